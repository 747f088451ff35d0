"""Most probable failure points by gradients: the points of least norm on the boundary of failure,
from many starts.

Each step goes to the nearest point of the linearised boundary (Hasofer and Lind 1974; Rackwitz and
Fiessler 1978). A miss distance is flat once a system fails, so a step that arrives among the
failures is halved back to the boundary.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast.episode import rollout
from jast.limit_state import dimension, normal_numbers, outcome, policy_of
from jast.rewards import log_likelihood

__all__ = ["design_points", "distinct"]

STEPS, HALVINGS = 12, 5
APART = 0.5
"""Points nearer to one another than so much of their norm are one."""
GRADIENT = 3
"""Evaluations that a value with its gradient is counted as."""


class DesignPoints(NamedTuple):
    """On the host."""

    points: np.ndarray
    """[m, D] distinct failing points next to the boundary, by rising norm"""
    evaluations: int


def design_points(key, sim, starts=48, limit=16):
    """At most ``limit`` distinct `DesignPoints` of ``sim`` from ``starts`` draws of the model; none
    where the miss distance has no useful gradient.
    """
    z = jax.random.normal(key, (starts, dimension(sim)), normal_numbers(sim))
    points, failing = jax.device_get(_descend(sim, z))
    points = points[failing & np.isfinite(points).all(axis=1)].astype(np.float64)
    return DesignPoints(distinct(points, limit), starts * STEPS * (GRADIENT + HALVINGS + 1))


def distinct(points, limit):
    """At most ``limit`` of ``points`` [n, D], of least norm and apart from one another: [m, D]."""
    points = points[np.argsort((points**2).sum(axis=1), kind="stable")]
    kept = []
    for z in points:
        if len(kept) < limit and all(
            np.linalg.norm(z - other) > APART * np.linalg.norm(other) for other in kept
        ):
            kept.append(z)
    return np.array(kept).reshape(-1, points.shape[-1])


@jax.jit
def _descend(sim, starts):
    return jax.vmap(partial(_one, sim))(starts)


def _one(sim, z):
    """The failing point that the steps from ``z`` end at, and whether there is one."""

    def step(carry, _):
        z, best, found = carry
        g, slope = jax.value_and_grad(
            lambda z: rollout(jax.random.key(0), sim, policy_of(sim, z), log_likelihood).distance
        )(z)
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
            fails = outcome(sim, middle).failure
            return (jnp.where(fails, outside, middle), jnp.where(fails, middle, inside)), None

        fails = outcome(sim, aim).failure
        (outside, inside), _ = jax.lax.scan(halve, (z, aim), length=HALVINGS)
        better = fails & (~found | (jnp.sum(inside**2) < jnp.sum(best**2)))
        return (
            jnp.where(fails, outside, aim),
            jnp.where(better, inside, best),
            found | fails,
        ), None

    (_, best, found), _ = jax.lax.scan(step, (z, z, jnp.zeros((), bool)), length=STEPS)
    return best, found
