"""The lateral path through a list of waypoints: fly-by turns, fitted to the legs, as packets of a
straight and an arc; with the injected defect.

A turn at a waypoint leaves the leg by its lead distance before the waypoint and is on the next leg
by as much behind it. Where two turns do not fit on a leg, both are made smaller. The defect: a leg
shorter than `Build.eps` is not fitted (as if to avoid a division by its length), its turns keep
their nominal radii and overlap, and the arc of the second is made to start where the first ended,
which is not where it was built to start: it is then longer or shorter than stated, and where that
point lies past its own end it leads nearly all the way round (a fifth of the failures).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jast._src.simulators.fms.geodesic import Earth, direct, inverse, wrap

__all__ = ["KNOT", "LEAST", "NMI", "Build", "Path", "lateral"]

NMI = 1852.0  # m
KNOT = NMI / 3600  # m/s
GRAVITY = 9.80665  # m/s^2
LEAD = 20 * NMI  # the longest lead distance of a turn
SLOWEST = 150 * KNOT  # ground speed
SHARE = 0.999  # of a leg that its two turns may take up
LEAST = 1e-3  # m: a turn shorter than that is none


class Build(NamedTuple):
    """Settings of the path builder, scalars."""

    eps: jax.Array
    """Legs shorter than that (m) skip the fit; 0: none does, the correct builder."""
    every: jax.Array
    """bool: the guard acts on every such leg, not only where the turns at its ends have opposite
    senses.
    """
    bank: jax.Array
    """Bank angle (radians)."""
    tas: jax.Array
    """True air speed (m/s)."""
    snap: jax.Array
    """bool: an arc that would start before the last one ended is made to start at that end, which
    keeps the path connected.
    """
    earth: Earth


class Path(NamedTuple):
    """The lateral path through T waypoints between two airports. Points are (latitude, longitude)
    in degrees, lengths in m, courses and angles in radians.

    Packet i is a straight to ``start[i]`` (where ``straight[i]``), then the arc to ``end[i]``
    (where ``arc[i]``); last comes a straight to the destination.
    """

    waypoints: jax.Array
    """[T + 2, 2], with both airports."""
    legs: jax.Array
    """[T + 1] lengths."""
    skipped: jax.Array
    """[T + 1] bool: legs on which the guard skipped the fit of turns that did not fit: the defect.
    """
    turn: jax.Array
    """[T]: change of course at a waypoint, to the right positive, in [-pi, pi]."""
    start: jax.Array
    """[T, 2] s: where the arc begins."""
    end: jax.Array
    """[T, 2] e: where the arc ends."""
    course_out: jax.Array
    """[T]: course of the next leg at e."""
    centre: jax.Array
    """[T, 2] c."""
    radius: jax.Array
    """[T] signed r: of a turn to the right positive."""
    beta: jax.Array
    """[T]: stated length of the arc."""
    straight: jax.Array
    """[T + 1] bool: a straight leads to s; last, to the destination."""
    arc: jax.Array
    """[T] bool: the turn is longer than 1 mm."""


def lateral(build, waypoints, winds, count):
    """The `Path` through the first ``count`` of the ``waypoints`` [T + 2, 2] behind the first; the
    last is the destination, and what lies between is left out.

    ``winds`` [T, 2]: direction blown towards (degrees) and speed (knots) at each waypoint.
    """
    T = winds.shape[0]
    place = jnp.arange(T + 2, dtype=jnp.int32)
    waypoints = jnp.where((place <= count)[:, None], waypoints, waypoints[-1])
    legs, leaving, arriving = inverse(build.earth, waypoints[:-1], waypoints[1:])
    out = leaving[1:]
    turn = jnp.where(place[1:-1] <= count, wrap(out - arriving[:-1]), 0)

    speed = jnp.maximum(
        build.tas + KNOT * winds[:, 1] * jnp.cos(jnp.radians(winds[:, 0]) - out), SLOWEST
    )
    tan = jnp.tan(jnp.abs(turn) / 2)
    radius = jnp.minimum(speed**2 / (GRAVITY * jnp.tan(build.bank)), LEAD / jnp.maximum(tan, 1e-9))
    end = jnp.zeros((1,), tan.dtype)

    def both(a):
        """The sum of the turns at both ends of a leg."""
        padded = jnp.concatenate([end, a, end])
        return padded[:-1] + padded[1:]

    sense = jnp.concatenate([end, jnp.sign(turn), end])
    needs = SHARE * legs < both(radius * tan)
    short = (legs < build.eps) & (build.every | (sense[:-1] * sense[1:] < 0))
    fit = jnp.where(needs & ~short, SHARE * legs / jnp.maximum(both(radius * tan), 1e-300), 1)
    radius = radius * jnp.minimum(fit[:-1], fit[1:])
    lead = radius * tan
    overlap = both(lead) > legs

    at = jnp.stack([waypoints[1:-1]] * 2)
    (start, finish), (course_in, course_out) = direct(
        build.earth, at, jnp.stack([arriving[:-1], out]), jnp.stack([-lead, lead])
    )
    side = jnp.where(turn < 0, -1, 1).astype(turn.dtype)
    centre, _ = direct(build.earth, start, course_in + side * jnp.pi / 2, radius)
    start = jnp.where(
        (build.snap & overlap[:-1])[:, None], jnp.concatenate([waypoints[:1], finish[:-1]]), start
    )
    beta = jnp.abs(turn) * radius
    return Path(
        waypoints=waypoints,
        legs=legs,
        skipped=needs & short,
        turn=turn,
        start=start,
        end=finish,
        course_out=course_out,
        centre=centre,
        radius=side * radius,
        beta=beta,
        straight=~overlap,
        arc=beta > LEAST,
    )
