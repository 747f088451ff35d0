"""Pictures of one state of the simulators that move in a plane, as SVG: what the page of a report
shows beside its slider (``report.html(path, draw=jast.simulators.draw)``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jast._src.core.typing import ArrayTree
from jast._src.simulators import svg
from jast._src.simulators.colav.planner import SPEEDS
from jast._src.simulators.colav.system import COLLISION as TOUCH
from jast._src.simulators.colav.system import ColavState
from jast._src.simulators.ferry import COLLISION, FerryState
from jast._src.simulators.pendulum import PendulumState
from jast._src.simulators.svg import BLUE, GREEN, GREY, INK, VERMILION
from jast._src.util.checks import wrong

__all__ = ["DRAWN", "HULL", "draw", "placed"]

HULL = np.array([(4.0, 0.0), (1.8, 1.5), (-4.0, 1.5), (-4.0, -1.5), (1.8, -1.5)])
"""Ahead and to the right of the centre, drawn larger than a collision so as to be seen."""
TRAIL = 60  # places of a trail, at most


def draw(state: ArrayTree, past: ArrayTree | None = None) -> str:
    """One state of `ferry`, `colav` or `pendulum` as an SVG picture.

    Args:
        state: a `FerryState`, `ColavState` or `PendulumState` of scalars.
        past: the states before it, [t, ...]: then what moves has a trail.

    Returns:
        The SVG element, as text.

    Raises:
        ValueError: for a state of another system.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> sim = jast.simulators.pendulum()
        >>> jast.simulators.draw(sim.init(jnp.zeros(2)))[:4]
        '<svg'
    """
    for kind, picture in DRAWN.items():
        if isinstance(state, kind):
            return picture(state, past)
    must = f"be one of {[kind.__name__ for kind in DRAWN]}"
    raise wrong("draw", "state", must, f"a {type(state).__name__}")


def _ferry(s: FerryState, past: FerryState | None) -> str:
    plane = svg.Plane((-22.0, -8.0), (114.0, 112.0), 360)
    ferry, other = (float(s.ferry_x), float(s.ferry_y)), (float(s.x), float(s.y))
    gap = math.dist(ferry, other)
    return plane.picture(
        plane.line([(0.0, 50.0), (105.0, 50.0)], GREY, dash="4 4"),
        *_trail(plane, past, lambda p: (p.ferry_x, p.ferry_y), ferry, BLUE),
        *_trail(plane, past, lambda p: (p.x, p.y), other, VERMILION),
        plane.circle(ferry, COLLISION, BLUE, 0.2),
        plane.line([ferry, other], INK if gap < 4 * COLLISION else "#ccc", width=1),
        plane.shape(_hull_at(ferry, math.pi / 2), BLUE),
        plane.shape(_hull_at(other, float(s.heading)), VERMILION),
        plane.words((-19.0, 105.0), "ferry", BLUE),
        plane.words((2.0, 105.0), "adversary", VERMILION),
        plane.words((112.0, 105.0), f"distance {gap:.2f}", INK, "end"),
        plane.words((112.0, -4.0), f"collision: within {COLLISION:g}", GREY, "end"),
    )


def _colav(s: ColavState, past: ColavState | None) -> str:
    plane = svg.Plane((-38.0, -6.0), (58.0, 112.0), 330)
    own, other, seen = s.pose, s.adversary.pose, s.track
    places = [(float(p.e), float(p.n)) for p in (own, other, seen)]
    course = math.atan2(float(seen.v_e), float(seen.v_n))
    near = math.dist(*places[:2])
    return plane.picture(
        plane.line([(0.0, 0.0), (0.0, 100.0)], GREY, dash="4 4"),
        *_trail(plane, past, lambda p: (p.pose.e, p.pose.n), places[0], BLUE),
        *_trail(
            plane, past, lambda p: (p.adversary.pose.e, p.adversary.pose.n), places[1], VERMILION
        ),
        plane.line(places[1:], INK, width=1),
        plane.circle(places[0], TOUCH, BLUE, 0.4),
        plane.shape(_hull_at(places[0], float(own.psi)), BLUE),
        plane.shape(_hull_at(places[1], float(other.psi)), VERMILION),
        plane.shape(_hull_at(places[2], course), "none", GREEN),
        plane.words((-36.0, 107.0), "ferry", BLUE),
        plane.words((-22.0, 107.0), "adversary", VERMILION),
        plane.words((3.0, 107.0), "as believed", GREEN),
        plane.words((56.0, 107.0), f"{near:.1f} m apart", INK, "end"),
        plane.words((56.0, -3.0), f"ordered {SPEEDS[int(s.choice)]:.2f} m/s", INK, "end"),
    )


def _pendulum(s: PendulumState, past: PendulumState | None) -> str:
    plane = svg.Plane((-1.3, -0.35), (1.3, 1.35), 330)
    theta, omega = float(s.theta), float(s.omega)

    def at(angle: float, r: float) -> svg.Place:
        return r * math.sin(angle), r * math.cos(angle)

    # where it will be in a tenth of a second at this speed
    ahead = [at(theta + 0.1 * omega * i / 10, 1.12) for i in range(11)]
    return plane.picture(
        plane.line([(-1.2, 0.0), (1.2, 0.0)], GREY),
        plane.line([(0.0, 0.0), (0.0, 1.15)], GREY, dash="4 4"),
        *_trail(plane, past, lambda p: (np.sin(p.theta), np.cos(p.theta)), at(theta, 1.0), BLUE),
        plane.line([(0.0, 0.0), at(theta, 1.0)], INK, width=3),
        plane.circle(at(theta, 1.0), 0.07, BLUE),
        plane.line(ahead, VERMILION, width=2),
        plane.words((-1.25, -0.25), f"{math.degrees(theta):.1f} degrees", BLUE),
        plane.words((1.25, -0.25), f"{omega:.2f} rad/s", VERMILION, "end"),
    )


def _trail(
    plane: svg.Plane, past: Any, place: Callable[[Any], Any], now: svg.Place, colour: str
) -> list[str]:
    """The way to ``now`` of what is at ``place`` of each state."""
    if past is None:
        return []
    before = np.stack(np.broadcast_arrays(*place(past)), -1)
    rows = np.unique(np.linspace(0, len(before) - 1, min(len(before), TRAIL)).astype(int))
    return [plane.line([*before[rows], now], colour, opacity=0.5)]


def placed(ahead: Any, right: Any, east: Any, north: Any, heading: Any) -> np.ndarray:
    """[points, 2] in (east, north): points ahead and to the right of a place on a heading (radians
    from north to east).
    """
    e = east + ahead * np.sin(heading) + right * np.cos(heading)
    n = north + ahead * np.cos(heading) - right * np.sin(heading)
    return np.stack([e, n], -1)


def _hull_at(place: svg.Place, heading: float) -> np.ndarray:
    """The hull at ``place``, its bow to ``heading``."""
    return placed(*HULL.T, *place, heading)


DRAWN = {FerryState: _ferry, ColavState: _colav, PendulumState: _pendulum}
"""Kind of state -> its picture."""
