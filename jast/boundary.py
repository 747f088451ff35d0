"""Descents by gradients to the boundary of failure, in the space of normal numbers
(`jast.limit_state`).

Each step goes to the nearest point of the linearised boundary (Hasofer and Lind 1974; Rackwitz and
Fiessler 1978). A miss distance is flat once a system fails, so a step that arrives among the
failures is halved back to the boundary.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast._jax import jit
from jast.episode import play_chosen
from jast.limit_state import outcome, policy_of
from jast.rewards import log_likelihood
from jast.simulator import Simulator

__all__ = ["Descents", "EPISODES", "descents", "differentiable"]

STEPS, HALVINGS = 12, 5
EPISODES = STEPS * (HALVINGS + 1)
"""Episodes of one descent, beside `STEPS` that are differentiated."""


class Descents(NamedTuple):
    """What n descents came to, [n, ...] each."""

    point: jax.Array
    """[D] the failing point of least norm; the start where there is none."""
    found: jax.Array
    """bool: there is one."""
    nearest: jax.Array
    """[D] the point of least distance among those that were differentiated, and"""
    distance: jax.Array
    """its distance; inf where none is valid."""
    useful: jax.Array
    """int32: how many of the gradients led somewhere."""
    failing: jax.Array
    """int32: failing episodes."""
    invalid: jax.Array
    """int32: invalid ones among those that were differentiated."""
    first: jax.Array
    """int32: the step, from 0 on, of which the first failure was; `STEPS` where none was."""
    slopes: jax.Array
    """int32: simulator steps of the episodes that were differentiated, and"""
    steps: jax.Array
    """int32: those of the others."""


@jit
def descents(sim: Simulator, starts: jax.Array) -> Descents:
    """`Descents` of ``sim`` from the points ``starts`` [n, D]."""
    return jax.vmap(partial(_one, sim))(starts)


def differentiable(sim, z):
    """The `Episode` of ``z`` [D]: of constant length, so that it can be differentiated backwards,
    and without a random number.
    """
    policy = policy_of(sim, z)
    choose = lambda state, t, _: D.mode(policy.disturbance(state, t))
    return play_chosen(sim, log_likelihood, D.mode(policy.start()), choose, (), sim.horizon)


def _one(sim, start):
    def step(carry, i):
        z, best, found, nearest, least, counts = carry

        def distance(z):
            e = differentiable(sim, z)
            return e.distance, e

        (g, e), slope = jax.value_and_grad(distance, has_aux=True)(z)
        square = jnp.sum(slope**2)
        usable = jnp.isfinite(g) & jnp.isfinite(square) & (square > 0)
        aim = jnp.where(
            usable, (jnp.dot(slope, z) - g) / jnp.where(usable, square, 1), 0
        ) * jnp.where(usable, slope, 0)
        aim = jnp.where(usable, aim, z)
        # a linear extrapolation of a curved function can be wild: no step ends farther out than the
        # last one by more than half
        length = jnp.linalg.norm(aim)
        most = 1.5 * jnp.linalg.norm(z) + 3
        aim = (
            aim
            * jnp.minimum(1, most / jnp.maximum(length, 1e-6))
            * jnp.asarray(1.0 + 1e-4, z.dtype)
        )

        def halve(ends, i):
            outside, inside = ends
            here = jnp.where(i == 0, inside, (outside + inside) / 2)
            there = outcome(sim, here)
            halves = i > 0
            ends = (
                jnp.where(there.failure | ~halves, outside, here),
                jnp.where(there.failure & halves, here, inside),
            )
            return ends, (there.failure, there.length)

        # one program for the aim and for the halves of the way to it
        number = jnp.arange(HALVINGS + 1, dtype=jnp.int32)
        (outside, inside), (failures_there, lengths) = jax.lax.scan(halve, (z, aim), number)
        fails = failures_there[0]
        better = fails & (~found | (jnp.sum(inside**2) < jnp.sum(best**2)))
        whole = lambda v: jnp.sum(v, dtype=jnp.int32)
        failing = whole(e.failure) + whole(failures_there)
        useful, failures, invalid, first, slopes, steps = counts
        counts = (
            useful + whole(usable),
            failures + failing,
            invalid + whole(~jnp.isfinite(g)),
            jnp.where((failing > 0) & (first == STEPS), i, first),
            slopes + e.length,
            steps + whole(lengths),
        )
        nearer = jnp.isfinite(g) & (g < least)
        return (
            jnp.where(fails, outside, aim),
            jnp.where(better, inside, best),
            found | fails,
            jnp.where(nearer, z, nearest),
            jnp.where(nearer, g, least),
            counts,
        ), None

    none = jnp.zeros((), jnp.int32)
    like = jax.eval_shape(lambda z: outcome(sim, z).distance, start)
    least = jnp.asarray(jnp.inf, like.dtype)
    counts = none, none, none, none + STEPS, none, none
    first = start, start, jnp.zeros((), bool), start, least, counts
    index = jnp.arange(STEPS, dtype=jnp.int32)
    (_, best, found, nearest, least, counts), _ = jax.lax.scan(step, first, index)
    return Descents(best, found, nearest, least, *counts)
