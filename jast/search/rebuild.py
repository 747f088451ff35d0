"""Episodes of a tree search, rebuilt from the number of their simulation: choices are addressed, so none has to be stored."""

import jax
import jax.numpy as jnp
from jax import lax

from jast.episode import Episode, Progress, accumulator
from jast.search.records import unpack
from jast.search.tree import FAILURE, FRESH, choose_child, choose_rollout, levels, node_keys, node_shapes, of_lanes, take

__all__ = ["rebuild"]


def rebuild(problem, axes, tree, lane, i, memoize="node"):
    """The episode of simulation ``i`` [n] of tree ``lane`` [n]: an `Episode` [n, ...] with the search's own reward, without states and true log p.

    To be passed through `jast.replay`, which gives it its exact numbers.
    """
    return jax.vmap(lambda lane, i: _one(problem, axes, tree, lane, i, memoize))(lane, i)


def _one(problem, axes, tree, lane, i, memoize):
    problem = of_lanes(problem, axes, lane)
    like, key, sim = node_shapes(tree, memoize), tree.key[lane], problem.sim
    height = levels(sim)
    outcome = tree.outcome[i, lane]
    leaf = jnp.where(((outcome & FRESH) > 0) & ~tree.ended[lane], i + 1, 0)

    def up(node, _):
        record = unpack(tree.nodes[node, lane], like)
        return record.parent, (node, record.parent, record.slot)

    _, (nodes, parents, slots) = lax.scan(up, leaf, None, length=height)
    depth = jnp.sum(nodes > 0, dtype=jnp.int32)  # choices made in the tree; those of the rollout follow
    rolling = jax.random.fold_in(key, i)
    begin = jax.tree.map(lambda a: a[lane], tree.origin)
    zero, false = jnp.zeros((), accumulator(sim)), jnp.zeros((), bool)

    def down(at, level):
        up_there = jnp.clip(depth - 1 - level, 0, height - 1)
        chosen = choose_child(problem, node_keys(key[None], parents[up_there][None])[0], slots[up_there], at.state)
        rolled = choose_rollout(problem, rolling, key, level, at.state)
        x0, x = action = jax.tree.map(lambda a, b: jnp.where(level < depth, a, b), chosen, rolled)
        after = take(problem, level, at, action)
        kept = jax.tree.map(lambda a, b: jnp.where(at.done, a, b), at, after)
        return kept, (x0, jax.tree.map(lambda a: jnp.where(at.done, jnp.zeros((), a.dtype), a), x), ~at.done)

    start = Progress(begin, zero, zero, zero + jnp.inf, false, tree.ended[lane], false)
    end, (x0s, xs, lived) = lax.scan(down, start, jnp.arange(height, dtype=jnp.int32))
    first = height - sim.horizon
    x0 = jax.tree.map(lambda a: a[0], x0s)
    steps = jnp.sum(lived[first:], dtype=jnp.int32)
    return Episode(x0, jax.tree.map(lambda a: a[first:], xs), end.log_prob, end.distance, (outcome & FAILURE) > 0, steps, tree.log[i, lane])
