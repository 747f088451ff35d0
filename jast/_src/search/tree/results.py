"""What a forest grew, as a `SearchResult`: counts, the archive of failures, the history."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.failures import identity, rank
from jast._src.search.driver import Log, finish, finish_traced
from jast._src.search.lanes import NEVER, Tally
from jast._src.search.result import History, SearchResult, Trials
from jast._src.search.tree.layout import flags
from jast._src.search.tree.run import Traced, TreeBatch
from jast._src.util.pytrees import index_tree, join_rows

__all__ = ["result", "traced_result"]

MOMENTS = 200  # of the history, at most
SPARE = 8
"""Distinct failures that are replayed beyond those that the archive keeps, as a few may no longer
fail."""


def result(search: Any, batches: list[TreeBatch], settings: dict, training: Any) -> SearchResult:
    """The `SearchResult` of ``batches`` of a search (its ``sim``, ``reward`` and ``top``);
    ``training``: what the heads learned, or None.
    """
    log = np.concatenate([batch.log for batch in batches], axis=1)
    outcome = np.concatenate([batch.outcome for batch in batches], axis=1)
    failed, fresh, invalid, ran = flags(outcome)
    value = np.where(ran, log, -np.inf)
    first = failed.reshape(-1).argmax()
    tally = Tally(
        episodes=int(ran.sum()),
        steps=int(sum(batch.steps.astype(np.int64).sum() for batch in batches)),
        failures=int(failed.sum()),
        invalid=int(invalid.sum()),
        first=int(ran.reshape(-1)[: first + 1].sum()) if failed.any() else NEVER,
        failing=(failed & fresh).any(0),
    )
    noted = Log(
        tally=tally,
        history=_history(value, failed & fresh, failed),
        interrupted=None,
        trials=_trials(batches, value, failed, fresh),
    )
    found, tree, simulation = join_rows(*((b.found, b.tree, b.simulation) for b in batches))
    nearest = index_tree(found, np.argmax(np.where(found.failure, -np.inf, found.reward)))
    rows = _distinct(found, tree, simulation, search.top)
    where = dict(numbers=simulation[rows], trees=tree[rows])
    done = finish(search, noted, nearest, index_tree(found, rows), settings=settings, **where)
    return done._replace(
        trees=_beside([b.branches for b in batches]),
        roots=_beside([b.roots for b in batches]),
        heads=None if training is None else training.heads,
        lessons=() if training is None else training.lessons,
        misses=_misses(batches, search.top),
    )


def _beside(parts: list[Any]) -> Any:
    """The arrays [n, trees, ...] of all batches; None where none were kept."""
    if parts[0] == ():
        return None
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=1), *parts)


def _misses(batches: list[TreeBatch], top: int) -> Episode:
    """The ``top`` best episodes of trees that found no failure, one a tree, by falling reward."""
    own = [index_tree(h.found, np.s_[: h.log.shape[1]]) for h in batches]
    best = join_rows(*own)
    rows = np.flatnonzero(~best.failure & np.isfinite(best.reward))
    return index_tree(best, rows[np.argsort(-best.reward[rows], kind="stable")][:top])


def _trials(batches: list[TreeBatch], value, failed, fresh) -> Trials | None:
    if isinstance(batches[0].trials, tuple):
        return None
    distance, log_prob = np.moveaxis(np.concatenate([h.trials for h in batches], axis=2), 1, 0)
    distance = np.where(fresh & np.isfinite(value), distance, np.inf)
    return Trials(value, distance, log_prob, failed & fresh, fresh, failed & ~fresh)


def _distinct(found: Episode, tree, simulation, top: int) -> np.ndarray:
    """Candidates worth a replay: failures, the best first, up to a few more distinct ones than
    the archive holds.
    """
    names, chosen, seen = set(), [], set()
    for i in np.argsort(rank(found), kind="stable"):
        if not found.failure[i] or (tree[i], simulation[i]) in seen:
            continue
        seen.add((tree[i], simulation[i]))
        names.add(identity(index_tree(found, i)))
        if len(names) > top + SPARE:
            break
        chosen.append(i)
    return np.array(chosen, np.int64)


def _history(value, failure, failed) -> History:
    moments = np.unique(np.linspace(1, value.shape[0], min(value.shape[0], MOMENTS)).astype(int))
    best = np.maximum.accumulate(value, axis=0)[moments - 1]
    best_failure = np.maximum.accumulate(np.where(failure, value, -np.inf), axis=0)[moments - 1]
    best = np.where(np.maximum.accumulate(failure, axis=0)[moments - 1], best_failure, best)
    return History(moments, best, np.cumsum(failed.sum(1))[moments - 1])


def traced_result(sim: Any, reward: Any, found: Traced) -> SearchResult:
    """The `SearchResult` of a traced search, of traced arrays."""
    (trees,) = found.first.shape
    failing, rewards = found.best.failure, found.best.reward
    score = jnp.where(failing | ~jnp.any(failing), rewards, -jnp.inf)
    order = jnp.min(found.first) * trees + jnp.argmin(found.first).astype(jnp.int32) + 1
    tally = Tally(
        episodes=jnp.sum(found.episodes),
        steps=jnp.sum(found.steps),
        failures=jnp.sum(found.failures),
        invalid=jnp.sum(found.invalid),
        first=jnp.where(jnp.any(found.failures > 0), order, NEVER),
        failing=failing,
    )
    best = index_tree(found.best, jnp.argmax(score))
    return finish_traced(sim, reward, tally, best, rewards)
