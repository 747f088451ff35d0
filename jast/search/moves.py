"""The moves of `jast.search.refine`: points of failing episodes in normal numbers, and one round
that looks for likelier failures around each of them.

A point z [D] is an episode (`jast.limit_state`), and its cost is log p of the mode less
log p, over the steps that it takes. A round tries, all at once and for every point:

- *rays*: the point drawn towards the anchor, which is the episode of modes, by a little or by much;
- *slopes*: steps along the boundary of failure that lower the cost, as the linearised constraint
  has them (a step of sequential quadratic programming whose Hessian is the identity; of whole
  length it is that of Hasofer and Lind 1974 and Rackwitz and Fiessler 1978);
- *walks*: random steps at equal distance from the anchor, and once more the last step that paid;
- *removals*: some of the numbers drawn to the anchor, wholly or partly;
- *shifts*: the same disturbances some steps later or sooner, the first one drawn out.

It takes the cheapest that fails. Sizes of steps grow where they pay and shrink where they do not,
for each point by itself.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast import distributions as D
from jast.episode import rollout
from jast.limit_state import dimension, ended, normal_numbers, policy_of
from jast.outline import outline
from jast.progress import advance, begin
from jast.pytrees import count
from jast.rewards import log_likelihood
from jast.simulator import Simulator

__all__ = ["Noise", "Point", "anchor", "begun", "judge", "residuals", "round_of", "SIZE"]

RAYS, LENGTHS, LIFTS, WALKS, REMOVALS, SHIFTS = 6, 3, 4, 8, 6, 4
SIZE = RAYS + LENGTHS * LIFTS + WALKS + 1 + REMOVALS + SHIFTS
"""Candidates of a point in a round."""
NEAREST, FARTHEST = 1e-6, 0.5
EDGE = 0.05
"""How far from the boundary differences are taken, as a share of the way to the anchor."""


def likelihood(sim: Simulator) -> Callable:
    """The log density as a reward: relative to the mode, and so free of units, where the
    disturbances of ``sim`` have modes.
    """
    return of_mode if outline(sim).density == "mode" else log_likelihood


def of_mode(log_p, event, distance, terminal, approach=0.0):
    return log_p


of_mode.density = "mode"


class Verdict(NamedTuple):
    """What episodes came to."""

    failure: Any
    cost: Any
    """log p(mode) - log p; inf where invalid"""
    distance: Any
    invalid: Any
    used: Any
    """int32: how many of the numbers decided it"""


class Point(NamedTuple):
    """A failing point on its way, and the sizes of its steps."""

    z: Any
    """[D]"""
    cost: Any
    used: Any
    gap: Any
    """How far inside the failures it may be, as a share of its way from the anchor"""
    length: Any
    """Of steps along the boundary; 1: to where the linearised problem has its optimum"""
    width: Any
    """Of random steps, as a share of the distance from the anchor"""
    last: Any
    """[D] the last step that paid"""
    slope: Any
    """[D] of the distance, and"""
    rise: Any
    """[D] of the cost, where both are told from differences"""


class Noise(NamedTuple):
    """Random numbers of a round: `walks` [WALKS, D] normal; uniform `masks` [REMOVALS, D], `rates`
    and `shrinks` [REMOVALS]; `part` [k] int32, the numbers that differences are taken of; `shifts`
    [SHIFTS] int32, steps.
    """

    walks: Any
    masks: Any
    rates: Any
    shrinks: Any
    part: Any
    shifts: Any


def judge(sim: Simulator, z: jax.Array) -> Verdict:
    """The `Verdict` of the episode of ``z`` [D]."""
    end, length = ended(sim, z, likelihood(sim))
    about = outline(sim)
    used = count(about.x0) + length * count(about.x)
    cost = jnp.where(end.invalid, jnp.inf, -end.reward)
    return Verdict(end.failure, cost.astype(z.dtype), end.distance, end.invalid, used)


@jax.jit
def anchor(sim: Simulator) -> jax.Array:
    """The point [D] of the episode in which every disturbance is at its mode; 0 where there is
    none, and no number beyond +-5.
    """
    about, dtype = outline(sim), normal_numbers(sim)
    row = lambda z: jnp.concatenate(
        [jnp.ravel(a).astype(dtype) for a in jax.tree.leaves(z)] or [jnp.zeros(0, dtype)]
    )
    start = sim.start()
    x0 = D.mode(start) if about.start.mode else D.sample(start, jax.random.key(0))
    first = row(D.to_normal(start, x0)) if about.random_start and about.start.mode else None
    first = jnp.zeros(count(about.x0), dtype) if first is None else first
    if not about.disturbance.mode:
        return jnp.concatenate([first, jnp.zeros(dimension(sim) - len(first), dtype)])

    reward = likelihood(sim)

    def step(progress, t):
        dist = sim.disturbance(progress.state)
        x = D.mode(dist)
        after = advance(sim, reward, progress, x, t + 1 >= sim.horizon)
        kept = jax.tree.map(lambda a, b: jnp.where(progress.done, a, b), progress, after)
        return kept, row(D.to_normal(dist, x))

    _, rows = lax.scan(step, begin(sim, reward, x0), jnp.arange(sim.horizon, dtype=jnp.int32))
    z = jnp.concatenate([first, rows.reshape(-1)])
    return jnp.clip(jnp.where(jnp.isfinite(z), z, jnp.where(z > 0, 5.0, -5.0)), -5, 5)


@jax.jit
def begun(sim: Simulator, z: jax.Array) -> tuple[Point, Verdict]:
    """The `Point` of each of ``z`` [n, D], and the `Verdict`."""
    v = jax.vmap(partial(judge, sim))(z)
    full = lambda value: jnp.full(len(z), value, z.dtype)
    zero = jnp.zeros_like(z)
    return Point(z, v.cost, v.used, full(0.3), full(1), full(0.5), zero, zero, zero), v


@partial(jax.jit, static_argnums=4)
def round_of(
    sim: Simulator, home: jax.Array, points: Point, noise: Noise, gradients: bool
) -> tuple[Point, jax.Array]:
    """One round of all ``points`` [n] with their ``noise`` [n], and how many of the candidates were
    invalid. ``home`` [D]: the `anchor`.
    """
    step = partial(_round, sim, gradients, home)
    points, invalid = jax.vmap(step)(points, noise)
    return points, jnp.sum(invalid, dtype=jnp.int32)


def _round(sim, gradients, home, point, noise):
    v, radius = point.z - home, jnp.linalg.norm(point.z - home)
    if gradients:
        edge = home + (1 - point.gap) * v
        slope, rise = _slopes(sim, edge)
    else:
        slope, rise = _differences(sim, home, v, radius, point, noise.part)
    along, usable = _along(slope, rise)
    dtype = v.dtype

    shares = jnp.asarray([8, 4, 2, 1, 0.5, 0.25], dtype)  # rays
    rays = v[None] * (1 - jnp.minimum(shares * point.gap, 1))[:, None]
    lengths = point.length * jnp.asarray([2.5, 1, 0.4], dtype)  # slopes
    lengths = jnp.minimum(lengths, 1.5)
    angle = lengths * jnp.sum(along**2) / jnp.maximum(radius, NEAREST) ** 2
    lifts = 1e-5 + jnp.asarray([0, 0.1, 0.3, 0.6], dtype)[None] * jnp.minimum(angle, 1)[:, None]
    steps = jnp.where(usable, lengths, 0)[:, None] * along[None]
    slid = (v[None] + steps)[:, None] * (1 + lifts)[:, :, None]
    widths = point.width * jnp.asarray([3, 1, 0.3, 0.1, 3, 1, 0.3, 0.1], dtype)  # walks
    live = jnp.arange(len(v), dtype=jnp.int32) < point.used
    count_live = jnp.maximum(jnp.sum(live, dtype=jnp.int32), 1).astype(dtype)
    strides = jnp.where(live[None], noise.walks, 0) / jnp.sqrt(count_live)
    walks = v[None] + widths[:, None] * radius * strides
    walks = jnp.concatenate([walks, (v + point.last)[None]])
    drop = 1 - 0.3 * jnp.concatenate([widths, point.width[None]]) ** 2 / count_live
    size = jnp.linalg.norm(walks, axis=1)
    walks = walks * (radius * jnp.minimum(drop, 1) / jnp.maximum(size, NEAREST))[:, None]
    hit = noise.masks < jnp.maximum(noise.rates, 1 / count_live)[:, None]  # removals
    removed = v[None] * jnp.where(hit, 1 - noise.shrinks[:, None], 1)

    shifted = jax.vmap(partial(_shifted, sim, v))(noise.shifts)
    sizes = jnp.linalg.norm(shifted, axis=1)
    shifted = shifted * (radius * (1 - 1e-5) / jnp.maximum(sizes, NEAREST))[:, None]

    moves = jnp.concatenate([rays, slid.reshape(-1, len(v)), walks, removed, shifted])
    verdict = jax.vmap(partial(judge, sim))(home[None] + moves)
    cost = jnp.where(verdict.failure, verdict.cost, jnp.inf)
    i = jnp.argmin(cost).astype(jnp.int32)
    better = cost[i] < point.cost
    took = lambda low, high: better & (i >= low) & (i < high)
    a, b, c = RAYS, RAYS + LENGTHS * LIFTS, RAYS + LENGTHS * LIFTS + WALKS
    paid, grown = shares[jnp.minimum(i, a - 1)], jnp.clip((i - a) // LIFTS, 0, LENGTHS - 1)
    gap = jnp.where(took(0, a), point.gap * paid, jnp.where(better, point.gap * 2, point.gap / 4))
    gap = jnp.where(took(0, a) & (paid <= 1), point.gap / 2, gap)
    length = jnp.where(took(a, b), lengths[grown], point.length * jnp.where(better, 1, 0.5))
    width = jnp.where(took(b, c), widths[jnp.clip(i - b, 0, WALKS - 1)] * 1.5, point.width * 0.93)
    # numbers that decide nothing stay at the anchor
    step = jnp.where(jnp.arange(len(v), dtype=jnp.int32) < verdict.used[i], moves[i], 0)
    new = Point(
        jnp.where(better, home + step, point.z),
        jnp.where(better, cost[i], point.cost),
        jnp.where(better, verdict.used[i], point.used),
        jnp.clip(gap, NEAREST, FARTHEST),
        jnp.clip(length, 1e-3, 1),
        jnp.clip(width, 1e-3, 1),
        jnp.where(better, step - v, point.last),
        slope,
        rise,
    )
    return new, jnp.sum(verdict.invalid, dtype=jnp.int32)


def _shifted(sim, v, k):
    """``v`` [D] with its steps ``k`` later, or sooner where negative; the first is drawn out."""
    first = count(outline(sim).x0)
    rows = v[first:].reshape(sim.horizon, -1)
    t = jnp.arange(sim.horizon, dtype=jnp.int32) - k
    rows = jnp.where((t < sim.horizon)[:, None], rows[jnp.clip(t, 0, sim.horizon - 1)], 0)
    return jnp.concatenate([v[:first], rows.reshape(-1)])


def _along(slope, rise):
    """The way along the boundary that lowers the cost, and whether there is one."""
    square = jnp.sum(slope**2)
    usable = jnp.isfinite(square) & (square > 0) & jnp.all(jnp.isfinite(rise))
    slope, rise = (jnp.where(usable, a, 0) for a in (slope, rise))
    return slope * jnp.dot(slope, rise) / jnp.where(usable, square, 1) - rise, usable


def _slopes(sim, z):
    """The gradients of the distance and of the cost at ``z``."""

    def both(z):
        e = rollout(jax.random.key(0), sim, policy_of(sim, z), likelihood(sim))
        return e.distance, -e.reward

    (distance, _), back = jax.vjp(both, z)
    one, zero = jnp.ones_like(distance), jnp.zeros_like(distance)
    return back((one, zero))[0], back((zero, one))[0]


def _differences(sim, home, v, radius, point, part):
    """Both slopes with the numbers ``part`` told anew, from differences outside the failures."""
    gap = jnp.maximum(EDGE, point.gap)
    edge, h = home + (1 - gap) * v, 0.2 * EDGE * jnp.maximum(radius, 1e-3)
    shifted = (
        edge[None].repeat(len(part), 0).at[jnp.arange(len(part), dtype=jnp.int32), part].add(h)
    )
    there = judge(sim, edge)
    moved = jax.vmap(partial(judge, sim))(shifted)
    good = jnp.isfinite(moved.distance) & jnp.isfinite(moved.cost)
    told = lambda a, b: jnp.where(good, (a - b) / h, 0)
    slope = point.slope.at[part].set(told(moved.distance, there.distance))
    return slope, point.rise.at[part].set(told(moved.cost, there.cost))


@jax.jit
def residuals(sim: Simulator, home: jax.Array, points: Point) -> jax.Array:
    """How far each of ``points`` [n] is from the conditions of Karush, Kuhn and Tucker: the slope
    of its cost along the boundary, as a share of the whole slope; NaN where the distance has none.
    """

    def one(point):
        slope, rise = _slopes(sim, home + (1 - point.gap) * (point.z - home))
        along, usable = _along(slope, rise)
        share = jnp.linalg.norm(along) / jnp.maximum(jnp.linalg.norm(rise), NEAREST)
        return jnp.where(usable, share, jnp.nan)

    return jax.vmap(one)(points)
