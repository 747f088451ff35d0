"""Distributions: distrax's, and what stress testing needs beside them.

A disturbance model returns any object with ``sample(seed=key)``, ``log_prob(x)`` and, where it
exists, ``mode()``: distrax's distributions do, and so do those made here. This is the only module
that imports distrax.
"""

import warnings

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import special
from jax.scipy.linalg import solve_triangular

# tensorflow-probability, below distrax, touches deprecated names of jax
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from distrax import (
        Bernoulli,
        Beta,
        Categorical,
        Distribution,
        Gamma,
        Independent,
        Joint,
        Laplace,
        Logistic,
        MultivariateNormalDiag,
        MultivariateNormalTri,
        Normal,
        Transformed,
        Uniform,
    )

    Normal(0.0, 1.0).name  # noqa: B018  (the deprecated names are touched lazily, so touch them here)

__all__ = [
    "Bernoulli",
    "Beta",
    "Categorical",
    "Deterministic",
    "Distribution",
    "Fixed",
    "Gamma",
    "Independent",
    "Joint",
    "Laplace",
    "Logistic",
    "MultivariateNormalDiag",
    "MultivariateNormalTri",
    "Normal",
    "Seeds",
    "Tent",
    "Transformed",
    "Uniform",
    "Where",
    "cdf",
    "event_like",
    "float_dtype",
    "fraction",
    "has_cdf",
    "has_mode",
    "has_quantile",
    "log_density",
    "log_mode",
    "mode",
    "quantile",
    "sample",
    "seeds",
    "sum_parts",
    "tent",
    "where",
]


class Fixed(Distribution):
    """The certain, empty disturbance ``()``: a system with one start."""

    @property
    def event_shape(self):
        return ()

    def sample(self, *, seed=None, sample_shape=()):
        return ()

    def _sample_n(self, key, n):
        return ()

    def log_prob(self, value):
        return jnp.zeros(())

    def mode(self):
        return ()


class Deterministic(Distribution):
    """All mass on ``value``, a pytree of arrays: a recorded disturbance. ``log_prob`` is 0: it is a
    point, not a density.
    """

    def __init__(self, value):
        super().__init__()
        self._value = value

    @property
    def event_shape(self):
        return jax.tree.map(jnp.shape, self._value)

    def sample(self, *, seed=None, sample_shape=()):
        return self._value

    def _sample_n(self, key, n):
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (n, *a.shape)), self._value)

    def log_prob(self, value):
        return jnp.zeros(())

    def mode(self):
        return self._value


class Seeds(Distribution):
    """Random seeds of ``shape``, uint32, for a system whose disturbance density is unknown:
    ``log_prob`` is 0 and there is no mode.
    """

    def __init__(self, shape=()):
        super().__init__()
        self._shape = tuple(shape)

    @property
    def event_shape(self):
        return self._shape

    def _sample_n(self, key, n):
        return jax.random.bits(key, (n, *self._shape), jnp.uint32)

    def log_prob(self, value):
        return jnp.zeros(())


class Tent(Distribution):
    """Density proportional to ``1 - |x - center| / width`` on ``[low, high]`` (elementwise over
    ``center``), zero elsewhere.

    With ``width=1`` on [0, 1] its mode-normalised log density is ``ln(1 - |x - center|)``, the step
    reward of the MCFS-AP paper (eq. 1 as a sum of logs).
    """

    def __init__(self, center, width=1.0, low=0.0, high=1.0):
        super().__init__()
        center = jnp.asarray(center)
        self._center, self._width, self._low, self._high = (
            jnp.asarray(v, center.dtype) for v in (center, width, low, high)
        )

    @property
    def event_shape(self):
        return ()

    @property
    def batch_shape(self):
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

    def log_prob_from_mode(self, x):
        """Log density less the log density of the mode, without the normaliser: exactly ``log(1 -
        |x - center| / width)``.
        """
        inside = (x >= self._low) & (x <= self._high)
        height = jnp.where(inside, 1 - jnp.abs(x - self._center) / self._width, 0.0)
        return jnp.where(height > 0, jnp.log(jnp.where(height > 0, height, 1.0)), -jnp.inf)

    def log_prob(self, value):
        return self.log_prob_from_mode(value) - jnp.log(self._masses()[1])

    def quantile(self, u):
        lower, span = self._masses()
        mass = (lower + u * span) / self._width  # of the full tent of unit mass
        z = jnp.where(
            mass < 0.5, jnp.sqrt(2 * mass) - 1, 1 - jnp.sqrt(jnp.maximum(2 - 2 * mass, 0))
        )
        return jnp.clip(self._center + self._width * z, self._low, self._high)

    def cdf(self, value):
        return fraction(*(self._cdf_full(v) for v in (value, self._low, self._high)))

    def _sample_n(self, key, n):
        return self.quantile(jax.random.uniform(key, (n, *self.batch_shape), self._center.dtype))

    def mode(self):
        return self._center


class Where(Distribution):
    """``a`` where the scalar ``pred`` holds, else ``b``: two classes of distribution over the same
    kind of value.
    """

    def __init__(self, pred, a, b):
        super().__init__()
        self._pred, self._a, self._b = jnp.asarray(pred), a, b

    @property
    def event_shape(self):
        return self._a.event_shape

    def _select(self, a, b):
        return jax.tree.map(
            lambda x, y: jnp.where(self._pred, x, jnp.asarray(y, jnp.result_type(x))), a, b
        )

    def sample(self, *, seed, sample_shape=()):
        # one key serves both, as only one of the two draws is seen; the clone tells JAX's check of
        # reused keys that it is meant
        other = self._b.sample(seed=jax.random.clone(seed), sample_shape=sample_shape)
        return self._select(self._a.sample(seed=seed, sample_shape=sample_shape), other)

    def _sample_n(self, key, n):
        return self.sample(seed=key, sample_shape=(n,))

    def log_prob(self, value):
        return self._select(self._a.log_prob(value), self._b.log_prob(value))

    def log_prob_from_mode(self, value):
        return self._select(
            log_density(self._a, value, "mode"), log_density(self._b, value, "mode")
        )

    def mode(self):
        return self._select(mode(self._a), mode(self._b))

    def quantile(self, u):
        return self._select(quantile(self._a, u), quantile(self._b, u))

    def cdf(self, value):
        return self._select(cdf(self._a, value), cdf(self._b, value))


def tent(center, width=1.0, low=0.0, high=1.0):
    """A `Tent`: likeliest at ``center`` (any shape, elementwise), falling linearly to zero
    ``width`` away, cut to ``[low, high]``.
    """
    return Tent(center, width, low, high)


def seeds(shape=()):
    """`Seeds` of ``shape``, uint32: the density of the disturbance is unknown (log p = 0), only its
    seed is chosen.
    """
    return Seeds(shape)


def where(pred, a, b):
    """`Where`: distribution ``a`` where the scalar ``pred`` holds, else ``b``; both over values of
    one shape and dtype.
    """
    return Where(pred, a, b)


def sample(d, key):
    """One draw from ``d``."""
    return d.sample(seed=key)


def mode(d):
    """The likeliest value of ``d``; its median where distrax names no mode. ValueError if there is
    neither.
    """
    if isinstance(d, Uniform):
        return (d.low + d.high) / 2  # any point is a mode; the middle is the undisturbed one
    if isinstance(d, Joint):
        return jax.tree.map(mode, d.distributions, is_leaf=_is_distribution)
    if isinstance(d, Independent):
        return mode(d.distribution)
    try:
        return d.mode()
    except (NotImplementedError, AttributeError):
        pass
    half = _half(d)
    try:
        return quantile(d, half)
    except ValueError:
        raise ValueError(
            f"{type(d).__name__} has neither a mode nor a median: the undisturbed system is not"
            " defined"
        ) from None


def has_mode(d):
    """Whether `mode` is defined for ``d`` (host-side)."""
    return _defined(lambda: mode(d))


def has_quantile(d):
    """Whether `quantile` is defined for ``d`` (host-side)."""
    return _defined(lambda: quantile(d, _half(d)))


def has_cdf(d):
    """Whether `cdf` is defined for ``d`` (host-side)."""
    return _defined(lambda: cdf(d, sample(d, jax.random.key(0))))


def _defined(function):
    try:
        jax.eval_shape(function)  # of no arguments, as a distribution need not be a pytree
    except ValueError:
        return False
    return True


def log_mode(d):
    """The log density of ``d`` at its mode: scalar."""
    if isinstance(d, Joint):
        return sum_parts(jax.tree.map(log_mode, d.distributions, is_leaf=_is_distribution))
    return d.log_prob(mode(d))


def log_density(d, x, density="raw"):
    """Log density of ``x``: ``"raw"``, or ``"mode"``: less that of the mode, so that the likeliest
    value has 0.
    """
    if density == "raw":
        return d.log_prob(x)
    if isinstance(d, (Fixed, Seeds, Deterministic)):
        return d.log_prob(x)
    if isinstance(d, Joint):
        parts = jax.tree.map(
            lambda e, v: log_density(e, v, "mode"), d.distributions, x, is_leaf=_is_distribution
        )
        return sum_parts(parts)
    if isinstance(d, Independent):
        inner = log_density(d.distribution, x, "mode")
        return inner.sum(range(inner.ndim - d.reinterpreted_batch_ndims, inner.ndim))
    if hasattr(d, "log_prob_from_mode"):
        return d.log_prob_from_mode(x)
    return d.log_prob(x) - log_mode(d)


def quantile(d, u):
    """The value of ``d`` at the quantile ``u`` in [0, 1] (a pytree like a value of ``d``, floats),
    so that ``u ~ U(0, 1)`` gives a draw of ``d``.

    Vectors are taken coordinate by coordinate; integers by the inverse of their distribution
    function. ValueError names a distribution that cannot.
    """
    if hasattr(d, "quantile"):
        return d.quantile(u)
    if isinstance(d, Fixed):
        return ()
    if isinstance(d, Uniform):
        return d.low + u * (d.high - d.low)
    if isinstance(d, Normal):
        return d.loc + d.scale * special.ndtri(_open(u))
    if isinstance(d, MultivariateNormalDiag):
        return d.loc + d.scale_diag * special.ndtri(_open(u))
    if isinstance(d, MultivariateNormalTri):
        return d.loc + d.scale_tri @ special.ndtri(_open(u))
    if isinstance(d, Logistic):
        return d.loc + d.scale * special.logit(_open(u))
    if isinstance(d, Laplace):
        v = _open(u) - 0.5
        return d.loc - d.scale * jnp.sign(v) * jnp.log1p(-2 * jnp.abs(v))
    if isinstance(d, Bernoulli):
        return jnp.asarray(u >= 1 - d.probs, d.dtype)
    if isinstance(d, Categorical):
        below = jnp.cumsum(d.probs, axis=-1)[..., :-1]
        return jnp.sum(u[..., None] >= below, axis=-1).astype(d.dtype)
    if isinstance(d, Independent):
        return quantile(d.distribution, u)
    if isinstance(d, Joint):
        return jax.tree.map(quantile, d.distributions, u, is_leaf=_is_distribution)
    if _of_scalars(d):
        x0, x1 = (
            d.bijector.forward(quantile(d.distribution, jnp.full_like(u, q))) for q in (0.25, 0.75)
        )
        return d.bijector.forward(quantile(d.distribution, jnp.where(x1 >= x0, u, 1 - u)))
    raise ValueError(
        f"quantile: {type(d).__name__} has no quantile function here; use jast.actions.samples()"
    )


def cdf(d, x):
    """The inverse of `quantile`: the ``u`` in [0, 1] (a pytree like ``x``, floats) with
    ``quantile(d, u) == x`` up to rounding, for a value ``x`` of ``d``.

    An integer has the middle of the interval of ``u`` that gives it. Outside of the support: 0 or
    1. ValueError names a distribution that cannot.
    """
    if hasattr(d, "quantile"):
        if _inverts(d):
            return d.cdf(x)
        raise ValueError(
            f"cdf: {type(d).__name__} has a method quantile, but no method cdf that inverts it"
        )
    if isinstance(d, Fixed):
        return ()
    if isinstance(d, Uniform):
        return fraction(x, d.low, d.high)
    if isinstance(d, Normal):
        return special.ndtr(_standard(x - d.loc, d.scale))
    if isinstance(d, MultivariateNormalDiag):
        return special.ndtr(_standard(x - d.loc, d.scale_diag))
    if isinstance(d, MultivariateNormalTri):
        far = jnp.sqrt(jnp.finfo(d.loc.dtype).max)  # an infinite one would make others NaN
        return special.ndtr(
            solve_triangular(d.scale_tri, jnp.clip(x - d.loc, -far, far), lower=d.is_lower)
        )
    if isinstance(d, Logistic):
        return special.expit(_standard(x - d.loc, d.scale))
    if isinstance(d, Laplace):
        z = _standard(x - d.loc, d.scale)
        tail = jnp.exp(-jnp.abs(z)) / 2
        return jnp.where(z < 0, tail, 1 - tail)
    if isinstance(d, Bernoulli):
        return _cell(x, (1 - d.probs)[..., None])
    if isinstance(d, Categorical):
        return _cell(x, jnp.cumsum(d.probs, axis=-1)[..., :-1])
    if isinstance(d, Independent):
        return cdf(d.distribution, x)
    if isinstance(d, Joint):
        return jax.tree.map(cdf, d.distributions, x, is_leaf=_is_distribution)
    if _of_scalars(d):
        x0, x1 = (
            d.bijector.forward(quantile(d.distribution, jnp.full_like(x, q))) for q in (0.25, 0.75)
        )
        try:
            u = cdf(d.distribution, d.bijector.inverse(x))
        except NotImplementedError:
            raise ValueError(f"cdf: {type(d).__name__} has a bijector without inverse") from None
        u = jnp.where(x1 >= x0, u, 1 - u)
        inside = (u > 0) & (u < 1)  # off the support the inverse may be NaN, or of either end
        return jnp.where(inside, u, (x >= (x0 + x1) / 2).astype(u.dtype))
    raise ValueError(f"cdf: {type(d).__name__} has no quantile function here to invert")


def fraction(x, low, high):
    """The part of the way from ``low`` to ``high`` at which ``x`` is, in [0, 1]; 0.5 where there is
    no way.
    """
    none = high == low
    return jnp.where(none, 0.5, jnp.clip((x - low) / jnp.where(none, 1, high - low), 0, 1))


def _inverts(d):
    """Whether the ``cdf`` of ``d`` is of the class that defines its ``quantile``, or of one below:
    distrax's may be another function.
    """
    first = next((c for c in type(d).__mro__ if {"cdf", "quantile"} & vars(c).keys()), None)
    return hasattr(d, "cdf") and (first is None or "cdf" in vars(first))


def _of_scalars(d):
    return (
        isinstance(d, Transformed)
        and d.bijector.event_ndims_in == 0
        and d.bijector.event_ndims_out == 0
    )


def _standard(gap, scale):
    """``gap / scale``; where the scale is 0, a gap of 0 stays 0."""
    return gap / jnp.maximum(scale, jnp.finfo(scale.dtype).tiny)


def _cell(x, inner):
    """Middle of the ``x``-th of the intervals of [0, 1] that begin at 0 and at each of ``inner``
    (on the last axis); 0 or 1 where there is none.
    """
    end = jnp.zeros((*inner.shape[:-1], 1), inner.dtype)
    starts, last = jnp.concatenate([end, inner, end + 1], axis=-1), inner.shape[-1]
    v = jnp.asarray(x).astype(inner.dtype)
    i = jnp.clip(jnp.floor(v), 0, last).astype(jnp.int32)[..., None]
    low, high = (jnp.take_along_axis(starts, j, axis=-1)[..., 0] for j in (i, i + 1))
    middle = (low + high) / 2
    middle = jnp.where(middle < high, middle, low)  # an interval holds its start alone
    return jnp.clip(jnp.where((v < 0) | (v > last), v, middle), 0, 1).astype(
        float_dtype(jnp.result_type(x))
    )


def _half(d):
    """0.5 for each number of a value of ``d``."""
    return jax.tree.map(lambda s: jnp.full(s.shape, 0.5, float_dtype(s.dtype)), event_like(d))


def _open(u):
    """Keep ``u`` off 0 and 1, where an unbounded quantile is infinite."""
    eps = jnp.finfo(u.dtype).eps
    return jnp.clip(u, eps / 2, 1 - eps)


def float_dtype(dtype):
    """``dtype`` where it is floating, else the default float."""
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.zeros(()).dtype


def event_like(d):
    """Shapes and dtypes of one value of ``d``."""
    return jax.eval_shape(lambda: sample(d, jax.random.key(0)))


def _is_distribution(d):
    return isinstance(d, Distribution)


def sum_parts(parts):
    """The sum of a pytree of scalars, in the widest of their dtypes."""
    leaves = jax.tree.leaves(parts)
    dtype = jnp.result_type(*leaves)
    return sum(
        (lax.convert_element_type(v, dtype) for v in leaves[1:]),
        lax.convert_element_type(leaves[0], dtype),
    )
