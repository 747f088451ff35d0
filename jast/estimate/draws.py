"""The weighted draws that an estimate keeps, in bounded memory, for answers beyond its one number:
`jast.estimate.answers` and `jast.estimate.events`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jast import results
from jast.intervals import clopper_pearson, log_normal

__all__ = ["Draws"]

KEPT = 2**17
"""Failing draws that are kept at most, and so many that did not fail."""


@results.printable()
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

    log_weight: Any
    """[m] log p - log q, of failures plus log ``every``"""
    distance: Any
    """[m] miss distance of the episode"""
    failure: Any
    """[m] bool"""
    length: Any
    """[m] int32: steps to its end"""
    row: Any
    """[m] int64: its number among the draws, which says where it comes from"""
    samples: int
    """Draws in all"""
    every: int = 1
    reach: float = math.inf
    key: Any = None
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
    def counted(self) -> int:
        """Whether all weights are 1, as those of plain draws are."""
        return self.every == 1 and not self.log_weight.any()


def nothing():
    """The `Draws` before the first."""
    none = np.zeros(0)
    whole = none.astype(np.int32)
    return Draws(none, none, none.astype(bool), whole, whole.astype(np.int64), 0)


def add(kept, traces):
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
    new = (log_w, distance, failure, np.asarray(traces.length, np.int32), row)
    # those before the first have no dtype of their own
    parts = [
        np.concatenate([a.astype(b.dtype), b[good]]) for a, b in zip(kept[:5], new, strict=True)
    ]
    return _bounded(kept._replace(**dict(zip(Draws._fields, parts)), samples=kept.samples + n))


def drawn_by(kept, key, lanes, source):
    """``kept`` with where it comes from."""
    if kept is None:
        return None
    typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    impl = str(jax.random.key_impl(key)) if typed else None
    words = np.asarray(jax.random.key_data(key) if typed else key)
    return kept._replace(key=words, impl=impl, lanes=lanes, source=source)


def key_of(kept):
    """The key of `drawn_by`."""
    return jax.random.wrap_key_data(kept.key, impl=kept.impl)


def _bounded(kept):
    while kept.failure.sum() > KEPT:
        every = 2 * kept.every
        more = np.where(kept.failure, np.asarray(math.log(2), kept.log_weight.dtype), 0)
        kept = kept._replace(every=every, log_weight=kept.log_weight + more)
        kept = _chosen(kept, ~kept.failure | (kept.row % every == 0))
    if (~kept.failure).sum() > 2 * KEPT:  # seldom, as it sorts
        reach = np.partition(kept.distance[~kept.failure], KEPT - 1)[KEPT - 1]
        kept = _chosen(kept, kept.failure | (kept.distance <= reach))
        kept = kept._replace(reach=float(reach))
    return kept


def _chosen(kept, rows):
    return kept._replace(**{name: getattr(kept, name)[rows] for name in Draws._fields[:5]})


class Moments(NamedTuple):
    """Of weights w of which the others of ``samples`` are 0: numbers, or arrays of them."""

    log_mean: Any
    relative: Any
    """Standard error over the mean"""
    ess: Any
    skewness: Any
    """Of the mean"""


def moments(log_sums, samples):
    """`Moments` by the logs of sum w, sum w^2 and sum w^3."""
    first, second, third = log_sums
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = samples * np.exp(second - 2 * first), samples**2 * np.exp(third - 3 * first)
        spread = a - 1 > 1e-9
        variance = np.where(spread, a - 1, 0)
        relative = np.sqrt(variance / max(samples - 1, 1))
        skewness = np.where(spread, (b - 3 * a + 2) / variance**1.5 / math.sqrt(samples), 0.0)
        return Moments(first - math.log(samples), relative, np.exp(2 * first - second), skewness)


def of_weights(log_w, samples):
    """`Moments` of log weights [m], of which there is one."""
    log_w = np.asarray(log_w, np.float64)
    return moments([np.logaddexp.reduce(i * log_w) for i in (1, 2, 3)], samples)


def interval(m, level, count=None, samples=None):
    """(low, high) of the mean of `Moments`; of ``count`` of ``samples`` where all weights are 1."""
    if count is not None:
        return clopper_pearson(count, samples, level)
    return log_normal(*(float(v) for v in (m.log_mean, m.relative)), level, float(m.skewness))


class Share(NamedTuple):
    """Sums over the failing draws, from which the share of some of them is told."""

    first: float
    """Sum of w, over that of the greatest"""
    second: float
    """Sum of w^2"""
    count: int
    counted: bool
    """All weights are 1"""


def shares(log_w, counted):
    """(w [m] over their greatest, `Share` of them)."""
    w = np.exp(np.asarray(log_w, np.float64) - np.max(log_w))
    return w, Share(w.sum(), (w**2).sum(), len(w), counted)


def share(whole, first, second, count, level):
    """The share of ``whole`` that ``count`` draws carry, whose weights have these sums, and its
    (low, high): of plain counts exact, else of the logit of the ratio of two means, by the delta
    method.

    Where all or none are meant, the effective number of the weights stands in for a count.
    """
    r = float(first / whole.first)
    if whole.counted or count in (0, whole.count):
        n = whole.count if whole.counted else max(int(whole.first**2 / whole.second), 1)
        return r, clopper_pearson(count if whole.counted else n * (count > 0), n, level)
    from statistics import NormalDist  # here: slow to import

    # sum of w^2 (1{chosen} - r)^2
    error = math.sqrt(second * (1 - r) ** 2 + (whole.second - second) * r**2) / whole.first
    logit, half = math.log(r / (1 - r)), NormalDist().inv_cdf((1 + level) / 2) * error / r / (1 - r)
    return r, tuple(float(1 / (1 + np.exp(-(logit + way)))) for way in (-half, half))
