"""Soft actor-critic (Haarnoja et al. 2018, arXiv:1812.05905) in the latents of a disturbance, with
the model itself as the measure of entropy: one update, and the training as one compiled program.

With temperature 1 the soft return is sum log p(z) / pi(z | s) + lambda (d(s) - d(s_T)). Its optimum
is V(s) = log E_p[exp(lambda (d(s) - d(s_T)))], which is, less lambda d(s) and for a large lambda,
the log of the probability of failure from s; the best pi is the disturbances given failure.
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
from jast._src.util.pytrees import index_tree

__all__ = ["Rates", "init_learner", "start_value", "train", "update"]

VALUE_DRAWS = 16  # of the policy, in the value of a start; a convention


class Rates(NamedTuple):
    """Real-valued settings of the updates, float32 and traced."""

    learning_rate: jax.Array
    polyak: jax.Array
    alpha: jax.Array
    entropy: jax.Array
    """Wanted entropy of the policy, of a latent and above that of N(0, 1)."""
    bonus: jax.Array
    adapt: jax.Array
    """1 where alpha follows ``entropy``, else 0."""
    acts: jax.Array
    """From this step on the policy acts and learns. Before, the latents are a drift of each
    episode's own, and noise, and the critics learn alone: else their first guesses would drive all
    components of the policy the same way.
    """
    total: jax.Array
    """Steps of the whole training, over which the learning rate falls."""


class Learner(NamedTuple):
    """All that is learned."""

    actor: ArrayTree
    critic: ArrayTree
    """Two, stacked in front."""
    target: ArrayTree
    """Their running averages."""
    average: ArrayTree
    """The actor's: what is handed out."""
    log_alpha: jax.Array
    optimiser: tuple[Any, Any, Any]
    """Adam's state of the actor, the critics and log alpha."""


def init_learner(key, m, n, hidden, components, alpha):
    """A `Learner` that has learned nothing, for ``m`` numbers observed."""
    (actor, critic), _ = make_networks(n, hidden, components)
    actor, critic = parameter_shapes(actor, m + 2), parameter_shapes(critic, m + 2 + n)
    actor, one, other = init_parameters(key, (actor, critic, critic))
    critic = jax.tree.map(lambda a, b: jnp.stack([a, b]), one, other)
    log_alpha = jnp.log(alpha)
    return Learner(
        actor=actor,
        critic=critic,
        target=critic,
        average=actor,
        log_alpha=log_alpha,
        optimiser=tuple(adam().init(part) for part in (actor, critic, log_alpha)),
    )


def _critic_values(criticise, unit, critic, inputs, z):
    """[2]: Q of both critics. The networks give what is to come beside log p, so far out, where
    they know nothing, -|z|^2 / 2 decides.
    """
    both = jnp.concatenate([inputs, z])
    return unit * jax.vmap(lambda params: criticise(params, both))(critic) - 0.5 * jnp.sum(z**2)


def _soft_values(networks, unit, actor, critic, inputs, noise):
    """The smaller Q and the entropy term, each the mean over the components at a draw of each."""
    act, criticise = networks
    log_w, mean, deviation = latent_mixture(act, actor, inputs)
    w, z = jnp.exp(log_w), mean + deviation * noise[None]
    q = jax.vmap(lambda z: jnp.min(_critic_values(criticise, unit, critic, inputs, z)))(z)
    log_pi = jax.vmap(lambda z: entropy_term(z, log_w, mean, deviation))(z)
    return jnp.sum(w * q), jnp.sum(w * log_pi)


def update(noise, learner, networks, normalisation, rates, acting, scale, rows, horizon):
    """One step of all networks on transitions, ``rows`` [batch], with ``noise`` [2, batch, n]:
    ``(Learner, critic loss)``; ``scale`` is lambda.

    ``acting``: 1, or 0 while the critics learn alone.
    """
    unit, alpha = normalisation.unit * scale, jnp.exp(learner.log_alpha)
    inputs_of = jax.vmap(functools.partial(network_inputs, normalisation, horizon))
    inputs = inputs_of(rows.observation, rows.t, rows.potential)
    following = inputs_of(rows.next_observation, rows.t + 1, rows.potential - rows.approach)
    soft = jax.vmap(functools.partial(_soft_values, networks, unit), (None, None, 0, 0))

    q, log_pi = soft(learner.actor, learner.target, following, noise[0])
    # Haarnoja eq. 5 with gamma 1
    target = rows.reward(scale, rates.bonus) + jnp.where(rows.done, 0, q - alpha * log_pi)

    def critic_loss(critic: Any) -> jax.Array:
        q = jax.vmap(lambda i, z: _critic_values(networks[1], unit, critic, i, z))(inputs, rows.z)
        return jnp.mean(((q - target[:, None]) / unit) ** 2)

    def actor_loss(actor: Any) -> tuple[jax.Array, jax.Array]:  # Haarnoja eq. 7
        q, log_pi = soft(actor, learner.critic, inputs, noise[1])
        return jnp.mean(alpha * log_pi - q) / unit, jnp.mean(log_pi)

    loss, critic_gradient = jax.value_and_grad(critic_loss)(learner.critic)
    (_, log_pi), actor_gradient = jax.value_and_grad(actor_loss, has_aux=True)(learner.actor)
    # Haarnoja eq. 18, in log alpha: the mean entropy of a latent less that of N(0, 1), of which log
    # pi is -1/2, is held at what is wanted
    alpha_gradient = -rates.adapt * (log_pi + rows.z.shape[1] * (rates.entropy + 0.5))
    rate, (of_actor, of_critic, of_alpha) = rates.learning_rate, learner.optimiser
    actor, of_actor = adam_step(learner.actor, of_actor, actor_gradient, acting * rate)
    critic, of_critic = adam_step(learner.critic, of_critic, critic_gradient, rate)
    log_alpha, of_alpha = adam_step(learner.log_alpha, of_alpha, alpha_gradient, acting * rate)

    def follow(average: Any, new: Any) -> Any:
        return jax.tree.map(lambda a, b: a + rates.polyak * (b - a), average, new)

    target, average = follow(learner.target, critic), follow(learner.average, actor)
    optimiser = of_actor, of_critic, of_alpha
    return Learner(actor, critic, target, average, log_alpha, optimiser), loss


@functools.partial(jax.jit, static_argnames=("config", "networks"))
def train(
    key: jax.Array,
    sim: Simulator,
    config: training_state.Config,
    networks: Networks,
    rates: Rates,
    training: training_state.TrainingState,
    updates: jax.Array,
    steps: int,
) -> tuple[training_state.TrainingState, training_state.Totals]:
    """``steps`` steps of all lanes, each followed by so many ``updates`` of the networks."""

    def step(training):
        for_noise, for_updates, for_starts = jax.random.split(
            jax.random.fold_in(key, training.step), 3
        )
        acting = training.step.astype(jnp.float32) >= rates.acts
        lanes, new, valid, totals = training_state.step_lanes(
            for_noise, for_starts, sim, config, networks[0], training, acting
        )
        buffer, stored = training.buffer.put(training.stored, new, valid)
        count = jnp.where(stored > 0, updates, 0)
        rate = rates.learning_rate * training_state.learning_rate_left(training, rates.total)

        def learn(i, carry):
            learner, loss = carry
            for_noise, for_rows = jax.random.split(jax.random.fold_in(for_updates, i))
            # each of the stored ones alike; the remainder favours none by more than 2^-15
            at = jax.random.bits(for_rows, (config.batch,), jnp.uint32) % jnp.clip(
                stored, 1, config.capacity
            ).astype(jnp.uint32)
            learner, more = update(
                noise=jax.random.normal(for_noise, (2, config.batch, config.n), jnp.float32),
                learner=learner,
                networks=networks,
                normalisation=training.normalisation,
                rates=rates._replace(learning_rate=rate),
                acting=acting.astype(jnp.float32),
                scale=training.scale,
                rows=index_tree(buffer, at.astype(jnp.int32)),
                horizon=sim.horizon,
            )
            return learner, loss + more

        start = training.learner, jnp.zeros((), jnp.float32)
        learner, loss = lax.fori_loop(0, count, learn, start)
        training = training._replace(
            lanes=lanes, buffer=buffer, stored=stored, learner=learner, step=training.step + 1
        )
        return training, totals._replace(loss=loss, updates=count)

    return training_state.repeat(step, training, steps)


@functools.cache
def start_value(networks: Networks, n: int) -> Callable:
    """V by the average actor and the target critics (Haarnoja eq. 3), for `fit_start`."""

    def value(key, training, inputs):
        learner, unit = training.learner, training.normalisation.unit * training.scale
        noise = jax.random.normal(key, (VALUE_DRAWS, n), jnp.float32)
        q, log_pi = jax.vmap(
            lambda e: _soft_values(networks, unit, learner.average, learner.target, inputs, e)
        )(noise)
        return jnp.mean(q - jnp.exp(learner.log_alpha) * log_pi)

    return value
