"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with generalised advantages
(Schulman et al. 2016, arXiv:1506.02438) in the latents of a disturbance: one update, and the
training as one compiled program.

The entropy is part of the reward, measured against the model as in
`policies.soft_actor_critic_training`: so V has the same meaning here as there, and says the same of
the start.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.core.simulator import Simulator
from jast._src.core.typing import ArrayTree
from jast._src.heads.networks import adam, adam_step
from jast._src.policies import training_state
from jast._src.policies.actor import (
    Networks,
    entropy_term,
    init_parameters,
    latent_mixture,
    make_networks,
    network_inputs,
    parameter_shapes,
)
from jast._src.util.pytrees import index_tree, merge_axes, zero_where

__all__ = ["Rates", "init_learner", "start_value", "train"]


class Rates(NamedTuple):
    """Real-valued settings of the updates, float32 and traced."""

    learning_rate: jax.Array
    clip: jax.Array
    """epsilon."""
    trace: jax.Array
    """lambda of the advantages."""
    alpha: jax.Array
    bonus: jax.Array
    total: jax.Array
    """Steps of the whole training, over which the learning rate falls."""


class Learner(NamedTuple):
    """All that is learned."""

    actor: ArrayTree
    critic: ArrayTree
    """V of the networks' inputs."""
    log_alpha: jax.Array
    optimiser: tuple[Any, Any]
    """Adam's state of both."""


def init_learner(key, m, n, hidden, components, alpha):
    """A `Learner` that has learned nothing, for ``m`` numbers observed."""
    inits, _ = make_networks(n, hidden, components)
    actor, critic = init_parameters(key, [parameter_shapes(init, m + 2) for init in inits])
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
    decay = jnp.where(done | ~valid, 0, jnp.asarray(trace, error.dtype))

    def back(later, step):  # 2016, eq. 16; 2017, eq. 11
        error, decay = step
        advantage = error + decay * later
        return advantage, advantage

    return lax.scan(back, jnp.zeros_like(error[0]), (error, decay), reverse=True)[1]


def surrogate(log_ratio: jax.Array, advantage: jax.Array, clip: Any) -> jax.Array:
    """The clipped objective of each step, to be maximised (2017, eq. 7); ``log_ratio``: of the new
    density of what was done to the old one.
    """
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    return jnp.minimum(ratio * advantage, clipped * advantage)


class Batch(NamedTuple):
    """Steps to learn from, in any order: [n] in front."""

    inputs: jax.Array
    z: jax.Array
    log_pi: jax.Array
    """Of the policy that drew them."""
    advantage: jax.Array
    target: jax.Array
    """Of the critic, in its unit."""
    weight: jax.Array
    """1, or 0 for a step that is not learned from."""


def update(
    learner: Learner, networks: Networks, rates: Rates, rate: Any, batch: Batch
) -> tuple[Learner, jax.Array]:
    """One step of both networks: ``(Learner, critic loss)``. They share nothing, so the parts of
    2017, eq. 9, are learned apart; the entropy is in the reward.
    """
    act, criticise = networks

    def mean(a):
        return jnp.sum(batch.weight * a) / jnp.maximum(jnp.sum(batch.weight), 1)

    def actor_loss(actor):
        log_ratio = _log_pi(act, actor, batch.inputs, batch.z) - batch.log_pi
        return -mean(surrogate(log_ratio, batch.advantage, rates.clip))

    def critic_loss(critic):
        return mean((jax.vmap(lambda i: criticise(critic, i))(batch.inputs) - batch.target) ** 2)

    loss, critic_gradient = jax.value_and_grad(critic_loss)(learner.critic)
    actor_gradient = jax.grad(actor_loss)(learner.actor)
    of_actor, of_critic = learner.optimiser
    actor, of_actor = adam_step(learner.actor, of_actor, actor_gradient, rate)
    critic, of_critic = adam_step(learner.critic, of_critic, critic_gradient, rate)
    return learner._replace(actor=actor, critic=critic, optimiser=(of_actor, of_critic)), loss


def _log_pi(act, actor, inputs, z):
    """[n]: the `entropy_term` of the latents ``z`` [n, ...]."""
    return jax.vmap(lambda i, z: entropy_term(z, *latent_mixture(act, actor, i)))(inputs, z)


def _batch(training, networks, rates, horizon, rows, valid):
    """The `Batch` [T * lanes] of ``rows`` [T, lanes], by the policy that drew them."""
    act, criticise = networks
    lanes, learner = training.lanes, training.learner
    unit = training.normalisation.unit * training.scale
    states = jax.tree.map(
        lambda before, last: jnp.concatenate([before, last.astype(before.dtype)[None]]),
        (rows.observation, rows.t, rows.potential),
        (lanes.observation, lanes.t, lanes.potential),
    )
    inputs_of = functools.partial(network_inputs, training.normalisation, horizon)
    inputs = jax.vmap(jax.vmap(inputs_of))(*states)
    value = unit * jax.vmap(jax.vmap(lambda i: criticise(learner.critic, i)))(inputs)
    log_pi = jax.vmap(functools.partial(_log_pi, act, learner.actor))(inputs[:-1], rows.z)
    # the entropy at the temperature alpha: Haarnoja et al. 2018, eq. 1
    reward = rows.reward(training.scale, rates.bonus) - rates.alpha * log_pi
    advantage = advantages(reward, value, rows.done, valid, rates.trace)
    weight = valid.astype(jnp.float32)
    n = jnp.maximum(jnp.sum(weight), 1)
    centre = jnp.sum(advantage) / n
    spread = jnp.sqrt(jnp.sum(weight * (advantage - centre) ** 2) / n)
    standard = (advantage - centre) / jnp.maximum(spread, 1e-6 * unit)
    batch = Batch(
        inputs=inputs[:-1],
        z=rows.z,
        log_pi=log_pi,
        advantage=weight * standard,
        target=(advantage + value[:-1]) / unit,
        weight=weight,
    )
    return merge_axes(batch)


@functools.partial(jax.jit, static_argnames=("config", "steps", "epochs", "networks"))
def train(
    key: jax.Array,
    sim: Simulator,
    config: training_state.Config,
    steps: int,
    epochs: int,
    networks: Networks,
    rates: Rates,
    training: training_state.TrainingState,
    iterations: int,
) -> tuple[training_state.TrainingState, training_state.Totals]:
    """So many ``iterations``, each of ``steps`` steps of all lanes by the policy as it is, from all
    of which it then learns ``epochs`` times.
    """

    def step(training, _):
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 0), training.step))
        lanes, rows, valid, totals = training_state.step_lanes(
            *keys, sim, config, networks[0], training, True
        )

        # what is not valid may hold numbers that are not finite
        rows = jax.vmap(zero_where)(~valid, rows)
        training = training._replace(lanes=lanes, step=training.step + 1)
        return training, (rows, valid, totals)

    def iterate(training):
        for_update = jax.random.fold_in(jax.random.fold_in(key, 1), training.step)
        training, (rows, valid, totals) = lax.scan(step, training, length=steps)
        batch = _batch(training, networks, rates, sim.horizon, rows, valid)
        rate = rates.learning_rate * training_state.learning_rate_left(training, rates.total)
        n = steps * config.lanes
        size = min(config.batch, n)

        def learn(learner, part):
            return update(learner, networks, rates, rate, index_tree(batch, part))

        keys = jax.random.split(for_update, epochs)
        order = jax.vmap(lambda k: jax.random.permutation(k, n))(keys)
        parts = order[:, : n // size * size].reshape(-1, size)
        learner, loss = lax.scan(learn, training.learner, parts)
        totals = jax.tree.map(lambda a: jnp.sum(a, axis=0, dtype=a.dtype), totals)
        totals = totals._replace(loss=jnp.sum(loss), updates=jnp.int32(len(parts)))
        return training._replace(learner=learner), totals

    return training_state.repeat(iterate, training, iterations)


@functools.cache
def start_value(criticise: Callable) -> Callable:
    """The critic's V, for `fit_start`."""

    def value(key, training, inputs):
        unit = training.normalisation.unit * training.scale
        return unit * criticise(training.learner.critic, inputs)

    return value
