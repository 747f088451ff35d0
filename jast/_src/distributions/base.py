"""What every distribution of jast is: a pytree with samples and log densities."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import PRNGKey
from jast._src.runtime._jax import is_traced

__all__ = [
    "Distribution",
    "Elementwise",
    "Wrapped",
    "as_key",
    "broadcast",
    "float_array",
    "is_distribution",
    "parameter_array",
    "tree_map",
]


class _Kind(type):
    """``isinstance(d, Distribution)`` holds for distrax's distributions, too, without a need to
    import distrax.
    """

    def __instancecheck__(cls, d: Any) -> bool:
        return super().__instancecheck__(d) or (
            cls is Distribution
            and any(
                c.__name__ == "Distribution" and c.__module__.partition(".")[0] == "distrax"
                for c in type(d).__mro__
            )
        )


class Distribution(metaclass=_Kind):
    """Base of jast's distributions, and of a user's own: a pytree whose leaves are the arrays among
    its attributes.

    A subclass defines ``event_shape`` (a pytree of shapes: that of one value),
    ``_sample_n(key, n)`` (n values on a new leading axis) and ``log_prob(value)``; where they
    exist, ``mode()``, and ``quantile(u)`` with ``cdf(x)``, its inverse.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> class Rayleigh(jast.distributions.Distribution):
        ...     event_shape = ()
        ...
        ...     def __init__(self, scale):
        ...         self.scale = jnp.asarray(scale)
        ...
        ...     def _sample_n(self, key, n):
        ...         return self.scale * jnp.sqrt(2 * jax.random.exponential(key, (n,)))
        ...
        ...     def log_prob(self, x):
        ...         return jnp.log(x) - 2 * jnp.log(self.scale) - (x / self.scale) ** 2 / 2
        >>> Rayleigh(2.0).sample(seed=0, sample_shape=5).shape
        (5,)
    """

    event_shape: Any

    def __new__(cls, *args: Any, **settings: Any) -> Distribution:
        _introduce()
        return super().__new__(cls)

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        jax.tree_util.register_pytree_node(cls, _flatten, lambda static, a: _build(cls, static, a))

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        raise NotImplementedError(f"{self.name} does not define _sample_n(key, n)")

    def log_prob(self, value: Any) -> jax.Array:
        """Log density of ``value``."""
        raise NotImplementedError(f"{self.name} does not define log_prob(value)")

    def prob(self, value: Any) -> jax.Array:
        """Density of ``value``."""
        return jnp.exp(self.log_prob(value))

    def sample(self, *, seed: Any, sample_shape: int | Sequence[int] = ()) -> Any:
        """Values of shape ``sample_shape + batch_shape + event_shape``, drawn with the key (or
        whole number) ``seed``.
        """
        if not isinstance(sample_shape, Sequence):
            sample_shape = (sample_shape,)
        shape = tuple(map(int, sample_shape))
        values = self._sample_n(as_key(seed), prod(shape))
        return jax.tree.map(lambda a: a.reshape(shape + a.shape[1:]), values)

    def sample_and_log_prob(self, *, seed: Any, sample_shape: int | Sequence[int] = ()) -> Any:
        """(`sample`, its log density)."""
        value = self.sample(seed=seed, sample_shape=sample_shape)
        return value, self.log_prob(value)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """The shape of a value in front of ``event_shape``; of a structure, of its first part."""
        like, shapes = _like(self), self.event_shape
        leaves, treedef = jax.tree.flatten(like)
        events = treedef.flatten_up_to(shapes) if shapes else [()] * len(leaves)
        parts = [a.shape[: a.ndim - len(e)] for a, e in zip(leaves, events, strict=True)]
        return parts[0] if parts else ()

    @property
    def dtype(self) -> Any:
        """The dtype of a value (a pytree of them where values are structures)."""
        return jax.tree.map(lambda a: a.dtype, _like(self))

    @property
    def name(self) -> str:
        return type(self).__name__


def _introduce() -> None:
    """Let distrax's containers take jast's distributions as parts, once somebody imported it."""
    global _introduced
    theirs = None if _introduced else getattr(sys.modules.get("distrax"), "Distribution", None)
    if theirs is not None:
        theirs.register(Distribution)
        _introduced = True


_introduced = False


def is_distribution(d: Any) -> bool:
    """Whether something is a distribution of jast or of distrax, or draws and scores as they do.

    Args:
        d: anything.

    Example:
        >>> from jast import distributions as D
        >>> D.is_distribution(D.Normal(0.0, 1.0)), D.is_distribution(0.0)
        (True, False)
    """
    return isinstance(d, Distribution) or (
        not isinstance(d, type)
        and callable(getattr(d, "sample", None))
        and callable(getattr(d, "log_prob", None))
    )


def tree_map(function: Callable[..., Any], distributions: Any, *rest: Any) -> Any:
    """``jax.tree.map`` over a structure whose leaves are distributions."""
    return jax.tree.map(function, distributions, *rest, is_leaf=is_distribution)


def as_key(seed: Any) -> PRNGKey:
    """The key of a ``seed``, which is one, or a whole number."""
    return jax.random.PRNGKey(seed) if isinstance(seed, (int, np.signedinteger)) else seed


def float_array(x: Any) -> Any:
    """``x`` as an array of floats; an array of floats is returned as it is.

    Raises:
        ValueError: of other numbers than integers and floats.
    """
    if not isinstance(x, (jax.Array, np.ndarray)):
        x = jnp.asarray(x)
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x
    if jnp.issubdtype(x.dtype, jnp.integer):
        return x.astype(float)
    raise ValueError(f"a distribution's numbers: expected floats or integers, received {x.dtype}")


def parameter_array(name: str, x: Any, low: Any = 0, high: float = np.inf) -> Any:
    """`float_array` of the parameter ``name``, such as "Poisson: rate".

    Raises:
        ValueError: where it is known, and some of it lies outside of [low, high].
    """
    array = float_array(x)
    if not is_traced(array, low, high):
        dtypes = [a.dtype for a in (array, low) if hasattr(a, "dtype")]
        coarse = min(dtypes, key=lambda dtype: dtype.itemsize)  # in which equal numbers are equal
        known = np.asarray(array, coarse)
        if not ((known >= np.asarray(low, coarse)) & (known <= high)).all():  # of NaN neither is
            bounded = np.isfinite(high).all()
            words = f"lie between {low} and {high}" if bounded else f"be at least {low}"
            raise ValueError(f"{name} must {words}, received {x}")
    return array


def _like(d: Distribution) -> Any:
    return jax.eval_shape(lambda: d.sample(seed=jax.random.PRNGKey(0)))


def _flatten(d: Distribution) -> tuple[list[Any], tuple[Any, ...]]:
    """Arrays (and what JAX puts in their place) are leaves; numbers, shapes, dtypes and functions
    are part of the structure.
    """
    leaves, treedef = jax.tree.flatten({k: v for k, v in vars(d).items() if k != "_known_numbers"})
    data = tuple(_is_data(a) for a in leaves)
    static = tuple(None if own else a for a, own in zip(leaves, data, strict=True))
    return [a for a, own in zip(leaves, data, strict=True) if own], (static, data, treedef)


def _build(cls: type, structure: tuple[Any, ...], arrays: Any) -> Any:
    static, data, treedef = structure
    arrays = iter(arrays)
    d = object.__new__(cls)
    leaves = [next(arrays) if own else a for a, own in zip(static, data, strict=True)]
    d.__dict__.update(treedef.unflatten(leaves))
    return d


def _is_data(x: Any) -> bool:
    return isinstance(x, (jax.Array, np.ndarray, np.generic)) or type(x) is object


class Elementwise(Distribution):
    """Of numbers one by one, by ``_parameters``, names of its attributes, which broadcast."""

    event_shape: Any = ()
    _known_numbers: tuple[float, ...] | None = None
    """The numbers it was made with, for `tables`; no transformation of JAX keeps them."""
    _parameters: tuple[str, ...]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return jax.lax.broadcast_shapes(*(getattr(self, name).shape for name in self._parameters))

    @property
    def dtype(self) -> Any:
        return jnp.result_type(*(getattr(self, name) for name in self._parameters))


def broadcast(name: str) -> Any:
    """A property of an `Elementwise`: the parameter ``name``, broadcast with the others."""
    return property(lambda d: jnp.broadcast_to(getattr(d, name), d.batch_shape))


class Wrapped(Distribution):
    """Of another ``distribution``, whose values have the same shapes."""

    def __init__(self, distribution: Any) -> None:
        self._distribution = distribution

    @property
    def event_shape(self) -> Any:
        return self._distribution.event_shape

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self._distribution.batch_shape

    def log_prob(self, value: Any) -> jax.Array:
        return self._distribution.log_prob(value)
