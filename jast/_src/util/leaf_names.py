"""What the numbers of a user's pytrees are called: one naming for tables, pages and pictures."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.tree_util import SequenceKey

__all__ = ["Field", "leaf_name", "entry_places", "named_fields", "named_numbers", "path_name"]


class Field(NamedTuple):
    """The numbers of one array of a pytree."""

    name: str
    """Its place in the pytree, as "car.speed"; what the whole is called where that is one array"""
    entries: list[str]
    """[k] the place of each number in the array, as "[0]" or "[1, 2]"; "" of a scalar"""
    values: np.ndarray
    """[..., k] float64"""


def leaf_name(path: tuple, root: str) -> str:
    """The name of the leaf at ``path`` of a pytree that is called ``root``: "car.speed" in named
    tuples and dicts, "x.0" in plain tuples, ``root`` itself where it is the whole.
    """
    name = path_name(path)
    numbered = bool(path) and isinstance(path[0], SequenceKey)
    return f"{root}.{name}" if numbered else name or root


def path_name(path: tuple) -> str:
    """``path`` in words: "car.speed", "0"; "" for the whole."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def entry_places(shape: tuple) -> list[str]:
    """The place of each number in an array of ``shape``, row by row."""
    return [str(list(at)) if at else "" for at in np.ndindex(*shape)]


def named_fields(tree: Any, root: str, lead: int = 1) -> list[Field]:
    """The `Field` of each array of numbers in ``tree`` [..., ...], whose first ``lead`` axes are of
    steps or episodes. What holds no numbers (random keys, arrays of size 0) is left out.
    """
    found = []
    for path, a in jax.tree_util.tree_leaves_with_path(tree):
        if jax.dtypes.issubdtype(getattr(a, "dtype", float), jax.dtypes.prng_key):
            continue
        a = np.asarray(a)
        number = a.dtype.kind in "fiub" or np.can_cast(a.dtype, float, "same_kind")
        if not a.size or not number:
            continue
        flat = a.reshape(*a.shape[:lead], -1).astype(float)
        found.append(Field(leaf_name(path, root), entry_places(a.shape[lead:]), flat))
    return found


def named_numbers(tree: Any, root: str, lead: int = 1) -> Iterator[tuple[str, np.ndarray]]:
    """(name, values) of each number of the arrays of `named_fields`: "speed", "position[0]"."""
    for name, entries, values in named_fields(tree, root, lead):
        for i, entry in enumerate(entries):
            yield name + entry, values[..., i]
