"""Failure probabilities from few calls of a slow system: a surrogate learns from most of them, and
the last ones correct it.

These are drawn at random from weighted points of the model, more of them where the surrogate
doubts. Their outcomes less what it expected there, weighted, are added to the probability by the
surrogate (the difference estimator of survey sampling, Saerndal, Swensson and Wretman 1992): the
sum is unbiased, however wrong the surrogate is.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.estimate import weight_sums
from jast._src.estimate.estimate import MAX_INVALID_SHARE, Estimate, estimate_from_counts
from jast._src.estimate.few_calls.active_learning import CANDIDATES, Learner, choose_calls
from jast._src.estimate.few_calls.surrogate_pool import expected
from jast._src.estimate.gaussians.design_points import distinct
from jast._src.estimate.monte_carlo import plain_traces
from jast._src.runtime._jax import was_interrupted
from jast._src.runtime.progress_bar import Watch
from jast._src.util.intervals import log_normal, normal_quantile

__all__ = ["LEAST", "few_calls"]

NAME = "failure_probability"
LEAST = 40  # calls of a budget: Gayton's hat of `benchmarks.few_calls` is answered with them
ROUNDS = 4  # of the last calls, at most; the surrogate learns between them
POINTS = 400_000  # coordinates of the points that the estimate is taken over
POOL = (4000, 40_000)  # the least and the greatest number of these points
BY_DOUBT = 0.6  # of the last calls, by how much the surrogate doubts
BY_FAILURES = 0.25  # by where it may expect failures
BY_CHANCE = 0.15  # anywhere: so no weight is large
TINY = 1e-300  # in place of a sum of 0
ERROR = 0.25  # relative standard error above which an estimate is not believed
CHANGE = 0.05  # share of an estimate, above which one call must not change it
FEW_FAILURES = 10  # below which it is not believed


class Round(NamedTuple):
    """One batch of the last calls. On the host."""

    expected: float
    """Probability by the surrogate before it"""
    corrections: np.ndarray
    """[n]: weight times (failure less what was expected)"""
    weights: np.ndarray
    """[n]: p over the density that it was drawn from"""
    failing: np.ndarray
    invalid: np.ndarray
    doubted: float
    """Variance of a correction if the surrogate's doubts are right"""
    sampled: float
    """Variance of the probability by the surrogate for want of points"""


def few_calls(
    key: jax.Array,
    sim: Simulator,
    budget: int,
    level: float,
    failures: np.ndarray | None = None,
    progress: bool = False,
    callback: Callable | None = None,
) -> Estimate:
    """`failure_probability` with ``budget`` calls, `LEAST` to 4999; ``failures`` [m, D]: points of
    failures that came with the call.
    """
    rounds: list[Round] = []
    with Watch(NAME, budget, "call", progress, callback) as watch:
        learner = Learner(key, sim, budget, watch)
        if failures is not None and len(failures):
            some = distinct(failures.astype(np.float64), learner.batch)
            none = np.zeros(len(some))
            learner.record(some, none, none == 0, none != 0)
        try:
            choose_calls(learner)
            if not learner.failing.any():
                return _plain(learner, level)
            learner.draw_pool(CANDIDATES)
            learner.draw_pool(int(np.clip(POINTS // learner.dimension, *POOL)))
            _correct(learner, rounds)
        except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
            if not was_interrupted(error):
                raise
            if not rounds:
                raise KeyboardInterrupt from error
    return _estimate(learner, rounds, level)


def _correct(learner, rounds):
    """Spend the rest on points of the pool, and append a `Round` for each batch of them."""
    left, pool = learner.budget - learner.spent, learner.pool
    size = max(left // ROUNDS // learner.batch, 1) * learner.batch
    while left:
        calls = left if left < 2 * size else size  # the last ones together: no round is small
        if rounds:
            learner.fit(len(rounds) == ROUNDS // 2)
        w, (p, doubt) = pool.weights, expected(learner.surrogate, pool.z)
        n, variance = len(w), doubt * (1 - doubt)
        preference = (
            BY_DOUBT * _shares(w * np.sqrt(variance))
            + BY_FAILURES * _shares(w * doubt)
            + BY_CHANCE * _shares(np.ones(n))
        )
        preference /= preference.sum()
        rows = learner.rng.choice(n, calls, p=preference)
        failing, invalid = learner.call(pool.z[rows])
        over = w / (n * preference)
        new = Round(
            expected=(w * p).mean(),
            corrections=over[rows] * (failing - p[rows]),
            weights=over[rows],
            failing=failing,
            invalid=invalid,
            doubted=float((w * over * variance).mean()),
            sampled=float((w * p).var() / n),
        )
        rounds.append(new)
        left -= calls
        learner.history.append(
            f"correcting: {calls} calls, {int(failing.sum())} failures; the surrogate's"
            f" {new.expected:.4g} by {new.corrections.mean():+.2g}"
        )


def _shares(weights):
    return weights / max(weights.sum(), TINY)


def _estimate(learner, rounds, level):
    """The `Estimate` of the pool and its corrections."""
    each = Round(*zip(*rounds, strict=True))
    sizes = np.array([len(c) for c in each.corrections])
    n, share = sizes.sum(), sizes / sizes.sum()
    c, w, failing, invalid = map(np.concatenate, each[1:5])
    mean = float(share @ each.expected + c.mean())
    seen = float((c**2).sum() / n**2)
    doubted = float((share**2 / sizes) @ each.doubted)
    error = math.sqrt(max(seen, doubted) + float(share @ each.sampled))
    relative = error / mean if mean > 0 else math.inf
    reasons = _reasons(learner, mean, relative, np.abs(c).max() / n, w[invalid].sum() / n)
    v = w * failing
    ess = float(v.sum() ** 2 / (v**2).sum()) if v.any() else 0.0
    mean = min(mean, 1.0)  # by chance above it: the corrections know no bound
    unseen = -math.log1p(-level) / learner.plain[-1]
    mixture = learner.pool.mixture
    return Estimate(
        method=NAME,
        log_mean=math.log(mean) if mean > 0 else math.nan,
        mean=mean if mean > 0 else math.nan,
        standard_error=error,
        relative_error=relative,
        interval=_interval(mean, error, level, unseen),
        level=level,
        ess=ess,
        k_hat=math.nan,
        max_share=float(v.max() / v.sum()) if v.any() else math.nan,
        failing=int(failing.sum()),
        samples=int(n),
        episodes=learner.spent,
        steps=learner.steps,
        invalid=int(learner.invalid.sum()),
        modes=None,
        reliable=not reasons,
        warnings=tuple(reasons),
        unseen=unseen,
        proposal=jax.tree.map(lambda a: np.asarray(a, learner.dtype), mixture),
        history=tuple(learner.history),
        plain=learner.plain,
    )


def _reasons(learner, mean, relative, change, invalid):
    """Why the estimate ``mean`` is not believed; ``change``: what one call adds to it at most,
    ``invalid``: what the invalid episodes would add if they failed.
    """
    reasons = []
    if learner.spent < learner.budget:
        reasons.append(f"interrupted after {learner.spent} of {learner.budget} calls")
    if not mean > 0:
        reasons.append(
            "the system contradicts the surrogate: the corrected estimate is not above 0"
        )
    elif relative > ERROR:
        reasons.append(f"relative standard error {relative:.0%}")
    if mean > 0 and change > CHANGE * mean:
        reasons.append(f"one call changes the estimate by {change / mean:.0%}")
    if invalid > MAX_INVALID_SHARE * max(mean, 0.0):
        reasons.append(
            f"{int(learner.invalid.sum())} episodes are invalid (a number that is not finite): if"
            " they failed, the estimate would change"
        )
    if learner.surprises:
        reasons.append(
            f"{learner.surprises} of {learner.sure} calls failed where the surrogate was sure that"
            " none does: the miss distance jumps, or says nothing there"
        )
    failures = int(learner.failing.sum())
    if failures < FEW_FAILURES:
        reasons.append(f"{failures} failures are too few to trust the estimate")
    return reasons


def _interval(mean, error, level, unseen):
    """Log-normal; where the error is as large as the mean only an upper end is known, and not below
    what draws of the model say.
    """
    if 0 < error < mean:
        return log_normal(math.log(mean), error / mean, level)
    above = max(mean, 0.0) + normal_quantile(level) * error
    return 0.0, min(max(above, unseen), 1.0)


def _plain(learner, level):
    """The `Estimate` of a system that has not failed: the rest are draws of the model."""
    n = learner.budget - learner.spent
    failing, invalid = learner.call(learner.rng.standard_normal((n, learner.dimension)))
    seen = plain_traces(failing, invalid, np.zeros(n, int))
    learner.history.append(f"plain draws: {n} calls, {int(failing.sum())} failures")
    return estimate_from_counts(
        NAME,
        weight_sums.add_traces(weight_sums.empty_sums(n), seen)._replace(steps=learner.steps),
        level=level,
        evaluations=learner.spent,
        history=tuple(learner.history),
    )
