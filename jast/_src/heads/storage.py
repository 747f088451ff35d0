"""Trained heads in one file: parameters, moments, levels, and of a network of `make_head` all that
its function is made of.
"""

from __future__ import annotations

import operator
import os
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.heads.heads import Heads, Moments
from jast._src.heads.networks import ACTIVATIONS, Head, dense
from jast._src.io import save_load
from jast._src.io.npz import arrays_of, check_array, check_structure, describe, named
from jast._src.runtime._jax import is_traced

if TYPE_CHECKING:
    from jast._src.core.typing import PathLike

__all__ = ["load", "save"]

HEADS, MOMENTS = ("policy", "value"), ("inputs", "returns")


def save(path: PathLike, heads: Heads) -> None:
    """Write `Heads` to a file. Deprecated: use `jast.save`; this function goes with the next
    version.

    The function of a network of `make_head` is in the file by its sizes and its activation; a
    function of your own cannot be, and `load` asks for it.

    Args:
        path: of the file.
        heads: what to write.

    Raises:
        ValueError: for heads with neither head, for parameters and moments that are not arrays of
            numbers, and for levels that are no integer.

    Example:
        >>> import os, tempfile, jax, jast
        >>> heads = jast.heads.Heads(value=jast.heads.make_head(jax.random.key(0), 2))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     jast.heads.save(os.path.join(folder, "heads.npz"), heads)
    """
    save_load.store(path, "jast heads", heads)


def load(path: PathLike, heads: Heads | None = None) -> Heads:
    """`Heads` from a file. Deprecated: use `jast.load`; this function goes with the next version.

    A network of `make_head` gets the very function that such networks of one shape share, so that
    what was compiled for them serves here too.

    Args:
        path: of the file.
        heads: needed where a head has a function of your own. Its functions are taken, the file's
            parameters must be like its own (structure, shapes, kinds of number; the precision may
            differ), and the rest is the file's.

    Example:
        >>> import os, tempfile, jax, jast
        >>> heads = jast.heads.Heads(value=jast.heads.make_head(jax.random.key(0), 2))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "heads.npz")
        ...     jast.heads.save(path, heads)
        ...     jast.heads.load(path).policy is None
        True
    """
    return save_load.restore(path, "jast heads", heads=heads)[0]


def parts(heads: Heads) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays of a file of heads."""
    _check("save", heads)
    try:
        levels = operator.index(heads.levels)
    except TypeError:
        raise ValueError(f"save: levels must be an integer, received {heads.levels!r}") from None
    arrays, about = {}, {}
    for name in HEADS:
        if (head := getattr(heads, name)) is not None:
            arrays[name] = head.params
            about[name] = dict(network=_specification(head), structure=describe(head.params))
    for name in MOMENTS:
        moments = getattr(heads, name)
        if moments is not None and not isinstance(moments, Moments):
            raise ValueError(
                f"save: {name} must be jast.heads.Moments or None, received"
                f" {type(moments).__name__}"
            )
        arrays[name] = moments
    for name, part in arrays.items():
        for at, leaf in jax.tree_util.tree_leaves_with_path(part):
            if not _storable(leaf):
                raise ValueError(
                    f"save: {name}{jax.tree_util.keystr(at)} must be an array of numbers, received"
                    f" {_readable(leaf)}"
                )
    return dict(levels=levels, heads=about), named(arrays)


def whole(
    path: str | os.PathLike, header: dict, arrays: dict[str, np.ndarray], heads: Heads | None
) -> Heads:
    """The heads of `parts`, with the functions of ``heads``, if any."""
    if heads is not None:
        _check("load", heads)
    loaded = {
        name: _head(path, name, header, arrays_of(arrays, name), getattr(heads, name, None))
        for name in HEADS
    }
    loaded |= {
        name: Moments(*numbers) if (numbers := arrays_of(arrays, name)) else None
        for name in MOMENTS
    }
    return Heads(**loaded, levels=header["levels"])


def _check(caller, heads):
    if not isinstance(heads, Heads):
        raise ValueError(
            f"{caller}: heads must be jast.heads.Heads, received {type(heads).__name__}"
        )
    if heads.policy is None and heads.value is None:
        raise ValueError(
            f"{caller}: heads must have a policy or a value head, received Heads(None, None)"
        )
    for name in HEADS:
        head = getattr(heads, name)
        if head is not None and not isinstance(head, Head):
            raise ValueError(
                f"{caller}: the {name} head must be a pair (params, apply), received"
                f" {type(head).__name__}"
            )


def _storable(leaf):
    array = isinstance(leaf, np.ndarray | np.generic | jax.Array) and not is_traced(leaf)
    return array and (leaf.dtype == bool or jnp.issubdtype(leaf.dtype, np.number))


def _readable(leaf):
    if not hasattr(leaf, "dtype") or not hasattr(leaf, "shape"):
        return f"{type(leaf).__name__} {leaf!r}"
    return f"{leaf.dtype}{list(leaf.shape)}" + ", traced" * is_traced(leaf)


def _specification(head):
    """What `make_head` needs to make this network again, as JSON has it; None for a function of
    another kind, or parameters that are not its own.
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
    made = jax.tree.structure(like) == jax.tree.structure(head.params) and shapes == [
        leaf.shape for leaf in jax.tree.leaves(like)
    ]
    return network if made else None


def _made(network):
    """The `Head` of a specification, with the shapes of its parameters in their place."""
    init, apply = dense(
        tuple(network["hidden"]),
        tuple(network["outputs"]),
        network["activation"],
        network["first_activation"],
    )
    return Head(
        jax.eval_shape(
            lambda: init(jax.random.key(0), jnp.zeros((network["inputs"],), jnp.float32))
        ),
        apply,
    )


def _head(path, name, header, leaves, given):
    """One head of a file, None where it has none. ``given``: the head of `load`'s ``heads``, or
    None.
    """
    about = header["heads"].get(name)
    if about is None:
        if given is not None:
            raise ValueError(
                f"load: {path} does not fit heads: it holds no {name} head, expected one"
            )
        return None
    network, structure = about["network"], about["structure"]
    if given is not None:
        expected = _specification(given)
        if None not in (network, expected) and network != expected:
            raise ValueError(
                f"load: {path} does not fit heads: {name} is the network {network}, expected"
                f" {expected}"
            )
    elif network is None:
        raise ValueError(
            f"load: {path} holds a {name} head with a function that is not in the file: load(path,"
            " heads) with Heads that have it"
        )
    elif network["activation"] not in ACTIVATIONS:
        raise ValueError(
            f"load: {path} has the activation {network['activation']!r}, which this jast does not"
            f" know: use the jast that wrote the file, {header.get('package')}"
        )
    like, apply = _made(network) if given is None else given
    other = "its network" if given is None else "heads"
    check_structure(path, other, f"{name}.params", structure, like)
    for a, (at, s) in zip(leaves, jax.tree_util.tree_leaves_with_path(like), strict=True):
        if not hasattr(s, "shape") or not hasattr(s, "dtype"):
            raise ValueError(
                f"load: {name}.params{jax.tree_util.keystr(at)} of heads must be an array of"
                f" numbers, received {_readable(s)}"
            )
        check_array(path, other, f"{name}.params{jax.tree_util.keystr(at)}", a, s)
    return Head(jax.tree.structure(like).unflatten(leaves), apply)
