"""Descents by gradients to the boundary of failure, in the space of normal numbers
(`normal_space.transform`).

Each step goes to the nearest point of the linearised boundary (Hasofer and Lind 1974; Rackwitz and
Fiessler 1978). A miss distance is flat once a system fails, so a step that arrives among the
failures is halved back to the boundary.
"""

from typing import NamedTuple

import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.gradients import gradients

__all__ = ["Descents", "EPISODES", "STEPS", "descents"]

STEPS = 12  # of a descent
HALVINGS = 5  # of the way back to the boundary, in each step
EPISODES = STEPS * (HALVINGS + 1)  # of a descent, beside `STEPS` that are differentiated
# a step ends at most at FARTHER |z| + FIRST: a linear extrapolation can be wild
FARTHER = 1.5
FIRST = 3  # for a start at the origin
BEYOND = 1.0 + 1e-4  # of the boundary, so that rounding leaves failures failures


class Descents(NamedTuple):
    """What n descents came to, [n, ...] each, on the host."""

    point: Array
    """[D] the failing point of least norm; the start where there is none."""
    found: Array
    """bool: there is one."""
    nearest: Array
    """[D] the point of least distance among those that were differentiated."""
    distance: Array
    """The distance there; inf where none is valid."""
    useful: Array
    """int32: how many of the gradients led somewhere."""
    failing: Array
    """int32: failing episodes."""
    invalid: Array
    """int32: invalid ones among those that were differentiated."""
    first: Array
    """int32: the step, from 0 on, of which the first failure was; `STEPS` where none was."""
    slopes: Array
    """int32: simulator steps of the episodes that were differentiated."""
    steps: Array
    """int32: simulator steps of the others."""


def descents(sim: Simulator, starts: np.ndarray) -> Descents:
    """`Descents` of ``sim`` from the points ``starts`` [n, D]. The system's steps are in two
    programs alone, that of `evaluate_points` and that of `gradients`.
    """
    n, none = len(starts), np.zeros(len(starts), np.int32)
    z, distance = starts, np.full(n, np.inf, starts.dtype)
    d = Descents(
        point=starts,
        found=np.zeros(n, bool),
        nearest=starts,
        distance=distance,
        useful=none,
        failing=none,
        invalid=none,
        first=none + STEPS,
        slopes=none,
        steps=none,
    )
    for i in range(STEPS):
        g = gradients(sim, z)
        valid = np.isfinite(g.distance)
        aim, usable = _nearest_on_the_boundary(z, g.distance, g.slope)
        there = evaluate_points(sim, aim)
        fails, outside, inside = there.failure, z, aim
        failing, steps = g.failure.astype(np.int32) + fails, there.length
        for _ in range(HALVINGS):
            here = (outside + inside) / 2
            there = evaluate_points(sim, here)
            failed = there.failure[:, None]
            outside, inside = np.where(failed, outside, here), np.where(failed, here, inside)
            failing, steps = failing + there.failure, steps + there.length
        closer = (inside**2).sum(axis=1) < (d.point**2).sum(axis=1)
        better = (fails & (~d.found | closer))[:, None]
        nearer = valid & (g.distance < d.distance)
        d = Descents(
            point=np.where(better, inside, d.point),
            found=d.found | fails,
            nearest=np.where(nearer[:, None], z, d.nearest),
            distance=np.where(nearer, g.distance, d.distance),
            useful=d.useful + usable,
            failing=d.failing + failing,
            invalid=d.invalid + ~valid,
            first=np.where((failing > 0) & (d.first == STEPS), i, d.first),
            slopes=d.slopes + g.length,
            steps=d.steps + steps,
        )
        z = np.where(fails[:, None], outside, aim)
    return d


def _nearest_on_the_boundary(
    z: np.ndarray, distance: np.ndarray, slope: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The point nearest to the origin on the linearised boundary, and a little beyond it, for each
    of ``z`` [n, D]; and whether its gradient was usable [n].
    """
    square = (slope**2).sum(axis=1)
    usable = np.isfinite(distance) & np.isfinite(square) & (square > 0)
    some = usable[:, None]
    slope = np.where(some, slope, 0)
    length = ((slope * z).sum(axis=1) - np.where(usable, distance, 0)) / np.where(usable, square, 1)
    aim = np.where(some, length[:, None] * slope, z)
    most = FARTHER * np.linalg.norm(z, axis=1) + FIRST
    shorter = np.minimum(1, most / np.maximum(np.linalg.norm(aim, axis=1), 1e-6))
    return aim * shorter[:, None].astype(z.dtype) * z.dtype.type(BEYOND), usable
