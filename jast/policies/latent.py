"""Disturbances by their latent normal numbers: x = Q(Phi(z)), z ~ N(0, I) under the model, so that
a policy is free of units and of p's family.
"""

import math

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast.heads.heads import unflat
from jast.outline import ask, outline
from jast.pytrees import count
from jast.simulator import Simulator

__all__ = ["Blended", "Moved", "log_normal", "sizes", "x_of"]

LOG_2PI = math.log(2 * math.pi)


def x_of(dist, z):
    """The disturbance at the latents ``z`` [n], which are N(0, I) under ``dist``."""
    return D.from_normal(dist, unflat(z, D.event_like(dist)))


def log_normal(z, mean=None, deviation=None):
    """log N(z; mean, deviation^2) [] of ``z`` [n], default the standard one."""
    if mean is None:
        return -0.5 * jnp.sum(z**2 + LOG_2PI)
    return -0.5 * jnp.sum(((z - mean) / deviation) ** 2 + LOG_2PI) - jnp.sum(jnp.log(deviation))


def sizes(sim: Simulator) -> tuple[int, int]:
    """``(n, n0)``: how many numbers x and x0 are made of; n0 is 0 where the start is fixed, or not
    of floats with quantiles, and then drawn as it is.

    ValueError naming ``disturbance`` where x is not of floats, or has no quantile function with an
    inverse.
    """
    like = outline(sim)
    if not _floats(like.x):
        raise ValueError(f"sac: disturbance: expected floats, received {_kinds(like.x)}")
    start, step = ask(sim, lambda start, state, dist: (D.untiltable(start), D.untiltable(dist)))
    if step is not None:
        raise ValueError(f"sac: disturbance: {step}")
    return count(like.x), count(like.x0) if _floats(like.x0) and start is None else 0


class Moved(D.Distribution):
    """``dist`` with its latents z ~ N(mean, deviation^2), [n] each; the ``mode`` is the value at z
    = mean, the deterministic policy's.
    """

    def __init__(self, dist, mean, deviation):
        super().__init__()
        like = D.event_like(dist)
        self.mean_z, self.deviation_z, self.model = mean, deviation, dist
        self._inner = D.tilted(dist, unflat(mean, like), unflat(deviation, like))

    @property
    def event_shape(self):
        return self._inner.event_shape

    def sample(self, *, seed, sample_shape=()):
        return self._inner.sample(seed=seed, sample_shape=sample_shape)

    def _sample_n(self, key, n):
        return self.sample(seed=key, sample_shape=(n,))

    def log_prob(self, value):
        return self._inner.log_prob(value)

    def mode(self):
        return x_of(self.model, self.mean_z)


class Blended(D.Distribution):
    """sum_k weights[k] (``dist`` with z ~ N(means[k], deviations[k]^2)); ``weights`` [K] of sum 1,
    ``means`` and ``deviations`` [K, n].
    """

    def __init__(self, dist, weights, means, deviations):
        super().__init__()
        self.model, self.weights, self.means, self.deviations = dist, weights, means, deviations

    @property
    def event_shape(self):
        return jax.tree.map(lambda s: s.shape, D.event_like(self.model))

    def sample(self, *, seed, sample_shape=()):
        """One value; ``sample_shape`` must be ()."""
        if sample_shape != ():
            raise ValueError(
                f"Blended: sample_shape must be (), received {sample_shape!r}: use jax.vmap over"
                " keys"
            )
        which, where = jax.random.split(seed)
        k = jax.random.categorical(which, jnp.log(self.weights))
        return Moved(self.model, self.means[k], self.deviations[k]).sample(seed=where)

    def _sample_n(self, key, n):
        return jax.vmap(lambda k: self.sample(seed=k))(jax.random.split(key, n))

    def log_prob(self, value):
        each = jax.vmap(lambda m, s: Moved(self.model, m, s).log_prob(value))(
            self.means, self.deviations
        )
        return jax.nn.logsumexp(each + jnp.log(self.weights).astype(each.dtype))

    def mode(self):
        """The centre of the heaviest component."""
        return x_of(self.model, self.means[jnp.argmax(self.weights)])


def _floats(like):
    return all(jnp.issubdtype(s.dtype, jnp.floating) for s in jax.tree.leaves(like))


def _kinds(like):
    return ", ".join(f"{s.dtype}{list(s.shape)}" for s in jax.tree.leaves(like)) or "nothing"
