"""A counter-based hash as a JAX key implementation: random numbers that are addressed, not
threaded.

A simulation of a search draws its disturbance x_t with a key folded from (tree key, simulation, t),
so that any simulation can be rebuilt from its number. Threefry spends most of a cheap simulator's
time on that; two rounds of a 32-bit finaliser (the one of MurmurHash3) per word do not. Searches,
populations and plain draws use it, and its statistics are tested; other estimators keep the user's
own key.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.runtime._jax import define_prng_impl, quick

__all__ = ["COUNTER", "coin", "counter_key", "numpy_generator", "tree_keys"]


def _mix(h):
    """MurmurHash3's 32-bit finaliser: a bijection in which every input bit moves every output
    bit.
    """
    h = (h ^ (h >> 16)) * jnp.uint32(0x85EBCA6B)
    h = (h ^ (h >> 13)) * jnp.uint32(0xC2B2AE35)
    return h ^ (h >> 16)


def _word(key, i):
    """The i-th 32-bit word of a key's stream."""
    return _mix(_mix(i * jnp.uint32(0x9E3779B9) + key[0]) ^ key[1])


def _seed(seed):
    seed = jnp.asarray(seed).astype(jnp.uint32)
    return _fold_in(jnp.stack([jnp.uint32(0x243F6A88), jnp.uint32(0x85A308D3)]), seed)


def _fold_in(key, data):
    data = lax.convert_element_type(data, jnp.uint32)
    first = _word(key, data)
    return jnp.stack([first, _mix(first + key[1] * jnp.uint32(0xCC9E2D51) + data)])


def _split(key, shape):
    size = math.prod(shape)
    numbers = lax.iota(jnp.uint32, max(1, size))[:size]
    return jax.vmap(lambda i: _fold_in(key, ~i))(numbers).reshape(*shape, 2)


def _random_bits(key, bit_width, shape):
    words = math.prod(shape) * (2 if bit_width == 64 else 1)
    bits = _word(key, lax.iota(jnp.uint32, words))
    if bit_width == 64:
        high, low = bits[0::2].astype(jnp.uint64), bits[1::2].astype(jnp.uint64)
        return ((high << 32) | low).reshape(shape)
    return bits.astype({8: jnp.uint8, 16: jnp.uint16, 32: jnp.uint32}[bit_width]).reshape(shape)


COUNTER = define_prng_impl(
    key_shape=(2,),
    seed=_seed,
    split=_split,
    random_bits=_random_bits,
    fold_in=_fold_in,
    name="jast_counter",
    tag="cnt",
)


def coin(key):
    """A fair bool by one bit of a counter key's own words, which its stream does not show."""
    return (jax.random.key_data(key)[..., 1] & 1).astype(bool)


@partial(quick, static_argnums=1)
def tree_keys(key, n):
    """``n`` counter keys, one a tree, from the user's ``key`` (consumed); the key of tree k does
    not depend on ``n``.
    """
    words = jax.vmap(lambda k: jax.random.bits(jax.random.fold_in(key, k), (2,), jnp.uint32))(
        jnp.arange(n)
    )
    return jax.random.wrap_key_data(words, impl=COUNTER)


def numpy_generator(key, *numbers):
    """A NumPy generator from a JAX key of any kind, for work on the host; another one for each
    ``numbers``, whole and not all 0. A generator is returned as it is.
    """
    if isinstance(key, np.random.Generator):
        return key
    words = np.asarray(jax.random.key_data(key)).astype(np.uint32).ravel().tolist()
    return np.random.default_rng([*words, *numbers])


def counter_key(key: jax.Array, *numbers: int) -> jax.Array:
    """A counter key from a user's key, another one for each ``numbers``."""
    words = numpy_generator(key, *numbers).integers(0, 2**32, 2, np.uint32)
    return jax.random.wrap_key_data(jnp.asarray(words), impl=COUNTER)
