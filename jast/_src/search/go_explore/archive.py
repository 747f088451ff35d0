"""An archive of states to go on from, the likeliest known way to each cell of them.

The cells of Go-Explore (Ecoffet et al. 2021) without any knowledge of the system: by the step, by
the rank of the miss distance among the states kept (the nearest half of them, the nearest quarter,
and so on), and by two random projections of what is observed. A slot holds a state and the
disturbances that lead there; a cell's place is told anew at every merge, as ranks change.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.rewards import log_likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, ravel
from jast._src.search.go_explore.continued_runs import Point, start_point
from jast._src.search.lanes import EMPTY_HASH, blank_episodes, fold_hash

__all__ = ["Cells", "choose_cells", "empty_cells", "features", "merge_cells"]

PHASES = 16  # stretches of the horizon that cells tell apart
HALVES = 12  # halvings of the rank of the miss distance: the nearest of 4096 states are told apart
NEAREST = 0.5  # share of the choices that are of the states nearest to failure first
SIDES = 3  # cells to each side of the mean of a projection, half a standard deviation each


class Cells(NamedTuple):
    """S slots."""

    points: Point
    x0: Any
    rows: Any
    """[S, horizon, ...]: the disturbances up to the point count."""
    near: jax.Array
    """[S] the state's own miss distance; inf where there is none."""
    seen: jax.Array
    """[S] int32: how many runs went on from the cell."""
    live: jax.Array
    """[S] bool: the slot holds a state."""


@partial(jax.jit, static_argnums=1)
def empty_cells(sim: Simulator, slots: int) -> Cells:
    """No state yet."""
    e, none = blank_episodes(sim, slots), jnp.zeros(slots, jnp.int32)
    point = jax.eval_shape(partial(start_point, sim, log_likelihood), signature_of(sim).x0)
    return Cells(
        points=jax.tree.map(lambda s: jnp.zeros((slots, *s.shape), s.dtype), point),
        x0=e.x0,
        rows=e.disturbances,
        near=e.distance,
        seen=none,
        live=none > 0,
    )


def features(sim: Simulator, state: Any) -> jax.Array:
    """[F] the numbers of a state that cells are told by: what it shows, finite."""
    seen = sim.observe if signature_of(sim).observation is not None else ravel
    row = jnp.ravel(jnp.asarray(seen(state)))
    row = row if jnp.issubdtype(row.dtype, jnp.floating) else row.astype(signature_of(sim).dtype)
    return jnp.clip(jnp.nan_to_num(row, nan=0.0), -1e6, 1e6)


def choose_cells(cells: Cells, coin: jax.Array, u: jax.Array) -> jax.Array:
    """The slot [N] of each lane by uniform numbers ``coin`` and ``u`` [N]: with probability
    `NEAREST` those that are nearest to failure first, else those least gone on from.
    """
    live = cells.live.astype(u.dtype)
    near = jnp.where(cells.live & jnp.isfinite(cells.near), cells.near, jnp.inf)
    rank = jnp.searchsorted(jnp.sort(near), near, side="right").astype(u.dtype)
    seen = 1 / (1 + cells.seen.astype(u.dtype))
    near_first = _drawn(live * jnp.sqrt(seen) / jnp.maximum(rank, 1), u)
    pick = jnp.where(coin < NEAREST, near_first, _drawn(live * seen, u))
    return jnp.minimum(pick, live.shape[0] - 1).astype(jnp.int32)


def _drawn(weight, u):
    """Numbers with probabilities proportional to ``weight``, by the uniform numbers ``u``."""
    total = jnp.cumsum(weight)
    return jnp.searchsorted(total, u * total[-1], side="right")


def merge_cells(
    sim: Simulator,
    cell: Callable | None,
    key: jax.Array,
    cells: Cells,
    points: Point,
    good: Any,
    lane: Any,
    ways: tuple[Any, Any],
    most: int,
) -> Cells:
    """The archive with the best of the points.

    Args:
        sim: the simulator.
        cell: the user's own cells, of a state, or None.
        key: of the projections.
        cells: the archive.
        points: [M], new ones.
        good: [M] bool: those that may go on.
        lane: [M] int32: the row of ``ways`` that leads there.
        ways: x0 and the disturbances, [N, ...] each.
        most: of the points that enter; static.
    """
    slots = cells.live.shape[0]
    real = cells.near.dtype
    state = points.progress.state
    near = jnp.full(good.shape, jnp.inf, real)
    if not sim.episodic:
        near = jax.vmap(lambda s: jnp.asarray(sim.evaluate(s)[1]).astype(real))(state)

    def both(a, b):
        return jnp.concatenate([a, b])

    value = both(cells.points.progress.reward, points.progress.reward)
    live = both(cells.live, good) & jnp.isfinite(value)
    parts = cells.points.progress.state, state
    if cell is None:
        told = both(*(jax.vmap(partial(features, sim))(s) for s in parts))
        t = both(cells.points.t, points.t)
        name = _by_default(sim, key, told, t, both(cells.near, near), live, cells)
    else:
        of_user = jax.vmap(lambda s: fold_hash(jnp.uint32(EMPTY_HASH), cell(s)))
        name = both(*map(of_user, parts))
    # the likeliest way to each cell
    order = jnp.lexsort((-value, name, ~live))
    name, there = name[order], live[order]
    differs = (name[1:] != name[:-1]) | (there[1:] != there[:-1])
    first = there & both(jnp.ones(1, bool), differs)
    group = jnp.cumsum(first, dtype=jnp.int32) - 1
    seen = both(cells.seen, jnp.zeros_like(points.t))[order]
    seen = jnp.zeros_like(seen).at[group].max(jnp.where(there, seen, 0))[group]
    wins = jnp.zeros_like(first).at[order].set(first)
    seen = jnp.zeros_like(seen).at[order].set(seen)

    # the nearest of the new ones take the slots of those that lost, then of the most seen
    old, new = wins[:slots], wins[slots:]
    most = min(most, slots, len(new))
    places, free = jnp.lexsort((near, ~new))[:most], jnp.lexsort((-seen[:slots], old))[:most]
    enters = new[places] & (~old[free] | (seen[:slots][free] > 0))
    to = jnp.where(enters, free, slots)

    def put(into, a, at):
        return jax.tree.map(lambda s, v: s.at[to].set(v[at], mode="drop"), into, a)

    return Cells(
        points=put(cells.points, points, places),
        x0=put(cells.x0, ways[0], lane[places]),
        rows=put(cells.rows, ways[1], lane[places]),
        near=put(cells.near, near, places),
        seen=put(seen[:slots], seen[slots:], places),
        live=put(old, new, places),
    )


def _by_default(sim, key, f, t, distance, live, cells):
    """The cell of each of n states as a number, by their features ``f`` [n, F]."""
    weight = live.astype(f.dtype)[:, None]
    total = jnp.maximum(jnp.sum(weight), 1)
    mean = jnp.sum(f * weight, axis=0) / total
    spread = jnp.sqrt(jnp.sum(weight * (f - mean[None]) ** 2, axis=0) / total)
    unit = (f - mean[None]) / jnp.where(spread > 0, spread, 1)[None]
    ways = jax.random.normal(key, (f.shape[1], 2), f.dtype) / np.sqrt(f.shape[1])
    side = jnp.clip(jnp.round(2 * (unit @ ways)), -SIDES, SIDES).astype(jnp.int32) + SIDES
    known = jnp.sort(jnp.where(cells.live, cells.near, jnp.inf))
    n = jnp.sum(cells.live, dtype=jnp.int32)
    below = jnp.minimum(jnp.searchsorted(known, distance, side="right"), n)
    share = (below + 1).astype(f.dtype) / (n + 1).astype(f.dtype)
    half = jnp.clip(jnp.floor(-jnp.log2(share)), 0, HALVES).astype(jnp.int32)
    phase = t * PHASES // max(sim.horizon, PHASES)
    wide = 2 * SIDES + 1
    name = ((phase * (HALVES + 1) + half) * wide + side[:, 0]) * wide + side[:, 1]
    return name.astype(jnp.uint32)
