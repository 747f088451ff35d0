"""The miss distance at every moment of an episode, and how these depend on its normal numbers.

A simulator says at every state how far it is from failing, so one run tells as many limit states as
the episode has moments: it fails if any of them does.
"""

from typing import NamedTuple

import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.normal_space.evaluate_points import evaluate_distances
from jast._src.normal_space.gradients import COST
from jast._src.normal_space.gradients import gradients as compute_gradients
from jast._src.normal_space.transform import Outcomes

__all__ = ["Linearised", "cost_of_slopes", "distances", "slopes"]

STEP = 0.1
"""Standard deviations that one number is moved by, to see what it changes."""


class Linearised(NamedTuple):
    """How far M moments are from failing near to a point. On the host."""

    point: np.ndarray
    """[D]"""
    distance: np.ndarray
    """[M] there; NaN of moments that its episode did not come to"""
    slope: np.ndarray
    """[M, D]"""


def distances(sim: Simulator, z: np.ndarray) -> tuple[Outcomes, np.ndarray]:
    """`Outcomes` of the points ``z`` [n, D], and the miss distance at each moment [n, M]: at s_0 ..
    s_T, or at the end of a system that is judged there. NaN where an episode had failed, or ended.
    """
    o, g = evaluate_distances(sim, z)
    return o, np.where(np.isfinite(g), g, np.nan).astype(np.float64)


def cost_of_slopes(sim: Simulator, d: int, gradients: bool) -> int:
    """Evaluations of `slopes`. A gradient tells of one moment, so that differences are cheaper
    where there are many.
    """
    return COST if gradients and sim.episodic else d + 1


def slopes(sim: Simulator, point: np.ndarray, gradients: bool) -> Linearised:
    """The system linearised at a ``point`` [D] that is safe: by its gradient, or by differences,
    each towards the model's middle, where failures are rarer.
    """
    if gradients and sim.episodic:
        here = compute_gradients(sim, point[None])
        return Linearised(point, *(a.astype(np.float64) for a in (here.distance, here.slope)))
    step = np.where(point > 0, -STEP, STEP)
    moved = point + np.concatenate([np.zeros((1, len(point))), np.diag(step)]).astype(point.dtype)
    _, g = distances(sim, moved)
    slope = ((g[1:] - g[0]) / step[:, None]).T
    return Linearised(point, g[0], np.nan_to_num(slope))
