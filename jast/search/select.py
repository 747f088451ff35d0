"""Selection: from the root down to a child that was never visited, or to an episode's end."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.search.tree import CHILD, LINK, PAGE, RETURNS, REWARD, ROW, VISITS

__all__ = ["Best", "Walk", "select"]


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


def select(settings, tree):
    """Walk down to a child that was never visited, or to an episode's end: MCFS-AP eq. 3 and progressive widening, a page an iteration."""
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    edges, dtype = tree.edges, tree.edges.dtype
    slots, columns = jnp.arange(PAGE + 1, dtype=jnp.int32)[None], jnp.array([[CHILD, REWARD]], jnp.int32)
    exploration = jnp.broadcast_to(jnp.asarray(settings.exploration, dtype), (lanes,))
    nil = jnp.zeros((lanes,), jnp.int32)

    first = jnp.minimum(tree.depth[0], 0)  # 0, which XLA does not know: an update of the whole desk would not be one in place

    def of_node(visits):
        count = settings.widths[visits] if settings.widths.ndim == 1 else settings.widths[lane, visits]
        return count, exploration * jnp.sqrt(jnp.log(visits.astype(dtype)))

    def read(w):
        """Visits and returns of the pages, laid out on the desk (see `Tree.desk`)."""
        rows = edges.reshape(-1, CHILD)[w.row * (ROW // CHILD)]
        desk = lax.dynamic_update_slice_in_dim(w.desk, rows[None], first, 0)
        return desk, desk[0]

    def pick(row, column, j):
        return jnp.take_along_axis(row, (column + j)[:, None], axis=1, mode="promise_in_bounds")[:, 0]

    def body(w):
        desk, row = read(w)
        n, total = row[:, VISITS:RETURNS], row[:, RETURNS:CHILD]
        q = jnp.where(n > 0, total / jnp.maximum(n, 1) - w.reward[:, None], 0)
        score = q + w.bonus[:, None] / jnp.sqrt(1 + n)  # eq. 3; the value term joins here
        score = jnp.where(slots < jnp.minimum(w.count - w.offset, PAGE)[:, None], score, -jnp.inf)
        scores = lax.dynamic_update_slice_in_dim(w.scores, score[None], first, 0)
        score = scores[0]
        j = jnp.argmax(score, axis=1).astype(jnp.int32)
        top = pick(score, 0, j)
        edge, link = w.row * ROW + j, row[:, LINK]
        better = top > w.best.score  # the first maximum wins
        edge = jnp.where(better, edge, w.best.edge)
        below = lax.dynamic_update_slice_in_dim(w.below, edges[edge[:, None] + columns][None], first, 0)
        child, reward = below[0, :, 0].astype(jnp.int32), below[0, :, 1]
        visits = jnp.where(better, pick(row, VISITS, j).astype(jnp.int32), w.best.visits)
        found = Best(jnp.where(better, top, w.best.score), edge, jnp.where(better, w.offset + j, w.best.slot), visits, child, reward)
        more = ~w.done & (link > 0) & (w.offset + PAGE < w.count)  # without a link there is an unvisited slot here, and later ones score the same
        taken = ~w.done & ~more
        descend = taken & (found.child > 0)
        count, bonus = of_node(found.visits)
        return Walk(
            node=jnp.where(descend, found.child, w.node),
            row=jnp.where(more, link.astype(jnp.int32) * lanes + lane, jnp.where(descend, found.child * lanes + lane, w.row)),
            offset=jnp.where(more, w.offset + PAGE, 0),
            count=jnp.where(descend, count, w.count),
            bonus=jnp.where(descend, bonus, w.bonus),
            reward=jnp.where(descend, found.reward, w.reward),
            depth=w.depth + descend.astype(jnp.int32),
            best=jax.tree.map(lambda a, b: jnp.where(w.done, b, a), found._replace(score=jnp.where(descend, -jnp.inf, found.score)), w.best),
            done=w.done | (taken & (found.child <= 0)),
            path=w.path.at[jnp.where(taken, w.depth, w.path.shape[0]), lane].set(found.edge, mode="drop"),
            desk=desk,
            scores=scores,
            below=below,
            trail=w.trail.at[jnp.where(descend, w.depth + 1, w.trail.shape[0]), lane].set(found.child, mode="drop"),
        )

    row = tree.root * lanes + lane
    count, bonus = of_node(tree.root_visits)
    nobody = Best(jnp.full((lanes,), -jnp.inf, dtype), nil, nil, nil, nil, jnp.zeros((lanes,), dtype))
    stay = ~tree.alive | tree.ended
    start = Walk(
        tree.root,
        row,
        nil,
        count,
        bonus,
        tree.root_reward,
        tree.depth,
        nobody,
        stay,
        tree.path,
        tree.trail,
        *(jnp.zeros((2, lanes, n), dtype) for n in (CHILD, PAGE + 1, 2)),
    )
    return lax.while_loop(lambda w: jnp.any(~w.done), body, start)
