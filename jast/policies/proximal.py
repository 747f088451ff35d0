"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with generalised advantages
(Schulman et al. 2016, arXiv:1506.02438) in the latents of a disturbance, as one compiled program.

The entropy is part of the reward, measured against the model as in `jast.policies.learner`: so V
has the same meaning here as there, and says the same of the start.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.heads.networks import dense
from jast.policies import exploring as E
from jast.policies import lanes as L
from jast.policies.actor import act, adam, descend, drawn, entropy_term, network, see
from jast.policies.start import Tilt
from jast.simulator import Simulator

__all__ = ["advantages", "learner", "look", "networks", "stretch", "surrogate", "tilt"]


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


def _judge(training, applies, rates, horizon, rows, valid):
    """The `Batch` [T * lanes] of ``rows`` [T, lanes], by the policy that drew them."""
    net, last, learner = training.net, training.lanes, training.learner
    unit = net.unit * training.scale
    inputs = jax.vmap(jax.vmap(lambda *row: see(net, horizon, *row)))(
        *(
            jnp.concatenate([a, b.astype(a.dtype)[None]])
            for a, b in zip(rows[:3], (last.seen, last.t, last.potential), strict=True)
        )
    )
    value = unit * jax.vmap(jax.vmap(lambda i: applies[1](learner.critic, i)))(inputs)
    log_pi = jax.vmap(jax.vmap(lambda i, z: entropy_term(z, *act(applies[0], learner.actor, i))))(
        inputs[:-1], rows.z
    )
    # log p relative to its mode, the shaping and the bonus: Lipkis and Agogino eq. 21; the entropy
    # at the temperature alpha: Haarnoja et al. 2018, eq. 1
    reward = (
        -0.5 * jnp.sum(rows.z**2, axis=2)
        + training.scale * rows.approach
        + rates.bonus * rows.failure.astype(jnp.float32)
        - rates.alpha * log_pi
    )
    advantage = advantages(reward, value, rows.done, valid, rates.trace)
    weight = valid.astype(jnp.float32)
    n = jnp.maximum(jnp.sum(weight), 1)
    centre = jnp.sum(advantage) / n
    spread = jnp.sqrt(jnp.sum(weight * (advantage - centre) ** 2) / n)
    standard = (advantage - centre) / jnp.maximum(spread, 1e-6 * unit)
    batch = Batch(
        inputs[:-1], rows.z, log_pi, weight * standard, (advantage + value[:-1]) / unit, weight
    )
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), batch)


def _iterate(key, sim, shape, pace, applies, rates, training):
    """``pace`` = (steps, epochs): so many steps of all lanes, and so many times all of them to
    learn from.
    """
    steps, epochs = pace
    for_update = jax.random.fold_in(jax.random.fold_in(key, 1), training.at)

    def body(training, _):
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 0), training.at))
        lanes, rows, valid, count = E.move(
            *keys, sim, shape, applies[0], training, jnp.asarray(True)
        )
        # what is not valid may hold numbers that are not finite
        clean = lambda a: jnp.where(valid.reshape(-1, *(1,) * (a.ndim - 1)), a, jnp.zeros_like(a))
        rows = jax.tree.map(clean, rows)
        return training._replace(lanes=lanes, at=training.at + 1), (rows, valid, count)

    training, (rows, valid, counts) = lax.scan(body, training, length=steps)
    batch = _judge(training, applies, rates, sim.horizon, rows, valid)
    left = jnp.clip(1 - training.at.astype(jnp.float32) / rates.total, 0.05, 1)
    n = steps * shape.lanes
    size = min(shape.batch, n)

    def learn(learner, part):
        part = jax.tree.map(lambda a: a[part], batch)
        return update(learner, applies, rates, rates.learning_rate * left, part)

    order = jax.vmap(lambda k: jax.random.permutation(k, n))(jax.random.split(for_update, epochs))
    parts = order[:, : n // size * size].reshape(-1, size)
    learner, loss = lax.scan(learn, training.learner, parts)
    count = jax.tree.map(lambda a: jnp.sum(a, axis=0, dtype=a.dtype), counts)
    count = count._replace(loss=jnp.sum(loss), updates=jnp.int32(len(parts)))
    return training._replace(learner=learner), count


@functools.partial(jax.jit, static_argnames=("shape", "pace", "applies"))
def stretch(
    key: jax.Array,
    sim: Simulator,
    shape: E.Shape,
    pace: tuple[int, int],
    applies: tuple[Callable, Callable],
    rates: Rates,
    training: E.Training,
    iterations: int,
) -> tuple[E.Training, E.Count]:
    """So many ``iterations``: ``(Training, Count)``."""

    def body(_, carry):
        training, count = carry
        training, more = _iterate(key, sim, shape, pace, applies, rates, training)
        return training, jax.tree.map(jnp.add, count, more)

    return lax.fori_loop(0, iterations, body, (training, E.nothing()))


@functools.partial(jax.jit, static_argnames="shape")
def first(key: jax.Array, sim: Simulator, shape: E.Shape, alpha: jax.Array) -> E.Training:
    """A `Training` before its first step."""
    for_lanes, for_networks = jax.random.split(key)
    new = learner(for_networks, shape.m, shape.n, shape.hidden, shape.components, alpha)
    return E.first(for_lanes, sim, shape, new)


@functools.partial(jax.jit, static_argnames=("shape", "apply"))
def look(
    key: jax.Array,
    sim: Simulator,
    shape: E.Shape,
    apply: Callable,
    training: E.Training,
    steps: int,
) -> tuple[E.Training, E.Count]:
    """``steps`` steps of all lanes around the model, kept in the buffer and not learned from."""

    def body(_, carry):
        training, count = carry
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 0), training.at))
        lanes, new, valid, more = E.move(*keys, sim, shape, apply, training, jnp.asarray(False))
        buffer, stored = L.put(training.buffer, training.stored, new, valid)
        training = training._replace(lanes=lanes, buffer=buffer, stored=stored, at=training.at + 1)
        return training, jax.tree.map(jnp.add, count, more)

    return lax.fori_loop(0, steps, body, (training, E.nothing()))


@functools.partial(jax.jit, static_argnames=("shape", "apply"))
def tilt(
    key: jax.Array,
    sim: Simulator,
    shape: E.Shape,
    apply: Callable,
    training: E.Training,
    bonus: jax.Array,
) -> Tilt:
    """The `Tilt` of the start that the critic asks for."""
    unit = training.net.unit * training.scale
    value = lambda inputs: unit * apply(training.learner.critic, inputs)
    return E.tilt(key, sim, shape, training, bonus, value)
