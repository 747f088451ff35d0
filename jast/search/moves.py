"""The moves of `jast.search.refine`: where a round looks for likelier failures around a point.

A point v [D] is an episode of a simulator whose modes are the origin (`jast.search.centred`), and
its cost is log p of the mode less log p, over the steps that it takes. Candidates are:

- *rays*: the point drawn towards the origin, by a little or by much;
- *slopes*: steps along the boundary of failure that lower the cost, as the linearised constraint
  has them (a step of sequential quadratic programming whose Hessian is the identity; of whole
  length it is that of Hasofer and Lind 1974 and Rackwitz and Fiessler 1978);
- *walks*: random steps at equal distance from the origin, and once more the last step that paid;
- *removals*: some of the numbers drawn to 0, wholly or partly;
- *exchanges*: one number drawn towards 0, and another raised by what keeps the miss distance as it
  is, to first order: where log p has a kink at its mode, the likeliest failures have many numbers
  at 0, and no slope tells which of them is to leave it;
- *shifts*: the same disturbances some steps later or sooner, drawn in a little.

Sizes of steps grow where they pay and shrink where they do not, for each point by itself.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast.outline import outline
from jast.pytrees import count
from jast.simulator import Simulator

__all__ = ["Noise", "Point", "along", "around", "resized", "SIZE"]

RAYS, LENGTHS, LIFTS, WALKS, REMOVALS, EXCHANGES, SHIFTS = 6, 3, 4, 8, 6, 8, 4
KINDS = RAYS, LENGTHS * LIFTS, WALKS + 1, REMOVALS, EXCHANGES, SHIFTS
SIZE = sum(KINDS)
"""Candidates of a point in a round."""
NEAREST, FARTHEST = 1e-6, 0.5
"""The least and the largest gap."""
ENTRANTS = 4
"""Numbers among which an exchange takes the dearest, or the cheapest."""
SHARES = 8, 4, 2, 1, 0.5, 0.25
STRETCHES = 2.5, 1, 0.4
"""Rays, as shares of the gap; slopes, as shares of the length."""


class Point(NamedTuple):
    """A failing point on its way, and the sizes of its steps."""

    v: Any
    """[D]"""
    cost: Any
    used: Any
    gap: Any
    """How far inside the failures it may be, as a share of its way from the origin"""
    length: Any
    """Of steps along the boundary; 1: to where the linearised problem has its optimum"""
    width: Any
    """Of random steps, as a share of the distance from the origin"""
    last: Any
    """[D] the last step that paid"""
    slope: Any
    """[D] of the distance, and"""
    rise: Any
    """[D] of the cost, both at the last round"""


class Noise(NamedTuple):
    """Random numbers of a round: `walks` [WALKS, D] normal; uniform `masks` [REMOVALS, D], `rates`
    and `shrinks` [REMOVALS], `pairs` [EXCHANGES, 2] and `sizes` [EXCHANGES]; `part` [k] int32, the
    numbers that differences are taken of; `shifts` [SHIFTS] int32, steps, with normal `fills`
    [SHIFTS].
    """

    walks: Any
    masks: Any
    rates: Any
    shrinks: Any
    pairs: Any
    sizes: Any
    part: Any
    shifts: Any
    fills: Any


def around(sim: Simulator, point: Point, slope: Any, rise: Any, noise: Noise) -> jax.Array:
    """The candidates [SIZE, D] around ``point``, by the slope of the distance and the rise of the
    cost there [D]; both are 0 where they are not known.
    """
    return jnp.concatenate(
        [
            _rays(point),
            _slid(point, slope, rise),
            _walked(point, noise.walks),
            _removed(point, noise),
            _exchanged(point, slope, rise, noise),
            jax.vmap(partial(_shifted, sim, point.v))(noise.shifts, noise.fills),
        ]
    )


def resized(point: Point, i: Any, better: Any, failing: Any) -> Point:
    """The point with the sizes of its steps after candidate ``i`` was the best of its round;
    ``failing`` [RAYS]: which rays failed.
    """
    rays, slopes, walks = (sum(KINDS[:k]) for k in (1, 2, 3))
    took = lambda low, high: better & (i >= low) & (i < high)
    shares, lengths, widths = jnp.asarray(SHARES, point.v.dtype), _lengths(point), _widths(point)
    paid = shares[jnp.minimum(i, rays - 1)]
    missed = jnp.min(jnp.where(failing, 2 * shares[0], shares))
    gap = point.gap * jnp.where(better, 2 * missed, 0.25)
    gap = jnp.where(took(0, rays), point.gap * jnp.where(paid <= 1, 0.5, paid), gap)
    length = point.length * jnp.where(better, 1, 0.5)
    grown = lengths[jnp.clip((i - rays) // LIFTS, 0, LENGTHS - 1)]
    length = jnp.where(took(rays, slopes), grown, length)
    wide = widths[jnp.clip(i - slopes, 0, WALKS - 1)] * 1.5
    width = jnp.where(took(slopes, walks - 1), wide, point.width * 0.93)
    return point._replace(
        gap=jnp.clip(gap, NEAREST, FARTHEST),
        length=jnp.clip(length, 1e-3, 1),
        width=jnp.clip(width, 1e-3, 1),
    )


def _lengths(point):
    return jnp.minimum(point.length * jnp.asarray(STRETCHES, point.v.dtype), 1.5)


def _widths(point):
    return point.width * jnp.asarray([3, 1, 0.3, 0.1, 3, 1, 0.3, 0.1], point.v.dtype)


def _live(point):
    """Which numbers decide something [D], and how many."""
    live = jnp.arange(len(point.v), dtype=jnp.int32) < point.used
    return live, jnp.maximum(jnp.sum(live, dtype=jnp.int32), 1).astype(point.v.dtype)


def _rays(point):
    shares = jnp.asarray(SHARES, point.v.dtype)
    return point.v[None] * (1 - jnp.minimum(shares * point.gap, 1))[:, None]


def _slid(point, slope, rise):
    """Steps along the boundary, each lifted a little, for a boundary that bends. No number crosses
    0 to the side where the distance grows.
    """
    lengths, radius, way = _lengths(point), jnp.linalg.norm(point.v), along(point, slope, rise)
    angle = lengths * jnp.sum(way**2) / jnp.maximum(radius, NEAREST) ** 2
    lifts = jnp.asarray([0, 0.1, 0.3, 0.6], point.v.dtype)
    lifts = 1e-5 + lifts[None] * jnp.minimum(angle, 1)[:, None]
    slid = point.v[None] + lengths[:, None] * way[None]
    slid = jnp.where((point.v * slope < 0)[None] & (slid * slope[None] > 0), 0, slid)
    slid = slid[:, None] * (1 + lifts)[:, :, None]
    return slid.reshape(-1, len(point.v))


def _walked(point, normals):
    """Random steps, and the last one that paid, at equal distance from the origin or a little
    nearer.
    """
    live, count_live = _live(point)
    radius, widths = jnp.linalg.norm(point.v), _widths(point)
    strides = jnp.where(live[None], normals, 0) / jnp.sqrt(count_live)
    walks = point.v[None] + widths[:, None] * radius * strides
    walks = jnp.concatenate([walks, (point.v + point.last)[None]])
    drop = 1 - 0.3 * jnp.concatenate([widths, point.width[None]]) ** 2 / count_live
    size = jnp.linalg.norm(walks, axis=1)
    return walks * (radius * jnp.minimum(drop, 1) / jnp.maximum(size, NEAREST))[:, None]


def along(point: Point, slope: jax.Array, rise: jax.Array) -> jax.Array:
    """The way along the boundary that lowers the cost [D]. A number at 0 leaves it for the side
    where the distance falls or not at all: the other is dearer and of no use.
    """
    size, rise, free = jnp.abs(slope), _helpful(slope) * rise, jnp.ones(slope.shape, bool)
    for _ in range(3):
        square = jnp.sum(jnp.where(free, size**2, 0))
        price = jnp.sum(jnp.where(free, size * rise, 0)) / jnp.where(square > 0, square, 1)
        way = jnp.where(free, price * size - rise, 0)
        free &= (point.v != 0) | (way > 0)
    return jnp.where(free, _helpful(slope) * way, 0)


def _helpful(slope):
    """The side, +-1, to which a number moves where the distance falls [D]."""
    return jnp.where(slope > 0, -1, 1).astype(slope.dtype)


def _removed(point, noise):
    _, count_live = _live(point)
    hit = noise.masks < jnp.maximum(noise.rates, 1 / count_live)[:, None]
    return point.v[None] * jnp.where(hit, 1 - noise.shrinks[:, None], 1)


def _exchanged(point, slope, rise, noise):
    """Of each pair of numbers one is drawn towards 0 by the share ``sizes``, and the other makes up
    for it. In the first half the number drawn in is, of a few, the one whose part in the failure is
    the dearest, and the other that of which more is the cheapest.
    """
    live, _ = _live(point)
    price = jnp.where(slope != 0, _helpful(slope) * rise / jnp.abs(slope), 0)
    dear = jnp.where(point.v * slope < 0, -price, jnp.inf)
    lowered = _picked(live & (point.v != 0), noise.pairs[:, 0], dear)
    raised = _picked(live & (slope != 0), noise.pairs[:, 1], price)
    drop = noise.sizes * point.v[lowered]
    # by a little more than to first order, for a boundary that bends
    back = drop * (1 + 0.1 * noise.sizes) * slope[lowered] / slope[raised]
    back = jnp.where((raised != lowered) & jnp.isfinite(back), back, 0)
    rows = jnp.arange(len(drop), dtype=jnp.int32)
    moved = point.v[None].repeat(len(rows), 0).at[rows, lowered].add(-drop)
    return moved.at[rows, raised].add(back)


def _picked(among, uniform, worth):
    """For each of ``uniform`` [n, k] one of the numbers that are ``among`` [D]: in the first half
    the one least in ``worth`` [D] of k, else any.
    """
    ranks = jnp.cumsum(among.astype(jnp.int32), dtype=jnp.int32)
    at = jnp.floor(uniform * ranks[-1].astype(uniform.dtype)).astype(jnp.int32) + 1
    picked = jnp.minimum(jnp.searchsorted(ranks, at), len(among) - 1).astype(jnp.int32)
    best = jnp.argmin(worth[picked], axis=1, keepdims=True)
    n = len(uniform)
    column = jnp.where(jnp.arange(n, dtype=jnp.int32)[:, None] * 2 < n, best, 0)
    return jnp.take_along_axis(picked, column, axis=1)[:, 0]


def _shifted(sim, v, steps, fill):
    """``v`` moved in time, at equal distance from the origin or a little nearer."""
    moved = _in_time(sim, v, steps, fill)
    size = jnp.maximum(jnp.linalg.norm(moved), NEAREST)
    return moved * (jnp.linalg.norm(v) * (1 - 1e-5) / size)


def _in_time(sim, v, steps, fill):
    """``v`` [D] with its disturbances that many ``steps`` later, sooner where negative. What comes
    in is the first of them times ``fill``, at the end modes.
    """
    first = count(outline(sim).x0)
    rows = v[first:].reshape(sim.horizon, -1)
    t = jnp.arange(sim.horizon, dtype=jnp.int32) - steps
    share = jnp.where(t < 0, fill, jnp.where(t < sim.horizon, 1, 0)).astype(v.dtype)
    rows = rows[jnp.clip(t, 0, sim.horizon - 1)] * share[:, None]
    return jnp.concatenate([v[:first], rows.reshape(-1)])
