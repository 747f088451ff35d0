"""Intervals for a probability. On the host, in double precision whatever the arrays' dtype."""

from __future__ import annotations

import math

from jast._src.util.checks import number

__all__ = [
    "checked_level",
    "chernoff",
    "clopper_pearson",
    "delta_bound",
    "effective_interval",
    "jeffreys",
    "log_normal",
    "normal",
    "normal_quantile",
    "student_factor",
]

MAX_SKEWNESS = 0.4
"""The greatest skewness of a mean that is corrected for: above it Hall's series does not hold."""


def clopper_pearson(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Exact (low, high) of a binomial probability: covers at least ``level`` of the time (Clopper
    and Pearson, 1934).

    low is the alpha/2 quantile of Beta(k, n - k + 1), high the 1 - alpha/2 quantile of Beta(k + 1,
    n - k), alpha = 1 - level; 0 at k = 0, 1 at k = n.

    Args:
        k: events.
        n: trials.
        level: of confidence, in (0, 1).

    Raises:
        ValueError: unless 0 <= k <= n, n >= 1 and 0 < level < 1.

    Example:
        >>> from jast.estimate import clopper_pearson
        >>> low, high = clopper_pearson(0, 1000)
        >>> low, round(high, 6)
        (0.0, 0.003682)
    """
    return _exact_interval(*_checked_counts("clopper_pearson", k, n, level), level)


def effective_interval(
    share: float, number: float, freedom: float = math.inf, level: float = 0.95
) -> tuple[float, float]:
    """(low, high) of a share that varies as that of ``number`` independent draws would, which need
    be no whole number: Clopper and Pearson's for as many, times (z / t)^2 where the variance is
    known with so many degrees of ``freedom`` only (Korn and Graubard 1998, Survey Methodology 24,
    193-201). From 0 to 1 where there are none.
    """
    if not freedom > 0:
        return 0.0, 1.0
    number /= student_factor(freedom, level) ** 2
    return _exact_interval(share * number, number, level)


def student_factor(freedom: float, level: float) -> float:
    """The two-sided quantile of Student's t with so many degrees of ``freedom`` over that of the
    normal distribution, at least 1.
    """
    from scipy.special import stdtrit  # here: slow to import

    if freedom == math.inf:
        return 1.0
    return max(float(stdtrit(freedom, (1 + level) / 2)) / normal_quantile(level), 1.0)


def normal_quantile(level: float) -> float:
    """z: a normal variable lies between -z and z with probability ``level``."""
    from scipy.special import ndtri  # here: slow to import

    return float(ndtri((1 + level) / 2))


def _exact_interval(k, n, level):
    from scipy.special import betainccinv, betaincinv  # here: slow to import

    tail = (1 - level) / 2
    # P(X >= k; p) = I_p(k, n - k + 1), and P(X <= k; p) = 1 - I_p(k + 1, n - k)
    low = 0.0 if k <= 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k >= n else float(betainccinv(k + 1, n - k, tail))
    return low, high


def checked_level(function: str, level: float) -> float:
    """``level`` as a float. ValueError unless it is a number between 0 and 1."""
    return number(function, "level", level, lambda v: 0 < v < 1, "between 0 and 1")


def _checked_counts(function, k, n, level):
    """``k`` and ``n`` as whole numbers."""
    if not (n == int(n) and n >= 1):
        raise ValueError(f"{function}: n must be a whole number of at least 1, received {n!r}")
    if not (k == int(k) and 0 <= k <= n):
        raise ValueError(f"{function}: k must be a whole number from 0 to n = {n}, received {k!r}")
    checked_level(function, level)
    return int(k), int(n)


def chernoff(k: int, n: int, level: float = 0.95) -> float:
    """One-sided upper bound of a binomial probability: the u above k/n with n KL(k/n || u) = log(1
    / (1 - level)).

    Chernoff's bound in its sharp form (Lipkis and Agogino, eq. 17). It covers at least ``level`` of
    the time, and is not below Clopper and Pearson's.

    Args:
        k: events.
        n: trials.
        level: of confidence, in (0, 1).

    Raises:
        ValueError: as `clopper_pearson`.

    Example:
        >>> from jast.estimate import chernoff
        >>> round(chernoff(0, 1000), 6)
        0.002991
    """
    from scipy.optimize import brentq  # here: slow to import

    k, n = _checked_counts("chernoff", k, n, level)
    if k == n:
        return 1.0
    share, bound = k / n, -math.log1p(-level) / n

    def excess(u):  # KL(k/n || u) less its bound; rises from k/n on
        missing = (1 - share) * (math.log1p(-share) - math.log1p(-u))
        return (share * math.log(share / u) if k else 0.0) + missing - bound

    top = math.nextafter(1.0, 0.0)
    return 1.0 if excess(top) <= 0 else brentq(excess, share, top, xtol=1e-300, rtol=1e-15)


def delta_bound(k: int, n: int, level: float = 0.95) -> float:
    """One-sided upper bound of a binomial probability as Lipkis and Agogino print it (eq. 17): k/n
    + delta with exp(-n delta^2) = 1 - level, at most 1.

    Valid and loose: Hoeffding's inequality has exp(-2 n delta^2), and `chernoff` is sharp.

    Args:
        k: events.
        n: trials.
        level: of confidence, in (0, 1).

    Raises:
        ValueError: as `clopper_pearson`.

    Example:
        >>> from jast.estimate import delta_bound
        >>> round(delta_bound(0, 1000), 4)
        0.0547
    """
    k, n = _checked_counts("delta_bound", k, n, level)
    return min(1.0, k / n + math.sqrt(-math.log1p(-level) / n))


def normal(mean: float, standard_error: float, level: float = 0.95) -> tuple[float, float]:
    """(low, high) of a normal distribution, mean -+ z standard_error, as Lipkis and Agogino print
    it (eq. 15 and 16). ``low`` may be below 0: `jast.estimate.Estimate` has a log-normal interval.

    Args:
        mean: of the estimate.
        standard_error: of the mean, at least 0.
        level: of confidence, in (0, 1).

    Raises:
        ValueError: for a mean that is not finite, a standard error that is negative or not finite,
            and a level outside (0, 1).

    Example:
        >>> from jast.estimate import normal
        >>> [round(end, 2) for end in normal(1.0, 0.1)]
        [0.8, 1.2]
    """
    mean = number("normal", "mean", mean, math.isfinite, "that is finite")
    error = number(
        "normal", "standard_error", standard_error, lambda v: 0 <= v < math.inf, "of at least 0"
    )
    half = normal_quantile(checked_level("normal", level)) * error
    return mean - half, mean + half


def jeffreys(k: int, n: int, level: float = 0.95) -> float:
    """Upper end of the one-sided interval under Jeffreys' prior (Lipkis and Agogino, eq. 18): a
    quantile of Beta(k + 1/2, n - k + 1/2).

    A Bayesian bound: below the exact one, and not promised to cover in each case.

    Args:
        k: events.
        n: trials.
        level: the quantile, in (0, 1).

    Raises:
        ValueError: as `clopper_pearson`.

    Example:
        >>> from jast.estimate import jeffreys
        >>> round(jeffreys(0, 1000), 6)
        0.001918
    """
    from scipy.special import betaincinv  # here: slow to import

    k, n = _checked_counts("jeffreys", k, n, level)
    return float(betaincinv(k + 0.5, n - k + 0.5, level))


def log_normal(
    log_mean: float, relative_error: float, level: float = 0.95, skewness: float = 0.0
) -> tuple[float, float]:
    """(low, high) above 0, as skewed as a mean of weights is: exp(log_mean -+ z s), s^2 = log(1 +
    relative_error^2).

    ``skewness``: of the mean, as the sample has it. Where it asks for a higher ``high`` (Hall 1992,
    Journal of the Royal Statistical Society B 54, 221-228, of the studentised mean), that is taken:
    the few great weights of a skewed mean are missing more often than not.
    """
    z = normal_quantile(level)
    below = above = z * math.sqrt(math.log1p(relative_error**2))
    g = min(skewness, MAX_SKEWNESS)
    if g > 1e-6 and relative_error > 0:
        # t + g t^2 / 3 + g^2 t^3 / 27 + g / 6 = -z
        t = 3 / g * (math.cbrt(1 - g * (z + g / 6)) - 1)
        above = max(above, -relative_error * t - (relative_error * t) ** 2 / 2)
    return math.exp(min(log_mean - below, 0.0)), math.exp(min(log_mean + above, 0.0))
