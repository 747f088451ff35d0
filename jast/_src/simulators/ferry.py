"""S0: a vessel that steers at random meets a ferry that reacts to nothing (Lytskjold and Mengshoel,
MCFS-AP).

Plane of about 100 x 100, x right, y up, no units. Known truth (uniform random seeds, float64): mean
closest approach 23.95, no collision in 2,000,000 episodes, best reward of 9000 about -16. A seed
held constant never hits (the best, 0.8363, comes to 10.0075). Undisturbed (0.5 throughout): no
failure, closest approach 24.2074. Best known failure: reward 29.649, seeds 0.97138 x4, 0.9566,
0.87626, 0.77608, 0.68724, then 0.63524 held; collision at step 20. The published best is 29.092.
Rewards are those of ``standard(event_bonus=30., density="mode")`` with actions ``uniform(0., 1.)``.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.util.checks import one_of
from jast.distributions import Uniform, tent, where

__all__ = ["COLLISION", "FerryState", "ferry"]

SPEED = 5.0  # m a step, of both vessels
COLLISION = 5.0  # m between them


class FerryState(NamedTuple):
    """Positions of both vessels, the adversary's heading (radians, from +y towards +x), its last
    seed and whether one was drawn yet.
    """

    ferry_x: jax.Array
    ferry_y: jax.Array
    x: jax.Array
    y: jax.Array
    heading: jax.Array
    seed: jax.Array
    moving: jax.Array


def ferry(
    adversary: tuple[float, float] = (16.0, 0.0), observation: Literal["code", "text"] = "code"
) -> Simulator:
    """The S0 ferry: a `Simulator` of horizon 21.

    A step turns the adversary by (10 a - 5) pi / 100 radians, a in [0, 1] its seed (0.5: straight
    on), then moves both vessels by 5. The first seed is uniform, each next one tent-shaped around
    the last: mode-normalised log p is ln(1 - |a_t - a_{t-1}|). Failure: centres closer than 5 at a
    step's end. Ends after 21 steps, when the ferry has left the plane (x > 100).

    Args:
        adversary: where the steered vessel starts; (17, 0) is the easier S0b.
        observation: what networks see. "code": the five numbers of the published code: the ferry's
            x and the adversary's x and y over 100, and half of the sine and cosine of its heading
            plus a half. "text": x and y over 100 and heading (radians) of both vessels, the six
            numbers that the published text names.

    Raises:
        ValueError: unless ``adversary`` is two numbers, and for another observation.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.ferry()
        >>> bool(jast.replay(sim, jnp.full(21, 0.5)).failure)  # straight on
        False
    """
    one_of("ferry", "observation", observation, OBSERVATIONS)
    try:
        start = jnp.asarray(adversary)
    except (TypeError, ValueError):
        start = jnp.zeros(())
    if start.shape != (2,):
        raise ValueError(f"ferry: adversary must be two numbers (x, y), received {adversary!r}")
    if not jnp.issubdtype(start.dtype, jnp.floating):
        start = start.astype(jnp.zeros(()).dtype)
    return Simulator(
        init=Partial(_init, start),
        step=_step,
        disturbance=_disturbance,
        evaluate=_evaluate,
        horizon=21,
        is_terminal=_is_terminal,
        observe=OBSERVATIONS[observation],
    )


def _init(adversary, x0):
    zero = jnp.zeros((), adversary.dtype)
    return FerryState(
        ferry_x=zero,
        ferry_y=zero + 50,
        x=adversary[0],
        y=adversary[1],
        heading=zero,
        seed=zero + 0.5,
        moving=jnp.zeros((), bool),
    )


def _step(s, a):
    heading = s.heading + (10 * a - 5) * jnp.asarray(jnp.pi / 100, a.dtype)
    return FerryState(
        ferry_x=s.ferry_x + SPEED,
        ferry_y=s.ferry_y,
        x=s.x + SPEED * jnp.sin(heading),
        y=s.y + SPEED * jnp.cos(heading),
        heading=heading,
        seed=a,
        moving=jnp.ones((), bool),
    )


def _disturbance(s):
    zero = jnp.zeros_like(s.seed)
    return where(s.moving, tent(s.seed), Uniform(zero, zero + 1))


def _evaluate(s):
    distance = jnp.sqrt((s.x - s.ferry_x) ** 2 + (s.y - s.ferry_y) ** 2)
    return distance < COLLISION, distance


def _is_terminal(s):
    return s.ferry_x > 100


def _observe(s):
    """The five numbers of the published code's networks."""
    way = jnp.sin(s.heading) / 2 + 0.5, jnp.cos(s.heading) / 2 + 0.5
    return jnp.stack([s.ferry_x / 100, s.x / 100, s.y / 100, *way])


def _observe_text(s):
    """Six numbers: x, y and heading of both vessels. The ferry's heading, to +x, is pi / 2."""
    east = jnp.full_like(s.heading, jnp.pi / 2)
    x, y = s.x / 100, s.y / 100
    return jnp.stack([s.ferry_x / 100, s.ferry_y / 100, east, x, y, s.heading])


OBSERVATIONS = {"code": _observe, "text": _observe_text}
