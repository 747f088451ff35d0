"""What jast needs of JAX beyond its stable API, in one place: a new version of JAX that moves any
of it is followed here, and ``tests/test_jax_shim.py`` says which part broke.

 - `is_traced`, `is_tracing`: whether values are known yet (`jax.core.Tracer`);
 - `quick`, `jit`, `briefly`: options of the compiler by how long programs run
   (`compiler_options`);
 - `was_interrupted`: whether an error was Ctrl-C (how a callback's error comes out);
 - `host_call`: NumPy on the host inside of compiled programs (a primitive with lowerings of its
   own, `jax.interpreters`);
 - `custom_vmap`: a function that says itself what a batch of it is (`jax.custom_batching`);
 - `define_prng_impl`: a key implementation (`jax.extend.random`);
 - `without_stops`: a function whose derivatives no `jax.lax.stop_gradient` stops (equations of a
   jaxpr, `jax.extend.core`);
 - `reset_cache`: what makes a new folder of compiled programs count
   (`jax.experimental.compilation_cache`).

Nothing else in the package imports `jax.core`, `jax.extend`, `jax.interpreters`,
`jax.custom_batching`, `jax.experimental` or `jax._src`.
"""

import contextlib
import contextvars
import functools
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.custom_batching import custom_vmap
from jax.interpreters import batching, mlir

from jast._src.runtime.device import on_cpu

__all__ = [
    "briefly",
    "custom_vmap",
    "define_prng_impl",
    "host_call",
    "is_brief",
    "is_traced",
    "is_tracing",
    "jit",
    "quick",
    "reset_cache",
    "was_interrupted",
    "without_stops",
]


def is_traced(*trees: Any) -> bool:
    """Whether a leaf of ``trees`` has no value yet, as under `jax.jit`, `jax.vmap` or
    `jax.grad`.
    """
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def is_tracing() -> bool:
    """Whether this runs inside of a `jax.jit` (or of what traces alike), where even constants have
    no value.
    """
    return isinstance(jnp.zeros(()) + 0, Tracer)


# What a program of 128 episodes takes, as JAX compiles it, briefly, and quickly: to compile
#   car .19, .10, .04 CPU s; gymnax CartPole .59, .29, .11; brax inverted pendulum 7.4, 4.5, 1.9
# and to run, microseconds an episode
#   car .5, .7, 1.6; gymnax CartPole 8.3, 9.8, 35; brax inverted pendulum 255, 281, 1656.
_BRIEFLY = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
_QUICKLY = _BRIEFLY | {"xla_backend_optimization_level": "0"}
_REFUSED: set[str] = set()
"""Options that this version of XLA does not know: that of JAX 0.11 has no fusion emitters to turn
off."""
_BRIEF = contextvars.ContextVar("brief", default=False)


@contextlib.contextmanager
def briefly(brief: bool) -> Iterator[None]:
    """A context in which programs of `jit` are compiled in some three fifths of the time, and run a
    tenth to a third slower: that pays below some hundred thousand episodes.
    """
    token = _BRIEF.set(brief)
    try:
        yield
    finally:
        _BRIEF.reset(token)


def is_brief() -> bool:
    """Whether this runs in a context of `briefly`."""
    return _BRIEF.get()


def jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit` for what simulates episodes, as many as a user pays for: compiled by `briefly`."""
    # flags for all programs may have said so already
    told = "xla_cpu_use_fusion_emitters" in os.environ.get("XLA_FLAGS", "")
    return _compiled(function, lambda: _BRIEF.get() and not told, _BRIEFLY, options)


def quick(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit` for a program that runs a few episodes: compiled without optimisation, in a
    fraction of the time, and slower.
    """
    return _compiled(function, lambda: True, _QUICKLY, options)


def _compiled(function, wanted, how, options):
    """`jax.jit` with the compiler's options ``how``, on a CPU, where they are ``wanted()``."""
    whole = jax.jit(function, **options)

    @functools.cache
    def jitted(known):
        return jax.jit(function, compiler_options=dict(known) or None, **options)

    def run(*args, **kwargs):
        try:
            return call(*args, **kwargs)
        except Exception as error:
            if was_interrupted(error):
                raise KeyboardInterrupt from error
            raise

    def call(*args, **kwargs):
        # inside of another program there are no options of its own
        if not wanted() or is_tracing() or is_traced(args, kwargs):
            return whole(*args, **kwargs)
        while True:
            known = tuple(p for p in how.items() if p[0] not in _REFUSED) if on_cpu() else ()
            try:
                return jitted(known)(*args, **kwargs)
            except jax.errors.JaxRuntimeError as error:
                refused = {k for k, _ in known if k in str(error)}
                if not refused:
                    raise
                _REFUSED.update(refused)

    run.eval_shape, run.lower = whole.eval_shape, whole.lower
    return functools.wraps(function)(run)


def define_prng_impl(**parts: Any) -> Any:
    """A key implementation of its ``parts``, as `jax.extend.random.define_prng_impl` takes them."""
    from jax.extend.random import define_prng_impl  # here: jax.extend loads Pallas

    return define_prng_impl(**parts)


def reset_cache() -> None:
    """Have JAX look anew at its options of the persistent compilation cache, which it reads once,
    before it compiles anything.
    """
    from jax.experimental.compilation_cache.compilation_cache import reset_cache  # seldom needed

    reset_cache()


def was_interrupted(error: BaseException) -> bool:
    """Whether ``error`` is a KeyboardInterrupt, or what JAX makes of one that met a callback."""
    # a compiled call raises a ValueError, later uses of its values a JaxRuntimeError
    of_jax = isinstance(error, jax.errors.JaxRuntimeError)
    of_jax |= isinstance(error, ValueError) and "Callback" in str(error)
    return isinstance(error, KeyboardInterrupt) or of_jax and "KeyboardInterrupt" in str(error)


def host_call(
    callback: Callable[..., Sequence[np.ndarray]],
    shapes: Sequence[jax.ShapeDtypeStruct],
    *args: Any,
) -> tuple[jax.Array, ...]:
    """``callback(*args)`` on the host, with NumPy arrays as XLA gives them. One call under any
    number of `jax.vmap`. No derivatives.

    `jax.pure_callback` makes JAX arrays of the arguments first. Reading those in the callback may
    block on an XLA thread; if every thread is inside a callback, this deadlocks
    (https://github.com/jax-ml/jax/issues/24255). Otherwise this is the same, with
    ``vmap_method="expand_dims"``.

    Args:
        callback: arrays -> a tuple of arrays of ``shapes``. Under `jax.vmap` its arguments have
            leading axes, and so must have its answers; an argument that a `jax.vmap` does not
            batch has an axis of 1 there. It is known by its identity, must always answer the same,
            and may be left out where nobody needs its answer.
        shapes: of the answers, without batch axes.
        args: arrays or numbers.
    """
    told = tuple((s.shape, np.dtype(s.dtype)) for s in shapes)
    return tuple(_host_call().bind(*map(jnp.asarray, args), callback=callback, shapes=told))


@functools.cache
def _host_call() -> Any:
    """The primitive, with what JAX asks of one."""
    from jax.extend.core import Primitive  # here: jax.extend loads Pallas

    primitive = Primitive("jast_host_call")
    primitive.multiple_results = True
    primitive.def_impl(_outside_of_programs)
    primitive.def_abstract_eval(_shapes)
    batching.primitive_batchers[primitive] = _batched
    # each call of a program has its own number on the host
    mlir.register_lowering(primitive, _lowered, cacheable=False)
    return primitive


def _outside_of_programs(*args, callback, shapes):
    return [jnp.asarray(a) for a in callback(*map(np.asarray, args))]


def _shapes(*args, callback, shapes):
    return [ShapedArray(*s) for s in shapes]


def _batched(args, axes, *, callback, shapes):
    (n,) = {a.shape[i] for a, i in zip(args, axes) if i is not None}
    args = [a[None] if i is None else jnp.moveaxis(a, i, 0) for a, i in zip(args, axes)]
    shapes = tuple(((n, *shape), dtype) for shape, dtype in shapes)
    return _host_call().bind(*args, callback=callback, shapes=shapes), [0] * len(shapes)


# an argument of JAX 0.8.2 and later; of effect on a TPU only
_KNOWN = inspect.signature(mlir.emit_python_callback).parameters
_NO_TOKEN = {"returns_token": False} if "returns_token" in _KNOWN else {}


def _lowered(ctx, *args, callback, shapes):
    # of arrays over several devices, JAX says who calls
    if getattr(ctx.module_context.axis_context, "num_devices", 1) > 1:
        structs = [jax.ShapeDtypeStruct(*s) for s in shapes]
        return mlir.lower_fun(
            lambda *a: jax.pure_callback(callback, structs, *a), multiple_results=True
        )(ctx, *args)
    given = ctx, callback, None, list(args), ctx.avals_in, ctx.avals_out
    out, _, _ = mlir.emit_python_callback(*given, has_side_effect=False, **_NO_TOKEN)
    return out


def without_stops(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` of pytrees of arrays, with derivatives that go through what it wraps in
    `jax.lax.stop_gradient`.
    """
    from jax.extend.core import jaxpr_as_fun  # here: jax.extend loads Pallas

    @functools.wraps(function)
    def through(*args: Any) -> Any:
        traced, out = jax.make_jaxpr(function, return_shape=True)(*args)
        values = jaxpr_as_fun(_unstopped(traced))(*map(jnp.asarray, jax.tree.leaves(args)))
        return jax.tree.unflatten(jax.tree.structure(out), values)

    return through


def _unstopped(closed: Any) -> Any:
    """A closed jaxpr without its equations of ``stop_gradient``, nor those inside of its loops."""

    def inner(value: Any) -> Any:
        if type(value) is tuple:  # of branches
            return tuple(map(inner, value))
        return _unstopped(value) if isinstance(value, type(closed)) else value

    same, equations = {}, []

    def seen(variable: Any) -> Any:
        # literals, which have a value and no hash, stay
        return variable if hasattr(variable, "val") else same.get(variable, variable)

    for equation in closed.jaxpr.eqns:
        given = [seen(v) for v in equation.invars]
        if equation.primitive.name == "stop_gradient":
            same.update(zip(equation.outvars, given, strict=True))
        else:
            params = {name: inner(value) for name, value in equation.params.items()}
            equations.append(equation.replace(invars=given, params=params))
    outvars = [seen(v) for v in closed.jaxpr.outvars]
    return closed.replace(jaxpr=closed.jaxpr.replace(eqns=equations, outvars=outvars))
