"""Falsification with few runs: is there any failure at all? Signals of few pieces first, then
changes of stretches of the nearest ones.

A search of its own, of the family of steady-state evolutionary algorithms (Whitley 1989, The
GENITOR algorithm and selection pressure). An episode is the quantile levels u of its disturbances,
in [0, 1]: what a requirement over time asks for is rarely noise that is new at each step, but a
level that is held, at an end of its range for some seconds.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, PathLike, PRNGKey
from jast._src.normal_space.transform import Outcomes, check, normal_numbers, outcome, played
from jast._src.runtime._jax import jit
from jast._src.runtime.host_errors import in_full_batches
from jast._src.search.best_episodes import standard_reward
from jast._src.search.driver import Log, finish, require_counts, require_host, run
from jast._src.search.lanes import NEVER, Tally
from jast._src.search.result import SearchResult
from jast._src.util.display import call_settings
from jast._src.util.pytrees import count_numbers, index_tree, join_rows, map_in_lanes

__all__ = ["falsify"]

LANES = 64  # failures whose normal numbers one program, of one shape, makes
TAIL = 3e-5  # probability beyond what is taken for an end of a range: 4 standard deviations
BATCH = 10  # simulations side by side
FIRST_SIGNALS = 30  # signals of few pieces that are drawn before any is changed
POOL = 10  # nearest signals that are kept to be changed
PIECES = 1, 2, 3, 5, 10  # numbers of pieces of the first signals, beside one piece a step
CROSSOVER = 0.3  # share of the children that have two parents
STEP = 0.25  # standard deviation of a move of u
MORE_CHANGES = 0.7  # mean number of the changes of a child beyond the first
ONE_COLUMN = 0.6  # share of the changes of one number of the disturbance; the others are of all
MOVED_AS_ONE = 0.35  # share of the changes that move a stretch by one amount, which keeps its shape
MOVED_APART = 0.25  # share of those that move each of its steps by itself
HELD_ANYWHERE = 0.2  # share of those that hold it at a level drawn anew; the others, at an end


class Pool(NamedTuple):
    """The nearest episodes, by rising miss distance."""

    score: np.ndarray
    """[m] what they rank by: the miss distance, -1 for a failure, inf where invalid."""
    rows: np.ndarray
    """[m, horizon, k]: u of the disturbances"""
    first: np.ndarray
    """[m, k0]: u of the start"""
    length: np.ndarray
    """[m] steps: what is beyond decided nothing"""


class State(NamedTuple):
    """A search so far."""

    pool: Pool
    numbers: np.ndarray
    """[m] of the failing episodes"""
    failing: np.ndarray
    """[m, D] their u"""


def falsify(
    key: PRNGKey,
    sim: Simulator,
    *,
    simulations: int = 300,
    batch: int | None = None,
    stop: bool = True,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> SearchResult:
    """Find a failure with few simulations, however unlikely it is.

    The first 30 signals consist of few pieces, half of them at the ends of the disturbances' ranges
    (the levels 3e-5 and 1 - 3e-5). Then come children of the ten nearest episodes. A child is made
    of two of them, one up to a step and the other from there on, or of one, with a stretch of its
    steps moved, held at another level, or held at an end of its range. Finding the likeliest
    failure is left to the other searches.

    ``history.best_reward`` is minus the least miss distance so far.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        simulations: the most that are run.
        batch: simulations side by side; with 1, each learns from all before it. Default: 10; of a
            black box with workers the least multiple of their number from 10 on.
        stop: end with the batch that has the first failure.
        top: distinct failures kept.
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)``, in simulations, after each batch.
        checkpoint: a folder that keeps finished batches. The same call then goes on where it was
            stopped, to the same result.

    Returns:
        `SearchResult`, whose ``first_failure`` is how many simulations it took. Failures are ranked
        by log p (relative to the mode, where there is one).

    Raises:
        ValueError: for a count below 1, disturbances without a quantile function, a simulator whose
            functions do not fit together, and inside a transformation of JAX.

    Example:
        >>> import jax, jast
        >>> result = jast.search.falsify(jax.random.key(0), jast.simulators.walk1d())
        >>> int(result.first_failure) <= 30
        True
    """
    name = "falsify"
    if batch is None:
        batch = in_full_batches(sim, BATCH)
    simulations, batch, top = require_counts(name, simulations=simulations, batch=batch, top=top)
    require_host(name, key, sim)
    check(name, sim)
    given = dict(simulations=simulations, batch=batch, stop=int(stop))
    settings = call_settings(name, key, **given)
    search = _Search(sim, settings["seed"], batch, top)
    ends = [*range(batch, simulations, batch), simulations]
    watched = dict(progress=progress, callback=callback, checkpoint=checkpoint)
    return run(key, search, ends, settings, stop_at_failure=bool(stop), **watched)


class _Search:
    """A `search.driver.Search`."""

    def __init__(self, sim: Simulator, seed: Any, batch: int, top: int):
        like = signature_of(sim)
        self.sim, self.reward, self.top = sim, standard_reward(sim), top
        self.seed, self.batch = seed, batch
        self.start_size, self.step_size = count_numbers(like.x0), count_numbers(like.x)

    def init(self) -> State:
        horizon, k, k0 = self.sim.horizon, self.step_size, self.start_size
        rows, first = np.zeros((0, horizon, k)), np.zeros((0, k0))
        pool = Pool(np.zeros(0), rows, first, np.zeros(0, np.int32))
        return State(pool, np.zeros(0, np.int64), np.zeros((0, k0 + horizon * k)))

    def step(self, state: State, begin: int, end: int) -> tuple[State, Tally, np.ndarray, None]:
        """One more batch."""
        n, pool = end - begin, state.pool
        rng = np.random.default_rng([*self.seed, begin])
        signals = [signal(rng, pool, begin + i) for i in range(n)]
        rows, first = (np.stack(a) for a in zip(*signals, strict=True))
        u = np.concatenate([first, rows.reshape(n, -1)], axis=1)
        lanes = np.pad(u, ((0, self.batch - n), (0, 0)), mode="edge")
        o = jax.device_get(_outcomes(self.sim, lanes.astype(normal_numbers(self.sim))))
        o = index_tree(o, np.s_[:n])
        score = np.where(o.invalid, np.inf, np.where(o.failure, -1, o.distance))
        pool = join_rows(pool, Pool(score, rows, first, o.length))
        pool = index_tree(pool, np.argsort(pool.score, kind="stable")[:POOL])
        failing = np.flatnonzero(o.failure)
        tally = Tally(
            episodes=n,
            steps=o.length.sum(),
            failures=len(failing),
            invalid=o.invalid.sum(),
            first=begin + failing[0] + 1 if len(failing) else NEVER,
            failing=np.array([len(failing) > 0]),
        )
        numbers = np.concatenate([state.numbers, begin + failing])
        state = State(pool, numbers, np.concatenate([state.failing, u[failing]]))
        return state, tally, np.array([-max(pool.score[0], 0)]), None

    def result(self, state: State, log: Log, settings: dict[str, Any]) -> SearchResult:
        pool, numbers = state.pool, state.numbers
        nearest = np.concatenate([pool.first[0], pool.rows[0].ravel()])
        u = state.failing if len(numbers) else nearest[None]
        normal = map_in_lanes(LANES, _normal, u.astype(normal_numbers(self.sim)))
        e = played(self.sim, normal)
        failing = index_tree(e, np.s_[: len(numbers)])
        return finish(self, log, index_tree(e, 0), failing, numbers, settings=settings)


@jit
def _outcomes(sim: Simulator, u: jax.Array) -> Outcomes:
    """`Outcomes` [n] of the levels ``u`` [n, D]."""
    return jax.vmap(partial(outcome, sim))(_normal(u))


@jax.jit
def _normal(u: jax.Array) -> jax.Array:
    return jax.scipy.special.ndtri(jnp.clip(u, TAIL, 1 - TAIL))


def signal(rng: np.random.Generator, pool: Pool, number: int) -> tuple[np.ndarray, np.ndarray]:
    """The episode of this ``number``: levels of the disturbances [horizon, k] and of the start
    [k0].
    """
    m, horizon, k = pool.rows.shape
    k0 = pool.first.shape[1]
    if number < FIRST_SIGNALS or not m:
        return _few_pieces(rng, horizon, k, k0)
    parent = int(m * rng.uniform() ** 2)  # rather a near one
    rows, first = pool.rows[parent].copy(), pool.first[parent].copy()
    length = max(int(pool.length[parent]), 1)
    if rng.uniform() < CROSSOVER and length > 1:
        at = rng.integers(1, length)
        rows[at:] = pool.rows[rng.integers(m)][at:]
    for _ in range(1 + rng.poisson(MORE_CHANGES) if k else 0):
        _change(rng, rows, length)
    if k0 and (k == 0 or rng.uniform() < 0.5):
        first = np.clip(first + STEP * rng.normal(size=k0), 0, 1)
    return rows, first


def _change(rng: np.random.Generator, rows: np.ndarray, length: int) -> None:
    """Move or hold a stretch of ``rows`` [horizon, k], in place; a short one rather than a long
    one, within the first ``length`` steps at its begin.
    """
    k = rows.shape[1]
    begin = rng.integers(length)
    end = begin + 1 + int(length / 3 * rng.uniform() ** 2)
    columns = [rng.integers(k)] if rng.uniform() < ONE_COLUMN else range(k)
    kind = rng.uniform()
    moved = MOVED_AS_ONE + MOVED_APART
    for column in columns:
        part = rows[begin:end, column]
        if kind < moved:
            size = 1 if kind < MOVED_AS_ONE else len(part)
            part = np.clip(part + STEP * rng.normal(size=size), 0, 1)
        else:
            part = rng.uniform() if kind < moved + HELD_ANYWHERE else rng.integers(2)
        rows[begin:end, column] = part


def _few_pieces(
    rng: np.random.Generator, horizon: int, k: int, k0: int
) -> tuple[np.ndarray, np.ndarray]:
    """An episode of few pieces, held each, at the ends of their ranges or anywhere."""
    pieces = min(rng.choice([*PIECES, horizon]), horizon)
    cuts = np.sort(rng.choice(np.arange(1, horizon), pieces - 1, replace=False))
    levels, first = rng.uniform(size=(pieces, k)), rng.uniform(size=k0)
    if rng.uniform() < 0.5:
        levels, first = np.round(levels), np.round(first)
    return levels[np.searchsorted(cuts, np.arange(horizon), side="right")], first
