"""Families without a closed quantile: Student's t, mixtures. The normal number z of a
value is exact in both tails; `from_normal` inverts it by Newton's method, to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.lax import lgamma, stop_gradient
from jax.scipy.special import betainc, erfinv

from jast._src.core.typing import Array, Numeric, PRNGKey
from jast._src.distributions.base import Distribution, broadcast, float_array
from jast._src.distributions.family_table import register
from jast._src.distributions.log_tail_rows import log_tails_of
from jast._src.distributions.normal import Symmetric
from jast._src.distributions.normal_tails import (
    HALF_LOG_2PI,
    inside,
    log_tails,
    ndtri,
    normal_of_log_tails,
)
from jast._src.distributions.operations import from_normal

__all__ = ["MixtureSameFamily", "StudentT", "newton", "row_of_inverse"]


def newton(
    z: jax.Array,
    y: jax.Array,
    score: Callable[[jax.Array], jax.Array],
    log_density: Callable[[jax.Array], jax.Array],
    steps: int,
    limit: float = 2.0,
) -> jax.Array:
    """The y with ``score(y) == z``, from the guess ``y``: steps of at most ``limit``, and one more
    by which derivatives in z and in what ``score`` closes over are those of the inverse.

    Args:
        score: y -> the normal number of the value at y, increasing.
        log_density: y -> log density of y.
    """

    def step(y):
        w = score(y)
        slope = jnp.exp(-0.5 * w**2 - HALF_LOG_2PI - log_density(y))  # dy/dw
        move = (z - w) * stop_gradient(slope)
        return y + jnp.clip(jnp.where(jnp.isnan(move), 0, move), -limit, limit)

    y = jax.lax.fori_loop(0, steps, lambda i, y: step(y), stop_gradient(y))
    return step(stop_gradient(y))


def row_of_inverse(place: Callable[..., Any], known: Callable[..., Any]) -> dict[str, Any]:
    """The functions of a row.

    Args:
        place: (d, z) -> the value.
        known: (d, x) -> (log P(X <= x), log P(X > x)).
    """
    return {
        "quantile": lambda d, u: place(d, ndtri(inside(u))),
        "cdf": lambda d, x: jnp.exp(known(d, x)[0]),
        "from_normal": place,
        "to_normal": lambda d, x: normal_of_log_tails(*known(d, x)),
        "log_tails": known,
    }


# Student's t: solved in y = asinh of the standardised value


class StudentT(Symmetric):
    """Student's t of ``df`` degrees of freedom, moved by ``loc`` and stretched by ``scale``.

    Example:
        >>> from jast import distributions as D
        >>> d = D.StudentT(3.0)
        >>> float(d.mode())
        0.0
    """

    _parameters = "_df", "_loc", "_scale"
    df: jax.Array = broadcast("_df")

    def __init__(self, df: Numeric, loc: Numeric = 0.0, scale: Numeric = 1.0) -> None:
        super().__init__(loc, scale)
        self._df = float_array(df)

    @property
    def dtype(self) -> Any:
        return jnp.result_type(self._df, self._loc, self._scale)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        shape = (n, *self.batch_shape)
        return self._placed(jax.random.t(key, self.df[None], shape, self.dtype))

    def log_prob(self, value: Any) -> Array:
        return _log_t(self._df, self._standardize(value)) - jnp.log(self._scale)


def _log_t(df, t):
    norm = lgamma((df + 1) / 2) - lgamma(df / 2) - 0.5 * jnp.log(df * math.pi)
    return norm - (df + 1) / 2 * jnp.log1p(jnp.square(t) / df)


def _score_t(df, t):
    """z of |t|: near 0 by the mass between -t and t, farther out by that beyond."""
    t = jnp.abs(t)
    share = jnp.square(t) / df
    middle = betainc(0.5, df / 2, share / (1 + share))
    beyond = jnp.log(betainc(df / 2, 0.5, 1 / (1 + share)) / 2)
    near = math.sqrt(2) * erfinv(jnp.minimum(middle, 0.5))
    return jnp.where(middle < 0.5, near, normal_of_log_tails(jnp.zeros_like(beyond), beyond))


def _student(d, z):
    df = jnp.broadcast_to(d.df, jnp.shape(z)).astype(jnp.result_type(z))
    size = jnp.abs(z)
    # a normal number is below the t of its probability, and z rises ever slower in y
    y = newton(
        z=size,
        y=jnp.arcsinh(size),
        score=lambda y: _score_t(df, jnp.sinh(y)),
        log_density=lambda y: _log_t(df, jnp.sinh(y)) + jnp.log(jnp.cosh(y)),
        steps=12,
        limit=8.0,
    )
    return d.loc + d.scale * jnp.sign(z) * jnp.sinh(y)


def _tails_student(d, x):
    t = (x - d.loc) / d.scale
    return log_tails(jnp.sign(t) * _score_t(d.df, t))


register(StudentT, **row_of_inverse(_student, _tails_student))


# mixtures: the root lies between the values of the parts


class MixtureSameFamily(Distribution):
    """One of k distributions of numbers of one family, drawn anew for each number.

    Args:
        mixture_distribution: a Categorical of k, over the batch.
        components_distribution: a batch of distributions of numbers [..., k].

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.MixtureSameFamily(
        ...     D.Categorical(probs=jnp.array([0.5, 0.5])), D.Normal(jnp.array([-2.0, 2.0]), 0.1)
        ... )
        >>> abs(float(d.sample(seed=0))) > 1.0
        True
    """

    event_shape: Any = ()

    def __init__(self, mixture_distribution: Any, components_distribution: Any) -> None:
        if components_distribution.event_shape != ():
            raise ValueError(
                "MixtureSameFamily: components_distribution: expected one of numbers, received"
                f" event shape {components_distribution.event_shape}"
            )
        self._mixture, self._components = mixture_distribution, components_distribution

    @property
    def mixture_distribution(self) -> Any:
        return self._mixture

    @property
    def components_distribution(self) -> Any:
        return self._components

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self._components.batch_shape[:-1]

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        which, what = jax.random.split(key)
        k = self._mixture.sample(seed=which, sample_shape=n)
        k = k.reshape(n, *(1,) * (len(self.batch_shape) + 1 - k.ndim), *k.shape[1:])
        k = jnp.broadcast_to(k, (n, *self.batch_shape))
        x = self._components.sample(seed=what, sample_shape=n)
        return jnp.take_along_axis(x, k[..., None].astype(jnp.int32), axis=-1)[..., 0]

    def log_prob(self, value: Any) -> Array:
        each = self._components.log_prob(jnp.asarray(value)[..., None])
        return jax.nn.logsumexp(each + _log_weights(self), axis=-1)


def _log_weights(d):
    w = d.mixture_distribution.logits
    return w - jax.nn.logsumexp(w, axis=-1, keepdims=True)


def _tails_mixture(d, x):
    parts = d.components_distribution
    each = log_tails_of(parts, jnp.broadcast_to(x[..., None], parts.batch_shape))
    return tuple(jax.nn.logsumexp(t + _log_weights(d), axis=-1) for t in each)


def _mixture(d, z):
    parts = d.components_distribution

    def score(x):
        return normal_of_log_tails(*_tails_mixture(d, x))

    ends = from_normal(parts, jnp.broadcast_to(z[..., None], parts.batch_shape))
    low, high = stop_gradient(jnp.min(ends, axis=-1)), stop_gradient(jnp.max(ends, axis=-1))

    def halve(i, bounds):
        low, high = bounds
        middle = low + (high - low) / 2
        above = score(middle) > z
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    steps = 24 if z.dtype == jnp.float32 else 40
    low, high = jax.lax.fori_loop(0, steps, halve, (low, high))
    return newton(z, low + (high - low) / 2, score, d.log_prob, 2, jnp.inf)


register(MixtureSameFamily, **row_of_inverse(_mixture, _tails_mixture))
register("distrax:MixtureSameFamily", **row_of_inverse(_mixture, _tails_mixture))
