"""One round of `jast.search.refine`: every point's candidates, the cheapest of them that fails, and
the slopes that the next candidates follow. The system's steps are in two programs alone, that of
`normal_space.evaluate_points` and that of the gradients.
"""

import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.gradients import gradients
from jast._src.normal_space.transform import Outcomes
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.refine.candidates import (
    NEAREST,
    RAYS,
    Noise,
    Point,
    boundary_direction,
    candidates,
    resize_steps,
)

__all__ = ["first_points", "residuals", "round_of"]

FIRST_GAP = 0.3  # how far inside the failures a point may be at first, as a share of its norm
FIRST_WIDTH = 0.5  # of the first random steps, likewise
ASIDE = 1e-4  # how far aside numbers at 0 are moved for gradients: there may be a kink
OUTSIDE = 0.01  # how far outside of them gradients are taken at most, as a share of the way there
EDGE = 0.05  # how far outside of them differences are taken at least


def first_points(sim: Simulator, v: np.ndarray) -> tuple[Point, np.ndarray]:
    """The `Point` of each of ``v`` [n, D], and which of them fail."""
    o = _judged(sim, v[:, None])
    one, zero = np.ones(len(v), v.dtype), np.zeros_like(v)
    point = Point(
        v=v,
        cost=-o.log_p[:, 0].astype(v.dtype),
        used=o.used[:, 0],
        gap=FIRST_GAP * one,
        length=one,
        width=FIRST_WIDTH * one,
        last=zero,
        slope=zero,
        rise=zero,
    )
    return point, o.failure[:, 0]


def round_of(
    sim: Simulator, first: int, points: Point, noise: Noise, part: np.ndarray | None
) -> tuple[Point, int]:
    """One round of all ``points`` [n] with their ``noise``, and how many of the candidates were
    invalid. ``part`` [k]: the numbers whose slopes are told anew, by differences; None: those of
    all, by gradients. ``first``: how many numbers are of the start.
    """
    told = _gradients(sim, points) if part is None else _differences(sim, points, part)
    usable = _usable(*told)
    slope, rise = (np.where(usable, a, 0) for a in told)
    points = points._replace(slope=slope, rise=rise)
    tried = candidates(points, noise, first, sim.horizon)
    o = _judged(sim, tried)
    cost = np.where(o.failure, -o.log_p, np.inf).astype(tried.dtype)
    i, rows = np.argmin(cost, axis=1), np.arange(len(cost))
    better = cost[rows, i] < points.cost
    new = resize_steps(points, i, better, o.failure[:, :RAYS])
    decides = np.arange(tried.shape[2]) < o.used[rows, i][:, None]
    best = np.where(decides, tried[rows, i], 0)  # the others stay at the mode
    new = new._replace(
        v=np.where(better[:, None], best, points.v),
        cost=np.where(better, cost[rows, i], points.cost),
        used=np.where(better, o.used[rows, i], points.used),
        last=np.where(better[:, None], best - points.v, points.last),
    )
    return new, int(o.invalid.sum())


def residuals(points: Point) -> np.ndarray:
    """How far each of ``points`` [n] was, at its last round, from the conditions of Karush, Kuhn
    and Tucker: the slope of its cost along the boundary, as a share of the whole slope; NaN where
    the distance has none.
    """
    whole = np.maximum(np.linalg.norm(points.rise, axis=1), NEAREST)
    share = np.linalg.norm(boundary_direction(points), axis=1) / whole
    return np.where(_usable(points.slope, points.rise)[:, 0], share, np.nan)


def _judged(sim: Simulator, v: np.ndarray) -> Outcomes:
    """The `Outcomes` [n, k] of the episodes of ``v`` [n, k, D]. A black box runs those of one point
    at a time: its programs then have few shapes.
    """
    n, k, d = v.shape
    parts = v if runs_on_host(sim) else v.reshape(1, n * k, d)
    found = [evaluate_points(sim, part) for part in parts]
    return Outcomes(*(np.concatenate(a).reshape(n, k) for a in zip(*found, strict=True)))


def _usable(slope, rise):
    """Whether the slopes lead anywhere [n, 1]."""
    finite = np.isfinite(slope).all(axis=1) & np.isfinite(rise).all(axis=1)
    return (finite & slope.any(axis=1))[:, None]


def _gradients(sim, points):
    """The gradients of the distance and of the cost, a little outside of the failures. Numbers at 0
    are moved aside for it, to where the distance fell.
    """
    v = (1 - np.minimum(points.gap, OUTSIDE))[:, None] * points.v
    v = np.where(v == 0, -ASIDE * np.sign(points.slope), v).astype(points.v.dtype)
    g = gradients(sim, v)
    return g.slope, g.rise


def _differences(sim, points, part):
    """Both slopes with the numbers ``part`` told anew, from differences outside the failures."""
    gap, radius = np.maximum(EDGE, points.gap), np.linalg.norm(points.v, axis=1)
    edge = ((1 - gap)[:, None] * points.v)[:, None]
    h = (0.2 * EDGE * np.maximum(radius, 1e-3)).astype(points.v.dtype)
    moved = edge.repeat(len(part), axis=1)
    moved[:, np.arange(len(part)), part] += h[:, None]
    o = _judged(sim, np.concatenate([edge, moved], axis=1))
    slopes = []
    for before, value in ((points.slope, o.distance), (points.rise, -o.log_p)):
        with np.errstate(invalid="ignore"):
            told = (value[:, 1:] - value[:, :1]) / h[:, None]
        slope = before.copy()
        slope[:, part] = np.where(np.isfinite(told) & ~o.invalid[:, 1:], told, 0)
        slopes.append(slope)
    return slopes
