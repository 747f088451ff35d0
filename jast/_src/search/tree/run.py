"""Running a tree search: groups of trees as units of work (`runtime.work`), in chunks that can be
watched and interrupted; or all in one traced program.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.counter_prng import COUNTER, tree_keys
from jast._src.core.episode import Episode, play_back
from jast._src.runtime import work
from jast._src.runtime._jax import custom_vmap, is_brief, jit, quick
from jast._src.runtime.backends import Task, UnitContext
from jast._src.runtime.memory import size
from jast._src.runtime.progress_bar import Watch
from jast._src.search.tree import simulate
from jast._src.search.tree.edges import Branches, Edges, branches_of, edges_of
from jast._src.search.tree.layout import Problem, flags, make
from jast._src.search.tree.prune import Roots, prune, recounted
from jast._src.search.tree.rebuild import rebuild
from jast._src.util.pytrees import index_tree

__all__ = ["Plan", "Round", "Traced", "TreeBatch", "bytes_per_tree", "grow_all", "grow_traced"]


class Plan(NamedTuple):
    """The static part of a search."""

    prunes: int
    simulations: int
    """Per root."""
    children: int
    """Greatest number of children of a node."""
    memoize: str
    pages: int | None = None
    """Of a tree (`search.tree.layout.pages_of`)."""
    edges: bool = False
    """Whether all edges are kept for training."""
    record: bool = False
    """Whether the numbers of all episodes are kept."""
    branches: bool = False
    """Whether the trees are kept."""
    recount: bool = False
    """Whether the statistics of roots are those at the end of the tree, not of their turn."""

    @property
    def room(self) -> tuple[int, str, int | None, bool]:
        """What `search.tree.layout.make` is told of it, the simulations of a tree first."""
        return self.prunes * self.simulations, self.memoize, self.pages, self.record


class TreeBatch(NamedTuple):
    """What is kept of a group of trees: B trees of S simulations."""

    log: np.ndarray
    """[S, B] reward of each simulation's episode."""
    outcome: np.ndarray
    """[S, B] `search.tree.layout.outcome_of` each simulation."""
    steps: np.ndarray
    """[B] simulator steps."""
    roots: Roots
    """`Roots` with a leading axis [prunes], zeros from where all trees of the group are at their
    end.
    """
    found: Episode
    """[n] the best failing episodes, or the best ones of trees without failure."""
    tree: np.ndarray
    """[n] where they were found."""
    simulation: np.ndarray
    edges: Edges | tuple[()] = ()
    """`Edges`, where the plan asks for them."""
    trials: np.ndarray | tuple[()] = ()
    """[S, 2, B] distance and log p of each simulation's episode, where the plan asks for them."""
    branches: Branches | tuple[()] = ()
    """`Branches`, where the plan asks for them."""


_make = jit(make, static_argnames=("simulations", "memoize", "pages", "record"))
_grow = jit(simulate.grow, static_argnames=("memoize",), donate_argnames=("tree",))
_prune = jit(prune, static_argnames=("children", "memoize"), donate_argnames=("tree",))
_recounted = jit(recounted, static_argnames=("children", "memoize"))
_edges = jit(edges_of, static_argnames=("children",))
_branches = jit(branches_of, static_argnames=("children",))
# briefly: of the ferry it is compiled in 1.0 CPU seconds in place of 2.3, and the 516 episodes of
# four trees then take .02 in place of .006
_rebuild = jit(rebuild, static_argnames=("memoize",))
_rebuild_quickly = quick(rebuild, static_argnames=("memoize",))


def bytes_per_tree(problem, plan):
    """Bytes that one tree takes while it grows, from the shapes of its arrays."""
    keys = tree_keys(jax.random.key(0), 2)
    return size(_make.eval_shape(problem, keys, *plan.room)) // 2


class Round(NamedTuple):
    """What the groups of a round of trees have in common."""

    problem: Problem
    words: np.ndarray
    """[trees, 2] uint32: those of the counter keys of the round; on the host."""
    plan: Plan
    lanes: int
    """Trees of a group."""
    chunk: int
    """Simulations between two looks at whether to stop."""
    candidates: int
    """Failures of a group that are handed on."""
    first: int
    """Number of the first tree."""


def grow_all(turn: Round, watch: Watch, placement: work.Placement, threads: int) -> work.UnitsRun:
    """Grow one tree a key, a group of lanes at a time: `runtime.work.UnitsRun` with a tuple of
    `TreeBatch` in the order of the keys. ``watch`` counts simulations; an interruption ends all
    trees at their next chunk.
    """
    trees, lanes = len(turn.words), turn.lanes
    each = turn.plan.prunes * turn.plan.simulations
    return work.run(
        Task(_one_group, turn, lambda: _like(turn)),
        -(-trees // lanes),
        lambda batches, number, new: (*batches, new),
        (),
        watch,
        placement._replace(name=f"trees-{turn.first}"),
        size=lambda done: (turn.first + min(done * lanes, trees)) * each,
        threads=threads,
        cut=True,
    )


def _like(turn: Round) -> TreeBatch:
    """The shapes of what `_one_group` returns."""
    problem, _, plan = turn[:3]
    keys = _keys(turn, np.zeros(turn.lanes, int))
    tree = _make.eval_shape(problem, keys, *plan.room)
    _, roots = _prune.eval_shape(problem, tree, plan.children, plan.memoize)
    rows = np.zeros(turn.candidates + turn.lanes, np.int32)
    found = _rebuild.eval_shape(problem, tree, rows, rows, plan.memoize)
    edges = _edges.eval_shape(problem, tree, plan.children) if plan.edges else ()
    branches = _branches.eval_shape(problem, tree, plan.children) if plan.branches else ()
    trials = 0 if plan.record else ()
    return TreeBatch(0, 0, 0, roots, found, 0, 0, edges, trials, branches)


def _keys(turn: Round, rows: np.ndarray) -> jax.Array:
    return jax.random.wrap_key_data(turn.words[rows], impl=COUNTER)


def _one_group(turn: Round, number: int, context: UnitContext) -> TreeBatch:
    problem, words, plan, lanes, chunk, candidates, before = turn
    group = np.arange(number * lanes, min((number + 1) * lanes, len(words)))
    keys, group = _keys(turn, np.resize(group, lanes)), group + before
    tree, turns = _make(problem, keys, *plan.room), []
    for root in range(plan.prunes):
        last = (root + 1) * plan.simulations
        for at in range(root * plan.simulations, last, chunk):
            end = min(at + chunk, last)
            tree = jax.block_until_ready(_grow(problem, tree, at, end, plan.memoize))
            context.more((end - at) * len(group))
            if context.stopped():
                break
        tree, roots = _prune(problem, tree, plan.children, plan.memoize)
        turns.append(jax.device_get(roots))
        if context.stopped() or not np.asarray(tree.alive).any():
            break
    log, outcome, steps, trials = jax.tree.map(
        lambda a: np.asarray(a)[..., : len(group)],
        (tree.log, tree.outcome, tree.steps, tree.trials),
    )
    lane, i = _candidates(log, outcome, candidates)
    wanted = candidates + len(group)
    rows = (np.resize(a, wanted).astype(np.int32) for a in (lane, i))
    rebuilt = _rebuild_quickly if is_brief() else _rebuild
    found = rebuilt(problem, tree, *rows, plan.memoize)
    found = index_tree(jax.device_get(found), np.s_[: len(lane)])
    none = jax.tree.map(np.zeros_like, turns[0])
    turns += [none] * (plan.prunes - len(turns))
    roots = jax.tree.map(lambda *rows: np.stack(rows), *turns)
    if plan.recount:
        roots = jax.device_get(_recounted(problem, tree, roots, plan.children, plan.memoize))
    edges = _edges(problem, tree, plan.children) if plan.edges else ()
    branches = _branches(problem, tree, plan.children) if plan.branches else ()
    roots, edges, branches = index_tree(
        jax.device_get((roots, edges, branches)), np.s_[:, : len(group)]
    )
    return TreeBatch(
        log=log,
        outcome=outcome,
        steps=steps,
        roots=roots,
        found=found,
        tree=group[lane].astype(np.int32),
        simulation=i.astype(np.int32),
        edges=edges,
        trials=trials,
        branches=branches,
    )


def _candidates(log, outcome, most):
    """Trees and simulations of the best episode of each tree and of the ``most`` best failures."""
    failed, fresh, *_ = flags(outcome)
    failure = fresh & failed
    value = np.where(fresh, log, -np.inf)
    own = np.where(failure.any(0), np.where(failure, value, -np.inf).argmax(0), value.argmax(0))
    lanes = np.arange(log.shape[1])
    i, lane = np.nonzero(failure)
    order = np.argsort(-log[i, lane], kind="stable")[:most]
    return np.concatenate([lanes, lane[order]]), np.concatenate([own, i[order]])


class Traced(NamedTuple):
    """What a traced search knows of each tree, [B]."""

    best: Episode
    failures: jax.Array
    episodes: jax.Array
    steps: jax.Array
    invalid: jax.Array
    first: jax.Array
    """The first failing simulation, or S."""


def grow_traced(problem, keys, plan):
    """The whole search as one traced program, for `jax.jit` and `jax.vmap`: `Traced`. Under
    `jax.vmap` the batch becomes more trees, not more programs.
    """
    leaves, treedef = jax.tree.flatten(problem)
    return _batchable(treedef, plan, (None,) * len(leaves))(keys, leaves)


def _batchable(treedef: Any, plan: Plan, axes: tuple) -> Callable[..., Traced]:
    """The traced search of a problem's leaves, with a rule of its own for `jax.vmap`; ``axes`` of
    `search.tree.layout.make`, a leaf each.
    """
    # Why custom_vmap: a plain vmap would make a select of the conditional that keeps XLA from
    # copying all trees at each write (`simulate`). As trees stand side by side already, a batch of
    # searches is one search of more trees.

    def whole(keys, leaves):
        return _traced(treedef.unflatten(leaves), treedef.unflatten(axes), keys, plan)

    function = custom_vmap(whole)

    @function.def_vmap
    def rule(size, batched, keys, leaves):
        keys_batched, leaf_batched = batched
        keys = keys if keys_batched else jnp.broadcast_to(keys[None], (size, *keys.shape))
        lanes = keys.shape[1]

        def spread(leaf, is_batched, axis):
            if not is_batched and axis is None:
                return leaf, None
            if not is_batched:
                return jnp.tile(leaf, (size,) + (1,) * (leaf.ndim - 1)), 0
            if axis is None:
                leaf = jnp.broadcast_to(leaf[:, None], (size, lanes, *leaf.shape[1:]))
            return leaf.reshape(size * lanes, *leaf.shape[2:]), 0

        pairs = [spread(*each) for each in zip(leaves, leaf_batched, axes, strict=True)]
        out = _batchable(treedef, plan, tuple(axis for _, axis in pairs))(
            keys.reshape(-1), [leaf for leaf, _ in pairs]
        )
        out = jax.tree.map(lambda a: a.reshape(size, lanes, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return function


def _traced(problem, axes, keys, plan):
    tree = make(problem, keys, *plan.room, axes=axes)

    def turn(n, tree):
        ends = n * plan.simulations, (n + 1) * plan.simulations
        tree = simulate.grow(problem, tree, *ends, plan.memoize, axes)
        return prune(problem, tree, plan.children, plan.memoize, axes)[0]

    tree = lax.fori_loop(0, plan.prunes, turn, tree)
    failed, fresh, invalid, ran = flags(tree.outcome)
    failing = fresh & failed
    counts = fresh & (failing | ~jnp.any(failing, axis=0)[None])
    value = jnp.where(counts, tree.log, -jnp.inf)
    best = jnp.argmax(value, axis=0).astype(jnp.int32)
    lane = jnp.arange(keys.shape[0], dtype=jnp.int32)
    found = rebuild(problem, tree, lane, best, plan.memoize, axes)
    first = jnp.where(jnp.any(failed, axis=0), jnp.argmax(failed, axis=0), len(tree.log))
    count = partial(jnp.sum, axis=0, dtype=jnp.int32)

    def played(problem, e):
        return play_back(problem.sim, problem.reward, e.x0, e.disturbances, e.length)

    return Traced(
        best=jax.vmap(played, in_axes=(axes, 0))(problem, found),
        failures=count(failed),
        episodes=count(ran),
        steps=tree.steps,
        invalid=count(invalid),
        first=first.astype(jnp.int32),
    )
