"""A distribution as its independent parts: numbers that have normal ones behind them, and choices
among few categories, each with its probabilities.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast._src.distributions.base import is_distribution
from jast._src.distributions.flat_rows import split
from jast._src.distributions.operations import event_like, from_normal, to_normal
from jast._src.distributions.special import Where
from jast._src.util.pytrees import count_numbers

__all__ = ["Parts", "parts"]


class Parts(NamedTuple):
    """What `parts` makes of a distribution. Lives in one trace: it holds a function."""

    normals: int
    """How many of the numbers have normal ones behind them"""
    choices: tuple[jax.Array, ...]
    """Log probabilities [B, C] of each batch of choices"""
    value: Callable[[jax.Array, tuple[jax.Array, ...]], Any]
    """(z [normals], (category [B], ...)) -> the value"""
    inverse: Callable[[Any], tuple[jax.Array, tuple[jax.Array, ...]]]
    """The value -> (z, categories) that give it: of a mixture those of the likeliest component"""
    owners: tuple[int, ...] = ()
    """[normals] which of all choices, in their order, a number belongs to; -1: none"""


def parts(d: Any) -> Parts:
    """The independent parts of ``d``, through joints, independent axes, one of two and mixtures of
    one family: of these the component is a choice of its own.

    A Bernoulli or Categorical is a choice; all else has normal numbers behind it (`from_normal`).
    """
    if hasattr(d, "distributions"):
        return _joint(d)
    if hasattr(d, "reinterpreted_batch_ndims"):
        return parts(d.distribution)
    if isinstance(d, Where):
        return _either(d)
    if type(d).__name__ == "MixtureSameFamily" and d.components_distribution.event_shape == ():
        return _mixture(d)
    if type(d).__name__ in ("Bernoulli", "Categorical"):
        return _choice(d)
    return _numbers(d)


def _numbers(d: Any) -> Parts:
    like = event_like(d)
    n = count_numbers(like)
    return Parts(
        normals=n,
        choices=(),
        value=lambda z, _: from_normal(d, split(z, like)),
        inverse=lambda x: (_row(jax.tree.leaves(to_normal(d, x))), ()),
        owners=(-1,) * n,
    )


def _row(arrays: Any) -> jax.Array:
    """The numbers of ``arrays``, of which there may be none, as one row."""
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(a) for a in arrays)])


def _choice(d: Any) -> Parts:
    like = event_like(d)
    logits = d.logits
    if type(d).__name__ == "Bernoulli":
        logits = jnp.stack([-jax.nn.softplus(logits), -jax.nn.softplus(-logits)], axis=-1)
    else:
        logits = jax.nn.log_softmax(logits, axis=-1)
    log_p = logits.reshape(-1, logits.shape[-1])
    return Parts(
        normals=0,
        choices=(log_p,),
        value=lambda _, i: i[0].reshape(like.shape).astype(like.dtype),
        inverse=lambda x: (_row(()), (jnp.ravel(x).astype(jnp.int32),)),
    )


def _joint(d: Any) -> Parts:
    leaves, treedef = jax.tree.flatten(d.distributions, is_leaf=is_distribution)
    each = [parts(leaf) for leaf in leaves]

    def value(z: jax.Array, i: tuple[jax.Array, ...]) -> Any:
        values, at, of = [], 0, 0
        for p in each:
            values.append(p.value(z[at : at + p.normals], i[of : of + len(p.choices)]))
            at, of = at + p.normals, of + len(p.choices)
        return treedef.unflatten(values)

    def inverse(x: Any) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        found = [p.inverse(v) for p, v in zip(each, treedef.flatten_up_to(x), strict=True)]
        return _row(z for z, _ in found), tuple(i for _, choices in found for i in choices)

    choices = tuple(log_p for p in each for log_p in p.choices)
    owners, before = [], 0
    for p in each:
        owners += [o if o < 0 else o + before for o in p.owners]
        before += sum(len(c) for c in p.choices)
    return Parts(
        normals=sum(p.normals for p in each),
        choices=choices,
        value=value,
        inverse=inverse,
        owners=tuple(owners),
    )


def _either(d: Where) -> Parts:
    a, b = (parts(part) for part in d.parts)
    shapes = [(p.normals, p.owners, [c.shape for c in p.choices]) for p in (a, b)]
    if shapes[0] != shapes[1]:  # by the normal numbers that both have behind them
        return _numbers(d)
    choices = tuple(jnp.where(d.pred, p, q) for p, q in zip(a.choices, b.choices, strict=True))
    return Parts(
        normals=a.normals,
        choices=choices,
        value=lambda z, i: d.select(a.value(z, i), b.value(z, i)),
        inverse=lambda x: d.select(a.inverse(x), b.inverse(x)),
        owners=a.owners,
    )


def _mixture(d: Any) -> Parts:
    """Of each number a choice of its component, and the normal number of that one."""
    like, components = event_like(d), d.components_distribution
    log_w = jax.nn.log_softmax(d.mixture_distribution.logits, axis=-1)
    lead = (None,) * (len(components.batch_shape) - log_w.ndim)
    log_p = jnp.broadcast_to(log_w[lead], components.batch_shape).reshape(count_numbers(like), -1)

    def value(z: jax.Array, i: tuple[jax.Array, ...]) -> Any:
        own = jnp.broadcast_to(z.reshape(*like.shape, 1), components.batch_shape)
        each, k = from_normal(components, own), i[0].reshape(*like.shape, 1)
        return jnp.take_along_axis(each, k, axis=-1)[..., 0]

    def inverse(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        own = jnp.broadcast_to(x[..., None], components.batch_shape)
        each = components.log_prob(own) + log_p.reshape(components.batch_shape)
        # off the support of a component its density may be NaN
        k = jnp.argmax(jnp.where(jnp.isnan(each), -jnp.inf, each), axis=-1).astype(jnp.int32)
        z = jnp.take_along_axis(to_normal(components, own), k[..., None], axis=-1)
        return jnp.ravel(z), (jnp.ravel(k),)

    return Parts(
        normals=count_numbers(like),
        choices=(log_p,),
        value=value,
        inverse=inverse,
        owners=tuple(range(count_numbers(like))),
    )
