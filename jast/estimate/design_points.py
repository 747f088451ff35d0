"""Most probable failure points by gradients: the points of least norm on the boundary of failure,
from many starts (`jast.boundary`).
"""

from typing import NamedTuple

import jax
import numpy as np

from jast.boundary import EPISODES, STEPS, descents
from jast.limit_state import dimension, normal_numbers

__all__ = ["design_points", "distinct"]

APART = 0.5
"""Points nearer to one another than so much of their norm are one."""
GRADIENT = 3
"""Evaluations that a value with its gradient is counted as."""


class DesignPoints(NamedTuple):
    """On the host."""

    points: np.ndarray
    """[m, D] distinct failing points next to the boundary, by rising norm"""
    evaluations: int


def design_points(key, sim, starts=48, limit=16):
    """At most ``limit`` distinct `DesignPoints` of ``sim`` from ``starts`` draws of the model; none
    where the miss distance has no useful gradient.
    """
    z = jax.random.normal(key, (starts, dimension(sim)), normal_numbers(sim))
    points, failing = jax.device_get(descents(sim, z)[:2])
    points = points[failing & np.isfinite(points).all(axis=1)].astype(np.float64)
    return DesignPoints(distinct(points, limit), starts * (STEPS * GRADIENT + EPISODES))


def distinct(points, limit):
    """At most ``limit`` of ``points`` [n, D], of least norm and apart from one another: [m, D]."""
    points = points[np.argsort((points**2).sum(axis=1), kind="stable")]
    kept = []
    for z in points:
        if len(kept) < limit and all(
            np.linalg.norm(z - other) > APART * np.linalg.norm(other) for other in kept
        ):
            kept.append(z)
    return np.array(kept).reshape(-1, points.shape[-1])
