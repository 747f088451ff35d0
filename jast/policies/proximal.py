"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with generalised advantages
(Schulman et al. 2016, arXiv:1506.02438) in the latents of a disturbance.

The entropy is part of the reward, measured against the model as in `jast.policies.learner`: so V
has the same meaning here as there, and says the same of the start.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.heads.networks import dense
from jast.policies.actor import act, adam, descend, drawn, entropy_term, network

__all__ = ["Batch", "Learner", "Rates", "advantages", "learner", "networks", "surrogate", "update"]


class Rates(NamedTuple):
    """Real-valued settings of the updates, float32 and traced."""

    learning_rate: Any
    clip: Any
    """epsilon."""
    trace: Any
    """lambda of the advantages."""
    alpha: Any
    bonus: Any
    total: Any
    """Steps of the whole training, over which the learning rate falls."""


class Learner(NamedTuple):
    """All that is learned."""

    actor: Any
    critic: Any
    """V of what is seen."""
    log_alpha: Any
    optimiser: Any
    """Adam's state of both."""


def networks(n: int, hidden: tuple[int, ...], components: int) -> tuple:
    """The networks' ``(init, apply)``, the actor's and the critic's, for ``n`` latents."""
    return network(n, hidden, components), dense(hidden, (), "relu", True)


def learner(
    key: jax.Array, m: int, n: int, hidden: tuple[int, ...], components: int, alpha: jax.Array
) -> Learner:
    """A `Learner` that has learned nothing, for ``m`` numbers seen."""
    like = jnp.zeros((m + 2,), jnp.float32)
    shapes = [
        jax.eval_shape(init, jax.random.key(0), like) for init, _ in networks(n, hidden, components)
    ]
    actor, critic = drawn(key, shapes)
    return Learner(actor, critic, jnp.log(alpha), (adam().init(actor), adam().init(critic)))


def advantages(
    reward: jax.Array, value: jax.Array, done: jax.Array, valid: jax.Array, trace: Any
) -> jax.Array:
    """Generalised advantages [T, ...] of steps one after another, undiscounted.

    Args:
        reward: [T, ...] of each step.
        value: [T + 1, ...] before each step, and after the last.
        done: [T, ...] the step ended its episode: no value follows.
        valid: [T, ...] False for a step that says nothing: its advantage is 0, and that of the step
            before it ends there.
        trace: lambda, from 0 (one step) to 1 (the whole return).
    """
    following = jnp.where(done, 0, value[1:])
    error = jnp.where(valid, reward + following - value[:-1], 0)  # 2017, eq. 12
    go_on = jnp.where(done | ~valid, 0, jnp.asarray(trace, error.dtype))

    def back(later, step):  # 2016, eq. 16; 2017, eq. 11
        error, go_on = step
        now = error + go_on * later
        return now, now

    return lax.scan(back, jnp.zeros_like(error[0]), (error, go_on), reverse=True)[1]


def surrogate(log_ratio: jax.Array, advantage: jax.Array, clip: Any) -> jax.Array:
    """The clipped objective of each step, to be maximised (2017, eq. 7); ``log_ratio``: of the new
    density of what was done to the old one.
    """
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    return jnp.minimum(ratio * advantage, clipped * advantage)


class Batch(NamedTuple):
    """Steps to learn from, in any order: [n] in front."""

    inputs: Any
    z: Any
    log_pi: Any
    """Of the policy that drew them."""
    advantage: Any
    goal: Any
    """Of the critic, in its unit."""
    weight: Any
    """1, or 0 for a step that is not learned from."""


def update(
    learner: Learner, applies: tuple[Callable, Callable], rates: Rates, rate: Any, batch: Batch
) -> tuple[Learner, jax.Array]:
    """One step of both networks: ``(Learner, critic loss)``. They share nothing, so the parts of
    2017, eq. 9, are learned apart; the entropy is in the reward.
    """
    mean = lambda a: jnp.sum(batch.weight * a) / jnp.maximum(jnp.sum(batch.weight), 1)

    def actor_loss(actor):
        log_pi = jax.vmap(lambda i, z: entropy_term(z, *act(applies[0], actor, i)))
        log_ratio = log_pi(batch.inputs, batch.z) - batch.log_pi
        return -mean(surrogate(log_ratio, batch.advantage, rates.clip))

    def critic_loss(critic):
        return mean((jax.vmap(lambda i: applies[1](critic, i))(batch.inputs) - batch.goal) ** 2)

    loss, by_critic = jax.value_and_grad(critic_loss)(learner.critic)
    by_actor = jax.grad(actor_loss)(learner.actor)
    actor, for_actor = descend(by_actor, learner.optimiser[0], learner.actor, rate)
    critic, for_critic = descend(by_critic, learner.optimiser[1], learner.critic, rate)
    return learner._replace(actor=actor, critic=critic, optimiser=(for_actor, for_critic)), loss
