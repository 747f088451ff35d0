"""Trained heads in one file: parameters, moments, levels, and of a network of `make_head` all that
its function is made of.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import PathLike
from jast._src.heads.heads import Heads
from jast._src.heads.networks import ACTIVATIONS, Head, dense
from jast._src.io import save_load
from jast._src.io.codec import Given, check_fits
from jast._src.io.npz import misfit, unknown
from jast._src.util.checks import instance, whole_number, wrong

__all__ = ["load", "parts", "whole"]

HEADS = ("policy", "value")


def load(path: PathLike, heads: Heads | None = None) -> Heads:
    """`Heads` from a file. Deprecated: use `jast.load`; this function goes with the next version.

    Args:
        path: of the file.
        heads: as for `jast.load`.

    Example:
        >>> import os, tempfile, jax, jast
        >>> heads = jast.heads.Heads(value=jast.heads.make_head(jax.random.key(0), 2))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "heads.npz")
        ...     jast.save(path, heads)
        ...     jast.heads.load(path).policy is None
        True
    """
    found = save_load.load(path, heads=heads)
    save_load.check_kind(path, found, Heads)
    return found


def parts(heads: Heads) -> dict[str, Any]:
    """The fields of heads as a file has them: a head as its parameters and its network."""
    levels = whole_number("save", "levels", heads.levels, 0)
    fields = dict(inputs=heads.inputs, returns=heads.returns, levels=levels)
    for name in HEADS:
        head = getattr(heads, name)
        if head is not None and not isinstance(head, Head):
            must = "be a pair (params, apply)"
            raise wrong("save", f"the {name} head", must, type(head).__name__)
        fields[name] = head and dict(network=_specification(head), params=head.params)
    return fields


def whole(path: Any, fields: dict[str, Any], given: Given) -> Heads:
    """The heads of `parts`, with the functions of those that are ``given``, if any."""
    if given.heads is not None:
        instance("load", "heads", given.heads, Heads, "jast.heads.Heads")
    heads = {
        name: _head(path, name, fields.get(name), getattr(given.heads, name, None))
        for name in HEADS
    }
    return Heads(**fields | heads)


def _specification(head):
    """What `make_head` needs to make this network again; None for a function of another kind, or
    parameters that are not its own.
    """
    module = getattr(getattr(head.apply, "func", None), "__self__", None)
    if (
        type(module).__module__ != dense.__module__
        or head.apply.func != module.apply
        or head.apply.args
        or head.apply.keywords
    ):
        return None
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(head.params)]
    # the first layer's bias, then its kernel
    if len(shapes) < 2 or len(shapes[1]) != 2:
        return None
    network = dict(
        inputs=shapes[1][0],
        outputs=list(module.outputs),
        hidden=list(module.hidden),
        activation=module.activation,
        first_activation=bool(module.first_activation),
    )
    like = _made(network).params
    same = jax.tree.structure(like) == jax.tree.structure(head.params)
    return network if same and shapes == [a.shape for a in jax.tree.leaves(like)] else None


def _made(network):
    """The `Head` of a specification, with the shapes of its parameters in their place."""
    hidden, outputs = tuple(network["hidden"]), tuple(network["outputs"])
    init, apply = dense(hidden, outputs, network["activation"], network["first_activation"])
    seen = jax.ShapeDtypeStruct((network["inputs"],), jnp.float32)
    return Head(jax.eval_shape(init, jax.random.key(0), seen), apply)


def _head(path, name, about, given):
    """One head of a file, None where it has none. ``given``: the head of `load`'s ``heads``, or
    None.
    """
    if about is None:
        if given is not None:
            raise misfit(path, "heads", f"it holds no {name} head, expected one")
        return None
    network, params = about["network"], about["params"]
    if given is not None:
        expected = _specification(given)
        if None not in (network, expected) and network != expected:
            words = f"{name} is the network {network}, expected {expected}"
            raise misfit(path, "heads", words)
    elif network is None:
        raise ValueError(
            f"load: {path} holds a {name} head with a function that is not in the file: load(path,"
            " heads=heads) with Heads that have it"
        )
    elif network["activation"] not in ACTIVATIONS:
        raise unknown(path, f"has the activation {network['activation']!r}")
    like, apply = _made(network) if given is None else given
    other = "its network" if given is None else "heads"
    check_fits(path, other, f"{name}.params", params, like)
    return Head(params, apply)
