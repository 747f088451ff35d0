"""More answers from the draws of one estimate: the probability of every miss distance, the distance
of a given probability, and when failures happen. No episode is simulated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jast import results
from jast._checks import number
from jast.estimate import diagnostics
from jast.estimate.draws import Draws, Moments, interval, moments, of_weights, share, shares
from jast.estimate.estimate import Estimate
from jast.intervals import checked_level

if TYPE_CHECKING:
    import chex

__all__ = ["Exceedance", "FailureTimes", "distance_quantile", "exceedance", "failure_times"]

POINTS = 64


@results.printable()
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

    thresholds: Any
    """[k] rising; 0 is the failure"""
    probability: Any
    """[k]"""
    low: Any
    """[k] ends of the pointwise interval at ``level``"""
    high: Any
    ess: Any
    """[k] effective sample size of the draws within a threshold"""
    reliable: Any
    """[k] bool: whether the estimate is, and the draws within this threshold are enough for a
    number"""
    level: float
    method: str
    unseen: float | None = None
    """That of the estimate"""


@results.printable()
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

    probability: Any
    """[T + 1] that an episode fails at this step; their sum is the failure probability"""
    low: Any
    """[T + 1] ends of the interval at ``level``; where no failure was seen, from 0"""
    high: Any
    given_failure: Any
    """[T + 1] the same, given that it fails; sum 1"""
    quantiles: dict[str, Any]
    """Of the time, given a failure: 0.05, 0.5, 0.95 -> (step, low, high)"""
    mean: float
    """Mean time of a failure"""
    ess: Any
    """[T + 1] effective sample size of the failures at this step"""
    reliable: bool
    """Whether the estimate is, and there are enough effective failures for the times"""
    level: float
    method: str


def exceedance(
    estimate: Estimate,
    thresholds: Sequence[float] | chex.Array | None = None,
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
    draws, level = asked(name, estimate, level)
    within = _Within(draws)
    if thresholds is None:
        thresholds = within.grid()
    try:
        u = np.sort(np.asarray(thresholds, np.float64).ravel())
    except (TypeError, ValueError):
        u = np.full(1, np.nan)
    if not (u.size and np.isfinite(u).all()):
        raise ValueError(f"{name}: thresholds must be finite numbers, received {thresholds!r}")
    rows = [within.at(v, level) for v in u]
    p, low, high, ess, good = (np.array(a) for a in zip(*rows, strict=True))
    good = good.astype(bool) & (estimate.reliable | draws.counted)
    return Exceedance(u, p, low, high, ess, good, level, estimate.method, estimate.unseen)


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
    draws, level = asked(name, estimate, level)
    p = number(name, "probability", probability, lambda v: 0 < v < 1, "above 0 and below 1")
    within = _Within(draws)

    def cross(reached):
        i = _first(within.count, reached)
        return None if i is None else float(within.severity[i])

    middle = cross(lambda i: within.probability(i) >= p)
    stops = middle == 0.0 == within.severity[0] and within.ties(0.0) > p * (1 + 1e-9)
    if middle is None or stops or math.isnan(within.at(middle, level)[0]):
        return math.nan, (math.nan, math.nan)
    low, high = (cross(lambda i, k=k: within.interval(i, level)[k] >= p) for k in (1, 0))
    ends = (-math.inf if low is None else low, math.inf if high is None else high)
    return middle, ends


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
    draws, level = asked(name, estimate, level)
    log_w, at = (a[draws.failure] for a in (draws.log_weight, draws.length))
    if not len(at):
        raise ValueError(f"{name}: estimate must have seen a failure, received one that saw none")
    m, n = of_weights(log_w, draws.samples), draws.samples
    w, whole = shares(log_w, draws.counted)
    first, second, count = np.bincount(at, w), np.bincount(at, w**2), np.bincount(at)
    with np.errstate(divide="ignore"):
        sums = [np.log(np.bincount(at, w**i)) + i * float(log_w.max()) for i in (1, 2, 3)]
    nothing = share(whole, 0.0, 0.0, 0, level)[1][1] * math.exp(m.log_mean)
    each = moments(sums, n)
    rows = [Moments(*(a[t] for a in each)) for t in range(len(count))]
    ends = [
        interval(r, level, k if draws.counted else None, n) if k else (0.0, nothing)
        for r, k in zip(rows, count.tolist(), strict=True)
    ]
    by = [
        share(whole, *sums_, level)
        for sums_ in zip(np.cumsum(first), np.cumsum(second), np.cumsum(count), strict=True)
    ]
    return FailureTimes(
        np.exp(np.minimum(each.log_mean, 0.0)),
        *np.array(ends).T,
        first / whole.first,
        {q: _time(by, q) for q in (0.05, 0.5, 0.95)},
        float(first @ np.arange(len(first)) / whole.first),
        np.where(count > 0, each.ess, 0.0),
        estimate.reliable and bool(draws.counted or m.ess >= diagnostics.ESS),
        level,
        estimate.method,
    )


def asked(name, estimate, level):
    """(`Draws`, level) of an ``estimate``; ValueError where it holds none."""
    if not isinstance(estimate, Estimate):
        raise ValueError(
            f"{name}: estimate must be a jast.estimate.Estimate, received {type(estimate).__name__}"
        )
    level = estimate.level if level is None else checked_level(name, level)
    if not isinstance(estimate.draws, Draws) or not estimate.draws.samples:
        raise ValueError(
            f"{name}: estimate must have kept its weighted draws, received one by"
            f" {estimate.method} without draws: importance sampling and plain draws keep them;"
            " subset simulation, a surrogate (budgets below 5000) and an interrupted search do"
            " not"
        )
    return estimate.draws, level


class _Within:
    """Sums over the draws within each severity."""

    def __init__(self, draws):
        order = np.argsort(draws.severity, kind="stable")
        self.draws, self.severity = draws, draws.severity[order]
        self.log_w = draws.log_weight[order].astype(np.float64)
        self.count = len(order)
        self.moments = moments(
            [np.logaddexp.accumulate(i * self.log_w) for i in (1, 2, 3)], draws.samples
        )
        self.top = np.maximum.accumulate(self.log_w) if self.count else self.log_w

    def probability(self, i):
        return math.exp(min(self.moments.log_mean[i], 0.0))  # weights may have a mean above 1

    def ties(self, v):
        """The probability within ``v``."""
        return self.probability(np.searchsorted(self.severity, v, "right") - 1)

    def interval(self, i, level):
        m = Moments(*(a[i] for a in self.moments))
        return interval(m, level, i + 1 if self.draws.counted else None, self.draws.samples)

    def at(self, u, level):
        """(probability, low, high, effective sample size, whether to believe it) within ``u``."""
        i = int(np.searchsorted(self.severity, u, "right")) - 1
        unknown = math.nan, math.nan, math.nan
        if i < 0 or u > self.draws.reach:
            return *unknown, 0.0, False
        ess = float(self.moments.ess[i])
        if not self.draws.counted:
            log_w = self.log_w[: i + 1]
            k_hat = diagnostics.pareto_k(log_w, self.draws.samples, i + 1)
            carried = math.exp(self.top[i] - self.moments.log_mean[i]) / self.draws.samples
            if diagnostics.reasons(i + 1, ess, k_hat, carried):
                return *unknown, ess, False
        return self.probability(i), *self.interval(i, level), ess, True

    def grid(self):
        """Thresholds that the draws say something of."""
        if not self.count:
            return np.zeros(1)
        low = min(self.severity[min(diagnostics.ESS, self.count) - 1], 0.0)
        i = _first(self.count, lambda i: self.probability(i) >= 0.5)
        high = max(self.severity[-1 if i is None else i], 0.0)
        return np.union1d(np.linspace(low, high, POINTS), [0.0])


def _first(n, holds):
    """The first of ``n`` numbers from which on ``holds`` does; None where it never does."""
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle + 1, high)
    return low if low < n else None


def _time(by, q):
    """(the step by which a share ``q`` of the failures happened, low, high), of the shares ``by``
    each step and their intervals.
    """
    # a share whose upper end is below q speaks for a later time
    marks = zip(*((r, high, low) for r, (low, high) in by), strict=True)
    return tuple(next((t for t, v in enumerate(each) if v >= q), len(by) - 1) for each in marks)
