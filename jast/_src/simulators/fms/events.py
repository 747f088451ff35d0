"""What may be wrong with a lateral path: the four failure events of the thesis (Moss, eq. 3.3 and
3.4, A.1 to A.3), with its formulas corrected.

A miss distance d <= 0 is a failure. What was corrected: eq. 3.3 as printed is at least 2 pi for
every turn to the right, here the extent of an arc is taken modulo 2 pi; A.1 and A.3 compare
azimuths at two points, between which the meridians converge by more than the thresholds, here both
are taken at one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jast._src.simulators.fms.geodesic import inverse, wrap
from jast._src.simulators.fms.lateral import LEAST

__all__ = ["EVENTS", "FOOT", "Misses", "extent", "misses"]

FOOT = 0.3048  # m
RHO = 100.0  # eq. 3.4: the scale
LIMIT = 10.0  # ft, eq. 3.4: the threshold
FLOOR = 1e-9  # ft, eq. 3.4: the least error
KINK = 1e-3  # radians
COURSE = jnp.pi / 180  # radians
ROUND = 1e-6  # radians: an arc as near to a whole circle is none


class Misses(NamedTuple):
    """Miss distance of each event; a failure where it is not positive."""

    arc_length: jax.Array
    """100 ln(10 ft / largest error of a stated arc length) (eq. 3.3, 3.4)."""
    kink: jax.Array
    """.001 less the largest kink (radians) between a straight and its arc (A.1)."""
    disconnection: jax.Array
    """10 less the largest gap (ft) between two packets (A.2)."""
    course: jax.Array
    """1 degree less the largest change of course (in radians) between two packets (A.3)."""


def misses(earth, path):
    """All four `Misses` of a `Path`."""
    return Misses(*(event(earth, path) for event in EVENTS.values()))


def extent(earth, path):
    """The angles [T] (radians, in [0, 2 pi)) through which the arcs lead from s to e."""
    ends = jnp.stack([path.start, path.end])
    _, (to_start, to_end), _ = inverse(earth, jnp.stack([path.centre] * 2), ends)
    angle = jnp.mod(jnp.sign(path.radius) * (to_end - to_start), 2 * jnp.pi)
    return jnp.where(2 * jnp.pi - angle < ROUND, 0, angle)


def _arc_length(earth, path):
    error = jnp.abs(path.beta - extent(earth, path) * jnp.abs(path.radius)) / FOOT
    return RHO * jnp.log(LIMIT / jnp.maximum(jnp.max(jnp.where(path.arc, error, 0)), FLOOR))


def _straights(earth, path):
    """Of the straights to the starts of the turns: whether each is one (longer than 1 mm), and its
    courses at both ends [T].
    """
    length, first, last = inverse(
        earth, jnp.concatenate([path.waypoints[:1], path.end[:-1]]), path.start
    )
    return path.straight[:-1] & (length > LEAST), first, last


def _kink(earth, path):
    there, _, course = _straights(earth, path)
    _, _, radial = inverse(earth, path.centre, path.start)
    kink = jnp.abs(wrap(radial - course + jnp.sign(path.radius) * jnp.pi / 2))
    return KINK - jnp.max(jnp.where(there & path.arc & (jnp.abs(path.radius) > LEAST), kink, 0))


def _disconnection(earth, path):
    last = jnp.where(path.arc[:, None], path.end, path.start)[:-1]
    first = jnp.where(path.straight[1:-1, None], path.end[:-1], path.start[1:])
    gap, _, _ = inverse(earth, last, first)
    return LIMIT - jnp.max(gap, initial=0) / FOOT


def _course(earth, path):
    there, course, _ = _straights(earth, path)
    change = jnp.abs(wrap(course[1:] - path.course_out[:-1]))
    return COURSE - jnp.max(jnp.where(there[1:], change, 0), initial=0)


EVENTS = {
    "arc length": _arc_length,
    "kink": _kink,
    "disconnection": _disconnection,
    "course": _course,
}
