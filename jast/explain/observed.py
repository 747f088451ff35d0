"""Ordinary episodes, and what is observed at each step of any."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast import rewards
from jast._jax import jit
from jast.episode import Episode, play_back, rollout
from jast.limit_state import side_by_side
from jast.pytrees import bound
from jast.simulator import Simulator

__all__ = ["draw_ordinary", "observations"]

LANES = 256  # episodes that are played at a time


def draw_ordinary(key: jax.Array, sim: Simulator, n: int) -> Episode:
    """At most ``n`` episodes of the model that do not fail."""
    at = np.arange(n, dtype=np.int32)
    e = side_by_side(sim, partial(_drawn, key, sim), at, lanes=LANES)
    return jax.tree.map(lambda a: a[~e.failure], e)


@jit
def _drawn(key: jax.Array, sim: Simulator, at: jax.Array) -> Episode:
    return jax.vmap(lambda k: rollout(jax.random.fold_in(key, k), sim)._replace(states=None))(at)


def observations(name: str, sim: Simulator, observe: Callable, e: Episode) -> np.ndarray:
    """[n, horizon + 1, d] of the states."""
    watched, about = partial(_watched, sim, bound(observe)), (e.x0, e.disturbances, e.length)
    seen = side_by_side(sim, watched, *about, lanes=LANES)
    if not isinstance(seen, np.ndarray) or seen.ndim != 3:
        shapes = jax.tree.map(lambda a: np.shape(a)[2:], seen)
        raise ValueError(
            f"{name}: observe must return a vector [d], received arrays of the shapes {shapes}"
        )
    return seen.astype(float)


@jit
def _watched(sim: Simulator, observe: Partial, x0: Any, x: Any, length: Any) -> Any:
    def one(x0, x, length):
        states = play_back(sim, rewards.STANDARD, x0, x, length).states
        return jax.tree.map(jnp.asarray, jax.vmap(observe)(states))

    return jax.vmap(one)(x0, x, length)
