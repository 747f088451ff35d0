"""What a policy learns in: latent normal numbers, x = Q(Phi(z)), z ~ N(0, I) under the model, so
that it is free of units and of p's family.
"""

import math

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast.outline import ask, outline
from jast.pytrees import count
from jast.simulator import Simulator

__all__ = ["log_normal", "sizes"]

LOG_2PI = math.log(2 * math.pi)


def log_normal(z, mean=None, deviation=None):
    """log N(z; mean, deviation^2) [] of ``z`` [n], default the standard one."""
    if mean is None:
        return -0.5 * jnp.sum(z**2 + LOG_2PI)
    return -0.5 * jnp.sum(((z - mean) / deviation) ** 2 + LOG_2PI) - jnp.sum(jnp.log(deviation))


def sizes(sim: Simulator, function: str) -> tuple[int, int]:
    """``(n, n0)``: how many numbers x and x0 are made of; n0 is 0 where the start is fixed, or not
    of floats with quantiles, and then drawn as it is.

    ValueError of ``function``, naming ``disturbance``, where x is not of floats or has no quantile
    function with an inverse.
    """
    like = outline(sim)
    if not _floats(like.x):
        raise ValueError(f"{function}: disturbance: expected floats, received {_kinds(like.x)}")
    start, step = ask(sim, lambda start, state, dist: (D.untiltable(start), D.untiltable(dist)))
    if step is not None:
        raise ValueError(f"{function}: disturbance: {step}")
    return count(like.x), count(like.x0) if _floats(like.x0) and start is None else 0


def _floats(like):
    return all(jnp.issubdtype(s.dtype, jnp.floating) for s in jax.tree.leaves(like))


def _kinds(like):
    return ", ".join(f"{s.dtype}{list(s.shape)}" for s in jax.tree.leaves(like)) or "nothing"
