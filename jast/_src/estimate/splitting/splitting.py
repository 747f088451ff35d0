"""splitting: the probability of a failure by episodes that branch where they come nearer to one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.contract import contract
from jast._src.core.float_resolution import rounding_problem
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array, Callback, Executor, PathLike, PRNGKey
from jast._src.estimate.estimate import Estimate, estimate_from_mean
from jast._src.estimate.population.search import Answer, contradictions
from jast._src.estimate.replicates import LOST_MODE_REMARK, MIN_REPLICATES, mean_of_replicates
from jast._src.estimate.splitting.device_paths import DevicePaths, require_paths
from jast._src.estimate.splitting.levels import NAME, Run, climb
from jast._src.estimate.splitting.object_checks import branching_objects, check_objects
from jast._src.estimate.splitting.object_paths import ObjectPaths
from jast._src.runtime import work
from jast._src.runtime.backends import Task
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.host_errors import incidents, new_incidents
from jast._src.runtime.progress_bar import Watch
from jast._src.util.checks import check_random_key, whole_number
from jast._src.util.display import call_settings
from jast._src.util.intervals import checked_level
from jast._src.util.pytrees import as_partial, shapes_text, traceable

__all__ = ["splitting"]

MIN_PARTICLES = 10
"""Particles of a run at least: a level is an order statistic of them."""
MIN_ANCESTORS = 10
"""First episodes from which the failures of a run descend, in the mean, at least. A sum of 20
squared normals (7.1e-6) and late arrivals (2.5e-7) have 5 to 7 of 1000: 35 of 39 intervals held
that were not flagged for other reasons, and those that did not were a factor of 1.7 to 2.5 low. Two
channels and a diffusion (16 to 21): 18 of 20, the others .77 and .80; seven further systems with 40
and more: none was off."""


def splitting(
    key: PRNGKey,
    sim: Simulator,
    particles: int = 1000,
    *,
    runs: int = 10,
    score: Callable[[Any], Array] | None = None,
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Estimate:
    """Adaptive multilevel splitting (Cerou and Guyader 2007): episodes that get nowhere are
    dropped, and others that came nearer to a failure go on twice from there. For long episodes of
    many random numbers, and for black boxes with steps, which are resumed and not run again.

    A run has ``particles`` episodes. Again and again it drops the quarter whose best state is worst
    (with all that tie with these), and replaces each by a branch of one that is left, from the
    first state that is better than all of the dropped, with new disturbances. The estimate is
    unbiased whatever the score, also one of few values (Brehier, Gazeau, Goudenege, Lelievre and
    Rousset 2016). But with a poor score rare runs carry most of it, and the others agree on too
    little without a sign. Standard error and interval are those of independent ``runs`` (Student's
    t).

    It needs draws only: no quantile functions, no densities, and disturbances of unknown density
    (`jast.distributions.seeds`) serve as well. Episodes that turn invalid count as not failing.

    Objects of `jast.blackbox.from_python` are saved where they came nearer to a failure, by their
    ``snapshot()`` and ``restore(saved)`` where they have these, else by `copy.deepcopy`; that these
    bring back all of an object is checked by one episode. With ``workers=0``; give ``executor`` for
    several processes. Memory: each run holds a state a step of each of its episodes, and of objects
    one wherever an episode came nearer than before.

    A KeyboardInterrupt ends it with the estimate of the runs that are done, UNRELIABLE, and is
    raised where they are fewer than 3. Host loop, not for `jax.jit` or `jax.vmap`.

    Args:
        key: consumed.
        sim: the simulator, one of `jast.specs.under` included. It is judged at every state, unless
            there is a ``score``.
        particles: episodes of a run, at least 10.
        runs: independent repetitions, at least 3.
        score: state -> float scalar in JAX, greater where a failure is nearer. None: minus the miss
            distance of the state. A failure is above all scores.
        level: of the interval, in (0, 1).
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after each run.
        checkpoint: a folder that keeps finished runs. The same call then goes on where it was
            stopped, to the same result.
        executor: does the runs: anything with ``submit(function, *args)``, such as the executors of
            `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Estimate`. ``steps`` are all transitions that were simulated, and ``episodes`` is that
        number in whole episodes, steps / horizon, rounded up. ``samples`` are the particles of all
        runs, ``plain`` counts their first episodes, which are draws of the model, and ``history``
        says what each run did.

    Raises:
        ValueError: for fewer than 10 particles or 3 runs, a level outside (0, 1), a score that is
            no function of a state to a float; for a system without a state on the way (one step
            from one start), one that is judged at the end only and has no score, a black box with
            workers, and objects that cannot be saved and resumed; and where the simulator's
            functions do not fit together.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d("one-sided")  # truly 9.58e-4
        >>> found = jast.estimate.splitting(jax.random.key(0), sim, 200, runs=4)
        >>> 5e-4 < found.mean < 2e-3
        True
    """
    check_random_key(NAME, key)
    particles = whole_number(NAME, "particles", particles, MIN_PARTICLES)
    runs = whole_number(NAME, "runs", runs, MIN_REPLICATES)
    level = checked_level(NAME, level)
    contract(NAME, sim)
    objects, before = branching_objects(sim), incidents(sim)
    score = _checked_score(sim, score)
    _check_states(sim, score)
    if objects is None:
        require_paths(sim, particles)
    placement = work.placement(NAME, executor, devices)
    about = dict(sim=sim, particles=particles, runs=runs, score=score)
    with (
        open_checkpoint(NAME, checkpoint, key, **about) as store,
        Watch(NAME, runs, "run", progress, callback) as watch,
    ):
        checked = 0 if objects is None else check_objects(key, sim, objects)
        shared = jax.random.split(key, runs), sim, score, particles
        task = Task(_run, shared, lambda: Run(*Run._fields))
        placement = placement._replace(store=store)
        ran = work.run(task, runs, lambda all, i, run: (*all, run), (), watch, placement)
    short = work.describe_missing("runs", ran, len(ran.state), runs)
    if len(ran.state) < MIN_REPLICATES:
        raise KeyboardInterrupt if ran.ended == "" else RuntimeError(f"{NAME}: {short}")
    reasons = [] if short is None else [short]
    if objects is None and (coarse := rounding_problem(sim)) is not None:
        reasons.append(coarse)
    said = (*map(str, new_incidents(before, incidents(sim))), *map(str, ran.incidents))
    settings = call_settings(NAME, key, particles=particles, runs=runs, level=level)
    found = _estimate(ran.state, sim.horizon, checked, level, reasons, said)
    return found._replace(settings=settings)


def _run(shared, number, context):
    """The `Run` of a number, of arrays."""
    keys, sim, score, particles = shared
    objects = branching_objects(sim)
    if objects is None:
        paths = DevicePaths(keys[number], sim, score, particles)
    else:
        paths = ObjectPaths(keys[number], sim, score, particles, objects)
    return jax.tree.map(np.asarray, climb(keys[number], paths))


def _estimate(runs, horizon, checked, level, reasons, notes):
    """The `Estimate` of these `Run`; ``checked``: steps that went before them."""
    found = mean_of_replicates([float(r.log_mean) for r in runs], "runs", level)
    plain = tuple(map(int, sum(r.plain for r in runs)))
    reasons = [*reasons, *found.reasons]
    if not math.isnan(found.log_mean):
        ancestors = np.mean([int(r.ancestors) for r in runs if r.failing])
        if ancestors < MIN_ANCESTORS:
            reasons.append(
                f"the failures of a run descend from {ancestors:.2g} of its first episodes only:"
                " more particles are needed, or a score that says sooner what leads to a failure"
            )
        reasons += contradictions(Answer(found.log_mean, found.relative), plain)
    if undefined := sum(int(r.undefined) for r in runs):
        reasons.append(f"{undefined} scores are NaN, which counts as below all others")
    steps = checked + sum(int(r.steps) for r in runs)
    return estimate_from_mean(
        NAME,
        min(found.log_mean, 0.0),
        found.relative,
        level,
        found.interval,
        ess=_worth(found.relative),
        max_share=found.max_share,
        failing=sum(int(r.failing) for r in runs),
        samples=plain[2],
        episodes=math.ceil(steps / horizon),
        steps=steps,
        invalid=sum(int(r.invalid) for r in runs),
        reliable=not reasons,
        warnings=(*reasons, *notes, LOST_MODE_REMARK),
        history=tuple(map(_words, runs)),
        plain=plain,
    )


def _worth(relative):
    """Of how many failing draws a count would be as sure; 0 where none was seen."""
    if math.isnan(relative):
        return 0.0
    return relative**-2 if relative > 0 else math.inf


def _words(r):
    """A run in words."""
    said = f"run: {len(r.levels)} levels"
    if len(r.levels):
        said += f", the last score {r.levels[-1]:.4g}"
    end = "died out"
    if r.failing:
        end = (
            f"log p {r.log_mean:.3f}, failures descend from {r.ancestors} of {r.plain[2]} episodes"
        )
    return f"{said}; {end}; {r.branches} branches, {r.steps} steps"


def _checked_score(sim, score):
    """``score`` as a pytree. ValueError where it is no function of a state to a float."""
    if score is None:
        return None
    if not callable(score):
        raise ValueError(f"{NAME}: score must be a function of the state, received {score!r}")
    score = traceable(as_partial(score))
    try:
        value = jax.eval_shape(score, signature_of(sim).state)
    except Exception as error:
        raise ValueError(f"{NAME}: score raised {type(error).__name__}: {error}") from error
    kinds = jnp.floating, jnp.integer
    if getattr(value, "shape", None) != () or not any(
        jnp.issubdtype(value.dtype, kind) for kind in kinds
    ):
        raise ValueError(f"{NAME}: score must return a float scalar, received {shapes_text(value)}")
    return score


def _check_states(sim, score):
    """ValueError where no state on the way tells anything."""
    advice = "use jast.estimate.failure_probability"
    if sim.horizon == 1 and not signature_of(sim).random_start:
        raise ValueError(
            f"{NAME}: sim must have states on the way, where episodes can branch; received one of a"
            f" single step from one start: {advice}"
        )
    if sim.episodic and score is None:
        raise ValueError(
            f"{NAME}: sim must be judged at every state, received an episodic one, judged at its"
            f" end only: give score=, a function of the states on the way, or {advice}"
        )
