"""What a forest grew, as a `SearchResult`: counts, the archive of failures, the history."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast.episode import Episode, replay
from jast.failures import collect, identity
from jast.search.result import History, SearchResult, Trials
from jast.search.tree.edges import Branches
from jast.search.tree.layout import FAILURE, FRESH, INVALID, RAN
from jast.search.tree.run import Harvest, Traced

__all__ = ["result", "traced_result"]


def result(
    sim: Any, reward: Any, harvests: list[Harvest], settings: dict, top: int, school: Any
) -> SearchResult:
    """The `SearchResult` of ``harvests``; ``school``: what the heads learned, or None."""
    log, outcome = (
        np.concatenate([getattr(h, field) for h in harvests], axis=1)
        for field in ("log", "outcome")
    )
    has = lambda bit: (outcome & bit) > 0
    ran, failed = has(RAN), has(FAILURE)
    order = failed.reshape(-1)
    episodes = int(ran.sum())
    first = int(ran.reshape(-1)[: order.argmax() + 1].sum()) if order.any() else None
    fresh_failure = failed & has(FRESH)
    value = np.where(ran, log, -np.inf)
    per_tree = np.where(
        fresh_failure.any(0), np.where(fresh_failure, value, -np.inf).max(0), value.max(0)
    )
    found = jax.tree.map(lambda *parts: np.concatenate(parts), *(h.found for h in harvests))
    tree, simulation = (
        np.concatenate([getattr(h, f) for h in harvests]) for f in ("tree", "simulation")
    )
    chosen = _distinct(found, tree, simulation, top)
    archive = collect(
        sim,
        reward,
        _take(found, chosen),
        tree[chosen],
        simulation[chosen],
        seen=int(failed.sum()),
        top=top,
    )
    best = archive.best
    if best is None:
        best = _take(found, np.argmax(np.where(found.failure, -np.inf, found.reward)))
    roots = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *(h.roots for h in harvests))
    return SearchResult(
        best=jax.device_get(replay(sim, best, reward=reward)),
        best_reward_per_tree=per_tree,
        failures=archive,
        episodes=episodes,
        steps=int(sum(h.steps.astype(np.int64).sum() for h in harvests)),
        first_failure=first,
        failing_share=float(failed.sum() / max(episodes, 1)),
        failing=int(failed.sum()),
        failing_per_tree=fresh_failure.any(0),
        history=_history(value, fresh_failure, failed),
        invalid=int(has(INVALID).sum()),
        trials=_trials(harvests, value, failed, has(FRESH)),
        trees=_branches(harvests),
        settings=settings,
        roots=roots,
        heads=None if school is None else school.heads,
        lessons=() if school is None else school.lessons,
        misses=_misses(harvests, top),
    )


def _misses(harvests: list[Harvest], top: int) -> Episode:
    """The ``top`` best episodes of trees that found no failure, one a tree, by falling reward."""
    own = [jax.tree.map(lambda a, h=h: a[: h.log.shape[1]], h.found) for h in harvests]
    best = jax.tree.map(lambda *parts: np.concatenate(parts), *own)
    rows = np.flatnonzero(~best.failure & np.isfinite(best.reward))
    return _take(best, rows[np.argsort(-best.reward[rows], kind="stable")][:top])


def _trials(harvests: list[Harvest], value, failed, fresh) -> Trials | None:
    if isinstance(harvests[0].trials, tuple):
        return None
    distance, log_prob = np.moveaxis(np.concatenate([h.trials for h in harvests], axis=2), 1, 0)
    return Trials(
        value,
        np.where(fresh & np.isfinite(value), distance, np.inf),
        log_prob,
        failed & fresh,
        fresh,
        failed & ~fresh,
    )


def _branches(harvests: list[Harvest]) -> Branches | None:
    if not isinstance(harvests[0].branches, Branches):
        return None
    beside = lambda *parts: np.concatenate(parts, axis=1)
    return jax.tree.map(beside, *(h.branches for h in harvests))


def _distinct(found: Episode, tree, simulation, top: int) -> np.ndarray:
    """Candidates worth a replay: failures by falling reward, up to a few more distinct ones than
    the archive holds.
    """
    names, chosen, seen = set(), [], set()
    for i in np.argsort(-found.reward, kind="stable"):
        if not found.failure[i] or (tree[i], simulation[i]) in seen:
            continue
        seen.add((tree[i], simulation[i]))
        names.add(identity(_take(found, i)))
        if len(names) > top + 8:
            break
        chosen.append(i)
    return np.array(chosen, np.int64)


def _history(value, failure, failed) -> History:
    moments = np.unique(np.linspace(1, value.shape[0], min(value.shape[0], 200)).astype(int))
    best = np.maximum.accumulate(value, axis=0)[moments - 1]
    best_failure = np.maximum.accumulate(np.where(failure, value, -np.inf), axis=0)[moments - 1]
    best = np.where(np.maximum.accumulate(failure, axis=0)[moments - 1], best_failure, best)
    return History(moments, best, np.cumsum(failed.sum(1))[moments - 1])


def traced_result(found: Traced) -> SearchResult:
    """The `SearchResult` of a traced search, of traced arrays."""
    steps = found.first.shape[0]
    failing = found.best.failure
    score = jnp.where(
        jnp.any(failing), jnp.where(failing, found.best.reward, -jnp.inf), found.best.reward
    )
    episodes = jnp.sum(found.episodes)
    first = jnp.where(
        jnp.any(found.failures > 0),
        jnp.min(found.first) * steps + jnp.argmin(found.first).astype(jnp.int32) + 1,
        -1,
    )
    failures = jnp.sum(found.failures)
    return SearchResult(
        best=jax.tree.map(lambda a: a[jnp.argmax(score)], found.best),
        best_reward_per_tree=found.best.reward,
        failures=None,
        episodes=episodes,
        steps=jnp.sum(found.steps),
        first_failure=first,
        failing_share=failures / jnp.maximum(episodes, 1),
        failing_per_tree=failing,
        history=None,
        invalid=jnp.sum(found.invalid),
        settings=None,
        failing=failures,
    )


def _take(episodes: Episode, i) -> Episode:
    return Episode(*jax.tree.map(lambda a: a[i], tuple(episodes[:-1])))
