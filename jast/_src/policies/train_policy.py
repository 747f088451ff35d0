"""The course of a training on the host: it explores the model and what is around it, then learns
chunk by chunk, watched, kept and interrupted.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.policies.failure_policy import FailurePolicy, History, Learned, assemble
from jast._src.policies.settings import Asked, Plan
from jast._src.policies.training_state import (
    Config,
    Totals,
    TrainingState,
    fit_normalisation,
    fit_start,
)
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.progress_bar import Watch, terminable

__all__ = ["Method", "train_policy"]

REACH = 8.0  # deviations, over all latents of an episode: as far as a probability of 1e-15
FARTHEST = 30.0  # the most that is reached where d is more of its deviations away from 0
WIDEN = 3.0  # deviations of the starts, or a third of that reach where this is more; a convention
MARGIN = 1.5  # lambda, as a multiple of what the last unit of distance is estimated to cost
RAISE = 1.5  # factor by which lambda is raised after a chunk in which too few episodes failed
ENOUGH_FAILURES = 0.2  # failing share from which lambda is no longer raised
FIRST_RAISE = 0.2  # part of the learning after which lambda may be raised: the policy follows it
LAST_RAISE = 0.75  # and up to which: what follows has time to learn
ROUNDING = 3e-3  # relative deviation of the miss distance that may be rounding of float32 sums
COUNTS = ("episodes", "steps", "invalid")  # of a history: whole numbers that go on from row to row


class Method(NamedTuple):
    """What differs between the ways of learning a policy. A key is that of a whole part."""

    actor: Callable
    """``apply`` of the actor."""
    begin: Callable[[jax.Array], TrainingState]
    """``begin(key)``: the state before the first step."""
    explore: Callable[..., tuple[TrainingState, Totals]]
    """``explore(key, training, steps)``: around the model, not learned from."""
    learn: Callable[..., tuple[TrainingState, Totals]]
    """``learn(key, training, steps)``."""
    learned: Callable[[TrainingState], tuple[Any, Any, jax.Array]]
    """What is handed out: actor, critic and alpha."""
    start_value: Callable[..., jax.Array]
    """``start_value(key, training, inputs)``: V, for `fit_start`."""
    bonus: float = 0.0
    keeps_buffer: bool = False
    """Whether the learning goes on from the buffer of the exploration."""
    explored: Callable[[TrainingState], TrainingState] | None = None
    """The state that the learning begins with, by that after the exploration, if another."""


def train_policy(
    key: jax.Array,
    asked: Asked,
    method: Method,
    config: Config,
    plan: Plan,
    *,
    scale: Any,
    widen: Any,
    progress: bool,
    callback: Callable[..., Any] | None,
    checkpoint: Any,
    **about: Any,
) -> FailurePolicy:
    """The policy that ``method`` teaches; from ``scale`` to ``checkpoint`` as the user gave them.
    ``about``: what else a checkpoint must agree with.
    """
    function, sim = asked.function, asked.sim
    scale, widen = asked.scale(scale), asked.widen(widen)
    for_begin, for_steps, for_start = jax.random.split(key, 3)
    method = method._replace(
        begin=functools.partial(method.begin, for_begin),
        explore=functools.partial(method.explore, for_steps),
        learn=functools.partial(method.learn, for_steps),
    )
    about = dict(sim=sim, config=config, plan=plan, scale=scale, widen=widen) | about
    with open_checkpoint(function, checkpoint, key, **about) as store:
        kept = _resume(method, store) or _explore(method, plan, sim.horizon, scale, widen)
        done, total = int(kept[0].step) * config.lanes, plan.total * config.lanes
        watch = Watch(function, total, "step", progress, callback, done=done)
        training, rows = _learn(method, plan, kept, scale is None, watch, store)
    tilt = ()
    if config.n0:
        bonus = jnp.float32(method.bonus)
        tilt = fit_start(for_start, sim, config, training, bonus, method.start_value)
    actor, critic, alpha = method.learned(training)
    learned = Learned(actor, critic, training.normalisation, tilt, alpha, training.scale)
    return assemble(sim, method.actor, config.dense_reward, learned, _history(rows[1:]))


def _explore(method, plan, horizon, scale, widen):
    """``(TrainingState, the first row of the history)`` after the exploration."""
    training, nominal = method.explore(method.begin(), plan.nominal)
    n = max(float(nominal.valid), 1.0)
    mean, square = float(nominal.nearest) / n, float(nominal.squares) / n
    deviation = math.sqrt(max(square - mean**2, 0)) if math.isfinite(square) else 0.0
    varies = mean > 0 and deviation > ROUNDING * mean
    far = min(mean / deviation, FARTHEST) if varies else 0.0
    training = training._replace(
        widen=jnp.float32(max(WIDEN, far / 3) if widen is None else widen),
        reach=jnp.float32(max(REACH, far) / math.sqrt(horizon + 1)),
    )
    training, around = method.explore(training, plan.exploration)
    training = fit_normalisation(training, horizon)
    if scale is None:
        # were d normal under p and linear in z, d = 0 would cost E[d]^2 / (2 Var[d]) of
        # log-likelihood, and the last unit of distance E[d] / Var[d]
        unit = float(training.normalisation.unit)
        scale = MARGIN * mean / deviation**2 if varies else REACH**2 / unit
    training = training._replace(scale=jnp.float32(scale))
    totals = jax.tree.map(lambda a, b: a + b, *jax.device_get((nominal, around)))
    rows = _with_row(np.zeros((0, len(History._fields))), training, totals)
    training = training if method.explored is None else method.explored(training)
    return training if method.keeps_buffer else training._replace(buffer=()), rows


def _learn(method, plan, kept, auto_scale, watch, store):
    """``(TrainingState, rows)`` after all chunks; ``kept``: those before. ``store``
    keeps them after each chunk.
    """
    lanes = kept[0].lanes.t.shape[0]
    try:
        with terminable():
            while (left := plan.total - int(kept[0].step)) > 0:
                steps = min(left, plan.chunk)
                training, totals = jax.block_until_ready(method.learn(kept[0], steps))
                rows = _with_row(kept[1], training, jax.device_get(totals))
                last = History(*rows[-1])
                passed = 1 - (left - plan.chunk) / plan.learning
                may_raise = auto_scale and FIRST_RAISE < passed < LAST_RAISE
                if may_raise and last.failing_share < ENOUGH_FAILURES:
                    training = training._replace(scale=training.scale * jnp.float32(RAISE))
                # in one statement: an interruption finds all of a chunk or nothing
                kept = training, rows
                if store is not None:
                    store.replace(jax.tree.leaves(kept))
                failing, log_p = f"{last.failing_share:.1%}", f"{last.log_p:.4g}"
                watch.reach(int(training.step) * lanes, failing=failing, log_p=log_p)
                watch.tell(lambda rows=rows: _history(rows[1:]))
    except KeyboardInterrupt:
        if len(kept[1]) < 2:
            raise
    finally:
        watch.close()
    return kept


def _resume(method, store):
    """``(TrainingState, rows)`` that a checkpoint holds; None where there is none."""
    state = None if store is None else store.state()
    if state is None:
        return None
    like = jax.eval_shape(method.begin)
    like = like if method.keeps_buffer else like._replace(buffer=())
    *leaves, rows = state
    return jax.tree.structure(like).unflatten(map(jnp.asarray, leaves)), rows


def _history(rows: np.ndarray) -> History:
    """The `History` of ``rows`` [n, fields], float64."""
    columns = zip(History._fields, rows.T, strict=True)
    return History(*(a.astype(np.int64 if name in COUNTS else np.float64) for name, a in columns))


def _with_row(rows: np.ndarray, training: TrainingState, totals: Totals) -> np.ndarray:
    """``rows`` and one more, by the state and the `Totals` since the last row."""
    last = History(*(rows[-1] if len(rows) else np.zeros(len(History._fields))))

    def ratio(a: Any, b: Any) -> float:
        return float(a) / float(b) if b else np.nan

    new = History(
        episodes=last.episodes + totals.episodes,
        steps=last.steps + totals.steps,
        mean_return=ratio(totals.log_p + float(training.scale) * totals.gain, totals.valid),
        failing_share=ratio(totals.failures, totals.valid),
        log_p=ratio(totals.failing_log_p, totals.failures),
        alpha=np.exp(float(training.learner.log_alpha)),
        critic_loss=ratio(totals.loss, totals.updates),
        scale=float(training.scale),
        invalid=last.invalid + totals.invalid,
    )
    return np.concatenate([rows, np.array([new], np.float64)])
