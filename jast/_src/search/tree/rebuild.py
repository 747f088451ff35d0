"""Episodes of a tree search, rebuilt from the number of their simulation: choices are addressed, so
none has to be stored.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.episode import Episode
from jast._src.core.transition import blank
from jast._src.search.tree.best_episode import fed_of, fed_source
from jast._src.search.tree.layout import choose, choose_rollout, flags, nodes_of, of_lanes, take
from jast._src.util.pytrees import index_tree, select, zero_where

__all__ = ["rebuild"]


def rebuild(problem, tree, lane, i, memoize="node", axes=None):
    """The episode of simulation ``i`` [n] of tree ``lane`` [n]: an `Episode` [n, ...] with the
    search's own reward, without states and true log p.

    To be passed through `jast.replay`, which gives it its exact numbers.
    """
    return jax.vmap(lambda lane, i: _one(problem, axes, tree, lane, i, memoize))(lane, i)


def _one(problem, axes, tree, lane, i, memoize):
    problem = of_lanes(problem, axes, lane)
    key, sim, height = tree.key[lane], problem.sim, problem.levels
    failed, fresh, *_ = flags(tree.outcome[i, lane])
    leaf = jnp.where(fresh & ~tree.ended[lane], i + 1, 0)

    def up(node, _):
        of = nodes_of(tree, memoize, tree.nodes[node, lane])
        return of.parent, (node, of.parent, of.slot, of.source)

    _, (nodes, parents, slots, sources) = lax.scan(up, leaf, None, length=height)
    # choices made in the tree; those of the rollout follow
    depth = jnp.sum(nodes > 0, dtype=jnp.int32)
    rolling = jax.random.fold_in(key, i)
    begin = index_tree(tree.origin, lane)

    def down(at, level):
        up_there = jnp.clip(depth - 1 - level, 0, height - 1)
        parent, slot, source = index_tree((parents, slots, sources), up_there)
        taken = source, fed_source(tree, source, lane)
        chosen = choose(problem, key, parent, slot, level, at.state, *taken)
        rolled = choose_rollout(problem, rolling, key, level, at.state, fed_of(tree, i, lane))
        x0, x = action = select(level < depth, chosen, rolled)
        after = select(at.done, at, take(problem, level, at, action))
        return after, (x0, zero_where(at.done, x), ~at.done)

    start = blank(sim, begin)._replace(done=tree.ended[lane])
    end, (x0s, xs, lived) = lax.scan(down, start, jnp.arange(height, dtype=jnp.int32))
    first = height - sim.horizon
    x0 = index_tree(x0s, 0)
    steps = jnp.sum(lived[first:], dtype=jnp.int32)
    xs = index_tree(xs, np.s_[first:])
    return Episode(x0, xs, end.log_prob, end.distance, failed, steps, tree.log[i, lane])
