"""Which part of the probability of failure is of which failure mode."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.episode import Episode, stacked
from jast._src.core.simulator import Simulator
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.estimate.redraw import redraw
from jast._src.normal_space import transform
from jast._src.normal_space.mode_coordinates import centred
from jast._src.normal_space.transform import unit
from jast._src.search.refine.connectivity import ALIKE, Paths, assigned, nearest
from jast._src.search.refine.modes import UNKNOWN, Modes
from jast._src.util.intervals import effective_interval
from jast._src.util.pytrees import index_tree

__all__ = ["corrected_shares", "mode_shares", "shares_cost"]

MIN_BUDGET = 10_000  # of the whole, below which nothing is told: draws would be too great a part
LARGE_BUDGET = 100_000  # evaluations of the whole budget from which on there are more draws
SMALL_DRAWS = 1024  # draws of the proposal below a large budget: a tenth of it at most
LARGE_DRAWS = 4096  # the same with a large budget: shares are then known to a few per cent
DRAWS_PER_FAILURE = 4  # of this many draws one failure is chosen, by weight
ONE_MODE_DRAWS = 256  # draws where one mode is known: do all failures belong to it?
MAX_PATH_FAILURES = 128  # failures that are told apart by paths, too
AT_A_TIME = 4  # of these: so many have their paths before it is seen whether more can be paid
PATHS_SHARE = 0.05  # share of the budget that these paths may cost
ONE_MODE_PATHS_SHARE = 0.02  # the same where one mode is known
SOME_OTHERS = 0.05  # share of the failures from which on those of no known mode are looked into
TOWARDS = 2.0
"""How far towards the likeliest failure of a mode one lies at least, in standard deviations, that
is of it without a path; and half of the way. In a direction that is none of its own a failure is so
far out once in 44 times."""


def shares_cost(budget: int, modes: int = 2) -> int:
    """Evaluations that `mode_shares` of so many ``modes`` takes at most, nearly: the last paths may
    take more.
    """
    n = _number_of_draws(budget, modes)
    return n + n // DRAWS_PER_FAILURE + _paths_budget(budget, modes) if n else 0


def mode_shares(
    key: jax.Array,
    sim: Simulator,
    q: Any,
    modes: Modes,
    budget: int,
    more: Callable[[Episode], Modes] | None = None,
) -> tuple[Modes, int, int]:
    """``modes`` with the share of the probability that each has and its 95 % interval, told from
    failures of ``q``: of a proposal, or of the `Sample` that populations leave.

    Every failure is of the mode in whose direction it lies; a part of them are told apart by paths,
    too, and say how many of those that lie towards one mode are of another, or of none that is
    known: what the shares lack of 1. What a path says is taken as the truth: of the failures of the
    README's lane, of which many are far out and near to both sides, it names the side on which they
    left the lane for four of five, for either side.

    Args:
        key: of the draws.
        sim: the simulator.
        q: of the estimate.
        modes: those that are known.
        budget: evaluations of the whole.
        more: from the failures [m] that are of none of the modes, where these have `SOME_OTHERS` of
            the probability, to more modes, whose shares are told in their place. Where there are no
            more, those failures lead to the modes that are known, and are counted as theirs.

    Returns:
        (`Modes`, whose shares are NaN where there was nothing to tell them from; draws that failed;
        evaluations).
    """
    n, k = _number_of_draws(budget, len(modes)), len(modes)
    unknown = _with_shares(modes, np.full(k, np.nan), [UNKNOWN] * k)
    if not n:
        return unknown, 0, 0
    z, group, failing, spent = _draw_failures(key, sim, q, n)
    if not failing:
        return unknown, 0, spent
    of_modes = centred(sim)

    def place(e):
        return transform.normal_of(of_modes, e).astype(np.float64), np.asarray(e.length)

    episodes = transform.played(sim, z)
    points = place(episodes)
    step = max(len(z) // MAX_PATH_FAILURES, 1)
    some = numpy_generator(key, 1).permutation(np.arange(step // 2, len(z), step))
    spent, before = spent + len(z), 0
    while True:
        targets, k = place(stacked(m.failure for m in modes)), len(modes)
        most = _paths_budget(budget, k)
        paths = Paths(of_modes, 2 * most)  # so that the last ones are not cut short
        exact = _told_apart(paths, (points[0][some], points[1][some]), targets, most)
        told, spent = some[: len(exact)], spent + paths.spent
        near, others = nearest(points[0], targets[0]), told[exact == k]
        if k <= before:  # they lead to those that are known
            exact = np.where(exact < k, exact, near[told])
        if more is None or len(others) < SOME_OTHERS * len(told):
            found = corrected_shares(near, told, exact, group, k)
            return _with_shares(modes, *found), failing, spent
        before, modes, more = k, more(index_tree(episodes, others)), None


def _told_apart(paths, failures, targets, most):
    """The mode of each of the first ``failures`` (points [m, D], steps [m]) of the ``targets``
    (points [k, D], steps [k]), or k for none of them: as many as ``most`` evaluations do for. Where
    that is not for all, those that point as a target does need no path.
    """
    (points, ends), k = failures, len(targets[0])
    cosine, reach = unit(points) @ unit(targets[0]).T, points @ unit(targets[0]).T
    near, rows = np.argmax(cosine, axis=1), np.arange(len(points))
    far = reach[rows, near] >= np.maximum(TOWARDS, np.linalg.norm(targets[0], axis=1)[near] / 2)
    exact = np.where(far, near, k)  # where there is no path
    clear = (cosine.max(axis=1) > ALIKE) & (paths.room < 2 * len(points))
    exact[clear] = near[clear]
    asked = np.flatnonzero(~clear)
    for first in range(0, len(asked), AT_A_TIME):
        some = asked[first : first + AT_A_TIME]
        if paths.spent >= most:
            return exact[: some[0]]
        owner = assigned(paths, (points[some], ends[some]), targets, np.arange(k), none=-1)
        exact[some] = np.where(owner >= 0, owner, exact[some])
    return exact


def corrected_shares(
    near: np.ndarray, some: np.ndarray, exact: np.ndarray, unit: np.ndarray, k: int
) -> tuple[np.ndarray, list[tuple[float, float]]]:
    """The shares of ``k`` modes and their 95 % intervals.

    The variance is that of what each independent unit adds to an error (of first order), by which
    the choice of the failures, their weights and the correction all count. Where none or all
    failures are of a mode, as many of ``some`` as are independent bound its share, as counts.

    Args:
        near: [m] the mode in whose direction each failure lies.
        some: [f] those of them that were told apart by paths, and
        exact: [f] their modes, ``k`` for none of these.
        unit: [m] the draw, or the first point of a population, that each comes from; units are
            independent.
        k: modes.

    Returns:
        (shares [k], their (low, high)).
    """
    one_hot, m = np.eye(k + 1, k), len(near)
    total = one_hot[near[some]].sum(axis=0)[:, None]
    seen = one_hot[near[some]].T @ one_hot[exact]  # [near, exact]
    truly = np.where(total > 0, seen / np.maximum(total, 1), one_hot[:k])
    lying = one_hot[near].mean(axis=0)
    found = lying @ truly
    error = (truly[near] - found) / m
    weight = lying[:, None] / np.maximum(total, 1)
    error[some] += weight[near[some]] * (one_hot[exact] - truly[near[some]])
    _, unit = np.unique(unit, return_inverse=True)
    added = np.stack([np.bincount(unit, e) for e in error.T], axis=1)
    variance = (added**2).sum(axis=0) * len(added) / max(len(added) - 1, 1)
    independent, among_some = _effective_number(unit), _effective_number(unit[some])

    def interval(share, variance):
        if not 0 < share < 1:
            return effective_interval(share, among_some, math.inf if independent > 1 else 0.0)
        number = min(share * (1 - share) / max(variance, 1e-300), m)
        return effective_interval(share, number, independent - 1)

    return found, [interval(*map(float, pair)) for pair in zip(found, variance, strict=True)]


def _effective_number(unit):
    """How many units of equal size would be as independent as these."""
    return float(len(unit) ** 2 / (np.bincount(unit) ** 2.0).sum())


def _draw_failures(key, sim, q, n):
    """Failures chosen by weight (points [m, D], the independent unit of each [m]), how many there
    were, and evaluations.
    """
    if isinstance(q, Sample):  # which have been run
        rows = resample(q.log_weight, n // DRAWS_PER_FAILURE, numpy_generator(key).random())
        return q.points[rows], q.group[rows], len(q.points), 0
    z, o, log_w = redraw(key, sim, q, n)
    if not (failing := int(o.failure.sum())):
        return z[:0], np.zeros(0, int), 0, n
    log_w = np.where(o.failure, log_w.astype(np.float64), -np.inf)
    rows = resample(log_w, n // DRAWS_PER_FAILURE, 0.5)
    return z[rows], rows, failing, n


def _with_shares(modes, shares, intervals):
    each = zip(modes, shares, intervals, strict=True)
    shared = (m._replace(share=float(s), share_interval=tuple(i)) for m, s, i in each)
    return Modes(shared, modes.evaluations)


def _paths_budget(budget, modes):
    return int((PATHS_SHARE if modes > 1 else ONE_MODE_PATHS_SHARE) * budget)


def _number_of_draws(budget, modes):
    if budget < MIN_BUDGET:
        return 0
    if modes == 1:
        return ONE_MODE_DRAWS
    return LARGE_DRAWS if budget >= LARGE_BUDGET else SMALL_DRAWS
