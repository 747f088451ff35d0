"""Recorded episodes as the random numbers that `estimate.tilts.tilts` plays them by again.

A choice has a normal number here too: that of the middle of the interval of uniform numbers that
`choose_categories` gives to its category. As rare categories lie near 0, floats tell all apart.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri

from jast._src.core.episode import Episode, play_back
from jast._src.core.rewards import log_likelihood
from jast._src.core.simulator import Simulator
from jast._src.distributions.independent_parts import Parts, parts
from jast._src.estimate.tilts.tilts import dimension, interval_starts, shape, stack_choices
from jast._src.normal_space.transform import normal_numbers, side_by_side
from jast._src.runtime._jax import quick

__all__ = ["numbers_of_episodes"]

FAR = 37.0  # the normal number of a value at the end of a support, whose own is infinite


def numbers_of_episodes(sim: Simulator, given: Episode) -> np.ndarray:
    """The points [n, `dimension`] by which `simulate_points` plays the episodes ``given`` [n]
    again; numbers that decided nothing are 0. On the host.
    """
    if not len(given.length):
        return np.zeros((0, dimension(shape(sim), sim.horizon)), normal_numbers(sim))
    about = given.x0, given.disturbances, given.length
    return side_by_side(sim, partial(_numbers, sim), *about).astype(normal_numbers(sim))


@quick
def _numbers(sim, x0, disturbances, length):
    def one(x0, x, length):
        e = play_back(sim, log_likelihood, x0, x, length)
        states = jax.tree.map(lambda a: a[:-1], e.states)
        first = _numbers_of_value(parts(sim.start()), e.x0)
        z = jax.vmap(lambda s, x: _numbers_of_value(parts(sim.disturbance(s)), x))(
            states, e.disturbances
        )
        live = jnp.arange(sim.horizon, dtype=jnp.int32) < e.length
        z = jnp.concatenate([first, jnp.where(live[:, None], z, 0).ravel()])
        return jnp.nan_to_num(z, posinf=FAR, neginf=-FAR)

    return jax.vmap(one)(x0, disturbances, length)


def _numbers_of_value(p: Parts, x: Any) -> jax.Array:
    """The normal numbers of the value ``x``, then those of its choices."""
    z, choices = p.inverse(x)
    if not choices:
        return z
    odds = jnp.exp(jax.nn.log_softmax(stack_choices(p), axis=-1))
    at = jnp.concatenate(choices)[:, None]
    begin, width = (jnp.take_along_axis(a, at, axis=1)[:, 0] for a in (interval_starts(odds), odds))
    return jnp.concatenate([z, ndtri(begin + width / 2)])
