"""Tables of evenly spaced places, read between their rows."""

from typing import Any

import jax.numpy as jnp

__all__ = ["along"]


def along(table: Any, place: Any) -> Any:
    """The rows of ``table`` [n, ...] at ``place``, counted in rows: straight between two, and
    beyond the first and the last.
    """
    table = jnp.asarray(table, place.dtype)
    low = jnp.clip(jnp.floor(place), 0, len(table) - 2)
    row = low.astype(jnp.int32)
    return table[row] + (place - low) * (table[row + 1] - table[row])
