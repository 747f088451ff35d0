"""When a weighted estimate must not be believed: effective sample size, the Pareto shape of the
greatest weights, and the rules made of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import chex


__all__ = ["pareto_k", "reasons"]

K_HAT, ESS, SHARE, PER_FAILURE, MATTERS, FEW, PART = 0.7, 100, 0.05, 0.01, 0.02, 30, 0.5


def pareto_k(log_weights: chex.Array, samples: int, failures: int | None = None) -> float:
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
        equal.

    Example:
        >>> import numpy as np, jast
        >>> heavy = 0.9 * np.random.default_rng(0).exponential(size=10000)  # Pareto, k = 0.9
        >>> 0.8 < jast.estimate.pareto_k(heavy, 10000) < 1.0
        True
    """
    log_w = np.sort(np.asarray(log_weights, np.float64))
    if np.isnan(log_w).any():
        return float("nan")
    log_w = log_w[log_w > -np.inf]
    failures = len(log_w) if failures is None else failures
    m = int(np.ceil(min(samples / 5, 3 * np.sqrt(samples), max(failures / 5, 5))))
    m = min(m, len(log_w) - 1)
    if m < 5:
        return float("nan")
    w = np.exp(log_w[-m - 1 :] - log_w[-1])
    excess = w[1:] - w[0]
    excess = excess[excess > 1e-9]
    if not excess.size:
        return float("-inf")
    if len(excess) >= 5:
        return _shape(excess)
    return float("-inf") if excess[-1] < w[0] else float("inf")  # a few above a crowd of equal ones


def _shape(x):
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


def by_mode(sums, groups):
    """(share of the estimate, effective sample size) of groups of components, greatest share first:
    [m], [m].
    """
    first = np.array([sums.by_component[g].sum() for g in groups])
    second = np.array([sums.squares[g].sum() for g in groups])
    order = np.argsort(-first, kind="stable")
    return (
        first[order] / sums.first,
        np.where(second > 0, first**2 / np.where(second > 0, second, 1), 0)[order],
    )


def thin_modes(shares, sizes, error):
    """Texts for the modes that few effective episodes speak for and that matter: also to the
    relative ``error`` of the whole.
    """
    if len(shares) < 2:
        return []
    return [
        f"a failure mode with {v:.1%} of the estimate has an effective sample size of only {n:.3g}"
        for v, n in zip(shares, sizes, strict=True)
        if v > MATTERS and n < FEW and v**2 > n * (PART * error) ** 2
    ]


def reasons(failures, ess, k_hat, max_share):
    """Why weights must not be trusted: a list of texts, empty where nothing speaks against them."""
    found = []
    if ess < ESS:
        found.append(f"effective sample size {ess:.3g}, below {ESS}")
    if np.isnan(k_hat):
        found.append(f"{failures} failures are too few to judge the tail of the weights")
    elif k_hat > K_HAT:
        found.append(
            f"Pareto k-hat {k_hat:.2f}, above {K_HAT}: the weights have so heavy a tail that their"
            " standard error cannot be trusted"
        )
    if max_share > SHARE:
        found.append(f"one episode carries {max_share:.0%} of the estimate, above {SHARE:.0%}")
    if ess < PER_FAILURE * failures:
        found.append(
            f"effective sample size {ess:.3g} is below {PER_FAILURE:.0%} of the {failures} failures"
        )
    return found
