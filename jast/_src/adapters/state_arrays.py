"""What an environment returns as what a state of a `Simulator` may hold, and back."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.util.pytrees import Key

__all__ = ["as_numbers", "in_dtypes_of", "refuse_warp", "with_keys"]


def as_numbers(tree: Any) -> Any:
    """Arrays of ``tree``, with typed keys as `Key`."""

    def number(a: Any) -> Any:
        a = jnp.asarray(a)
        typed = jnp.issubdtype(a.dtype, jax.dtypes.prng_key)
        return Key(jax.random.key_data(a)) if typed else a

    return jax.tree.map(number, tree)


def with_keys(tree: Any) -> Any:
    """``tree`` as the environment knows it."""

    def made(a: Any) -> Any:
        return jax.random.wrap_key_data(a.data) if isinstance(a, Key) else a

    return jax.tree.map(made, tree, is_leaf=lambda a: isinstance(a, Key))


def in_dtypes_of(tree: Any, like: Any) -> Any:
    """``tree`` in the dtypes of ``like``: many environments return others than at the start. Floats
    never become whole numbers.
    """

    def cast(a: Any, b: jax.Array) -> jax.Array:
        same = np.can_cast(jnp.asarray(a).dtype, b.dtype, "same_kind")
        return jnp.asarray(a, b.dtype if same else None)

    return jax.tree.map(cast, tree, like)


def refuse_warp(name: str, model: Any, instead: str) -> None:
    """Refuses a model of MuJoCo whose data are shared by all episodes under `jax.vmap`."""
    if getattr(getattr(model, "impl", None), "value", None) == "warp":
        raise ValueError(
            f"{name}: the physics are those of Warp, which keeps one memory for all episodes;"
            f" expected those of JAX: {instead}"
        )
