"""A distribution seen through its latent normal number and moved there: x = Q(Phi(z)) with z ~
N(mean, deviation^2) in place of N(0, 1).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jast._src.core.typing import Array, ArrayTree, DistributionLike, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.base import Wrapped
from jast._src.distributions.family_table import row
from jast._src.distributions.flat_rows import filled
from jast._src.distributions.operations import event_like, from_normal, has_cdf, to_normal

__all__ = ["Tilted", "tilted", "untiltable"]


class Tilted(Wrapped):
    """What `tilted` makes of a distribution of floats that has a quantile function and its inverse,
    taken number by number.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.tilted(D.Uniform(0.0, 1.0), jnp.array(1.0), jnp.array(0.5))
        >>> 0.0 < float(d.sample(seed=0)) < 1.0
        True
    """

    def __init__(self, distribution: Any, mean: jax.Array, deviation: jax.Array) -> None:
        super().__init__(distribution)
        self._mean, self._deviation = mean, deviation

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        z = self._mean[None] + self._deviation[None] * fine_draws.normal(
            key, (n, *self._mean.shape), self._mean.dtype
        )
        return jax.vmap(lambda z: from_normal(self._distribution, z))(z)

    def log_prob(self, value: Any) -> Array:
        """log p(x) + log N(z; mean, deviation) - log N(z; 0, 1) at z = Phi^-1(cdf(x)), as dz/dx is
        the same in both.
        """
        log_p = self._distribution.log_prob(value)
        z = to_normal(self._distribution, value)
        e = (z - self._mean) / self._deviation
        gain = 0.5 * (z - e) * (z + e) - jnp.log(self._deviation)
        return log_p + jnp.sum(gain, axis=tuple(range(log_p.ndim, gain.ndim)))


def tilted(dist: DistributionLike, mean: ArrayTree, deviation: ArrayTree) -> DistributionLike:
    """The distribution of x = Q(Phi(z)), z ~ N(mean, deviation^2), Q the quantile function of a
    distribution.

    It has samples and log densities. Normal distributions are shifted and scaled; of whole numbers
    only the probabilities change: these are exact. Others are as exact as `from_normal`.

    Args:
        dist: a distribution.
        mean, deviation: like a value, floats.

    Raises:
        ValueError: naming a distribution that cannot be tilted.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.mode(D.tilted(D.Normal(0.0, 1.0), jnp.array(2.0), jnp.array(0.5))))
        2.0
    """
    known = row(dist, "tilt", "quantile").tilt
    if known is not None:
        return known(dist, mean, deviation)
    like = event_like(dist)
    if not has_cdf(dist) or not (
        hasattr(like, "dtype") and jnp.issubdtype(like.dtype, jnp.floating)
    ):
        raise ValueError(
            f"{type(dist).__name__} cannot be tilted: expected floats with a quantile function and"
            " a distribution function that inverts it"
        )
    return Tilted(dist, mean, deviation)


def untiltable(dist: DistributionLike) -> str | None:
    """Why `tilted` cannot serve a distribution; None where it can.

    Args:
        dist: a distribution.

    Example:
        >>> from jast import distributions as D
        >>> D.untiltable(D.Normal(0.0, 1.0)) is None, D.untiltable(D.seeds()) is None
        (True, False)
    """
    zeros, ones = (filled(event_like(dist), v) for v in (0, 1))
    try:
        tilted(dist, zeros, ones)
    except ValueError as error:
        return str(error)
    return None
