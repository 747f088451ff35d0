"""What is random in one place of a loop, and what a draw does there."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core.typing import DistributionLike
from jast._src.util.checks import wrong
from jast._src.util.pytrees import as_partial

__all__ = ["Random", "add", "model_of", "random", "replaced"]

PAIR = "a pair (distribution, function (it, draw) -> it)"


class Random(NamedTuple):
    """What is random in one place, and what a draw does there."""

    model: DistributionLike | Callable[[Any], DistributionLike]
    """A distribution, or a function of the `Instant` that returns one"""
    apply: Partial | None
    """(it, draw) -> it; None: the draw is added"""


def random(
    name: str, place: str, value: Any, apply: Callable | None = None, *, adds: bool = False
) -> Random:
    """What a user gave for ``place``: a pair (distribution, function), or a distribution whose draw
    ``apply`` takes, or which ``adds``.
    """
    pair = isinstance(value, tuple) and len(value) == 2 and callable(value[1])
    model, apply = value if pair else (value, apply)
    if isinstance(model, dict):  # of names, such as those of agents
        try:
            model = D.Joint({k: _as_one_value(d) for k, d in model.items()})
        except ValueError as error:
            raise ValueError(f"{name}: {place}: {error}") from error
    alone = adds or apply is not None
    if not (D.is_distribution(model) or callable(model)) or not alone:
        expected = f"a distribution, or {PAIR}" if alone else PAIR
        raise ValueError(f"{name}: {place} must be {expected}, received {value!r}")
    # a distribution of jast is a pytree, whose numbers are traced
    model = model if isinstance(model, D.Distribution) else as_partial(model)
    return Random(model, None if apply is None else as_partial(apply))


def add(argument: str, subject: Any, draw: Any) -> Any:
    """``draw`` added to ``subject``, number by number; ValueError where their shapes differ, in the
    name of the ``argument`` of a door.
    """
    numbers, tree = jax.tree.flatten(subject)
    draws, given = jax.tree.flatten(draw)
    if tree != given:
        raise ValueError(
            f"{argument} must be a distribution of the structure {tree}, to which its draws are"
            f" added, or {PAIR}; received one of {given}"
        )
    return tree.unflatten([_sum(argument, a, x) for a, x in zip(numbers, draws, strict=True)])


def _sum(argument: str, a: Any, x: Any) -> jax.Array:
    a = jnp.asarray(a)
    if not jnp.issubdtype(a.dtype, jnp.floating):
        raise ValueError(
            f"{argument} must be {PAIR}, as noise cannot be added to {a.dtype}{list(a.shape)};"
            f" received a distribution of shape {jnp.shape(x)}"
        )
    if a.shape != jnp.shape(x):
        raise ValueError(
            f"{argument} must be a distribution of shape {a.shape}, such as"
            f" Normal(jnp.zeros({a.shape}), 0.1), to be added to {a.dtype}{list(a.shape)}, or"
            f" {PAIR}; received one of shape {jnp.shape(x)}"
        )
    return a + x.astype(a.dtype)


def replaced(subject: Any, draw: Any) -> Any:
    """``subject`` with the fields that ``draw`` names."""
    for k in draw:
        if not hasattr(subject, k):
            raise wrong("parameters", "names", f"be fields of {type(subject).__name__}", f"{k!r}")
    like = {k: jnp.asarray(getattr(subject, k)) for k in draw}
    return subject.replace(**{k: jnp.asarray(v, like[k].dtype) for k, v in draw.items()})


def model_of(random: Random, *now: Any) -> Any:
    """Its distribution."""
    return _as_one_value(random.model if D.is_distribution(random.model) else random.model(*now))


def _as_one_value(d: Any) -> Any:
    """A distribution of one value, where a batch counts as independent numbers."""
    if isinstance(d, D.Joint):
        return D.Joint(jax.tree.map(_as_one_value, d.distributions, is_leaf=D.is_distribution))
    batch = len(getattr(d, "batch_shape", ()))
    return D.Independent(d, batch) if batch else d
