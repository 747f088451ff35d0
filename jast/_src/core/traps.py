"""Traps: systems whose functions fit together, and whose failures are lost all the same."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero

from jast import distributions as D
from jast._src.core.contract import leaf_path
from jast._src.core.float_resolution import describe
from jast._src.core.probe import Resolution
from jast._src.core.signature import per_simulator, signature_of
from jast._src.core.simulator import Simulator, first_state, next_state
from jast._src.util.pytrees import Key

__all__ = ["traps"]

EQUATIONS = 3000
"""Of a step and evaluate, from which on they take minutes to compile. On two shared cores one
program of 50 steps compiles in 4 to 14 CPU seconds for 3200 to 7000 of them (brax, mjx, two cars of
ARCH-COMP), one with its gradient in 22 and 51 for 3200; `jast.stress` then compiles for 190 and 275
seconds (an inverted pendulum of brax, the cars), for 63 with 700 (a transmission of ARCH-COMP).
"""
CALLS = {"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat2", "checkpoint"}
"""Primitives whose inputs and outputs are those of the program in them, as JAX names them."""


def traps(sim: Simulator, seen: Resolution) -> list[str]:
    """What loses failures, or minutes, of a simulator that keeps its contract, not on the host, by
    what a probe has ``seen``: a text each, which names the function at fault.
    """
    signature, (equations, level, keys) = signature_of(sim), _program(sim)
    found = [f"step: {text}" for text in (describe(sim, seen), _jumps(seen)) if text is not None]
    if seen.ended:
        found.append(
            "is_terminal: holds at the start of every episode, which ends there, before any step;"
            " it must be False while an episode goes on"
        )
    found += _fixed_keys(signature.state, seen, keys)
    if seen.distance_differs and level:
        found.append(
            "step: the miss distance depends on the disturbance, and its gradient is 0 everywhere:"
            " all ways from one to the other pass through jax.lax.stop_gradient, comparisons or"
            " whole numbers, so that what follows gradients finds nothing; let them through (of a"
            " gymnax environment: env.with_transition_gradients())"
        )
    if equations > EQUATIONS:
        found.append(
            f"step: {equations:,} operations of JAX take minutes to compile, in the programs"
            " of a search or an estimate together; jast.cache() keeps these for the next process,"
            " and a lax.scan in place of a loop of Python makes fewer"
        )
    return found


def _jumps(seen: Resolution) -> str | None:
    if not seen.jump:
        return None
    return (
        f"the state jumps back to its start, as that of an environment which resets itself does, at"
        f" step {seen.jump} of one of 16 episodes: evaluate never sees the failure before; use"
        " the step that does not reset (of gymnax step_env, of brax an environment without"
        " AutoResetWrapper)"
    )


def _is_ours(leaf: Any) -> bool:
    """Whether it is a key of `jast.adapters`, whose user says what is random."""
    return isinstance(leaf, Key)


def _fixed_keys(state: Any, seen: Resolution, keys: tuple[bool, ...]) -> Iterator[str]:
    """A text for each of the leaves that are ``keys`` and that no disturbance reaches."""
    leaves = jax.tree_util.tree_leaves_with_path(state, is_leaf=_is_ours)
    for (path, leaf), key, still in zip(leaves, keys, seen.unmoved, strict=True):
        if key and still and not _is_ours(leaf):
            yield (
                f"init: state leaf {leaf_path(path)} looks like a random key that no disturbance"
                " reaches: the simulator's own noise is the same in every episode. Draw this noise"
                " in disturbance, or make the seed a disturbance (jast.distributions.seeds) and"
                " fold it into the key (jax.random.fold_in)"
            )


@per_simulator
def _program(
    sim: Simulator, start: Any, state: Any, dist: Any
) -> tuple[int, bool, tuple[bool, ...]]:
    """How many equations step and evaluate have; whether `jax.lax.stop_gradient` is among them and
    leaves no slope; which leaves of the state they make random keys of.
    """
    x = D.sample(dist, jax.random.key(0))
    program = jax.make_jaxpr(lambda s, x: (sim.evaluate(s), next_state(sim, s, x)))(state, x).jaxpr
    names = [equation.primitive.name for equation in _equations(program)]
    level = "stop_gradient" in names and _level(sim)
    leaves = jax.tree.leaves(state)
    words = [a.dtype == jnp.uint32 and a.shape[-1:] in ((2,), (4,)) for a in leaves]
    inputs = range(len(program.invars))
    keys = (w and _makes_keys(program, [i == at for i in inputs])[0] for at, w in enumerate(words))
    return len(names), level, tuple(keys)


def _makes_keys(program: Any, given: list[bool]) -> tuple[bool, list[bool]]:
    """Whether a jaxpr wraps, as the words of a random key, what depends on the inputs that are
    ``given``; and which outputs depend on them.
    """
    known = {variable for variable, it in zip(program.invars, given, strict=True) if it}
    found = False
    for equation in program.eqns:
        inputs = [_among(v, known) for v in equation.invars]
        if not any(inputs):
            continue
        found |= equation.primitive.name == "random_wrap"
        outputs = [True] * len(equation.outvars)
        for inner in _programs(equation):
            # of a loop or a branch, what steers it comes first
            reached = inputs[len(inputs) - len(inner.invars) :]
            inside, after = _makes_keys(inner, reached)
            found |= inside
            # what a loop carries may reach any of its outputs
            outputs = after if equation.primitive.name in CALLS else outputs
        known |= {v for v, it in zip(equation.outvars, outputs, strict=True) if it}
    return found, [_among(v, known) for v in program.outvars]


def _among(variable: Any, known: set[Any]) -> bool:
    """Whether a variable of a jaxpr is ``known``; a number written there is none."""
    return not hasattr(variable, "val") and variable in known


def _equations(program: Any) -> Iterator[Any]:
    """Those of a jaxpr and of all in it; the body of a loop once."""
    for equation in program.eqns:
        yield equation
        for inner in _programs(equation):
            yield from _equations(inner)


def _programs(equation: Any) -> Iterator[Any]:
    """The jaxprs in an equation."""
    for value in equation.params.values():
        for inner in value if isinstance(value, tuple | list) else (value,):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield inner


def _level(sim: Simulator) -> bool:
    """Whether the rules of derivatives alone say that the slopes of the miss distance by the floats
    of the disturbances are 0. Nothing is run or compiled; False where there are no such rules.
    """
    leaves, tree = jax.tree.flatten(signature_of(sim).x)
    smooth = [i for i, a in enumerate(leaves) if jnp.issubdtype(a.dtype, jnp.floating)]
    found = []

    @jax.custom_jvp
    def heard(distance):
        return distance

    @partial(heard.defjvp, symbolic_zeros=True)
    def _(distance, slope):
        found.append(isinstance(slope[0], SymbolicZero))
        return distance[0], jnp.zeros_like(distance[0])

    def last(floats):
        numbers = [jnp.zeros(a.shape, a.dtype) for a in leaves]
        for i, number in zip(smooth, floats, strict=True):
            numbers[i] = number
        x = jax.tree.unflatten(tree, numbers)
        state = first_state(sim, D.sample(sim.start(), jax.random.key(0)))
        # a loop follows what needs several steps to reach the distance
        state, _ = lax.scan(lambda s, _: (next_state(sim, s, x), None), state, length=sim.horizon)
        return heard(sim.evaluate(state)[1])

    floats = [leaves[i] for i in smooth]
    try:
        jax.eval_shape(lambda a: jax.jvp(last, (a,), (a,)), floats)
    except Exception:  # of a user's function: what has no derivative is told by who needs it
        return False
    return bool(smooth) and all(found)
