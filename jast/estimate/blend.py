"""A finite mixture of distributions over one kind of value: what makes a proposal cover the model
(defensive mixing).
"""

import jax
import jax.numpy as jnp

from jast import distributions as D

__all__ = ["Blend", "blend"]

COIN = 0x5EED


class Blend(D.Distribution):
    """What `blend` makes."""

    def __init__(self, log_weights, parts):
        super().__init__()
        self._log_weights, self._parts = log_weights, parts

    @property
    def event_shape(self):
        return self._parts[0].event_shape

    def sample(self, *, seed, sample_shape=()):
        """One value; ``sample_shape`` must be ()."""
        if sample_shape != ():
            raise ValueError(
                f"Blend: sample_shape must be (), received {sample_shape!r}: use jax.vmap over keys"
            )
        # the coin is drawn with a key folded from the value's, one hash less than of a split; only
        # one of the draws is seen, so that one key serves all
        u = jax.random.uniform(
            jax.random.fold_in(jax.random.clone(seed), COIN), (), self._log_weights.dtype
        )
        edges = jnp.cumsum(jnp.exp(self._log_weights))[:-1]
        value = D.sample(self._parts[0], seed)
        for part, edge in zip(self._parts[1:], edges, strict=True):
            value = jax.tree.map(
                lambda a, b: jnp.where(u < edge, a, b.astype(a.dtype)),  # noqa: B023
                value,
                D.sample(part, jax.random.clone(seed)),
            )
        return value

    def _sample_n(self, key, n):
        return jax.vmap(lambda k: self.sample(seed=k))(jax.random.split(key, n))

    def log_prob(self, value):
        logs = [part.log_prob(value) for part in self._parts]
        dtype = max((l.dtype for l in logs), key=lambda t: t.itemsize)
        logs = jnp.stack([l.astype(dtype) for l in logs])
        return jax.nn.logsumexp(logs + self._log_weights.astype(dtype), axis=0)

    def mode(self):
        """The likeliest of the modes of the parts."""
        modes = [D.mode(part) for part in self._parts]
        best = jnp.argmax(jnp.stack([self.log_prob(m) for m in modes]))
        return jax.tree.map(lambda *leaves: jnp.stack(leaves)[best], *modes)


def blend(weights, *parts):
    """The mixture of the distributions ``parts`` with ``weights`` [len(parts)] that sum to 1:
    samples one at a time, exact log densities.
    """
    return Blend(jnp.log(jnp.asarray(weights)), parts)
