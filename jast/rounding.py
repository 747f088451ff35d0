"""Whether the floats of a state are fine enough for what a disturbance does to it.

A position of 4.6e6 m in float32 moves in steps of half a metre: what pushes it by five is rounded,
at every step, and so is the probability of where it ends.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._jax import quick
from jast.counter import COUNTER
from jast.incidents import hosted
from jast.simulator import Simulator

__all__ = ["rounded"]

PAIRS, STEPS = 16, 500
UNITS, SHARE = 32.0, 0.02
"""A disturbance that moves a number by fewer units of its last place is rounded; it matters where
rounding moves the miss distance by more than this share of what the disturbances do. A random walk
whose steps have a standard deviation of 10 units is off by 1 % at 4.5 standard deviations.
"""


def rounded(sim: Simulator) -> str | None:
    """A text that says so where the dtype of the state rounds what the disturbances do; None where
    it does not, and for a system on the host. Runs 48 episodes at most.

    Three paths share their random numbers: one as it is, one with a disturbance drawn anew, whose
    effect is told in units of the last place, and one whose state is moved by such a unit at every
    step.
    """
    if hosted(sim):
        return None
    units, moved, spread = jax.device_get(_looked_at(sim))
    least = [u for u in (np.nanmin(a, initial=np.inf) for a in units) if u < UNITS]
    if not least or not moved > SHARE * spread:
        return None
    return (
        "the state is too coarse: a disturbance changes one of its numbers by only"
        f" {min(least):.2g} units in the last place, and rounding changes the miss distance by"
        f" {moved / spread:.0%} as much as the disturbances do; take large offsets out of the"
        " state, or use float64"
    )


@quick
def _looked_at(sim):
    """The median, over the pairs, of the units by which each number of the state that a disturbance
    moves is moved, a list of arrays; the deviation of the miss distance that rounding makes, and
    that of the disturbances.
    """
    steps = min(sim.horizon, STEPS)
    key = jax.random.key(0, impl=COUNTER)
    words = jax.random.key_data(key).shape
    keys = jax.random.bits(key, (PAIRS, steps + 2, *words), jnp.uint32)
    units, distance = jax.vmap(partial(_three, sim, steps))(keys)
    units = [jnp.nanmedian(jnp.where(u > 0, u, jnp.nan), axis=0) for u in units]
    gap = distance[:, 2] - distance[:, 0]
    gap = jnp.where(jnp.isfinite(gap), gap, 0)
    # a whole unit has the deviation of 12 ** 0.5 roundings
    moved = jnp.sqrt(jnp.mean(gap**2) / 12)
    first = jnp.where(jnp.isfinite(distance[:, 0]), distance[:, 0], 0)
    return units, moved, jnp.std(first)


def _three(sim: Simulator, steps: int, keys: jax.Array) -> tuple[list[Any], jax.Array]:
    """The greatest way between the first two paths, in units, for each float of the state; the miss
    distances [3]. ``keys``: the data of keys, uint32: of the start, of the disturbance drawn anew,
    of the steps.
    """
    # programs with the default generator take longer to compile
    seed, made = keys[0, 0], partial(jax.random.wrap_key_data, impl=COUNTER)
    when = (seed % max(steps // 2, 1)).astype(jnp.int32)
    which = jnp.arange(3, dtype=jnp.int32)
    state = sim.init(D.sample(sim.start(), made(keys[0])))
    repeated = lambda a: jnp.broadcast_to(jnp.asarray(a)[None], (3, *jnp.shape(a)))
    states = jax.tree.map(repeated, state)

    def step(i, t, state):
        drawn = keys[jnp.where((i == 1) & (t == when), 1, 2 + t)]
        new = sim.step(state, D.sample(sim.disturbance(state), made(drawn)))
        return jax.tree.map(
            lambda a: jnp.where(i == 2, _a_unit_off(seed + t.astype(seed.dtype), a), a), new
        )

    def judged(state):
        event, distance, *_ = sim.evaluate(state)
        return event | sim.is_terminal(state), distance

    def body(carry):
        t, states, units, distance, _ = carry
        states = jax.vmap(step, (0, None, 0))(which, t, states)
        if not sim.episodic:
            done, now = jax.vmap(judged)(states)
            distance = jnp.minimum(distance, now.astype(distance.dtype))
        else:
            done = jnp.zeros(3, bool)
        units = [jnp.maximum(u, _apart(a)) for u, a in zip(units, _floats(states), strict=True)]
        return t + 1, states, units, distance, jnp.any(done)

    dtype = jax.eval_shape(judged, state)[1].dtype
    zero = [jnp.zeros_like(a[0]) for a in _floats(states)]
    first = jnp.int32(0), states, zero, jnp.full(3, jnp.inf, dtype), jnp.zeros((), bool)
    _, states, units, distance, _ = lax.while_loop(lambda c: (c[0] < steps) & ~c[4], body, first)
    return units, jax.vmap(judged)(states)[1] if sim.episodic else distance


def _floats(tree: Any) -> list[jax.Array]:
    return [a for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]


def _apart(a: jax.Array) -> jax.Array:
    """How far the second path is from the first, in units of the last place."""
    size = jnp.abs(a[0])
    units = jnp.abs(a[1] - a[0]) / (jnp.nextafter(size, jnp.full_like(size, jnp.inf)) - size)
    return jnp.where(jnp.isfinite(units), units, 0)


def _a_unit_off(seed: jax.Array, a: jax.Array) -> jax.Array:
    """``a`` with each float a unit of the last place higher or lower, by a hash of ``seed``
    (uint32) and its place.
    """
    a = jnp.asarray(a)
    if not jnp.issubdtype(a.dtype, jnp.floating):
        return a
    h = (jnp.arange(a.size, dtype=jnp.uint32).reshape(a.shape) * 40503 + seed) * jnp.uint32(
        2654435761
    )
    h = (h ^ (h >> 15)) * jnp.uint32(2246822519)
    up = (h ^ (h >> 13)) * jnp.uint32(3266489917) >> 31 == 1
    return jnp.nextafter(a, jnp.where(up, jnp.inf, -jnp.inf).astype(a.dtype))
