"""Systems whose failures have causes that were planted, for `benchmarks.explain`.

The settings of `jast.explain.rules` and `monitor` were chosen on the systems of
`benchmarks.stress_systems`, not on these; but that variants of failures also move in time was added
after two seeds of "one step of 50".
"""

import math
from statistics import NormalDist
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jast
from benchmarks.closed_loops import system
from jast.distributions import Exponential, Joint, Normal

__all__ = ["PLANTED", "Planted", "lane", "planted", "version", "walk"]

STEPS = 50  # of an episode
DELAY = 0.2  # s, the mean
FIELDS = ("delay", "gust")  # of a disturbance
PLANTED = (
    "one step of 50",
    "two causes, 1 to 20",
    "delay with a gust",
    "delay with a gust, any step",
)
NEVER = -100.0
"""A limit that every disturbance is above."""


class Planted(NamedTuple):
    """A system, and what leads to its failures."""

    sim: jast.Simulator
    causes: list
    """For each cause the limits of (step, field), of which all must be passed; a cause that may
    come at any step has the step None."""

    def named(self, cause: int) -> set:
        """What a rule for the cause speaks of."""
        if any(step is None for step, _ in self.causes[cause]):
            return {"greatest gust", "delay while gust is greatest"}
        return {f"{field} at step {step}" for step, field in self.causes[cause]}

    def failing(self, rng: np.random.Generator, cause: int, n: int) -> Any:
        """Disturbances [n, steps] of failures by one cause, as probable as in the model."""
        x, at = _model(rng, n), rng.integers(0, STEPS, n)
        for (step, field), limit in self.causes[cause].items():
            u, rows = 1 - rng.random(n), np.arange(n)
            tail = np.array([NormalDist().inv_cdf(v) for v in u * NormalDist().cdf(-limit)])
            beyond = limit - DELAY * np.log(u) if field == "delay" else -tail
            # just above, whatever a float32 makes of it
            x[field][rows, at if step is None else step - 1] = beyond * (1 + 1e-6)
        return x

    def sample(self, rng: np.random.Generator, n: int) -> Any:
        """Disturbances [n, steps] of failures, by all causes as often as in the model."""
        rarer = int((rng.random(n) < 1 / 21).sum()) if len(self.causes) == 2 else 0
        parts = [self.failing(rng, 0, n - rarer)]
        parts += [self.failing(rng, 1, rarer)] if rarer else []
        return {field: np.concatenate([x[field] for x in parts]) for field in FIELDS}

    def near(self, rng: np.random.Generator, cause: int, n: int) -> Any:
        """Disturbances [n, steps] of which those that matter are anywhere up to a quarter beyond
        their limits; some fail.
        """
        x, at = _model(rng, n), rng.integers(0, STEPS, n)
        for (step, field), limit in self.causes[cause].items():
            x[field][np.arange(n), at if step is None else step - 1] = 1.25 * limit * rng.random(n)
        return x

    def episodes(self, x: Any) -> jast.Episode:
        """These disturbances, played."""
        each = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), x)
        return _replayed(self.sim, each)


@jax.jit
def _replayed(sim, x):
    return jax.vmap(lambda one: jast.replay(sim, one)._replace(states=None))(x)


def _model(rng, n):
    gust, delay = rng.standard_normal((n, STEPS)), rng.exponential(DELAY, (n, STEPS))
    return dict(delay=delay, gust=gust)


def planted(name: str, seed: int) -> Planted:
    """One of `PLANTED`, with steps drawn by ``seed``."""
    rng = np.random.default_rng([seed, PLANTED.index(name)])
    first, second = (int(t) for t in 1 + rng.choice(STEPS, 2, replace=False))

    def rare(p):
        return -NormalDist().inv_cdf(p)

    def late(p):
        return -DELAY * math.log(p)

    if name == "one step of 50":
        causes = [{(first, "gust"): rare(3e-6)}]
    elif name == "two causes, 1 to 20":
        causes = [{(first, "gust"): rare(4e-5)}, {(second, "gust"): rare(2e-6)}]
    elif name == "delay with a gust":
        causes = [{(first, "delay"): late(2e-3), (first, "gust"): rare(2e-3)}]
    else:
        causes = [{(None, "delay"): late(1e-2), (None, "gust"): rare(2e-4)}]
        limits = jnp.array([causes[0][None, field] for field in FIELDS])
        return Planted(_any_step(limits), causes)
    limits = np.full((2, STEPS, len(FIELDS)), NEVER)
    if len(causes) == 1:
        limits[1] = -NEVER
    for k, cause in enumerate(causes):
        for (step, field), limit in cause.items():
            limits[k, step - 1, FIELDS.index(field)] = limit
    return Planted(_planted(jnp.asarray(limits)), causes)


class Short(NamedTuple):
    t: jax.Array
    short: jax.Array
    """By how much each cause has been missed, at most."""


def _weather(s):
    return Joint(dict(delay=Exponential(1 / DELAY), gust=Normal(0.0, 1.0)))


def _row(x):
    return jnp.stack([x[field] for field in FIELDS])


def _step_of_causes(limits, s, x):
    return Short(s.t + 1, jnp.maximum(s.short, jnp.max(limits[:, s.t] - _row(x)[None], axis=1)))


def _evaluate(s):
    near = jnp.maximum(jnp.min(s.short), 0.0)
    return near <= 0, near


def _planted(limits):
    """Fails where at the end all limits of a cause [k, steps, fields] were passed."""
    init, step = Partial(_begin, jnp.full(2, NEVER)), Partial(_step_of_causes, limits)
    return jast.Simulator(init, step, _weather, _evaluate, STEPS, episodic=True)


def _any_step(limits):
    """Fails at the first step at which all limits [fields] are passed."""
    init, step = Partial(_begin, jnp.full(2, 3.0)), Partial(_step_of_any, limits)
    return jast.Simulator(init, step, _weather, _evaluate, STEPS)


def _begin(short, x0):
    return Short(jnp.zeros((), jnp.int32), short)


def _step_of_any(limits, s, x):
    return Short(s.t + 1, jnp.full(2, jnp.max(limits - _row(x))))


def walk(limit, steps=20):
    """A random walk that fails above ``limit`` at its end: from s after t steps with the
    probability Phi((s - limit) / sqrt(steps - t)).
    """
    return system(0.0, lambda s, x: s + x, lambda s: limit - s, 1, steps, episodic=True)


class Car(NamedTuple):
    offset: jax.Array
    drift: jax.Array


def lane(gust, camera):
    """A car keeps its lane in gusts, by a camera with errors: no closed form is known."""
    return jast.Simulator(
        init=lambda x0: Car(jnp.array(0.0), jnp.array(0.0)),
        step=_steered,
        disturbance=Partial(_lane_weather, jnp.asarray(gust), jnp.asarray(camera)),
        evaluate=lambda c: (jnp.abs(c.offset) >= 1.2, jnp.maximum(1.2 - jnp.abs(c.offset), 0.0)),
        horizon=8,
    )


def _steered(car, x):
    drift = 0.8 * car.drift - 0.3 * (car.offset + x["camera"]) + x["gust"]
    return Car(car.offset + drift, drift)


def _lane_weather(gust, camera, car):
    zero = jnp.zeros_like(gust)
    return Joint(dict(camera=Normal(zero, camera), gust=Normal(zero, gust)))


SIDE = 4.753424
"""Phi(-SIDE) = 1e-6."""


def version(new: bool):
    """A controller that holds a load against gusts on either side: both versions let go above 3.6
    standard deviations of the sum of two; the new one, by a wrong branch, below -`SIDE`, too.
    """

    def distance(s):
        return jnp.where(s > 0, 3.6 - s, s + SIDE if new else 10.0)

    return system(0.0, lambda s, x: s + x / math.sqrt(2), distance, 1, 2, episodic=True)
