"""A batch of search trees as arrays.

All trees advance side by side: simulation i runs in every tree at once. Arrays never leave their
place: every write is a row, or a scatter whose index is out of range where there is nothing to
write, and no tree array is an operand of a select.

 - Node ids: node ``i + 1`` is made by simulation i, in every tree; 0 is the first root. So making a
   node is one contiguous row write.
 - Edges: a node's children sit in pages of ``PAGE`` slots, each slot with the child's visits, the
   sum of its returns and its id. The first page of a node has the node's id; when a page fills up,
   the next free one is linked behind it, so a node may have any number of children. What a
   selection reads of every page, visits and returns, stands together: two cache lines in float32.
 - A slot that was never visited needs no storage: the number of children is a function of the
   node's visits alone (`widths`), and the action of a slot is drawn from its address (tree, node,
   slot). Unvisited slots score alike, so they are visited in order.
 - With a value head they do not: then v(s, a) of every child stands in ``Tree.values``, and pages
   are linked when a child appears, not when it is visited.
 - Returns are those of whole episodes; Q(s, a) subtracts the reward up to s.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.rewards import once
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, never
from jast._src.core.transition import advance, begin, blank, conclude
from jast._src.core.typing import Reward
from jast._src.runtime._jax import is_traced
from jast._src.search.tree.best_episode import Lead, feed_level, follows, no_lead, take_fed
from jast._src.search.tree.head_guidance import Guide, rolled
from jast._src.search.tree.packing import pack, unpack
from jast._src.search.tree.pages import PAGE, ROW
from jast._src.util.pytrees import select

__all__ = [
    "Node",
    "Problem",
    "Settings",
    "choose",
    "choose_child",
    "choose_rollout",
    "flags",
    "levels",
    "make",
    "most_lanes",
    "node_keys",
    "nodes_of",
    "of_lanes",
    "outcome_of",
    "pages_of",
    "take",
    "widths",
]

FAILURE, FRESH, INVALID, RAN = 1, 2, 4, 8  # bits of Tree.outcome
_NODE = np.uint32(1 << 31)  # addresses of children, apart from those of simulations


class Settings(NamedTuple):
    """The real-valued settings of a search, all traced."""

    exploration: jax.Array
    """c1 of MCFS-AP eq. 3."""
    widths: jax.Array
    """[simulations + 2] int32: the number of children of a node by its visits."""


class Problem(NamedTuple):
    """What a tree search is about: pytrees, each shared by all trees or with a leading axis [B]."""

    sim: Simulator
    reward: Reward
    choice: Any
    """`search.tree.settings.Choice`."""
    settings: Settings
    guide: Guide | tuple[()] = ()
    """`search.tree.head_guidance.Guide`, or ``()`` for a search without heads."""

    @property
    def values(self):
        """Whether children have a v(s, a)."""
        return self.guide != () and self.guide.heads.value is not None

    @property
    def levels(self):
        """`levels` of its simulator."""
        return levels(self.sim)

    def q_value(self, total, visits, before):
        """Q(s, a), 0 where there are no visits: the mean of the returns ``total`` less what was
        paid ``before``, up to s; a reward of whole episodes pays nothing before the end.
        """
        mean = total / jnp.maximum(visits, 1)
        return jnp.where(visits > 0, mean if once(self.reward) else mean - before, 0)


class Tree(NamedTuple):
    """B trees of up to S simulations; H levels (the horizon, and one more for a random start)."""

    key: jax.Array
    """[B] counter keys."""
    edges: jax.Array
    """[pages * B * ROW] float: a row a page, ``page * B + lane``. Of each child: visits N(s, a),
    sum of returns, node id (negative: an episode's end, 0: not visited yet), reward from the start
    up to it.
    """
    nodes: jax.Array
    """[S + 1, B, words] uint32: a packed `Node` each."""
    desk: jax.Array
    """[2, B, words] uint32: where the node of a simulation is laid out to be read. XLA would cut a
    gather from a large array over threads, which for so few numbers costs more than it saves,
    unless the gather ends in an update in place.
    """
    values: jax.Array | tuple[()]
    """[pages * B * (PAGE + 1)] float: v(s, a) of each child, rows as in ``edges``; ``()`` without a
    value head.
    """
    pages: jax.Array
    """[B] int32: pages in use."""
    root: jax.Array
    """[B] int32: the current root."""
    root_visits: jax.Array
    """[B] int32: N(root)."""
    root_reward: jax.Array
    """[B] float: reward from the start up to the root."""
    depth: jax.Array
    """[B] int32: the current root's level."""
    trail: jax.Array
    """[H + 1, B] int32: nodes from the first root to the current one."""
    path: jax.Array
    """[H, B] int32: edges from the first root to the current one, as places in ``edges``."""
    turn: jax.Array
    """[2, B] float: visits and returns since the last root, which the edges of ``path`` have not
    seen yet.
    """
    alive: jax.Array
    """[B] bool: false once the root is an episode's end."""
    ended: jax.Array
    """[B] bool: the first root is one: the system ends at its start, and one simulation says all.
    """
    origin: Any
    """[B, ...] the first root's state."""
    base: Any
    """[B, ...] the state from which replays start: the first root's or, with memoization at roots,
    the current one's.
    """
    worst: jax.Array
    """[B] float: least finite return so far, backed up in place of one that is not finite."""
    steps: jax.Array
    """[B] int32: simulator steps taken."""
    log: jax.Array
    """[S, B] float: reward of the episode of each simulation."""
    outcome: jax.Array
    """[S, B] uint8: `outcome_of` each simulation."""
    lead: Lead | tuple[()]
    """`Lead`, the best episode of each tree, or ``()`` where the search makes no use of it."""
    trials: jax.Array | tuple[()]
    """[S, 2, B] float: miss distance and true log p of the episode of each simulation; ``()`` where
    they are not recorded.
    """


class Node(NamedTuple):
    """What a tree knows of a node beside its edges."""

    parent: jax.Array
    slot: jax.Array
    """Its place among its parent's children."""
    reward: jax.Array
    """From the start up to here."""
    distance: jax.Array
    failure: jax.Array
    invalid: jax.Array
    state: Any
    """The simulator's state, or ``()`` where states are not kept at nodes."""
    source: jax.Array | tuple[()] = ()
    """int32: 1 + the simulation whose rollout took the action that led here, 0: it is the slot's
    own; ``()`` without `Choice.follow`.
    """
    log_prob: jax.Array | tuple[()] = ()
    """From the start up to here; ``()`` where trials are not recorded."""


def widths(simulations, k, alpha):
    """[simulations + 2] int32: the number of children of a node that was visited n times before, n
    = 0, 1, ...

    Progressive widening adds at most one child a visit, while #children <= k n^alpha (MCFS-AP
    Algorithm 1; Moss's Algorithm 10 tests before it adds), which for alpha <= 1 comes to min(n,
    floor(k n^alpha) + 1). Made on the host in float64 unless ``k`` or ``alpha`` are traced.
    """
    if is_traced(k, alpha):
        n = jnp.arange(simulations + 2, dtype=jnp.int32)
        bound = jnp.floor(k * n.astype(jnp.float32) ** alpha * (1 + 4e-7)).astype(jnp.int32) + 1
        return jnp.minimum(n, bound)
    n = np.arange(simulations + 2)
    bound = np.floor(float(k) * n ** float(alpha) * (1 + 1e-14)) + 1
    return np.minimum(n, bound).astype(np.int32)


def levels(sim: Simulator) -> int:
    """Levels of choices in an episode: x_1 .. x_horizon, and x0 where the start is random."""
    return sim.horizon + signature_of(sim).random_start


def pages_of(problem, simulations):
    """Pages of a tree of so many simulations: one for each node, and one more whenever one is
    full.
    """
    more = simulations // PAGE
    if problem.values and problem.guide.eager:  # children stand on pages before they are visited
        levels, table = problem.levels, problem.settings.widths
        # at each level, the visits of all nodes are at most the simulations
        n = np.arange(1, simulations + 2)
        children = (
            n if is_traced(table) else np.asarray(table).reshape(-1, simulations + 2).max(0)[1:]
        )
        more = int(simulations * levels * np.max((-(-children // PAGE) - 1) / n)) + levels
    return simulations + 1 + more + 1


def most_lanes(pages):
    """How many trees of so many pages one `Tree` can hold: places in its edges are int32."""
    return (2**31 - 1 - ROW) // (pages * ROW)


def make(problem, keys, simulations, memoize="node", pages=None, record=False, axes=None):
    """Trees of one root each, with room for ``simulations`` in so many ``pages`` (default:
    `pages_of`).

    ``axes`` says which parts of ``problem`` differ between trees (0) or not (None); None: none
    does. ``record``: `Tree.trials` are wanted.
    """
    # Why axes: in a batch of searches (`jax.vmap`) some parameters differ from tree to tree; the
    # others, in most searches all, are held once and not once a tree.
    (lanes,) = keys.shape
    pages = pages_of(problem, simulations) if pages is None else pages
    if lanes > most_lanes(pages):
        raise ValueError(
            f"search: expected at most {most_lanes(pages)} trees of {simulations} simulations side"
            f" by side, so that 32 bits can number their nodes, received {lanes}"
        )

    def origin(problem, key):
        if signature_of(problem.sim).random_start:
            # any state will do: the first level chooses x0
            x0 = problem.choice.actions.draw_start(key, problem.sim.start())
            return blank(problem.sim, begin(problem.sim, problem.reward, x0).state)
        first = begin(problem.sim, problem.reward, ())
        # an episodic system may be at its end from the start, but a user's evaluation is not called
        # in vain
        if problem.sim.is_terminal.func is never:
            return first
        return conclude(problem.sim, problem.reward, first, first.done)

    first = jax.vmap(origin, in_axes=(axes, 0))(problem, keys)
    dtype = first.reward.dtype
    count = jnp.zeros((lanes,), jnp.int32)
    lead = no_lead(problem, lanes, problem.levels, simulations, dtype)
    told = first.reward, first.distance, first.failure, first.invalid
    state = first.state if memoize == "node" else ()
    source = count if problem.choice.follow else ()
    log_prob = first.log_prob if record else ()
    words = jax.vmap(pack)(Node(count, count, *told, state, source, log_prob))
    return Tree(
        key=keys,
        edges=jnp.zeros((pages * lanes * ROW,), dtype),
        nodes=jnp.zeros((simulations + 1, *words.shape), words.dtype).at[0].set(words),
        desk=jnp.zeros((2, *words.shape), words.dtype),
        values=jnp.zeros((pages * lanes * (PAGE + 1),), dtype) if problem.values else (),
        pages=count + simulations + 1,
        root=count,
        root_visits=count + 1,
        root_reward=first.reward,
        depth=count,
        trail=jnp.zeros((problem.levels + 1, lanes), jnp.int32),
        path=jnp.zeros((problem.levels, lanes), jnp.int32),
        turn=jnp.zeros((2, lanes), dtype),
        alive=jnp.ones((lanes,), bool),
        ended=first.done,
        origin=first.state,
        base=first.state,
        worst=jnp.full((lanes,), jnp.inf, dtype),
        steps=count,
        log=jnp.full((simulations, lanes), -jnp.inf, dtype),
        outcome=jnp.zeros((simulations, lanes), jnp.uint8),
        lead=lead,
        trials=jnp.zeros((simulations, 2, lanes), dtype) if record else (),
    )


def outcome_of(failed, fresh, invalid, ran):
    """uint8: the flags of simulations, each a bit; 0 where one never ``ran``. ``fresh``: it was no
    end seen before.
    """
    bits = zip((failed, fresh, invalid, ran), (FAILURE, FRESH, INVALID, RAN), strict=True)
    outcome = sum(jnp.where(flag, bit, 0) for flag, bit in bits)
    return jnp.where(ran, outcome, 0).astype(jnp.uint8)


def flags(outcome):
    """``failed``, ``fresh``, ``invalid`` and ``ran``, of which `outcome_of` was made."""
    return [(outcome & bit) > 0 for bit in (FAILURE, FRESH, INVALID, RAN)]


def node_shapes(tree, memoize):
    """The shapes and dtypes of one tree's `Node`."""
    number, real, flag = (
        jax.ShapeDtypeStruct((), dtype) for dtype in (jnp.int32, tree.edges.dtype, jnp.bool_)
    )
    state = ()
    if memoize == "node":
        state = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), tree.origin)
    source = number if follows(tree) else ()
    log_prob = () if isinstance(tree.trials, tuple) else real
    return Node(number, number, real, real, flag, flag, state, source, log_prob)


def nodes_of(tree, memoize, rows):
    """The `Node` of each of ``rows`` [..., words] of ``tree.nodes``."""
    unpacked = partial(unpack, like=node_shapes(tree, memoize))
    for _ in rows.shape[:-1]:
        unpacked = jax.vmap(unpacked)
    return unpacked(rows)


def choose_child(problem, node_key, slot, state):
    """One lane: (x0, x), the action of a node's child, for a first level that chooses x0 and for
    any other; x0 is ``()`` for a system with one start.
    """
    sim, choice, chosen = problem.sim, problem.choice, signature_of(problem.sim).random_start
    x0 = choice.child(node_key, slot, sim.start(), start=True) if chosen else ()
    return x0, choice.child(node_key, slot, sim.disturbance(state))


def choose(problem, tree_key, parent, slot, level, state, source=(), fed=()):
    """One lane: (x0, x), the action of the child in this slot of the node ``parent``, or the one of
    the rollout of simulation ``source`` - 1, fed ``fed``.
    """
    own = choose_child(problem, node_keys(tree_key[None], parent[None])[0], slot, state)
    if not problem.choice.follow:
        return own
    simulation = jax.random.fold_in(tree_key, source - 1)
    taken = choose_rollout(problem, simulation, tree_key, level, state, fed)
    return select(source > 0, taken, own)


def choose_rollout(problem, key, tree_key, level, state, fed=()):
    """One lane: (x0, x) of a level of a rollout, by the keys of its simulation and its tree, and
    what it is fed.
    """
    sim, choice, chosen = problem.sim, problem.choice, signature_of(problem.sim).random_start
    guide, simulation, key = problem.guide, key, jax.random.fold_in(key, level)
    x0 = choice.roll(key, tree_key, sim.start(), start=True) if chosen else ()
    dist = sim.disturbance(state)
    x = choice.roll(key, tree_key, dist)
    if guide != () and guide.heads.policy is not None:
        of = guide, sim, choice.actions, simulation, key, level, state, dist, x
        x = lax.cond(guide.levels > 0, lambda: rolled(*of), lambda: x)
    if choice.feed:
        x = take_fed(sim, fed, level == feed_level(sim), x)
    return x0, x


def take(problem, level, before, action, rolling=False):
    """One lane: the `Progress` that the action leads to; ``rolling``: it is not the start that is
    chosen.
    """
    sim, reward = problem.sim, problem.reward
    x0, x = action
    start = levels(sim) - sim.horizon
    after = advance(sim, reward, before, x, level + 1 - start >= sim.horizon)
    if start and not rolling:
        after = select(level == 0, begin(sim, reward, x0), after)
    return after


def of_lanes(problem, axes, lane):
    """``problem`` with those of its leaves that differ between trees taken of these trees, [...];
    ``axes`` as in `make`.
    """
    if axes is None:
        return problem

    def of_lane(axis, leaf):
        return leaf if axis is None else leaf[lane]

    return jax.tree.map(of_lane, axes, problem, is_leaf=lambda x: x is None)


def node_keys(keys, node):
    """[B] the keys from which the actions of these nodes' children are drawn."""
    return jax.vmap(jax.random.fold_in)(keys, node.astype(jnp.uint32) | _NODE)
