"""check: whether a simulator's functions fit together, said in terms of the function that does not.

`contract` traces the functions. `check` also runs a handful of steps, for what only numbers show:
NaN, densities of zero, randomness that is not a disturbance. Then come the `core.traps`.
"""

from __future__ import annotations

import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core import black_boxes
from jast._src.core.actions import UniformBox
from jast._src.core.contract import action_name, arrays, called, contract, first_line, leaf_path
from jast._src.core.probe import probe
from jast._src.core.simulator import Simulator, first_state
from jast._src.core.traps import traps
from jast._src.core.typing import Actions
from jast._src.runtime._jax import is_traced, is_tracing, quick
from jast._src.runtime.host_errors import incidents, new_incidents, runs_on_host

__all__ = ["check"]

ANEW = ", and initialize brings an object back to its start, whatever it did before"
DRAWS = 64  # of the actions at the start


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
    black_boxes.check_played_again(sim, found.x0)
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
    for words in black_boxes.words_on_distances(sim) if hosted else traps(sim, found.resolution):
        warnings.warn(f"check: {words}", UserWarning, stacklevel=2)
    black_boxes.warn_of_lost_failures(sim)
    share = 0.0 if actions is None else _impossible_share(sim, actions, found.x0)
    if share > 0.5:
        box = ""
        if isinstance(actions, UniformBox):
            box = f" on the box [{_show(actions.low)}, {_show(actions.high)}]"
        raise ValueError(
            f"{action_name(actions)}: expected disturbances inside the support of p(x | s),"
            f" received log densities that are not finite in {share:.0%} of {DRAWS} draws at the"
            f" start{box}"
        )
    return sim


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
        words = f"state leaf {leaf_path(path)} is NaN {when}, expected a number"
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
    first, second = (arrays(name, called(name, function, *args)) for _ in range(2))
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(second), strict=True
    ):
        if np.asarray(a).tobytes() != np.asarray(b).tobytes():
            raise ValueError(
                f"{name}: {'not deterministic: ' if hosted else ''}leaf {leaf_path(path)} differs"
                " between two runs on the same input; randomness belongs in disturbance or start"
                f"{ANEW if hosted else ''}"
            )


def _text(name, function, args):
    """The program of ``function`` and the bits of its constants."""
    traced = jax.make_jaxpr(lambda *args: arrays(name, called(name, function, *args)))(*args)
    return "\n".join([str(traced.jaxpr), *(str(np.asarray(c).tobytes()) for c in traced.consts)])


def _raised(error):
    """What a callback raised: JAX shows it behind the traceback, whose lines are indented."""
    *traceback, last = str(error).split('\n  File "')
    shown = (line for line in last.splitlines()[1:] if traceback and line[:1].strip())
    return next(shown, None) or first_line(error)


def _show(value):
    return np.array2string(np.asarray(value), threshold=8, precision=4)
