"""The two phases of `jast.search.go_explore`, compiled: runs that explore from kept states, and
runs that go on from states of failing episodes.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.signature import signature_of
from jast._src.runtime._jax import jit
from jast._src.search.go_explore.archive import choose_cells, features, merge_cells
from jast._src.search.go_explore.continued_runs import (
    CHANGES,
    Follow,
    Noise,
    continue_runs,
    exploring_draws,
    following_draws,
    played_runs,
    start_point,
)
from jast._src.search.lanes import Tally, in_blocks
from jast._src.util.pytrees import index_tree, merge_axes, select, select_rows

__all__ = ["Plan", "improve_backward", "explore"]

POINTS = 8  # states that are kept of a run at most
FROM_START = 0.1  # share of the runs that are from the start
WIDTHS = 1.0, 1.0, 1.5, 2.0, 3.0, 4.0  # of the noise of a run: a third draw from the model
PERSISTING = 0.0, 0.0, 0.5, 0.9  # shares of the noise of a run that are the same at every step
COINS = np.uint32(3 << 30)  # address of a run's choices, apart from those of its steps


class Plan(NamedTuple):
    """What is static."""

    lanes: int
    """Runs side by side."""
    length: int
    """The most steps of a run that explores."""
    traces: int
    """Failures that are made likelier side by side."""


@partial(jit, static_argnames="plan")
def explore(key, sim, reward, cell, plan, cells, best, begin, end):
    """Runs ``begin`` .. ``end - 1`` that explore: ((`Cells`, `BestEpisodes`), `Tally`)."""
    draw, draw_start = exploring_draws(sim)
    length = plan.length
    way = np.unique(np.linspace(0, length - 1, POINTS).round().astype(np.int32))

    def block(number, live, carry):
        cells, best = carry
        keys, coins = _keys_and_coins(sim, key, number)
        noise = _noise(coins)
        slot = choose_cells(cells, coins[:, 0], coins[:, 1])
        anew = (coins[:, 2] < FROM_START) | ~jnp.any(cells.live)
        x0 = jax.vmap(lambda k, own: draw_start(k, own, sim.start()))(keys, noise)
        first = jax.vmap(partial(start_point, sim, reward), axis_size=plan.lanes)(x0)
        kept = index_tree(cells, slot)
        points, x0 = select_rows(anew, (first, x0), (kept.points, kept.x0))
        until = jnp.where(live, points.t + length, 0)
        ends, new, xs, points_on = continue_runs(
            sim, reward, keys, points, until, draw, noise, length, keep=True
        )
        played = played_runs(sim, reward, x0, kept.rows, points, ends, new, xs)
        mark = jax.vmap(partial(features, sim))(ends.progress.state)
        best = best.merge(played, live, number, mark)

        seen = cells.seen.at[jnp.where(live & ~anew, slot, len(cells.seen))].add(1, mode="drop")
        good = (way[:, None] < new[None]) & ~points_on.progress.done[way] & live[None]
        # the points on the way [m, N] in a row, and the lane of each
        rows = merge_axes(index_tree(points_on, way))
        lane = jnp.tile(jnp.arange(plan.lanes, dtype=jnp.int32), len(way))
        new_ones = rows, good.reshape(-1), lane, (x0, played.episode.disturbances)
        cells = cells._replace(seen=seen)
        cells = merge_cells(sim, cell, key, cells, *new_ones, 4 * plan.lanes)
        return (cells, best), _tally(played, new, live, number)

    return in_blocks(block, plan.lanes, begin, end, (cells, best))


@partial(jit, static_argnames="plan")
def improve_backward(key, sim, reward, plan, best, traces, begin, end, since, whole):
    """Runs ``begin`` .. ``end - 1`` that go on from states of ``traces``, P failing episodes, ever
    earlier ones, as many as ``whole`` before they are at the start: ((`BestEpisodes`, what is then
    best known of each trace), `Tally`).
    """
    draw, draw_start = following_draws(sim)
    p, n = plan.traces, plan.lanes
    own_of = jnp.arange(n, dtype=jnp.int32) % p

    def block(number, live, carry):
        best, traces = carry
        keys, coins = _keys_and_coins(sim, key, number)
        share = (number[0].astype(whole.dtype) - since) / whole
        left = jnp.maximum(1 - share, 0) * traces.length.astype(whole.dtype)
        back = jnp.minimum(left.astype(jnp.int32), traces.length - 1)
        first = jax.vmap(partial(start_point, sim, reward), axis_size=p)(traces.x0)
        until = jnp.maximum(back, 0)
        points, steps, _, _ = continue_runs(
            sim, reward, keys[:p], first, until, _copied, traces.disturbances, sim.horizon
        )
        mine, points, back = index_tree((traces, points, back), own_of)
        own, x0 = _ways(coins, mine, back), mine.x0
        if signature_of(sim).random_start:
            moved = jax.vmap(lambda k, own: draw_start(k, own, sim.start()))(keys, own)
            x0 = select(share >= 1, moved, x0)
            first = jax.vmap(partial(start_point, sim, reward), axis_size=n)(x0)
            points = select(share >= 1, first, points)
        until = jnp.where(live, sim.horizon, 0)
        ends, new, xs, _ = continue_runs(sim, reward, keys, points, until, draw, own, sim.horizon)
        played = played_runs(sim, reward, x0, mine.disturbances, points, ends, new, xs)
        mark = jax.vmap(partial(features, sim))(ends.progress.state)
        best = best.merge(played, live, number, mark)
        more = _tally(played, new, live, number)
        more = more._replace(steps=more.steps + jnp.sum(steps, dtype=jnp.int32))
        return (best, _bettered(traces, played, live)), more

    return in_blocks(block, plan.lanes, begin, end, (best, traces))


def _copied(key, t, rows, dist):
    return index_tree(rows, t)


def _keys_and_coins(sim, key, number):
    """The keys of the runs of these numbers, and five uniform numbers of each."""
    keys, real = jax.vmap(jax.random.fold_in, (None, 0))(key, number), signature_of(sim).dtype
    coins = jax.vmap(lambda k: jax.random.uniform(jax.random.fold_in(k, COINS), (5,), real))
    return keys, coins(keys)


def _noise(u):
    """How each run draws, by two of its uniform numbers ``u`` [N, 5]."""
    real = u.dtype
    widths, shares = jnp.asarray(WIDTHS, real), jnp.asarray(PERSISTING, real)
    width = widths[(u[:, 3] * len(WIDTHS)).astype(jnp.int32)]
    return Noise(width, shares[(u[:, 4] * len(PERSISTING)).astype(jnp.int32)])


def _ways(u, traces, back):
    """How each run follows its trace from step ``back`` on, by its uniform numbers ``u`` [N, 5]: a
    `Follow`.
    """
    steps = jnp.maximum(traces.length - back, 1).astype(u.dtype)
    rate = jnp.where(u[:, 0] < 0.3, 1.0, steps ** -u[:, 1]).astype(u.dtype)
    change = (u[:, 2] * len(CHANGES)).astype(jnp.int32)
    size = 10 ** (-3 * u[:, 3])
    noise = Noise(0.5 + u[:, 4], jnp.zeros_like(size))
    of_trace = dict(rows=traces.disturbances, x0=traces.x0, length=traces.length)
    return Follow(noise=noise, **of_trace, rate=rate, change=change, size=size)


def _bettered(traces, played, live):
    """Each of the P traces, or the likeliest failure of its lanes (k, k + P, ..) if likelier."""
    p, e = traces.length.shape[0], played.episode
    value = jnp.where(e.failure & live, e.reward, -jnp.inf).reshape(-1, p)
    row = jnp.argmax(value, axis=0) * p + jnp.arange(p)
    return select_rows(jnp.max(value, axis=0) > traces.reward, index_tree(e, row), traces)


def _tally(played, new, live, number):
    """The `Tally` of runs of so many new steps."""
    e = played.episode._replace(length=new)
    return Tally.of(played._replace(episode=e), live, number)
