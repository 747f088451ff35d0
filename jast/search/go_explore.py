"""Go-Explore: keep states, return to them, explore from there; then make the failures likelier from
their ends backwards.

First return, then explore (Ecoffet et al. 2021); for adaptive stress testing, with the backward
algorithm as its second phase, Koren and Kochenderfer 2020. In place of a learned policy the second
phase has a search: from each state of the known failing episode, the later ones first, likelier
ways to a failure.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import _checks
from jast._jax import is_traced, is_tracing
from jast.contract import contract
from jast.counter import generator, tree_keys
from jast.incidents import hosted, incidents, since
from jast.outline import outline
from jast.results import asked
from jast.rewards import as_pytree
from jast.search import cells as C
from jast.search import kept as K
from jast.search import lockstep as E
from jast.search import restarts as R
from jast.search.result import SearchResult
from jast.simulator import Simulator

__all__ = ["go_explore"]

LANES, HOSTED, SLOTS, POINTS = 256, 64, 4096, 8
"""Runs side by side; of a system on the host; states kept; of a run at most so many."""
ANEW, NEAREST = 0.1, 0.5
"""Shares of the runs: from the start; from the states that are nearest to failure."""
WIDTHS, PERSISTING = (1.0, 1.0, 1.5, 2.0, 3.0, 4.0), (0.0, 0.0, 0.5, 0.9)
TRACES, BACK = 4, 0.6
"""Failures that are made likelier side by side; share of that work before it is at the start."""
MOMENTS = 100
COINS = np.uint32(3 << 30)
"""Address of a run's choices, apart from those of its steps."""


class Plan(NamedTuple):
    """What is static."""

    lanes: int
    length: int
    traces: int


class Traces(NamedTuple):
    """Failing episodes, and what is best known of each: P of them."""

    x0: Any
    rows: Any
    length: Any
    reward: Any


def go_explore(
    key: jax.Array,
    sim: Simulator,
    *,
    episodes: int = 100_000,
    length: int | None = None,
    cell: Callable | None = None,
    backward: float = 0.5,
    top: int = 64,
    progress: bool = False,
    callback: Callable | None = None,
) -> SearchResult:
    """Find failures that need many things to go wrong one after another: for long horizons, and for
    systems that do not say how near a failure is.

    States are kept, with the disturbances that led there, the likeliest way to each cell. Runs go
    on from them: half of the runs from the states that are nearest to failure, the others from
    those least gone on from, a few from the start. They draw from the model and, where it has
    quantile functions, from wider and persisting noise. The best failures are then made likelier:
    runs go on from states of the failing episode, first the last ones, later from its start, and
    change some of its disturbances; whatever still fails and is likelier takes its place.

    Args:
        key: consumed.
        sim: the simulator. Its state has to be all that decides what happens next, as always.
        episodes: runs; one from a kept state costs only its new steps (``result.steps`` counts
            those), so compare with other searches at equal steps.
        length: the most steps of a run that explores; default: an eighth of the horizon.
        cell: ``state -> array or pytree of arrays``, preferably whole numbers: states of equal
            value are of one cell. Default: by the step, the rank of the miss distance and two
            random projections of ``observe``.
        backward: share of the runs, from 0 to below 1, that make known failures likelier.
        top: distinct failures kept.
        progress: show a bar.
        callback: called as ``callback(done, total, None)``, in runs.

    Returns:
        `SearchResult`. ``best`` is the likeliest failure, or the episode that came nearest; its
        reward is that of `jast.rewards.standard` with the density relative to the mode (raw, where
        there is none). ``simulation`` of a failure is the number of the run that ended in it.
        KeyboardInterrupt ends the search with what it has.

    Raises:
        ValueError: for a count below 1, ``backward`` outside its range, a ``cell`` that is no
            function, a simulator whose functions do not fit together, and inside of a
            transformation of JAX.

    A system whose miss distance means something only at its end (``episodic``) has no nearest
    states; there cells are told by the step and what is observed.
    """
    name = "go_explore"
    episodes, top = E.whole(name, episodes=episodes, top=top)
    length = (
        max(1, -(-sim.horizon // 8)) if length is None else _checks.whole(name, "length", length)
    )
    expected = "from 0 to below 1"
    backward = _checks.number(name, "backward", backward, lambda v: 0 <= v < 1, expected)
    if cell is not None and not callable(cell):
        raise ValueError(f"{name}: cell must be a function of a state, received {cell!r}"[:200])
    _checks.random_key(name, key)
    if is_traced(key, sim) or is_tracing():
        raise ValueError(f"{name}: cannot be traced; call it outside of jax.jit and jax.vmap")
    contract(sim, observed=False)
    cell = None if cell is None else _cell(name, sim, cell)
    numbers = dict(episodes=episodes, length=min(length, sim.horizon), backward=backward)
    settings = asked(name, key, **numbers)
    size = HOSTED if hosted(sim) else LANES
    lanes = max(8, min(size, 1 << max(0, (episodes // 16).bit_length())))
    plan = Plan(lanes, min(length, sim.horizon), min(TRACES, lanes // 8))
    search = _Search(key, sim, cell, plan, episodes, int(episodes * (1 - backward)))
    before = incidents(sim)
    mark = jax.eval_shape(partial(C.features, sim), outline(sim).state)
    slots = min(SLOTS, max(64, 4 * episodes))
    carry = C.empty(sim, slots), K.none(sim, max(top, 64), mark), None, 0
    stretch = lanes if hosted(sim) else lanes * max(1, episodes // (lanes * MOMENTS))
    ends = [*range(stretch, episodes, stretch), episodes]
    (_, kept, *_), log = E.drive(
        search.chunk,
        carry,
        ends,
        host=hosted(sim),
        progress=progress,
        callback=callback,
        name=name,
    )
    found = K.result(sim, search.reward, log, kept, settings, top)
    return found._replace(incidents=since(before, incidents(sim)))


def _cell(name, sim, cell):
    """``cell`` as what `jax.jit` takes; ValueError where it does not work."""
    try:
        told = jax.eval_shape(cell, outline(sim).state)
    except Exception as error:
        said = f"{name}: cell raised {type(error).__name__} on a state: {error}"
        raise ValueError(said) from error
    if not jax.tree.leaves(told):
        raise ValueError(f"{name}: cell must return numbers, received {told!r}")
    return as_pytree(cell)


class _Search:
    """What does not change while a search runs."""

    def __init__(self, key, sim, cell, plan, episodes, until):
        self.key, self.rng = tree_keys(key, 1)[0], generator(jax.random.fold_in(key, 1))
        self.sim, self.cell, self.plan, self.reward = sim, cell, plan, K.likelihood(sim)
        self.episodes, self.until = episodes, until

    def chunk(self, carry, begin, end):
        """Runs ``begin`` .. ``end - 1``: explore, or, where a failure is known and it is time for
        that, make failures likelier.
        """
        cells, kept, traces, since = carry
        ends = jnp.asarray(begin, jnp.int32), jnp.asarray(end, jnp.int32)
        if traces is None and begin >= self.until and bool(kept.episode.failure[0]):
            traces, since = self._traces(kept), begin
        if traces is None:
            (cells, kept), counted = _explore(
                self.key, self.sim, self.reward, self.cell, self.plan, cells, kept, *ends
            )
        else:
            whole = max(1.0, BACK * (self.episodes - since))
            schedule = (jnp.asarray(v, kept.value.dtype) for v in (since, whole))
            (kept, traces), counted = _backward(
                self.key, self.sim, self.reward, self.plan, kept, traces, *ends, *schedule
            )
        return (cells, kept, traces, since), counted, K.best_of(kept), None

    def _traces(self, kept):
        """The likeliest failure, then by turns the one that ends least like those and the next
        likeliest.
        """
        value, mark, failing = jax.device_get((kept.value, kept.mark, kept.episode.failure))
        n = int((failing & (value > -np.inf)).sum())
        mark = (mark[:n] - mark[:n].mean(axis=0)) / np.maximum(mark[:n].std(axis=0), 1e-6)
        rows, left = [0], list(range(1, n))
        while left and len(rows) < self.plan.traces:
            far = np.abs(mark[left][:, None] - mark[rows][None]).sum(axis=2).min(axis=1)
            rows.append(left.pop(int(np.argmax(far)) if len(rows) % 2 else 0))
        rows = jnp.asarray(np.resize(rows, self.plan.traces))
        e = jax.tree.map(lambda a: a[rows], kept.episode)
        return Traces(e.x0, e.disturbances, e.length, e.reward)


@partial(jax.jit, static_argnames="plan")
def _explore(key, sim, reward, cell, plan, cells, kept, begin, end):
    """Runs ``begin`` .. ``end - 1`` that explore: ((`Cells`, `Kept`), `E.Tally`)."""
    draw, draw_start = R.explore(sim)
    length = plan.length
    way = np.unique(np.linspace(0, length - 1, POINTS).round().astype(np.int32))

    def block(at, carry):
        (cells, kept), counted = carry
        number, live, keys = _lanes(key, plan, at, begin, end)
        noise, coins = _noise(sim, keys)
        slot = C.chosen(cells, coins[:, 0], coins[:, 1], NEAREST)
        anew = (coins[:, 2] < ANEW) | ~jnp.any(cells.live)
        x0 = jax.vmap(lambda k, own: draw_start(k, own, sim.start()))(keys, noise)
        first = jax.vmap(partial(R.started, sim, reward), axis_size=plan.lanes)(x0)
        points = _either(anew, first, jax.tree.map(lambda a: a[slot], cells.points))
        x0 = _either(anew, x0, jax.tree.map(lambda a: a[slot], cells.x0))
        rows = jax.tree.map(lambda a: a[slot], cells.rows)
        until = jnp.where(live, points.t + length, 0)
        ends, new, xs, points_on = R.onward(
            sim, reward, keys, points, until, draw, noise, length, keep=True
        )
        played = R.played(sim, reward, x0, rows, points, ends, new, xs)
        kept = K.merged(
            kept, played, live, number, jax.vmap(partial(C.features, sim))(ends.progress.state)
        )
        counted = E.add(counted, _tally(played, new, live, number))

        seen = cells.seen.at[jnp.where(live & ~anew, slot, len(cells.seen))].add(1, mode="drop")
        good = (way[:, None] < new[None]) & ~points_on.progress.done[way] & live[None]
        flat = lambda a: a[way].reshape(len(way) * plan.lanes, *a.shape[2:])
        lane = jnp.tile(jnp.arange(plan.lanes, dtype=jnp.int32), len(way))
        cells = C.merged(
            sim,
            cell,
            key,
            cells._replace(seen=seen),
            jax.tree.map(flat, points_on),
            good.reshape(-1),
            lane,
            (x0, played.episode.disturbances),
            4 * plan.lanes,
        )
        return (cells, kept), counted

    return _blocks(block, plan, begin, end, (cells, kept))


@partial(jax.jit, static_argnames="plan")
def _backward(key, sim, reward, plan, kept, traces, begin, end, since, whole):
    """Runs ``begin`` .. ``end - 1`` that go on from states of ``traces``, ever earlier ones, as
    many as ``whole`` before they are at the start: ((`Kept`, `Traces`), `E.Tally`).
    """
    draw, draw_start = R.follow(sim)
    p, n = plan.traces, plan.lanes
    own_of = jnp.arange(n, dtype=jnp.int32) % p
    copied = lambda key, t, rows, dist: jax.tree.map(lambda a: a[t], rows)

    def block(at, carry):
        (kept, traces), counted = carry
        number, live, keys = _lanes(key, plan, at, begin, end)
        share = (at.astype(whole.dtype) - since) / whole
        left = jnp.maximum(1 - share, 0) * traces.length.astype(whole.dtype)
        back = jnp.minimum(left.astype(jnp.int32), traces.length - 1)
        first = jax.vmap(partial(R.started, sim, reward), axis_size=p)(traces.x0)
        until = jnp.maximum(back, 0)
        points, steps, _, _ = R.onward(
            sim, reward, keys[:p], first, until, copied, traces.rows, sim.horizon
        )
        mine = jax.tree.map(lambda a: a[own_of], (traces, points, back))
        own = _ways(sim, keys, mine[0], mine[2])
        points, x0 = mine[1], mine[0].x0
        if outline(sim).random_start:
            moved = jax.vmap(lambda k, own: draw_start(k, own, sim.start()))(keys, own)
            whole_way = jnp.broadcast_to(share >= 1, (n,))
            x0 = _either(whole_way, moved, x0)
            points = _either(
                whole_way,
                jax.vmap(partial(R.started, sim, reward), axis_size=plan.lanes)(x0),
                points,
            )
        until = jnp.where(live, sim.horizon, 0)
        ends, new, xs, _ = R.onward(sim, reward, keys, points, until, draw, own, sim.horizon)
        played = R.played(sim, reward, x0, mine[0].rows, points, ends, new, xs)
        kept = K.merged(
            kept, played, live, number, jax.vmap(partial(C.features, sim))(ends.progress.state)
        )
        more = _tally(played, new, live, number)
        counted = E.add(counted, more._replace(steps=more.steps + jnp.sum(steps, dtype=jnp.int32)))
        return (kept, _bettered(traces, played, live)), counted

    return _blocks(block, plan, begin, end, (kept, traces))


def _blocks(block, plan, begin, end, carry):
    """``carry, counted`` after ``block(at, (carry, counted))`` for each block of lanes."""
    _, carry, counted = lax.while_loop(
        lambda c: (c[0] < end) & (c[0] >= begin),
        lambda c: (c[0] + plan.lanes, *block(c[0], c[1:])),
        (begin, carry, E.nothing()),
    )
    return carry, counted


def _lanes(key, plan, at, begin, end):
    """The numbers of the runs from ``at`` on, which of them are live, and their keys."""
    number = at + jnp.arange(plan.lanes, dtype=jnp.int32)
    live = (number < end) & (number >= begin)
    return number, live, jax.vmap(jax.random.fold_in, (None, 0))(key, number)


def _noise(sim, keys):
    """How each run draws, and three more uniform numbers of it."""
    real = outline(sim).dtype
    u = jax.vmap(lambda k: jax.random.uniform(jax.random.fold_in(k, COINS), (5,), real))(keys)
    of = lambda values, u: jnp.asarray(values, real)[(u * len(values)).astype(jnp.int32)]
    return R.Noise(of(WIDTHS, u[:, 3]), of(PERSISTING, u[:, 4])), u[:, :3]


def _ways(sim, keys, traces, back):
    """How each run follows its trace from step ``back`` on: a `R.Follow`."""
    real = outline(sim).dtype
    u = jax.vmap(lambda k: jax.random.uniform(jax.random.fold_in(k, COINS), (5,), real))(keys)
    steps = jnp.maximum(traces.length - back, 1).astype(real)
    rate = jnp.where(u[:, 0] < 0.3, 1.0, steps ** -u[:, 1]).astype(real)
    change = (u[:, 2] * len(R.CHANGES)).astype(jnp.int32)
    size = 10 ** (-3 * u[:, 3])
    noise = R.Noise(0.5 + u[:, 4], jnp.zeros_like(size))
    return R.Follow(noise, traces.rows, traces.x0, traces.length, rate, change, size)


def _bettered(traces, played, live):
    """Each of the P traces, or the likeliest failure of its lanes (k, k + P, ..) if likelier."""
    p, e = traces.length.shape[0], played.episode
    value = jnp.where(e.failure & live, e.reward, -jnp.inf).reshape(-1, p)
    best = jnp.argmax(value, axis=0) * p + jnp.arange(p)
    new = Traces(e.x0, e.disturbances, e.length, e.reward)
    new = jax.tree.map(lambda a: a[best], new)
    return _either(jnp.max(value, axis=0) > traces.reward, new, traces)


def _tally(played, new, live, number):
    """The `E.Tally` of runs of so many new steps."""
    e = played.episode._replace(length=new)
    return E.tally(played._replace(episode=e), live, number)


def _either(pred, a, b):
    return jax.tree.map(lambda a, b: jax.vmap(jnp.where)(pred, a, b), a, b)
