"""indices: how much each disturbance decides whether the system fails."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.exceedance_and_times import draws_and_level
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.explain.estimate_draws import UNRELIABLE, failing_draws, free_undecided, normalised
from jast._src.normal_space import transform
from jast._src.normal_space.episode_point import number_names, number_steps
from jast._src.normal_space.evaluate_points import PointEvaluator
from jast._src.util import checks, display
from jast._src.util.intervals import clopper_pearson, log_normal

__all__ = ["Index", "Indices", "indices"]

KEPT = 16_384  # failing draws that are looked at, at most
RELIABLE = 100  # effective failures, below which the answer is UNRELIABLE
WIDTH = 0.02  # of the cells in which failures are counted, in standard deviations
PRINTED = 20  # numbers


class Index(NamedTuple):
    """One number of the disturbances.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing(b=0.5)
        >>> estimate = jast.estimate.failure_probability(key, sim, 6000)
        >>> start = jast.explain.indices(key, sim, estimate, draws=50).rows[0]
        >>> start.step, start.first_interval[0] <= start.first <= start.first_interval[1]
        (0, True)
    """

    name: str
    """Its field, with its place in an array"""
    step: int
    """From 1; 0 is the start"""
    mean: float
    """Its normal number, on average over the failures: 0 where a failure does not move it"""
    first: float
    """First-order index: the share of the variance of failing that this number decides alone"""
    first_interval: tuple[Any, ...]
    """(low, high) at ``level``, of the delta method"""
    total: float
    """Total index: the share that it decides alone or together with others; NaN where not asked"""
    total_interval: tuple[Any, ...]
    """(low, high) at ``level``, of counts"""


@display.printable()
class Indices(NamedTuple):
    """Sensitivity of a failure to each number of the disturbances.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing(b=0.5)
        >>> estimate = jast.estimate.failure_probability(key, sim, 6000)
        >>> found = jast.explain.indices(key, sim, estimate, draws=50)
        >>> found.probability == estimate.mean
        True
    """

    rows: tuple[Any, ...]
    """An `Index` for each number, x0 first, then step by step"""
    probability: float
    """Of failure. The first-order index of a number that decides nothing by itself is a small
    multiple of it"""
    level: float
    ess: float
    """Effective number of failures behind the means and the first-order indices"""
    reliable: bool
    """Whether the estimate is, and there are 100 effective failures or more"""
    evaluations: int

    def __str__(self) -> str:
        lines = [] if self.reliable else [UNRELIABLE]
        lines.append(
            f"{'number':<20} {'step':>4} {'mean':>7} {'first order':>12} {'total':>7}"
            f"   {self.level:.0%} intervals"
        )
        greatest_first = sorted(self.rows, key=lambda r: (-np.nan_to_num(r.total), -r.first))
        for r in greatest_first[:PRINTED]:
            (a, b), (c, d) = r.first_interval, r.total_interval
            ends = f"[{a:.3g}, {b:.3g}]" + ("" if np.isnan(d) else f"  [{c:.3f}, {d:.3f}]")
            total = "      -" if np.isnan(r.total) else f"{r.total:7.3f}"
            lines.append(f"{r.name:<20} {r.step:4d} {r.mean:7.3f} {r.first:12.4g} {total}   {ends}")
        if len(self.rows) > PRINTED:
            lines.append(f"{len(self.rows) - PRINTED} more numbers")
        return "\n".join(lines)


def indices(
    key: PRNGKey,
    sim: Simulator,
    estimate: Estimate,
    *,
    draws: int = 400,
    level: float | None = None,
) -> Indices:
    """Which disturbance decides whether the system fails, alone and together with others?

    The variance-based (Sobol) indices of the indicator of failure 1_F over the independent normal
    numbers z behind the disturbances (Papaioannou and Straub, 2021; Li, Lu, Feng and Wang, 2012).
    First order: S_i = Var(E[1_F | z_i]) / Var(1_F). By Bayes' rule E[1_F | z_i] is P f(z_i | F) /
    phi(z_i), so S_i comes from the failures that the estimate has drawn already (Perrin and Defaux,
    2019), here without a bias of their number: a sum over pairs of failures in cells of 0.02
    standard deviations. Total: T_i = E[Var(1_F | all others)] / Var(1_F), which is
    (1 - Q_i) / (1 - P), Q_i the probability that a failure stays one when z_i alone is drawn anew.
    Q_i is counted on new episodes.

    Of rare failures that take several disturbances together first-order indices are tiny and total
    ones near 1; they still rank the disturbances.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        estimate: of this simulator, by `jast.estimate.failure_probability` from 5000 episodes on.
        draws: episodes for the total index of each number; 0: none, and no total indices.
        level: of the intervals; default: that of the estimate.

    Returns:
        `Indices`. Its ``evaluations`` are ``draws`` for each number, and, where the estimate was
        made by tilts, those of the chunks that are drawn again.

    Raises:
        ValueError: for an estimate without draws or without a failure, one whose draws were not
            normal numbers, or of another simulator.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing(b=0.5)
        >>> estimate = jast.estimate.failure_probability(key, sim, 6000)
        >>> found = jast.explain.indices(key, sim, estimate, draws=50)
        >>> len(found.rows)  # the start and ten steps
        11
    """
    name = "indices"
    checks.check_random_key(name, key)
    kept, level = draws_and_level(name, estimate, level)
    draws = checks.whole_number(name, "draws", draws, 0)
    transform.check(name, sim)
    rng = numpy_generator(key)
    z, log_w, length, spent = failing_draws(name, sim, estimate, KEPT)
    z = free_undecided(sim, z, length, rng)
    w = normalised(log_w)
    p, n_eff = float(estimate.mean), float(effective_sample_size(log_w))
    samples = kept.samples * len(z) / np.count_nonzero(kept.failure)
    evaluate, picks = PointEvaluator(sim), resample(log_w, draws, rng.random()) if draws else None
    rows = []
    for i, (called, step) in enumerate(zip(number_names(sim), number_steps(sim), strict=True)):
        gain, each = _gain(z[:, i], w)
        first = p * (gain - 1) / (1 - p)
        # P and the gain are of the same draws: the influence of each draw on their product
        c = w * (2 * each - gain - 1)
        square = (c**2).sum() - (gain - 1) ** 2 / samples
        error = p / (1 - p) * math.sqrt(max(square, 0.0))
        total, ends = math.nan, (math.nan, math.nan)
        if picks is not None:
            fails = int(_still_failing(evaluate, z[picks], i, rng))
            # as many independent failures as both samples are worth
            n = max(int(1 / (1 / draws + 1 / n_eff)), 1)
            q = fails / draws
            low = clopper_pearson(math.floor(q * n), n, level)[0]
            high = clopper_pearson(math.ceil(q * n), n, level)[1]
            total, ends = (1 - q) / (1 - p), ((1 - high) / (1 - p), min((1 - low) / (1 - p), 1.0))
        index = Index(
            name=called,
            step=int(step),
            mean=float(w @ z[:, i]),
            first=first,
            first_interval=_interval(first, error, c, level),
            total=total,
            total_interval=ends,
        )
        rows.append(index)
    return Indices(
        rows=tuple(rows),
        probability=p,
        level=level,
        ess=n_eff,
        reliable=bool(estimate.reliable and n_eff >= RELIABLE),
        evaluations=spent + evaluate.spent,
    )


def _interval(first: float, error: float, c: np.ndarray, level: float) -> tuple[float, float]:
    """The interval of a first-order index by its standard error and the influences ``c`` [m] of the
    draws: log-normal where it is clearly above 0, as few failures far out may decide it.
    """
    if first > 3 * error > 0:
        skewness = float((c**3).sum() / (c**2).sum() ** 1.5)
        return log_normal(math.log(first), error / first, level, skewness)
    half = NormalDist().inv_cdf(0.5 + level / 2) * error
    return first - half, first + half


def _still_failing(
    evaluate: PointEvaluator, z: np.ndarray, i: int, rng: np.random.Generator
) -> int:
    """How many of the failures ``z`` still fail with number ``i`` drawn anew."""
    moved = z.copy()
    moved[:, i] = rng.standard_normal(len(z))
    return np.count_nonzero(evaluate(moved).failure)


def _gain(z: np.ndarray, w: np.ndarray) -> tuple[float, np.ndarray]:
    """E[f(z | F) / phi(z) | F] of one number, from failures ``z`` [m] with weights ``w`` of sum 1,
    and f(z | F) / phi(z) of each, by the others: [m].
    """
    from scipy.special import ndtr

    cells, at = np.unique(np.floor(z.astype(np.float64) / WIDTH), return_inverse=True)
    # as a tail's own number: no difference of numbers near 1
    near = np.minimum(np.abs(cells), np.abs(cells + 1)) * WIDTH
    phi = ndtr(-near) - ndtr(-near - WIDTH)
    others = (np.bincount(at, w, len(cells))[at] - w) / np.maximum(phi, 1e-300)[at]
    pairs = 1 - w @ w
    gain = float(w @ others / pairs) if pairs > 0 else math.nan
    return gain, others / np.maximum(1 - w, 1e-12)
