"""F-16 ground collision avoidance: one flight from a given start, or a `Simulator` of starts."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator, ravel
from jast._src.core.typing import Numeric
from jast._src.simulators.arch import gcas
from jast._src.simulators.arch.models import Driving, begun, ends, nothing, samples_of
from jast._src.simulators.arch.specifications import named
from jast._src.simulators.parameter import positive
from jast._src.specs.robustness import reach
from jast._src.util.checks import number
from jast.distributions import Independent, Uniform
from jast.specs import Formula, under

__all__ = ["fly", "ground_collision_avoidance"]

BOX = (
    (math.pi / 4 - math.pi / 20, -0.4 * math.pi, -math.pi / 4 - math.pi / 8),
    (math.pi / 4 + math.pi / 30, -0.35 * math.pi, -math.pi / 4 + math.pi / 8),
)
"""The least and the greatest roll, pitch and yaw at the start, rad."""
STEPS = 15  # disturbances of an episode, each held for a second
EACH = round(gcas.DURATION / gcas.DT) // STEPS
"""Samples of a step."""


def ground_collision_avoidance(
    requirement: str | Formula = "F16", altitude: Numeric = 2262.0, start: Any = None
) -> Simulator:
    """An F-16 dives, and its autopilot levels the wings and pulls up
    (`simulators.arch.gcas` has the autopilot, what of it is our own, and published results;
    `simulators.arch.f16` the aircraft).

    All that is uncertain is the attitude at the start, x0 [3]; nothing disturbs the flight. A step
    is 1 s; samples are 1/30 s apart. A failure violates the requirement; the miss distance is the
    robustness, in feet for "F16" (`jast.specs.under`).

    Args:
        requirement: "F16" (15 s above the ground), or a formula of `Flight`.
        altitude: ft at the start. Traced. From 2262 about as many starts fail here as fail from the
            published 2338 with the published gains; 4040 and 2330 are in use, too.
        start: p(roll, pitch, yaw) [3] in rad, a distribution of `jast.distributions`. None: uniform
            in pi/4 + [-pi/20, pi/30], [-.4 pi, -.35 pi] and -pi/4 + [-pi/8, pi/8].

    Returns:
        `jast.Simulator`.

    Raises:
        ValueError: for an unknown name and an altitude that is not positive.

    Example:
        >>> import jast
        >>> jast.simulators.arch.ground_collision_avoidance(altitude=4040.0).horizon
        15
    """
    name = "ground_collision_avoidance"
    (altitude,) = positive(name, altitude=altitude)
    formula = named(name, "F16", requirement)
    needed = math.ceil(min(reach(formula, gcas.DT), EACH * STEPS) / EACH)
    sim = Simulator(
        init=Partial(_init, altitude),
        step=_step,
        disturbance=_undisturbed,
        evaluate=nothing,
        horizon=STEPS,
        start=_start if start is None else lambda: start,
        is_terminal=ends(needed),
        observe=_observe,
    )
    return under(sim, formula, gcas.DT, samples=samples_of)


def fly(
    roll: Numeric, pitch: Numeric, yaw: Numeric, altitude: Numeric = 2262.0
) -> tuple[gcas.Flight, float]:
    """One flight of 15 s from a given start, such as a published one.

    Args:
        roll, pitch, yaw: rad at the start, numbers.
        altitude: ft at the start.

    Returns:
        (`Flight` [451, ...], 1/30): samples from 0 s on, and the seconds between them.

    Raises:
        ValueError: for angles that are not finite numbers and an altitude that is not positive.

    Example:
        >>> import jast
        >>> trace, dt = jast.simulators.arch.fly(0.8, -1.2, -0.8, altitude=4040.0)
        >>> bool(trace.altitude.min() > 0)
        True
    """
    (altitude,) = positive("fly", altitude=altitude)
    given = dict(roll=roll, pitch=pitch, yaw=yaw)
    attitude = [
        number("fly", name, a, math.isfinite, "of rad that is finite") for name, a in given.items()
    ]
    begin = gcas.start(jnp.array(attitude, jnp.zeros(()).dtype), altitude)
    after = _flown(begin)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, after), gcas.DT


@jax.jit
def _flown(begin: gcas.Flight) -> gcas.Flight:
    return gcas.drive(begin, EACH * STEPS)[1]


def _start() -> Any:
    low, high = (jnp.array(side, jnp.zeros(()).dtype) for side in BOX)
    return Independent(Uniform(low, high), 1)


def _init(altitude: Any, x0: Any) -> Driving:
    return begun(gcas.start(x0, altitude), EACH)


def _step(state: Driving, x: Any) -> Driving:
    return Driving(*gcas.drive(state.now, EACH), state.step + 1)


def _undisturbed(state: Driving) -> Any:
    """A disturbance of no numbers, x [0]."""
    none = jnp.zeros(0, state.now.errors.dtype)
    return Independent(Uniform(none, none + 1), 1)


def _observe(state: Driving) -> Any:
    return ravel(state.now)
