"""The training by soft actor-critic as one compiled program: steps of all lanes, and after each,
once enough was seen, an update of the networks.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.policies import exploring as E
from jast.policies import lanes as L
from jast.policies.learner import Rates, learner, soft_value, update
from jast.policies.start import Tilt
from jast.simulator import Simulator

__all__ = ["Phase", "first", "stretch", "tilt"]

VALUE_DRAWS = 16


class Phase(NamedTuple):
    """How a stretch goes; traced."""

    updates: Any
    """int32: of the networks, after each step of all lanes."""
    acts: Any
    """int32: from this step on the policy acts and learns. Before, the latents are a drift of each
    episode's own, and noise, and the critics learn alone: else their first guesses would drive all
    components of the policy the same way.
    """
    total: Any
    """Steps of all stretches together, over which the learning rate falls."""


@functools.partial(jax.jit, static_argnames="shape")
def first(key: jax.Array, sim: Simulator, shape: E.Shape, alpha: jax.Array) -> E.Training:
    """A `Training` before its first step."""
    for_lanes, for_networks = jax.random.split(key)
    new = learner(for_networks, shape.m, shape.n, shape.hidden, shape.components, alpha)
    return E.first(for_lanes, sim, shape, new)


@functools.partial(jax.jit, static_argnames=("shape", "applies"))
def stretch(
    key: jax.Array,
    sim: Simulator,
    shape: E.Shape,
    applies: tuple[Callable, Callable],
    rates: Rates,
    training: E.Training,
    phase: Phase,
    steps: int,
) -> tuple[E.Training, E.Count]:
    """``steps`` steps of all lanes: ``(Training, Count)``."""

    def body(_, carry):
        training, count = carry
        training, more = _step(key, sim, shape, applies, rates, training, phase)
        return training, jax.tree.map(jnp.add, count, more)

    return lax.fori_loop(0, steps, body, (training, E.nothing()))


def _step(key, sim, shape, applies, rates, training, phase):
    net = training.net
    for_noise, for_updates, for_starts = jax.random.split(jax.random.fold_in(key, training.at), 3)
    acting = training.at >= phase.acts
    lanes, new, valid, count = E.move(
        for_noise, for_starts, sim, shape, applies[0], training, acting
    )
    buffer, stored = L.put(training.buffer, training.stored, new, valid)
    updates = jnp.where(stored > 0, phase.updates, 0)
    left = jnp.clip(1 - training.at.astype(jnp.float32) / phase.total, 0.05, 1)
    slower = rates._replace(learning_rate=rates.learning_rate * left)

    def learn(i, carry):
        for_noise, for_rows = jax.random.split(jax.random.fold_in(for_updates, i))
        # of the stored ones all alike; the remainder favours none by more than 2^-15
        at = jax.random.bits(for_rows, (shape.batch,), jnp.uint32) % jnp.clip(
            stored, 1, shape.capacity
        ).astype(jnp.uint32)
        rows = jax.tree.map(lambda a: a[at.astype(jnp.int32)], buffer)
        noise = jax.random.normal(for_noise, (2, shape.batch, shape.n), jnp.float32)
        new, loss = update(
            noise,
            carry[0],
            applies,
            net,
            slower,
            acting.astype(jnp.float32),
            training.scale,
            rows,
            sim.horizon,
        )
        return new, carry[1] + loss

    new_learner, loss = lax.fori_loop(
        0, updates, learn, (training.learner, jnp.zeros((), jnp.float32))
    )
    return (
        training._replace(
            lanes=lanes, buffer=buffer, stored=stored, learner=new_learner, at=training.at + 1
        ),
        count._replace(loss=loss, updates=updates),
    )


@functools.partial(jax.jit, static_argnames=("shape", "applies"))
def tilt(
    key: jax.Array,
    sim: Simulator,
    shape: E.Shape,
    applies: tuple[Callable, Callable],
    training: E.Training,
    bonus: jax.Array,
) -> Tilt:
    """The `Tilt` of the start that the critics ask for."""
    for_draws, for_fit = jax.random.split(key)
    noise = jax.random.normal(for_draws, (VALUE_DRAWS, shape.n), jnp.float32)
    unit = training.net.unit * training.scale
    value = lambda inputs: soft_value(applies, unit, training.learner, inputs, noise)
    return E.tilt(for_fit, sim, shape, training, bonus, value)
