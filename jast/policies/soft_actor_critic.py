"""sac: a failure policy by soft actor-critic (Lipkis and Agogino, NASA; Haarnoja et al. 2018,
arXiv:1812.05905).
"""

import math
import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._checks import random_key, real, whole
from jast._jax import is_traced
from jast.contract import contract
from jast.incidents import hosted
from jast.outline import outline
from jast.policies import checkpoints
from jast.policies import training as T
from jast.policies.failure_policy import FAILING_SHARE, History, Learned, assemble, history, row
from jast.policies.latent import sizes
from jast.policies.learner import Rates, networks
from jast.watch import Watch

__all__ = ["sac"]

STRETCHES, UPDATES = 20, 5000
NOMINAL, AROUND, ALONE = 0.03, 0.05, 0.1
"""Shares of the steps: of the model itself and of the look around, before the learning, and of the
learning of the critics alone.
"""
REACH, WIDEN, FAR = 8.0, 3.0, 30.0
"""How far away from the model, in deviations, the episodes of the look around are in all their
latents together: as far as a failure of probability 1e-15; how wide the starts are; both more where
the miss distance is more of its deviations away from 0, and then as wide as this at the most (a
third of it).
"""
MARGIN, RAISE, FAILING, RAISED = 1.5, 1.5, 0.2, (0.2, 0.75)
"""Lambda: times what a unit of distance costs by estimate; then raised by a factor, while too few
fail, in this part of the training.
"""


class Plan(NamedTuple):
    """Steps of all lanes: int each."""

    nominal: int
    around: int
    learning: int
    stretch: int
    updates: int
    """After each step."""


def sac(
    key,
    sim,
    *,
    episodes=12_000,
    scale="auto",
    bonus=0.0,
    alpha=1.0,
    entropy=-0.1,
    shaping="auto",
    widen="auto",
    components=2,
    lanes=16,
    hidden=(100, 100),
    learning_rate=1e-3,
    batch=256,
    buffer=100_000,
    polyak=0.01,
    updates="auto",
    progress=False,
    callback=None,
    checkpoint=None,
):
    """Teach a policy to make ``sim`` fail in the likeliest ways: `FailurePolicy`, a `jast.Policy`
    with its start, for `jast.rollout` and importance sampling.

    The policy acts in the latents z of a disturbance, x = Q(Phi(z)) with z ~ N(0, I) under p(x |
    s): any disturbance of floats that has a quantile function and its inverse will do, whatever its
    units. Its networks see ``observe(state)``, d(s) and t / horizon. The reward of a step is -|z|^2
    / 2 (log p relative to its mode) + lambda (d(s) - d(s')) + ``bonus`` at a failure, undiscounted
    (Lipkis and Agogino eq. 21; d is the miss distance, and counts 0 at a failure). Starts are drawn
    ``widen`` times as wide as p(x0), and the start that is handed out is a mixture fitted to p(x0)
    exp(V(s0) - lambda d(s0)) by the critics, 5 % of it p(x0); a start that is not of floats with
    quantiles is left as it is.

    ==================  ============================================================================
    ``episodes``        in all, of full length; where they end early there are more of them. At
                        least 4 a lane
    ``scale``           lambda, a number above 0, per unit of distance: above the log-likelihood
                        that the last unit costs. "auto": 1.5 E[d] / Var[d] of the nominal miss
                        distance (that cost were d normal and linear in z; 64 over a typical
                        distance gone where d does not vary), raised by half after each twentieth of
                        the training in which less than a fifth of the episodes failed, up to three
                        quarters of it
    ``shaping``         "steps": d counts at every state, also of an ``episodic`` system, where it
                        must then mean something on the way (as in `landing`); "end": only at the
                        end of an episode, a sparse reward; "auto": "end" for an episodic black box,
                        else "steps"
    ``alpha``           temperature, a number above 0; with 1 the best policy is the disturbances
                        given failure, and V the log of their probability. "auto": such that the
                        mean entropy of a latent is ``entropy`` above that of N(0, 1) (on `landing`
                        1.1 to 1.2, and no sharper)
    ``components``      of the policy, a mixture of normal distributions of z: so many ways out of
                        one state. Its ``mode`` is the middle of the heaviest
    ``widen``           at least 1. "auto": 3, or where that is more a third of E[d] over the
                        deviation of d, at most 10
    ``lanes``           episodes side by side; after each step of all come ``updates`` of all
                        networks ("auto": one, or as many as make 5000 in all), each on ``batch`` of
                        the last ``buffer`` transitions
    ``learning_rate``   of Adam; falls to a twentieth. ``polyak``: rate of the target networks.
                        ``hidden``: widths of their layers
    ==================  ============================================================================

    ``progress`` shows a bar; ``callback(done, total, history)`` is called twenty times, with the
    steps of all lanes and the `History` so far. A KeyboardInterrupt ends the training after its
    last whole stretch and gives what was learned by then (it is raised again where there is none).
    ``checkpoint``: a file to which each stretch is saved, and from which a call with the same
    arguments goes on: to the bit as if nothing had been between (the functions of ``sim`` cannot be
    compared, its parameters are). The loop runs on the host, so not under `jax.jit` or `jax.vmap`;
    the result does. The key is consumed.

    Transitions in which a number is not finite are counted (``history.invalid``), end their episode
    and are never learned from. More ways to fail out of one certain state than ``components`` are
    left out, and so are they all but one in a proposal that is moved to the ``mode``: importance
    sampling from the policy itself has both of two.

    Raises ValueError for settings out of range, a simulator that breaks its contract, a disturbance
    that is not of floats or cannot be tilted (named), and a checkpoint of another training.
    """
    counts = dict(episodes=episodes, lanes=lanes, batch=batch, buffer=buffer, components=components)
    episodes, lanes, batch, buffer, components = (
        whole("sac", name, value) for name, value in counts.items()
    )
    if episodes < 4 * lanes:
        raise ValueError(
            f"sac: episodes must be at least 4 a lane, {4 * lanes}, received {episodes}"
        )
    if not isinstance(hidden, tuple | list) or not hidden:
        raise ValueError(
            f"sac: hidden must be the widths of one or more layers, received {hidden!r}"
        )
    hidden = tuple(whole("sac", "hidden", width) for width in hidden)
    if shaping not in ("auto", "steps", "end"):
        raise ValueError(f'sac: shaping must be "auto", "steps" or "end", received {shaping!r}')
    if shaping == "auto":
        shaping = "end" if sim.episodic and hosted(sim) else "steps"
    positive = lambda name, value: _float(name, value, lambda v: 0 < v < math.inf, "above 0")
    auto_scale, auto_alpha = _auto(scale), _auto(alpha)
    scale, alpha = (
        None if auto_scale else positive("scale", scale),
        1.0 if auto_alpha else positive("alpha", alpha),
    )
    rates = Rates(
        learning_rate=positive("learning_rate", learning_rate),
        polyak=_float("polyak", polyak, lambda v: 0 < v <= 1, "above 0 and at most 1"),
        alpha=alpha,
        entropy=_float("entropy", entropy, math.isfinite, "that is finite"),
        bonus=_float("bonus", bonus, math.isfinite, "that is finite"),
        adapt=float(auto_alpha),
    )
    widen = (
        None
        if _auto(widen)
        else _float("widen", widen, lambda v: 1 <= v < math.inf, "of at least 1")
    )
    random_key("sac", key)
    contract(sim)
    n, n0 = sizes(sim)
    (m,) = outline(sim).observation
    shape = T.Shape(
        m, n, n0, hidden, components, shaping == "steps", lanes, batch, max(buffer, lanes)
    )
    plan = _plan(
        episodes, sim.horizon, lanes, None if _auto(updates) else whole("sac", "updates", updates)
    )
    settings = dict(
        shape=list(shape),
        plan=list(plan),
        rates=list(rates),
        scale=scale,
        widen=widen,
        seed=np.ravel(_data(key)).tolist(),
        x64=jax.config.jax_enable_x64,
    )

    for_first, for_steps, for_start = jax.random.split(key, 3)
    applies = tuple(apply for _, apply in networks(m, n, hidden, components))
    rates = jax.tree.map(jnp.float32, rates)
    begin = lambda: T.first(for_first, sim, shape, rates.alpha)
    run = lambda training, phase, steps: jax.block_until_ready(
        T.stretch(for_steps, sim, shape, applies, rates, training, phase, steps)
    )
    acts = plan.nominal + plan.around + int(ALONE * plan.learning)
    phase = T.Phase(jnp.int32(0), jnp.int32(acts), jnp.float32(sum(plan[:3])))
    if checkpoint is not None and os.path.exists(checkpoint):
        training, rows = checkpoints.resume(checkpoint, sim, settings, jax.eval_shape(begin))
    else:
        training, rows = _before(begin(), run, phase, plan, sim.horizon, scale, widen)
    keep = (
        (lambda *state: checkpoints.keep(checkpoint, sim, settings, *state))
        if checkpoint is not None
        else None
    )
    phase = phase._replace(updates=jnp.int32(plan.updates))
    training, rows = _learn(
        training, rows, run, phase, plan, auto_scale, lanes, progress, callback, keep
    )
    tilt = T.tilt(for_start, sim, shape, applies, training, rates.bonus) if n0 else ()
    learned = Learned(
        training.learner.average,
        training.learner.target,
        training.net,
        tilt,
        jnp.exp(training.learner.log_alpha),
        training.scale,
    )
    return assemble(sim, applies[0], shape.dense, learned, history(rows[1:]))


def _auto(setting):
    return isinstance(setting, str) and setting == "auto"


def _plan(episodes, horizon, lanes, updates):
    steps = -(-episodes * horizon // lanes)
    nominal, around = (max(horizon, int(share * steps)) for share in (NOMINAL, AROUND))
    learning = steps - nominal - around
    return Plan(
        nominal,
        around,
        learning,
        -(-learning // STRETCHES),
        -(-UPDATES // learning) if updates is None else updates,
    )


def _before(training, run, phase, plan, horizon, scale, widen):
    """``(Training, its first row of the history)`` once the model and what is around it were looked
    at.
    """
    training, count = run(training, phase, plan.nominal)
    n = max(float(count.whole), 1.0)
    mean, square = float(count.nearest) / n, float(count.squares) / n
    deviation = math.sqrt(max(square - mean**2, 0)) if math.isfinite(square) else 0.0
    varies = mean > 0 and deviation > 3e-3 * mean  # beyond the rounding of sums
    far = min(mean / deviation, FAR) if varies else 0.0
    widen = max(WIDEN, far / 3) if widen is None else widen
    training = training._replace(
        widen=jnp.float32(widen), reach=jnp.float32(max(REACH, far) / math.sqrt(horizon + 1))
    )
    training, more = run(training, phase, plan.around)
    training = T.settle(training, horizon)
    if scale is None:
        # were d normal under p and linear in z, d = 0 would cost E[d]^2 / (2 Var[d]) of
        # log-likelihood, and the last unit of distance E[d] / Var[d]
        scale = MARGIN * mean / deviation**2 if varies else REACH**2 / float(training.net.unit)
    training = training._replace(scale=jnp.float32(scale))
    return training, row(
        np.zeros((0, len(History._fields))),
        training,
        jax.tree.map(lambda a, b: a + b, *jax.device_get((count, more))),
    )


def _learn(training, rows, run, phase, plan, auto_scale, lanes, progress, callback, keep):
    """``(Training, rows)`` after all stretches that ``rows`` do not hold yet."""
    kept, done = (training, rows), int(training.at) * lanes
    last = lambda h: jax.tree.map(lambda a: a[-1], h)
    watch = Watch(
        "sac",
        sum(plan[:3]) * lanes,
        "step",
        progress,
        callback,
        done=done,
        former=lambda done, total, h: (int(h.episodes[-1]), last(h)),
    )
    try:
        while (left := sum(plan[:3]) - int(kept[0].at)) > 0:
            training, count = run(kept[0], phase, min(left, plan.stretch))
            rows = row(kept[1], training, jax.device_get(count))
            gone = 1 - (left - plan.stretch) / plan.learning
            if auto_scale and RAISED[0] < gone < RAISED[1] and rows[-1, FAILING_SHARE] < FAILING:
                training = training._replace(scale=training.scale * jnp.float32(RAISE))
            kept = training, rows  # at once: an interruption finds all of a stretch or nothing
            if keep is not None:
                keep(*kept)
            failing, log_p = rows[-1, FAILING_SHARE : FAILING_SHARE + 2]
            watch.reach(int(training.at) * lanes, failing=f"{failing:.1%}", log_p=f"{log_p:.4g}")
            watch.tell(lambda rows=rows: history(rows[1:]))
    except KeyboardInterrupt:
        if len(kept[1]) < 2:
            raise
    finally:
        watch.close()
    return kept


def _float(name, value, holds, expected):
    value = real("sac", name, value, holds, expected)
    if is_traced(value):
        raise ValueError(
            f"sac: {name} must be a number {expected}, received a traced one: sac runs on the host"
        )
    return float(value)


def _data(key):
    return key if jnp.issubdtype(key.dtype, jnp.unsignedinteger) else jax.random.key_data(key)
