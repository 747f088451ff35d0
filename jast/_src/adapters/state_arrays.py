"""What an environment returns as what a state of a `Simulator` may hold, and back."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.runtime._jax import is_traced, is_tracing
from jast._src.util.pytrees import Key

__all__ = ["as_numbers", "free_to_move", "in_dtypes_of", "refuse_warp", "with_keys"]


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


def free_to_move(tree: Any) -> Any:
    """``tree`` with arrays that were put on the default device as if they had come there by
    themselves. What JAX computes from an array that was put somewhere counts as put there, too, and
    a program is compiled once for such arguments and once for others: MuJoCo puts its models.
    """

    def free(a: Any) -> Any:
        put = isinstance(a, jax.Array) and not is_traced(a) and a.committed
        typed = put and jnp.issubdtype(a.dtype, jax.dtypes.prng_key)
        if not put or typed or a.devices() != jnp.zeros(()).devices():
            return a
        new = jnp.asarray(np.asarray(a))
        same = (new.dtype, new.weak_type) == (a.dtype, a.weak_type)
        return new if same else a

    return tree if is_tracing() else jax.tree.map(free, tree)


def refuse_warp(name: str, model: Any, instead: str) -> None:
    """Refuses a model of MuJoCo whose data are shared by all episodes under `jax.vmap`."""
    if getattr(getattr(model, "impl", None), "value", None) == "warp":
        raise ValueError(
            f"{name}: the physics are those of Warp, which keeps one memory for all episodes;"
            f" expected those of JAX: {instead}"
        )
