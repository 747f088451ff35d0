"""The mean of independent repetitions, and how far it is to be believed."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jast._src.util.intervals import log_normal, student_factor

__all__ = ["LOST_MODE_REMARK", "MIN_REPLICATES", "mean_of_replicates"]

LOST_MODE_REMARK = (
    "a failure mode that few members of a population reach can be lost without a sign"
)
MIN_REPLICATES = 3
"""Repetitions at least: their spread is the standard error."""
MAX_REPLICATE_ERROR = 0.5
"""Relative standard error of the repetitions above which they disagree. A convention."""


class Replicates(NamedTuple):
    """What independent repetitions say together."""

    log_mean: float
    """NaN where none of them reached a failure"""
    relative: float
    """Relative standard error, by their spread"""
    interval: tuple[float, float]
    ess: float
    max_share: float
    reasons: tuple[str, ...]
    """Why it must not be believed"""


def mean_of_replicates(logs: Sequence[float], what: str, level: float) -> Replicates:
    """`Replicates` of the logarithms of their estimates, -inf where one reached no failure;
    ``what`` they are called.
    """
    logs, n = np.asarray(logs, float), len(logs)
    seen, reasons = int(np.isfinite(logs).sum()), []
    if seen < n:
        reasons.append(f"{n - seen} of {n} {what} reached no failure")
    if not seen:
        return Replicates(math.nan, math.nan, (0.0, 1.0), 0.0, math.nan, tuple(reasons))
    if n == 1:
        reason = f"only one of the {what} tells it"
        return Replicates(float(logs[0]), math.inf, (0.0, 1.0), 1.0, 1.0, (reason,))
    p = np.exp(logs - logs.max())
    log_mean = float(logs.max()) + math.log(p.mean())
    relative = float(p.std(ddof=1) / math.sqrt(n) / p.mean())
    # few repetitions: Student's t in place of the normal quantile, as a wider error
    interval = log_normal(log_mean, relative * student_factor(n - 1, level), level)
    if relative > MAX_REPLICATE_ERROR:
        reasons.append(f"the {what} disagree: relative standard error {relative:.0%}")
    ess, share = float(p.sum() ** 2 / (p**2).sum()), float(p.max() / p.sum())
    return Replicates(log_mean, relative, interval, ess, share, tuple(reasons))
