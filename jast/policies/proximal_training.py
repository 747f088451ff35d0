"""The training by proximal policy optimisation as compiled programs: steps of all lanes by the
policy as it is, which they are learned from, and so on.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from jast.policies import exploring as E
from jast.policies.actor import act, entropy_term, see
from jast.policies.proximal import Batch, Rates, advantages, learner, update
from jast.policies.start import Tilt
from jast.simulator import Simulator

__all__ = ["first", "stretch", "tilt"]


def _judge(training, applies, rates, horizon, rows, valid):
    """The `Batch` [T * lanes] of ``rows`` [T, lanes], by the policy that drew them."""
    net, last, known = training.net, training.lanes, training.learner
    unit = net.unit * training.scale
    inputs = jax.vmap(jax.vmap(lambda *row: see(net, horizon, *row)))(
        *(
            jnp.concatenate([a, b.astype(a.dtype)[None]])
            for a, b in zip(rows[:3], (last.seen, last.t, last.potential), strict=True)
        )
    )
    value = unit * jax.vmap(jax.vmap(lambda i: applies[1](known.critic, i)))(inputs)
    log_pi = jax.vmap(jax.vmap(lambda i, z: entropy_term(z, *act(applies[0], known.actor, i))))(
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
