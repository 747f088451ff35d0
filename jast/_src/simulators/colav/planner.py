"""The ferry's collision avoidance: safety zones around the tracked obstacle, and the speed along
the path that keeps out of them.

Path-velocity decomposition: the path is fixed, the planner chooses a speed. It predicts the
obstacle at the tracker's velocity, and for each candidate speed adds up what the zones that the
ferry would enter cost. The zones, the weights of the two penalty regions and of slowness, and the
rule for keeping a speed are those published for S1 (Lytskjold and Mengshoel); the weight of the
region of collision, the prediction, the sum of it all, and planning every 3 s (published: 5 s) are
ours.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

__all__ = ["DESIRED", "FIRST", "SPEEDS", "STILL", "ZONES", "costs", "inside", "plan", "speed_of"]


class Zone(NamedTuple):
    """A zone that moves with an obstacle: how far it reaches (m), and what a second in it costs."""

    name: str
    forward: float
    starboard: float
    aft: float
    port: float
    weight: float


ZONES = (  # published; the weight of the first is ours
    Zone("region of collision", 20.0, 10.0, 10.0, 10.0, 1000.0),
    Zone("high penalty region", 25.0, 20.0, 15.0, 15.0, 100.0),
    Zone("low penalty region", 40.0, 30.0, 25.0, 25.0, 10.0),
)
DESIRED = 0.75  # m/s
STILL = 0.05  # m/s: published threshold of low velocity
# candidates, m/s: published range
SPEEDS = np.concatenate([[-0.2, 0.0], np.linspace(0.15, 1.5, 10)])
FIRST = int(np.flatnonzero(np.isclose(SPEEDS, DESIRED))[0])  # in force at the start
STEP = 2.0  # s: of the prediction: ours
AHEAD = 30.0  # s: its end: ours (published: up to 600)
SLOWNESS = 10.0  # cost of a second at 1 m/s off the desired speed
KEEP = 0.8  # the speed in force stays unless another costs less than this share of it ...
KEEP_LEAST = 20.0  # ... and this much less


def inside(zone, ahead, right):
    """Whether a point ``ahead`` and to the ``right`` of an obstacle (m) is in its zone: a quarter
    of an ellipse in each quadrant.
    """
    x = ahead / jnp.where(ahead > 0, zone.forward, zone.aft)
    y = right / jnp.where(right > 0, zone.starboard, zone.port)
    return x**2 + y**2 < 1


def costs(along, obstacle):
    """[candidates] cost of each of `SPEEDS` for a ferry at ``along`` on the path and an obstacle
    with this `tracker.Track`.
    """
    dtype = along.dtype
    speeds = jnp.asarray(SPEEDS, dtype)[:, None]
    times = jnp.arange(STEP, AHEAD + STEP, STEP, dtype=dtype)[None, :]
    n, e, v_n, v_e = obstacle
    speed = jnp.sqrt(v_n**2 + v_e**2)
    still = speed < STILL  # a course of its own an obstacle at rest has not
    north, east = (
        jnp.where(still, rest, v / jnp.where(still, 1, speed)) for v, rest in ((v_n, 1), (v_e, 0))
    )
    d_n, d_e = along + speeds * times - n - v_n * times, -e - v_e * times
    ahead, right = d_n * north + d_e * east, d_e * north - d_n * east
    rate = jnp.zeros_like(ahead)
    for zone in reversed(ZONES):  # the innermost counts
        rate = jnp.where(inside(zone, ahead, right), jnp.asarray(zone.weight, dtype), rate)
    sure = 1 - times / (2 * AHEAD)  # what is predicted for later is less certain
    return STEP * jnp.sum(rate * sure, axis=1) + SLOWNESS * AHEAD * jnp.abs(speeds[:, 0] - DESIRED)


def plan(along, current, obstacle):
    """int32: which of `SPEEDS` to take now; ``current``: the one in force."""
    cost = costs(along, obstacle)
    now, least = _pick(cost, current), jnp.min(cost)
    better = (least < KEEP * now) & (least < now - KEEP_LEAST)
    return jnp.where(better, jnp.argmin(cost).astype(jnp.int32), current)


def speed_of(choice, dtype):
    """m/s."""
    return _pick(jnp.asarray(SPEEDS, dtype), choice)


def _pick(values, index):
    """``values[index]`` without a gather, which costs more in a batch."""
    return jnp.sum(jnp.where(jnp.arange(values.size, dtype=jnp.int32) == index, values, 0))
