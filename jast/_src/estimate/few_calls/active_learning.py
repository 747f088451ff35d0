"""A surrogate of a slow system learns where a call says most.

As AK-MCS (Echard, Gayton and Lemaire 2011) with other parts: failures are data without a value,
unless they say how deep they are (`estimate.few_calls.surrogate`), candidates are drawn around what
the surrogate holds for possible (`estimate.few_calls.surrogate_pool`), and a batch is chosen that
leaves the least doubt about failure at these. A quarter of each batch looks where nobody has
looked.
"""

import math
from itertools import count
from typing import Any

import jax.numpy as jnp
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.estimate.few_calls.surrogate import (
    Surrogate,
    fit,
    posterior_covariance,
    predict,
    probability_below_zero,
    turned,
)
from jast._src.estimate.few_calls.surrogate_pool import DOUBT, Pool, expected, pool
from jast._src.estimate.gaussians.mixture_fit import nearest_centre
from jast._src.normal_space import transform
from jast._src.runtime.checkpoints import answer_once
from jast._src.runtime.progress_bar import Watch

__all__ = ["CANDIDATES", "Learner", "choose_calls"]

LEARNING = 0.65  # share of the budget for learning
CALLS = 240  # of learning, at most
HELD = 400  # points that the surrogate is fitted to, at most: a fit takes their third power
BATCHES = 14  # that the calls of learning are divided into
LEAST_BATCH = 4  # calls of a batch, at least; a convention
FIRST_CALLS = 12  # of the initial design, at least
FIRST_CALLS_EACH = 2  # the same for each coordinate
FIRST_SHARE = 1 / 3  # of the calls of learning, at most
FIRST_WIDTH = 2.0  # deviation of every other point of the initial design; the others: the model's
WARP_EVERY = 4  # batches after which the warp is chosen anew
POPULATION_EVERY = 2  # batches after which candidates come from a new population
UNSEEN_SHARE = 1 / 4  # of a batch, for places where nobody has looked
UNSEEN_TRIED = 200  # directions that these are chosen from
UNSEEN_NEAREST = 0.1  # quantile of the norms of failures: what is beyond it weighs little
UNSEEN_FARTHER = 1.5  # times as far out, at most
CANDIDATES = 4000  # points of a pool
TRIED = 500  # of these, whose covariances are worked out
WARPS = (1.0, 0.2, 0.04)  # tried beside none, as parts of the median distance
SURE = 0.01
"""Probability of a failure, in doubt, below which the surrogate is sure that there is none. In 1330
such calls of eight smooth problems of `benchmarks.few_calls` (4 keys each) it never was wrong; of a
constant distance, a choice that decides, or distances of two scales, mostly in one or two of 30."""
TINY = 1e-300  # in place of a weight of 0
ROUNDING = 1e-6  # part of the variance that rounding leaves of a difference of covariances


class Learner:
    """What is known so far: the calls, the surrogate of them, and the points that it leads to."""

    def __init__(self, key: Any, sim: Simulator, budget: int, watch: Watch):
        self.sim, self.budget, self.watch = sim, budget, watch
        self.rng = numpy_generator(key)
        self.dtype, self.dimension = transform.normal_numbers(sim), transform.dimension(sim)
        self.z, self.distance = np.zeros((0, self.dimension)), np.zeros(0)
        self.failing, self.invalid = np.zeros(0, bool), np.zeros(0, bool)
        # an episode that is judged on the way ends where it fails, however deep it would have got
        one_state = sim.horizon == 1 and not signature_of(sim).random_start
        self.shows_depth = sim.episodic or one_state
        self.steps, self.spent = 0, 0
        self.sure, self.surprises = 0, 0  # calls where no failure was expected; those that failed
        self.plain = (0, 0, 0)  # (failing, invalid, calls) of draws of the model
        self.fits: list[Surrogate] = []
        self.surrogate: Surrogate | None = None
        self.fitted: list | None = None
        self.pool: Pool | None = None
        self.history: list[str] = []
        self.calls = min(int(LEARNING * budget), CALLS)  # of learning
        self.batch = max(self.calls // BATCHES, LEAST_BATCH)

    def call(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Failures and invalid episodes [n] of the system at ``z`` [n, D], which are recorded."""
        before, sure = len(self.z), np.zeros(len(z), bool)
        if self.surrogate is not None:
            sure = expected(self.surrogate, z)[1] < SURE
        for i in range(0, len(z), self.batch):
            rows = np.asarray(z[i : i + self.batch], self.dtype)
            o = answer_once(lambda z: transform.outcomes(self.sim, jnp.asarray(z)), rows)
            self.spent, self.steps = self.spent + len(rows), self.steps + int(o.length.sum())
            self.record(rows, o.distance, o.failure, o.invalid)
            self.watch.more(len(rows))
        failing = self.failing[before:]
        self.sure, self.surprises = self.sure + sure.sum(), self.surprises + (sure & failing).sum()
        return failing, self.invalid[before:]

    def record(self, z, distance, failing, invalid):
        """Keep what was seen at ``z``."""
        distance = np.asarray(distance, np.float64)
        depth = self.shows_depth & np.isfinite(distance)
        distance = np.where(failing & ~depth, 0.0, distance)
        self.z = np.concatenate([self.z, z.astype(np.float64)])
        self.distance = np.concatenate([self.distance, distance])
        self.failing = np.concatenate([self.failing, failing])
        self.invalid = np.concatenate([self.invalid, invalid | ~np.isfinite(distance)])

    def fit(self, with_warp: bool) -> None:
        """Fit surrogates to what was seen, one along the coordinates and one along axes that turn
        with each fit, and keep the better; ``with_warp``: with the choice of their warps.
        """
        rows = np.flatnonzero(~self.invalid)[:HELD]
        hidden = self.failing[rows] & ~_depths(self.z[rows], self.distance[rows])
        data = self.z[rows], self.distance[rows], hidden
        starts = [self.fits[0], turned(self.fits[-1])] if self.fits else [None]
        if with_warp or not self.fits:
            safe = self.distance[rows][~self.failing[rows]]
            middle = float(np.median(safe)) if len(safe) else 0.0
            warps = [math.inf, *(middle * w for w in WARPS if middle > 0)]
            self.fits = [_likeliest(fit(*data, start, w) for w in warps) for start in starts]
        else:
            self.fits = [fit(*data, start, start.warp, rounds=1) for start in starts]
        self.surrogate = _likeliest(self.fits)

    def draw_pool(self, n: int, anew: bool = True) -> None:
        """Draw ``n`` points of the model around the failures that the surrogate expects."""
        failures = self.z[self.failing]
        self.pool, self.fitted = pool(self.rng, self.surrogate, failures, self.fitted, n, anew)


def choose_calls(learner: Learner) -> None:
    """The calls of the initial design and those that are chosen."""
    batch = learner.batch
    calls = learner.calls // batch * batch
    first = min(max(FIRST_CALLS, FIRST_CALLS_EACH * learner.dimension), int(FIRST_SHARE * calls))
    first = -(-first // batch) * batch
    of_model = np.arange(first) % 2 == 0
    width = np.where(of_model, 1.0, FIRST_WIDTH)[:, None]
    failing, invalid = learner.call(width * learner.rng.standard_normal((first, learner.dimension)))
    learner.plain = int(failing[of_model].sum()), int(invalid[of_model].sum()), int(of_model.sum())
    if learner.invalid.all():  # nothing to learn from
        return
    for i in count():
        learner.fit(i % WARP_EVERY == 0)
        if learner.spent >= calls:
            break
        learner.draw_pool(CANDIDATES, i % POPULATION_EVERY == 0)
        unseen = int(UNSEEN_SHARE * batch) if learner.failing.any() else 0
        chosen = _least_doubt(learner, batch - unseen)
        learner.call(np.concatenate([_unseen(learner, unseen), chosen]))
    learner.history.append(
        f"learning: {learner.spent} calls, {int(learner.failing.sum())} failures,"
        f" {int(learner.invalid.sum())} invalid"
    )


def _likeliest(surrogates):
    """The one of the greatest evidence."""
    return max(surrogates, key=lambda surrogate: surrogate.evidence)


def _depths(z, distance):
    """Which of the ``distance`` [n] of points ``z`` [n, D] say how deep an episode failed: below 0,
    and not what others say, too, as a -1 that stands for every failure. One alone may be such a -1.
    """
    _, once = np.unique(z, axis=0, return_index=True)  # a point may have been drawn twice
    values, times = np.unique(distance[once], return_counts=True)
    depths = values[(values < 0) & (times == 1)]
    return np.isin(distance, depths if len(depths) > 1 else [])


def _unseen(learner, n):
    """Points [n, D] a little farther out than the nearest failures, in directions that nobody has
    looked in: for failures that the surrogate cannot know of.
    """
    if not n:
        return np.zeros((0, learner.dimension))
    radius = np.quantile(np.linalg.norm(learner.z[learner.failing], axis=1), UNSEEN_NEAREST)
    z = transform.unit(learner.rng.standard_normal((UNSEEN_TRIED, learner.dimension)))
    z *= radius * learner.rng.uniform(1.0, UNSEEN_FARTHER, (UNSEEN_TRIED, 1))
    gaps, chosen = ((z[:, None] - learner.z[None]) ** 2).sum(axis=2).min(axis=1), []
    for _ in range(n):
        chosen.append(int(np.argmax(gaps)))
        gaps = np.minimum(gaps, ((z - z[chosen[-1]]) ** 2).sum(axis=1))
    return z[chosen]


def _least_doubt(learner, n):
    """The ``n`` candidates [n, D] that leave the least doubt."""
    rng, candidates, surrogate = learner.rng, learner.pool, learner.surrogate
    _, p = expected(surrogate, candidates.z)
    doubt = candidates.weights * np.sqrt(p * (1 - p)) + TINY
    if learner.invalid.any():  # nothing is learned there
        doubt = np.where(learner.invalid[nearest_centre(candidates.z, learner.z)], TINY, doubt)
    rows = rng.choice(len(p), TRIED, p=doubt / doubt.sum())
    rows = np.unique(np.concatenate([rows, rng.choice(len(p), learner.batch, replace=False)]))
    z = candidates.z[rows]
    mean, _ = predict(surrogate, z)
    # posterior covariances among them; what is known after a call at one of them falls by their
    # squares, whatever its outcome
    c = posterior_covariance(surrogate, z)
    rounding = ROUNDING * float(np.exp(surrogate.logs[:2]).sum() + 1)
    noise, chosen = surrogate.noise + rounding, []
    for _ in range(n):
        variance = np.maximum(np.diagonal(c), 0.0) + noise
        most = np.sqrt(np.outer(variance, variance))  # rounding may have left more
        c = np.clip(c, -most, most)
        p = probability_below_zero(mean, DOUBT * np.sqrt(variance))
        gain = (np.sqrt(p * (1 - p)) / variance) @ c**2 / variance
        gain[chosen] = -1.0
        best = int(np.argmax(gain))
        chosen.append(best)
        c = c - np.outer(c[:, best], c[:, best]) / variance[best]
    return z[chosen]
