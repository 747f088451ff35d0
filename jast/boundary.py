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

from jast.episode import rollout
from jast.limit_state import outcome, policy_of
from jast.rewards import log_likelihood
from jast.simulator import Simulator

__all__ = ["Descents", "descents", "EPISODES"]

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


@jax.jit
def descents(sim: Simulator, starts: jax.Array) -> Descents:
    """`Descents` of ``sim`` from the points ``starts`` [n, D]."""
    return jax.vmap(partial(_one, sim))(starts)


def _one(sim, start):
    def step(carry, i):
        z, best, found, nearest, least, counts = carry

        def distance(z):
            e = rollout(jax.random.key(0), sim, policy_of(sim, z), log_likelihood)
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

        def halve(ends, _):
            outside, inside = ends
            middle = (outside + inside) / 2
            there = outcome(sim, middle)
            ends = (
                jnp.where(there.failure, outside, middle),
                jnp.where(there.failure, middle, inside),
            )
            return ends, (there.failure, there.length)

        there = outcome(sim, aim)
        fails = there.failure
        (outside, inside), halved = jax.lax.scan(halve, (z, aim), length=HALVINGS)
        better = fails & (~found | (jnp.sum(inside**2) < jnp.sum(best**2)))
        whole = lambda v: jnp.sum(v, dtype=jnp.int32)
        failing = whole(e.failure) + whole(fails) + whole(halved[0])
        useful, failures, invalid, first, slopes, steps = counts
        counts = (
            useful + whole(usable),
            failures + failing,
            invalid + whole(~jnp.isfinite(g)),
            jnp.where((failing > 0) & (first == STEPS), i, first),
            slopes + e.length,
            steps + there.length + whole(halved[1]),
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
