"""What rules and monitors share: scikit-learn where it is installed, and episodes held out."""

from typing import Any

import numpy as np

from jast._src.util.checks import import_library
from jast._src.util.intervals import clopper_pearson

__all__ = ["DISTINCT", "hold_out", "share_of", "sklearn_module"]

DISTINCT = 4  # episodes of a class, the least


def sklearn_module(function: str, module: str) -> Any:
    """A module of scikit-learn; ImportError where it is not installed."""
    return import_library(function, f"sklearn.{module}", "explain")


def hold_out(
    rng: np.random.Generator, owner: np.ndarray, group: np.ndarray, share: float
) -> np.ndarray:
    """Which episodes [n] are held out: of each class ``owner`` [n] about a ``share``, by groups
    drawn at random, so that all episodes of a ``group`` [n] are on one side; one group at least.
    """
    side: dict[int, bool] = {}
    for k in np.unique(owner)[::-1]:
        groups, sizes = np.unique(group[owner == k], return_counts=True)
        taken = sum(n for g, n in zip(groups, sizes) if side.get(g, False))
        for i in rng.permutation(len(groups)):
            if groups[i] not in side:
                side[groups[i]] = bool(taken + sizes[i] <= share * sizes.sum())
                taken += side[groups[i]] * sizes[i]
        if not taken:
            side[groups[np.argmin(sizes)]] = True
    return np.array([side[g] for g in group])


def share_of(part: int, whole: int, level: float) -> tuple[float, tuple[float, float]]:
    """The share ``part`` of ``whole``, with its interval; NaN of nothing."""
    if not whole:
        return float("nan"), (0.0, 1.0)
    return part / whole, clopper_pearson(part, whole, level)
