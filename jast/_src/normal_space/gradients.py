"""Episodes of points of normal numbers with their gradients, backwards through the simulator: the
one program that has its derivative.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.rewards import likelihood
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array
from jast._src.normal_space.transform import normal_numbers, play
from jast._src.runtime._jax import quick
from jast._src.runtime.checkpoints import step_once
from jast._src.util.pytrees import map_in_lanes

__all__ = ["COST", "Gradients", "gradients"]

LANES = 4
"""Points of a call of the program: so few that calls for a few points are not filled up with
many."""
COST = 3
"""Evaluations that a value with its gradient counts as."""


class Gradients(NamedTuple):
    """Of n episodes, on the host."""

    distance: Array
    """[n] miss distance; inf where invalid"""
    failure: Array
    """[n] bool"""
    length: Array
    """[n] int32: steps"""
    slope: Array
    """[n, D] of the miss distance"""
    rise: Array
    """[n, D] of -log p, relative to the mode where the disturbances have modes"""


def gradients(sim: Simulator, z: np.ndarray) -> Gradients:
    """`Gradients` at the points ``z`` [n, D]; kept by the checkpoint of the call around it."""
    z = np.asarray(z, normal_numbers(sim))

    def like():
        return jax.tree.map(lambda a: jnp.zeros((len(z), *a.shape[1:]), a.dtype), one(z[:LANES]))

    one = partial(_gradients, sim)
    return step_once(lambda: map_in_lanes(LANES, one, z), z, like=like)


@quick
def _gradients(sim, z):
    def numbers(z):
        e = play(sim, likelihood(sim), z)
        return jnp.stack([e.distance.astype(z.dtype), -e.reward.astype(z.dtype)]), e

    def both(z):
        _, back, e = jax.vjp(numbers, z, has_aux=True)
        slope, rise = jax.vmap(lambda row: back(row)[0])(jnp.eye(2, dtype=z.dtype))
        return Gradients(e.distance, e.failure, e.length, slope, rise)

    return jax.vmap(both)(z)
