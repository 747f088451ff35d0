"""Draws in float32 whose rare values have their probabilities.

JAX makes a float32 of 23 of a word's 32 random bits, so that probabilities are multiples of 2^-23:
a normal number above 5 comes .83 times as often as it should, one below -5 1.25 times, an event of
1e-6 .95 or 1.07 times. Here the outermost 2^-15 on either side is placed by all 32 bits; every
other draw is JAX's to the bit, and so are all of other dtypes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

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

EPSILON = np.finfo(np.float32).epsneg
"""Between 1 and the next number below it."""
TINY = np.finfo(np.float32).tiny
"""The least normal number."""
OUTERMOST = 2**17
"""Of the 2^32 words so many on either side: a part of 2^-15. Nearer the middle JAX is off by .4 %
at most."""
NORMAL_TAIL = 2.450598e-5, -8.560246e-4, 0.01259107, -0.1011611, 1.485857, -1.535392
"""For `jnp.polyval`: z as a polynomial of (-2 log p)^.5, p from 2^-33 to 2^-15; least squares at
Chebyshev's points, within 6e-7."""


def normal(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.normal`."""
    if dtype != jnp.float32:
        return jax.random.normal(key, shape, dtype)

    def above(p):
        return jnp.polyval(jnp.asarray(NORMAL_TAIL, p.dtype), jnp.sqrt(-2 * jnp.log(p)))

    words = _words(key, shape)
    z = np.float32(np.sqrt(2)) * lax.erf_inv(_between(words, -1 + EPSILON, 1))
    return _with_tails(words, z, lambda p: -above(p), above)


def exponential(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.exponential`."""
    if dtype != jnp.float32:
        return jax.random.exponential(key, shape, dtype)
    words = _words(key, shape)
    e = -jnp.log1p(-_between(words, 0, 1))
    return _with_tails(words, e, lambda p: -jnp.log1p(-p), lambda p: -jnp.log(p))


def gumbel(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.gumbel`."""
    if dtype != jnp.float32:
        return jax.random.gumbel(key, shape, dtype, mode="low")

    def above(p):
        return -jnp.log(-jnp.log1p(-p))

    def below(p):
        return -jnp.log(-jnp.log(p))

    words = _words(key, shape)
    return _with_tails(words, below(_between(words, TINY, 1)), below, above)


def laplace(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.laplace`, whose smallest words are its largest numbers."""
    if dtype != jnp.float32:
        return jax.random.laplace(key, shape, dtype)
    words = _words(key, shape)
    u = _between(words, -1 + EPSILON, 1)
    v = jnp.sign(u) * jnp.log1p(-jnp.abs(u))
    return _with_tails(words, v, lambda p: -jnp.log(2 * p), lambda p: jnp.log(2 * p))


def logistic(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """log u - log(1 - u), u uniform."""

    def below(p):
        return jnp.log(p) - jnp.log1p(-p)

    if dtype != jnp.float32:
        tiny = jnp.finfo(dtype).tiny
        return below(jax.random.uniform(key, shape, dtype, minval=tiny, maxval=1.0))
    words = _words(key, shape)
    return _with_tails(words, below(_between(words, TINY, 1)), below, lambda p: -below(p))


def categorical(key: PRNGKey, logits: Array, n: int) -> Array:
    """[n, ...] of ``logits`` [..., k], as `jax.random.categorical`: by Gumbel numbers."""
    return jnp.argmax(gumbel(key, (n, *logits.shape), logits.dtype) + logits[None], axis=-1)


def uniform(key: PRNGKey, shape: tuple[int, ...], dtype: Any) -> Array:
    """As `jax.random.uniform` between 0 and 1, and in float32 neither 0 nor 1."""
    if dtype != jnp.float32:
        return jax.random.uniform(key, shape, dtype)
    words, most = _words(key, shape), 1 - EPSILON
    return _with_tails(
        words, _between(words, 0, 1), lambda p: p, lambda p: jnp.minimum(1 - p, most)
    )


def bernoulli(key: PRNGKey, p: Array, n: int) -> Array:
    """bool [n, ...]: whether a uniform number is below ``p`` [...]."""
    shape = (n, *p.shape)
    if p.dtype != jnp.float32:
        return p[None] > jax.random.uniform(key, shape, p.dtype)
    words = _words(key, shape)
    spare = words & 0x1FF  # the 9 bits that a uniform number leaves out
    return p[None] - _between(words, 0, 1) > (spare.astype(p.dtype) + 0.5) * 2.0**-32


def _words(key, shape):
    """The words from which JAX draws an array of this shape. They are the dear part of a draw."""
    return jax.random.bits(key, shape, np.uint32)


def _between(words, low, high):
    """What `jax.random.uniform` makes of the ``words``: 23 bits of each."""
    low, high = np.float32(low), np.float32(high)
    u = lax.bitcast_convert_type((words >> 9) | np.uint32(0x3F800000), np.float32) - 1
    return jnp.maximum(low, u * (high - low) + low)


def _with_tails(
    words: Array,
    x: Array,
    first: Callable[[Array], Array],
    last: Callable[[Array], Array],
) -> Array:
    """``x``, which was made of the ``words``; where one is among the outermost, ``first`` or
    ``last`` of the part of all words that lies beyond it.
    """
    left = jnp.minimum(words, ~words)
    outermost = left < OUTERMOST
    p = (jnp.where(outermost, left, 0).astype(x.dtype) + 0.5) * 2.0**-32
    return jnp.where(outermost, jnp.where(words == left, first(p), last(p)), x)
