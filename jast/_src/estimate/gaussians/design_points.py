"""Most probable failure points by gradients: the points of least norm on the boundary of failure,
from many starts (`normal_space.design_point_descent`).
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.normal_space.design_point_descent import EPISODES, STEPS, descents
from jast._src.normal_space.gradients import COST
from jast._src.normal_space.transform import dimension, normal_numbers, unit
from jast._src.util.blocked_matmul import product

__all__ = ["descend", "design_points", "distinct", "explained", "may_matter"]

APART = 0.5  # of the norm of a point: those nearer to it are the same
MOST = 48  # descents of a call
LIMIT = 16  # design points of a call, at most
LITTLE = math.log(1e-3)  # log of a part of the probability that does not matter


class DesignPoints(NamedTuple):
    """Failing points that descents came to, and what these cost. On the host."""

    points: np.ndarray
    """[m, D] failing points next to the boundary, distinct and by rising norm if not said
    otherwise"""
    evaluations: int


def design_points(key: jax.Array, sim: Simulator, starts: int = MOST) -> DesignPoints:
    """At most `LIMIT` distinct `DesignPoints` of ``sim`` from ``starts`` draws of the model; none
    where the miss distance has no useful gradient.
    """
    z = numpy_generator(key).standard_normal((starts, dimension(sim)))
    found = descend(sim, z)
    return found._replace(points=distinct(found.points, LIMIT))


def descend(sim: Simulator, starts: np.ndarray) -> DesignPoints:
    """The `DesignPoints` that the ``starts`` [n, D] lead to, in no order."""
    d = descents(sim, np.asarray(starts, normal_numbers(sim)))
    points = d.point[d.found & np.isfinite(d.point).all(axis=1)].astype(np.float64)
    return DesignPoints(points, len(starts) * (STEPS * COST + EPISODES))


def distinct(points: np.ndarray, limit: int) -> np.ndarray:
    """At most ``limit`` of ``points`` [n, D], of least norm and apart from one another: [m, D]."""
    points = points[np.argsort((points**2).sum(axis=1), kind="stable")]
    kept = points[:0]
    while len(points) and len(kept) < limit:
        nearest = points[0]
        kept = np.concatenate([kept, nearest[None]])
        gaps = np.linalg.norm(points - nearest, axis=1)
        points = points[gaps > APART * np.linalg.norm(nearest)]
    return kept


def explained(points: np.ndarray, centres: np.ndarray, slack: float = 1e-3) -> np.ndarray:
    """Which of the failures ``points`` [n, D] lie beyond the plane that stands square on one of the
    design points ``centres`` [m, D], or before it by ``slack`` of its distance: bool [n]. The
    others fail by something else.
    """
    size = np.linalg.norm(centres, axis=1)
    return (product(points, unit(centres).T) >= (1 - slack) * size).any(axis=1)


def may_matter(points: np.ndarray) -> np.ndarray:
    """Which of the design points ``points`` [n, D] may matter beside the nearest: bool [n]."""
    square = (points**2).sum(axis=1)
    return square <= square.min(initial=np.inf) - 2 * LITTLE
