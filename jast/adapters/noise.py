"""What is random in one place of a loop, and what a draw does there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast import distributions as D
from jast.pytrees import bound

__all__ = ["Random", "add", "model_of", "random", "replaced"]


class Random(NamedTuple):
    """What is random in one place: a distribution, or a function of the `Instant` that returns one,
    and what a draw does there.
    """

    model: Any
    apply: Partial


def random(name: str, place: str, value: Any, apply: Callable | None) -> Random:
    """What a user gave for ``place``: a distribution, whose draw ``apply`` takes, or
    a pair (distribution, function).
    """
    pair = isinstance(value, tuple) and len(value) == 2 and callable(value[1])
    model, apply = value if pair else (value, apply)
    if isinstance(model, dict):  # of names, such as those of agents
        model = D.Joint({k: _whole(d) for k, d in model.items()})
    if not (D.is_distribution(model) or callable(model)) or apply is None:
        raise ValueError(
            f"{name}: {place} must be "
            + ("" if apply is None else "a distribution, or ")
            + f"a pair (distribution, function (it, draw) -> it), received {value!r}"
        )
    # a distribution of jast is a pytree, whose numbers are traced
    model = model if isinstance(model, D.Distribution) else bound(model)
    return Random(model, bound(apply))


def add(place: Any, draw: Any) -> Any:
    """``draw`` added to what is there, number by number."""

    def add(a: Any, x: Any) -> jax.Array:
        a = jnp.asarray(a)
        if a.shape != jnp.shape(x) or not jnp.issubdtype(a.dtype, jnp.floating):
            raise ValueError(
                f"noise of shape {jnp.shape(x)} cannot be added to {a.dtype}{list(a.shape)}: give a"
                " distribution of that shape, such as Normal(jnp.zeros(4), 0.1), or a pair"
                " (distribution, function (it, draw) -> it)"
            )
        return a + x.astype(a.dtype)

    return jax.tree.map(add, place, draw)


def replaced(subject: Any, draw: Any) -> Any:
    """``subject`` with the fields that ``draw`` names."""
    like = {k: jnp.asarray(getattr(subject, k)) for k in draw}
    return subject.replace(**{k: jnp.asarray(v, like[k].dtype) for k, v in draw.items()})


def model_of(random: Random, *now: Any) -> Any:
    """Its distribution, a batch as one value."""
    return _whole(random.model if D.is_distribution(random.model) else random.model(*now))


def _whole(d: Any) -> Any:
    if isinstance(d, D.Joint):
        return D.Joint(jax.tree.map(_whole, d.distributions, is_leaf=D.is_distribution))
    batch = len(getattr(d, "batch_shape", ()))
    return D.Independent(d, batch) if batch else d
