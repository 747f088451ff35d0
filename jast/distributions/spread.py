"""How far out a value is, in standard deviations of a normal number."""

from typing import Any

import jax
import jax.numpy as jnp

from jast.distributions.base import is_distribution
from jast.distributions.verbs import has_mode, mode, to_normal

__all__ = ["spread"]


def spread(d: Any, x: Any) -> Any:
    """Like ``x``: the normal number of each of its numbers less that of the mode (of the median,
    where there is none); of a choice, which has no order, sqrt(2 (log p of the likeliest - log p)),
    the distance at which a normal number is as much less likely than its mode.
    """
    if hasattr(d, "distributions"):
        each, treedef = jax.tree.flatten(d.distributions, is_leaf=is_distribution)
        values = treedef.flatten_up_to(x)
        return treedef.unflatten([spread(a, b) for a, b in zip(each, values, strict=True)])
    inner = d
    while hasattr(inner, "reinterpreted_batch_ndims"):
        inner = inner.distribution
    if type(inner).__name__ in ("Bernoulli", "Categorical"):
        gap = inner.log_prob(inner.mode()) - inner.log_prob(x)
        return jnp.sqrt(2 * jnp.maximum(gap, 0))
    z = to_normal(d, x)
    if not has_mode(d):
        return z
    return jax.tree.map(lambda a, b: a - jnp.where(jnp.isfinite(b), b, 0), z, to_normal(d, mode(d)))
