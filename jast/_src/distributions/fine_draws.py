"""Draws in float32 whose rare values have their probabilities.

JAX makes a float32 of 23 of a word's 32 random bits, so that probabilities are multiples of 2^-23:
a normal number above 5 comes .83 times as often as it should, one below -5 1.25 times, an event of
1e-6 .95 or 1.07 times. Here the outermost 2^-15 on either side is placed by all 32 bits; every
other draw is JAX's, and so are all of other dtypes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import Array, PRNGKey

__all__ = [
    "bernoulli",
    "categorical",
    "exponential",
    "gumbel",
    "laplace",
    "logistic",
    "normal",
    "uniform",
]

OUTERMOST = 2**17
"""Of the 2^32 words so many on either side: a part of 2^-15. Nearer the middle JAX is off by .4 %
at most."""
NORMAL_TAIL = 2.450598e-5, -8.560246e-4, 0.01259107, -0.1011611, 1.485857, -1.535392
"""For `jnp.polyval`: z as a polynomial of (-2 log p)^.5, p from 2^-33 to 2^-15; least squares at
Chebyshev's points, within 6e-7."""


def normal(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.normal`."""

    def above(p):
        return jnp.polyval(jnp.asarray(NORMAL_TAIL, p.dtype), jnp.sqrt(-2 * jnp.log(p)))

    z = jax.random.normal(key, shape, dtype)
    return _with_tails(key, z, lambda p: -above(p), above)


def exponential(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.exponential`."""
    e = jax.random.exponential(key, shape, dtype)
    return _with_tails(key, e, lambda p: -jnp.log1p(-p), lambda p: -jnp.log(p))


def gumbel(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.gumbel`."""
    v = jax.random.gumbel(key, shape, dtype, mode="low")

    def above(p):
        return -jnp.log(-jnp.log1p(-p))

    return _with_tails(key, v, lambda p: -jnp.log(-jnp.log(p)), above)


def laplace(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.laplace`, whose smallest words are its largest numbers."""
    v = jax.random.laplace(key, shape, dtype)
    return _with_tails(key, v, lambda p: -jnp.log(2 * p), lambda p: jnp.log(2 * p))


def logistic(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """log u - log(1 - u), u uniform."""
    u = jax.random.uniform(key, shape, dtype, minval=jnp.finfo(dtype).tiny, maxval=1.0)

    def below(p):
        return jnp.log(p) - jnp.log1p(-p)

    return _with_tails(key, below(u), below, lambda p: -below(p))


def categorical(key: PRNGKey, logits: Array, n: int) -> Array:
    """[n, ...] of ``logits`` [..., k], as `jax.random.categorical`: by Gumbel numbers."""
    return jnp.argmax(gumbel(key, (n, *logits.shape), logits.dtype) + logits[None], axis=-1)


def uniform(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.uniform` between 0 and 1, and in float32 neither 0 nor 1."""
    most = 1 - float(jnp.finfo(dtype).epsneg)
    u = jax.random.uniform(key, shape, dtype)
    return _with_tails(key, u, lambda p: p, lambda p: jnp.minimum(1 - p, most))


def bernoulli(key: PRNGKey, p: Array, n: int) -> Array:
    """bool [n, ...]: whether a uniform number is below ``p`` [...]."""
    shape = (n, *p.shape)
    gap = p[None] - jax.random.uniform(key, shape, p.dtype)
    if p.dtype != jnp.float32:
        return gap > 0
    spare = _words(key, shape) & 0x1FF  # the 9 bits that the uniform number left out
    return gap > (spare.astype(p.dtype) + 0.5) * 2.0**-32


def _with_tails(
    key: PRNGKey,
    x: Array,
    first: Callable[[Array], Array],
    last: Callable[[Array], Array],
) -> Array:
    """``x``, which was drawn with ``key``; where its word is among the outermost, ``first`` or
    ``last`` of the part of all words that lies beyond it.
    """
    if x.dtype != jnp.float32:
        return x
    words = _words(key, x.shape)
    left = jnp.minimum(words, ~words)
    outermost = left < OUTERMOST
    p = (jnp.where(outermost, left, 0).astype(x.dtype) + 0.5) * 2.0**-32
    return jnp.where(outermost, jnp.where(words == left, first(p), last(p)), x)


def _words(key, shape):
    """The words from which JAX draws an array of this shape."""
    return jax.random.bits(jax.random.clone(key), shape, np.uint32)
