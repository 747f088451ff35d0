"""Paths of episodes on the device, each from where it branched off: one compiled program simulates
however many of them, and each is resumed from a stored state.

A path keeps its states and scores from its own branching on, and nothing before that: levels only
rise, so nobody branches earlier. That is one state a step of each path, in place of all the
disturbances and a second simulation up to the branching.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core.counter_prng import counter_key
from jast._src.core.rewards import log_likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.transition import Progress, advance, begin, blank, conclude
from jast._src.estimate.splitting.levels import FRESH, NAME, Played
from jast._src.runtime._jax import jit
from jast._src.runtime.memory import require, size
from jast._src.util.pytrees import index_tree, select

__all__ = ["DevicePaths", "require_paths"]

LANES = 128
"""Paths that are simulated side by side: their states then stay in the caches of a core."""


class Store(NamedTuple):
    """What the paths keep, a row a step from their branchings on; stale behind their ends."""

    states: Any
    """[T + 1, n, ...]"""
    scores: jax.Array
    """[T + 1, n]: inf at a failure, -inf where nothing is known"""
    begun: jax.Array
    """[n] int32: the step of the first row"""


class Lane(NamedTuple):
    """A path at its newest state."""

    state: Any
    score: jax.Array
    t: jax.Array
    top: jax.Array
    """Greatest score so far"""
    done: jax.Array
    invalid: jax.Array
    undefined: jax.Array
    """int32: scores of a user's function that were NaN"""


class DevicePaths:
    """``n`` paths of a simulator in JAX."""

    def __init__(self, key: jax.Array, sim: Simulator, score: Callable | None, n: int):
        self.sim, self.score, self.n = sim, score, n
        self.key, self.times = counter_key(key, 1), 0
        signature, rows = signature_of(sim), sim.horizon + 1
        states = jax.tree.map(lambda s: np.zeros((rows, n, *s.shape), s.dtype), signature.state)
        scores = np.zeros((rows, n), signature.dtype)
        self.store = jax.device_put(Store(states, scores, np.zeros(n, np.int32)))

    def play(self, paths: np.ndarray, parents: np.ndarray, level: float) -> Played:
        """As `levels.Paths`."""
        m = len(paths)

        def padded(rows):
            return np.concatenate([rows, np.full(self.n - m, self.n)]).astype(np.int32)

        self.store, *found = _play(
            self.store,
            self.key,
            np.int32(self.times),
            self.sim,
            self.score,
            padded(paths),
            padded(parents),
            np.asarray(level, self.store.scores.dtype),
            np.int32(m),
        )
        self.times += 1
        top, invalid, steps, undefined = jax.device_get(found)
        return Played(top[:m], invalid[:m], int(steps[:m].sum()), int(undefined[:m].sum()))


def require_paths(sim: Simulator, n: int) -> None:
    """ValueError where the states of ``n`` paths do not fit into memory."""
    signature = signature_of(sim)
    row = size(signature.state) + np.dtype(signature.dtype).itemsize
    needed = 2 * n * (sim.horizon + 1) * row
    require(NAME, needed, f"the states of {n} episodes", "use fewer particles")


@partial(jit, donate_argnums=0)
def _play(store, key, time, sim, score, paths, parents, level, m):
    """The store and what came of the first ``m`` of ``paths`` [n]: (top, invalid, steps, undefined
    scores) [n]. Those of parents `FRESH` are new episodes, others branch off their parents at the
    first state whose score is above ``level``.
    """
    key = jax.random.fold_in(key, time)
    n = len(paths)
    width = -(-n // -(-n // LANES))
    blocks = -(-m // width)
    pad = (0, -n % width)
    numbers = jnp.arange(n + pad[1], dtype=jnp.int32)
    paths, parents = (jnp.pad(a, pad, constant_values=n) for a in (paths, parents))

    def rows_of(i):
        return lax.dynamic_slice(numbers, (i * width,), (width,))

    def branching(i, rows):
        """The row of the store at which each branches off, and its step."""
        at = rows_of(i)
        parent = parents[at]
        row = jnp.argmax(store.scores[:, parent] > level, axis=0).astype(jnp.int32)
        row = jnp.where(parent == FRESH, 0, row)
        step = jnp.where(parent == FRESH, 0, store.begun[parent] + row)
        step = jnp.where(at < m, step, sim.horizon + 1)
        return tuple(a.at[at].set(b) for a, b in zip(rows, (row, step), strict=True))

    row, step = lax.fori_loop(0, blocks, branching, (jnp.zeros_like(numbers), numbers * 0 + 2**30))
    # those of about as many steps run side by side
    order = jnp.argsort(step).astype(jnp.int32)

    def block(i, carry):
        store, out = carry
        at = order[rows_of(i)]
        keys = jax.vmap(partial(jax.random.fold_in, key))(at)
        first = jax.vmap(partial(_first, sim, score))(
            keys,
            parents[at] == FRESH,
            index_tree(store.states, (row[at], parents[at])),
            store.scores[row[at], parents[at]],
            step[at],
            at < m,
        )
        store, last = _run(sim, score, store, keys, paths[at], first)
        found = last.top, last.invalid, last.t - first.t, last.undefined
        out = tuple(a.at[at].set(b) for a, b in zip(out, found, strict=True))
        return store, out

    zeros = jnp.zeros_like(numbers)
    out = zeros.astype(store.scores.dtype), zeros.astype(bool), zeros, zeros
    store, out = lax.fori_loop(0, blocks, block, (store, out))
    return store, *out


def _first(sim, score, key, fresh, state, value, t, live):
    """The `Lane` that begins at a new start, or at a stored state; done where not ``live``."""
    start = begin(sim, log_likelihood, D.sample(sim.start(), jax.random.fold_in(key, 0)))
    new = _lane(score, start, 0)
    ended = (value == jnp.inf) | (t >= sim.horizon) | jnp.asarray(sim.is_terminal(state))
    no = jnp.zeros((), bool)
    old = Lane(state, value, t, value, ended, no, jnp.zeros((), jnp.int32))
    lane = select(fresh, new, old)
    return lane._replace(done=lane.done | ~live)


def _run(sim, score, store, keys, paths, first):
    """The store with these lanes run to their ends, and their last `Lane`."""

    def write(store, i, lanes):
        # the rows of a path beyond n, which nobody has, are dropped
        states = jax.tree.map(
            lambda a, b: a.at[i, paths].set(b, mode="drop"), store.states, lanes.state
        )
        scores = store.scores.at[i, paths].set(lanes.score, mode="drop")
        return store._replace(states=states, scores=scores)

    def body(carry):
        store, lanes, i = carry
        new = jax.vmap(partial(_next, sim, score))(keys, lanes)
        return write(store, i, new), new, i + 1

    store = write(store, 0, first)
    store = store._replace(begun=store.begun.at[paths].set(first.t, mode="drop"))
    store, last, _ = lax.while_loop(
        lambda carry: ~carry[1].done.all(), body, (store, first, jnp.ones((), jnp.int32))
    )
    return store, last


def _next(sim, score, key, lane):
    """The `Lane` one step on; an ended one stays as it is."""
    x = D.sample(sim.disturbance(lane.state), jax.random.fold_in(key, lane.t + 1))
    after = advance(sim, log_likelihood, blank(sim, lane.state), x, lane.t + 1 >= sim.horizon)
    new = _lane(score, conclude(sim, log_likelihood, after), lane.t + 1)
    new = new._replace(top=jnp.maximum(lane.top, new.top), undefined=lane.undefined + new.undefined)
    return select(lane.done, lane, new)


def _lane(score, progress: Progress, t):
    """The `Lane` at a state; its score is the user's, or minus its own miss distance."""
    value = -progress.distance if score is None else jnp.asarray(score(progress.state))
    value, most = value.astype(progress.distance.dtype), jnp.finfo(progress.distance.dtype).max
    undefined = jnp.isnan(value) & ~progress.invalid
    value = jnp.where(jnp.isnan(value), -jnp.inf, jnp.minimum(value, most))
    value = jnp.where(progress.failure, jnp.inf, jnp.where(progress.invalid, -jnp.inf, value))
    return Lane(
        state=progress.state,
        score=value,
        t=jnp.asarray(t, jnp.int32),
        top=value,
        done=progress.done,
        invalid=progress.invalid,
        undefined=undefined.astype(jnp.int32),
    )
