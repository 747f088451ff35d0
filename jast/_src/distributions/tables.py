"""Values of families that are solved for, from a table, where their shapes are numbers that are
known before a program is compiled: a solver takes a hundred times as long, in every program that
has a step in it, and some seconds more to compile. SciPy fills the tables, in double precision.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.runtime._jax import is_traced

__all__ = ["REACH", "interpolated", "numbers", "serves", "tail"]

REACH = 12
"""Normal number at which a table ends: at 12.9 float32 has no tail left."""
PER_UNIT = 64
"""Nodes a unit: cubics between them are as exact as rounding in float32."""


def numbers(*values: Any) -> tuple[float, ...] | None:
    """The values as Python's floats, where they are single finite numbers that are known."""
    if is_traced(values) or any(np.ndim(v) for v in values):
        return None
    known = tuple(map(float, values))
    return known if all(map(math.isfinite, known)) else None


def serves(known: tuple[float, ...] | None, z: jax.Array) -> bool:
    """Whether a table can be made, and is exact enough for ``z``."""
    return known is not None and jnp.result_type(z) == jnp.float32


def interpolated(
    values: Callable[..., np.ndarray], known: tuple[float, ...], z: jax.Array
) -> jax.Array:
    """``values(*known, z)``, a smooth function of arrays on the host, by cubics between nodes
    (Hermite); with derivatives.
    """
    table = jnp.asarray(_table(values, known))
    at = jnp.clip(z, -REACH, REACH) * PER_UNIT
    before = jnp.minimum(jnp.floor(at), REACH * PER_UNIT - 1)
    i = (before + REACH * PER_UNIT).astype(jnp.int32)
    here, there = (jnp.take(table, j, axis=0, mode="clip") for j in (i, i + 1))
    y, slope, f = here[..., 0], here[..., 1], at - before
    rise, bend = there[..., 0] - y, slope + there[..., 1]
    return y + f * (slope + f * (3 * rise - slope - bend + f * (bend - 2 * rise)))


@functools.lru_cache(maxsize=256)
def _table(values, known):
    """Values at the nodes, and their differences of fourth order, [nodes, 2]."""
    z = np.arange(-REACH * PER_UNIT - 2, REACH * PER_UNIT + 3) / PER_UNIT
    y = values(*known, z)
    slope = np.convolve(y, [-1, 8, 0, -8, 1], mode="valid") / 12
    return np.stack([y[2:-2], slope], axis=-1).astype(np.float32)


def tail(z: np.ndarray) -> np.ndarray:
    """The probability beyond ``z``, on its side of 0."""
    from scipy.special import ndtr

    return ndtr(-np.abs(z))
