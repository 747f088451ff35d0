"""Least and greatest of a signal over sliding windows, by doubling: O(T log T), differentiable.

A signal [T] is continued beyond its end by one value, which says what a window finds there. Exact
operations and soft ones (a temperature) take the same way.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.util.pytrees import index_tree

__all__ = ["Pair", "exact", "over", "soft", "until"]


class Pair(NamedTuple):
    """The least and the greatest of two numbers."""

    least: Callable[[Any, Any], Any]
    most: Callable[[Any, Any], Any]
    overlap: bool
    """A number may be counted twice."""


exact = Pair(jnp.minimum, jnp.maximum, True)


def soft(temperature: Any) -> Pair:
    """Least and greatest smoothed: -t log(sum exp(-x / t)), t log(sum exp(x / t))."""

    def most(a, b):
        return temperature * jnp.logaddexp(a / temperature, b / temperature)

    return Pair(lambda a, b: -most(-a, -b), most, False)


def over(op: Callable, x: Any, first: int, last: int, beyond: Any, overlap: bool) -> Any:
    """``op`` of x[t + first], .., x[t + last] for each t, [T]; ``x`` is an array or a pytree of
    them, each continued by its number in ``beyond``. ``op`` is associative.
    """
    size = jax.tree.leaves(x)[0].shape[0]
    # beyond the end all is the same: one number of it is enough
    first = min(first, size)
    width = min(last - first, size) + 1
    rows = size + width - 1
    y, n = jax.tree.map(partial(_continued, rows, first), x, beyond), 1

    def cut(y, start, length):
        return index_tree(y, np.s_[start : start + length])

    found, done = None, 0
    while True:  # y[t] is that of the n numbers from t on
        if overlap and 2 * n > width:
            return op(cut(y, 0, size), cut(y, width - n, size))
        if not overlap and width & n:
            part = cut(y, done, size)
            found, done = part if found is None else op(found, part), done + n
        if 2 * n > width:
            return found
        rows, y = rows - n, op(cut(y, 0, rows - n), cut(y, n, rows - n))
        n *= 2


def until(pair: Pair, f: Any, g: Any, first: int, last: int, beyond: Any) -> Any:
    """The greatest over k in first..last of the least of g[t + k] and f[t], .., f[t + k], for each
    t, [T]. ``beyond``: what f and g are beyond the end.
    """

    def op(a, b):  # (least of f, until) of two stretches, one after the other
        return pair.least(a[0], b[0]), pair.most(a[1], pair.least(a[0], b[1]))

    both = f, pair.least(f, g)
    ends = beyond[0], jnp.minimum(*beyond)
    # stretches that overlap do no harm: what they share counts in the first, and less in the second
    _, found = over(op, both, first, last, ends, pair.overlap)
    if first:
        found = pair.least(over(pair.least, f, 0, first - 1, beyond[0], pair.overlap), found)
    return found


def _continued(rows: int, first: int, a: Any, beyond: Any) -> Any:
    rest = jnp.broadcast_to(jnp.asarray(beyond, a.dtype), (rows - a.shape[0] + first,))
    return jnp.concatenate([a[first:], rest])
