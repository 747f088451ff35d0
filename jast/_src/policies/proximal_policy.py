"""ppo: a failure policy by proximal policy optimisation (Schulman et al., arXiv:1707.06347)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, PathLike, PRNGKey
from jast._src.policies import proximal_training
from jast._src.policies.actor import make_networks
from jast._src.policies.failure_policy import FailurePolicy
from jast._src.policies.lanes import Transitions
from jast._src.policies.settings import Asked, is_auto
from jast._src.policies.train_policy import Method, train_policy
from jast._src.policies.training_state import explore, init_training
from jast._src.runtime.memory import require, size

__all__ = ["ppo"]

MOST_STEPS = 128  # of a lane between updates, where nobody says; a convention
ITERATIONS = 150  # updates of the policy, for which as many lanes are taken where nobody says
FEWEST_LANES = 8  # where nobody says; a convention
MOST_LANES = 64  # where nobody says; a convention
EXPLORED = 100_000  # transitions of the exploration whose moments are taken; a convention


def ppo(
    key: PRNGKey,
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
        KeyboardInterrupt ends the training after its last whole chunk and gives what was learned
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
    asked = Asked("ppo", key, sim)
    if is_auto(steps):
        steps = min(sim.horizon, MOST_STEPS)
    episodes, batch, epochs, components, steps = asked.counts(
        episodes=episodes, batch=batch, epochs=epochs, components=components, steps=steps
    )
    if is_auto(lanes):
        lanes = episodes * sim.horizon // (steps * ITERATIONS)
        lanes = min(max(FEWEST_LANES, lanes), MOST_LANES)
    (lanes,) = asked.counts(lanes=lanes)
    plan = asked.plan(episodes, lanes, steps)
    sizes = dict(lanes=lanes, components=components, batch=batch, capacity=max(EXPLORED, lanes))
    config = asked.networks(hidden, shaping, **sizes)
    rates = proximal_training.Rates(
        learning_rate=asked.positive("learning_rate", learning_rate),
        clip=asked.number("clip", clip, lambda v: 0 < v < 1, "above 0 and below 1"),
        trace=asked.number("trace", trace, lambda v: 0 <= v <= 1, "of 0 to 1"),
        alpha=asked.positive("alpha", alpha),
        bonus=asked.finite("bonus", bonus),
        total=float(plan.total),
    )
    _, networks = make_networks(config.n, config.hidden, components)
    act, criticise = networks
    traced = jax.tree.map(jnp.float32, rates)

    def begin(key):
        return init_training(key, sim, config, proximal_training.init_learner, traced.alpha)

    def learn(key, training, n):
        return proximal_training.train(
            key, sim, config, steps, epochs, networks, traced, training, n // steps
        )

    batches = jax.eval_shape(lambda: Transitions.empty(steps * lanes, config.m, config.n))
    needed = size(jax.eval_shape(begin, key)) + size(batches)
    held = f"{steps} steps of {lanes} lanes between updates, and the networks"
    require("ppo", 2 * needed, held, "use fewer lanes or steps")
    method = Method(
        actor=act,
        begin=begin,
        explore=lambda key, *args: explore(key, sim, config, act, *args),
        learn=learn,
        learned=lambda training: (training.learner.actor, training.learner.critic, traced.alpha),
        start_value=proximal_training.start_value(criticise),
        bonus=bonus,
    )
    course = dict(scale=scale, widen=widen, progress=progress, callback=callback)
    about = dict(steps=steps, epochs=epochs, rates=rates)
    return train_policy(key, asked, method, config, plan, checkpoint=checkpoint, **course, **about)
