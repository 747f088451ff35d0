"""Small functions of pytrees of arrays that several rooms need."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

__all__ = [
    "Key",
    "as_partial",
    "count_numbers",
    "conform",
    "fields_of",
    "index_tree",
    "join_rows",
    "map_in_lanes",
    "merge_axes",
    "pad_rows",
    "select",
    "select_rows",
    "shapes_text",
    "with_strong_types",
    "traceable",
    "with_rows_of",
    "zero_where",
]


class Key(NamedTuple):
    """A typed random key as numbers, which is what a state may hold."""

    data: jax.Array


def with_strong_types(tree: Any) -> Any:
    """Arrays of explicit dtype: a weak type would change on its way through a step."""
    return jax.tree.map(lambda a: lax.convert_element_type(a, jnp.result_type(a)), tree)


def as_partial(function: Callable) -> Partial:
    """``function`` as a pytree of the arguments that it binds."""
    return function if isinstance(function, Partial) else Partial(function)


def traceable(function: Partial) -> Partial:
    """``function`` itself, or where there are functions among the leaves of its arguments, the same
    with these as a part of the function: JAX traces arguments, and a function cannot be traced.
    """
    given = function.args, function.keywords
    if not any(map(callable, jax.tree.leaves(given))):
        return function
    functions = jax.tree.map(lambda a: a if callable(a) else None, given)
    others = jax.tree.map(lambda a: None if callable(a) else a, given)
    return Partial(_WithFunctions(function.func, functions), *others)


@dataclass(frozen=True, eq=False)
class _WithFunctions:
    """A function, and the functions among the leaves of its arguments; equal where these are."""

    function: Callable
    static: tuple[Any, Any]
    """(args, keywords) with None where JAX traces."""

    def __call__(self, args: tuple, keywords: dict, *more: Any) -> Any:
        args, keywords = jax.tree.map(
            lambda a, b: b if a is None else a,
            (args, keywords),
            self.static,
            is_leaf=lambda a: a is None,
        )
        return self.function(*args, *more, **keywords)

    def _parts(self) -> tuple:
        leaves, tree = jax.tree.flatten(self.static)
        return self.function, *leaves, tree

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _WithFunctions) and self._parts() == other._parts()

    def __hash__(self) -> int:
        return hash(self._parts())


def select(pred: Any, a: Any, b: Any) -> Any:
    """``a`` where the scalar ``pred`` holds, else ``b``."""
    return jax.tree.map(lambda x, y: jnp.where(pred, x, y), a, b)


def select_rows(pred: Any, a: Any, b: Any) -> Any:
    """Rows [n, ...] of ``a`` where ``pred`` [n] holds, else of ``b``."""
    return jax.vmap(select)(pred, a, b)


def index_tree(tree: Any, where: Any) -> Any:
    """Each array of ``tree`` at ``where``: a number, rows, a mask, or a slice (`numpy.s_`)."""
    return jax.tree.map(lambda a: a[where], tree)


def join_rows(*trees: Any) -> Any:
    """The rows of trees of arrays, those of the first tree first. On the host."""
    return jax.tree.map(lambda *a: np.concatenate(a), *trees)


def merge_axes(tree: Any) -> Any:
    """The first two axes of each array as one: [n, m, ...] as [n m, ...]."""
    return jax.tree.map(lambda a: a.reshape(a.shape[0] * a.shape[1], *a.shape[2:]), tree)


def with_rows_of(like: jax.Array, tree: Any) -> Any:
    """``tree``, the carry that a loop starts with, of which every array depends on the numbers
    ``like``, for `jax.vmap` and for derivatives; the values are the same.

    JAX batches and differentiates the body of a loop again and again until it knows which arrays of
    the carry depend on what it maps over: here all do, as soon as episodes end one by one.
    """
    first = jnp.ravel(like)[0]  # never greater than itself

    def tie(a: jax.Array) -> jax.Array:
        moves = all(jnp.issubdtype(b.dtype, jnp.floating) for b in (a, first))
        return jnp.where(first > first, a + first.astype(a.dtype) if moves else a, a)

    return jax.tree.map(tie, tree)


def zero_where(pred: Any, tree: Any) -> Any:
    """Zeros where the scalar ``pred`` holds, else ``tree``."""
    return jax.tree.map(lambda a: jnp.where(pred, jnp.zeros((), a.dtype), a), tree)


def pad_rows(rows: Any, length: int) -> Any:
    """``rows`` [T, ...] with zeros behind them, [length, ...]; those of that length as they are."""

    def longer(a: Any) -> Any:
        if len(a) == length:
            return a
        return jnp.zeros((length, *a.shape[1:]), a.dtype).at[: len(a)].set(a)

    return jax.tree.map(longer, rows)


def map_in_lanes(size: int, function: Callable, *trees: Any) -> Any:
    """``function`` of arrays [n, ...], n from 1 on, which goes on them row by row, ``size`` rows at
    a time. The last part is filled up with rows again, so one program serves every n. On the host.
    """
    n = len(jax.tree.leaves(trees)[0])
    parts = (np.arange(-(-n // size) * size) % n).reshape(-1, size)
    found = [
        function(*jax.tree.map(lambda a, rows=rows: np.asarray(a)[rows], trees)) for rows in parts
    ]
    return index_tree(join_rows(*jax.device_get(found)), np.s_[:n])


def fields_of(record: Any) -> dict[str, Any]:
    """The fields of a NamedTuple or of a dataclass."""
    if isinstance(record, tuple):
        return record._asdict()
    return {f.name: getattr(record, f.name) for f in fields(record)}


def count_numbers(like: Any) -> int:
    """How many numbers ``like``, arrays or their shapes, holds."""
    return sum(math.prod(jnp.shape(leaf)) for leaf in jax.tree.leaves(like))


def conform(name: str, value: Any, like: Any) -> Any:
    """``value`` as arrays of the shapes and dtypes of ``like``.

    Raises ValueError, which calls it ``name``, for another structure or shape, and for floats where
    integers belong.
    """

    def refusal() -> ValueError:
        return ValueError(f"{name} must be {shapes_text(like)}, received {shapes_text(value)}")

    def fit(v: Any, s: Any) -> jax.Array:
        v = jnp.asarray(v)
        kinds = [jnp.issubdtype(d, jnp.floating) for d in (v.dtype, s.dtype)]
        if v.shape != s.shape or (kinds[0] and not kinds[1]):
            raise refusal()
        return v.astype(s.dtype)

    if jax.tree.structure(value) != jax.tree.structure(like):
        raise refusal()
    return jax.tree.map(fit, value, like)


def shapes_text(tree: Any) -> str:
    """Dtypes and shapes of the arrays of ``tree``, for messages."""
    return str(jax.tree.map(lambda a: f"{jnp.result_type(a)}{list(jnp.shape(a))}", tree))
