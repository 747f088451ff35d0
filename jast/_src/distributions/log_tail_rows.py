"""Rows of families that are known by the logs of the probabilities below and above a value: exact
in both tails, as each is as precise as it is small.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jast._src.distributions.family_table import row
from jast._src.distributions.normal_tails import inside, log_tails, ndtri, normal_of_log_tails
from jast._src.distributions.operations import to_normal

__all__ = ["log_tails_of", "of_inverse", "of_log_tails"]


def of_log_tails(place: Callable[..., Any], known: Callable[..., Any]) -> dict[str, Any]:
    """The functions of a row.

    Args:
        place: (d, log below, log above) -> the value with these probabilities below and above it;
            it reads whichever is exact.
        known: (d, x) -> (log P(X <= x), log P(X > x)), its inverse.
    """
    return of_inverse(lambda d, z: place(d, *log_tails(z)), known) | {
        "quantile": lambda d, u: place(d, jnp.log(inside(u)), jnp.log1p(-inside(u)))
    }


def of_inverse(place: Callable[..., Any], known: Callable[..., Any]) -> dict[str, Any]:
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


def log_tails_of(d: Any, x: Any) -> tuple[jax.Array, jax.Array]:
    """(log P(X <= x), log P(X > x)) of numbers; by way of z where the row does not say."""
    known = row(d, "log_tails", "to_normal", "quantile").log_tails
    return known(d, x) if known is not None else log_tails(to_normal(d, x))
