"""What rules and monitors share: scikit-learn where it is installed, and episodes held out."""

import importlib
from typing import Any

import numpy as np

__all__ = ["learner", "parted"]

DISTINCT = 4
"""Groups of a class below which its episodes are parted one by one."""


def learner(function: str, module: str) -> Any:
    """A module of scikit-learn.

    Raises:
        ImportError: where it is not installed.
    """
    try:
        return importlib.import_module(f"sklearn.{module}")
    except ImportError as error:
        raise ImportError(
            f"{function} learns with scikit-learn: pip install 'jast[explain]'"
        ) from error


def parted(
    rng: np.random.Generator, owner: np.ndarray, group: np.ndarray, share: float
) -> np.ndarray:
    """Which episodes [n] are held out: of each class ``owner`` [n] at most a ``share``, by groups
    drawn at random, so that all episodes of a ``group`` [n] are on one side; one group at least.
    """
    out = np.zeros(len(owner), bool)
    for k in np.unique(owner):
        groups, sizes = np.unique(group[owner == k], return_counts=True)
        most, taken = share * sizes.sum(), 0
        chosen = []
        for i in rng.permutation(len(groups)):
            if taken + sizes[i] <= most:
                chosen.append(groups[i])
                taken += sizes[i]
        chosen = chosen or [groups[np.argmin(sizes)]]
        out |= (owner == k) & np.isin(group, chosen)
    return out
