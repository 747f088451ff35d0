"""Failure probabilities from few calls of a slow system: a surrogate learns from most of them, and
the last ones correct it.

These are drawn at random from weighted points of the model, more of them where the surrogate
doubts. Their outcomes less what it expected there, weighted, are added to the probability by the
surrogate (the difference estimator of survey sampling, Saerndal, Swensson and Wretman 1992): the
sum is unbiased, however wrong the surrogate is.
"""

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._jax import was_interrupted
from jast.estimate import sums
from jast.estimate.active_learning import CANDIDATES, Learner, learn
from jast.estimate.design_points import distinct
from jast.estimate.estimate import MAX_INVALID_SHARE, Estimate, estimate_from_counts
from jast.estimate.gaussians import as_latent
from jast.estimate.importance_sampling import Traces
from jast.estimate.surrogate_failures import expected
from jast.intervals import log_normal
from jast.watch import Watch

__all__ = ["LEAST", "few_calls"]

NAME = "failure_probability"
LEAST, ROUNDS = 50, 4
POINTS = 400_000
"""Coordinates of the points that the estimate is taken over."""
PREFERENCES = (0.6, 0.25, 0.15)
"""Of the last calls: where the surrogate doubts, where it expects failures, and anywhere."""
ERROR, CHANGE, FEW = 0.25, 0.05, 10
"""What an estimate is not believed above: relative standard error, share that one call changes; and
below: failures."""


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
    key: Any,
    sim: Any,
    budget: int,
    level: float,
    known: np.ndarray | None = None,
    progress: bool = False,
    callback: Any = None,
) -> Estimate:
    """`failure_probability` with ``budget`` calls, `LEAST` to 4999; ``known`` [m, D]: points of
    failures.
    """
    rounds: list[Round] = []
    with Watch(NAME, budget, "call", progress, callback) as watch:
        s = Learner(key, sim, budget, watch)
        if known is not None and len(known):
            some = distinct(known.astype(np.float64), s.batch)
            s.learn(some, np.zeros(len(some)), np.ones(len(some), bool), np.zeros(len(some), bool))
        try:
            learn(s)
            if not s.failing.any():
                return _counted(s, level)
            s.look(CANDIDATES)
            s.look(max(min(POINTS // s.dimension, 40_000), 4000))
            _correct(s, rounds)
        except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
            if not was_interrupted(error):
                raise
            if not rounds:
                raise KeyboardInterrupt from error
    return _estimate(s, rounds, level)


def _correct(s, rounds):
    """Spend the rest on points of the pool, and append a `Round` for each batch of them."""
    left, n = s.budget - s.spent, len(s.pool.z)
    size = max(left // ROUNDS // s.batch, 1) * s.batch
    while left:
        # the last ones together, that no round is small
        now = left if left < 2 * size else size
        if rounds:
            s.fit(len(rounds) == ROUNDS // 2)
        w, (p, doubt) = s.pool.weights, expected(s.surrogate, s.pool.z)
        variance = doubt * (1 - doubt)
        shares = (w * np.sqrt(variance), w * doubt, np.ones(n))
        r = sum(a * v / max(v.sum(), 1e-300) for a, v in zip(PREFERENCES, shares, strict=True))
        rows = s.rng.choice(n, now, p=r / r.sum())
        failing, invalid = s.call(s.pool.z[rows])
        over = w / (n * r / r.sum())
        rounds.append(
            Round(
                (w * p).mean(),
                over[rows] * (failing - p[rows]),
                over[rows],
                failing,
                invalid,
                float((w * over * variance).mean()),
                float((w * p).var() / n),
            )
        )
        left -= now
        s.history.append(
            f"correcting: {now} calls, {int(failing.sum())} failures; the surrogate's"
            f" {rounds[-1].expected:.4g} by {rounds[-1].corrections.mean():+.2g}"
        )


def _estimate(s, rounds, level):
    """The `Estimate` of the pool and its corrections."""
    sizes = np.array([len(r.corrections) for r in rounds])
    n, share = sizes.sum(), sizes / sizes.sum()
    c, w, failing, invalid = (np.concatenate([r[i] for r in rounds]) for i in (1, 2, 3, 4))
    mean = float(share @ [r.expected for r in rounds] + c.mean())
    seen = float((c**2).sum() / n**2)
    doubted = float((share**2 / sizes) @ [r.doubted for r in rounds])
    sampled = float(share @ [r.sampled for r in rounds])
    error = math.sqrt(max(seen, doubted) + sampled)
    unseen = -math.log1p(-level) / s.plain[-1]
    found = []
    if s.spent < s.budget:
        found.append(f"interrupted after {s.spent} of {s.budget} calls")
    relative = error / mean if mean > 0 else math.inf
    if not mean > 0:
        found.append("the system contradicts the surrogate: the corrected estimate is not above 0")
    elif relative > ERROR:
        found.append(f"relative standard error {relative:.0%}")
    if mean > 0 and np.abs(c).max() / n > CHANGE * mean:
        found.append(f"one call changes the estimate by {np.abs(c).max() / n / mean:.0%}")
    if w[invalid].sum() / n > MAX_INVALID_SHARE * max(mean, 0.0):
        found.append(
            f"{int(s.invalid.sum())} episodes are invalid (a number that is not finite): if they"
            " failed, the estimate would change"
        )
    if s.failing.sum() < FEW:
        found.append(f"{int(s.failing.sum())} failures are too few to trust the estimate")
    v = w * failing
    ess = float(v.sum() ** 2 / (v**2).sum()) if v.any() else 0.0
    mean = min(mean, 1.0)  # by chance above it: the corrections know no bound
    log_mean = math.log(mean) if mean > 0 else math.nan
    return Estimate(
        method=NAME,
        log_mean=log_mean,
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
        episodes=s.spent,
        steps=s.steps,
        invalid=int(s.invalid.sum()),
        modes=None,
        reliable=not found,
        warnings=tuple(found),
        unseen=unseen,
        proposal=as_latent([(1.0, s.pool.mixture)], s.dtype),
        history=tuple(s.history),
        plain=s.plain,
    )


def _interval(mean, error, level, unseen):
    """Log-normal; where the error is as large as the mean only an upper end is known, and not below
    what draws of the model say.
    """
    if 0 < error < mean:
        return log_normal(math.log(mean), error / mean, level)
    from statistics import NormalDist  # here: slow to import

    above = max(mean, 0.0) + NormalDist().inv_cdf((1 + level) / 2) * error
    return 0.0, min(max(above, unseen), 1.0)


def _counted(s, level):
    """The `Estimate` of a system that has not failed: the rest are draws of the model."""
    n = s.budget - s.spent
    failing, invalid = s.call(s.rng.standard_normal((n, s.dimension)))
    none = np.zeros(n)
    seen = Traces(none, none[:, None], failing, invalid, none.astype(int))
    s.history.append(f"plain draws: {n} calls, {int(failing.sum())} failures")
    return estimate_from_counts(
        NAME,
        sums.add_traces(sums.empty_sums(n), seen)._replace(steps=s.steps),
        level=level,
        evaluations=s.spent,
        history=tuple(s.history),
    )
