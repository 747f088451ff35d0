"""Families without a closed quantile: Student's t, mixtures. The normal number z of a
value is exact in both tails; `from_normal` inverts it by Newton's method, to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.lax import lgamma, stop_gradient
from jax.scipy.special import betainc, betaln, erfinv

from jast._src.core.typing import Array, Numeric, PRNGKey
from jast._src.distributions.base import Distribution, broadcast, parameter_array
from jast._src.distributions.family_table import register, register_both
from jast._src.distributions.log_tail_rows import log_tails_of, of_inverse
from jast._src.distributions.normal import Symmetric
from jast._src.distributions.normal_tails import HALF_LOG_2PI, log_tails, normal_of_log_tails
from jast._src.distributions.operations import from_normal, mode, no_quantile
from jast._src.distributions.tables import interpolated, numbers, serves, tail

__all__ = ["MixtureSameFamily", "StudentT", "newton"]


MAX_STEPS = 64
"""Steps at most: halving alone brings an interval to rounding."""
LIMIT = 4.0
"""Longest step where only one side is known: numbers are logarithms then."""


def newton(
    score: Callable[[Any, jax.Array], jax.Array],
    log_density: Callable[[Any, jax.Array], jax.Array],
    about: Any,
    z: jax.Array,
    y: jax.Array,
    low: Numeric = -jnp.inf,
    high: Numeric = jnp.inf,
) -> jax.Array:
    """The y with ``score(about, y) == z``, from the guess ``y``, by Newton's method between the
    nearest values known to be too low and too high; to rounding. Its derivatives in z and in
    ``about`` are those of the inverse.

    Args:
        score: the normal number of the value at y, increasing.
        log_density: log density of y.
        about: a pytree, the parameters of both.
        z, y: of one shape.
        low, high: between which the answer lies.
    """
    leaves, tree = jax.tree.flatten(about)
    return _newton(score, log_density, tree, leaves, z, y, low, high)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _newton(score, log_density, tree, leaves, z, y, low, high):
    about, near = tree.unflatten(leaves), math.sqrt(jnp.finfo(z.dtype).eps)

    def go_on(carry):
        i, *_, far = carry
        return (i < MAX_STEPS) & jnp.any(far)

    def step(carry):
        i, y, low, high, far = carry
        w = score(about, y)
        move = (z - w) * _slope(log_density, about, w, y)
        move = jnp.where(jnp.isnan(move), 0, move)
        low, high = jnp.where(w < z, y, low), jnp.where(w > z, y, high)
        middle = low + (high - low) / 2
        last = ~(jnp.abs(z - w) > near)  # from so near one step, which squares the error, is enough
        inside = (y + move > low) & (y + move < high)
        between = jnp.where(inside | last, y + move, middle)
        after = jnp.where(jnp.isfinite(middle), between, y + jnp.clip(move, -LIMIT, LIMIT))
        return i + 1, jnp.where(far, after, y), low, high, far & ~last

    low, high = (jnp.full_like(y, end) for end in (low, high))
    return jax.lax.while_loop(go_on, step, (0, y, low, high, jnp.ones(jnp.shape(y), bool)))[1]


def _newton_jvp(score, log_density, tree, primals, tangents):
    leaves, z, *_ = primals
    (*moves, rise), moved = (*tangents[0], tangents[1]), 0
    y, about = _newton(score, log_density, tree, *primals), tree.unflatten(leaves)
    if not all(isinstance(t, SymbolicZero) for t in moves):  # in betainc's shapes there is none
        moves = list(map(_instantiated, moves))
        _, moved = jax.jvp(lambda leaves: score(tree.unflatten(leaves), y), (leaves,), (moves,))
    return y, _slope(log_density, about, z, y) * (_instantiated(rise) - moved)


def _slope(log_density, about, z, y):
    """dy/dz, where the normal number of y is z."""
    return jnp.exp(-0.5 * jnp.square(z) - HALF_LOG_2PI - log_density(about, y))


def _instantiated(tangent):
    return np.zeros(tangent.shape, tangent.dtype) if isinstance(tangent, SymbolicZero) else tangent


_newton.defjvp(_newton_jvp, symbolic_zeros=True)


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
        self._df = parameter_array("StudentT: df", df)
        self._known_numbers = numbers(df)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        shape = (n, *self.batch_shape)
        return self._placed(jax.random.t(key, self.df[None], shape, self.dtype))

    def log_prob(self, value: Any) -> Array:
        return _log_t(self._df, self._standardize(value)) - jnp.log(self._scale)


def _log_t(df, t):
    norm = lgamma((df + 1) / 2) - lgamma(df / 2) - 0.5 * jnp.log(df * math.pi)
    return norm - (df + 1) / 2 * _log_more(df, t)


def _log_more(df, t):
    """log(1 + t^2 / df), also where the square is no float: with few ``df`` it matters there."""
    s = t / jnp.sqrt(df)
    large = jnp.abs(s) > 1
    out = jnp.where(large, s, 1)
    return 2 * jnp.log(jnp.abs(out)) + jnp.log1p(jnp.square(jnp.where(large, 1 / out, s)))


def _score_t(df, t):
    """z of |t|: near 0 by the mass between -t and t, farther out by that beyond, and where that is
    the first term of its series to rounding (DLMF 8.17.7), by the log of this.
    """
    square, more = jnp.square(t), _log_more(df, t)
    share = square / df
    near = square < 0.45  # where no more than half lies between, whatever df
    far = more > -math.log(jnp.finfo(more.dtype).eps)
    half, rest = jnp.full_like(share, 0.5), df / 2
    a, b = jnp.where(near, half, rest), jnp.where(near, rest, half)
    mass = betainc(a, b, jnp.where(far, 0.5, jnp.where(near, share, 1) / (1 + share)))
    inner = math.sqrt(2) * erfinv(jnp.where(near, mass, 0))
    first = -rest * more - jnp.log(rest) - betaln(rest, half)
    beyond = jnp.where(far, first, jnp.log(jnp.where(near, 1, mass))) - math.log(2.0)
    return jnp.where(near, inner, normal_of_log_tails(jnp.zeros_like(beyond), beyond))


def _score_of_asinh(df, y):
    return _score_t(df, jnp.sinh(y))


def _log_of_asinh(df, y):
    return _log_t(df, jnp.sinh(y)) + jnp.log(jnp.cosh(y))


def _asinh_of_t(df, z):
    """On the host."""
    from scipy.special import stdtrit

    return -np.sign(z) * np.arcsinh(stdtrit(df, tail(z)))


def _student(d, z):
    if serves(d._known_numbers, z):
        return d.loc + d.scale * jnp.sinh(interpolated(_asinh_of_t, d._known_numbers, z))
    size, df = jnp.where(z < 0, -z, z), jnp.broadcast_to(d.df, jnp.shape(z)).astype(z.dtype)
    # a normal number is below the t of its probability, and z rises ever slower in y
    y = newton(_score_of_asinh, _log_of_asinh, df, size, jnp.arcsinh(size))
    return d.loc + d.scale * jnp.sinh(jnp.where(z < 0, -y, y))


def _tails_student(d, x):
    t = (x - d.loc) / d.scale
    return log_tails(jnp.sign(t) * _score_t(d.df, t))


register(StudentT, **of_inverse(_student, _tails_student))


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
        self.mixture_distribution: Any = mixture_distribution
        self.components_distribution: Any = components_distribution

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self.components_distribution.batch_shape[:-1]

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        which, what = jax.random.split(key)
        k = self.mixture_distribution.sample(seed=which, sample_shape=n)
        k = k.reshape(n, *(1,) * (len(self.batch_shape) + 1 - k.ndim), *k.shape[1:])
        k = jnp.broadcast_to(k, (n, *self.batch_shape))
        x = self.components_distribution.sample(seed=what, sample_shape=n)
        return jnp.take_along_axis(x, k[..., None].astype(jnp.int32), axis=-1)[..., 0]

    def log_prob(self, value: Any) -> Array:
        each = self.components_distribution.log_prob(jnp.asarray(value)[..., None])
        return jax.nn.logsumexp(each + _log_weights(self), axis=-1)


def _log_weights(d):
    w = d.mixture_distribution.logits
    return w - jax.nn.logsumexp(w, axis=-1, keepdims=True)


def _tails_mixture(d, x):
    parts = d.components_distribution
    each = log_tails_of(parts, jnp.broadcast_to(x[..., None], parts.batch_shape))
    return tuple(jax.nn.logsumexp(t + _log_weights(d), axis=-1) for t in each)


def _score_mixture(d, x):
    return normal_of_log_tails(*_tails_mixture(d, x))


def _mixture(d, z):
    parts = d.components_distribution
    if not jnp.issubdtype(parts.dtype, jnp.floating):  # Newton's rule comes between whole numbers
        raise no_quantile(d)
    ends = stop_gradient(from_normal(parts, jnp.broadcast_to(z[..., None], parts.batch_shape)))
    guess = jnp.sum(ends * jnp.exp(_log_weights(d)), axis=-1)
    low, high = jnp.min(ends, axis=-1), jnp.max(ends, axis=-1)
    return newton(_score_mixture, type(d).log_prob, d, z, guess, low, high)


def _mode_of_mixture(d):
    """The likeliest of the modes of its parts."""
    parts = d.components_distribution
    each = jnp.moveaxis(jnp.broadcast_to(mode(parts), parts.batch_shape), -1, 0)
    best = jnp.argmax(jax.vmap(d.log_prob)(each), axis=0)
    return jnp.take_along_axis(each, best[None], axis=0)[0]


register_both(MixtureSameFamily, mode=_mode_of_mixture, **of_inverse(_mixture, _tails_mixture))
