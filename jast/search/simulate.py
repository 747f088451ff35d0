"""One simulation in every tree: select, expand, roll out, back up."""

import jax
import jax.numpy as jnp
from jax import lax

from jast.episode import Progress, accumulator
from jast.search.foresee import foresee
from jast.search.records import pack, unpack
from jast.search.select import select
from jast.search.tree import (
    CHILD,
    FAILURE,
    FRESH,
    INVALID,
    LINK,
    PAGE,
    RAN,
    RETURNS,
    REWARD,
    ROW,
    VISITS,
    Node,
    choose_child,
    choose_rollout,
    levels,
    node_keys,
    node_shapes,
    of_lanes,
    take,
)

__all__ = ["child_state", "grow", "replay_to", "select_lanes"]


def grow(problem, axes, tree, begin_at, end_at, memoize="node"):
    """Run simulations ``begin_at`` .. ``end_at - 1`` in every tree (traced: one program for any number); none where all trees are at their end."""
    end_at = jnp.where(jnp.any(tree.alive), end_at, begin_at)
    return lax.fori_loop(begin_at, end_at, lambda i, tree: _simulation(problem, axes, tree, i, memoize), tree)


def _simulation(problem, axes, tree, i, memoize):
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    walk = select(problem, tree)
    fresh = tree.alive & ~tree.ended & (walk.best.child == 0)
    nothing = jnp.zeros((lanes,), bool)
    zero = jnp.zeros((lanes,), tree.edges.dtype)

    def expand():
        """The new child of each tree; and the node it is a child of, or the episode's end that selection ran into."""
        at = jnp.where(fresh, walk.node, -walk.best.child)
        desk = lax.dynamic_update_slice_in_dim(tree.desk, tree.nodes[at, lane][None], jnp.minimum(i, 0), 0)
        like = node_shapes(tree, memoize)
        node = jax.vmap(lambda w: unpack(w, like))(desk[0])
        state, replayed = (node.state, jnp.zeros_like(at)) if memoize == "node" else replay_to(problem, axes, tree, walk.trail, walk.depth, memoize)
        before = Progress(state, zero, walk.reward, node.distance, nothing, nothing, nothing)
        child = jax.vmap(_child, in_axes=(axes, 0, 0, 0, 0))(problem, node_keys(tree.key, walk.node), walk.best.slot, walk.depth, before)
        return desk, child._replace(log_prob=zero), replayed, node.reward, node.failure, node.invalid

    # in a conditional, so that all reads of the tree are over before the first write: otherwise XLA copies the tree
    nobody = lambda: (tree.desk, *jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(expand)[1:]))
    desk, child, replayed, known_reward, known_failure, known_invalid = lax.cond(jnp.any(tree.alive), expand, nobody)

    # roll out; lanes that have ended step on, and only what is summed up is masked
    key = jax.vmap(jax.random.fold_in, in_axes=(0, None))(tree.key, i)

    def roll(carry):
        level, steps, at = carry
        live = ~at.done
        after = jax.vmap(_rolled, in_axes=(axes, 0, 0, 0, 0))(problem, key, tree.key, level, at)
        kept = Progress(after.state, *(jnp.where(live, b, a) for a, b in zip(at[1:], after[1:], strict=True)))
        return level + 1, steps + _one(live), kept._replace(log_prob=zero)

    steps = _one(fresh & (walk.depth >= levels(problem.sim) - problem.sim.horizon))  # a random start is a level, but no step
    _, steps, end = lax.while_loop(lambda c: jnp.any(~c[2].done), roll, (walk.depth + 1, steps, child._replace(done=child.done | ~fresh)))

    value = jnp.where(fresh, end.reward, known_reward)
    finite = jnp.isfinite(value)
    worst = jnp.where(finite & tree.alive, jnp.minimum(tree.worst, value), tree.worst)
    backed = jnp.where(finite, value, jnp.where(jnp.isfinite(worst), worst, 0))
    first = tree.ended & tree.alive
    failed, invalid = jnp.where(fresh, end.failure, known_failure), jnp.where(fresh, end.invalid, known_invalid)
    bits = _bit(fresh | first, FRESH) | _bit(failed, FAILURE) | _bit(invalid, INVALID) | jnp.uint8(RAN)
    bits = jnp.where(tree.alive, bits, 0).astype(jnp.uint8)
    kept = Node(walk.node, walk.best.slot, child.reward, child.distance, child.failure, child.invalid, child.state if memoize == "node" else ())
    tree = tree._replace(
        edges=_back_up(tree, walk, fresh, child, backed, i + 1, link=not problem.values),
        nodes=lax.dynamic_update_slice_in_dim(tree.nodes, jax.vmap(pack)(kept)[None], i + 1, 0),
        desk=desk,
        pages=tree.pages if problem.values else tree.pages + _one(fresh & _fills(walk)),
        root_visits=tree.root_visits + _one(tree.alive),
        turn=tree.turn + jnp.where(tree.alive, jnp.stack([jnp.ones_like(backed), backed]), 0),
        worst=worst,
        steps=tree.steps + steps + jnp.where(fresh, replayed, 0),
        log=lax.dynamic_update_slice_in_dim(tree.log, value[None], i, 0),
        outcome=lax.dynamic_update_slice_in_dim(tree.outcome, bits[None], i, 0),
        alive=tree.alive & ~tree.ended,
    )
    if not problem.values:
        return tree
    return foresee(problem, axes, tree, walk, fresh, lambda lane, level, live: replay_to(problem, axes, tree, walk.trail, level, memoize, lane, live), memoize)


def _back_up(tree, walk, fresh, child, value, new, link):
    """The edges with one more visit and return along each path, and the new children in their slots: one scatter, since what is new was 0."""
    nowhere = tree.edges.size
    level = jnp.arange(tree.path.shape[0], dtype=jnp.int32)[:, None]
    last = walk.depth + _one(tree.alive & ~tree.ended)
    at = jnp.where((level >= tree.depth[None]) & (level < last[None]), walk.path, nowhere).reshape(-1)
    ids = jnp.where(child.done, -new, new).astype(tree.edges.dtype)
    slot = jnp.where(fresh, walk.best.edge, nowhere)
    returns = jnp.broadcast_to(value[None], walk.path.shape).reshape(-1)
    places, values = [at + VISITS, at + RETURNS, slot + CHILD, slot + REWARD], [jnp.ones_like(returns), returns, ids, child.reward]
    if link:  # where the page is full now, another goes on
        places.append(jnp.where(fresh & _fills(walk), walk.best.edge // ROW * ROW + LINK, nowhere))
        values.append(tree.pages.astype(tree.edges.dtype))
    return tree.edges.at[jnp.concatenate(places)].add(jnp.concatenate(values), mode="drop")


def _fills(walk):
    """Whether the chosen slot is the last of its page."""
    return walk.best.edge % ROW == PAGE - 1


def replay_to(problem, axes, tree, trail, depth, memoize, lane=None, live=None):
    """The simulator's state at the node ``trail[depth]`` of each tree, from the state that is kept, and the simulator steps that it took to get there.

    Or of the trees ``lane`` [m], ``depth`` [m], where ``live`` [m].
    """
    like = node_shapes(tree, memoize)
    key, base, first = tree.key, tree.base, tree.depth if memoize == "root" else jnp.zeros_like(tree.depth)
    running = tree.alive & ~tree.ended if live is None else live
    if lane is None:
        lane = jnp.arange(key.shape[0], dtype=jnp.int32)
    else:
        problem, key, base, first = of_lanes(problem, axes, lane), key[lane], jax.tree.map(lambda a: a[lane], base), first[lane]
    move = jax.vmap(child_state, in_axes=(axes, 0, 0, 0, 0))

    def body(carry):
        level, state = carry
        node = jax.vmap(lambda w: unpack(w, like))(tree.nodes[trail[level + 1, lane], lane])
        live = running & (level < depth)
        after = move(problem, node_keys(key, node.parent), node.slot, level, state)
        return level + _one(live), select_lanes(live, after, state)

    _, state = lax.while_loop(lambda c: jnp.any(running & (c[0] < depth)), body, (first, base))
    chosen = levels(problem.sim) - problem.sim.horizon  # a random start is a level, but no step
    return state, jnp.maximum(depth, chosen) - jnp.maximum(first, chosen)


def _child(problem, node_key, slot, level, before):
    return take(problem, level, before, choose_child(problem, node_key, slot, before.state))


def _rolled(problem, key, tree_key, level, before):
    return take(problem, level, before, choose_rollout(problem, key, tree_key, level, before.state))


def child_state(problem, node_key, slot, level, state):
    """One lane: the simulator's state at a node's child."""
    zero, nothing = jnp.zeros((), accumulator(problem.sim)), jnp.zeros((), bool)
    return _child(problem, node_key, slot, level, Progress(state, zero, zero, zero, nothing, nothing, nothing)).state


def select_lanes(pred, a, b):
    """Leaves [B, ...] of ``a`` where ``pred`` [B], else of ``b``."""
    return jax.tree.map(lambda x, y: jax.vmap(jnp.where)(pred, x, y), a, b)


def _one(pred):
    return pred.astype(jnp.int32)


def _bit(pred, bit):
    return jnp.where(pred, bit, 0).astype(jnp.uint8)
