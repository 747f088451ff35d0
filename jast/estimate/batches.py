"""Batches of a search: points drawn from a proposal, and their weights by the proposals of all
batches.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax.scipy.special import logsumexp

from jast import limit_state as latent

__all__ = ["numbers"]


class Batch(NamedTuple):
    """Points drawn from one proposal. On the host."""

    q: latent.Latent
    z: np.ndarray
    used: np.ndarray
    failure: np.ndarray
    log_weight: np.ndarray


def balanced(batches):
    """Log weights of the failing points of all ``batches``, p over the mean of their proposals (the
    balance heuristic), and which points those are.
    """
    failing = np.concatenate([b.failure for b in batches])
    logs = np.stack([over_batches(c.q, batches)[failing] for c in batches])
    top = logs.max(axis=0)
    return -top - np.log(np.exp(logs - top).mean(axis=0)), failing


def over_batches(q, batches):
    """log q - log p of the points of all ``batches``."""
    return np.concatenate(
        [
            -b.log_weight if b.q is q else np.asarray(log_ratio(q, b.z, b.used), np.float64)
            for b in batches
        ]
    )


@jax.jit
def log_ratio(q, z, used):
    """log q - log p [n] of points ``z`` [n, D] over their first ``used`` numbers."""
    return logsumexp(latent.log_ratios(q, z, used) + q.log_weights[None], axis=1)


@jax.jit
def drawn(sim, q, u, e):
    """Episodes of ``q`` by uniform numbers ``u`` [n] and normal ones ``e`` [n, D]: z, `Outcomes`,
    log p - log q, log shares of the components [n, K].
    """
    z = latent.place(q, u, e)
    o = latent.outcomes(sim, z)
    joint = latent.log_ratios(q, z, o.used) + q.log_weights[None]
    log_q = logsumexp(joint, axis=1)
    return z, o, -log_q, joint - log_q[:, None]


@partial(jax.jit, static_argnums=(1, 2, 3))
def numbers(key, n, d, dtype):
    """Uniform [n] and normal [n, d] numbers for `drawn`."""
    for_component, for_noise = jax.random.split(key)
    return jax.random.uniform(for_component, (n,), dtype), jax.random.normal(
        for_noise, (n, d), dtype
    )


@partial(jax.jit, static_argnums=2)
def plain_numbers(key, sim, n):
    """Points [n, D] of the model itself."""
    return jax.random.normal(key, (n, latent.dimension(sim)), latent.normal_numbers(sim))


def resampled(log_w: np.ndarray, size: int, shift: float) -> np.ndarray:
    """Rows [size], each as often as its weight asks, by the comb of ``shift`` in [0, 1)
    (systematic resampling). On the host.
    """
    w = np.exp(log_w - log_w.max())
    at = (np.arange(size) + shift) / size
    return np.searchsorted(np.cumsum(w) / w.sum(), at).clip(max=len(w) - 1)
