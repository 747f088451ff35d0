"""Systems of a course and of papers on failure probabilities, with their truths: `CASES`, name ->
(function that makes the simulator, truth).

``simple Gaussian`` and ``collision avoidance`` are systems of the course AA228V, "Validation of
Safety-Critical Systems" (Stanford); ``half-planes`` is the toy of diffusion failure sampling
(Delecki et al. 2024); ``squares`` and ``Himmelblau`` are those of Bayesian safety validation (Moss
et al. 2024), whose third, Booth's function, is in benchmarks/few_calls.py.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from scipy import stats

import jast
from jast import distributions as D

__all__ = ["CASES", "collision_avoidance", "table"]


def one_step(noise: Any, g: Callable) -> jast.Simulator:
    """One step, which fails where ``g`` of its disturbance is at most 0."""

    def evaluate(x):
        value = g(x)
        return value <= 0, jnp.maximum(value, 0.0)

    return jast.Simulator(
        init=lambda x0: jnp.zeros(noise.event_shape),
        step=lambda s, x: x,
        disturbance=lambda s: noise,
        evaluate=evaluate,
        horizon=1,
        episodic=True,
    )


def pair_of(noise):
    """Two numbers, each of them ``noise``."""
    return D.Independent(noise, 1)


def simple_gaussian():
    return one_step(D.Normal(0.0, 1.0), lambda x: x + 2)


def half_planes():
    """abs(x1) >= 3 and x2 >= 3."""
    return one_step(
        pair_of(D.Normal(jnp.zeros(2), 1.0)), lambda x: jnp.maximum(3 - jnp.abs(x[0]), 3 - x[1])
    )


def squares():
    """Inside of a square of half width 1 at (2, 2) or of 1/2 at (8, 8)."""

    def inside(x, centre, half):
        return jnp.max(jnp.abs(x - centre)) - half

    def g(x):
        return jnp.minimum(inside(x, 2.0, 1.0), inside(x, 8.0, 0.5))

    return one_step(pair_of(D.Normal(jnp.full(2, 5.0), 1.0)), g)


def squares_probability():
    def p(low, high):
        return (stats.norm.cdf(high - 5) - stats.norm.cdf(low - 5)) ** 2

    return p(1, 3) + p(7.5, 8.5)


def himmelblau():
    """Himmelblau's function at most 15, of two numbers around 2 or -2, cut at 6 and -6."""
    ways = D.TruncatedNormal(jnp.array([[2.0, -2.0]] * 2), 1.0, -6.0, 6.0)
    noise = D.MixtureSameFamily(D.Categorical(probs=jnp.full((2, 2), 0.5)), ways)
    return one_step(pair_of(noise), lambda x: _himmelblau(x[0], x[1]) - 15)


def _himmelblau(a, b):
    return (a**2 + b - 11) ** 2 + (a + b**2 - 7) ** 2


def himmelblau_probability(nodes=6001):
    x = np.linspace(-6, 6, nodes)
    density = sum(stats.truncnorm(-6 - m, 6 - m, m).pdf(x) for m in (2, -2))
    p = density / density.sum()
    return float(p @ (_himmelblau(x[:, None], x) <= 15) @ p)


# collision avoidance

ALTITUDES = np.linspace(-200, 200, 21)  # m, of the course's grid
RATES = np.linspace(-10, 10, 21)  # m/s
ACTIONS = (-5.0, 0.0, 5.0)  # m/s, advised rates
NOISE = (-2.0, 0.0, 2.0)  # m/s, of the rate, in the decision process
CHANCES = (0.25, 0.5, 0.25)  # of these
TIME = 40  # s to the closest point
NEAR = 50.0  # m: a failure


class Encounter(NamedTuple):
    """Another aircraft, level at the closest point if ``altitude`` is then 0."""

    altitude: Any
    """m"""
    rate: Any
    """m/s"""
    action: Any
    """int, the last one"""
    time: Any
    """s to the closest point"""


@cache
def table() -> np.ndarray:
    """The values of actions [action, time, last action, rate, altitude] that the avoidance system
    looks up: of a Markov decision process in which being within 50 m at the closest point costs
    100, each change of the action 1. Equal to the course's file ``cas_policy.bson`` to 1e-5.
    """
    h, rate = np.meshgrid(ALTITUDES, RATES)
    change = np.array([[a != b for b in ACTIONS] for a in ACTIONS], float)[:, :, None, None]
    q = np.zeros((3, TIME + 1, 3, 21, 21))
    q[:, 0] = -100.0 * (np.abs(h) < NEAR) - change
    for t in range(1, TIME + 1):
        best = q[:, t - 1].max(axis=0)
        for k, a in enumerate(ACTIONS):
            new = rate + (np.clip(a - rate, -1, 1) if a else 0)
            ways = zip(NOISE, CHANCES, strict=True)
            q[k, t] = sum(p * _looked_up(best[k], h + rate, new + x, np) for x, p in ways)
        q[:, t] -= change
    return q


def _looked_up(values, h, rate, np=jnp):
    """``values`` [..., rate, altitude] between the points of the grid."""
    column = np.clip((h - ALTITUDES[0]) / 20, 0, 20)
    row = np.clip(rate - RATES[0], 0, 20)
    i, j = (np.clip(v.astype(int), 0, 19) for v in (row, column))
    u, v = row - i.astype(row.dtype), column - j.astype(row.dtype)
    below = (1 - v) * values[..., i, j] + v * values[..., i, j + 1]
    above = (1 - v) * values[..., i + 1, j] + v * values[..., i + 1, j + 1]
    return (1 - u) * below + u * above


def collision_avoidance():
    """Within 50 m at the closest point, after 40 s, with noise of 1.5 m/s in the rate of climb.

    The course's step is kept as it is, with a slip: a rate that is within 1 m/s of the action
    doubles.
    """
    values = jnp.asarray(table(), float)
    return jast.Simulator(
        init=lambda x0: Encounter(*x0, jnp.ones((), jnp.int32), jnp.full((), TIME, jnp.int32)),
        step=Partial(_avoided, values),
        disturbance=lambda s: D.Normal(0.0, 1.5),
        evaluate=_near,
        horizon=TIME,
        start=lambda: D.Joint((D.Uniform(-100.0, 100.0), D.Uniform(-10.0, 10.0))),
        episodic=True,
    )


def _avoided(values, s, x):
    worth = _looked_up(values[:, s.time, s.action], s.altitude, s.rate)
    k = jnp.argmax(worth)
    a = jnp.array(ACTIONS)[k].astype(x.dtype)
    turn = jnp.where(jnp.abs(a - s.rate) < 1, a, jnp.sign(a - s.rate))
    rate = s.rate + jnp.where(a == 0, 0, turn) + x
    return Encounter(s.altitude + s.rate, rate, k.astype(jnp.int32), s.time - 1)


def _near(s):
    return jnp.abs(s.altitude) <= NEAR, jnp.maximum(jnp.abs(s.altitude) - NEAR, 0.0)


# collision avoidance: crude Monte Carlo, a standard error of 1.2 %
CASES: dict[str, tuple[Callable, float]] = {
    "simple Gaussian": (simple_gaussian, float(stats.norm.cdf(-2))),
    "half-planes": (half_planes, float(2 * stats.norm.sf(3) ** 2)),
    "squares": (squares, float(squares_probability())),
    "Himmelblau": (himmelblau, himmelblau_probability()),
    "collision avoidance": (collision_avoidance, 7255 / 4e7),
}
