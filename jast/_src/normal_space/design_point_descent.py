"""Descents by gradients to the boundary of failure, in the space of normal numbers
(`normal_space.transform`).

Each step goes to the nearest point of the linearised boundary (Hasofer and Lind 1974; Rackwitz and
Fiessler 1978). A miss distance is flat once a system fails, so a step that arrives among the
failures is halved back to the boundary.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast._src.core.episode import play_chosen
from jast._src.core.rewards import log_likelihood
from jast._src.core.simulator import Simulator
from jast._src.normal_space.transform import outcome, policy_of
from jast._src.runtime._jax import jit

__all__ = ["Descents", "EPISODES", "STEPS", "descents", "differentiable"]

STEPS = 12  # of a descent
HALVINGS = 5  # of the way back to the boundary, in each step
EPISODES = STEPS * (HALVINGS + 1)  # of a descent, beside `STEPS` that are differentiated
# a step ends at most at FARTHER |z| + FIRST: a linear extrapolation can be wild
FARTHER = 1.5
FIRST = 3  # for a start at the origin
BEYOND = 1.0 + 1e-4  # of the boundary, so that rounding leaves failures failures


class Descents(NamedTuple):
    """What n descents came to, [n, ...] each."""

    point: jax.Array
    """[D] the failing point of least norm; the start where there is none."""
    found: jax.Array
    """bool: there is one."""
    nearest: jax.Array
    """[D] the point of least distance among those that were differentiated."""
    distance: jax.Array
    """The distance there; inf where none is valid."""
    useful: jax.Array
    """int32: how many of the gradients led somewhere."""
    failing: jax.Array
    """int32: failing episodes."""
    invalid: jax.Array
    """int32: invalid ones among those that were differentiated."""
    first: jax.Array
    """int32: the step, from 0 on, of which the first failure was; `STEPS` where none was."""
    slopes: jax.Array
    """int32: simulator steps of the episodes that were differentiated."""
    steps: jax.Array
    """int32: simulator steps of the others."""


@jit
def descents(sim: Simulator, starts: jax.Array) -> Descents:
    """`Descents` of ``sim`` from the points ``starts`` [n, D]."""
    return jax.vmap(partial(_one, sim))(starts)


def differentiable(sim, z):
    """The `Episode` of ``z`` [D]: of constant length, so that it can be differentiated backwards,
    and without a random number.
    """
    policy = policy_of(sim, z)

    def choose(state, t, _):
        return D.mode(policy.disturbance(state, t))

    return play_chosen(sim, log_likelihood, D.mode(policy.start()), choose, (), sim.horizon)


def _one(sim, start):
    def step(carry, i):
        z, so_far = carry

        def distance(z):
            e = differentiable(sim, z)
            return e.distance, e

        (g, e), slope = jax.value_and_grad(distance, has_aux=True)(z)
        square = jnp.sum(slope**2)
        usable = jnp.isfinite(g) & jnp.isfinite(square) & (square > 0)
        length = (jnp.dot(slope, z) - g) / jnp.where(usable, square, 1)
        aim = jnp.where(usable, jnp.where(usable, length, 0) * jnp.where(usable, slope, 0), z)
        most = FARTHER * jnp.linalg.norm(z) + FIRST
        shorter = jnp.minimum(1, most / jnp.maximum(jnp.linalg.norm(aim), 1e-6))
        aim = aim * shorter * jnp.asarray(BEYOND, z.dtype)

        def halve(ends, i):
            outside, inside = ends
            halves = i > 0
            here = jnp.where(halves, (outside + inside) / 2, inside)
            there = outcome(sim, here)
            outside = jnp.where(there.failure | ~halves, outside, here)
            inside = jnp.where(there.failure & halves, here, inside)
            return (outside, inside), (there.failure, there.length)

        # one program for the aim and for the halves of the way to it
        number = jnp.arange(HALVINGS + 1, dtype=jnp.int32)
        (outside, inside), (failures_there, lengths) = jax.lax.scan(halve, (z, aim), number)
        fails = failures_there[0]
        closer = jnp.sum(inside**2) < jnp.sum(so_far.point**2)
        better = fails & (~so_far.found | closer)
        nearer = jnp.isfinite(g) & (g < so_far.distance)
        whole = partial(jnp.sum, dtype=jnp.int32)
        failing = whole(e.failure) + whole(failures_there)
        return (
            jnp.where(fails, outside, aim),
            Descents(
                point=jnp.where(better, inside, so_far.point),
                found=so_far.found | fails,
                nearest=jnp.where(nearer, z, so_far.nearest),
                distance=jnp.where(nearer, g, so_far.distance),
                useful=so_far.useful + whole(usable),
                failing=so_far.failing + failing,
                invalid=so_far.invalid + whole(~jnp.isfinite(g)),
                first=jnp.where((failing > 0) & (so_far.first == STEPS), i, so_far.first),
                slopes=so_far.slopes + e.length,
                steps=so_far.steps + whole(lengths),
            ),
        ), None

    none = jnp.zeros((), jnp.int32)
    like = jax.eval_shape(lambda z: outcome(sim, z).distance, start)
    nothing = Descents(
        point=start,
        found=jnp.zeros((), bool),
        nearest=start,
        distance=jnp.asarray(jnp.inf, like.dtype),
        useful=none,
        failing=none,
        invalid=none,
        first=none + STEPS,
        slopes=none,
        steps=none,
    )
    index = jnp.arange(STEPS, dtype=jnp.int32)
    return jax.lax.scan(step, (start, nothing), index)[0][1]
