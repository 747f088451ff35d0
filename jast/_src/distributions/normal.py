"""Normal distributions, of numbers and of vectors, and the base of families with a location and a
scale. Log densities agree with distrax's to the bit, draws but for rounding and the outermost.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jast._src.core.typing import Array, Numeric, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.base import (
    Distribution,
    Elementwise,
    broadcast,
    float_array,
    parameter_array,
)
from jast._src.distributions.normal_tails import HALF_LOG_2PI, ndtr

__all__ = [
    "LocationScale",
    "MultivariateNormalDiag",
    "MultivariateNormalTri",
    "Normal",
    "Symmetric",
]


class LocationScale(Elementwise):
    """x = loc + scale e, e of a standard distribution; ``loc`` and ``scale`` broadcast."""

    _parameters = "_loc", "_scale"
    loc: jax.Array = broadcast("_loc")
    scale: jax.Array = broadcast("_scale")

    def __init__(self, loc: Numeric, scale: Numeric) -> None:
        self._loc: jax.Array = float_array(loc)
        self._scale: jax.Array = parameter_array(f"{self.name}: scale", scale)

    def _standardize(self, value):
        return (value - self._loc) / self._scale

    def _placed(self, e):
        """loc + scale e, for e [n, *batch_shape]."""
        scale, loc = (jnp.expand_dims(a, range(e.ndim - a.ndim)) for a in (self._scale, self._loc))
        return scale * e + loc

    def _like_n(self, n):
        return {"shape": (n, *self.batch_shape), "dtype": jnp.result_type(self._loc, self._scale)}


class Symmetric(LocationScale):
    """Mean, median and mode are ``loc``."""

    def mean(self) -> Any:
        return self.loc

    median = mean
    mode = mean


class Normal(Symmetric):
    """Of mean ``loc`` and standard deviation ``scale``.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Normal(1.0, 2.0)
        >>> float(d.mode())
        1.0
    """

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return self._placed(fine_draws.normal(key, **self._like_n(n)))

    def log_prob(self, value: Any) -> Array:
        exponent = -0.5 * jnp.square(self._standardize(value))
        return exponent - (HALF_LOG_2PI + jnp.log(self._scale))

    def cdf(self, value: Any) -> Any:
        return ndtr(self._standardize(value))

    def stddev(self) -> Any:
        return self.scale

    def variance(self) -> Any:
        return jnp.square(self.scale)


class _Vector(Distribution):
    """x = loc + A e, e ~ N(0, I), of ``loc`` [..., k]."""

    _loc: jax.Array

    @property
    def event_shape(self) -> Any:
        return self._loc.shape[-1:]

    @property
    def loc(self) -> jax.Array:
        return jnp.broadcast_to(self._loc, self.batch_shape + self.event_shape)

    @property
    def dtype(self) -> Any:
        return jnp.result_type(self._loc, *(v for k, v in vars(self).items() if "scale" in k))

    # As programs are fused, where a product is rounded depends on each operation around it: those
    # below that look idle (plus 0, times 1) are distrax's, and keep its bits.

    @property
    def _noise(self):
        return Normal(jnp.zeros(self.batch_shape + self.event_shape, self.dtype), 1.0)

    def _log_prob(self, e, log_det):
        """Of the value with the noise ``e``; ``log_det``: log |det de/dx|."""
        return jnp.sum(self._noise.log_prob(e), axis=-1) + log_det

    def mean(self) -> Any:
        return self.loc

    median = mean
    mode = mean

    def stddev(self) -> Any:
        return jnp.sqrt(self.variance())


class MultivariateNormalDiag(_Vector):
    """Vectors of independent normal numbers: means ``loc`` [..., k] (default 0) and standard
    deviations ``scale_diag`` [..., k] (default 1).

    Raises:
        ValueError: where neither is given, one is a scalar, or their last axes differ.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.MultivariateNormalDiag(jnp.zeros(2), jnp.array([1.0, 3.0]))
        >>> d.event_shape
        (2,)
    """

    def __init__(self, loc: Any = None, scale_diag: Any = None) -> None:
        loc, scale = _fitting("MultivariateNormalDiag", "scale_diag", loc, scale_diag, 1)
        if scale is None:
            scale = jnp.ones(loc.shape[-1], loc.dtype)
        if loc is None:
            loc = jnp.zeros(scale.shape[-1], scale.dtype)
        ndim = max(loc.ndim, scale.ndim)
        self._loc, self._scale_diag = (
            jnp.expand_dims(a, range(ndim - a.ndim)) for a in (loc, scale)
        )

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return jax.lax.broadcast_shapes(self._loc.shape[:-1], self._scale_diag.shape[:-1])

    @property
    def scale_diag(self) -> jax.Array:
        return jnp.broadcast_to(self._scale_diag, self.batch_shape + self.event_shape)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        e = self._noise.sample(seed=key, sample_shape=n)
        return self._scale_diag[None] * e + 0.0 + self._loc[None]

    def log_prob(self, value: Any) -> Array:
        scale = self._scale_diag
        e = (1.0 / scale) * (value - self._loc - 0.0)
        return self._log_prob(e, 0.0 + jnp.sum(-jnp.log(jnp.abs(scale)), axis=-1))

    def variance(self) -> Any:
        return jnp.square(self.scale_diag)

    def covariance(self) -> Array:
        return jnp.vectorize(jnp.diag, signature="(k)->(k,k)")(self.variance())


class MultivariateNormalTri(_Vector):
    """Vectors x = loc + A e, e ~ N(0, I): ``loc`` [..., k] (default 0), the triangular factor A
    ``scale_tri`` [..., k, k] (default I) of the covariance A A^T, lower or upper (``is_lower``).

    Raises:
        ValueError: where neither is given, or their shapes do not fit.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.MultivariateNormalTri(scale_tri=jnp.array([[1.0, 0.0], [1.0, 1.0]]))
        >>> d.covariance().tolist()
        [[1.0, 1.0], [1.0, 2.0]]
    """

    def __init__(self, loc: Any = None, scale_tri: Any = None, is_lower: bool = True) -> None:
        loc, scale = _fitting("MultivariateNormalTri", "scale_tri", loc, scale_tri, 2)
        dtype = jnp.result_type(*(a for a in (loc, scale) if a is not None))
        k = (scale if loc is None else loc).shape[-1]
        self._loc = jnp.zeros((k,), dtype) if loc is None else loc
        triangle = jnp.tril if is_lower else jnp.triu
        self._scale_tri = jnp.eye(k, dtype=dtype) if scale is None else triangle(scale)
        self.is_lower: bool = is_lower

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return jax.lax.broadcast_shapes(self._loc.shape[:-1], self._scale_tri.shape[:-2])

    @property
    def scale_tri(self) -> jax.Array:
        return jnp.broadcast_to(self._scale_tri, self.batch_shape + 2 * self.event_shape)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        product = jnp.vectorize(lambda e, a: a @ e, signature="(k),(k,k)->(k)")
        e = self._noise.sample(seed=key, sample_shape=n)
        return jax.vmap(lambda e: product(e, self._scale_tri) + self._loc)(e)

    def log_prob(self, value: Any) -> Array:
        solve = jnp.vectorize(
            lambda x, a: jax.scipy.linalg.solve_triangular(a, x, lower=self.is_lower),
            signature="(k),(k,k)->(k)",
        )
        diagonal = jnp.diagonal(self._scale_tri, axis1=-2, axis2=-1)
        e = solve(value - self._loc, self._scale_tri)
        return self._log_prob(e, 0.0 + -jnp.sum(jnp.log(jnp.abs(diagonal)), axis=-1))

    def variance(self) -> Any:
        square = jnp.sum(jnp.square(self._scale_tri), axis=-1)
        return jnp.broadcast_to(square, self.batch_shape + self.event_shape)

    def covariance(self) -> Array:
        return self.scale_tri @ jnp.swapaxes(self.scale_tri, -1, -2)


def _fitting(kind: str, name: str, loc: Any, scale: Any, ndim: int) -> tuple[Any, Any]:
    """``loc`` and the ``scale`` of that name, of ``ndim`` axes or more, as arrays of floats; None
    stays None.
    """
    if loc is None and scale is None:
        raise ValueError(f"{kind}: expected loc or {name}, received neither")
    loc, scale = (None if v is None else float_array(v) for v in (loc, scale))
    if loc is not None and loc.ndim < 1:
        raise ValueError(f"{kind}: loc: expected a vector, received a scalar")
    if scale is not None and scale.ndim < ndim:
        raise ValueError(f"{kind}: {name}: expected {ndim} axes or more, received {scale.shape}")
    sizes = {a for s in (loc, scale) if s is not None for a in s.shape[-1:]}
    sizes |= set(scale.shape[-ndim:]) if scale is not None else set()
    if len(sizes) > 1:
        shapes = f"{getattr(loc, 'shape', None)} and {getattr(scale, 'shape', None)}"
        raise ValueError(f"{kind}: loc and {name} do not fit: received shapes {shapes}")
    return loc, scale
