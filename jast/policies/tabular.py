"""Q-learning (Watkins and Dayan 1992) in a table: states in cells, latents of a disturbance on a
grid, so that a failure policy needs no network.

The return of an episode is log p relative to the mode, less lambda times its last miss distance:
V(s) is that of the likeliest way to fail from s. No value is above 0, where the table begins, so
what was not tried yet looks good (Wiewiora 2003 shows that a potential would do no more).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import ndtr
from jax.tree_util import Partial

from jast.heads.heads import Moments
from jast.policies import exploring as E
from jast.policies.start import Tilt
from jast.simulator import Simulator

__all__ = [
    "Rates",
    "Table",
    "actions",
    "first",
    "given",
    "grid",
    "lookup",
    "spread",
    "stretch",
    "tilt",
]


class Table(NamedTuple):
    """What Q-learning learns."""

    q: Any
    """[cells, actions] float32: at most 0."""
    actions: Any
    """[actions, n] float32: latents; the least first, which is taken where all are worth the
    same.
    """
    low: Any
    """[m] float32: where the grid of cells begins."""
    high: Any
    """[m] float32: where it ends; whatever is beyond belongs to the last cell."""


class Learner(NamedTuple):
    """A table in the place of networks."""

    actor: Table
    log_alpha: Any
    """-inf: nothing is paid for chance."""


@functools.partial(jax.jit, static_argnames=("shape", "cells"))
def first(
    key: jax.Array, sim: Simulator, shape: E.Shape, cells: int, actions: np.ndarray
) -> E.Training:
    """A `Training` of a `Learner` that has learned nothing, before its first step."""
    table = Table(
        jnp.zeros((cells, len(actions)), jnp.float32),
        jnp.asarray(actions),
        jnp.zeros((shape.m,), jnp.float32),
        jnp.ones((shape.m,), jnp.float32),
    )
    return E.first(key, sim, shape, Learner(table, jnp.full((), -jnp.inf, jnp.float32)))


def actions(n: int, values: int, reach: float) -> np.ndarray:
    """[values^n, n]: a grid of ``n`` latents from -``reach`` to ``reach``, the least first."""
    axis = np.linspace(-reach, reach, values)
    grid = np.stack(np.meshgrid(*[axis] * n, indexing="ij"), axis=-1).reshape(-1, n)
    return grid[np.argsort(np.sum(grid**2, axis=1), kind="stable")].astype(np.float32)


@functools.cache
def grid(cells: tuple[int, ...]) -> Callable[..., jax.Array]:
    """The cell of what is seen [m] at step t, from 0 to prod(``cells``) times the horizon: so many
    ``cells`` of each number, anew at every step.
    """

    def cell(table, seen, t):
        width = jnp.where(table.high > table.low, table.high - table.low, 1)
        count = jnp.asarray(cells, jnp.int32)
        at = jnp.floor((seen - table.low) / width * count.astype(jnp.float32))
        for own, of in zip(jnp.clip(at.astype(jnp.int32), 0, count - 1), cells, strict=True):
            t = t * of + own
        return t

    return cell


@functools.cache
def given(cell: Callable[..., jax.Array], cells: int) -> Callable[..., jax.Array]:
    """The user's ``cell`` of what is seen [m] at step t; a number out of range is that of the
    nearest cell.
    """
    return lambda table, seen, t: jnp.clip(jnp.asarray(cell(seen, t), jnp.int32), 0, cells - 1)


@functools.cache
def lookup(cell: Callable[..., jax.Array], horizon: int) -> Partial:
    """The table as a function of what networks see, in the form of `jast.policies.actor.network`:
    one normal distribution of the latents around the best action.
    """

    def apply(table, inputs):
        best = table.actions[jnp.argmax(_row(cell, horizon, table, inputs))]
        return jnp.concatenate([jnp.zeros((1,), best.dtype), best, jnp.zeros_like(best)])[None]

    return Partial(apply)


def _row(cell, horizon, table, inputs):
    """Q [actions] at ``inputs`` of `jast.policies.actor.see`, whose moments change nothing."""
    t = jnp.round((inputs[-2] + 0.5) * horizon).astype(jnp.int32)
    return table.q[cell(table, inputs[:-2], t)]


def spread(training: E.Training, ranges: np.ndarray | None) -> E.Training:
    """``training`` after the exploration: its grid has the ``ranges`` [m, 2], or those that were
    seen, and what is seen is no longer normalised.
    """
    seen = np.asarray(training.buffer.seen)[: int(training.stored)]
    if ranges is None:  # where nothing was seen that can be learned from, any will do
        seen = seen if len(seen) else np.zeros((1, seen.shape[1]))
        ranges = np.stack([np.min(seen, axis=0), np.max(seen, axis=0)], axis=1)
    low, high = np.asarray(ranges, np.float32).T
    same = Moments(*(jnp.asarray(a) for a in Moments.empty(len(low))))
    table = training.learner.actor._replace(low=low, high=high)
    return training._replace(
        buffer=(),
        learner=training.learner._replace(actor=table),
        net=training.net._replace(inputs=same),
    )


class Rates(NamedTuple):
    """Real-valued settings, float32 and traced."""

    learning_rate: Any
    epsilon: Any
    total: Any
    """Steps of the whole training, over which the learning rate falls."""


@functools.partial(jax.jit, static_argnames=("shape", "cell"))
def stretch(
    key: jax.Array,
    sim: Simulator,
    shape: E.Shape,
    cell: Callable[..., jax.Array],
    rates: Rates,
    training: E.Training,
    steps: int,
) -> tuple[E.Training, E.Count]:
    """``steps`` steps of all lanes, each learned from: ``(Training, Count)``."""
    apply = lookup(cell, sim.horizon)

    def body(_, carry):
        training, count = carry
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 1), training.at))
        left = jnp.clip(1 - training.at.astype(jnp.float32) / rates.total, 0.05, 1)
        draw = functools.partial(_greedy, training.learner.actor.actions, rates.epsilon)
        lanes, rows, valid, more = E.move(
            *keys, sim, shape, apply, training, jnp.asarray(True), draw
        )
        table, loss = _update(training, cell, rates.learning_rate * left, rows, valid)
        training = training._replace(
            lanes=lanes, learner=training.learner._replace(actor=table), at=training.at + 1
        )
        more = more._replace(loss=loss, updates=jnp.ones((), jnp.int32))
        return training, jax.tree.map(jnp.add, count, more)

    return lax.fori_loop(0, steps, body, (training, E.nothing()))


def _greedy(all_actions, epsilon, mixture, noise):
    """The best action, with probability ``epsilon`` any; by n + 1 standard normal numbers."""
    k = len(all_actions)
    any_one = jnp.clip((ndtr(noise[0]) * k).astype(jnp.int32), 0, k - 1)
    return jnp.where(ndtr(noise[-1]) < epsilon, all_actions[any_one], mixture[1][0])


def _update(training, cell, rate, rows, valid):
    """The `Table` after the transitions ``rows`` [lanes], and the mean square of their errors."""
    table = training.learner.actor
    at = jax.vmap(functools.partial(cell, table))
    t = rows.t.astype(jnp.int32)
    here = at(rows.seen, t)
    following = jnp.max(table.q[at(rows.next_seen, t + 1)], axis=1)
    taken = jnp.argmin(
        jnp.sum((rows.z[:, None] - table.actions[None]) ** 2, axis=2), axis=1
    ).astype(jnp.int32)
    # the target of Watkins and Dayan with gamma 1
    last = -training.scale * (rows.potential - rows.approach)
    goal = jnp.where(rows.done, last, following) - 0.5 * jnp.sum(rows.z**2, axis=1)
    goal = jnp.where(valid, goal, 0)
    # lanes that took the same action in the same cell learn their mean, as fast as one by one
    entry = jnp.where(valid, here * len(table.actions) + taken, -1)
    same = (entry[:, None] == entry[None]).astype(jnp.float32)
    number = jnp.sum(same, axis=1)
    old = table.q[here, taken]
    new = old + (1 - (1 - rate) ** number) * (same @ goal / number - old)
    loss = jnp.sum(jnp.where(valid, goal - old, 0) ** 2) / jnp.maximum(
        jnp.sum(valid.astype(jnp.float32)), 1
    )
    place = jnp.where(valid, here, table.q.shape[0])
    return table._replace(q=table.q.at[place, taken].set(new, mode="drop")), loss


@functools.partial(jax.jit, static_argnames=("shape", "cell"))
def tilt(
    key: jax.Array,
    sim: Simulator,
    shape: E.Shape,
    cell: Callable[..., jax.Array],
    training: E.Training,
) -> Tilt:
    """The `Tilt` of the start that the table asks for."""
    table = training.learner.actor
    # before the end of an episode the potential that E.tilt takes from V is 0 here
    value = lambda inputs: jnp.max(_row(cell, sim.horizon, table, inputs))
    return E.tilt(key, sim, shape, training, jnp.zeros(()), value)
