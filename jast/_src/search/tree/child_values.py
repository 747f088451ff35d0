"""The value term of eq. 3: v(s, a) of a child, evaluated once, when the child appears, and kept in
the tree.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.distributions.flat_rows import flat
from jast._src.heads.heads import observation, predicted_value
from jast._src.search.tree.layout import choose_child, node_keys, nodes_of, of_lanes
from jast._src.search.tree.pages import LINK, PAGE, ROW

__all__ = ["evaluate_children"]


def evaluate_children(problem, axes, tree, walk, fresh, replay, memoize):
    """Give children their v(s, a) before a selection sees them, and pages to stand on: the tree.

    With ``guide.eager``, of every node of the path the child that its next visit will find; else of
    the node that has a new child, ``fresh`` [B], the one that comes after it. A first child needs
    no value before it has a sibling: both come at once then. They are put in a row and evaluated
    together, two a tree at a time. ``replay(lane, level, live)`` [m]: states of the path's nodes
    where they are not kept, and the steps to get there.
    """
    lanes = tree.key.shape[0]
    lane, nowhere = jnp.arange(lanes, dtype=jnp.int32), tree.edges.size
    if problem.guide.eager:
        new, last = walk.new, walk.last
        depth = lax.broadcasted_iota(jnp.int32, new.shape, 0)
        on_path = (depth >= tree.depth[None]) & (depth <= walk.depth[None])
        todo = (tree.alive & ~tree.ended)[None] & (new > 0) & on_path
    else:
        row = walk.depth, fresh, walk.best.slot + 1, walk.best.edge // ROW
        depth, todo, new, last = (a[None] for a in row)

    opens = todo & (new % PAGE == 0)  # a page of its own
    rank = jnp.cumsum(opens, axis=0, dtype=jnp.int32)
    page = tree.pages[None] + rank - 1
    rows = jnp.where(opens, page * lanes + lane[None], last)

    # the new child, and the first one where the new one is its first sibling
    both = jnp.concatenate([todo, todo & (new == 1)])
    per_lane = jnp.sum(both, axis=0, dtype=jnp.int32)
    before = jnp.cumsum(per_lane, dtype=jnp.int32) - per_lane  # those of the trees to the left
    place = jnp.cumsum(both, axis=0, dtype=jnp.int32) - 1 + before[None]
    place = jnp.where(both, place, -1).reshape(-1)
    number, room = jnp.arange(place.size, dtype=jnp.int32), 2 * lanes
    total = jnp.sum(per_lane, dtype=jnp.int32)

    def some(carry):
        done, edges, values, steps = carry
        here = (place >= done) & (place < done + room)
        at = jnp.where(here, place - done, room)
        entry = jnp.zeros((room,), jnp.int32).at[at].set(number, mode="drop")
        live = jnp.arange(room, dtype=jnp.int32) < total - done
        at = entry // lanes % len(new), entry % lanes
        level, column = depth[at], at[1]
        slot = jnp.where(entry >= new.size, 0, new[at])
        node, row = walk.trail[level, column], rows[at]
        if memoize == "node":
            state = nodes_of(tree, memoize, tree.nodes[node, column]).state
        else:
            state, taken = replay(column, level, live)
            steps = steps.at[jnp.where(live, column, lanes)].add(taken, mode="drop")
        v = jax.vmap(_value, in_axes=(axes, 0, 0, 0))(
            of_lanes(problem, axes, column), node_keys(tree.key[column], node), slot, state
        )
        # the level of a random start has no value: all its children score 0
        v = jnp.where(level < problem.levels - problem.sim.horizon, 0, v).astype(values.dtype)
        to = jnp.where(live, row * (PAGE + 1) + slot % PAGE, nowhere)
        values = values.at[to].set(v, mode="drop")
        link = jnp.where(live & opens[at], last[at] * ROW + LINK, nowhere)
        edges = edges.at[link].add(page[at].astype(edges.dtype), mode="drop")
        return done + room, edges, values, steps

    _, edges, values, steps = lax.while_loop(
        lambda c: c[0] < total, some, (jnp.int32(0), tree.edges, tree.values, tree.steps)
    )
    return tree._replace(edges=edges, values=values, pages=tree.pages + rank[-1], steps=steps)


def _value(problem, node_key, slot, state):
    """v(s, a); 0 where it is not finite."""
    _, x = choose_child(problem, node_key, slot, state)
    v = predicted_value(problem.guide.heads, observation(problem.sim, state), flat(x))
    return jnp.where(jnp.isfinite(v), v, 0)
