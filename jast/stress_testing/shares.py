"""Which part of the probability of failure is of which failure mode."""

import math
from typing import Any

import jax
import numpy as np

from jast import limit_state as latent
from jast.counter import numpy_generator
from jast.estimate.batches import resampled
from jast.estimate.redrawn import redrawn
from jast.estimate.sample import Sample
from jast.intervals import of_effective
from jast.search.centred import centred
from jast.search.failure_modes import UNKNOWN, Modes
from jast.search.paths import Paths, assigned, nearest
from jast.simulator import Simulator

__all__ = ["corrected", "cost", "shares"]

DRAWS, LARGE, LEAST = (1024, 4096), 100_000, 10_000
"""Draws of the proposal, the more of them from the next number of evaluations of the whole budget
on; below the last they would be too great a part of it, and nothing is told.
"""
PART, PATHS, WALKS = 4, 128, 0.05
"""Of this many draws one failure is chosen, by weight; failures that are told apart by paths, too,
and what these may cost, as a share of the budget.
"""


def cost(budget: int) -> int:
    """Evaluations that `shares` takes at most, nearly: the last paths may take a little more."""
    n = _draws(budget)
    return n + n // PART + int(WALKS * budget) if n else 0


def shares(
    key: jax.Array, sim: Simulator, q: Any, modes: Modes, budget: int
) -> tuple[Modes, int, int]:
    """``modes`` with the share of the probability that each has and its 95 % interval, told from
    failures of ``q``: of a proposal, or of the `Sample` that populations leave.

    Every failure is of the mode in whose direction it lies; a part of them are told apart by paths,
    too, and say how many of those that lie towards one mode are of another. What a path says is
    taken as the truth: of the failures of the README's lane, of which many are far out and near to
    both sides, it names the side on which they left the lane for four of five, for either side.

    Returns:
        (`Modes`, whose shares are NaN where there was nothing to tell them from; draws that failed;
        evaluations).
    """
    n, k = _draws(budget), len(modes)
    if k == 1:
        return _told(modes, np.ones(1), [(1.0, 1.0)]), 0, 0
    unknown = _told(modes, np.full(k, np.nan), [UNKNOWN] * k)
    if not n:
        return unknown, 0, 0
    z, unit, failing, spent = _failures(key, sim, q, n)
    if not failing:
        return unknown, 0, spent
    of_modes = centred(sim)
    place = lambda e: (latent.normal_of(of_modes, e).astype(np.float64), np.asarray(e.length))
    bests = [m.failure._replace(states=None) for m in modes]
    known = place(jax.tree.map(lambda *a: np.stack([np.asarray(b) for b in a]), *bests))
    points, ends = place(latent.played(sim, z))
    every = len(z) // PATHS
    few = np.arange(every // 2, len(z), every)
    paths = Paths(of_modes, int(WALKS * budget))
    exact = assigned(paths, (points[few], ends[few]), known, np.arange(k))
    found = corrected(nearest(points, known[0]), few, exact, unit, k)
    return _told(modes, *found), failing, spent + len(z) + paths.spent


def corrected(
    near: np.ndarray, few: np.ndarray, exact: np.ndarray, unit: np.ndarray, k: int
) -> tuple[np.ndarray, list[tuple[float, float]]]:
    """The shares of ``k`` modes and their 95 % intervals.

    The variance is that of what each independent unit adds to an error (of first order), by which
    the choice of the failures, their weights and the correction all count. Where none or all
    failures are of a mode, as many of the ``few`` as are independent bound its share, as counts.

    Args:
        near: [m] the mode in whose direction each failure lies.
        few: [f] those of them that were told apart by paths, and
        exact: [f] their modes.
        unit: [m] the draw, or the first point of a population, that each comes from; units are
            independent.
        k: modes.

    Returns:
        (shares [k], their (low, high)).
    """
    one, m = np.eye(k), len(near)
    seen = one[near[few]].T @ one[exact]
    looked = seen.sum(axis=1, keepdims=True)
    truly = np.where(looked > 0, seen / np.maximum(looked, 1), one)  # [near, exact]
    lying = one[near].mean(axis=0)
    found = lying @ truly
    error = (truly[near] - found) / m
    weight = lying[:, None] / np.maximum(looked, 1)
    error[few] += weight[near[few]] * (one[exact] - truly[near[few]])
    _, unit = np.unique(unit, return_inverse=True)
    added = np.stack([np.bincount(unit, e) for e in error.T], axis=1)
    variance = (added**2).sum(axis=0) * len(added) / max(len(added) - 1, 1)
    independent, among_few = _effective(unit), _effective(unit[few])

    def interval(share, variance):
        if not 0 < share < 1:
            return of_effective(share, among_few, math.inf if independent > 1 else 0.0)
        number = min(share * (1 - share) / max(variance, 1e-300), m)
        return of_effective(share, number, independent - 1)

    return found, [interval(*map(float, pair)) for pair in zip(found, variance, strict=True)]


def _effective(unit):
    """How many units of equal size would be as independent as these."""
    return float(len(unit) ** 2 / (np.bincount(unit) ** 2.0).sum())


def _failures(key, sim, q, n):
    """Failures chosen by weight (points [m, D], the independent unit of each [m]), how many there
    were, and evaluations.
    """
    if isinstance(q, Sample):  # which have been run
        rows = resampled(q.log_weight, n // PART, numpy_generator(key).random())
        return q.points[rows], q.group[rows], len(q.points), 0
    z, o, log_w = redrawn(key, sim, q, n)
    if not (failing := int(o.failure.sum())):
        return z[:0], np.zeros(0, int), 0, n
    rows = resampled(np.where(o.failure, log_w.astype(np.float64), -np.inf), n // PART, 0.5)
    return z[rows], rows, failing, n


def _told(modes, found, intervals):
    pairs = zip(modes, found, intervals, strict=True)
    told = (m._replace(share=float(s), share_interval=tuple(i)) for m, s, i in pairs)
    return Modes(told, modes.evaluations)


def _draws(budget):
    return 0 if budget < LEAST else DRAWS[budget >= LARGE]
