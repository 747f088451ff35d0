"""The weighted draws that an estimate keeps, in bounded memory, for answers beyond its one number:
`estimate.exceedance_and_times` and `jast.estimate.events`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.util import display
from jast._src.util.intervals import clopper_pearson, log_normal, normal_quantile

__all__ = [
    "Draws",
    "Moments",
    "add_draws",
    "empty_draws",
    "mean_interval",
    "moments_of_sums",
    "moments_of_weights",
    "scaled_weights",
    "share_interval",
    "source_key",
    "with_source",
]

MAX_KEPT = 2**17
"""Failing draws that are kept at most, and so many that did not fail: a few megabytes."""


@display.printable()
class Draws(NamedTuple):
    """The failing episodes among the draws of an estimate, and the others that came nearest to a
    failure: [m] each, NumPy. Of more failures than fit, one in ``every`` is kept, and counts
    ``every`` times; of the other episodes, those with a miss distance of at most ``reach``.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> counted.draws.counted, int(counted.draws.failure.sum()) == counted.failing
        (True, True)
    """

    log_weight: np.ndarray
    """[m] log p - log q, of failures plus log ``every``"""
    distance: np.ndarray
    """[m] miss distance of the episode"""
    failure: np.ndarray
    """[m] bool"""
    length: np.ndarray
    """[m] int32: steps to its end"""
    row: np.ndarray
    """[m] int64: its number among the draws, which says where it comes from"""
    samples: int
    """Draws in all"""
    every: int = 1
    reach: float = math.inf
    key: np.ndarray | None = None
    """Words of the key, from which each chunk was drawn by its number"""
    impl: str | None = None
    """Of the key"""
    lanes: int = 0
    """Draws of a chunk"""
    source: Any = None
    """What they were drawn from: a mixture of Gaussians, "model" for plain draws of normal numbers,
    "keys" for plain draws by keys, "policy" for a policy that is not kept
    """

    @property
    def severity(self) -> np.ndarray:
        """[m] What ranks episodes: the miss distance, above 0 unless they failed, and at most 0
        where they did.
        """
        safe = np.maximum(self.distance, np.finfo(self.distance.dtype).tiny)
        return np.where(self.failure, np.minimum(self.distance, 0), safe).astype(np.float64)

    @property
    def counted(self) -> bool:
        """Whether all weights are 1, as those of plain draws are."""
        return self.every == 1 and not self.log_weight.any()


def empty_draws() -> Draws:
    """The `Draws` before the first."""
    none = np.zeros(0)
    return Draws(
        log_weight=none,
        distance=none,
        failure=none.astype(bool),
        length=none.astype(np.int32),
        row=none.astype(np.int64),
        samples=0,
    )


def add_draws(kept: Draws | None, traces: Any) -> Draws | None:
    """`Draws` with the `jast.estimate.Traces` [n] (NumPy) as well; None where these have no
    distances.
    """
    if kept is None or traces.distance is None:
        return None
    n, log_w = len(traces.failure), np.asarray(traces.log_weight)
    row = kept.samples + np.arange(n)
    failure, distance = np.asarray(traces.failure), np.asarray(traces.distance)
    # a weight of 0 counts for nothing, one that is not finite is counted by the sums
    good = np.isfinite(log_w) & ~np.asarray(traces.invalid) & ~np.isnan(distance)
    good &= np.where(failure, row % kept.every == 0, distance <= kept.reach)
    log_w = log_w + np.where(failure, np.asarray(math.log(kept.every), log_w.dtype), 0)
    added = dict(
        log_weight=log_w,
        distance=distance,
        failure=failure,
        length=np.asarray(traces.length, np.int32),
        row=row,
    )
    # draws before the first have no dtype of their own
    both = {
        name: np.concatenate([getattr(kept, name).astype(a.dtype), a[good]])
        for name, a in added.items()
    }
    return _limit_kept(kept._replace(**both, samples=kept.samples + n))


def with_source(kept: Draws | None, key: jax.Array, lanes: int, source: Any) -> Draws | None:
    """``kept`` with where it comes from."""
    if kept is None:
        return None
    typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    impl = str(jax.random.key_impl(key)) if typed else None
    words = np.asarray(jax.random.key_data(key) if typed else key)
    return kept._replace(key=words, impl=impl, lanes=lanes, source=source)


def source_key(kept: Draws) -> jax.Array:
    """The key of `with_source`."""
    return jax.random.wrap_key_data(kept.key, impl=kept.impl)


def _limit_kept(kept):
    while kept.failure.sum() > MAX_KEPT:
        every = 2 * kept.every
        more = np.where(kept.failure, np.asarray(math.log(2), kept.log_weight.dtype), 0)
        kept = kept._replace(every=every, log_weight=kept.log_weight + more)
        kept = _take_rows(kept, ~kept.failure | (kept.row % every == 0))
    if (~kept.failure).sum() > 2 * MAX_KEPT:  # seldom, as it sorts
        reach = np.partition(kept.distance[~kept.failure], MAX_KEPT - 1)[MAX_KEPT - 1]
        kept = _take_rows(kept, kept.failure | (kept.distance <= reach))
        kept = kept._replace(reach=float(reach))
    return kept


def _take_rows(kept, rows):
    return kept._replace(**{name: getattr(kept, name)[rows] for name in Draws._fields[:5]})


class Moments(NamedTuple):
    """Of weights w of which the others of ``samples`` are 0: numbers, or arrays of them."""

    log_mean: np.ndarray
    relative: np.ndarray
    """Standard error over the mean"""
    ess: np.ndarray
    skewness: np.ndarray
    """Of the mean"""


def moments_of_sums(log_sums: Sequence[np.ndarray | float], samples: int) -> Moments:
    """`Moments` by the logs of sum w, sum w^2 and sum w^3."""
    first, second, third = log_sums
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = samples * np.exp(second - 2 * first), samples**2 * np.exp(third - 3 * first)
        spread = a - 1 > 1e-9
        variance = np.where(spread, a - 1, 0)
        return Moments(
            log_mean=first - math.log(samples),
            relative=np.sqrt(variance / max(samples - 1, 1)),
            ess=np.exp(2 * first - second),
            skewness=np.where(spread, (b - 3 * a + 2) / variance**1.5 / math.sqrt(samples), 0.0),
        )


def moments_of_weights(log_w: np.ndarray, samples: int) -> Moments:
    """`Moments` of log weights [m], of which there is one."""
    log_w = np.asarray(log_w, np.float64)
    return moments_of_sums([np.logaddexp.reduce(i * log_w) for i in (1, 2, 3)], samples)


def mean_interval(draws: Draws, m: Moments, count: int, level: float) -> tuple[float, float]:
    """(low, high) of the mean weight of some of the ``draws``, of these `Moments` and this
    ``count``: exact where all weights are 1.
    """
    if draws.counted:
        return clopper_pearson(count, draws.samples, level)
    return log_normal(float(m.log_mean), float(m.relative), level, float(m.skewness))


class WeightSums(NamedTuple):
    """Sums over the failing draws, from which the share of some of them is told."""

    first: float
    """Sum of w, over that of the greatest"""
    second: float
    """Sum of w^2"""
    count: int
    counted: bool
    """Whether all weights are 1"""


def scaled_weights(log_w: np.ndarray, counted: bool) -> tuple[np.ndarray, WeightSums]:
    """(w [m] over their greatest, `WeightSums` of them)."""
    w = np.exp(np.asarray(log_w, np.float64) - np.max(log_w))
    return w, WeightSums(w.sum(), (w**2).sum(), len(w), counted)


def share_interval(
    total: WeightSums, first: float, second: float, count: int, level: float
) -> tuple[float, tuple[float, float]]:
    """The share of ``total`` that ``count`` draws carry, whose weights have these sums, and its
    (low, high): of plain counts exact, else of the logit of the ratio of two means, by the delta
    method.

    Where all or none are meant, the effective number of the weights stands in for a count.
    """
    r = float(first / total.first)
    if total.counted or count in (0, total.count):
        n = total.count if total.counted else max(int(total.first**2 / total.second), 1)
        return r, clopper_pearson(count if total.counted else n * (count > 0), n, level)
    # sum of w^2 (1{chosen} - r)^2
    error = math.sqrt(second * (1 - r) ** 2 + (total.second - second) * r**2) / total.first
    logit, half = math.log(r / (1 - r)), normal_quantile(level) * error / r / (1 - r)
    low, high = (float(1 / (1 + np.exp(-(logit + side)))) for side in (-half, half))
    return r, (low, high)
