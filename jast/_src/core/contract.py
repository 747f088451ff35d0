"""The contract of a simulator, traced: structure, shapes and dtypes of what its functions return,
said in terms of the function that does not fit. Cheap, and possible while the simulator holds
tracers, so searches call `contract` as they are traced.
"""

from __future__ import annotations

import operator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core.actions import Quantiles, Samples, UniformBox, Wide
from jast._src.core.simulator import require_simulator
from jast._src.runtime.memory import release

__all__ = [
    "ACTIONS",
    "OBSERVED",
    "action_name",
    "arrays",
    "called",
    "contract",
    "first_line",
    "leaf_path",
]

OBSERVED = 64  # numbers that ``observe`` may return at most to what looks at them, as networks do
ARRAYS = (jax.Array, np.ndarray, np.generic, bool, int, float)
LOOKS = {"disturbance", "evaluate", "is_terminal", "observe"}  # at a state that goes on
HINTS = {
    "TracerBoolConversionError": (
        " An if, and, or, not, min or max on a value of the state or the disturbance does not work:"
        " write jnp.where(condition, this, that)"
    ),
    "TracerArrayConversionError": " Use jax.numpy in place of numpy",
    "ConcretizationTypeError": " Use jax.numpy in place of float, int and math",
}
NO_START = ". Its argument is (), as start is not given: start=lambda: Normal(0.0, 1.0) draws one"
KEY = (
    ". Noise from a key in the state is the same in every episode: draw it in disturbance or start,"
    " which may also be the seed of a key (jast.distributions.seeds). To keep the key all the same,"
    " hold jax.random.key_data(key) in the state, and use jax.random.wrap_key_data of it"
)
ACTIONS = {
    Samples: "actions.samples",
    Quantiles: "actions.quantiles",
    UniformBox: "actions.uniform",
    Wide: "actions.wide",
}


def contract(function, sim, actions=None, observed=0):
    """The traced half of `check`: structure, shapes and dtypes of what the functions return;
    returns ``sim``, also under jit and vmap.

    ``function`` is what the user called, and ``observed`` the most numbers of an observation that
    it can use: 0 leaves out ``observe``, for what looks at none. Raises ValueError naming the
    function at fault, in the order start, init, disturbance, evaluate, is_terminal, observe, step,
    actions.
    """
    require_simulator(function, sim)
    for name in ("start", "init", "disturbance", "evaluate", "is_terminal", "observe", "step"):
        if not callable(getattr(sim, name)):
            raise ValueError(f"{name}: expected a function, received {getattr(sim, name)!r}")
    release()  # here, as whatever compiles much for a simulator comes by first
    kept, wide = vars(sim).setdefault("_contracts", set()), jax.config.jax_enable_x64
    if actions is not None or (wide, observed) not in kept:
        jax.eval_shape(lambda: _trace(function, sim, actions, observed))
        kept |= {(wide, observed), (wide, 0)}  # who looks at no observation asks for less
    return sim


def _trace(function, sim, actions, observed):
    start = called("start", sim.start)
    x0 = _draw("start", start)
    state = arrays("init", called("init", sim.init, x0))
    hint = _hint_of_integers(state)
    dist = called("disturbance", sim.disturbance, state)
    x = _draw("disturbance", dist)
    pair = called("evaluate", sim.evaluate, state)
    if not isinstance(pair, tuple | list) or len(pair) not in (2, 3):
        raise ValueError(
            "evaluate: expected a pair (event, distance), or (event, distance, log p), received"
            f" {_kind(pair)}"
        )
    _scalar("evaluate: event", pair[0], bool)
    _scalar("evaluate: distance", pair[1], float, hint)
    for told in pair[2:]:
        _scalar("evaluate: log p", told, float)
    _scalar("is_terminal", called("is_terminal", sim.is_terminal, state), bool)
    if observed:
        seen = called("observe", sim.observe, state)
        vector = isinstance(seen, ARRAYS) and jnp.ndim(seen) == 1
        if not (vector and jnp.issubdtype(jnp.result_type(seen), jnp.floating)):
            raise ValueError(f"observe: returns {_kind(seen)}, expected a float vector")
        if jnp.size(seen) > observed:
            raise ValueError(
                f"observe: returns {jnp.size(seen)} numbers, of which {function} takes at most"
                f" {observed}; pass the simulator observe=, a function state -> float vector of"
                " those that matter"
            )
    _same("step: state", arrays("step", called("step", sim.step, state, x)), state, hint)
    if actions is not None:
        name = action_name(actions)
        if not callable(getattr(actions, "draw", None)):
            raise ValueError(f"actions: expected one of jast.actions, received {actions!r}")
        if isinstance(actions, UniformBox):
            _box(actions, x)
        _same(f"{name}: disturbance", called(name, actions.draw, jax.random.key(0), dist), x)
        if jax.tree.leaves(x0):
            _same(f"{name}: x0", called(name, actions.draw_start, jax.random.key(0), start), x0)


def called(name, function, *args):
    # containers of its own: what a step does to these is its own affair
    given = jax.tree.map(lambda a: a, args)
    before = jax.tree.leaves(given)
    looks = name in LOOKS and not _differ(before, given)  # a class may make its leaves anew
    try:
        found = function(*given)
    except Exception as e:
        from jast._src.blackbox.readings import line_of

        kind = type(e).__name__
        hint = HINTS.get(kind, NO_START if name == "init" and args == ((),) else "")
        where = line_of(e) or _line_of_definition(function)
        raise ValueError(f"{name}: raised {kind}{where}: {first_line(e)}{hint}") from e
    if looks and _differ(before, given):
        raise ValueError(
            f"{name}: changes the state that it is given, which others look at, too: it must leave"
            " it as it is, and make a new one, such as {**state, 'speed': 0.0}, where it needs one"
        )
    if found is None and name in ("init", "step"):
        raise ValueError(f"{name}: returned None: is a return missing?")
    return found


def _line_of_definition(function):
    """ " (system.py:12)", of a user's function that was not entered; "" where that is unknown."""
    while isinstance(function, partial):
        function = function.func
    code = getattr(function, "__code__", None)
    if code is None or function.__module__.startswith("jast."):
        return ""
    return f" ({Path(code.co_filename).name}:{code.co_firstlineno})"


def _differ(before, tree):
    """Whether the leaves of ``tree`` are other objects than ``before``."""
    after = jax.tree.leaves(tree)
    return len(after) != len(before) or any(map(operator.is_not, before, after))


def _draw(name, dist):
    """One traced value of ``dist``, which must be a distribution with a scalar log density."""
    if not (callable(getattr(dist, "sample", None)) and callable(getattr(dist, "log_prob", None))):
        hint = "; combine several independent ones with jast.distributions.Joint"
        raise ValueError(
            f"{name}: expected a distribution (with sample and log_prob), received"
            f" {_kind(dist)}{hint if isinstance(dist, dict | list | tuple) else ''}"
        )
    of_sample = f"{name}: sample"
    x = arrays(of_sample, called(of_sample, lambda: D.sample(dist, jax.random.key(0))))
    log_p = called(f"{name}: log_prob", dist.log_prob, x)
    if isinstance(log_p, ARRAYS) and jnp.shape(log_p):
        shape = jnp.shape(log_p)
        raise ValueError(
            f"{name}: log_prob has shape {shape}, expected (); wrap it in"
            f" jast.distributions.Independent(d, {len(shape)}), whose number counts the axes that"
            " are one disturbance together"
        )
    _scalar(f"{name}: log_prob", log_p, float)
    return x


def arrays(name, tree):
    """``tree`` with leaves of explicit dtype; ValueError for a leaf that is not numbers."""

    def array(path, leaf):
        numbers = isinstance(leaf, ARRAYS)
        key = numbers and jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.extended)
        if key or not numbers:
            raise ValueError(
                f"{name}: leaf {leaf_path(path)} is {_kind(leaf)}, expected an array of numbers or"
                f" booleans{KEY * key}"
            )
        return lax.convert_element_type(leaf, jnp.result_type(leaf))

    return jax.tree_util.tree_map_with_path(array, tree)


def _scalar(what, value, kind, hint=""):
    if not isinstance(value, ARRAYS):
        raise ValueError(f"{what}: received {_kind(value)}, expected a {kind.__name__} scalar")
    shape, dtype = jnp.shape(value), jnp.result_type(value)
    if shape != ():
        raise ValueError(f"{what} has shape {shape}, expected (): a {kind.__name__} scalar")
    if not (dtype == jnp.bool_ if kind is bool else jnp.issubdtype(dtype, jnp.floating)):
        raise ValueError(
            f"{what} has dtype {dtype}, expected {'bool' if kind is bool else 'a float'}{hint}"
        )


def _hint_of_integers(state):
    """What to say where a state of `init` holds whole numbers: often these are meant as floats."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if jnp.issubdtype(jnp.result_type(leaf), jnp.integer):
            at = f" in leaf {leaf_path(path)}" if path else ""
            return f"; init returns whole numbers{at}: where floats are meant, write 0.0 for 0"
    return ""


def _same(what, new, old, hint=""):
    """ValueError unless ``new`` has the tree structure, shapes and dtypes of ``old``."""
    if jax.tree.structure(new) != jax.tree.structure(old):
        raise ValueError(
            f"{what} has structure {jax.tree.structure(new)}, expected {jax.tree.structure(old)}"
        )
    leaves = jax.tree_util.tree_leaves_with_path(new)
    for (path, a), b in zip(leaves, jax.tree.leaves(old), strict=True):
        name = f"{what} leaf {leaf_path(path)}"
        if jnp.shape(a) != jnp.shape(b):
            raise ValueError(f"{name} has shape {jnp.shape(a)}, expected {jnp.shape(b)}")
        if (dtype := jnp.result_type(a)) != jnp.result_type(b):
            raise ValueError(f"{name} has dtype {dtype}, expected {jnp.result_type(b)}{hint}")


def _box(box, x):
    for side, end in zip(("low", "high"), box.ends(x), strict=True):
        shapes = map(jnp.shape, jax.tree.leaves(end))
        for leaf, shape in zip(jax.tree.leaves(x), shapes, strict=True):
            try:
                fits = np.broadcast_shapes(shape, leaf.shape) == leaf.shape
            except ValueError:
                fits = False
            if not fits:
                raise ValueError(
                    f"actions.uniform: {side} has shape {shape}, expected one that broadcasts to"
                    f" the disturbance's {leaf.shape}"
                )


def action_name(actions):
    return ACTIONS.get(type(actions), f"actions.{type(actions).__name__}")


def first_line(error):
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def leaf_path(path):
    return jax.tree_util.keystr(path) or "(the whole)"


def _kind(value):
    if isinstance(value, ARRAYS):
        return f"{jnp.result_type(value)}{list(jnp.shape(value))}"
    return f"{type(value).__name__} {value!r}"[:120]
