"""Actions: what a search chooses at a step. An action becomes a disturbance before ``step``; only disturbances are stored."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jast import distributions as D

__all__ = ["Quantiles", "Samples", "UniformBox", "quantiles", "samples", "uniform"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples:
    """See `samples`."""

    def draw(self, key, dist):
        """One disturbance by this choice of actions, where ``dist`` is the disturbance model at the state."""
        return D.sample(dist, key)

    draw_start = draw


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Quantiles:
    """See `quantiles`."""

    def draw(self, key, dist):
        return D.quantile(dist, _uniform_like(key, dist))

    draw_start = draw


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UniformBox:
    """See `uniform`."""

    low: Any
    high: Any

    def draw(self, key, dist):
        return self.at(_uniform_like(key, dist), dist)

    def draw_start(self, key, dist):
        """The box is one of steps: a random start is drawn from its own distribution."""
        return D.sample(dist, key)

    def at(self, u, dist):
        """The point of the box at ``u`` in [0, 1)^d; integers are the whole numbers from ``low`` to ``high``, both included."""

        def place(u, s):
            low, high = (jnp.asarray(v).astype(u.dtype) for v in (self.low, self.high))
            if jnp.issubdtype(s.dtype, jnp.floating):
                return low + u * (high - low)
            return jnp.floor(low + u * (high - low + 1)).astype(s.dtype)

        return jax.tree.map(place, u, D.event_like(dist))


def samples():
    """Disturbances drawn from the model p(x | s): always possible, also where the density is unknown (`jast.distributions.seeds`)."""
    return Samples()


def quantiles():
    """Points of [0, 1]^d, turned into disturbances by the quantile function of p(x | s); uniform points are draws of p."""
    return Quantiles()


def uniform(low, high):
    """Disturbances uniform on the box ``[low, high]`` (scalars, or arrays that broadcast to x). The ferry's published actions are ``uniform(0., 1.)``."""
    return UniformBox(low, high)


def _uniform_like(key, dist):
    """Uniform numbers in [0, 1) in the shape of a value of ``dist``, one independent stream a leaf."""
    event = D.event_like(dist)
    leaves, treedef = jax.tree.flatten(event)
    keys = [key] if len(leaves) == 1 else [jax.random.fold_in(key, i) for i in range(len(leaves))]
    return treedef.unflatten([jax.random.uniform(k, s.shape, D.float_dtype(s.dtype)) for k, s in zip(keys, leaves, strict=True)])
