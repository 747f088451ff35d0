"""Running a tree search: groups of trees as units of work (`jast.units`), in chunks that can be
watched and interrupted; or all in one traced program.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import units
from jast._jax import custom_vmap, jit
from jast.counter import COUNTER, tree_keys
from jast.episode import Episode, play_back
from jast.memory import size
from jast.places import Task, UnitContext
from jast.search.tree import simulate
from jast.search.tree.edges import branches_of, edges_of
from jast.search.tree.layout import FAILURE, FRESH, INVALID, RAN, make
from jast.search.tree.prune import prune, recounted
from jast.search.tree.rebuild import rebuild
from jast.watch import Watch

__all__ = ["Harvest", "Plan", "Round", "bytes_per_tree", "grow_all", "grow_traced"]


class Plan(NamedTuple):
    """The static part of a search."""

    prunes: int
    simulations: int
    """Per root."""
    children: int
    """Greatest number of children of a node."""
    memoize: str
    pages: int | None = None
    """Of a tree (`jast.search.tree.layout.pages_of`)."""
    edges: bool = False
    """Whether all edges are kept for training."""
    record: bool = False
    """Whether the numbers of all episodes are kept."""
    branches: bool = False
    """Whether the trees are kept."""
    recount: bool = False
    """Whether the statistics of roots are those at the end of the tree, not of their turn."""


class Harvest(NamedTuple):
    """What is kept of a group of trees: B trees of S simulations."""

    log: Any
    """[S, B] reward of each simulation's episode."""
    outcome: Any
    """[S, B] bits FAILURE, FRESH, INVALID, RAN of `jast.search.tree.layout`."""
    steps: Any
    """[B] simulator steps."""
    roots: Any
    """`Roots` with a leading axis [prunes], zeros from where all trees of the group are at their
    end.
    """
    found: Episode
    """[n] the best failing episodes, or the best ones of trees without failure."""
    tree: Any
    """[n] where they were found."""
    simulation: Any
    edges: Any = ()
    """`Edges`, where the plan asks for them."""
    trials: Any = ()
    """[S, 2, B] distance and log p of each simulation's episode, where the plan asks for them."""
    branches: Any = ()
    """`Branches`, where the plan asks for them."""


@functools.partial(jit, static_argnames=("simulations", "memoize", "pages", "record"))
def _make(problem, keys, simulations, memoize, pages=None, record=False):
    return make(problem, _shared(problem), keys, simulations, memoize, pages, record)


@functools.partial(jit, static_argnames=("memoize",), donate_argnames=("tree",))
def _grow(problem, tree, begin_at, end_at, memoize):
    return simulate.grow(problem, _shared(problem), tree, begin_at, end_at, memoize)


@functools.partial(jit, static_argnames=("children", "memoize"), donate_argnames=("tree",))
def _prune(problem, tree, children, memoize):
    return prune(problem, _shared(problem), tree, children, memoize)


@functools.partial(jit, static_argnames=("children", "memoize"))
def _recounted(problem, tree, roots, children, memoize):
    return recounted(problem, tree, roots, children, memoize)


@functools.partial(jit, static_argnames=("children",))
def _edges(problem, tree, children):
    return edges_of(problem, _shared(problem), tree, children)


@functools.partial(jit, static_argnames=("children",))
def _branches(problem, tree, children):
    return branches_of(problem, _shared(problem), tree, children)


@functools.partial(jit, static_argnames=("memoize",))
def _rebuild(problem, tree, lane, i, memoize):
    return rebuild(problem, _shared(problem), tree, lane, i, memoize)


def _shared(problem):
    """`axes` of a problem that all trees share."""
    return jax.tree.map(lambda _: None, problem)


def bytes_per_tree(problem, plan):
    """Bytes that one tree takes while it grows, from the shapes of its arrays."""
    simulations = plan.prunes * plan.simulations
    build = lambda p, keys: make(
        p, _shared(p), keys, simulations, plan.memoize, plan.pages, plan.record
    )
    tree = jax.eval_shape(build, problem, tree_keys(jax.random.key(0), 2))
    return size(tree) // 2


class Round(NamedTuple):
    """What the groups of a round of trees have in common."""

    problem: Any
    words: Any
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


def grow_all(turn: Round, watch: Watch, ways: units.Placement, threads: int) -> units.UnitsRun:
    """Grow one tree a key, a group of lanes at a time: `jast.units.UnitsRun` with a tuple of
    `Harvest` in the order of the keys. ``watch`` counts simulations; an interruption ends all trees
    at their next chunk.
    """
    trees, lanes = len(turn.words), turn.lanes
    each = turn.plan.prunes * turn.plan.simulations
    return units.run(
        Task(_one_group, turn, lambda: _like(turn)),
        -(-trees // lanes),
        lambda harvests, number, new: (*harvests, new),
        (),
        watch,
        ways._replace(name=f"trees-{turn.first}"),
        size=lambda done: (turn.first + min(done * lanes, trees)) * each,
        threads=threads,
        cut=True,
    )


def _like(turn: Round) -> Harvest:
    """The shapes of what `_one_group` returns."""
    problem, _, plan = turn[:3]
    keys = _keys(turn, np.zeros(turn.lanes, int))
    simulations = plan.prunes * plan.simulations
    tree = _make.eval_shape(problem, keys, simulations, plan.memoize, plan.pages, plan.record)
    _, roots = _prune.eval_shape(problem, tree, plan.children, plan.memoize)
    rows = np.zeros(turn.candidates + turn.lanes, np.int32)
    found = _rebuild.eval_shape(problem, tree, rows, rows, plan.memoize)
    return Harvest(
        log=0,
        outcome=0,
        steps=0,
        roots=roots,
        found=found,
        tree=0,
        simulation=0,
        edges=_edges.eval_shape(problem, tree, plan.children) if plan.edges else (),
        trials=0 if plan.record else (),
        branches=_branches.eval_shape(problem, tree, plan.children) if plan.branches else (),
    )


def _keys(turn: Round, rows: np.ndarray) -> jax.Array:
    return jax.random.wrap_key_data(turn.words[rows], impl=COUNTER)


def _one_group(turn: Round, number: int, post: UnitContext) -> Harvest:
    problem, words, plan, lanes, chunk, candidates, before = turn
    group = np.arange(number * lanes, min((number + 1) * lanes, len(words)))
    keys, group = _keys(turn, np.resize(group, lanes)), group + before
    tree = _make(
        problem, keys, plan.prunes * plan.simulations, plan.memoize, plan.pages, plan.record
    )
    turns = []
    for turn in range(plan.prunes):
        first, end = turn * plan.simulations, (turn + 1) * plan.simulations
        for at in range(first, end, chunk):
            tree = jax.block_until_ready(
                _grow(problem, tree, at, min(at + chunk, end), plan.memoize)
            )
            post.more((min(at + chunk, end) - at) * len(group))
            if post.stopped():
                break
        tree, roots = _prune(problem, tree, plan.children, plan.memoize)
        turns.append(jax.device_get(roots))
        if post.stopped() or not np.asarray(tree.alive).any():
            break
    log, outcome, steps = (
        np.asarray(a)[..., : len(group)] for a in (tree.log, tree.outcome, tree.steps)
    )
    lane, i = _candidates(log, outcome, candidates)
    wanted = candidates + len(group)
    found = _rebuild(
        problem,
        tree,
        np.resize(lane, wanted).astype(np.int32),
        np.resize(i, wanted).astype(np.int32),
        plan.memoize,
    )
    found = jax.tree.map(lambda a: a[: len(lane)], jax.device_get(found))
    roots = jax.tree.map(
        lambda *rows: np.stack([*rows, *[np.zeros_like(rows[0])] * (plan.prunes - len(rows))]),
        *turns,
    )
    if plan.recount:
        roots = jax.device_get(_recounted(problem, tree, roots, plan.children, plan.memoize))
    roots = jax.tree.map(lambda a: a[:, : len(group)], roots)
    kept = lambda of: jax.tree.map(
        lambda a: a[:, : len(group)], jax.device_get(of(problem, tree, plan.children))
    )
    edges = kept(_edges) if plan.edges else ()
    branches = kept(_branches) if plan.branches else ()
    trials = np.asarray(tree.trials)[..., : len(group)] if plan.record else ()
    return Harvest(
        log,
        outcome,
        steps,
        roots,
        found,
        group[lane].astype(np.int32),
        i.astype(np.int32),
        edges,
        trials,
        branches,
    )


def _candidates(log, outcome, most):
    """Trees and simulations of the best episode of each tree and of the ``most`` best failures."""
    fresh = (outcome & FRESH) > 0
    failure = fresh & ((outcome & FAILURE) > 0)
    value = np.where(fresh, log, -np.inf)
    own = np.where(failure.any(0), np.where(failure, value, -np.inf).argmax(0), value.argmax(0))
    lanes = np.arange(log.shape[1])
    i, lane = np.nonzero(failure)
    order = np.argsort(-log[i, lane], kind="stable")[:most]
    return np.concatenate([lanes, lane[order]]), np.concatenate([own, i[order]])


class Traced(NamedTuple):
    """What a traced search knows of each tree, [B]."""

    best: Episode
    failures: Any
    episodes: Any
    steps: Any
    invalid: Any
    first: Any
    """The first failing simulation, or S."""


def grow_traced(problem, keys, plan):
    """The whole search as one traced program, for `jax.jit` and `jax.vmap`: `Traced`. Under
    `jax.vmap` the batch becomes more trees, not more programs.
    """
    leaves, treedef = jax.tree.flatten(problem)
    return _batchable(treedef, plan, (None,) * len(leaves))(keys, leaves)


def _batchable(treedef: Any, plan: Plan, axes: tuple) -> Callable[..., Traced]:
    """The traced search of a problem's leaves, with a rule of its own for `jax.vmap`; ``axes`` of
    `jast.search.tree.layout.make`, a leaf each.
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
            if not is_batched:
                return (
                    (leaf, None)
                    if axis is None
                    else (jnp.tile(leaf, (size,) + (1,) * (leaf.ndim - 1)), 0)
                )
            leaf = (
                leaf
                if axis == 0
                else jnp.broadcast_to(leaf[:, None], (size, lanes, *leaf.shape[1:]))
            )
            return leaf.reshape(size * lanes, *leaf.shape[2:]), 0

        pairs = [spread(*each) for each in zip(leaves, leaf_batched, axes, strict=True)]
        out = _batchable(treedef, plan, tuple(axis for _, axis in pairs))(
            keys.reshape(-1), [leaf for leaf, _ in pairs]
        )
        out = jax.tree.map(lambda a: a.reshape(size, lanes, *a.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return function


def _traced(problem, axes, keys, plan):
    tree = make(problem, axes, keys, plan.prunes * plan.simulations, plan.memoize, plan.pages)

    def turn(n, tree):
        tree = simulate.grow(
            problem, axes, tree, n * plan.simulations, (n + 1) * plan.simulations, plan.memoize
        )
        return prune(problem, axes, tree, plan.children, plan.memoize)[0]

    tree = lax.fori_loop(0, plan.prunes, turn, tree)
    has = lambda bit: (tree.outcome & bit) > 0
    failing = has(FRESH) & has(FAILURE)
    value = jnp.where(
        has(FRESH) & jnp.where(jnp.any(failing, axis=0), failing, True), tree.log, -jnp.inf
    )
    best = jnp.argmax(value, axis=0).astype(jnp.int32)
    lane = jnp.arange(keys.shape[0], dtype=jnp.int32)
    found = rebuild(problem, axes, tree, lane, best, plan.memoize)
    count = lambda bit: jnp.sum(has(bit), axis=0, dtype=jnp.int32)
    first = jnp.where(
        jnp.any(has(FAILURE), axis=0), jnp.argmax(has(FAILURE), axis=0), tree.log.shape[0]
    ).astype(jnp.int32)
    exact = jax.vmap(
        lambda p, e: play_back(p.sim, p.reward, e.x0, e.disturbances, e.length), in_axes=(axes, 0)
    )(problem, found)
    return Traced(exact, count(FAILURE), count(RAN), tree.steps, count(INVALID), first)
