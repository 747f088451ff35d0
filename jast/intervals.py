"""Intervals for a probability. On the host, in double precision whatever the arrays' dtype."""

from __future__ import annotations

import math

from jast._checks import real_number

__all__ = ["chernoff", "clopper_pearson", "delta_bound", "jeffreys", "log_normal", "normal"]


SKEWED = 0.4
"""The greatest skewness of a mean that is corrected for; above it the series does not hold."""


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
    _counts("clopper_pearson", k, n, level)
    return _exact(int(k), int(n), level)


def of_effective(share, number, freedom=math.inf, level=0.95):
    """(low, high) of a share that varies as that of ``number`` independent draws would, which need
    be no whole number: Clopper and Pearson's for as many, times (z / t)^2 where the variance is
    known with so many degrees of ``freedom`` only (Korn and Graubard 1998, Survey Methodology 24,
    193-201). From 0 to 1 where there are none.
    """
    from statistics import NormalDist  # here: slow to import

    if not freedom > 0:
        return 0.0, 1.0
    if freedom < math.inf:
        z = NormalDist().inv_cdf((1 + level) / 2)
        number *= min(z / _student(freedom, level), 1.0) ** 2
    return _exact(share * number, number, level)


def _student(freedom, level):
    """The t that Student's distribution exceeds, on either side, with probability 1 - level."""
    x = _solve(lambda x: _betainc(freedom / 2, 0.5, x) - (1 - level))  # P(|T| > t)
    return math.sqrt(freedom * (1 - x) / x) if x > 0 else math.inf


def _exact(k, n, level):
    tail = (1 - level) / 2
    # P(X >= k; p) = I_p(k, n - k + 1) and P(X <= k; p) = I_(1-p)(n - k, k + 1): each tail is solved
    # as itself, none as 1 less the other
    low = 0.0 if k <= 0 else _solve(lambda p: _betainc(k, n - k + 1, p) - tail)
    high = 1.0 if k >= n else _solve(lambda p: tail - _betainc(n - k, k + 1, 1 - p))
    return low, high


def checked_level(function, level):
    """``level`` as a float. ValueError unless it is a number between 0 and 1."""
    real_number(function, "level", level, lambda v: 0 < v < 1, "between 0 and 1")
    return float(level)


def _counts(function, k, n, level):
    if not (n == int(n) and n >= 1):
        raise ValueError(f"{function}: n must be a whole number of at least 1, received {n!r}")
    if not (k == int(k) and 0 <= k <= n):
        raise ValueError(f"{function}: k must be a whole number from 0 to n = {n}, received {k!r}")
    if not 0 < level < 1:
        raise ValueError(f"{function}: level must lie between 0 and 1, received {level!r}")


def _solve(rising):
    """The root in (0, 1) of an increasing function, by bisection to the last bits."""
    low, high = 0.0, 1.0
    while high - low > 1e-15 * high:
        middle = (low + high) / 2
        if middle in (low, high):
            break
        low, high = (low, middle) if rising(middle) > 0 else (middle, high)
    return (low + high) / 2


def _betainc(a, b, x):
    """Regularised incomplete beta function I_x(a, b), by its continued fraction (DLMF 8.17.22)."""
    if not 0 < x < 1:
        return float(x >= 1)
    # beyond the bulk the fraction of the mirror image converges faster
    if x > (a + 1) / (a + b + 2):
        return 1 - _betainc(b, a, 1 - x)
    log_front = (
        math.lgamma(a + b)
        - math.lgamma(a)
        - math.lgamma(b)
        + a * math.log(x)
        + b * math.log1p(-x)
        - math.log(a)
    )
    tiny = 1e-300
    c, d = 1.0, 1 / (1 - (a + b) * x / (a + 1) or tiny)  # modified Lentz
    value = d
    for m in range(1, 1_000_000):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            d = 1 / (1 + term * d or tiny)
            c = 1 + term / c or tiny
            value *= c * d
        if abs(c * d - 1) < 1e-15:
            break
    return math.exp(log_front) * value if log_front > -745 else 0.0


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
    _counts("chernoff", k, n, level)
    k, n = int(k), int(n)
    if k == n:
        return 1.0
    m, bound = k / n, -math.log1p(-level) / n
    kl = lambda u: (m * math.log(m / u) if m else 0.0) + (1 - m) * (math.log1p(-m) - math.log1p(-u))
    return _solve(lambda u: 1.0 if u >= 1 else (kl(u) - bound if u > m else -1.0))


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
    _counts("delta_bound", k, n, level)
    return min(1.0, int(k) / int(n) + math.sqrt(-math.log1p(-level) / int(n)))


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
    from statistics import NormalDist  # here: slow to import

    real_number("normal", "mean", mean, math.isfinite, "that is finite")
    real_number(
        "normal", "standard_error", standard_error, lambda v: 0 <= v < math.inf, "of at least 0"
    )
    half = NormalDist().inv_cdf((1 + checked_level("normal", level)) / 2) * float(standard_error)
    return float(mean) - half, float(mean) + half


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
    _counts("jeffreys", k, n, level)
    return _solve(lambda p: _betainc(int(k) + 0.5, int(n) - int(k) + 0.5, p) - level)


def log_normal(log_mean, relative_error, level=0.95, skewness=0.0):
    """(low, high) above 0, as skewed as a mean of weights is: exp(log_mean -+ z s), s^2 = log(1 +
    relative_error^2).

    ``skewness``: of the mean, as the sample has it. Where it asks for a higher ``high`` (Hall 1992,
    Journal of the Royal Statistical Society B 54, 221-228, of the studentised mean), that is taken:
    the few great weights of a skewed mean are missing more often than not.
    """
    from statistics import NormalDist  # here: slow to import

    z = NormalDist().inv_cdf((1 + level) / 2)
    half = z * math.sqrt(math.log1p(relative_error**2))
    above = half
    if (g := min(skewness, SKEWED)) > 1e-6 and relative_error > 0:
        t = (
            3 / g * (math.cbrt(1 - g * (z + g / 6)) - 1)
        )  # t + g t^2 / 3 + g^2 t^3 / 27 + g / 6 = -z
        above = max(half, -relative_error * t - (relative_error * t) ** 2 / 2)
    return tuple(math.exp(min(log_mean + way, 0.0)) for way in (-half, above))
