"""How far out a value is, in standard deviations of a normal number; how probable a choice is."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jast._src.distributions.base import tree_map
from jast._src.distributions.operations import has_mode, mode, to_normal

__all__ = ["chances", "spread"]


def spread(d: Any, x: Any) -> Any:
    """Like ``x``: the normal number of each of its numbers less that of the mode (of the median,
    where there is none); of a choice, which has no order, sqrt(2 (log p of the likeliest - log p)),
    the distance at which a normal number is as much less likely than its mode.
    """
    return _of_each_part(_spread, d, x)


def chances(d: Any, x: Any) -> Any:
    """Like ``x``, floats: the probability of each number that is whole, 0 of the others."""
    return _of_each_part(_chance, d, x)


def _of_each_part(of: Callable, d: Any, x: Any) -> Any:
    """``of`` each independent part of ``d`` and its value."""
    if not hasattr(d, "distributions"):
        return of(d, x)
    return tree_map(partial(_of_each_part, of), d.distributions, x)


def _without_independent(d: Any) -> Any:
    while hasattr(d, "reinterpreted_batch_ndims"):
        d = d.distribution
    return d


def _chance(d: Any, x: Any) -> Any:
    none = jax.tree.map(lambda a: jnp.zeros(jnp.shape(a)), x)
    if jax.tree.structure(x) != jax.tree.structure(0) or not jnp.issubdtype(x.dtype, jnp.integer):
        return none
    log_p = _without_independent(d).log_prob(x)
    return jnp.exp(log_p) if log_p.shape == x.shape else none


def _spread(d: Any, x: Any) -> Any:
    inner = _without_independent(d)
    if type(inner).__name__ in ("Bernoulli", "Categorical"):
        gap = inner.log_prob(inner.mode()) - inner.log_prob(x)
        return jnp.sqrt(2 * jnp.maximum(gap, 0))
    z = to_normal(d, x)
    if not has_mode(d):
        return z
    return jax.tree.map(lambda a, b: a - jnp.where(jnp.isfinite(b), b, 0), z, to_normal(d, mode(d)))
