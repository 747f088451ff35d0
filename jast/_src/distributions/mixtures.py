"""Mixtures over one kind of value: of any distributions (what makes a proposal cover the model:
defensive mixing), and of one distribution moved in its latent normal numbers.
"""

import jax
import jax.numpy as jnp

from jast._src.distributions import fine_draws
from jast._src.distributions.base import Distribution, Wrapped
from jast._src.distributions.flat_rows import unflat
from jast._src.distributions.operations import event_like, from_normal, mode, sample
from jast._src.distributions.tilted import tilted
from jast._src.util.checks import wrong
from jast._src.util.pytrees import select

__all__ = ["Blended", "Moved", "OneByOne", "blend", "x_of"]

COIN = 0x5EED  # what the key of the coin is folded with


class OneByOne(Distribution):
    """Drawn one at a time, by ``_draw(key)``."""

    def sample(self, *, seed, sample_shape=()):
        """One value; ``sample_shape`` must be ()."""
        if sample_shape != ():
            received = f"{sample_shape!r}: use jax.vmap over keys"
            raise wrong(self.name, "sample_shape", "be ()", received)
        return self._draw(seed)


class Blend(OneByOne):
    """What `blend` makes."""

    def __init__(self, log_weights, parts):
        self._log_weights, self._parts = log_weights, parts

    @property
    def event_shape(self):
        return self._parts[0].event_shape

    def _draw(self, key):
        # the coin is drawn with a key folded from the value's, one hash less than of a split; only
        # one of the draws is seen, so that one key serves all
        coin = jax.random.fold_in(jax.random.clone(key), COIN)
        u = fine_draws.uniform(coin, (), self._log_weights.dtype)
        edges = jnp.cumsum(jnp.exp(self._log_weights))[:-1]
        value = sample(self._parts[0], key)
        for part, edge in zip(self._parts[1:], edges, strict=True):
            other = sample(part, jax.random.clone(key))
            other = jax.tree.map(lambda a, b: b.astype(a.dtype), value, other)
            value = select(u < edge, value, other)
        return value

    def log_prob(self, value):
        logs = [part.log_prob(value) for part in self._parts]
        dtype = max((l.dtype for l in logs), key=lambda t: t.itemsize)
        logs = jnp.stack([l.astype(dtype) for l in logs])
        return jax.nn.logsumexp(logs + self._log_weights.astype(dtype), axis=0)

    def mode(self):
        """The likeliest of the modes of the parts."""
        modes = [mode(part) for part in self._parts]
        best = jnp.argmax(jnp.stack([self.log_prob(m) for m in modes]))
        return jax.tree.map(lambda *leaves: jnp.stack(leaves)[best], *modes)


def blend(weights, *parts):
    """The mixture of the distributions ``parts`` with ``weights`` [len(parts)] that sum to 1:
    samples one at a time, exact log densities.
    """
    return Blend(jnp.log(jnp.asarray(weights)), parts)


def x_of(dist, z):
    """The disturbance at the latents ``z`` [n], which are N(0, I) under ``dist``."""
    return from_normal(dist, unflat(z, event_like(dist)))


class Moved(Wrapped):
    """``dist`` with its latents z ~ N(mean, deviation^2), [n] each; the ``mode`` is the value at z
    = mean, the deterministic policy's.
    """

    def __init__(self, dist, mean, deviation):
        like = event_like(dist)
        super().__init__(tilted(dist, unflat(mean, like), unflat(deviation, like)))
        self._model, self._mean = dist, mean

    def sample(self, *, seed, sample_shape=()):
        return self._distribution.sample(seed=seed, sample_shape=sample_shape)

    def mode(self):
        return x_of(self._model, self._mean)


class Blended(OneByOne):
    """sum_k weights[k] (``dist`` with z ~ N(means[k], deviations[k]^2)); ``weights`` [K] of sum 1,
    ``means`` and ``deviations`` [K, n].
    """

    def __init__(self, dist, weights, means, deviations):
        self.model, self.weights, self.means, self.deviations = dist, weights, means, deviations

    @property
    def event_shape(self):
        return jax.tree.map(lambda s: s.shape, event_like(self.model))

    def _draw(self, key):
        which, where = jax.random.split(key)
        k = jax.random.categorical(which, jnp.log(self.weights))
        return Moved(self.model, self.means[k], self.deviations[k]).sample(seed=where)

    def log_prob(self, value):
        each = jax.vmap(lambda m, s: Moved(self.model, m, s).log_prob(value))(
            self.means, self.deviations
        )
        return jax.nn.logsumexp(each + jnp.log(self.weights).astype(each.dtype))

    def mode(self):
        """The centre of the heaviest component."""
        return x_of(self.model, self.means[jnp.argmax(self.weights)])
