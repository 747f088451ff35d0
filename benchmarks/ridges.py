"""Limit states with a ridge across several coordinates, drawn by number: the shape, how many
normal numbers, their rotation, how far failures are, how high and how sharp the ridge. Nothing was
chosen on them. Their probabilities are integrals over one number.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from scipy.stats import norm

__all__ = ["RIDGES", "ridge"]

RIDGES = range(12)
NODES = np.linspace(-9.0, 9.0, 40_001)
"""Of the second number, which makes the ridge. The density beyond is 1e-18."""


def _wave(b, a, w, y, np=jnp):
    return b - a * np.sin(2 * w * y[1]) - y[0]


def _bump(b, a, w, y, np=jnp):
    return b - 2 * a * np.exp(-2 * w * y[1] ** 2) - y[0]


def _two_sides(b, a, w, y, np=jnp):
    return b - a * np.tanh(2 * w * y[1]) - np.abs(y[0])


def _product(b, a, w, y, np=jnp):
    """Of another scale than a distance: the logarithm is what is linear in the first number."""
    return np.exp(0.3 * (b - y[0] - a * y[1] * y[2] / (1 + np.abs(y[2])))) - 1


SHAPES = _wave, _bump, _two_sides, _product


def _rotated(shape, rotation, b, a, w, z):
    return shape(b, a, w, rotation @ z)


def ridge(number: int) -> tuple[Callable[[Any], Any], int, float]:
    """The limit state of a number, how many normal numbers it has, and P(g <= 0)."""
    rng = np.random.default_rng(number)
    shape, d = SHAPES[number % len(SHAPES)], int(rng.integers(4, 12))
    rotation = np.linalg.qr(rng.standard_normal((d, d))).Q
    b, w, a = rng.uniform(2.8, 4.0), rng.uniform(0.5, 2.0), rng.uniform(0.3, 1.0)
    if shape is _product:  # a normal number, given the third
        fails = norm.sf(b / np.hypot(1, a * NODES / (1 + np.abs(NODES))))
    else:
        edge = shape(b, a, w, np.stack([np.zeros_like(NODES), NODES]), np=np)
        fails = norm.sf(edge) * (1 + (shape is _two_sides))
    truth = float(fails @ norm.pdf(NODES) * (NODES[1] - NODES[0]))
    g = Partial(Partial(_rotated, shape), *map(jnp.asarray, (rotation, b, a, w)))
    return g, d, truth
