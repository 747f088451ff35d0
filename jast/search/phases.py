"""The two phases of `jast.search.go_explore`, compiled: runs that explore from kept states, and
runs that go on from states of failing episodes.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._jax import jit
from jast.outline import outline
from jast.search import cells as C
from jast.search import kept as K
from jast.search import lockstep as E
from jast.search import restarts as R

__all__ = ["Plan", "Traces", "backward", "explore"]

POINTS = 8
"""States that are kept of a run at most."""
ANEW, NEAREST = 0.1, 0.5
"""Shares of the runs: from the start; from the states that are nearest to failure."""
WIDTHS, PERSISTING = (1.0, 1.0, 1.5, 2.0, 3.0, 4.0), (0.0, 0.0, 0.5, 0.9)
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


@partial(jit, static_argnames="plan")
def explore(key, sim, reward, cell, plan, cells, kept, begin, end):
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


@partial(jit, static_argnames="plan")
def backward(key, sim, reward, plan, kept, traces, begin, end, since, whole):
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
