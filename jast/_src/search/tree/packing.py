"""Pytrees as rows of 32-bit words, so that a tree keeps all it knows of a node in one place in
memory.

Reading a node is then one access instead of one a leaf: most of the time of a search on a cheap
simulator goes into waiting for memory.
"""

import math

import jax
import jax.numpy as jnp
from jax import lax

__all__ = ["pack", "unpack", "width"]

SMALL = {1: jnp.uint8, 2: jnp.uint16}  # bytes of a dtype below a word -> what has its bits


def width(like):
    """Words in the record of a pytree of arrays, by these or their shapes and dtypes."""
    return sum(math.prod(s.shape) * max(1, s.dtype.itemsize // 4) for s in jax.tree.leaves(like))


def pack(tree):
    """The leaves of one pytree (no batch axis) as uint32 [width]; exact for every dtype up to 64
    bits.
    """
    none = jnp.zeros((0,), jnp.uint32)
    return jnp.concatenate([none, *(_words(jnp.ravel(a)) for a in jax.tree.leaves(tree))])


def unpack(words, like):
    """Inverse of `pack`."""
    leaves, treedef = jax.tree.flatten(like)
    out, at = [], 0
    for s in leaves:
        n = width(s)
        out.append(_value(words[at : at + n], s.dtype).reshape(s.shape))
        at += n
    return treedef.unflatten(out)


def _words(a):
    if a.dtype == jnp.bool_:
        return a.astype(jnp.uint32)
    if jnp.issubdtype(a.dtype, jnp.complexfloating):
        return _words(jnp.stack([a.real, a.imag], axis=-1).reshape(-1))
    if a.dtype.itemsize < 4:
        return lax.bitcast_convert_type(a, SMALL[a.dtype.itemsize]).astype(jnp.uint32)
    return lax.bitcast_convert_type(a, jnp.uint32).reshape(-1)


def _value(words, dtype):
    if dtype == jnp.bool_:
        return words != 0
    if jnp.issubdtype(dtype, jnp.complexfloating):
        parts = _value(words, jnp.finfo(dtype).dtype).reshape(-1, 2)
        return lax.complex(parts[:, 0], parts[:, 1])
    if dtype.itemsize < 4:
        words = words.astype(SMALL[dtype.itemsize])
    elif dtype.itemsize == 8:
        words = words.reshape(-1, 2)
    return lax.bitcast_convert_type(words, dtype)
