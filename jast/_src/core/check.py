"""check: whether a simulator's functions fit together, said in terms of the function that does not.

Two halves. `contract` traces the functions, for structure, shapes and dtypes: cheap, and possible
while the simulator holds tracers, so searches call it as they are traced. `check` also runs a
handful of steps, for what only numbers show: NaN, densities of zero, randomness that is not a
disturbance. Then come the `core.traps`.
"""

from __future__ import annotations

import math
import operator
import warnings
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core.actions import Quantiles, Samples, UniformBox, Wide
from jast._src.core.black_boxes import check_played_again, words_on_distances
from jast._src.core.lost_failures import warn_of_lost_failures
from jast._src.core.probe import probe
from jast._src.core.simulator import Simulator, first_state, require_simulator
from jast._src.core.traps import traps
from jast._src.core.typing import Actions
from jast._src.runtime._jax import is_traced, is_tracing, quick
from jast._src.runtime.host_errors import incidents, new_incidents, runs_on_host
from jast._src.runtime.memory import release

__all__ = ["ACTIONS", "OBSERVED", "check", "contract"]

OBSERVED = 64  # numbers that ``observe`` may return at most to what looks at them, as networks do
ARRAYS = (jax.Array, np.ndarray, np.generic, bool, int, float)
LOOKS = {"disturbance", "evaluate", "is_terminal", "observe"}  # at a state that goes on
ANEW = ", and initialize brings an object back to its start, whatever it did before"
DRAWS = 64  # of the actions at the start
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


def check(sim: Simulator, actions: Actions | None = None) -> Simulator:
    """Whether a simulator keeps its contract: every function is traced and a few steps are run.

    Runs 81 episodes, of at most 500 steps where the system is not episodic. Of a system on the host
    it runs 9, and one twice; of objects of `jast.blackbox` also two whole episodes, and then the
    first of them again. Where ``sim`` holds tracers, or inside a transformation of JAX, only the
    traced half runs. Warns (UserWarning) where such objects that are judged at the end only
    (``episodic=True``) failed on the way in some of 16 more episodes; where the miss distances of a
    system on the host are all equal, or greater where it fails; and of what fits together and loses
    failures all the same (not of a system on the host):

     - the floats of the state are too coarse for what a disturbance does to it, or no disturbance
       changes a number of the state;
     - the state jumps back to its start, three times as far as it ever moved in a step, as of an
       environment that resets itself;
     - the state holds a random key that no disturbance reaches;
     - ``is_terminal`` holds at every start;
     - `jax.lax.stop_gradient` leaves the miss distance without a slope;
     - the step is so large that it takes minutes to compile.

    Args:
        sim: the simulator.
        actions: of `jast.actions`; checks whether they suit it as well.

    Returns:
        ``sim`` itself.

    Raises:
        ValueError: that names the function at fault (its own exception is the ``__cause__``): one
            that does not fit the others; a log density that is not finite on its own samples; NaN
            in the state, or a distance that is not finite in the undisturbed first steps or in more
            than half of the nominal ones; ``init``, ``step`` or ``evaluate`` with another answer
            the second time; actions that are impossible under p(x | s) in more than half of 64
            draws at the start.

    Example:
        >>> import jast
        >>> sim = jast.check(jast.simulators.walk1d(), jast.actions.wide(2.0))
    """
    contract("check", sim, actions, observed=math.inf)
    if is_traced(sim, actions) or is_tracing():
        return sim
    before = incidents(sim)
    try:
        found = probe(sim)
    except jax.errors.JaxRuntimeError as e:  # a host callback that raised
        raise ValueError(
            f"check: while the first steps ran, a function of the simulator raised {_raised(e)}"
        ) from e
    _check_densities(found)
    check_played_again(sim, found.x0)
    _check_twice("init", sim.init, found.x0)
    _check_twice("evaluate", sim.evaluate, found.judged)
    for incident in new_incidents(before, incidents(sim)):
        if incident.kind == "not deterministic":
            raise ValueError(
                f"evaluate: not deterministic: {incident.message}: randomness belongs in"
                f" disturbance or start{ANEW}"
            )
    _check_twice("step", lambda x0, x: sim.step(first_state(sim, x0), x), found.x0, found.x)
    _check_numbers(found, new_incidents(before, incidents(sim)))
    hosted = runs_on_host(sim)
    for words in words_on_distances(sim) if hosted else traps(sim, found.resolution):
        warnings.warn(f"check: {words}", UserWarning, stacklevel=2)
    warn_of_lost_failures(sim)
    share = 0.0 if actions is None else _impossible_share(sim, actions, found.x0)
    if share > 0.5:
        box = ""
        if isinstance(actions, UniformBox):
            box = f" on the box [{_show(actions.low)}, {_show(actions.high)}]"
        raise ValueError(
            f"{_name(actions)}: expected disturbances inside the support of p(x | s), received log"
            f" densities that are not finite in {share:.0%} of {DRAWS} draws at the"
            f" start{box}"
        )
    return sim


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
    start = _call("start", sim.start)
    x0 = _draw("start", start)
    state = _arrays("init", _call("init", sim.init, x0))
    hint = _hint_of_integers(state)
    dist = _call("disturbance", sim.disturbance, state)
    x = _draw("disturbance", dist)
    pair = _call("evaluate", sim.evaluate, state)
    if not isinstance(pair, tuple | list) or len(pair) not in (2, 3):
        raise ValueError(
            "evaluate: expected a pair (event, distance), or (event, distance, log p), received"
            f" {_kind(pair)}"
        )
    _scalar("evaluate: event", pair[0], bool)
    _scalar("evaluate: distance", pair[1], float, hint)
    for told in pair[2:]:
        _scalar("evaluate: log p", told, float)
    _scalar("is_terminal", _call("is_terminal", sim.is_terminal, state), bool)
    if observed:
        seen = _call("observe", sim.observe, state)
        vector = isinstance(seen, ARRAYS) and jnp.ndim(seen) == 1
        if not (vector and jnp.issubdtype(jnp.result_type(seen), jnp.floating)):
            raise ValueError(f"observe: returns {_kind(seen)}, expected a float vector")
        if jnp.size(seen) > observed:
            raise ValueError(
                f"observe: returns {jnp.size(seen)} numbers, of which {function} takes at most"
                f" {observed}; pass the simulator observe=, a function state -> float vector of"
                " those that matter"
            )
    _same("step: state", _arrays("step", _call("step", sim.step, state, x)), state, hint)
    if actions is not None:
        name = _name(actions)
        if not callable(getattr(actions, "draw", None)):
            raise ValueError(f"actions: expected one of jast.actions, received {actions!r}")
        if isinstance(actions, UniformBox):
            _box(actions, x)
        _same(f"{name}: disturbance", _call(name, actions.draw, jax.random.key(0), dist), x)
        if jax.tree.leaves(x0):
            _same(f"{name}: x0", _call(name, actions.draw_start, jax.random.key(0), start), x0)


def _call(name, function, *args):
    # containers of its own: what a step does to these is its own affair
    given = jax.tree.map(lambda a: a, args)
    before = jax.tree.leaves(given)
    looks = name in LOOKS and not _differ(before, given)  # a class may make its leaves anew
    try:
        found = function(*given)
    except Exception as e:
        from jast._src.blackbox.worker import line_of

        kind = type(e).__name__
        hint = HINTS.get(kind, NO_START if name == "init" and args == ((),) else "")
        where = line_of(e) or _line_of_definition(function)
        raise ValueError(f"{name}: raised {kind}{where}: {_first_line(e)}{hint}") from e
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
    x = _arrays(of_sample, _call(of_sample, lambda: D.sample(dist, jax.random.key(0))))
    log_p = _call(f"{name}: log_prob", dist.log_prob, x)
    if isinstance(log_p, ARRAYS) and jnp.shape(log_p):
        shape = jnp.shape(log_p)
        raise ValueError(
            f"{name}: log_prob has shape {shape}, expected (); wrap it in"
            f" jast.distributions.Independent(d, {len(shape)}), whose number counts the axes that"
            " are one disturbance together"
        )
    _scalar(f"{name}: log_prob", log_p, float)
    return x


def _arrays(name, tree):
    """``tree`` with leaves of explicit dtype; ValueError for a leaf that is not numbers."""

    def array(path, leaf):
        numbers = isinstance(leaf, ARRAYS)
        key = numbers and jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.extended)
        if key or not numbers:
            raise ValueError(
                f"{name}: leaf {_path(path)} is {_kind(leaf)}, expected an array of numbers or"
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
            at = f" in leaf {_path(path)}" if path else ""
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
        name = f"{what} leaf {_path(path)}"
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


@quick
def _impossible_share(sim, actions, x0):
    """Of the ``actions``' draws at the start, those whose log density is not finite."""

    def impossible(key):
        dist = sim.disturbance(first_state(sim, x0))
        return ~jnp.isfinite(dist.log_prob(actions.draw(key, dist)))

    drawn = jax.vmap(impossible)(jax.random.split(jax.random.key(1), DRAWS))
    return jnp.mean(drawn, dtype=jnp.float32)


def _check_densities(found):
    # the undisturbed lane is at the modes, where a density may be infinite
    density = found.density[:-1]
    for t in np.flatnonzero(density.any(axis=0))[:1]:
        name, where = ("start", "") if t == 0 else ("disturbance", f" at step {t}")
        raise ValueError(
            f"{name}: log_prob is not finite in {density[:, t].sum()} of {len(density)} of its own"
            f" samples{where}"
        )


def _check_numbers(found, went_wrong):
    def first_wrong(flags):  # [lanes + 1, STEPS + 1] -> a step, or None
        wrong = (flags[:-1].mean(axis=0) > 0.5) | (flags[-1] & bool(found.has_mode))
        return int(np.argmax(wrong)) if wrong.any() else None

    leaves = jax.tree_util.tree_leaves_with_path(found.state)
    steps = [(first_wrong(flags), path) for path, flags in leaves]
    for t, path in sorted([s for s in steps if s[0] is not None], key=lambda s: s[0])[:1]:
        when = f"after {t} steps" if t else "at the start"
        words = f"state leaf {_path(path)} is NaN {when}, expected a number"
        raise ValueError(_because(went_wrong, "step" if t else "init", words))
    if (t := first_wrong(found.distance)) is not None:
        words = f"distance is not finite after {t} steps, expected a number"
        raise ValueError(_because(went_wrong, "evaluate", words))


def _because(incidents, name, words):
    """``words`` on the function of that ``name``, after the ``incidents`` that led to it."""
    causes = list(map(str, incidents))
    return f"{name}: " + "\n  ".join([*causes, "so " * bool(causes) + words])


def _check_twice(name, function, *args):
    """ValueError unless two runs agree to the bit. Two traces that read alike are one program,
    which is quicker to see than to run. Others run outside of jit, as do those that call the host.
    """
    texts = [_text(name, function, args) for _ in range(2)]
    hosted = "callback" in texts[0]
    if texts[0] == texts[1] and not hosted:
        return
    args = jax.tree.map(jnp.asarray, args)
    first, second = (_arrays(name, _call(name, function, *args)) for _ in range(2))
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(second), strict=True
    ):
        if np.asarray(a).tobytes() != np.asarray(b).tobytes():
            raise ValueError(
                f"{name}: {'not deterministic: ' if hosted else ''}leaf {_path(path)} differs"
                " between two runs on the same input; randomness belongs in disturbance or start"
                f"{ANEW if hosted else ''}"
            )


def _text(name, function, args):
    """The program of ``function`` and the bits of its constants."""
    traced = jax.make_jaxpr(lambda *args: _arrays(name, _call(name, function, *args)))(*args)
    return "\n".join([str(traced.jaxpr), *(str(np.asarray(c).tobytes()) for c in traced.consts)])


def _name(actions):
    return ACTIONS.get(type(actions), f"actions.{type(actions).__name__}")


def _raised(error):
    """What a callback raised: JAX shows it behind the traceback, whose lines are indented."""
    *traceback, last = str(error).split('\n  File "')
    shown = (line for line in last.splitlines()[1:] if traceback and line[:1].strip())
    return next(shown, None) or _first_line(error)


def _first_line(error):
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def _path(path):
    return jax.tree_util.keystr(path) or "(the whole)"


def _kind(value):
    if isinstance(value, ARRAYS):
        return f"{jnp.result_type(value)}{list(jnp.shape(value))}"
    return f"{type(value).__name__} {value!r}"[:120]


def _show(value):
    return np.array2string(np.asarray(value), threshold=8, precision=4)
