"""One round of `jast.search.refine`: every point's candidates, the cheapest of them that fails, and
the slopes that the next candidates follow.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast.episode import rollout
from jast.limit_state import ended, policy_of
from jast.outline import outline
from jast.pytrees import count
from jast.rewards import likelihood
from jast.search import moves as M
from jast.simulator import Simulator

__all__ = ["Verdict", "begun", "residuals", "round_of"]

ASIDE, OUTSIDE = 1e-4, 0.01
EDGE = 0.05
"""How far aside numbers at 0 are moved for gradients, and how far outside of the failures, as a
share of the way to the origin, these are taken at most; where differences are taken at least.
"""


class Verdict(NamedTuple):
    """What episodes came to."""

    failure: Any
    cost: Any
    """log p(mode) - log p; inf where invalid"""
    distance: Any
    invalid: Any
    used: Any
    """int32: how many of the numbers decided it"""


def _judge(sim: Simulator, v: jax.Array) -> Verdict:
    """The `Verdict` of the episode of ``v`` [D]."""
    end, length = ended(sim, v, likelihood(sim))
    about = outline(sim)
    used = count(about.x0) + length * count(about.x)
    cost = jnp.where(end.invalid, jnp.inf, -end.reward)
    return Verdict(end.failure, cost.astype(v.dtype), end.distance, end.invalid, used)


@jax.jit
def begun(sim: Simulator, v: jax.Array) -> tuple[M.Point, Verdict]:
    """The `Point` of each of ``v`` [n, D], and the `Verdict`."""
    verdict = jax.vmap(partial(_judge, sim))(v)
    full = lambda value: jnp.full(len(v), value, v.dtype)
    zero = jnp.zeros_like(v)
    sizes = full(0.3), full(1), full(0.5)
    return M.Point(v, verdict.cost, verdict.used, *sizes, zero, zero, zero), verdict


@partial(jax.jit, static_argnums=3)
def round_of(
    sim: Simulator, points: M.Point, noise: M.Noise, gradients: bool
) -> tuple[M.Point, jax.Array]:
    """One round of all ``points`` [n] with their ``noise`` [n], and how many of the candidates of
    each were invalid [n].
    """
    return jax.vmap(partial(_round, sim, gradients))(points, noise)


def _round(sim, gradients, point, noise):
    slope, rise = (_slopes if gradients else _differences)(sim, point, noise.part)
    usable = _usable(slope, rise)
    slope, rise = (jnp.where(usable, a, 0) for a in (slope, rise))
    moves = M.around(sim, point, slope, rise, noise)
    verdict = jax.vmap(partial(_judge, sim))(moves)
    cost = jnp.where(verdict.failure, verdict.cost, jnp.inf)
    i = jnp.argmin(cost).astype(jnp.int32)
    better = cost[i] < point.cost
    new = M.resized(point, i, better, verdict.failure[: M.RAYS])._replace(slope=slope, rise=rise)
    took = lambda a, b: jnp.where(better, a, b)
    decides = jnp.arange(len(point.v), dtype=jnp.int32) < verdict.used[i]
    best = jnp.where(decides, moves[i], 0)  # the others stay at the mode
    new = new._replace(
        v=took(best, point.v),
        cost=took(cost[i], point.cost),
        used=took(verdict.used[i], point.used),
        last=took(best - point.v, point.last),
    )
    return new, jnp.sum(verdict.invalid, dtype=jnp.int32)


def _usable(slope, rise):
    """Whether the slopes lead anywhere."""
    square = jnp.sum(slope**2)
    return jnp.isfinite(square) & (square > 0) & jnp.all(jnp.isfinite(rise))


def _slopes(sim, point, _):
    """The gradients of the distance and of the cost, a little outside of the failures. Numbers at 0
    are moved aside for it, to where the distance fell: there may be a kink.
    """
    v = (1 - jnp.minimum(point.gap, OUTSIDE)) * point.v
    v = jnp.where(v == 0, -ASIDE * jnp.sign(point.slope), v)

    def both(v):
        e = rollout(jax.random.key(0), sim, policy_of(sim, v), likelihood(sim))
        return e.distance, -e.reward

    (distance, _), back = jax.vjp(both, v)
    one, zero = jnp.ones_like(distance), jnp.zeros_like(distance)
    return back((one, zero))[0], back((zero, one))[0]


def _differences(sim, point, part):
    """Both slopes with the numbers ``part`` told anew, from differences outside the failures."""
    gap, radius = jnp.maximum(EDGE, point.gap), jnp.linalg.norm(point.v)
    edge, h = (1 - gap) * point.v, 0.2 * EDGE * jnp.maximum(radius, 1e-3)
    rows = jnp.arange(len(part), dtype=jnp.int32)
    there = _judge(sim, edge)
    moved = jax.vmap(partial(_judge, sim))(edge[None].repeat(len(part), 0).at[rows, part].add(h))
    good = jnp.isfinite(moved.distance) & jnp.isfinite(moved.cost)
    told = lambda a, b: jnp.where(good, (a - b) / h, 0)
    slope = point.slope.at[part].set(told(moved.distance, there.distance))
    return slope, point.rise.at[part].set(told(moved.cost, there.cost))


@jax.jit
def residuals(points: M.Point) -> jax.Array:
    """How far each of ``points`` [n] was, at its last round, from the conditions of Karush, Kuhn
    and Tucker: the slope of its cost along the boundary, as a share of the whole slope; NaN where
    the distance has none.
    """

    def one(point):
        usable = _usable(point.slope, point.rise)
        along = M.along(point, point.slope, point.rise)
        share = jnp.linalg.norm(along) / jnp.maximum(jnp.linalg.norm(point.rise), M.NEAREST)
        return jnp.where(usable, share, jnp.nan)

    return jax.vmap(one)(points)
