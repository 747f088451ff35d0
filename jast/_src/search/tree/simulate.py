"""One simulation in every tree: select, expand, roll out, back up."""

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.core.transition import Progress, blank, conclude
from jast._src.search.tree import layout
from jast._src.search.tree.best_episode import fed_of, fed_source, feed_level, follows, update_lead
from jast._src.search.tree.child_values import evaluate_children
from jast._src.search.tree.packing import pack
from jast._src.search.tree.pages import back_up, fills
from jast._src.search.tree.select import walk_down
from jast._src.util.pytrees import index_tree, select, select_rows

__all__ = ["child_state", "grow", "replay_to"]


def grow(problem, tree, begin_at, end_at, memoize="node", axes=None):
    """Run simulations ``begin_at`` .. ``end_at - 1`` in every tree (traced: one program for any
    number); none where all trees are at their end.
    """
    end_at = jnp.where(jnp.any(tree.alive), end_at, begin_at)
    return lax.fori_loop(
        begin_at, end_at, lambda i, tree: _simulation(problem, axes, tree, i, memoize), tree
    )


def _simulation(problem, axes, tree, i, memoize):
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    walk = walk_down(problem, tree)
    fresh = tree.alive & ~tree.ended & (walk.best.child == 0)
    nothing = jnp.zeros((lanes,), bool)
    zero = jnp.zeros((lanes,), tree.edges.dtype)
    recorded, episodic = not isinstance(tree.trials, tuple), problem.sim.episodic
    source = jnp.where(tree.lead.on & fresh, tree.lead.source, 0) if follows(tree) else ()

    def trial(*numbers):
        return numbers if recorded else ()

    def without_log_p(progress):
        return progress if recorded else progress._replace(log_prob=zero)

    def expand():
        """The new child of each tree; and the node it is a child of, or the episode's end that
        selection ran into.
        """
        at = jnp.where(fresh, walk.node, -walk.best.child)
        desk = lax.dynamic_update_slice_in_dim(
            tree.desk, tree.nodes[at, lane][None], jnp.minimum(i, 0), 0
        )
        node = layout.nodes_of(tree, memoize, desk[0])
        if memoize == "node":
            state, replayed = node.state, jnp.zeros_like(at)
        else:
            state, replayed = replay_to(problem, axes, tree, walk.trail, walk.depth, memoize)
        so_far, owed = node.log_prob if recorded else zero, zero if episodic else ()
        flags = nothing, nothing, nothing
        before = Progress(state, so_far, walk.reward, node.distance, *flags, owed)
        of = walk.node, walk.best.slot, walk.depth, before, source, fed_source(tree, source, lane)
        child = jax.vmap(_child, in_axes=(axes, *[0] * 7))(problem, tree.key, *of)
        known = node.reward, node.failure, node.invalid, trial(node.distance, so_far)
        fed = fed_of(tree, jnp.zeros_like(lane) + i, lane)
        return desk, without_log_p(child), replayed, known, fed

    # in a conditional, so that all reads of the tree are over before the first write: otherwise XLA
    # copies the tree
    def nobody():
        blanks = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(expand)[1:])
        return tree.desk, *blanks

    desk, child, replayed, known, fed = lax.cond(jnp.any(tree.alive), expand, nobody)

    # roll out; lanes that have ended step on, and only what is summed up is masked (and the state,
    # where it is yet to be judged)
    key = jax.vmap(jax.random.fold_in, in_axes=(0, None))(tree.key, i)
    middle = feed_level(problem.sim)

    def roll(carry):
        level, steps, at, taken = carry
        live = ~at.done
        after, x = jax.vmap(_rolled, in_axes=(axes, *[0] * 5))(
            problem, key, tree.key, level, at, fed
        )
        kept = select(live, after._replace(state=()), at._replace(state=()))
        if problem.choice.feed:
            here = live & (level == middle)
            taken = jnp.where(here[:, None], jax.vmap(pack)((here, x)), taken)
        state = select_rows(live, after.state, at.state) if episodic else after.state
        return level + 1, steps + _one(live), without_log_p(kept._replace(state=state)), taken

    # a random start is a level, but no step
    steps = _one(fresh & (walk.depth >= problem.levels - problem.sim.horizon))
    taken = jnp.zeros_like(fed) if problem.choice.feed else ()
    carry = walk.depth + 1, steps, child._replace(done=child.done | ~fresh), taken
    _, steps, end, taken = lax.while_loop(lambda c: jnp.any(~c[2].done), roll, carry)
    if episodic:
        end = jax.vmap(lambda p, e, live: conclude(p.sim, p.reward, e, live), in_axes=(axes, 0, 0))(
            problem, end, fresh
        )
        ended = end._replace(state=()), child._replace(state=())
        child = select(child.done, *ended)._replace(state=child.state)

    rolled = end.reward, end.failure, end.invalid, trial(end.distance, end.log_prob)
    value, failed, invalid, numbers = select(fresh, rolled, known)
    finite = jnp.isfinite(value)
    worst = jnp.where(finite & tree.alive, jnp.minimum(tree.worst, value), tree.worst)
    backed = jnp.where(finite, value, jnp.where(jnp.isfinite(worst), worst, 0))
    outcome = layout.outcome_of(failed, fresh | (tree.ended & tree.alive), invalid, tree.alive)
    state = child.state if memoize == "node" else ()
    told = child.reward, child.distance, child.failure, child.invalid
    log_prob = child.log_prob if recorded else ()
    kept = layout.Node(walk.node, walk.best.slot, *told, state, source, log_prob)

    def put(into, row, at):
        return lax.dynamic_update_slice_in_dim(into, row[None], at, 0)

    tree = tree._replace(
        edges=back_up(tree, walk, fresh, child, backed, i + 1, link=not problem.values),
        nodes=put(tree.nodes, jax.vmap(pack)(kept), i + 1),
        desk=desk,
        pages=tree.pages if problem.values else tree.pages + _one(fresh & fills(walk)),
        root_visits=tree.root_visits + _one(tree.alive),
        turn=tree.turn + jnp.where(tree.alive, jnp.stack([jnp.ones_like(backed), backed]), 0),
        worst=worst,
        steps=tree.steps + steps + jnp.where(fresh, replayed, 0),
        log=put(tree.log, value, i),
        outcome=put(tree.outcome, outcome, i),
        alive=tree.alive & ~tree.ended,
        lead=update_lead(tree, walk, fresh, child, value, failed, i, taken),
        trials=put(tree.trials, jnp.stack(numbers), i) if recorded else (),
    )
    if not problem.values:
        return tree

    def replay(lane, level, live):
        return replay_to(problem, axes, tree, walk.trail, level, memoize, lane, live)

    return evaluate_children(problem, axes, tree, walk, fresh, replay, memoize)


def replay_to(problem, axes, tree, trail, depth, memoize, lane=None, live=None):
    """The simulator's state at the node ``trail[depth]`` of each tree, from the state that is kept,
    and the simulator steps that it took to get there.

    Or of the trees ``lane`` [m], ``depth`` [m], where ``live`` [m].
    """
    first = tree.depth if memoize == "root" else jnp.zeros_like(tree.depth)
    start = tree.key, tree.base, first
    running = tree.alive & ~tree.ended if live is None else live
    if lane is None:
        lane = jnp.arange(tree.key.shape[0], dtype=jnp.int32)
    else:
        problem = layout.of_lanes(problem, axes, lane)
        start = index_tree(start, lane)
    key, base, first = start
    move = jax.vmap(child_state, in_axes=(axes, *[0] * 7))

    def body(carry):
        level, state = carry
        node = layout.nodes_of(tree, memoize, tree.nodes[trail[level + 1, lane], lane])
        live = running & (level < depth)
        taken = node.source, fed_source(tree, node.source, lane)
        after = move(problem, key, node.parent, node.slot, level, state, *taken)
        return level + _one(live), select_rows(live, after, state)

    _, state = lax.while_loop(lambda c: jnp.any(running & (c[0] < depth)), body, (first, base))
    chosen = problem.levels - problem.sim.horizon  # a random start is a level, but no step
    return state, jnp.maximum(depth, chosen) - jnp.maximum(first, chosen)


def _child(problem, tree_key, parent, slot, level, before, source, fed):
    action = layout.choose(problem, tree_key, parent, slot, level, before.state, source, fed)
    return layout.take(problem, level, before, action)


def _rolled(problem, key, tree_key, level, before, fed):
    action = layout.choose_rollout(problem, key, tree_key, level, before.state, fed)
    return layout.take(problem, level, before, action, rolling=True), action[1]


def child_state(problem, tree_key, parent, slot, level, state, source=(), fed=()):
    """One lane: the simulator's state at a node's child."""
    before = blank(problem.sim, state)
    return _child(problem, tree_key, parent, slot, level, before, source, fed).state


def _one(pred):
    return pred.astype(jnp.int32)
