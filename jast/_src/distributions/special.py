"""Distributions that stress testing needs and no library has: certain values, seeds of unknown
density, the tent of the MCFS-AP paper, one of two classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jast._src.core.typing import Array, DistributionLike, Numeric, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.base import Distribution, as_key, float_array, parameter_array
from jast._src.distributions.normal_tails import float_dtype, fraction
from jast._src.distributions.operations import log_density, mode

__all__ = ["Deterministic", "Fixed", "Seeds", "Tent", "Where", "seeds", "tent", "where"]


class _WithoutDensity(Distribution):
    """Of log density 0 everywhere, as there is none."""

    def log_prob(self, value: Any) -> Array:
        return jnp.zeros(())

    log_prob_from_mode = log_prob


class Fixed(_WithoutDensity):
    """The certain, empty disturbance ``()``: a system with one start.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Fixed()
        >>> d.sample(seed=0)
        ()
    """

    event_shape: Any = ()

    def sample(
        self, *, seed: PRNGKey | int | None = None, sample_shape: int | Sequence[int] = ()
    ) -> Any:
        return ()

    def mode(self) -> Any:
        return ()


class Deterministic(_WithoutDensity):
    """All mass on ``value``, a pytree of arrays: a recorded disturbance. ``log_prob`` is 0: it is a
    point, not a density.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.Deterministic(jnp.array(2.0))
        >>> float(d.sample(seed=0))
        2.0
    """

    def __init__(self, value: Any) -> None:
        self._value = value

    @property
    def event_shape(self) -> Any:
        return jax.tree.map(jnp.shape, self._value)

    def sample(
        self, *, seed: PRNGKey | int | None = None, sample_shape: int | Sequence[int] = ()
    ) -> Any:
        if sample_shape == ():
            return self._value
        return super().sample(seed=seed, sample_shape=sample_shape)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (n, *jnp.shape(a))), self._value)

    def mode(self) -> Any:
        return self._value

    def from_normal(self, z: Any) -> Any:
        return self._value

    quantile = from_normal

    def cdf(self, value: Any) -> Any:
        return jax.tree.map(lambda x, a: (x >= a).astype(float_dtype(x.dtype)), value, self._value)

    def to_normal(self, value: Any) -> Any:
        """0: whatever it is decides nothing."""
        return jax.tree.map(lambda x: jnp.zeros(jnp.shape(x), float_dtype(x.dtype)), value)


class Seeds(_WithoutDensity):
    """Random seeds of ``shape``, uint32, for a system whose disturbance density is unknown:
    ``log_prob`` is 0 and there is no mode.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Seeds((2,))
        >>> d.sample(seed=0).shape
        (2,)
    """

    def __init__(self, shape: Sequence[int] = ()) -> None:
        self.event_shape: Any = tuple(shape)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return jax.random.bits(key, (n, *self.event_shape), jnp.uint32)


class Tent(Distribution):
    """Density proportional to ``1 - |x - center| / width`` on ``[low, high]`` (elementwise over
    ``center``), zero elsewhere.

    With ``width=1`` on [0, 1] its mode-normalised log density is ``ln(1 - |x - center|)``, the step
    reward of the MCFS-AP paper (eq. 1 as a sum of logs).

    Example:
        >>> from jast import distributions as D
        >>> d = D.Tent(0.25)
        >>> float(d.mode())
        0.25
    """

    event_shape: Any = ()

    def __init__(
        self,
        center: Numeric,
        width: Numeric = 1.0,
        low: Numeric = 0.0,
        high: Numeric = 1.0,
    ) -> None:
        center = float_array(center)
        low, high = (jnp.asarray(v, center.dtype) for v in (low, high))
        self._center = parameter_array("Tent: center", center, low, high)
        self._width = jnp.asarray(parameter_array("Tent: width", width), center.dtype)
        self._low, self._high = low, high

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self._center.shape

    def _masses(self):
        """Unnormalised masses left of the start of the support, and its whole span, of the full
        tent of mass ``width``.
        """
        lower, upper = self._cdf_full(self._low), self._cdf_full(self._high)
        return lower, upper - lower

    def _cdf_full(self, x):
        z = jnp.clip((x - self._center) / self._width, -1.0, 1.0)
        return self._width * jnp.where(z < 0, 0.5 * (1 + z) ** 2, 1 - 0.5 * (1 - z) ** 2)

    def log_prob_from_mode(self, x: Any) -> Array:
        """Log density less the log density of the mode, without the normaliser: exactly ``log(1 -
        |x - center| / width)``.
        """
        inside = (x >= self._low) & (x <= self._high)
        height = jnp.where(inside, 1 - jnp.abs(x - self._center) / self._width, 0.0)
        return jnp.where(height > 0, jnp.log(jnp.where(height > 0, height, 1.0)), -jnp.inf)

    def log_prob(self, value: Any) -> Array:
        return self.log_prob_from_mode(value) - jnp.log(self._masses()[1])

    def quantile(self, u: Any) -> Any:
        lower, span = self._masses()
        mass = (lower + u * span) / self._width  # of the full tent of unit mass
        z = jnp.where(
            mass < 0.5, jnp.sqrt(2 * mass) - 1, 1 - jnp.sqrt(jnp.maximum(2 - 2 * mass, 0))
        )
        edge = 1 - 4 * jnp.finfo(z.dtype).eps  # at the foot of the tent there is no density
        z = jnp.clip(z, -edge, edge)
        return jnp.clip(self._center + self._width * z, self._low, self._high)

    def cdf(self, value: Any) -> Any:
        return fraction(*(self._cdf_full(v) for v in (value, self._low, self._high)))

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return self.quantile(fine_draws.uniform(key, (n, *self.batch_shape), self._center.dtype))

    def mode(self) -> Any:
        return self._center


class Where(Distribution):
    """``a`` where the scalar ``pred`` holds, else ``b``: two classes of distribution over the same
    kind of value.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Where(True, D.Normal(1.0, 1.0), D.Normal(0.0, 1.0))
        >>> float(d.mode())
        1.0
    """

    def __init__(self, pred: Array | bool, a: DistributionLike, b: DistributionLike) -> None:
        self.pred: jax.Array = jnp.asarray(pred)
        self.parts: tuple[Any, Any] = (a, b)
        """``(a, b)``"""

    @property
    def event_shape(self) -> Any:
        return self.parts[0].event_shape

    def select(self, a: Any, b: Any) -> Any:
        """The pytree ``a`` where ``pred`` holds, else ``b``."""
        return jax.tree.map(
            lambda x, y: jnp.where(self.pred, x, jnp.asarray(y, jnp.result_type(x))), a, b
        )

    def sample(self, *, seed: PRNGKey | int, sample_shape: int | Sequence[int] = ()) -> Any:
        (a, b), seed = self.parts, as_key(seed)
        # one key serves both, as only one of the two draws is seen; the clone tells JAX's check of
        # reused keys that it is meant
        other = b.sample(seed=jax.random.clone(seed), sample_shape=sample_shape)
        return self.select(a.sample(seed=seed, sample_shape=sample_shape), other)

    def log_prob(self, value: Any) -> Array:
        return self.select(*(d.log_prob(value) for d in self.parts))

    def log_prob_from_mode(self, value: Any) -> Array:
        return self.select(*(log_density(d, value, "mode") for d in self.parts))

    def mode(self) -> Any:
        return self.select(*map(mode, self.parts))


def tent(
    center: Numeric,
    width: Numeric = 1.0,
    low: Numeric = 0.0,
    high: Numeric = 1.0,
) -> Tent:
    """Likeliest at a centre, falling linearly to zero on both sides, and cut to an interval.

    Args:
        center: of any shape, elementwise.
        width: from the centre to where the density is zero.
        low, high: ends of the interval.

    Returns:
        `Tent`.

    Example:
        >>> from jast import distributions as D
        >>> float(D.log_density(D.tent(0.5), 1.0, "mode"))  # ln(1 - 0.5)
        -0.6931...
    """
    return Tent(center, width, low, high)


def seeds(shape: Sequence[int] = ()) -> Seeds:
    """Random seeds, uint32, for a system whose disturbance density is unknown (log p = 0): only the
    seed is chosen.

    Args:
        shape: of the seeds.

    Returns:
        `Seeds`.

    Example:
        >>> from jast import distributions as D
        >>> D.seeds((2,)).sample(seed=0).dtype.name
        'uint32'
    """
    return Seeds(shape)


def where(pred: Array | bool, a: DistributionLike, b: DistributionLike) -> Where:
    """One of two distributions over values of one shape and dtype.

    Args:
        pred: scalar: whether it is ``a``.
        a, b: the two.

    Returns:
        `Where`.

    Example:
        >>> from jast import distributions as D
        >>> float(D.mode(D.where(False, D.Normal(1.0, 1.0), D.Normal(0.0, 1.0))))
        0.0
    """
    return Where(pred, a, b)
