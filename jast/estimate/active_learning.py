"""Failure probabilities from few calls of a slow system: a surrogate of the limit state learns
where calls say most, and the last calls correct it.

Learning is that of AK-MCS (Echard, Gayton and Lemaire 2011) with other parts: failures are data
without a value (`jast.estimate.surrogate`), candidates are drawn around what the surrogate holds
for possible (`jast.estimate.surrogate_failures`), and a batch is chosen that leaves the least doubt
about failure at these. A quarter of each batch looks where nobody has looked.

The rest of the calls are drawn at random from weighted points of the model, more of them where the
surrogate doubts. Their outcomes less what it expected there, weighted, are added to the probability
by the surrogate (the difference estimator of survey sampling, Saerndal, Swensson and Wretman 1992):
the sum is unbiased, however wrong the surrogate is.
"""

import math
from statistics import NormalDist
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import limit_state as latent
from jast._jax import was_interrupted
from jast.counter import generator
from jast.estimate import sums
from jast.estimate.design_points import distinct
from jast.estimate.estimate import INVALID, Estimate, of_counts
from jast.estimate.gaussians import Gaussians, as_latent
from jast.estimate.importance_sampling import Traces
from jast.estimate.surrogate import Surrogate, covariance, fit, normal_cdf, predict
from jast.estimate.surrogate_failures import DOUBT, Pool, expected, pool
from jast.intervals import log_normal
from jast.watch import Watch

__all__ = ["MOST", "LEAST", "few_calls"]

NAME = "failure_probability"
LEAST, MOST = 50, 4999
LEARNING, TRAINED, LEARNED = 0.65, 240, 400
"""Share of the budget for learning and its most calls; points that the surrogate holds at last."""
BATCHES, ROUNDS, FAR = 14, 4, 4
CANDIDATES, TRIED = 4000, 500
POINTS = 400_000
"""Coordinates of the points that the estimate is taken over."""
WARPS = (1.0, 0.2, 0.04)


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


class Learner:
    """What is known so far: the calls, the surrogate of them, and the proposal."""

    def __init__(self, key: Any, sim: Any, budget: int, watch: Watch):
        self.sim, self.budget, self.watch, self.rng = sim, budget, watch, generator(key)
        self.dtype, self.dimension = latent.normal_numbers(sim), latent.dimension(sim)
        self.z, self.distance = np.zeros((0, self.dimension)), np.zeros(0)
        self.failing, self.invalid = np.zeros(0, bool), np.zeros(0, bool)
        self.steps, self.spent, self.plain = 0, 0, 0
        self.surrogate: Surrogate | None = None
        self.fitted: Gaussians | None = None
        self.pool: Pool | None = None
        self.history: list[str] = []
        self.batch = max(min(int(LEARNING * budget), TRAINED) // BATCHES, 4)

    def call(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Failures and invalid episodes [n] of the system at ``z`` [n, D], which are learned."""
        out = []
        for i in range(0, len(z), self.batch):
            rows = np.asarray(z[i : i + self.batch], self.dtype)
            out.append(jax.device_get(latent.outcomes(self.sim, jnp.asarray(rows))))
            o = out[-1]
            self.spent, self.steps = self.spent + len(rows), self.steps + int(o.length.sum())
            self.learn(rows, o.distance, o.failure, o.invalid)
            self.watch.more(len(rows))
        return tuple(np.concatenate([getattr(o, n) for o in out]) for n in ("failure", "invalid"))

    def learn(self, z, distance, failing, invalid):
        """Keep what was seen at ``z``."""
        distance = np.where(failing, 0.0, np.asarray(distance, np.float64))
        new = z.astype(np.float64), distance, failing, invalid | ~np.isfinite(distance)
        old = self.z, self.distance, self.failing, self.invalid
        self.z, self.distance, self.failing, self.invalid = (
            np.concatenate(pair) for pair in zip(old, new, strict=True)
        )

    def fit(self, anew: bool) -> None:
        """Fit the surrogate to what was seen; ``anew``: with the choice of its warp."""
        rows = np.flatnonzero(~self.invalid)[:LEARNED]
        data = self.z[rows], self.distance[rows], self.failing[rows]
        if not anew and self.surrogate is not None:
            self.surrogate = fit(*data, self.surrogate, self.surrogate.warp, 1)
            return
        safe = self.distance[rows][~self.failing[rows]]
        middle = float(np.median(safe)) if len(safe) else 0.0
        warps = [math.inf, *(middle * w for w in WARPS if middle > 0)]
        tried = [fit(*data, self.surrogate, warp) for warp in warps]
        self.surrogate = max(tried, key=lambda s: s.evidence)

    def look(self, n: int, anew: bool = True) -> None:
        """Draw ``n`` points of the model around the failures that the surrogate expects."""
        found = self.z[self.failing]
        self.pool, self.fitted = pool(self.rng, self.surrogate, found, self.fitted, n, anew)


def few_calls(
    key: Any,
    sim: Any,
    budget: int,
    level: float,
    known: np.ndarray | None = None,
    progress: bool = False,
    callback: Any = None,
) -> Estimate:
    """`failure_probability` with ``budget`` calls, `LEAST` to `MOST`; ``known`` [m, D]: points of
    failures.
    """
    rounds: list[Round] = []
    with Watch(NAME, budget, "call", progress, callback) as watch:
        s = Learner(key, sim, budget, watch)
        if known is not None and len(known):
            some = distinct(known.astype(np.float64), s.batch)
            s.learn(some, np.zeros(len(some)), np.ones(len(some), bool), np.zeros(len(some), bool))
        try:
            _learn(s)
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


def _learn(s):
    """The calls of the initial design and those that are chosen."""
    calls = min(int(LEARNING * s.budget), TRAINED) // s.batch * s.batch
    first = min(max(12, 2 * s.dimension), calls // 3)
    first = -(-first // s.batch) * s.batch
    wide = np.where(np.arange(first) % 2, 2.0, 1.0)[:, None]
    s.plain = (first + 1) // 2  # draws of the model itself
    s.call(wide * s.rng.standard_normal((first, s.dimension)))
    i = 0
    while True:
        s.fit(i % 4 == 0)
        if s.spent >= calls:
            break
        s.look(CANDIDATES, i % 2 == 0)
        far = s.batch // FAR if s.failing.any() else 0
        s.call(np.concatenate([_far(s, far), _chosen(s, s.batch - far)]))
        i += 1
    s.history.append(
        f"learning: {s.spent} calls, {int(s.failing.sum())} failures,"
        f" {int(s.invalid.sum())} invalid"
    )


def _far(s, n):
    """Points [n, D] a little farther out than the nearest failures, in directions that nobody has
    looked in: for failures that the surrogate cannot know of.
    """
    if not n:
        return np.zeros((0, s.dimension))
    radius = np.linalg.norm(s.z[s.failing], axis=1)
    u = s.rng.standard_normal((200, s.dimension))
    u *= (np.quantile(radius, 0.1) * s.rng.uniform(1.0, 1.5, 200) / np.linalg.norm(u, axis=1))[
        :, None
    ]
    near, out = ((u[:, None] - s.z[None]) ** 2).sum(axis=2).min(axis=1), []
    for _ in range(n):
        out.append(int(np.argmax(near)))
        near = np.minimum(near, ((u - u[out[-1]]) ** 2).sum(axis=1))
    return u[out]


def _chosen(s, n):
    """The ``n`` candidates [n, D] that leave the least doubt."""
    _, p = expected(s.surrogate, s.pool.z)
    doubt = s.pool.weights * np.sqrt(p * (1 - p)) + 1e-300
    if s.invalid.any():  # nothing is learned there
        doubt = np.where(s.invalid[_nearest(s.pool.z, s.z)], 1e-300, doubt)
    rows = s.rng.choice(len(p), TRIED, p=doubt / doubt.sum())
    rows = np.unique(np.concatenate([rows, s.rng.choice(len(p), s.batch, replace=False)]))
    z = s.pool.z[rows]
    mean, _ = predict(s.surrogate, z)
    # posterior covariances among them; what is known after a call at one of them falls by their
    # squares, whatever its outcome
    k = covariance(z, s.surrogate.z, s.surrogate.logs)[0]
    c = covariance(z, z, s.surrogate.logs)[0] - k @ s.surrogate.inverse @ k.T
    # no less than what rounding leaves of a difference of covariances
    noise, out = s.surrogate.noise + 1e-6 * float(np.exp(s.surrogate.logs[:2]).sum() + 1), []
    for _ in range(n):
        v = np.maximum(np.diagonal(c), 0.0) + noise
        p = normal_cdf(-mean / (DOUBT * np.sqrt(v)))
        gain = (np.sqrt(p * (1 - p)) / v) @ c**2 / v
        gain[out] = -1.0
        out.append(int(np.argmax(gain)))
        c = c - np.outer(c[:, out[-1]], c[:, out[-1]]) / v[out[-1]]
    return z[out]


def _nearest(z, others):
    """The number [n] of the nearest of ``others`` [m, D] to each of ``z`` [n, D]."""
    return np.argmin((others**2).sum(axis=1) - 2 * z @ others.T, axis=1)


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
        r = sum(
            a * v / max(v.sum(), 1e-300) for a, v in zip((0.6, 0.25, 0.15), shares, strict=True)
        )
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
    found = []
    if s.spent < s.budget:
        found.append(f"interrupted after {s.spent} of {s.budget} calls")
    relative = error / mean if mean > 0 else math.inf
    if not mean > 0:
        found.append("the system contradicts the surrogate: the estimate is not above 0")
    elif relative > 0.25:
        found.append(f"relative standard error {relative:.0%}")
    if mean > 0 and np.abs(c).max() / n > 0.05 * mean:
        found.append(f"one call changes the estimate by {np.abs(c).max() / n / mean:.0%}")
    if w[invalid].sum() / n > INVALID * max(mean, 0.0):
        found.append(
            f"{int(s.invalid.sum())} episodes are invalid (a number that is not finite): if they"
            " failed, the estimate would be another one"
        )
    if s.failing.sum() < 10:
        found.append(f"{int(s.failing.sum())} failures are too few")
    v = w * failing
    ess = float(v.sum() ** 2 / (v**2).sum()) if v.any() else 0.0
    log_mean = math.log(mean) if mean > 0 else math.nan
    return Estimate(
        method=NAME,
        log_mean=log_mean,
        mean=mean if mean > 0 else math.nan,
        standard_error=error,
        relative_error=relative,
        interval=_interval(mean, error, level),
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
        unseen=-math.log1p(-level) / s.plain,
        proposal=as_latent([(1.0, s.pool.mixture)], s.dtype),
        history=tuple(s.history),
    )


def _interval(mean, error, level):
    """Log-normal; where the error is as large as the mean, only what lies above is known."""
    if 0 < error < mean:
        return log_normal(math.log(mean), error / mean, level)
    return 0.0, min(max(mean, 0.0) + NormalDist().inv_cdf((1 + level) / 2) * error, 1.0)


def _counted(s, level):
    """The `Estimate` of a system that has not failed: the rest are draws of the model."""
    n = s.budget - s.spent
    failing, invalid = s.call(s.rng.standard_normal((n, s.dimension)))
    none = np.zeros(n)
    seen = Traces(none, none[:, None], failing, invalid, none.astype(int))
    s.history.append(f"plain draws: {n} calls, {int(failing.sum())} failures")
    return of_counts(
        NAME,
        sums.add(sums.nothing(n), seen)._replace(steps=s.steps),
        level=level,
        evaluations=s.spent,
        history=tuple(s.history),
    )
