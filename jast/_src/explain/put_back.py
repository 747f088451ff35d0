"""Numbers of a failing episode put back to their modes, as many and as far as it still fails."""

from __future__ import annotations

import numpy as np

from jast._src.normal_space.episode_point import EpisodePoint

__all__ = ["find_needed", "shrink"]

SECTIONS = 31  # places between two ends that are looked at together
SWEEPS = 3  # rounds of shrinking one number after the other


def find_needed(g: EpisodePoint, orders: int, budget: int) -> tuple[np.ndarray, np.ndarray]:
    """([D] bool: the fewest numbers that are not 0 at the end of any order, [D] bool: those without
    which it was tried).
    """
    rng = np.random.default_rng(0)
    size = np.abs(g.v)
    live = np.flatnonzero(size)
    with np.errstate(divide="ignore"):
        noise = np.concatenate([np.zeros((1, len(live))), rng.gumbel(size=(orders - 1, len(live)))])
        order = live[np.argsort(np.log(size[live]) + noise, axis=1)]
    points = np.tile(g.v, (orders, 1))
    # of each order what lies before ``at`` is decided
    at = np.zeros(orders, int)
    for rows in (slice(1), slice(orders)):  # the order by size is through before the others begin
        while (at[rows] < len(live)).any() and g.evaluate.spent < budget:
            points[rows], at[rows] = _advance(g, points[rows], order[rows], at[rows])
    counts = (points != 0).sum(axis=1)
    best = np.lexsort(((points**2).sum(axis=1), counts))[0]
    tried = np.zeros(len(g.v), bool)
    tried[order[best, : at[best]]] = True
    return _spare_one_by_one(g, points[best], tried, budget)


def _fails(g: EpisodePoint, points: np.ndarray) -> np.ndarray:
    """Whether the ``points`` fail; of a black box the first ones, those its budget affords."""
    before = g.evaluate.spent
    return g.evaluate(points).failure[: g.evaluate.spent - before]


def _advance(g: EpisodePoint, points: np.ndarray, order: np.ndarray, at: np.ndarray):
    """Put back as much of what comes next in each order as can be in one piece; the number behind
    the piece stays, where it was tried.
    """
    n = order.shape[1]
    # all before low can be spared, not all before high; n + 1: that is not known
    low, high = at.copy(), np.full(len(at), n + 1)
    rows = np.flatnonzero(at < n)
    first = True
    while len(rows):
        ends = [np.linspace(low[i], min(high[i], n), SECTIONS + 1).round() for i in rows]
        tried = [np.unique(e).astype(int)[1 : None if first else -1] for e in ends]
        batch = [_at_mode(points[i], order[i, at[i] : e]) for i, t in zip(rows, tried) for e in t]
        fails = _fails(g, np.stack(batch))
        known = iter(fails)
        for i, t in zip(rows, tried):
            said = list(zip(t, known))  # fewer than t where the budget ends
            low[i] = max((e for e, failing in said if failing), default=low[i])
            high[i] = min((e for e, _ in said if e > low[i]), default=high[i])
        if len(fails) < len(batch):
            break
        rows, first = rows[high[rows] - low[rows] > 1], False
    for i in range(len(at)):
        points[i] = _at_mode(points[i], order[i, at[i] : low[i]])
    return points, np.where(high - low == 1, np.minimum(low + 1, n), low)


def _at_mode(point: np.ndarray, which: np.ndarray) -> np.ndarray:
    out = point.copy()
    out[which] = 0.0
    return out


def _spare_one_by_one(g: EpisodePoint, point: np.ndarray, tried: np.ndarray, budget: int):
    """(bool [D]: those of ``point`` that cannot be spared one by one, ``tried`` with these)."""
    while g.evaluate.spent < budget and (left := np.flatnonzero(point)).size:
        left = left[np.argsort(np.abs(point[left]))]
        each = np.tile(point, (len(left), 1))
        each[np.arange(len(left)), left] = 0.0
        fails = _fails(g, each)
        tried[left[: len(fails)]] = True
        if not fails.any():
            break
        point = each[np.flatnonzero(fails)[-1]]
    return point != 0, tried


def shrink(g: EpisodePoint, point: np.ndarray, budget: int) -> np.ndarray:
    """``point`` nearer to the mode, all numbers at first and then each alone."""
    left = np.flatnonzero(point)
    point = _scale(g, point, left)
    for _ in range(SWEEPS):
        before = point
        for i in left:
            if g.evaluate.spent >= budget:
                return point
            point = _scale(g, point, np.array([i]))
        if np.allclose(before, point, rtol=1e-3, atol=0):
            break
    return point


def _scale(g: EpisodePoint, point: np.ndarray, which: np.ndarray) -> np.ndarray:
    """``point`` with the numbers ``which`` shrunk by the least factor, to 1 / 1024, that leads over
    failures alone.
    """
    low, high = 0.0, 1.0
    for _ in range(2):
        factors = np.linspace(high, low, SECTIONS + 2)[1:-1]
        each = np.tile(point, (len(factors), 1))
        each[:, which] *= factors[:, None]
        fails = g.evaluate(each).failure
        reached = len(fails) if fails.all() else int(np.argmin(fails))
        low = factors[reached] if reached < len(fails) else low
        high = factors[reached - 1] if reached else high
    out = point.copy()
    out[which] *= high
    return out
