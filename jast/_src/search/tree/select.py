"""Selection: from the root down to a child that was never visited, or to an episode's end."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.search.tree.best_episode import follows
from jast._src.search.tree.pages import CHILD, LINK, PAGE, RETURNS, REWARD, ROW, VISITS
from jast._src.util.pytrees import select

__all__ = ["Best", "Walk", "walk_down"]


class Best(NamedTuple):
    """The best child of a node so far."""

    score: jax.Array
    edge: jax.Array
    """Its place in the edges."""
    slot: jax.Array
    visits: jax.Array
    child: jax.Array
    """Node id; 0: never visited; negative: an episode's end."""
    reward: jax.Array


class Walk(NamedTuple):
    """Where the selection of each tree stands: at a page of a node, with the best child so far."""

    node: jax.Array
    row: jax.Array
    """The page's row in the edges."""
    offset: jax.Array
    """Slots in the pages before."""
    count: jax.Array
    """Children of the node."""
    grows: jax.Array
    """bool: it will have one more at its next visit."""
    bonus: jax.Array
    """Exploration weight times sqrt(ln N(s))."""
    reward: jax.Array
    """From the start up to the node."""
    depth: jax.Array
    best: Best
    done: jax.Array
    path: jax.Array
    trail: jax.Array
    desk: jax.Array
    scores: jax.Array
    below: jax.Array
    values: jax.Array | tuple[()]
    """Desk of the pages' v(s, a), ``()`` without a value head; so are the next two."""
    last: jax.Array | tuple[()]
    """[H, B] last page's row of the path's nodes."""
    new: jax.Array | tuple[()]
    """[H, B] the slot that will be new at the next visit, or 0 (the first child needs no value
    while it is alone).
    """


def walk_down(problem, tree):
    """Walk down to a child that was never visited, or to an episode's end: MCFS-AP eq. 3 and
    progressive widening, a page an iteration.
    """
    settings, guide, valued = problem.settings, problem.guide, problem.values
    eager = valued and guide.eager
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    edges, dtype = tree.edges, tree.edges.dtype
    slots = jnp.arange(PAGE + 1, dtype=jnp.int32)[None]
    columns = jnp.array([[CHILD, REWARD]], jnp.int32)
    exploration = jnp.broadcast_to(jnp.asarray(settings.exploration, dtype), (lanes,))
    nil = jnp.zeros((lanes,), jnp.int32)

    # 0, which XLA does not know: an update of the whole desk would not be one in place
    first = jnp.minimum(tree.depth[0], 0)

    def of_node(visits):
        def width(n):
            return settings.widths[n if settings.widths.ndim == 1 else (lane, n)]

        count = width(visits)
        grows = width(visits + 1) > count if eager else ()
        return count, grows, exploration * jnp.sqrt(jnp.log(visits.astype(dtype)))

    def lay_out(desk, rows):
        """``rows`` on the desk, to be read from there (see `Tree.desk`): the desk and they."""
        desk = lax.dynamic_update_slice_in_dim(desk, rows[None], first, 0)
        return desk, desk[0]

    def number(a):  # of all trees or of each
        return jnp.asarray(a, dtype).reshape(-1, 1)

    def pick(row, at):
        return jnp.take_along_axis(row, at[:, None], axis=1, mode="promise_in_bounds")[:, 0]

    def body(w):
        desk, row = lay_out(w.desk, edges.reshape(-1, CHILD)[w.row * (ROW // CHILD)])
        n, total = row[:, VISITS:RETURNS], row[:, RETURNS:CHILD]
        q = problem.q_value(total, n, w.reward[:, None])
        values = ()
        if valued:
            values, v = lay_out(w.values, tree.values.reshape(-1, PAGE + 1)[w.row])
            q = number(guide.q_weight) * q + number(guide.v_weight) * v
        if problem.choice.urgent:  # thesis Algorithm 10
            score = jnp.where(n > 0, q + w.bonus[:, None] / jnp.sqrt(jnp.maximum(n, 1)), jnp.inf)
        else:
            score = q + w.bonus[:, None] / jnp.sqrt(1 + n)  # eq. 3
        there = slots < jnp.minimum(w.count - w.offset, PAGE)[:, None]
        if valued and not eager:  # one that was not tried yet stands after those that were
            there &= (slots == 0) | (n > 0) | (jnp.roll(n, 1, axis=1) > 0)
        score = jnp.where(there, score, -jnp.inf)
        scores, score = lay_out(w.scores, score)
        j = jnp.argmax(score, axis=1).astype(jnp.int32)
        top = pick(score, j)
        edge, link = w.row * ROW + j, row[:, LINK]
        better = top > w.best.score  # the first maximum wins
        edge = jnp.where(better, edge, w.best.edge)
        below, told = lay_out(w.below, edges[edge[:, None] + columns])
        found = Best(
            score=jnp.where(better, top, w.best.score),
            edge=edge,
            slot=jnp.where(better, w.offset + j, w.best.slot),
            visits=jnp.where(better, pick(row, VISITS + j).astype(jnp.int32), w.best.visits),
            child=told[:, 0].astype(jnp.int32),
            reward=told[:, 1],
        )
        # without a link there is an unvisited slot here, and later ones score the same; with values
        # all pages are linked
        more = ~w.done & (link > 0) & (w.offset + PAGE < w.count)
        taken = ~w.done & ~more
        descend = taken & (found.child > 0)
        count, grows, bonus = of_node(found.visits)
        level = jnp.where(taken, w.depth, w.path.shape[0])
        next_page = link.astype(jnp.int32) * lanes + lane
        first_page = found.child * lanes + lane
        deeper = jnp.where(descend, w.depth + 1, w.trail.shape[0])
        ahead = found._replace(score=jnp.where(descend, -jnp.inf, found.score))
        last, new = w.last, w.new
        if eager:
            last = last.at[level, lane].set(w.row, mode="drop")
            new = new.at[level, lane].set(jnp.where(w.grows, w.count, 0), mode="drop")
        return Walk(
            node=jnp.where(descend, found.child, w.node),
            row=jnp.where(more, next_page, jnp.where(descend, first_page, w.row)),
            offset=jnp.where(more, w.offset + PAGE, 0),
            count=jnp.where(descend, count, w.count),
            grows=jnp.where(descend, grows, w.grows) if eager else (),
            bonus=jnp.where(descend, bonus, w.bonus),
            reward=jnp.where(descend, found.reward, w.reward),
            depth=w.depth + descend.astype(jnp.int32),
            best=select(w.done, w.best, ahead),
            done=w.done | (taken & (found.child <= 0)),
            path=w.path.at[level, lane].set(found.edge, mode="drop"),
            desk=desk,
            scores=scores,
            below=below,
            trail=w.trail.at[deeper, lane].set(found.child, mode="drop"),
            values=values,
            last=last,
            new=new,
        )

    place = tree.root, tree.root_visits, tree.root_reward, tree.depth, tree.path, tree.trail
    # straight to the last node of the best episode's path, which was visited once
    if follows(tree):
        lead, once = tree.lead, jnp.ones_like(tree.root_visits)
        end = lead.node, once, lead.reward, lead.depth, lead.path, lead.trail
        place = (
            jnp.where(lead.on if a.ndim == 1 else lead.on[None], a, b)
            for a, b in zip(end, place, strict=True)
        )
    node, visits, reward, depth, path, trail = place
    count, grows, bonus = of_node(visits)
    zero = jnp.zeros((lanes,), dtype)
    start = Walk(
        node=node,
        row=node * lanes + lane,
        offset=nil,
        count=count,
        grows=grows,
        bonus=bonus,
        reward=reward,
        depth=depth,
        best=Best(zero - jnp.inf, nil, nil, nil, nil, zero),
        done=~tree.alive | tree.ended,
        path=path,
        trail=trail,
        desk=jnp.zeros((2, lanes, CHILD), dtype),
        scores=jnp.zeros((2, lanes, PAGE + 1), dtype),
        below=jnp.zeros((2, lanes, 2), dtype),
        values=jnp.zeros((2, lanes, PAGE + 1), dtype) if valued else (),
        last=jnp.zeros(tree.path.shape, jnp.int32) if eager else (),
        new=jnp.zeros(tree.path.shape, jnp.int32) if eager else (),
    )
    return lax.while_loop(lambda w: jnp.any(~w.done), body, start)
