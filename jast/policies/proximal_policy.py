"""ppo: a failure policy by proximal policy optimisation (Schulman et al., arXiv:1707.06347)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp

from jast._checks import random_key, whole
from jast.checkpoints import open_checkpoint
from jast.contract import OBSERVED, contract
from jast.memory import require, size
from jast.outline import outline
from jast.policies import course, settings
from jast.policies import exploring as E
from jast.policies import proximal_training as T
from jast.policies.failure_policy import FailurePolicy, Learned, assemble, history
from jast.policies.lanes import empty
from jast.policies.latent import sizes
from jast.policies.proximal import Rates, networks
from jast.simulator import Simulator

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback, PathLike


__all__ = ["ppo"]

LONGEST = 128
"""Steps of a lane between updates, at most, where nobody says."""
ITERATIONS, LANES = 150, (8, 64)
"""Of the lanes, where nobody says: as many as let the policy change this often; their bounds."""
LOOKED_AT = 100_000
"""Transitions of the exploration whose moments are taken."""


def ppo(
    key: chex.PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 12_000,
    scale: float | Literal["auto"] = "auto",
    bonus: float = 0.0,
    alpha: float = 1.0,
    shaping: Literal["auto", "steps", "end"] = "auto",
    widen: float | Literal["auto"] = "auto",
    components: int = 2,
    lanes: int | Literal["auto"] = "auto",
    hidden: Sequence[int] = (100, 100),
    learning_rate: float = 1e-3,
    steps: int | Literal["auto"] = "auto",
    epochs: int = 10,
    batch: int = 256,
    clip: float = 0.2,
    trace: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> FailurePolicy:
    """Teach a policy to make ``sim`` fail in the likeliest ways: the `FailurePolicy` that
    `jast.policies.sac` hands out, by clipped proximal policy optimisation with generalised
    advantages.

    It learns only from the episodes of the policy as it is, and keeps none of them: an episode
    costs less to learn from than with `sac`, and teaches less (docs/figures.md). The latents,
    the reward of a step (Lipkis and Agogino eq. 21, less ``alpha`` times the log density of what
    was drawn), the exploration before the learning, and what becomes of numbers that are not finite
    are those of `sac`. So are random starts: drawn ``widen`` times as wide as p(x0), and handed out
    as a mixture fitted to p(x0) exp(V(s0) - lambda d(s0)).

    Args:
        key: of `jax.random`; consumed.
        sim: with a disturbance of floats that has a quantile function and its inverse. One that is
            ``episodic`` may end its episodes at any step.
        episodes: in all, of full length; where they end early there are more of them. At least 4 a
            lane.
        scale, bonus, shaping, widen, components, hidden: as for `sac`.
        alpha: temperature, above 0; 1 for importance sampling. It stays as it is.
        lanes: episodes side by side; "auto": such that about 150 updates of the policy follow one
            another, from 8 to 64.
        steps: of each lane between updates, at least 1; "auto": the horizon, at most 128. An
            episode that is not over then is judged by V, and goes on.
        epochs: times that all steps since the last updates are learned from, in another order each
            time.
        batch: steps of one update; what is left over of an epoch waits for the next.
        learning_rate: of Adam, above 0; falls to a twentieth.
        clip: epsilon, above 0 and below 1: how far the density of a latent gains from an update.
        trace: lambda of the advantages, from 0 (the next step and V) to 1 (the whole return).
        progress: whether there is a bar.
        callback: called some twenty times as ``callback(done, total, history)``, with the steps of
            all lanes and the `History` so far.
        checkpoint: a folder that keeps where the training stands; the same call goes on from there,
            whatever ended it, to the same bits (docs/scale.md).

    Returns:
        `FailurePolicy`; its ``history.alpha`` is ``alpha`` and ``critic_loss`` that of V. A
        KeyboardInterrupt ends the training after its last whole stretch and gives what was learned
        by then (it is raised again where there is none).

    Raises:
        ValueError: for settings out of range, a simulator that breaks its contract, a disturbance
            that is not of floats or cannot be tilted (named), a checkpoint of another call.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, epochs=1)
        >>> policy = jast.policies.ppo(jax.random.key(0), sim, **small)
        >>> jast.rollout(jax.random.key(1), sim, policy).disturbances.shape
        (30,)
    """
    random_key("ppo", key)
    contract("ppo", sim, observed=OBSERVED)
    if settings.auto(steps):
        steps = min(sim.horizon, LONGEST)
    counts = dict(episodes=episodes, batch=batch, epochs=epochs, components=components, steps=steps)
    episodes, batch, epochs, components, steps = (
        whole("ppo", name, value) for name, value in counts.items()
    )
    if settings.auto(lanes):
        fewest, most = LANES
        lanes = min(max(fewest, episodes * sim.horizon // (steps * ITERATIONS)), most)
    lanes = whole("ppo", "lanes", lanes)
    plan = settings.plan("ppo", episodes, sim.horizon, lanes, steps)
    hidden = settings.widths("ppo", hidden)
    dense = settings.shaped("ppo", shaping, sim)
    auto_scale = settings.auto(scale)
    scale = None if auto_scale else settings.positive("ppo", "scale", scale)
    number = lambda name, value, holds, expected: settings.number(
        "ppo", name, value, holds, expected
    )
    rates = Rates(
        learning_rate=settings.positive("ppo", "learning_rate", learning_rate),
        clip=number("clip", clip, lambda v: 0 < v < 1, "above 0 and below 1"),
        trace=number("trace", trace, lambda v: 0 <= v <= 1, "of 0 to 1"),
        alpha=settings.positive("ppo", "alpha", alpha),
        bonus=number("bonus", bonus, math.isfinite, "that is finite"),
        total=float(plan.total),
    )
    widen = settings.widening("ppo", widen)
    n, n0 = sizes(sim, "ppo")
    (m,) = outline(sim).observation
    shape, pace = (
        E.Shape(m, n, n0, hidden, components, dense, lanes, batch, max(LOOKED_AT, lanes)),
        (steps, epochs),
    )
    about = dict(
        sim=sim,
        shape=shape,
        steps=steps,
        epochs=epochs,
        plan=plan,
        rates=rates,
        scale=scale,
        widen=widen,
    )

    for_first, for_steps, for_start = jax.random.split(key, 3)
    applies = tuple(apply for _, apply in networks(n, hidden, components))
    rates = jax.tree.map(jnp.float32, rates)
    begin = lambda: T.first(for_first, sim, shape, rates.alpha)
    like, between = jax.eval_shape(begin), jax.eval_shape(lambda: empty(steps * lanes, m, n))
    held = f"{steps} steps of {lanes} lanes between updates, and the networks"
    require("ppo", 2 * (size(like) + size(between)), held, "use fewer lanes or steps")
    look = lambda training, steps: E.look(for_steps, sim, shape, applies[0], training, steps)
    run = lambda training, n: jax.block_until_ready(
        T.stretch(for_steps, sim, shape, pace, applies, rates, training, n // steps)
    )

    def first():
        training, rows = course.look(begin(), look, plan, sim.horizon, scale, widen)
        return training._replace(buffer=()), rows

    with open_checkpoint("ppo", checkpoint, key, **about) as store:
        training, rows = course.learn(
            "ppo",
            first,
            run,
            plan,
            auto_scale=auto_scale,
            progress=progress,
            callback=callback,
            store=store,
            like=like._replace(buffer=()),
        )
    tilt = T.tilt(for_start, sim, shape, applies[1], training, rates.bonus) if n0 else ()
    learned = Learned(
        training.learner.actor,
        training.learner.critic,
        training.net,
        tilt,
        rates.alpha,
        training.scale,
    )
    return assemble(sim, applies[0], dense, learned, history(rows[1:]))
