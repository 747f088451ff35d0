"""sac: a failure policy by soft actor-critic (Lipkis and Agogino, NASA; Haarnoja et al. 2018,
arXiv:1812.05905).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, PathLike, PRNGKey
from jast._src.policies import soft_actor_critic_training
from jast._src.policies.actor import make_networks
from jast._src.policies.failure_policy import FailurePolicy
from jast._src.policies.settings import Asked, is_auto
from jast._src.policies.train_policy import Method, train_policy
from jast._src.policies.training_state import init_training
from jast._src.runtime.memory import require, size

__all__ = ["sac"]

UPDATES = 5000  # in all, where nobody says; a convention
CRITICS_ALONE = 0.1  # fraction of the learning in which the actor does not learn yet


def sac(
    key: PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 12_000,
    scale: float | Literal["auto"] = "auto",
    bonus: float = 0.0,
    alpha: float | Literal["auto"] = 1.0,
    entropy: float = -0.1,
    shaping: Literal["auto", "steps", "end"] = "auto",
    widen: float | Literal["auto"] = "auto",
    components: int = 2,
    lanes: int = 16,
    hidden: Sequence[int] = (100, 100),
    learning_rate: float = 1e-3,
    batch: int = 256,
    buffer: int = 100_000,
    polyak: float = 0.01,
    updates: int | Literal["auto"] = "auto",
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> FailurePolicy:
    """Teach a policy by soft actor-critic to make a system fail in the likeliest ways: a
    `jast.Policy` with its start, for `jast.rollout` and importance sampling.

    The policy acts in the latents z of a disturbance, x = Q(Phi(z)) with z ~ N(0, I) under p(x |
    s). Any disturbance of floats that has a quantile function and its inverse will do, whatever its
    units. The networks see ``observe(state)``, d(s) and t / horizon. The reward of a step is -|z|^2
    / 2 (log p relative to its mode) + lambda (d(s) - d(s')) + ``bonus`` at a failure, undiscounted
    (eq. 21 of Lipkis and Agogino; d is the miss distance, and counts 0 at a failure). The start
    that is handed out is a mixture fitted to p(x0) exp(V(s0) - lambda d(s0)) by the critics, 5 % of
    it p(x0); a start that is not of floats with quantiles is left as it is.

    Transitions in which a number is not finite are counted (``history.invalid``), end their episode
    and are never learned from. Where there are more ways to fail out of one certain state than
    ``components``, the others are left out. A proposal that is moved to the ``mode`` has only one
    of them; importance sampling from the policy itself has both of two.

    The loop runs on the host, so not under `jax.jit` or `jax.vmap`; the result does.

    Args:
        key: consumed.
        sim: the simulator.
        episodes: in all, of full length; where they end early there are more of them. At least 4
            for each lane.
        scale: lambda, above 0, per unit of distance: above the log-likelihood that the last unit
            costs. "auto" begins with 1.5 E[d] / Var[d] of the nominal miss distance (that cost were
            d normal and linear in z), or, where d does not vary, with what makes the loss of a
            typical distance worth 64. It is raised by half after each twentieth of the training in
            which less than a fifth of the episodes failed, up to three quarters of the training.
        bonus: of the reward at a failure.
        alpha: temperature, above 0. With 1 the best policy is the disturbances given failure, and V
            the log of their probability. "auto": such that the mean entropy of a latent is
            ``entropy`` above that of N(0, 1) (on `landing` 1.1 to 1.2, and no sharper).
        entropy: see ``alpha``.
        shaping: "steps": d counts at every state, also of an ``episodic`` system, where it must
            then mean something on the way (as in `landing`). "end": only at the end of an episode,
            a sparse reward. "auto": "end" for an episodic black box, else "steps".
        widen: starts are drawn this many times as wide as p(x0), at least 1. "auto": 3, or, where
            that is more, a third of E[d] over the deviation of d, at most 10.
        components: of the policy, a mixture of normal distributions of z: the ways out of one
            state. Its ``mode`` is the middle of the heaviest.
        lanes: episodes side by side.
        hidden: widths of the networks' layers.
        learning_rate: of Adam; falls to a twentieth.
        batch: transitions of one update.
        buffer: transitions that are kept to learn from.
        polyak: rate of the target networks.
        updates: of all networks after each step of all lanes. "auto": one, or as many as make 5000
            in all.
        progress: whether to show a progress bar.
        callback: called twenty times as ``callback(done, total, history)``, with the steps of all
            lanes and the `History` so far.
        checkpoint: a folder that keeps where the training stands after each chunk. The same call
            then goes on from there, to the same bits (docs/scale.md).

    Returns:
        `FailurePolicy`. A KeyboardInterrupt or SIGTERM ends the training after its last whole
        chunk and gives what was learned by then (it is raised again where there is none).

    Raises:
        ValueError: for settings out of range, a simulator that breaks its contract, a disturbance
            that is not of floats or cannot be tilted (named), and a checkpoint of another call.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, updates=1)
        >>> policy = jast.policies.sac(jax.random.key(0), sim, **small)
        >>> jast.rollout(jax.random.key(1), sim, policy).disturbances.shape
        (30,)
    """
    asked = Asked("sac", key, sim)
    episodes, lanes, batch, buffer, components = asked.counts(
        episodes=episodes, lanes=lanes, batch=batch, buffer=buffer, components=components
    )
    plan = asked.plan(episodes, lanes)
    sizes = dict(lanes=lanes, components=components, batch=batch, capacity=max(buffer, lanes))
    config = asked.networks(hidden, shaping, **sizes)
    auto_alpha = is_auto(alpha)
    rates = soft_actor_critic_training.Rates(
        learning_rate=asked.positive("learning_rate", learning_rate),
        polyak=asked.number("polyak", polyak, lambda v: 0 < v <= 1, "above 0 and at most 1"),
        alpha=1.0 if auto_alpha else asked.positive("alpha", alpha),
        entropy=asked.finite("entropy", entropy),
        bonus=asked.finite("bonus", bonus),
        adapt=float(auto_alpha),
        acts=float(plan.nominal + plan.exploration + int(CRITICS_ALONE * plan.learning)),
        total=float(plan.total),
    )
    (updates,) = asked.counts(updates=-(-UPDATES // plan.learning) if is_auto(updates) else updates)
    _, networks = make_networks(config.n, config.hidden, components)
    traced = jax.tree.map(jnp.float32, rates)

    def begin(key):
        init_learner = soft_actor_critic_training.init_learner
        return init_training(key, sim, config, init_learner, traced.alpha)

    def learn(key, training, steps, updates=updates):
        of = key, sim, config, networks, traced, training, jnp.int32(updates), steps
        return soft_actor_critic_training.train(*of)

    def learned(training):
        learner = training.learner
        return learner.average, learner.target, jnp.exp(learner.log_alpha)

    kept = f"a buffer of {config.capacity} steps and the networks"
    require("sac", 2 * size(jax.eval_shape(begin, key)), kept, "use a smaller buffer")
    method = Method(
        actor=networks[0],
        begin=begin,
        explore=functools.partial(learn, updates=0),
        learn=learn,
        learned=learned,
        start_value=soft_actor_critic_training.start_value(networks, config.n),
        bonus=bonus,
        keeps_buffer=True,
    )
    course = dict(scale=scale, widen=widen, progress=progress, callback=callback)
    about = dict(updates=updates, rates=rates)
    return train_policy(key, asked, method, config, plan, checkpoint=checkpoint, **course, **about)
