"""Tables of evenly spaced places: read from a file, and between their rows."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

__all__ = ["along", "read"]


def read(name: str) -> dict[str, Any]:
    """What is in the JSON file ``name`` beside this one; its lists are arrays of float64."""
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    return json.loads(text, object_hook=_arrays)


def _arrays(given: dict[str, Any]) -> dict[str, Any]:
    return {k: v if isinstance(v, dict) else np.array(v, np.float64) for k, v in given.items()}


def along(table: Any, place: Any) -> Any:
    """The rows of ``table`` [n, ...] at ``place``, counted in rows: straight between two, and
    beyond the first and the last.
    """
    table = jnp.asarray(table, place.dtype)
    low = jnp.clip(jnp.floor(place), 0, len(table) - 2)
    row = low.astype(jnp.int32)
    return table[row] + (place - low) * (table[row + 1] - table[row])
