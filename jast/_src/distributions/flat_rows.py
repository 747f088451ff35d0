"""A value of any structure as one row of numbers, and back; or of one number throughout."""

import math
from typing import Any

import jax
import jax.numpy as jnp

from jast._src.distributions.normal_tails import float_dtype

__all__ = ["filled", "flat", "split", "unflat"]


def flat(x: Any) -> jax.Array:
    """[d] float32: a disturbance, or a point of its unit cube, as one row of numbers."""
    return jnp.concatenate([jnp.ravel(a).astype(jnp.float32) for a in jax.tree.leaves(x)])


def split(row: jax.Array, event: Any) -> Any:
    """The numbers ``row`` [d] in the shapes of ``event``."""
    leaves, treedef = jax.tree.flatten(event)
    out, at = [], 0
    for s in leaves:
        n = math.prod(s.shape)
        out.append(row[at : at + n].reshape(s.shape))
        at += n
    return treedef.unflatten(out)


def unflat(u: jax.Array, event: Any) -> Any:
    """Inverse of `flat` for a point of the unit cube: ``u`` [d] in the shapes of ``event``, as
    floats.
    """
    return jax.tree.map(lambda a, s: a.astype(float_dtype(s.dtype)), split(u, event), event)


def filled(event: Any, value: float, *rows: int) -> Any:
    """Floats [*rows, ...] of one ``value`` in the shapes of ``event``."""
    return jax.tree.map(lambda s: jnp.full((*rows, *s.shape), value, float_dtype(s.dtype)), event)
