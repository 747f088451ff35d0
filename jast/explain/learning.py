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
    """Which episodes [n] are held out: a ``share`` of the groups of each class ``owner`` [n], so
    that all episodes of a ``group`` [n] are on one side.

    Of each class at least one group is held out, and one is not.
    """
    out = np.zeros(len(owner), bool)
    for k in np.unique(owner):
        groups = rng.permutation(np.unique(group[owner == k]))
        many = min(max(int(round(share * len(groups))), 1), len(groups) - 1)
        out |= (owner == k) & np.isin(group, groups[:many])
    return out
