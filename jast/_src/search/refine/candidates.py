"""The moves of `jast.search.refine`: where a round looks for likelier failures around a point.

A point v [D] is an episode of a simulator whose modes are the origin
(`normal_space.mode_coordinates`), and its cost is log p of the mode less log p, over the steps that
it takes. Candidates are:

- *rays*: the point drawn towards the origin, by a little or by much;
- *slopes*: steps along the boundary of failure that lower the cost, as the linearised constraint
  has them (a step of sequential quadratic programming whose Hessian is the identity; of whole
  length it is that of Hasofer and Lind 1974 and Rackwitz and Fiessler 1978);
- *walks*: random steps at equal distance from the origin, and once more the last step that paid;
- *removals*: some of the numbers drawn to 0, wholly or partly;
- *exchanges*: one number drawn towards 0, and another raised by what keeps the miss distance as it
  is, to first order: where log p has a kink at its mode, the likeliest failures have many numbers
  at 0, and no slope tells which of them is to leave it; or, without slopes, two numbers drawn to
  their mean;
- *shifts*: the same disturbances some steps later or sooner, drawn in a little.

Sizes of steps grow where they pay and shrink where they do not, for each point by itself.

All of it is NumPy's, for n points at a time: there is nothing to compile.
"""

from typing import NamedTuple

import numpy as np

__all__ = [
    "NEAREST",
    "RAYS",
    "SIZE",
    "Noise",
    "Point",
    "boundary_direction",
    "candidates",
    "draw_noise",
    "resize_steps",
    "shift_in_time",
]

RAY_LENGTHS = 8, 4, 2, 1, 0.5, 0.25  # lengths of the rays, as shares of the gap
SLOPE_LENGTHS = 2.5, 1, 0.4  # steps along the boundary, as shares of ``Point.length``
RAISED = 0, 0.1, 0.3, 0.6
"""How far each of them is lifted for a boundary that bends, as shares of the angle of the step."""
WIDTHS = 3, 1, 0.3, 0.1, 3, 1, 0.3, 0.1  # widths of the random steps, as shares of ``Point.width``
RAYS = len(RAY_LENGTHS)  # candidates of a point in a round that are rays
SLOPES = len(SLOPE_LENGTHS) * len(RAISED)  # those that are steps along the boundary
WALKS = len(WIDTHS)  # those that are random steps, without the last step that paid
REMOVALS = 6  # those that are removals of numbers
EXCHANGES = 8  # those that exchange numbers
SHIFTS = 4  # those that are shifts in time
SIZE = RAYS + SLOPES + WALKS + 1 + REMOVALS + EXCHANGES + SHIFTS  # all of a point in a round
NEAREST = 1e-6  # the least gap, and the least of what is divided by
FARTHEST = 0.5  # the largest gap
MIN_STEP = 1e-3  # the least length and width
ENTRANTS = 4  # numbers among which an exchange takes the dearest, or the cheapest


class Point(NamedTuple):
    """Failing points [n] on their way, and the sizes of their steps."""

    v: np.ndarray
    """[n, D]"""
    cost: np.ndarray
    used: np.ndarray
    """How many of the numbers decide something."""
    gap: np.ndarray
    """How far inside the failures it may be, as a share of its way from the origin."""
    length: np.ndarray
    """Of steps along the boundary; 1: to where the linearised problem has its optimum."""
    width: np.ndarray
    """Of random steps, as a share of the distance from the origin."""
    last: np.ndarray
    """[n, D] the last step that paid."""
    slope: np.ndarray
    """[n, D] the gradient of the distance at the last round."""
    rise: np.ndarray
    """[n, D] the gradient of the cost at the last round."""


class Noise(NamedTuple):
    """Random numbers of a round, for each of n points."""

    walks: np.ndarray
    """[n, WALKS, D] normal"""
    masks: np.ndarray
    """[n, REMOVALS, D] uniform"""
    rates: np.ndarray
    """[n, REMOVALS]"""
    shrinks: np.ndarray
    """[n, REMOVALS] powers of ten"""
    pairs: np.ndarray
    """[n, EXCHANGES, 2, ENTRANTS] uniform"""
    sizes: np.ndarray
    """[n, EXCHANGES] powers of ten"""
    shifts: np.ndarray
    """[n, SHIFTS] int32: steps"""
    fills: np.ndarray
    """[n, SHIFTS] normal"""


def draw_noise(rng: np.random.Generator, v: np.ndarray, horizon: int) -> Noise:
    """The `Noise` of a round for the points ``v`` [n, D]."""
    (n, d), real = v.shape, v.dtype

    def uniform(*shape):
        return rng.random((n, *shape)).astype(real)

    def normal(*shape):
        return rng.standard_normal((n, *shape)).astype(real)

    def powers(k):
        return (10.0 ** -rng.integers(0, 5, (n, k))).astype(real)

    return Noise(
        walks=normal(WALKS, d),
        masks=uniform(REMOVALS, d),
        rates=uniform(REMOVALS) ** 2,
        shrinks=powers(REMOVALS),
        pairs=uniform(EXCHANGES, 2, ENTRANTS),
        sizes=powers(EXCHANGES),
        shifts=_draw_shifts(rng, n, horizon),
        fills=normal(SHIFTS),
    )


def _draw_shifts(rng, n, horizon):
    """One step later, twice, as more steps are more ways; one sooner; many, either way."""
    far = rng.integers(2, max(3, horizon // 3), n) * rng.choice([-1, 1], n)
    steps = np.stack([np.ones(n), np.ones(n), -np.ones(n), far], axis=1)
    most = horizon - 1  # one of the steps at least stays
    return np.clip(steps, -most, most).astype(np.int32)


def candidates(point: Point, noise: Noise, first: int, horizon: int) -> np.ndarray:
    """The candidates [n, SIZE, D] around the points; slope and rise are 0 where they are not
    known. ``first``: how many of the D numbers are of the start; the others are of ``horizon``
    steps.
    """
    return np.concatenate(
        [
            _rays(point),
            _slid(point),
            _walked(point, noise.walks),
            _removed(point, noise),
            _exchanged(point, noise),
            _shifted(point.v, noise.shifts, noise.fills, first, horizon),
        ],
        axis=1,
    )


def resize_steps(point: Point, i: np.ndarray, better: np.ndarray, failing: np.ndarray) -> Point:
    """The points with the sizes of their steps after candidates ``i`` [n] were the best of the
    round; ``failing`` [n, RAYS]: which rays failed.
    """
    rays, slopes, walks = RAYS, RAYS + SLOPES, RAYS + SLOPES + WALKS
    by_slope, by_walk = (i >= rays) & (i < slopes), (i >= slopes) & (i < walks)
    shares = _of(point, RAY_LENGTHS)
    paid = shares[np.minimum(i, rays - 1)]
    missed = np.where(failing, 2 * shares[0], shares).min(axis=1)
    gap = point.gap * np.where(better, 2 * missed, 0.25)
    gap = np.where(better & (i < rays), point.gap * np.where(paid <= 1, 0.5, paid), gap)
    length = point.length * np.where(better, 1, 0.5)
    of_slope = _entry(_lengths(point), (i - rays) // len(RAISED))
    length = np.where(better & by_slope, of_slope, length)
    width = np.where(better & by_walk, 1.5 * _entry(_widths(point), i - slopes), 0.93 * point.width)
    dtype = point.v.dtype
    return point._replace(
        gap=np.clip(gap, NEAREST, FARTHEST).astype(dtype),
        length=np.clip(length, MIN_STEP, 1).astype(dtype),
        width=np.clip(width, MIN_STEP, 1).astype(dtype),
    )


def _entry(a, k):
    """The entry ``k`` [n] of each row of ``a`` [n, m]; the nearest where there is none such."""
    k = np.clip(k, 0, a.shape[1] - 1)[:, None]
    return np.take_along_axis(a, k, axis=1)[:, 0]


def _of(point, numbers):
    return np.asarray(numbers, point.v.dtype)


def _lengths(point):
    return np.minimum(point.length[:, None] * _of(point, SLOPE_LENGTHS), 1.5)


def _widths(point):
    return point.width[:, None] * _of(point, WIDTHS)


def _live(point):
    """Which numbers decide something [n, D], and how many [n]."""
    live = np.arange(point.v.shape[1]) < point.used[:, None]
    return live, np.maximum(live.sum(axis=1), 1).astype(point.v.dtype)


def _norm(a):
    """Of the last axis, which stays."""
    return np.linalg.norm(a, axis=-1, keepdims=True)


def _rays(point):
    drawn = 1 - np.minimum(_of(point, RAY_LENGTHS) * point.gap[:, None], 1)
    return point.v[:, None] * drawn[:, :, None]


def _slid(point):
    """Steps along the boundary, each lifted a little, for a boundary that bends. No number crosses
    0 to the side where the distance grows.
    """
    v, slope = point.v[:, None], point.slope[:, None]
    lengths, way = _lengths(point), boundary_direction(point)
    bend = (way**2).sum(axis=1) / np.maximum(_norm(point.v)[:, 0], NEAREST) ** 2
    angle = np.minimum(lengths * bend[:, None], 1)
    lifts = 1e-5 + _of(point, RAISED) * angle[:, :, None]
    slid = v + lengths[:, :, None] * way[:, None]
    slid = np.where((v * slope < 0) & (slid * slope > 0), 0, slid)
    slid = slid[:, :, None] * (1 + lifts)[:, :, :, None]
    return slid.reshape(len(v), -1, v.shape[-1])


def _walked(point, normals):
    """Random steps, and the last one that paid, at equal distance from the origin or a little
    nearer.
    """
    live, count_live = _live(point)
    radius, widths = _norm(point.v)[:, None], _widths(point)
    strides = np.where(live[:, None], normals, 0) / np.sqrt(count_live)[:, None, None]
    walks = point.v[:, None] + widths[:, :, None] * radius * strides
    walks = np.concatenate([walks, (point.v + point.last)[:, None]], axis=1)
    all_widths = np.concatenate([widths, point.width[:, None]], axis=1)
    drop = np.minimum(1 - 0.3 * all_widths**2 / count_live[:, None], 1)
    return walks * (radius * drop[:, :, None] / np.maximum(_norm(walks), NEAREST))


def boundary_direction(point: Point) -> np.ndarray:
    """The way along the boundary that lowers the cost [n, D]. A number at 0 leaves it for the side
    where the distance falls or not at all: the other is dearer and of no use.
    """
    side = _helpful(point.slope)
    size, rise, free = np.abs(point.slope), side * point.rise, np.ones(point.v.shape, bool)
    for _ in range(3):
        square = np.where(free, size**2, 0).sum(axis=1, keepdims=True)
        price = np.where(free, size * rise, 0).sum(axis=1, keepdims=True)
        price = price / np.where(square > 0, square, 1)
        way = np.where(free, price * size - rise, 0)
        free &= (point.v != 0) | (way > 0)
    return np.where(free, side * way, 0)


def _helpful(slope):
    """The side, +-1, to which a number moves where the distance falls."""
    return np.where(slope > 0, -1, 1).astype(slope.dtype)


def _removed(point, noise):
    _, count_live = _live(point)
    hit = noise.masks < np.maximum(noise.rates, 1 / count_live[:, None])[:, :, None]
    return point.v[:, None] * np.where(hit, 1 - noise.shrinks[:, :, None], 1)


def _exchanged(point, noise):
    """Of each pair of numbers one is drawn towards 0 by the share ``sizes``, and the other makes up
    for it. In the first half the number drawn in is, of a few, the one whose part in the failure is
    the dearest, and the other that of which more is the cheapest; where no slope is known both are
    drawn to their mean, by which counts give up a unit to one another.
    """
    v, slope, (live, _) = point.v, point.slope, _live(point)
    steep = np.where(slope != 0, slope, 1)
    price = np.where(slope != 0, _helpful(slope) * point.rise / np.abs(steep), 0)
    dear = np.where(v * slope < 0, -price, np.inf)
    lowered = _picked(live & (v != 0), noise.pairs[:, :, 0], dear)
    flat = ~slope.any(axis=1, keepdims=True)
    raised = _picked(live & (flat | (slope != 0)), noise.pairs[:, :, 1], price)
    row = np.arange(len(v))[:, None]
    drop = noise.sizes * v[row, lowered]
    # by a little more than to first order, for a boundary that bends
    back = drop * (1 + 0.1 * noise.sizes) * slope[row, lowered] / steep[row, raised]
    back = np.where((raised != lowered) & (slope[row, raised] != 0) & np.isfinite(back), back, 0)
    moved = v[:, None].repeat(drop.shape[1], axis=1)
    n, e = np.indices(drop.shape)
    level = (v[row, lowered] + v[row, raised]) / 2
    flat = flat & (e < e.shape[1] // 2)
    moved[n, e, lowered] = np.where(flat, level, v[row, lowered] - drop)
    moved[n, e, raised] = np.where(flat, level, moved[n, e, raised] + back)
    return moved


def _picked(among, uniform, worth):
    """For each of ``uniform`` [n, E, k] one of the numbers that are ``among`` [n, D]: in the first
    half the one least in ``worth`` [n, D] of k, else any.
    """
    ranks = np.cumsum(among, axis=1)
    at = np.floor(uniform * ranks[:, -1, None, None]).astype(int) + 1
    picked = np.stack([np.searchsorted(r, a) for r, a in zip(ranks, at, strict=True)])
    picked = np.minimum(picked, among.shape[1] - 1)
    best = np.argmin(worth[np.arange(len(worth))[:, None, None], picked], axis=2)
    best[:, best.shape[1] // 2 :] = 0
    return np.take_along_axis(picked, best[:, :, None], axis=2)[:, :, 0]


def _shifted(v, steps, fill, first, horizon):
    """``v`` moved in time, at equal distance from the origin or a little nearer."""
    moved = shift_in_time(v, steps, fill, first, horizon)
    radius = _norm(v)[:, None] * (1 - 1e-5)
    return moved * (radius / np.maximum(_norm(moved), NEAREST)).astype(v.dtype)


def shift_in_time(
    v: np.ndarray, steps: np.ndarray, fill: np.ndarray, first: int, horizon: int
) -> np.ndarray:
    """``v`` [n, D] with its disturbances that many ``steps`` [n, k] later, sooner where negative:
    [n, k, D]. What comes in is the first of them times ``fill`` [n, k], at the end modes.
    """
    n, d = v.shape
    rows = v[:, first:].reshape(n, horizon, -1)
    t = np.arange(horizon) - steps[:, :, None]
    share = np.where(t < 0, fill[:, :, None], t < horizon).astype(v.dtype)
    at = np.clip(t, 0, horizon - 1)
    moved = rows[np.arange(n)[:, None, None], at] * share[:, :, :, None]
    start = v[:, None, :first].repeat(steps.shape[1], axis=1)
    return np.concatenate([start, moved.reshape(*steps.shape, d - first)], axis=2)
