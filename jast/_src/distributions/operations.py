"""What jast asks of a distribution: a draw, its mode, its log density, and the ways between its
values, the unit interval and normal numbers. Each is a look-up in the table of families.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.core.typing import ArrayTree, Density, DistributionLike, PRNGKey
from jast._src.distributions.family_table import row
from jast._src.distributions.flat_rows import filled
from jast._src.distributions.normal_tails import normal_score, phi

__all__ = [
    "cdf",
    "event_like",
    "from_normal",
    "has_cdf",
    "has_exact_tails",
    "has_mode",
    "has_quantile",
    "log_density",
    "log_mode",
    "mode",
    "no_quantile",
    "quantile",
    "sample",
    "sum_parts",
    "to_normal",
]


def sample(d: DistributionLike, key: PRNGKey) -> ArrayTree:
    """One draw from a distribution.

    Args:
        d: a distribution.
        key: consumed.

    Example:
        >>> import jax
        >>> from jast import distributions as D
        >>> D.sample(D.Normal(0.0, 1.0), jax.random.key(0)).shape
        ()
    """
    return d.sample(seed=key)


def mode(d: DistributionLike) -> ArrayTree:
    """The likeliest value of a distribution; its median where no mode is known. Of a `Gamma` or
    `Beta` whose density has no maximum, or is the same everywhere, the mean.

    Args:
        d: a distribution.

    Raises:
        ValueError: if there is neither.

    Example:
        >>> from jast import distributions as D
        >>> float(D.mode(D.tent(0.25))), float(D.mode(D.Gamma(0.5, 1.0)))
        (0.25, 0.5)
    """
    known = row(d, "mode").mode
    try:
        if known is not None:
            return known(d)
    except NotImplementedError:  # distrax's base class has the method
        pass
    half = filled(event_like(d), 0.5)
    try:
        return quantile(d, half)
    except ValueError:
        raise ValueError(
            f"{type(d).__name__} has neither a mode nor a median, so the undisturbed system is not"
            " defined"
        ) from None


def log_mode(d: DistributionLike) -> jax.Array:
    """The log density of a distribution at its mode: scalar.

    Args:
        d: a distribution.

    Example:
        >>> from jast import distributions as D
        >>> float(D.log_mode(D.Uniform(0.0, 1.0)))
        0.0
    """
    known = row(d, "log_mode").log_mode
    return known(d) if known is not None else d.log_prob(mode(d))


def log_density(d: DistributionLike, x: ArrayTree, density: Density = "raw") -> jax.Array:
    """Log density of a value.

    Args:
        d: a distribution.
        x: a value of it.
        density: "raw", or "mode": less that of the mode, so that the likeliest value has 0.

    Example:
        >>> from jast import distributions as D
        >>> float(D.log_density(D.Normal(0.0, 1.0), 2.0, "mode"))
        -2.0
    """
    if density == "raw":
        return d.log_prob(x)
    known = row(d, "log_prob_from_mode").log_prob_from_mode
    return known(d, x) if known is not None else d.log_prob(x) - log_mode(d)


def quantile(d: DistributionLike, u: ArrayTree) -> ArrayTree:
    """The value of a distribution at a quantile, so that ``u ~ U(0, 1)`` gives a draw of it.

    Vectors are taken coordinate by coordinate; integers by the inverse of their distribution
    function.

    Args:
        d: a distribution.
        u: in [0, 1]: a pytree like a value, of floats.

    Raises:
        ValueError: naming a distribution that has no quantile function.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.quantile(D.Uniform(2.0, 6.0), jnp.array(0.25)))
        3.0
    """
    known = row(d, "quantile").quantile
    if known is None:
        raise no_quantile(d)
    return known(d, jax.tree.map(jnp.asarray, u))  # plain numbers, too


def cdf(d: DistributionLike, x: ArrayTree) -> ArrayTree:
    """The inverse of `quantile`: the ``u`` in [0, 1] with ``quantile(d, u) == x`` up to rounding.

    Args:
        d: a distribution.
        x: a value of it. An integer has the middle of the interval of ``u`` that gives it.

    Returns:
        A pytree like ``x`` of floats; 0 or 1 outside the support.

    Raises:
        ValueError: naming a distribution that has none.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.cdf(D.Normal(0.0, 1.0), jnp.array(0.0)))
        0.5
    """
    if row(d, "quantile").quantile is None:
        raise ValueError(f"cdf: {type(d).__name__} has no quantile function here to invert")
    # a cdf of a base may be that of another quantile function
    known = row(d, "quantile", "cdf").cdf
    if known is None:
        raise ValueError(
            f"cdf: {type(d).__name__} has a method quantile, but no method cdf that inverts it"
        )
    return known(d, x)


def from_normal(d: DistributionLike, z: ArrayTree) -> ArrayTree:
    """The value of a distribution at a normal number: ``quantile(d, Phi(z))``, so that ``z ~ N(0,
    I)`` gives a draw of ``d``.

    Exact in both tails where `has_exact_tails`; else by way of Phi(z), a float below 1.

    Args:
        d: a distribution.
        z: a pytree like a value, of floats.

    Raises:
        ValueError: naming a distribution that has no quantile function.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.from_normal(D.Normal(1.0, 2.0), jnp.array(3.0)))
        7.0
    """
    known = row(d, "from_normal", "quantile").from_normal
    return known(d, z) if known is not None else quantile(d, jax.tree.map(phi, z))


def to_normal(d: DistributionLike, x: ArrayTree) -> ArrayTree:
    """The inverse of `from_normal`: z with ``from_normal(d, z) == x``; for a whole number the
    middle (in probability) of those.

    Args:
        d: a distribution.
        x: a value of it.

    Raises:
        ValueError: naming a distribution for which none is known.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.to_normal(D.Normal(1.0, 2.0), jnp.array(7.0)))
        3.0
    """
    known = row(d, "to_normal", "quantile", "cdf").to_normal
    return known(d, x) if known is not None else jax.tree.map(normal_score, cdf(d, x))


def has_mode(d: DistributionLike) -> bool:
    """Whether `mode` is defined for a distribution (host-side).

    Args:
        d: a distribution.

    Example:
        >>> from jast import distributions as D
        >>> D.has_mode(D.tent(0.5)), D.has_mode(D.seeds())
        (True, False)
    """
    return _defined(lambda: mode(d))


def has_quantile(d: DistributionLike) -> bool:
    """Whether `quantile` is defined for a distribution (host-side).

    Args:
        d: a distribution.

    Example:
        >>> from jast import distributions as D
        >>> D.has_quantile(D.Poisson(3.0)), D.has_quantile(D.seeds())
        (True, False)
    """
    return _defined(lambda: quantile(d, filled(event_like(d), 0.5)))


def has_cdf(d: DistributionLike) -> bool:
    """Whether `cdf` is defined for a distribution (host-side).

    Args:
        d: a distribution.

    Example:
        >>> from jast import distributions as D
        >>> D.has_cdf(D.Normal(0.0, 1.0)), D.has_cdf(D.seeds())
        (True, False)
    """
    return _defined(lambda: cdf(d, sample(d, jax.random.key(0))))


def has_exact_tails(d: DistributionLike) -> bool:
    """Whether `from_normal` is exact however far out (host-side). Where it is not, in float32 all z
    > 5.4 are one value.

    Args:
        d: a distribution.

    Example:
        >>> from jast import distributions as D
        >>> D.has_exact_tails(D.Normal(0.0, 1.0)), D.has_exact_tails(D.tent(0.5))
        (True, False)
    """
    known = row(d, "from_normal", "quantile")
    return known.from_normal is not None and (known.exact is None or known.exact(d))


def event_like(d: DistributionLike) -> ArrayTree:
    """Shapes and dtypes of one value of a distribution.

    Args:
        d: a distribution.

    Example:
        >>> from jast import distributions as D
        >>> D.event_like(D.Normal(0.0, 1.0)).shape
        ()
    """
    return jax.eval_shape(lambda: sample(d, jax.random.key(0)))


def sum_parts(parts: ArrayTree) -> jax.Array:
    """The sum of a pytree of scalars, in the widest of their dtypes.

    Args:
        parts: a pytree of scalars.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.sum_parts({"a": jnp.array(1.0), "b": jnp.array(2.0)}))
        3.0
    """
    leaves = jax.tree.leaves(parts)
    dtype = jnp.result_type(*leaves)
    first, *others = (lax.convert_element_type(v, dtype) for v in leaves)
    return sum(others, first)


def no_quantile(d: Any) -> ValueError:
    """The error of a distribution that has no quantile function."""
    return ValueError(
        f"quantile: {type(d).__name__} has no quantile function here; use jast.actions.samples()"
    )


def _defined(function: Callable[[], Any]) -> bool:
    try:
        jax.eval_shape(function)  # of no arguments, as a distribution need not be a pytree
    except ValueError:
        return False
    return True
