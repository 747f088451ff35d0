"""Markov moves over normal numbers, which keep N(0, width^2 I): what all chains share."""

import math
from typing import Any

import jax
import jax.numpy as jnp

__all__ = ["WIDTHS", "proposed"]

WIDTHS = 1.0, 1.5, 2.0, 3.0, 4.0, 6.0  # of the noise, in the order in which they are tried


def proposed(z: jax.Array, noise: jax.Array, scale: Any, width: Any) -> jax.Array:
    """The points that ``z`` may move to, reversibly with respect to N(0, width^2 I): the
    preconditioned Crank-Nicolson proposal (Cotter, Roberts, Stuart and White 2013), which is
    conditional sampling (Papaioannou, Betz, Zwirglmaier and Straub 2015).

    Args:
        z: points.
        noise: standard normal numbers, as many.
        scale: from 0, no move, to 1, an independent draw.
        width: of the normal numbers.
    """
    root = jnp.sqrt if isinstance(scale, jax.Array) else math.sqrt
    return root(1 - scale**2) * z + scale * width * noise
