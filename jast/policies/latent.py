"""The coordinates that a policy acts in: latent normal numbers, x = Q(Phi(z)), z ~ N(0, I) under
the model, whatever the units and the family of p.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast.outline import ask, outline
from jast.pytrees import count
from jast.simulator import Simulator

__all__ = ["LOG_2PI", "count_latents", "log_normal"]

LOG_2PI = math.log(2 * math.pi)


def log_normal(
    z: jax.Array, mean: jax.Array | None = None, deviation: jax.Array | None = None
) -> jax.Array:
    """log N(z; mean, deviation^2) [] of ``z`` [n]; of N(0, I) where no mean is given."""
    if mean is None:
        return -0.5 * jnp.sum(z**2 + LOG_2PI)
    return -0.5 * jnp.sum(((z - mean) / deviation) ** 2 + LOG_2PI) - jnp.sum(jnp.log(deviation))


def count_latents(sim: Simulator, function: str) -> tuple[int, int]:
    """``(n, n0)``: how many numbers x and x0 have. n0 is 0 where the start is fixed, or is not of
    floats with quantiles; it is then drawn from its own distribution.

    ValueError of ``function``, naming ``disturbance``, where x is not of floats or has no quantile
    function with an inverse.
    """
    like = outline(sim)
    if not _floats(like.x):
        kinds = ", ".join(f"{s.dtype}{list(s.shape)}" for s in jax.tree.leaves(like.x)) or "nothing"
        raise ValueError(f"{function}: disturbance: expected floats, received {kinds}")
    start, step = ask(sim, lambda start, state, dist: (D.untiltable(start), D.untiltable(dist)))
    if step is not None:
        raise ValueError(f"{function}: disturbance: {step}")
    return count(like.x), count(like.x0) if _floats(like.x0) and start is None else 0


def _floats(like: Any) -> bool:
    return all(jnp.issubdtype(s.dtype, jnp.floating) for s in jax.tree.leaves(like))
