"""jast._src.runtime._jax: what the package needs of JAX beyond its stable API. One test a piece, so
that on another version of JAX the one that fails names what moved.
"""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import jast
from jast._src.runtime._jax import (
    _REFUSED,
    _compiled,
    custom_vmap,
    define_prng_impl,
    host_call,
    is_traced,
    is_tracing,
    was_interrupted,
    without_stops,
)

FRAGILE = (
    "jax._src",
    "jax.core",
    "jax.custom_batching",
    "jax.experimental",
    "jax.extend",
    "jax.interpreters",
)


def touched(path):
    """The dotted names below ``jax`` that a source file imports or reads."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [node.module or ""]
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Attribute):
            names += [ast.unparse(node)]
    return {f for f in FRAGILE for name in names if name == f or name.startswith(f + ".")}


def test_one_module_alone_touches_what_may_move():
    package = Path(jast.__file__).parent
    users = {str(p.relative_to(package)) for p in package.rglob("*.py") if touched(p)}
    assert users == {"_src/runtime/_jax.py"}


def test_what_is_traced():
    assert not is_traced(1.0, jnp.ones(2), None, {"a": "text"}) and not is_tracing()
    seen = []

    @jax.jit
    def program(x):
        seen.append((is_traced(x), is_traced({"a": [1.0, x]}), is_traced(1.0), is_tracing()))
        return x

    program(1.0)
    assert seen == [(True, True, False, True)]
    lanes = []
    jax.vmap(lambda x: lanes.append((is_traced(x), is_tracing())))(jnp.ones(2))
    assert lanes == [(True, False)]  # constants have values there


def doubled(log):
    """A callback that notes what it is given, and the shapes of its answers."""

    def callback(a, b):
        log.append((type(a), type(b), a.shape, b.shape))
        return 2 * a + b, (2 * a + b) > 0

    return callback, (
        jax.ShapeDtypeStruct((), jnp.zeros(()).dtype),
        jax.ShapeDtypeStruct((), bool),
    )


def test_the_host_is_called_once_for_any_number_of_vmaps():
    callback, shapes = doubled(log := [])
    one = lambda a, b: host_call(callback, shapes, a, b)
    a, b = jnp.arange(-1.0, 2.0), jnp.arange(2.0)
    for alone in (one, jax.jit(one)):
        assert [float(v) for v in alone(a[0], b[1])] == [-1, 0]
    log.clear()
    all_pairs = jax.vmap(jax.vmap(one, (None, 0)), (0, None))
    for program in (all_pairs, jax.jit(all_pairs)):
        number, flag = program(a, b)
        np.testing.assert_array_equal(number, 2 * np.asarray(a)[:, None] + np.asarray(b))
        np.testing.assert_array_equal(flag, number > 0)
    assert log == [(np.ndarray, np.ndarray, (3, 1), (1, 2))] * 2


def test_each_call_of_a_program_has_its_own_callback():
    shapes = (jax.ShapeDtypeStruct((), jnp.zeros(()).dtype),)
    add = lambda n: lambda a: (a + np.asarray(n, a.dtype),)
    first, second = add(1), add(10)
    program = jax.jit(lambda x: host_call(second, shapes, *host_call(first, shapes, x)))
    assert program(jnp.zeros(()))[0] == 11


def test_an_answer_of_another_shape_is_an_error():
    shapes = (jax.ShapeDtypeStruct((3,), jnp.zeros(()).dtype),)
    program = jax.jit(lambda x: host_call(lambda a: (a,), shapes, x))
    with pytest.raises(Exception, match="(?i)shape"):
        jax.block_until_ready(program(jnp.zeros(2)))


def test_an_interruption_that_met_a_callback_is_one():
    def callback(a):
        raise KeyboardInterrupt

    shapes = (jax.ShapeDtypeStruct((), jnp.zeros(()).dtype),)
    program = jax.jit(lambda x: host_call(callback, shapes, x))
    with pytest.raises((KeyboardInterrupt, jax.errors.JaxRuntimeError)) as met:
        jax.block_until_ready(program(jnp.zeros(())))
    assert was_interrupted(met.value) and was_interrupted(KeyboardInterrupt())
    assert not was_interrupted(jax.errors.JaxRuntimeError("INTERNAL: RuntimeError: no"))
    assert not was_interrupted(ValueError("KeyboardInterrupt"))


def test_the_host_is_called_for_arrays_over_several_devices():
    callback, shapes = doubled([])
    over = NamedSharding(Mesh(np.array(jax.devices()[:2]), ("i",)), PartitionSpec("i"))
    a = jax.device_put(jnp.arange(4.0), over)
    program = jax.jit(jax.vmap(lambda a: host_call(callback, shapes, a, jnp.ones(()))))
    np.testing.assert_array_equal(program(a)[0], 2 * np.arange(4.0) + 1)


def test_a_function_that_says_what_a_batch_of_it_is():
    sizes = []
    total = custom_vmap(lambda x, y: x + y)

    @total.def_vmap
    def rule(size, batched, x, y):
        sizes.append((size, batched))
        return x * 100 + y, True

    np.testing.assert_array_equal(
        jax.jit(jax.vmap(total, (0, None)))(jnp.arange(3.0), jnp.ones(())), [1, 101, 201]
    )
    assert sizes == [(3, [True, False])] and total(1.0, 2.0) == 3


def test_a_key_implementation():
    fold = lambda key, data: key * jnp.uint32(31) + jnp.asarray(data).astype(jnp.uint32)
    bits = lambda key, width, shape: (
        key[0] + jnp.arange(int(np.prod(shape)), dtype=jnp.uint32).reshape(shape)
    ).astype(f"uint{width}")
    split = lambda key, shape: jnp.stack([fold(key, i) for i in range(int(np.prod(shape)))])
    implementation = define_prng_impl(
        key_shape=(1,),
        seed=lambda seed: jnp.asarray(seed).astype(jnp.uint32)[None],
        split=lambda key, shape: split(key, shape).reshape(*shape, 1),
        random_bits=bits,
        fold_in=fold,
        name="jast_test",
        tag="tst",
    )
    key = jax.random.key(5, impl=implementation)
    draw = lambda key: jax.random.bits(jax.random.fold_in(key, 2), (3,), jnp.uint32)
    assert draw(key).tolist() == jax.jit(draw)(key).tolist() == [157, 158, 159]
    keys = jax.random.wrap_key_data(jnp.array([[5], [6]], jnp.uint32), impl=implementation)
    assert jax.vmap(draw)(keys).tolist() == [[157, 158, 159], [188, 189, 190]]
    assert jax.random.key_data(jax.random.split(key, 2)).tolist() == [[155], [156]]


def test_derivatives_go_through_stops():
    """x ** 2 * 3 a, stopped in a program, a loop, a branch and at the end: the same numbers, and
    the slope 6 a x in place of 0. Keys and numbers of Python go through.
    """
    stop = jax.lax.stop_gradient
    square = jax.jit(lambda x: stop(x) ** 2)

    def stopped(state, a):
        y = square(state["x"]) * a
        y = jax.lax.scan(lambda y, z: (stop(y) * z, None), y, jnp.array([1.5, 2.0]))[0]
        y = jax.lax.cond(a > 0.0, lambda y: stop(y), lambda y: 2.0 * y, y)
        return {"x": stop(y), "key": jax.random.split(state["key"])[0], "time": 3}

    start = {"x": jnp.array(2.0), "key": jax.random.key(0)}
    before, after = stopped(start, 5.0), without_stops(stopped)(start, 5.0)
    assert before["x"] == after["x"] == 60.0 and after["time"] == 3
    assert (jax.random.key_data(before["key"]) == jax.random.key_data(after["key"])).all()
    for function, slope in ((stopped, 0.0), (without_stops(stopped), 60.0)):
        of_x = lambda x, f=function: f(start | {"x": x}, 5.0)["x"]
        np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(of_x)))(jnp.full(3, 2.0)), slope)


def test_an_option_that_the_compiler_does_not_know_is_left_out():
    """Another version of XLA knows other options: the program is compiled without."""
    options = {"xla_no_such_option_of_any_version": True, "xla_backend_optimization_level": "0"}
    double = _compiled(lambda x: 2 * x, lambda: True, options, {})
    assert double(np.float32(3)) == 6
    assert "xla_no_such_option_of_any_version" in _REFUSED
    assert "xla_backend_optimization_level" not in _REFUSED


def test_an_error_of_the_program_stays():
    """It names no option."""

    def fail(x):
        raise RuntimeError("of the host")

    program = _compiled(
        lambda x: jax.pure_callback(fail, jax.ShapeDtypeStruct((), np.float32), x),
        lambda: True,
        {"xla_backend_optimization_level": "0"},
        {},
    )
    with pytest.raises(jax.errors.JaxRuntimeError, match="of the host"):
        jax.block_until_ready(program(np.float32(1)))
