"""Q-learning (Watkins and Dayan 1992) in a table: states in cells, latents of a disturbance on a
grid, so that a failure policy needs no network.

The return of an episode is log p relative to the mode, less lambda times its last miss distance:
V(s) is that of the likeliest way to fail from s. No value is above 0, where the table begins, so
what was not tried yet looks good (Wiewiora 2003 shows that a potential would do no more).
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.heads.heads import Moments
from jast._src.policies import training_state

__all__ = [
    "Rates",
    "Table",
    "action_grid",
    "begin_table_training",
    "greedy_actor",
    "grid_cell",
    "set_ranges",
    "start_value",
    "train",
    "user_cell",
]

CellOf = Callable[..., jax.Array]  # ``cell(table, observation [m], t)``: the number of a cell


class Table(NamedTuple):
    """What Q-learning learns."""

    q: jax.Array
    """[cells, actions] float32: at most 0."""
    actions: jax.Array
    """[actions, n] float32: latents; the least first, which is taken where all are worth the
    same.
    """
    low: jax.Array
    """[m] float32: where the grid of cells begins."""
    high: jax.Array
    """[m] float32: where it ends; whatever is beyond belongs to the last cell."""


class Learner(NamedTuple):
    """A table in the place of networks."""

    actor: Table
    log_alpha: jax.Array
    """-inf: no entropy is rewarded."""


class Rates(NamedTuple):
    """Real-valued settings, float32 and traced."""

    learning_rate: jax.Array
    epsilon: jax.Array
    total: jax.Array
    """Steps of the whole training, over which the learning rate falls."""


@functools.partial(jax.jit, static_argnames=("config", "cells"))
def begin_table_training(
    key: jax.Array, sim: Simulator, config: training_state.Config, cells: int, actions: np.ndarray
) -> training_state.TrainingState:
    """The `TrainingState` before the first step, with a table of zeros."""
    table = Table(
        q=jnp.zeros((cells, len(actions)), jnp.float32),
        actions=jnp.asarray(actions),
        low=jnp.zeros((config.m,), jnp.float32),
        high=jnp.ones((config.m,), jnp.float32),
    )
    learner = Learner(table, jnp.full((), -jnp.inf, jnp.float32))
    return training_state.begin_training(key, sim, config, learner)


def action_grid(n: int, values: int, reach: float) -> np.ndarray:
    """[values^n, n]: a grid of ``n`` latents from -``reach`` to ``reach``, the least first."""
    axis = np.linspace(-reach, reach, values)
    grid = np.stack(np.meshgrid(*[axis] * n, indexing="ij"), axis=-1).reshape(-1, n)
    return grid[np.argsort(np.sum(grid**2, axis=1), kind="stable")].astype(np.float32)


@functools.cache
def grid_cell(cells: tuple[int, ...]) -> CellOf:
    """The `CellOf` a grid with so many ``cells`` of each number observed, anew at every step."""

    def cell(table, observation, t):
        width = jnp.where(table.high > table.low, table.high - table.low, 1)
        count = jnp.asarray(cells, jnp.int32)
        at = jnp.floor((observation - table.low) / width * count.astype(jnp.float32))
        for own, of in zip(jnp.clip(at.astype(jnp.int32), 0, count - 1), cells, strict=True):
            t = t * of + own
        return t

    return cell


@functools.cache
def user_cell(cell: Callable[..., jax.Array], cells: int) -> CellOf:
    """The user's ``cell`` of an observation [m] at step t as a `CellOf`; a number out of range is
    that of the nearest cell.
    """
    return lambda table, observation, t: jnp.clip(
        jnp.asarray(cell(observation, t), jnp.int32), 0, cells - 1
    )


@functools.cache
def greedy_actor(cell: CellOf, horizon: int) -> Partial:
    """The table as a function of the networks' inputs, in the form of an actor of `make_networks`:
    one normal distribution of the latents around the best action.
    """

    def apply(table, inputs):
        best = table.actions[jnp.argmax(_q_row(cell, horizon, table, inputs))]
        return jnp.concatenate([jnp.zeros((1,), best.dtype), best, jnp.zeros_like(best)])[None]

    return Partial(apply)


def _q_row(cell, horizon, table, inputs):
    """Q [actions] at `network_inputs` whose moments change nothing."""
    t = jnp.round((inputs[-2] + 0.5) * horizon).astype(jnp.int32)
    return table.q[cell(table, inputs[:-2], t)]


def set_ranges(
    training: training_state.TrainingState, ranges: np.ndarray | None
) -> training_state.TrainingState:
    """``training`` after the exploration: its grid has the ``ranges`` [m, 2], or those that were
    observed, and observations are no longer normalised.
    """
    observed = np.asarray(training.buffer.observation)[: int(training.stored)]
    if ranges is None:  # where nothing was observed that can be learned from, any will do
        observed = observed if len(observed) else np.zeros((1, observed.shape[1]))
        ranges = np.stack([np.min(observed, axis=0), np.max(observed, axis=0)], axis=1)
    low, high = np.asarray(ranges, np.float32).T
    identity = Moments(*(jnp.asarray(a) for a in Moments.empty(len(low))))
    table = training.learner.actor._replace(low=low, high=high)
    return training._replace(
        learner=training.learner._replace(actor=table),
        normalisation=training.normalisation._replace(inputs=identity),
    )


@functools.partial(jax.jit, static_argnames=("config", "cell"))
def train(
    key: jax.Array,
    sim: Simulator,
    config: training_state.Config,
    cell: CellOf,
    rates: Rates,
    training: training_state.TrainingState,
    steps: int,
) -> tuple[training_state.TrainingState, training_state.Totals]:
    """``steps`` steps of all lanes, each learned from."""
    apply = greedy_actor(cell, sim.horizon)

    def step(training):
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 1), training.step))
        rate = rates.learning_rate * training_state.learning_rate_left(training, rates.total)
        sample = functools.partial(_epsilon_greedy, training.learner.actor.actions, rates.epsilon)
        lanes, rows, valid, totals = training_state.step_lanes(
            *keys, sim, config, apply, training, True, sample
        )
        table, loss = _update(training, cell, rate, rows, valid)
        training = training._replace(
            lanes=lanes, learner=training.learner._replace(actor=table), step=training.step + 1
        )
        return training, totals._replace(loss=loss, updates=jnp.ones((), jnp.int32))

    return training_state.repeat(step, training, steps)


def _epsilon_greedy(actions, epsilon, mixture, noise):
    """The best action, with probability ``epsilon`` any; by n + 1 standard normal numbers."""
    k = len(actions)
    random_one = jnp.clip((ndtr(noise[0]) * k).astype(jnp.int32), 0, k - 1)
    return jnp.where(ndtr(noise[-1]) < epsilon, actions[random_one], mixture[1][0])


def _update(training, cell, rate, rows, valid):
    """The `Table` after the transitions ``rows`` [lanes], and the mean square of their errors."""
    table = training.learner.actor
    cells_of = jax.vmap(functools.partial(cell, table))
    t = rows.t.astype(jnp.int32)
    here = cells_of(rows.observation, t)
    following = jnp.max(table.q[cells_of(rows.next_observation, t + 1)], axis=1)
    distances = jnp.sum((rows.z[:, None] - table.actions[None]) ** 2, axis=2)
    taken = jnp.argmin(distances, axis=1).astype(jnp.int32)
    # the target of Watkins and Dayan with gamma 1
    last = -training.scale * (rows.potential - rows.approach)
    target = jnp.where(rows.done, last, following) - 0.5 * jnp.sum(rows.z**2, axis=1)
    target = jnp.where(valid, target, 0)
    # lanes that took the same action in the same cell learn their mean, as fast as one by one
    entry = jnp.where(valid, here * len(table.actions) + taken, -1)
    same = (entry[:, None] == entry[None]).astype(jnp.float32)
    number = jnp.sum(same, axis=1)
    old = table.q[here, taken]
    new = old + (1 - (1 - rate) ** number) * (same @ target / number - old)
    loss = jnp.sum(jnp.where(valid, target - old, 0) ** 2) / jnp.maximum(
        jnp.sum(valid.astype(jnp.float32)), 1
    )
    place = jnp.where(valid, here, table.q.shape[0])
    return table._replace(q=table.q.at[place, taken].set(new, mode="drop")), loss


@functools.cache
def start_value(cell: CellOf, horizon: int) -> Callable:
    """The best of a row of the table, for `fit_start`."""
    # before the end of an episode the potential that `fit_start` takes from V is 0 here
    return lambda key, training, inputs: jnp.max(
        _q_row(cell, horizon, training.learner.actor, inputs)
    )
