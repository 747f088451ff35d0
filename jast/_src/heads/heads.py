"""The two heads of a search and what they say: a histogram of the next disturbance, and the reward
to come after one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array
from jast._src.distributions.flat_rows import unflat
from jast._src.heads.networks import Head
from jast._src.util import display
from jast._src.util.pytrees import as_partial

__all__ = [
    "Heads",
    "Moments",
    "draw_by_bins",
    "observation",
    "policy_logits",
    "predicted_value",
    "update_moments",
]


class Moments(NamedTuple):
    """Running mean and deviation of n numbers; with ``count`` 0 they leave what they normalise as
    it is.

    Example:
        >>> import numpy as np, jast
        >>> speeds = jast.heads.Moments(np.float32(100), np.array([5.0]), np.array([2.0]))
        >>> float(speeds.normalise(np.array([9.0]))[0])
        2.0
    """

    count: Array
    """scalar float32."""
    mean: Array
    """[n] float32."""
    deviation: Array
    """[n] float32: 0 where nothing varies; 1 is used in its place."""

    @classmethod
    def empty(cls, *shape: Sequence[int]) -> Moments:
        return cls(
            np.zeros((), np.float32), np.zeros(shape, np.float32), np.ones(shape, np.float32)
        )

    def normalise(self, x: Any) -> Array:
        return (x - self.mean) / self._scale()

    def restore(self, x: Any) -> Array:
        return self.mean + self._scale() * x

    def _scale(self):
        return jnp.where(self.deviation > 0, self.deviation, 1)

    def first(self, n: int) -> Moments:
        """Those of the first ``n`` numbers."""
        return Moments(self.count, self.mean[:n], self.deviation[:n])


def update_moments(before: Moments, x: np.ndarray) -> Moments:
    """The `Moments` ``before`` with the rows of ``x`` [m, n] (or [m]) added, on the host (the
    pairwise update of Chan, Golub and LeVeque).
    """
    if not len(x):
        return before
    x, mean, count = np.asarray(x, np.float64), np.float64(before.mean), before.count + len(x)
    squares = before.count * np.float64(before.deviation) ** 2 if before.count else 0.0
    gap = x.mean(0) - mean
    variance = (squares + len(x) * x.var(0) + gap**2 * before.count * len(x) / count) / count
    deviation = np.where(variance > 1e-12, np.sqrt(variance), 0)  # less is rounding
    updated = count, mean + gap * len(x) / count, deviation
    return Moments(*(np.asarray(a, np.float32) for a in updated))


@display.printable()
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Heads:
    """A rollout-policy head and a value head (Lytskjold and Mengshoel, MCFS-AP): each a `Head`, or
    a pair (params, apply), or None; a pytree.

    ``policy.apply(params, s)`` gives logits [d, bins] for the normalised observation s [n],
    ``value.apply(params, s and x [n + d])`` a scalar; n numbers are observed, a disturbance has d.
    A search fills in the moments that normalise what goes in and out.

    Example:
        >>> import jax, jast
        >>> value = jast.heads.make_head(jax.random.key(0), 2)  # observes s, sees x
        >>> heads = jast.heads.Heads(value=value)
        >>> heads.policy is None
        True
    """

    policy: Head | None = None
    value: Head | None = None
    inputs: Moments | None = None
    """Of the n + d inputs."""
    returns: Moments | None = None
    """Of the value head's targets."""
    levels: int = 0
    """The first levels of an episode that they have learned of; a default search is not guided
    by them deeper down. Give those that you trained yourself the horizon.
    """

    def __post_init__(self) -> None:
        for name in ("policy", "value"):
            head = getattr(self, name)
            if isinstance(head, tuple) and len(head) == 2 and callable(head[1]):
                apply = as_partial(head[1])
                object.__setattr__(self, name, Head(head[0], apply))


def observation(sim: Simulator, state: Any) -> jax.Array:
    """[n] float32: what networks see of a state."""
    return jnp.ravel(jnp.asarray(sim.observe(state))).astype(jnp.float32)


def policy_logits(heads: Heads, seen: jax.Array) -> jax.Array:
    """Logits [d, bins] of the policy head at an `observation` [n]."""
    inputs = heads.inputs.first(seen.shape[0]).normalise(seen)
    return heads.policy.apply(heads.policy.params, inputs)


def sample_bins(logits: jax.Array, u: jax.Array) -> jax.Array:
    """Points [d] of the unit interval with the histogram density of ``logits`` [d, bins], from
    uniform ``u`` [d]: the inverse of its distribution function.
    """
    bins = logits.shape[1]
    mass = jnp.exp(logits - jnp.max(logits, axis=1, keepdims=True))
    mass = jnp.where(jnp.isfinite(mass), mass, 1)  # uniform where a head gives no number
    # summed as below, so that no rounding leads past the last bin that has mass
    u = u * sum(mass[:, k] for k in range(bins))
    below = bin = beneath = jnp.zeros_like(u)
    own = mass[:, 0]
    # unrolled: one fused loop over lanes, where a cumulative sum and a gather would be several
    for k in range(1, bins):
        below = below + mass[:, k - 1]
        past = u >= below
        bin = jnp.where(past, jnp.float32(k), bin)
        beneath = jnp.where(past, below, beneath)
        own = jnp.where(past, mass[:, k], own)
    # of 1, so far that no rounding leads into the next bin
    inside = jnp.clip((u - beneath) / jnp.maximum(own, 1e-12), 0, 1 - bins * 2.0**-22)
    return (bin + inside) / bins


def draw_by_bins(key: jax.Array, logits: jax.Array, actions: Any, dist: Any) -> Any:
    """A disturbance at a point of the unit cube (`jast.actions`) that `sample_bins` draws."""
    event = D.event_like(dist)
    u = sample_bins(logits, jax.random.uniform(key, logits.shape[:1], jnp.float32))
    return jax.tree.map(lambda a, s: a.astype(s.dtype), actions.at(unflat(u, event), dist), event)


def predicted_value(heads: Heads, seen: jax.Array, x: jax.Array) -> jax.Array:
    """v(s, a), a scalar: the value head's reward to come from the `observation` ``seen`` [n] on,
    with the disturbance ``x`` [d].
    """
    inputs = heads.inputs.normalise(jnp.concatenate([seen, x]))
    return heads.returns.restore(heads.value.apply(heads.value.params, inputs))
