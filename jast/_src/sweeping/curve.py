"""The rows of a sweep joined to one curve: failures of each row are judged under its neighbours,
which tells the ratios of neighbouring probabilities better than the rows do.

P_j / P_i = P(fails in j | fails in i) / P(fails in i | fails in j), where normal numbers are the
coordinate that systems have in common (bridge sampling, Meng and Wong 1996, between densities that
are constant where an episode fails). Rows and ratios are joined by generalised least squares. Their
covariance comes from the failures: those of a row serve its own answer and both of its ratios.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.estimate.budgets import uses_populations
from jast._src.estimate.population.descents import SETTINGS
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.population.search import MAX_DISAGREEMENT, MAX_WITNESS_ERROR
from jast._src.estimate.redraw import sample_of_draws
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.transform import Latent, dimension
from jast._src.util.intervals import log_normal
from jast.estimate import Estimate

__all__ = ["join_rows"]


class Row(NamedTuple):
    """The failures of a row."""

    error: float
    """Standard error of its log probability."""
    points: np.ndarray
    """[m, D]."""
    share: np.ndarray
    """[m] weights, of sum 1."""
    family: np.ndarray
    """[m] from 0 on; members of one are not independent."""

    def family_shares(self) -> np.ndarray:
        """[G] shares of the families."""
        return np.bincount(self.family, self.share)

    def moves(self) -> np.ndarray:
        """[G] by what each family moves the log probability. They may be a part of all draws, or
        one of two ways that were pooled, whose weight is then that of its inverse variance.
        """
        share = self.family_shares()
        return min(self.error**2 / (share @ share), 1.0) * share

    def share_failing_in(self, sim: Simulator) -> tuple[float, np.ndarray]:
        """The log of the share that fails in ``sim`` too, and by what each family moves it [G]; NaN
        where that is too much.
        """
        fails = evaluate_points(sim, self.points).failure
        share = max(float(self.share @ fails), np.finfo(float).tiny)
        moves = np.bincount(self.family, self.share * (fails / share - 1))
        return (math.log(share) if moves @ moves < MAX_WITNESS_ERROR**2 else math.nan), moves


def join_rows(
    keys: Sequence[jax.Array], made: Sequence[Simulator], found: Sequence[Any]
) -> tuple[np.ndarray | None, np.ndarray | None, dict[str, Any]]:
    """The results ``found`` of `jast.estimate.failure_probability` with ``keys`` on systems of one
    kind as one curve: what `Sweep` has as ``curve`` and ``ratios``, NaN where a row takes no part,
    and what its ``settings`` then say (``judged``, ``apart``). (None, None, {}) where no two of
    them can be joined.
    """
    places = np.array([i for i, each in enumerate(zip(made, found)) if _takes_part(*each)], int)
    chain = [(keys[i], made[i], found[i]) for i in places]
    m, n = len(chain), len(found)
    if m < 2:
        return None, None, {}
    said, covariance, episodes = _measure(chain)
    steps = np.diff(np.eye(m), axis=0)
    against = np.concatenate([steps, -np.eye(m - 1)], axis=1)
    spread = np.sqrt(np.diagonal(against @ covariance @ against.T))
    apart = np.abs(against @ said) > MAX_DISAGREEMENT * spread
    used = np.isfinite(said)
    used[m:] &= ~apart
    of_curve = np.concatenate([np.eye(m), steps])[used]
    weighted = np.linalg.solve(covariance[np.ix_(used, used)], of_curve)
    covariance = np.linalg.inv(of_curve.T @ weighted)
    logs = covariance @ weighted.T @ said[used]
    errors, level = np.sqrt(np.diagonal(covariance)), chain[0][2].level
    curve, ratios = np.full((n, 3), np.nan), np.full((n - 1, 3), np.nan)
    for k in np.flatnonzero(np.append(used[m:], False) | np.append(False, used[m:])):
        ends = log_normal(logs[k], errors[k], level)
        curve[places[k]] = math.exp(min(logs[k], 0.0)), *ends
    half = NormalDist().inv_cdf((1 + level) / 2) * np.array([0, -1, 1])
    errors = np.sqrt(np.diagonal(steps @ covariance @ steps.T))
    for k in np.flatnonzero(np.diff(places) == 1):
        ratios[places[k]] = np.exp(steps[k] @ logs + half * errors[k])
    notes: dict[str, Any] = dict(judged=episodes)
    if apart.any():
        notes["apart"] = places[:-1][apart].tolist()
    return curve, ratios, notes


def _measure(chain):
    """What m rows (key, simulator, `Estimate`) say, log probabilities [m] and then log ratios
    [m - 1], NaN where these are not known; the covariance of both; and the episodes that it took.
    """
    m, episodes = len(chain), 0
    said = np.array([float(r.log_mean) for _, _, r in chain] + [0.0] * (m - 1))
    covariance = np.zeros((2 * m - 1, 2 * m - 1))
    for k, each in enumerate(chain):
        row = _row_of(*each)  # of one at a time, as points may be many
        moves = {k: row.moves()}
        for j, sign in ((k - 1, -1), (k + 1, 1)):
            if 0 <= j < m:
                at = m + min(j, k)
                log_share, of_share = row.share_failing_in(chain[j][1])
                said[at] += sign * log_share
                moves[at] = sign * of_share
                # a share of 1 is known to one effective failure
                covariance[at, at] += np.sum(row.family_shares() ** 2) ** 2
                episodes += len(row.points)
        which, columns = list(moves), np.stack(list(moves.values()))
        covariance[np.ix_(which, which)] += columns @ columns.T
        covariance[k, k] = row.error**2
    return said, covariance, episodes


def _takes_part(sim, r):
    """Whether a result is reliable, and of a cheap system whose failures are points."""
    good = isinstance(r, Estimate) and r.reliable and uses_populations(sim, r.settings["budget"])
    if not good or r.draws is None:
        return False
    return r.draws.source == "model" or isinstance(r.draws.source, Sample | Latent)


def _row_of(key, sim, r):
    """The `Row` of a result that takes part."""
    if isinstance(r.proposal, Sample) and isinstance(r.draws.source, Sample):
        sample = r.proposal
    else:  # draws of Gaussians, or of the model, which are independent
        sample = sample_of_draws(sim, r.draws, SETTINGS.max_numbers // dimension(sim))
    points, used, _, log_w, family = sample
    # what its own episode did not use may decide a neighbour's, so it is drawn from the model
    new = numpy_generator(key, 8).standard_normal(points.shape).astype(points.dtype)
    points = np.where(np.arange(points.shape[1]) < used[:, None], points, new)
    share = np.exp(log_w - np.logaddexp.reduce(log_w))
    return Row(r.relative_error, points, share, family)
