"""Where the probability of failure crosses a level, between the rows of a sweep."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

__all__ = ["Crossing", "crossing"]


class Crossing(NamedTuple):
    """Where the probability of failure crosses ``level``.

    Example:
        >>> import jax, jast
        >>> make = lambda threshold: jast.simulators.walk1d(threshold=threshold)
        >>> table = jast.sweep(
        ...     jax.random.key(0), make, {"threshold": [8.0, 12.0]}, jast.nominal, episodes=500
        ... )
        >>> crossing = table.crossing(0.1)
        >>> crossing.interval[0] < crossing.value < crossing.interval[1]
        True
    """

    name: str
    """Of the setting."""
    value: float
    """By interpolation of the normal scores of probabilities."""
    interval: tuple[float, float]
    """Where the intervals of the rows, interpolated in several ways, hold ``level``
    (`Sweep.crossing`); infinite where they still do at the last value of the sweep
    """
    level: float

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.name} {self.value:.6g} [{low:.6g}, {high:.6g}] at probability {self.level:g}"


def crossing(
    name: str, x: np.ndarray, answers: np.ndarray, used: np.ndarray, level: float
) -> Crossing:
    """Where the probability crosses ``level``, of rows at ``x`` [N] of the setting ``name`` with
    ``answers`` [N, 3], a probability and the ends of its interval; those ``used`` [N] serve.
    ValueError as of `Sweep.crossing`.
    """
    p = answers[:, 0]
    used = used & np.isfinite(x) & (p > 0)
    rows = np.flatnonzero(used)[np.argsort(x[used], kind="stable")]
    if len(rows) < 2:
        raise ValueError(
            "crossing: expected at least two rows with a reliable probability, received"
            f" {len(rows)} of {len(x)}; unreliable=True also uses the others"
        )
    x, bands = x[rows], answers[rows].T
    scores = _score(bands[0]) - _score(level)
    if not (at := _zeros(x, scores)):
        raise ValueError(
            f"crossing: the probability does not cross {level:g}: for {name} from {x[0]:.6g}"
            f" to {x[-1]:.6g} it lies between {p[rows].min():.3g} and {p[rows].max():.3g}"
        )
    (left, right), wider = (_zone(x, bands, level, f) for f in (_score, np.log))
    left, right = min(left, wider[0]), max(right, wider[1])
    if at[-1] > right:
        places = ", ".join(f"{v:.6g}" for v in at)
        raise ValueError(
            f"crossing: the probability crosses {level:g} at several values of {name}: {places}"
        )
    bends = _bends(x, scores)
    interval = min([left, *bends]), max([right, *bends])
    return Crossing(name, (at[0] + at[-1]) / 2, interval, level)


def _score(p):
    """The normal score of p, rising; of 1 as of the greatest float below it, to be finite."""
    from scipy.special import ndtri  # here: slow to import

    return ndtri(np.minimum(p, 1 - 2.0**-53))


def _zone(x, bands, level, scale):
    """The nearest places on both sides of where p crosses ``level``, at which an end of its
    interval does, by straight lines of ``scale(p)``; ``bands``: p and the ends of its intervals.
    """
    with np.errstate(divide="ignore"):
        at, *ends = (_zeros(x, scale(a) - scale(level)) for a in bands)
    ends = [*ends[0], *ends[1]]
    left = max((e for e in ends if e <= at[0]), default=-math.inf)
    return left, min((e for e in ends if e >= at[0]), default=math.inf)


def _bends(x, y):
    """Where the line through (x, y) is 0 if it goes on between two points, one above 0 and one
    below, as it came to either of them; at the other one where it does not come to 0 before.
    """
    out = []
    for i in np.flatnonzero((y[1:] < 0) != (y[:-1] < 0)):
        for before, near, far in ((i - 1, i, i + 1), (i + 2, i + 1, i)):
            if 0 <= before < len(x) and x[before] != x[near]:
                gap = x[far] - x[near]
                rise = (y[near] - y[before]) / (x[near] - x[before]) * gap
                share = min(-y[near] / rise, 1) if y[near] * rise < 0 else y[near] != 0
                out.append(float(x[near] + share * gap))
    return out


def _zeros(x, y):
    """Where the line through (x, y) is 0, x rising; from a y of -inf on, at the finite end."""
    out = []
    for x0, x1, a, b in zip(x, x[1:], y, y[1:]):
        if (a < 0) != (b < 0):
            share = 1.0 if a == -math.inf else 0.0 if b == -math.inf else a / (a - b)
            out.append(float(x0 + share * (x1 - x0)))
    return out
