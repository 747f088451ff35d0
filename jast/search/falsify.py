"""Falsification with few runs: is there any failure at all? Signals of few pieces first, then
changes of stretches of the nearest ones.

A search of its own, of the family of steady-state evolutionary algorithms (Whitley 1989, The
GENITOR algorithm and selection pressure). An episode is the quantile levels u of its disturbances,
in [0, 1]: what a requirement over time asks for is rarely noise that is new at each step, but a
level that is held, at an end of its range for some seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import _checks
from jast._jax import is_traced, is_tracing, jit
from jast._threads import run_in_thread
from jast.incidents import incidents, new_incidents, runs_on_host
from jast.limit_state import check, normal_numbers, outcome, played
from jast.outline import outline
from jast.pytrees import count_numbers, map_in_lanes
from jast.results import call_settings
from jast.search import kept as K
from jast.search import lockstep as E
from jast.search.result import History, SearchResult
from jast.simulator import Simulator
from jast.watch import Watch, in_pieces

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback

__all__ = ["falsify"]

AT_ONCE = 64
"""Failures whose normal numbers one program, of one shape, makes."""
TAIL = 3e-5
"""Probability beyond what is taken for an end of a disturbance's range."""
FRESH, POOL = 30, 10
"""Signals that are drawn before any is changed, and how many are kept to be changed."""
PIECES = 1, 2, 3, 5, 10
CROSSED, STEP = 0.3, 0.25
"""The share of children of two parents, and the deviation of a change of u."""


class _Pool(NamedTuple):
    """The nearest episodes, by rising miss distance."""

    score: np.ndarray
    """[m]"""
    rows: np.ndarray
    """[m, horizon, k]: u of the disturbances"""
    first: np.ndarray
    """[m, k0]: u of the start"""
    length: np.ndarray
    """[m] steps: what is beyond decided nothing"""


class _Found(NamedTuple):
    """A search so far."""

    pool: _Pool
    failing: tuple
    """(number, u [D]) of each failure"""
    counts: tuple[int, int, int, int]
    """Episodes, steps, failures, invalid ones"""
    moments: tuple
    """After each batch: episodes, minus the least distance [1], failures"""


def falsify(
    key: chex.PRNGKey,
    sim: Simulator,
    *,
    simulations: int = 300,
    batch: int = 10,
    stop: bool = True,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
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
        batch: simulations side by side; with 1, each learns from all before it.
        stop: end with the batch that has the first failure.
        top: distinct failures kept.
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)``, in simulations, after each batch.

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
    simulations, batch, top = E.whole(name, simulations=simulations, batch=batch, top=top)
    _checks.check_random_key(name, key)
    if is_traced(key, sim) or is_tracing():
        raise ValueError(f"{name}: cannot be traced; call it outside of jax.jit and jax.vmap")
    check(name, sim)
    settings = call_settings(name, key, simulations=simulations, batch=batch, stop=int(stop))
    work, before = _Work(sim, settings["seed"], batch, bool(stop)), incidents(sim)
    watch = Watch(name, simulations, "sim", progress, callback)
    found, done = in_pieces(work, work.nothing(), work.ends(simulations), watch)
    if done < simulations and not work.over:
        settings |= dict(interrupted=f"after {done} of {simulations} episodes")
    result = _result(sim, found, settings, top)
    return result._replace(incidents=new_incidents(before, incidents(sim)))


class _Work:
    """What does not change while a search runs, but whether it is ``over``."""

    def __init__(self, sim: Simulator, seed: Any, batch: int, stop: bool):
        about = outline(sim)
        self.sim, self.seed, self.batch, self.stop, self.over = sim, seed, batch, stop, False
        self.k0, self.k, self.dtype = (
            count_numbers(about.x0),
            count_numbers(about.x),
            normal_numbers(sim),
        )

    def nothing(self) -> _Found:
        rows, first = np.zeros((0, self.sim.horizon, self.k)), np.zeros((0, self.k0))
        return _Found(_Pool(np.zeros(0), rows, first, np.zeros(0, int)), (), (0, 0, 0, 0), ())

    def ends(self, simulations: int) -> Iterator[int]:
        for begin in range(0, simulations, self.batch):
            if not self.over:
                yield min(begin + self.batch, simulations)

    def __call__(self, found: _Found, begin: int, end: int) -> _Found:
        """One more batch."""
        n, pool = end - begin, found.pool
        rng = np.random.default_rng([*self.seed, begin])
        signals = [_signal(rng, pool, begin + i, pool.rows.shape[1:], self.k0) for i in range(n)]
        rows, first = (np.stack(a) for a in zip(*signals, strict=True))
        u = np.concatenate([first, rows.reshape(n, -1)], axis=1)
        lanes = np.pad(u, ((0, self.batch - n), (0, 0)), mode="edge")
        ask = lambda: jax.device_get(_judged(self.sim, lanes.astype(self.dtype)))
        o = jax.tree.map(lambda a: a[:n], run_in_thread(ask) if runs_on_host(self.sim) else ask())
        score = np.where(o.invalid, np.inf, np.where(o.failure, -1, o.distance))
        new = score, rows, first, o.length
        every = (np.concatenate(p) for p in zip(pool, new, strict=True))
        every = _Pool(*every)
        best = np.argsort(every.score, kind="stable")[:POOL]
        pool = jax.tree.map(lambda a: a[best], every)
        failing = tuple((begin + int(i), u[i]) for i in np.flatnonzero(o.failure))
        counts = n, int(o.length.sum()), len(failing), int(o.invalid.sum())
        counts = tuple(a + b for a, b in zip(found.counts, counts, strict=True))
        self.over = self.stop and counts[2] > 0
        moment = end, np.array([-max(pool.score[0], 0)]), counts[2]
        return _Found(pool, found.failing + failing, counts, (*found.moments, moment))


@jit
def _judged(sim: Simulator, u: jax.Array) -> Any:
    """`Outcomes` [n] of the levels ``u`` [n, D]."""
    return jax.vmap(partial(outcome, sim))(_normal(u))


@jax.jit
def _normal(u: jax.Array) -> jax.Array:
    return jax.scipy.special.ndtri(jnp.clip(u, TAIL, 1 - TAIL))


def _signal(
    rng: np.random.Generator, pool: _Pool, i: int, shape: tuple[int, int], k0: int
) -> tuple[np.ndarray, np.ndarray]:
    """The ``i``-th episode: levels of the disturbances [horizon, k] and of the start [k0]."""
    if i < FRESH or not len(pool.score):
        return _drawn(rng, *shape, k0)
    m = len(pool.score)
    parent = int(m * rng.uniform() ** 2)  # rather a near one
    rows, first = pool.rows[parent].copy(), pool.first[parent].copy()
    length, k = max(int(pool.length[parent]), 1), shape[1]
    if rng.uniform() < CROSSED and length > 1:
        at = rng.integers(1, length)
        rows[at:] = pool.rows[rng.integers(m)][at:]
    for _ in range(1 + rng.poisson(0.7) if k else 0):
        begin = rng.integers(length)
        end = begin + 1 + int(length / 3 * rng.uniform() ** 2)
        columns = [rng.integers(k)] if rng.uniform() < 0.6 else range(k)
        kind = rng.uniform()
        for c in columns:
            part = rows[begin:end, c]
            if kind < 0.6:  # moved, as one or each by itself
                size = 1 if kind < 0.35 else len(part)
                part = np.clip(part + STEP * rng.normal(size=size), 0, 1)
            else:  # held
                part = rng.uniform() if kind < 0.8 else rng.integers(2)
            rows[begin:end, c] = part
    if k0 and (k == 0 or rng.uniform() < 0.5):
        first = np.clip(first + STEP * rng.normal(size=k0), 0, 1)
    return rows, first


def _drawn(
    rng: np.random.Generator, horizon: int, k: int, k0: int
) -> tuple[np.ndarray, np.ndarray]:
    """An episode of few pieces, held each, at the ends of their ranges or anywhere."""
    pieces = min(rng.choice([*PIECES, horizon]), horizon)
    cuts = np.sort(rng.choice(np.arange(1, horizon), pieces - 1, replace=False))
    levels, first = rng.uniform(size=(pieces, k)), rng.uniform(size=k0)
    if rng.uniform() < 0.5:
        levels, first = np.round(levels), np.round(first)
    return levels[np.searchsorted(cuts, np.arange(horizon), side="right")], first


def _result(sim: Simulator, found: _Found, settings: dict, top: int) -> SearchResult:
    reward, pool = K.likelihood(sim), found.pool
    points = [u for _, u in found.failing] or [
        np.concatenate([pool.first[0], pool.rows[0].ravel()])
    ]
    points = np.stack(points).astype(normal_numbers(sim))
    e = played(sim, map_in_lanes(AT_ONCE, _normal, points))
    numbers = [i for i, _ in found.failing]
    failing = jax.tree.map(lambda a: a[: len(numbers)], e)
    ends, best, failures = zip(*found.moments, strict=True)
    first = numbers[0] + 1 if numbers else E.NEVER
    log = E.Log(
        E.Tally(*found.counts, first, np.array([bool(numbers)])),
        History(np.array(ends), np.array(best), np.array(failures)),
        settings.get("interrupted"),
        None,
    )
    nearest = jax.tree.map(lambda a: a[0], e)
    of = [0] * len(numbers), numbers, [1] * len(numbers)
    return E.finish(sim, reward, log, nearest, failing, *of, settings, top)
