"""Encounters of the ferry and an adversary, as data: where each starts and what the adversary is
told to do.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jast._src.core.typing import Array

__all__ = ["SCENARIOS", "Scenario"]


class Scenario(NamedTuple):
    """An encounter; arrays or numbers, all traced but the number of rows of ``route``, which is the
    horizon.
    """

    adversary: Array | Sequence[float]
    """Its start: north (m), east (m), heading (radians, from north towards east); it moves ahead at
    the speed of the first row of the route.
    """
    route: Array
    """[steps, 3]: the surge, sway (m/s) and yaw rate (rad/s) that it is told at each search step.
    """
    ferry: Array | Sequence[float] = (10.0, 0.0, 0.0)
    """The ferry's start, at rest; its path goes from (0, 0) to (100, 0)."""


def _route(steps, *turns):
    """Ahead at 1 m/s, with yaw rates ``(first step, number of steps, rad/s)``."""
    route = np.tile([1.0, 0.0, 0.0], (steps, 1))
    for first, count, rate in turns:
        route[first : first + count, 2] = rate
    return route


SCENARIOS = {
    "head-on": Scenario((100.0, 40.0, 3.84), _route(25)),
    "crossing": Scenario((20.0, 50.0, -0.8), _route(25)),
    "overtaking": Scenario((0.0, 45.0, 0.0), _route(27, (0, 25, -0.0225))),
    "sharp turn": Scenario((20.0, 45.0, 0.0), _route(25, (5, 5, -0.10472))),
}
"""Starts and routes are those published for S1 (delay3, delay2, delay4 with the gradual left turn,
over_turn with the sharp left turn).
"""
