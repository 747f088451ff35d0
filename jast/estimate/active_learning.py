"""A surrogate of a slow system learns where a call says most.

As AK-MCS (Echard, Gayton and Lemaire 2011) with other parts: failures are data without a value
(`jast.estimate.surrogate`), candidates are drawn around what the surrogate holds for possible
(`jast.estimate.surrogate_failures`), and a batch is chosen that leaves the least doubt about
failure at these. A quarter of each batch looks where nobody has looked.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jast import limit_state as latent
from jast.checkpoints import answer_once
from jast.counter import numpy_generator
from jast.estimate.gaussians import Gaussians
from jast.estimate.surrogate import Surrogate, covariance, fit, normal_cdf, predict
from jast.estimate.surrogate_failures import DOUBT, Pool, expected, pool
from jast.watch import Watch

__all__ = ["CANDIDATES", "Learner", "learn"]

LEARNING, TRAINED, LEARNED = 0.65, 240, 400
"""Share of the budget for learning and its most calls; points that the surrogate holds at last."""
BATCHES, FAR = 14, 4
CANDIDATES, TRIED = 4000, 500
WARPS = (1.0, 0.2, 0.04)


class Learner:
    """What is known so far: the calls, the surrogate of them, and the proposal."""

    def __init__(self, key: Any, sim: Any, budget: int, watch: Watch):
        self.sim, self.budget, self.watch, self.rng = sim, budget, watch, numpy_generator(key)
        self.dtype, self.dimension = latent.normal_numbers(sim), latent.dimension(sim)
        self.z, self.distance = np.zeros((0, self.dimension)), np.zeros(0)
        self.failing, self.invalid = np.zeros(0, bool), np.zeros(0, bool)
        self.steps, self.spent, self.plain = 0, 0, (0, 0, 0)
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
            run = lambda rows: latent.outcomes(self.sim, jnp.asarray(rows))
            out.append(answer_once(run, rows))
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


def learn(s: Learner) -> None:
    """The calls of the initial design and those that are chosen."""
    calls = min(int(LEARNING * s.budget), TRAINED) // s.batch * s.batch
    first = min(max(12, 2 * s.dimension), calls // 3)
    first = -(-first // s.batch) * s.batch
    wide = np.where(np.arange(first) % 2, 2.0, 1.0)[:, None]
    failing, invalid = s.call(wide * s.rng.standard_normal((first, s.dimension)))
    # draws of the model itself
    s.plain = int(failing[::2].sum()), int(invalid[::2].sum()), (first + 1) // 2
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
        most = np.sqrt(np.outer(v, v))  # of a covariance; rounding may have left more
        c = np.clip(c, -most, most)
        p = normal_cdf(-mean / (DOUBT * np.sqrt(v)))
        gain = (np.sqrt(p * (1 - p)) / v) @ c**2 / v
        gain[out] = -1.0
        out.append(int(np.argmax(gain)))
        c = c - np.outer(c[:, out[-1]], c[:, out[-1]]) / v[out[-1]]
    return z[out]


def _nearest(z, others):
    """The number [n] of the nearest of ``others`` [m, D] to each of ``z`` [n, D]."""
    return np.argmin((others**2).sum(axis=1) - 2 * z @ others.T, axis=1)
