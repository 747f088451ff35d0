"""What populations say, and whether they agree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jast.estimate.descents import Descent
from jast.intervals import clopper_pearson

__all__ = ["APART", "BLUNT", "Answer", "Kind", "against", "answer_of", "pooled", "told"]

APART = 3.0
"""Standard errors of their difference within which two ways agree: chance parts one of 370."""
BLUNT = 0.3
"""Relative standard error above which a way witnesses nothing."""
SURE = 1e-4
"""One minus the level of the interval of the plain draws that an answer must lie in."""
INVALID = 0.01
"""Part of an answer that invalid episodes may add, if they failed."""
REPEATED = 4
"""Populations from which on their spread speaks beside what their genealogies say."""


class Answer(NamedTuple):
    """What populations of one kind say."""

    log_mean: float
    relative: float
    """Relative standard error"""

    def apart(self, other: Answer) -> float:
        """The difference of two logarithms in its standard errors."""
        return abs(self.log_mean - other.log_mean) / math.hypot(self.relative, other.relative)

    def __str__(self) -> str:
        return f"{math.exp(self.log_mean):.3g} +- {self.relative:.1%}"


class Kind(NamedTuple):
    """A way down, and how often a point moves between two levels."""

    way: str
    moves: int

    def __str__(self) -> str:
        return f"by {self.way}, {self.moves} moves"


def answer_of(runs: Sequence[Descent]) -> Answer | None:
    """The `Answer` of populations of one kind; None where none of them reached a failure."""
    logs = np.array([float(r.log_mean) for r in runs])
    if not np.isfinite(logs).any():
        return None
    sizes = np.array([float(r.size) for r in runs])
    top, share, n = logs.max(), sizes / sizes.sum(), len(logs)
    p = np.exp(logs - top)
    mean = share @ p
    own = np.where(p > 0, np.array([float(r.variance) for r in runs]), 0)
    variance = share**2 @ (own * p**2)
    if n >= REPEATED or (n > 1 and not (p > 0).all()):
        variance = max(variance, share**2 @ (p - mean) ** 2 * n / (n - 1))
    return Answer(top + math.log(mean), math.sqrt(variance) / mean)


def pooled(answers: Sequence[Answer]) -> Answer:
    """Answers as one, by their variances."""
    weights = np.array([a.relative**-2 for a in answers])
    weights /= weights.sum()
    logs = np.array([a.log_mean for a in answers])
    top = logs.max()
    return Answer(
        top + math.log(weights @ np.exp(logs - top)),
        math.sqrt(sum((w * a.relative) ** 2 for w, a in zip(weights, answers, strict=True))),
    )


def against(exact: Answer, plain: tuple[int, int, int]) -> list[str]:
    """What the model's own draws, (failing, invalid, all), say against an answer."""
    reasons, (failing, invalid, drawn) = [], plain
    low, high = clopper_pearson(failing, drawn, 1 - SURE)
    if not low <= math.exp(exact.log_mean) <= high:
        reasons.append(
            f"plain draws say otherwise: {failing} of {drawn} fail, so the probability lies"
            f" between {low:.3g} and {high:.3g}"
        )
    if (share := invalid / drawn) > INVALID * math.exp(exact.log_mean):
        reasons.append(
            f"{share:.2g} of the model's own episodes are invalid (a number that is not finite),"
            " which counts as not failing"
        )
    return reasons


def told(kind: Kind, r: Descent) -> str:
    """A population in words."""
    levels = ", ".join(f"{v:.4g}" for v in r.levels[-3:])
    said = f"{len(r.levels)} {'levels' if kind.way == 'distance' else 'widths'}"
    if len(r.levels):
        said += f", the last {levels}"
    if np.isfinite(r.log_mean):
        end = f"log p {r.log_mean:.3f}, relative standard error {math.sqrt(r.variance):.2g}"
    else:
        end = "no failure reached"
    return f"population {kind}: {said}; {end}; {r.evaluations} evaluations"
