"""When a weighted estimate must not be believed: effective sample size, the Pareto shape of the
greatest weights, and the rules made of them.
"""

from __future__ import annotations

import math

import numpy as np

from jast._src.core.typing import Array

__all__ = [
    "MAX_SHARE_OF_ERROR",
    "MIN_ESS",
    "MIN_MODE_ESS",
    "MIN_MODE_SHARE",
    "mode_warnings",
    "pareto_k",
    "tail_size",
    "warnings_of_weights",
    "weight_warnings",
]

MAX_K_HAT = 0.7
"""Pareto shape above which no standard error is trusted (Vehtari and others 2024)."""
MIN_ESS = 100
"""Effective draws of an estimate: a relative standard error of a tenth. A convention."""
MAX_SHARE_OF_ERROR = 0.5
"""Part of an estimate that one episode may carry, as a multiple of the relative standard error of
the least effective draws: 5 % where these are 100. A convention."""
MIN_ESS_PER_FAILURE = 0.01
"""Effective draws a failure: of a proposal below it the weights hardly overlap. A convention."""
MIN_MODE_SHARE = 0.02
"""Part of the estimate from which on a failure mode matters. A convention."""
MIN_MODE_ESS = 30
"""Effective draws of such a mode: its own standard error is then below a fifth."""
MIN_ERROR_SHARE = 0.5
"""Part of the standard error of the whole that the mode's own has to be, to matter."""
MIN_TAIL = 5
"""Weights that a shape is fitted to, at least."""


def pareto_k(log_weights: Array, samples: int, failures: int | None = None) -> float:
    """Shape k of the generalised Pareto distribution of the greatest weights.

    Below 0.5 the weights look as if they had a variance, above 0.7 no standard error can be trusted
    (Vehtari, Simpson, Gelman, Yao and Gabry 2024). The tail is min(n / 5, 3 sqrt(n)) weights, and
    at most a fifth of the failures.

    Args:
        log_weights: [m]: logs of the weights above 0.
        samples: how many weights there are in all, n.
        failures: how many are above 0 in all. Default: those given.

    Returns:
        A float; NaN for fewer than 5 weights, and where one is NaN; -inf where the greatest are all
        equal, and inf where one is infinite.

    Example:
        >>> import numpy as np, jast
        >>> heavy = 0.9 * np.random.default_rng(0).exponential(size=10000)  # Pareto, k = 0.9
        >>> 0.8 < jast.estimate.pareto_k(heavy, 10000) < 1.0
        True
    """
    log_w = np.sort(np.asarray(log_weights, np.float64))
    if np.isnan(log_w).any():
        return float("nan")
    if np.isposinf(log_w).any():
        return float("inf")
    log_w = log_w[log_w > -np.inf]
    failures = len(log_w) if failures is None else failures
    m = min(tail_size(samples), math.ceil(max(failures / 5, MIN_TAIL)), len(log_w) - 1)
    if m < MIN_TAIL:
        return float("nan")
    w = np.exp(log_w[-m - 1 :] - log_w[-1])
    excess = w[1:] - w[0]
    excess = excess[excess > 1e-9]
    if not excess.size:
        return float("-inf")
    if len(excess) >= MIN_TAIL:
        return _fit_shape(excess)
    return float("-inf") if excess[-1] < w[0] else float("inf")  # a few above a crowd of equal ones


def tail_size(samples: int) -> int:
    """How many of the greatest of so many weights a shape is fitted to, at most: min(n / 5,
    3 sqrt(n)) (Vehtari and others 2024).
    """
    return math.ceil(min(samples / 5, 3 * math.sqrt(samples)))


def _fit_shape(x):
    """The estimate of Zhang and Stephens (2009) from rising excesses ``x`` above 0, with the weak
    prior of PSIS (10 observations at 0.5).
    """
    n = len(x)
    m = 30 + int(np.sqrt(n))
    quartile = x[int(n / 4 + 0.5) - 1]
    theta = 1 / x[-1] + (1 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3 * quartile)
    k = np.log1p(-theta[:, None] * x).mean(axis=1)
    log_likelihood = n * (np.log(-theta / k) - k - 1)
    weights = np.exp(log_likelihood - log_likelihood.max())
    best = (theta * weights).sum() / weights.sum()
    return float((n * np.log1p(-best * x).mean() + 5) / (n + 10))


def mode_warnings(shares: np.ndarray, sizes: np.ndarray, error: float) -> list[str]:
    """Texts for the modes that few effective episodes speak for and that matter: also to the
    relative ``error`` of the whole.
    """
    if len(shares) < 2:
        return []
    return [
        f"a failure mode with {share:.1%} of the estimate has an effective sample size of only"
        f" {size:.3g}"
        for share, size in zip(shares, sizes, strict=True)
        if share > MIN_MODE_SHARE
        and size < MIN_MODE_ESS
        and share**2 > size * (MIN_ERROR_SHARE * error) ** 2
    ]


def weight_warnings(
    failures: int, ess: float, k_hat: float, max_share: float, min_ess: int = MIN_ESS
) -> list[str]:
    """Why weights must not be trusted: a list of texts, empty where nothing speaks against them.
    ``min_ess``: the least effective draws.
    """
    found = []
    if ess < min_ess:
        found.append(f"effective sample size {ess:.3g}, below {min_ess}")
    if np.isnan(k_hat):
        found.append(f"{failures} failures are too few to judge the tail of the weights")
    elif k_hat > MAX_K_HAT:
        found.append(
            f"Pareto k-hat {k_hat:.2f}, above {MAX_K_HAT}: the weights have so heavy a tail that"
            " their standard error cannot be trusted"
        )
    if max_share > (most := MAX_SHARE_OF_ERROR / math.sqrt(min_ess)):
        found.append(f"one episode carries {max_share:.0%} of the estimate, above {most:.0%}")
    if ess < MIN_ESS_PER_FAILURE * failures:
        found.append(
            f"effective sample size {ess:.3g} is below {MIN_ESS_PER_FAILURE:.0%} of the {failures}"
            " failures"
        )
    return found


def warnings_of_weights(log_weights: Array, samples: int, ess: float) -> list[str]:
    """`weight_warnings` of these weights [m] above 0, of ``samples`` in all, whose effective sample
    size is known.
    """
    m = len(log_weights)
    max_share = math.exp(np.max(log_weights) - np.logaddexp.reduce(log_weights))
    return weight_warnings(m, ess, pareto_k(log_weights, samples, m), max_share)
