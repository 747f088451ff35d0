"""More answers from the draws of one estimate: the probability of every miss distance, the distance
of a given probability, and when failures happen. No episode is simulated.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.typing import Array
from jast._src.estimate import diagnostics
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.weighted_draws import (
    Draws,
    Moments,
    mean_interval,
    moments_of_sums,
    moments_of_weights,
    scaled_weights,
    share_interval,
)
from jast._src.util import display
from jast._src.util.checks import instance, number
from jast._src.util.intervals import checked_level

__all__ = [
    "Exceedance",
    "FailureTimes",
    "distance_quantile",
    "draws_and_level",
    "exceedance",
    "failure_times",
]

GRID_POINTS = 64
"""Thresholds by default: a smooth curve in a picture."""
TIME_QUANTILES = (0.05, 0.5, 0.95)
"""Of the time of a failure: the median, and nine of ten lie between the others."""


@display.printable()
class Exceedance(NamedTuple):
    """The probability that an episode comes as near to a failure as a threshold of the miss
    distance, [k] each, NumPy. NaN where it is not known.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> curve = jast.estimate.exceedance(counted, [0.0, 1.0])
        >>> bool((curve.low < curve.probability).all() and (curve.probability < curve.high).all())
        True
    """

    thresholds: np.ndarray
    """[k] rising; 0 is the failure"""
    probability: np.ndarray
    """[k]"""
    low: np.ndarray
    """[k] ends of the pointwise interval at ``level``"""
    high: np.ndarray
    ess: np.ndarray
    """[k] effective sample size of the draws within a threshold"""
    reliable: np.ndarray
    """[k] bool: whether the estimate is, and the draws within this threshold are enough for a
    number"""
    level: float
    method: str
    unseen: float | None = None
    """That of the estimate"""


@display.printable()
class FailureTimes(NamedTuple):
    """When failures happen, in steps, [T + 1] each, NumPy: from 0, at the start, to the last step
    at which one was seen.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> times = jast.estimate.failure_times(counted)
        >>> low, median, high = (times.quantiles[q][0] for q in (0.05, 0.5, 0.95))
        >>> low <= median <= high, round(float(times.given_failure.sum()), 6)
        (True, 1.0)
    """

    probability: np.ndarray
    """[T + 1] that an episode fails at this step; their sum is the failure probability"""
    low: np.ndarray
    """[T + 1] ends of the interval at ``level``; where no failure was seen, from 0"""
    high: np.ndarray
    given_failure: np.ndarray
    """[T + 1] the same, given that it fails; sum 1"""
    quantiles: dict[float, tuple[int, int, int]]
    """Of the time, given a failure: 0.05, 0.5, 0.95 -> (step, low, high)"""
    mean: float
    """Mean time of a failure"""
    ess: np.ndarray
    """[T + 1] effective sample size of the failures at this step"""
    reliable: bool
    """Whether the estimate is, and there are enough effective failures for the times"""
    level: float
    method: str


def exceedance(
    estimate: Estimate,
    thresholds: Sequence[float] | Array | None = None,
    *,
    level: float | None = None,
) -> Exceedance:
    """The distribution of the miss distance in its tail: the probability that an episode fails or
    comes as near as each threshold. Below 0, where the miss distance continues, it is the
    probability of failing by that much. No further episode is simulated.

    The draws of `failure_probability` lie around failures, so this is sharp from the failure
    inwards and some way outwards. Farther out the model's own share of the draws carries it: an
    event that comes near and leads to no failure is met by these alone, and below ``unseen`` it may
    be missing without a sign.

    Args:
        estimate: of `failure_probability`, `monte_carlo` or `importance`, with its draws.
        thresholds: [k] numbers. Default: 64, from the least distance that a hundred draws reach to
            the median of the model.
        level: of the interval. Default: the estimate's.

    Returns:
        `Exceedance`. ``reliable`` is False, and the numbers are NaN, where the weights within a
        threshold have the signs for which an estimate is UNRELIABLE. For plain counts the intervals
        are exact, and nothing is NaN unless nothing was seen.

    Raises:
        ValueError: for thresholds that are not finite numbers, and an estimate without draws.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> curve = jast.estimate.exceedance(counted, [0.0, 1.0, 2.0])
        >>> bool((curve.probability[1:] >= curve.probability[:-1]).all())
        True
    """
    name = "exceedance"
    draws, level = draws_and_level(name, estimate, level)
    within = _DistanceDistribution(draws)
    if thresholds is None:
        thresholds = within.grid()
    try:
        u = np.sort(np.asarray(thresholds, np.float64).ravel())
    except (TypeError, ValueError):
        u = np.full(1, np.nan)
    if not (u.size and np.isfinite(u).all()):
        raise ValueError(f"{name}: thresholds must be finite numbers, received {thresholds!r}")
    rows = [within.at(v, level) for v in u]
    probability, low, high, ess, good = (np.array(a) for a in zip(*rows, strict=True))
    return Exceedance(
        thresholds=u,
        probability=probability,
        low=low,
        high=high,
        ess=ess,
        reliable=good.astype(bool) & (estimate.reliable | draws.counted),
        level=level,
        method=estimate.method,
        unseen=estimate.unseen,
    )


def distance_quantile(
    estimate: Estimate, probability: float, *, level: float | None = None
) -> tuple[float, tuple[float, float]]:
    """The miss distance that an episode comes within with a given probability, the inverse of
    `exceedance`. No further episode is simulated.

    Args:
        estimate: of `failure_probability`, `monte_carlo` or `importance`, with its draws.
        probability: in (0, 1).
        level: of the interval. Default: the estimate's.

    Returns:
        (distance, (low, high)). NaN where the draws do not tell: below the probability of a failure
        where the distance stops at 0 there, and beyond what `exceedance` believes. An end of the
        interval that the draws do not reach is infinite.

    Raises:
        ValueError: for a probability outside (0, 1), and an estimate without draws.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> distance, (low, high) = jast.estimate.distance_quantile(counted, 0.3)
        >>> low <= distance <= high
        True
    """
    name = "distance_quantile"
    draws, level = draws_and_level(name, estimate, level)
    p = number(name, "probability", probability, lambda v: 0 < v < 1, "above 0 and below 1")
    within = _DistanceDistribution(draws)

    def first_distance(reached):
        i = within.first_index(reached)
        return None if i is None else float(within.severity[i])

    middle = first_distance(lambda i: within.probability(i) >= p)
    if middle is None or math.isnan(within.at(middle, level)[0]):
        return math.nan, (math.nan, math.nan)
    # where all failures are at 0, the distance is not known below it
    at_zero = within.probability(np.searchsorted(within.severity, 0.0, "right") - 1)
    if middle == 0.0 == within.severity[0] and at_zero > p * (1 + 1e-9):
        return math.nan, (math.nan, math.nan)
    low, high = (first_distance(lambda i, k=k: within.interval(i, level)[k] >= p) for k in (1, 0))
    return middle, (-math.inf if low is None else low, math.inf if high is None else high)


def failure_times(estimate: Estimate, *, level: float | None = None) -> FailureTimes:
    """When the system fails: the probability of a failure at each step with its interval, and
    quantiles of the time given a failure. No further episode is simulated.

    An episodic system is judged at the end of its episodes, and fails then.

    Args:
        estimate: of `failure_probability`, `monte_carlo` or `importance`, with its draws.
        level: of the intervals. Default: the estimate's.

    Returns:
        `FailureTimes`.

    Raises:
        ValueError: for an estimate without draws or without a failure.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> times = jast.estimate.failure_times(counted)
        >>> sorted(times.quantiles) == list(times.quantiles)
        True
    """
    name = "failure_times"
    draws, level = draws_and_level(name, estimate, level)
    log_w, at = (a[draws.failure] for a in (draws.log_weight, draws.length))
    if not len(at):
        raise ValueError(f"{name}: estimate must have seen a failure, received one that saw none")
    m = moments_of_weights(log_w, draws.samples)
    w, total = scaled_weights(log_w, draws.counted)
    first, second, count = np.bincount(at, w), np.bincount(at, w**2), np.bincount(at)
    with np.errstate(divide="ignore"):
        log_sums = [np.log(np.bincount(at, w**i)) + i * float(log_w.max()) for i in (1, 2, 3)]
    each = moments_of_sums(log_sums, draws.samples)
    # above a step at which no failure was seen: what is not excluded among the failures
    unseen = share_interval(total, 0.0, 0.0, 0, level)[1][1] * math.exp(m.log_mean)
    ends = [
        mean_interval(draws, _at_index(each, t), k, level) if k else (0.0, unseen)
        for t, k in enumerate(count.tolist())
    ]
    sums_by_step = zip(np.cumsum(first), np.cumsum(second), np.cumsum(count), strict=True)
    shares = [share_interval(total, *sums, level) for sums in sums_by_step]
    low, high = np.array(ends).T
    return FailureTimes(
        probability=np.exp(np.minimum(each.log_mean, 0.0)),
        low=low,
        high=high,
        given_failure=first / total.first,
        quantiles={q: _time_quantile(shares, q) for q in TIME_QUANTILES},
        mean=float(first @ np.arange(len(first)) / total.first),
        ess=np.where(count > 0, each.ess, 0.0),
        reliable=estimate.reliable and bool(draws.counted or m.ess >= diagnostics.MIN_ESS),
        level=level,
        method=estimate.method,
    )


def draws_and_level(name: str, estimate: Any, level: float | None) -> tuple[Draws, float]:
    """(`Draws`, level) of an ``estimate``; ValueError where it holds none."""
    instance(name, "estimate", estimate, Estimate, "a jast.estimate.Estimate")
    level = estimate.level if level is None else checked_level(name, level)
    if not isinstance(estimate.draws, Draws) or not estimate.draws.samples:
        raise ValueError(
            f"{name}: estimate must have kept its weighted draws, received one by"
            f" {estimate.method} without draws: importance sampling and plain draws keep them;"
            " subset simulation, a surrogate (budgets below 5000) and an interrupted search do"
            " not"
        )
    return estimate.draws, level


def _at_index(m, i):
    """The one of many `Moments`."""
    return Moments(*(a[i] for a in m))


class _DistanceDistribution:
    """Sums over the draws within each severity."""

    def __init__(self, draws):
        order = np.argsort(draws.severity, kind="stable")
        self.draws, self.severity = draws, draws.severity[order]
        self.log_w = draws.log_weight[order].astype(np.float64)
        log_sums = [np.logaddexp.accumulate(i * self.log_w) for i in (1, 2, 3)]
        self.moments = moments_of_sums(log_sums, draws.samples)

    def probability(self, i):
        return math.exp(min(self.moments.log_mean[i], 0.0))  # weights may have a mean above 1

    def interval(self, i, level):
        return mean_interval(self.draws, _at_index(self.moments, i), i + 1, level)

    def first_index(self, holds):
        """The first draw from which on ``holds`` does; None where it never does."""
        n = len(self.severity)
        i = bisect_left(range(n), True, key=holds)
        return i if i < n else None

    def at(self, threshold, level):
        """(probability, low, high, effective sample size, whether to believe it) within it."""
        i = int(np.searchsorted(self.severity, threshold, "right")) - 1
        unknown = math.nan, math.nan, math.nan
        if i < 0 or threshold > self.draws.reach:
            return *unknown, 0.0, False
        ess, n = float(self.moments.ess[i]), self.draws.samples
        if not self.draws.counted and diagnostics.warnings_of_weights(self.log_w[: i + 1], n, ess):
            return *unknown, ess, False
        return self.probability(i), *self.interval(i, level), ess, True

    def grid(self):
        """Thresholds that the draws say something of."""
        n = len(self.severity)
        if not n:
            return np.zeros(1)
        low = min(self.severity[min(diagnostics.MIN_ESS, n) - 1], 0.0)
        i = self.first_index(lambda i: self.probability(i) >= 0.5)
        high = max(self.severity[-1 if i is None else i], 0.0)
        return np.union1d(np.linspace(low, high, GRID_POINTS), [0.0])


def _time_quantile(shares, q):
    """(the step by which a share ``q`` of the failures happened, low, high), of the ``shares`` by
    each step and their intervals.
    """

    def first_step(values):
        return next((t for t, v in enumerate(values) if v >= q), len(shares) - 1)

    middle, ends = zip(*shares, strict=True)
    low, high = zip(*ends, strict=True)
    # a share whose upper end is below q speaks for a later time
    return first_step(middle), first_step(high), first_step(low)
