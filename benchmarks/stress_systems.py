"""Systems with failures to find, most of which have a known likeliest one.

None of the settings of jast was tuned on those of `JUDGED`, but for `relay`, whose first result
made us look for systems like it; `TUNED` served while the search was written, and `BUILT_IN` are
the simulators of jast, some of which did.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

import jast
from benchmarks import closed_loops
from benchmarks.closed_loops import system
from jast import simulators
from jast.distributions import Categorical, MultivariateNormalDiag, Normal

__all__ = ["BUILT_IN", "CASES", "Case", "JUDGED", "LOOPS", "TUNED"]


class Case(NamedTuple):
    """A system, and what is known of its likeliest failure."""

    make: Callable[[], jast.Simulator]
    optimum: float | None = None
    """log p - log p(mode) of the likeliest failure, in closed form; None where there is none."""
    modes: int | None = None
    """How many failure modes were planted."""


def linear(steps, beta=4.55, sides=1, decay=0.95):
    """A first-order filter of white noise leaves its band: log p - log p(mode) = -beta^2 / 2, at
    the last step.
    """
    limit = beta * math.sqrt(sum(decay ** (2 * i) for i in range(steps)))

    def distance(y):
        return limit - (jnp.abs(y) if sides == 2 else y)

    return system(0.0, lambda y, x: decay * y + x, distance, 1, steps)


def lane(gain=0.3):
    """The lane of the README: a car keeps its lane in gusts of wind, steering back by ``gain``."""

    def step(car, gust):
        offset, speed = car
        speed = 0.8 * speed - gain * offset + 0.1 * gust
        return jnp.stack([offset + speed, speed])

    return system([0.0, 0.0], step, lambda car: 1.4 - jnp.abs(car[0]), 1, 30)


def car():
    """The car of notebooks/quickstart: noise in two measurements, a leader that brakes."""
    dt, first = 0.5, [29.0, 25.0, 25.0, 0.0]
    noise = MultivariateNormalDiag(jnp.zeros(2), jnp.array([2.0, 1.0]))

    def step(s, x):
        gap, speed, leader, time = s
        leader = jnp.maximum(leader - dt * jnp.where(time >= 1, 5.0, 0.0), 0.0)
        wish = 0.4 * (gap + x[0] - 4 - speed) + 0.8 * (leader + x[1] - speed)
        speed = jnp.maximum(speed + dt * jnp.clip(wish, -7.0, 2.0), 0.0)
        return jnp.stack([gap + dt * (leader - speed), speed, leader, time + dt])

    return system(first, step, lambda s: s[0], 2, 20, disturbance=lambda s: noise)


def drone():
    """A drone in gusts [3] is steered back to its place, with limited thrust, and must stay within
    2 m.
    """
    dt = 0.1

    def step(s, gust):
        place, speed = s[:3], s[3:]
        thrust = jnp.clip(-3.0 * place - 2.5 * speed, -4.0, 4.0)
        speed = speed + dt * (thrust + 2.5 * gust - 0.1 * speed * jnp.linalg.norm(speed + 1e-6))
        return jnp.concatenate([place + dt * speed, speed])

    def distance(s):
        return 2.0 - jnp.linalg.norm(s[:3] + 1e-6)

    noise = MultivariateNormalDiag(jnp.zeros(3), jnp.ones(3))
    return system(jnp.zeros(6), step, distance, 3, 60, disturbance=lambda s: noise)


def relay():
    """A pendulum-like plant under an if/else controller with a dead zone."""

    def step(s, push):
        x, v = s
        u = jnp.where(x > 0.2, -1.0, jnp.where(x < -0.2, 1.0, 0.0))
        v = 0.97 * v + 0.1 * (u + 0.5 * x) + 0.06 * push
        return jnp.stack([x + 0.2 * v, v])

    return system([0.0, 0.0], step, lambda s: 1.8 - jnp.abs(s[0]), 1, 60)


def slips():
    """A walker on a ledge slips (three kinds of step), and falls off after three slips in a row:
    3 log(.04 / .9).
    """

    def step(s, kind):
        place, depth = s
        depth_next = jnp.where(kind == 1, depth + 1, jnp.where(kind == 2, depth, depth - 1))
        ahead = jnp.where((kind == 0) & (depth == 0), 1, 0)
        return jnp.stack([place + ahead, jnp.maximum(depth_next, 0)])

    return jast.Simulator(
        init=lambda x0: jnp.zeros(2, jnp.int32),
        step=step,
        disturbance=lambda s: Categorical(probs=jnp.array([0.9, 0.04, 0.06])),
        evaluate=lambda s: (s[1] >= 3, (3 - s[1]).astype(float)),
        is_terminal=lambda s: s[0] >= 12,
        horizon=40,
    )


def latch(steps=50, threshold=1.88):
    """Four disturbances in a row above a threshold, and nothing that says how near one is."""

    def step(run, x):
        return jnp.where(x >= threshold, run + 1, 0)

    return jast.Simulator(
        init=lambda x0: jnp.int32(0),
        step=step,
        disturbance=lambda run: Normal(0.0, 1.0),
        evaluate=lambda run: (run >= 4, jnp.where(run >= 4, 0.0, 1.0)),
        horizon=steps,
    )


PEDESTRIANS = (8, 5.0, 0.4), (15, 7.2, 0.4)  # when the car passes, how far away, noise a step


def pedestrians():
    """Two pedestrians stray at random; each is hit if it is on the road when the car passes."""
    (when_a, away_a, noise), (when_b, away_b, _) = PEDESTRIANS

    def evaluate(s):
        a, b, t = s
        hit = ((t == when_a) & (a <= 0)) | ((t == when_b) & (b <= 0))
        near = jnp.where(
            t == when_a, jnp.maximum(a, 0.0), jnp.where(t == when_b, jnp.maximum(b, 0.0), away_b)
        )
        return hit, near

    return jast.Simulator(
        init=lambda x0: jnp.array([away_a, away_b, 0.0]),
        step=lambda s, x: jnp.concatenate([s[:2] + noise * x, s[2:] + 1]),
        disturbance=lambda s: MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)),
        evaluate=evaluate,
        horizon=16,
    )


def branches(beta=4.0):
    """Four failure modes of one step in a plane, at the distances beta to beta + .3."""
    unit = jnp.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]) / math.sqrt(2)
    limits = beta + jnp.array([0.0, 0.1, 0.2, 0.3])

    def distance(x):
        return jnp.min(limits - unit @ x)

    noise = MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2))
    return system(jnp.zeros(2), lambda s, x: x, distance, 2, 1, disturbance=lambda s: noise)


def wander():
    """Two hundred steps of a steered vessel in a channel, in waves that it feels late."""

    def step(s, wave):
        y, v, late = s
        v = 0.9 * v - 0.05 * late + 0.05 * wave
        return jnp.stack([y + v, v, 0.5 * late + 0.5 * y])

    return system([0.0, 0.0, 0.0], step, lambda s: 7.5 - jnp.abs(s[0]), 1, 200)


def _cost(steps, away, noise):
    return -(away**2) / (2 * steps * noise**2)


LINEAR = -(4.55**2) / 2
TUNED = {
    "linear-10": Case(lambda: linear(10), LINEAR, 1),
    "linear-50": Case(lambda: linear(50), LINEAR, 1),
    "linear-50-two": Case(lambda: linear(50, sides=2), LINEAR, 2),
    "lane": Case(lane, 19.209 - 30),
    "car": Case(car),
    "pedestrians": Case(pedestrians, max(_cost(*p) for p in PEDESTRIANS), 2),
}
JUDGED = {
    "linear-300": Case(lambda: linear(300), LINEAR, 1),
    "linear-300-two": Case(lambda: linear(300, sides=2), LINEAR, 2),
    "drone": Case(drone),
    "relay": Case(relay),
    "slips": Case(slips, 3 * math.log(0.04 / 0.9)),
    "latch": Case(latch, -2 * 1.88**2),
    "branches": Case(branches, -8.0, 4),
    "wander": Case(wander),
}
BUILT_IN = {
    "ferry": Case(simulators.ferry),
    "pendulum": Case(simulators.pendulum),
    "walk": Case(simulators.walk1d, _cost(30, 10.0, 1.0)),
    "landing": Case(simulators.landing),
    "autoregression": Case(simulators.autoregression),
    "ruin": Case(simulators.ruin),
    "colav head-on": Case(lambda: simulators.colav("head-on", "steering")),
    "colav turn": Case(lambda: simulators.colav("sharp turn", "delay")),
}
CASES = TUNED | JUDGED | BUILT_IN
LOOPS = {
    f"{a.name} loop": Case(lambda sim=a.simulator: sim)
    for a in (*closed_loops.TUNED, *closed_loops.JUDGED, *closed_loops.RARE)
}
"""Those of `benchmarks.closed_loops`, whose likeliest failures are not known."""
