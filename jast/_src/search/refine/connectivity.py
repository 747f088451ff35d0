"""Paths between failures that keep to the failures: what makes two of them one mode."""

from functools import partial

import numpy as np

from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.normal_space.evaluate_points import PointEvaluator
from jast._src.normal_space.transform import unit
from jast._src.search.refine.candidates import shift_in_time
from jast._src.util.pytrees import count_numbers

__all__ = [
    "ALIKE",
    "Paths",
    "assigned",
    "components",
    "distinct_points",
    "moved_in_time",
    "nearest",
]

PLACES = 7  # points of a path between two failures, at first
LIFTS = 1.0, 1.03, 1.06, 1.1
"""How much farther out than the line between the two a path may run: a tenth of the way from the
origin, at most."""
OPPOSITE = -0.5  # the cosine of two failures below which no path is looked for
ALIKE = 0.8  # the cosine from which two are alike, where nothing can be simulated
FINE = 0.1
"""Angle, in radians, between two places of a path that is believed: between the two sides of
README's lane there is one with eight gaps of .12, of which one holds no failure."""
RARER = 1.0  # by how many nats the way between two modes may be rarer than the rarer of them
BENT = 0.1  # how far beside the line a path may bend, as a share of the way from the origin
MOVES = 2  # moves of the points of a path that is bent
TRIALS = 8
"""Candidates of a move, of which the best is taken. Of the failures of the ferry straight paths
make 10, 13 and 11 modes (three keys, 6,000 evaluations at most) and these one (14,300 at most); of
the ship's 12 and 7 (within 12,500: 7, 8 with four moves, 9 with one move or six trials). The two of
the lane and of the arm, four branches and the 14 found of "2 of 10" and of "series 60, turned" stay
apart.
"""
PAIRS = 32  # paths looked for at a time, of all modes
MIN_PAIRS = 2  # of each mode, at least
IN_VAIN = 4  # times in a row that paths by way of others join no two modes, which are enough


def components(
    paths: "Paths", v: np.ndarray, ends: np.ndarray, cost: np.ndarray, n: int
) -> np.ndarray:
    """Which failures are joined by paths, be it by way of others: a graph that grows from the first
    ``n``, along the pairs that point most nearly in the same direction.

    Args:
        paths: looks for them. Where its budget is used up, the first ``n`` are told apart by
            direction alone.
        v: [N, D] normal numbers.
        ends: [N] steps.
        cost: [N] how much rarer each is than the mode, in nats.
        n: refined failures, whose components are wanted.

    Returns:
        [N]: a number of the component of each.
    """
    ways, owner, edges = unit(v), np.arange(len(v)), np.zeros((0, 2), int)
    cosine = ways @ ways.T
    untried, left = cosine > OPPOSITE, n
    # straight from one of the first n to another, until all are tried, or by way of others, until
    # that is in vain: what pays is done more often
    reach, joins, tries, in_vain, most = (n, len(v)), [1, 1], [1, 1], [0, 0], (np.inf, IN_VAIN)
    while left > 1 and (ways := [w for w in (0, 1) if in_vain[w] < most[w]]):
        way = max(ways, key=lambda w: joins[w] / tries[w])
        m = reach[way]
        open = untried[:m, :m] & _useful(owner[:m], cost[:m], n)
        pairs = _nearest_pairs(cosine[:m, :m], open, owner[:m], np.unique(owner[:n]))
        if not len(pairs):
            in_vain[way] = np.inf
            continue
        if paths.room:
            pairs = pairs[: paths.room]
            i, j = pairs.T
            joined = paths.between((v[i], ends[i]), (v[j], ends[j]))
        else:
            pairs = np.argwhere(np.triu(untried[:n, :n], 1))
            joined = cosine[tuple(pairs.T)] > ALIKE
        untried[tuple(pairs.T)] = untried[tuple(pairs.T[::-1])] = False
        edges = np.concatenate([edges, pairs[joined]])
        owner = _grown(edges, cost, n)
        fewer = left - (left := len(np.unique(owner[:n])))
        in_vain[way] = 0 if fewer else in_vain[way] + 1
        joins[way], tries[way] = joins[way] + fewer, tries[way] + len(pairs)
    return owner


def _useful(owner, cost, n):
    """Of which pairs [N, N] a path could join two modes."""
    low = np.full(owner.max() + 1, cost[:n].max())
    tops = np.unique(owner[:n])
    low[tops] = [cost[:n][owner[:n] == k].min() for k in tops]
    rarest = np.maximum(low[owner][:, None], low[owner])
    return (np.maximum(cost[:, None], cost) <= rarest + RARER) & (owner[:, None] != owner)


def _grown(edges, cost, n):
    """The component of each, by the paths ``edges`` [m, 2], likely ones first: so where two with
    some of the first ``n`` meet it is by the likeliest way between them, and they stay two modes if
    that is too rare.
    """
    owner, low = np.arange(len(cost)), np.where(np.arange(len(cost)) < n, cost, np.inf)
    rarer = cost[edges].max(axis=1)
    for k in np.argsort(rarer, kind="stable"):
        a, b = owner[edges[k]]
        rarest = max(low[a], low[b])
        if a != b and (rarest == np.inf or rarer[k] <= rarest + RARER):
            owner[owner == a] = b
            low[b] = min(low[a], low[b])
    return owner


def _nearest_pairs(cosine, open, owner, tops):
    """Of each of the components ``tops`` those of the pairs ``open`` [N, N] that are nearest in
    direction: [m, 2], the nearest first.
    """
    found, each = set(), max(MIN_PAIRS, PAIRS // len(tops))
    for k in tops:
        mine = np.flatnonzero(owner == k)
        worth = np.where(open[mine], cosine[mine], -np.inf)
        best = np.argsort(-worth, axis=None, kind="stable")[:each]
        a, b = np.unravel_index(best[np.isfinite(worth.flat[best])], worth.shape)
        found.update((min(pair), max(pair)) for pair in zip(mine[a].tolist(), b.tolist()))
    return np.array(sorted(found, key=lambda pair: -cosine[pair]), int).reshape(-1, 2)


def assigned(paths, many, known, owner, none=None):
    """Of each of ``many`` failures (points [m, D], steps [m]) the owner, given those of ``known``
    (points [n, D], steps [n]). Without a path it is ``none``, or the one that is nearest.
    """
    (w, ends), (v, known_ends) = many, known
    order = np.argsort(-unit(w) @ unit(v).T, axis=1)
    out = owner[order[:, 0]] if none is None else np.full(len(w), none)
    left = np.ones(len(w), bool)
    for k in range(min(order.shape[1], 8)):
        rows = np.flatnonzero(left)
        if not len(rows):
            break
        other = order[rows, k]
        joined = paths.between((w[rows], ends[rows]), (v[other], known_ends[other]))
        out[rows[joined]] = owner[order[rows[joined], k]]
        left[rows[joined]] = False
    return out


def distinct_points(
    v: np.ndarray, *, distance: float | None = None, cosine: float | None = None
) -> list[int]:
    """Which of the points ``v`` [n, D] are the same as none of those before them: [m]. The same are
    two that are no farther from one another than ``distance`` times the second one's way from the
    origin, or whose directions have at least this ``cosine``.
    """
    chosen = []
    for i, point in enumerate(v):
        if distance is not None:
            size = distance * max(float(np.linalg.norm(point)), 1e-12)
            same = np.linalg.norm(v[chosen] - point, axis=1) <= size
        else:
            same = unit(v[chosen]) @ unit(point) >= cosine
        if not same.any():
            chosen.append(i)
    return chosen


def nearest(w, v):
    """Of each of the points ``w`` [m, D] the index of that of ``v`` [n, D] in whose direction it
    lies most nearly: [m].
    """
    return np.argmax(unit(w) @ unit(v).T, axis=1)


class Paths:
    """Looks for paths of failures between points of ``sim``, `normal_space.mode_coordinates`, for
    at most ``budget`` evaluations.
    """

    def __init__(self, sim: Simulator, budget: int):
        self.sim, self.budget, self.judge = sim, budget, PointEvaluator(sim, most=budget)
        self.rng = np.random.default_rng(0)  # of moves: the same failures are always told the same

    @property
    def spent(self) -> int:
        return self.judge.spent

    @property
    def room(self) -> int:
        """The straight paths that the rest of the budget does for, nearly: one that is no path
        takes a lift at each try, another one a place each. What bends ends within the budget.
        """
        return max(self.budget - self.spent, 0) // (PLACES + len(LIFTS))

    def between(self, first, second):
        """Whether there is a path between each of the failures ``first`` and that of ``second``
        (points [n, D], steps [n]), as they are or with the shorter one moved in time, so that both
        end together: [n].
        """
        (v, v_ends), (w, w_ends) = first, second
        joined = self.straight(v, w)
        rows = np.flatnonzero(~joined & (v_ends != w_ends))
        if len(rows):
            sooner = (v_ends <= w_ends)[rows, None]
            early, late = np.where(sooner, v[rows], w[rows]), np.where(sooner, w[rows], v[rows])
            steps = np.abs(w_ends - v_ends)[rows]
            moved = moved_in_time(self.sim, early, steps)
            joined[rows] = self.straight(moved, late, of_both=True)
        return joined

    def straight(self, v, w, of_both=False):
        """Whether the arc between each of ``v`` [n, D] and that of ``w`` keeps to the failures:
        [n]. ``of_both``: ``v`` itself is yet to be seen failing.
        """
        cosine = np.sum(unit(v) * unit(w), axis=1)
        if len(v) > self.room:
            return cosine > ALIKE
        joined = cosine > OPPOSITE  # no arc is meant between opposite points
        places = np.arange(0 if of_both else 1, PLACES + 1) / (PLACES + 1)
        middle = places == 0.5  # first: most that leave the failures have left them there
        for t in (places[middle], places[~middle]):
            self._keep(joined, joined, v, w, t)
        gaps, angle = PLACES + 1, np.arccos(np.clip(cosine, -1, 1))
        while (wide := joined & (angle > FINE * gaps)).any():
            self._keep(joined, wide, v, w, (np.arange(gaps) + 0.5) / gaps)
            gaps *= 2
        return joined

    def _keep(self, joined, among, v, w, t):
        """Of the pairs ``among`` [n] only those stay ``joined`` that fail at the shares ``t``."""
        rows = np.flatnonzero(among)
        points = _arcs(v[rows], w[rows], t).reshape(-1, v.shape[1])
        out, ways = self.failing(points), np.tile(unit(w[rows]) - unit(v[rows]), (len(t), 1))
        out[~out] = self.bent(points[~out], ways[~out])
        joined[rows] = out.reshape(len(t), -1).all(0)

    def failing(self, points):
        """Which of ``points`` [n, D] fail as they are or a little farther out: [n]."""
        out = np.zeros(len(points), bool)
        for lift in LIFTS:
            rows = np.flatnonzero(~out)
            if len(rows):
                out[rows] = self.judge(lift * points[rows]).failure
        return out

    def bent(self, points, ways):
        """Beside which of ``points`` [n, D] there is a failure to which the path may bend: [n].
        Moves that lower the miss distance look for it, across the path, whose direction there is
        that of ``ways`` [n, D]: so no place slips along the path out of a gap.
        """
        found, at, norm = np.zeros(len(points), bool), points.copy(), np.linalg.norm(points, axis=1)
        along = unit(_across(ways, unit(points)))
        for _ in range(MOVES):
            rows = np.flatnonzero(~found)
            if not len(rows) or self.spent + TRIALS * len(rows) > self.budget:
                break
            moves = self.rng.standard_normal((len(rows), TRIALS, points.shape[1]))
            moves = unit(_across(moves, along[rows, None])) * norm[rows, None, None]
            tried = at[rows, None] + BENT / MOVES * moves
            score = self.judge(tried.reshape(-1, points.shape[1])).score.reshape(-1, TRIALS)
            at[rows] = tried[np.arange(len(rows)), np.argmin(score, axis=1)]
            found[rows] = score.min(axis=1) == -np.inf
        return found


def moved_in_time(sim: Simulator, v: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """The points ``v`` [n, D] with their disturbances so many ``steps`` [n] later, sooner where
    negative; what comes in is the mode. On the host.
    """
    first, steps = count_numbers(signature_of(sim).x0), steps[:, None]
    return shift_in_time(v, steps, np.zeros(steps.shape), first, sim.horizon)[:, 0]


def _across(a, b):
    """``a`` [..., D] less what of it is along the unit vectors ``b``."""
    return a - np.sum(a * b, axis=-1, keepdims=True) * b


def _arcs(v, w, t):
    """Points [T, n, D] of the arcs between ``v`` [n, D] and ``w``, at the shares ``t`` [T]."""
    norm, t = partial(np.linalg.norm, axis=-1, keepdims=True), t[:, None, None]
    line = (1 - t) * unit(v) + t * unit(w)
    size = (1 - t) * norm(v) + t * norm(w)
    return np.where(norm(line) > 1e-3, unit(line) * size, 0)  # opposite points have no arc
