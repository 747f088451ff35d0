"""A callback to the host that hands over NumPy arrays, as XLA gives them.

`jax.pure_callback` makes JAX arrays of the arguments first. To read those in the callback can wait
for a thread of XLA's, and where all of them are inside of callbacks that is for ever
(https://github.com/jax-ml/jax/issues/24255). Otherwise this is the same, with
``vmap_method="expand_dims"``.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

__all__ = ["ask"]


def ask(callback, shapes, *args):
    """``callback(*args)``, arrays in NumPy, a tuple of arrays of ``shapes``
    (`jax.ShapeDtypeStruct`). One call under any number of `jax.vmap`.

    Batched arguments have leading axes, and so must have the answers; an argument that a `jax.vmap`
    does not batch has an axis of 1 there. ``callback`` is known by its identity, must always answer
    the same, and may be left out where nobody needs its answer. No derivatives.
    """
    return tuple(
        _ask.bind(
            *map(jnp.asarray, args),
            callback=callback,
            shapes=tuple((s.shape, np.dtype(s.dtype)) for s in shapes),
        )
    )


_ask = Primitive("jast_ask")
_ask.multiple_results = True


@_ask.def_impl
def _outside_of_programs(*args, callback, shapes):
    return [jnp.asarray(a) for a in callback(*map(np.asarray, args))]


@_ask.def_abstract_eval
def _shapes(*args, callback, shapes):
    return [ShapedArray(*s) for s in shapes]


def _batched(args, axes, *, callback, shapes):
    (n,) = {a.shape[i] for a, i in zip(args, axes) if i is not None}
    args = [a[None] if i is None else jnp.moveaxis(a, i, 0) for a, i in zip(args, axes)]
    shapes = tuple(((n, *shape), dtype) for shape, dtype in shapes)
    return _ask.bind(*args, callback=callback, shapes=shapes), [0] * len(shapes)


def _lowered(ctx, *args, callback, shapes):
    # of arrays over several devices, JAX says who calls
    if getattr(ctx.module_context.axis_context, "num_devices", 1) > 1:
        structs = [jax.ShapeDtypeStruct(*s) for s in shapes]
        return mlir.lower_fun(
            lambda *a: jax.pure_callback(callback, structs, *a), multiple_results=True
        )(ctx, *args)
    out, _, _ = mlir.emit_python_callback(
        ctx,
        callback,
        None,
        list(args),
        ctx.avals_in,
        ctx.avals_out,
        has_side_effect=False,
        returns_token=False,
    )
    return out


batching.primitive_batchers[_ask] = _batched
# each call of a program has its own number on the host
mlir.register_lowering(_ask, _lowered, cacheable=False)
