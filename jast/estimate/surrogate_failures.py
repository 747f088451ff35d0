"""Where a surrogate expects failures: weighted points of the model, by a mixture of Gaussians
around them. They cost no call of the system.

The mixture is made of a population that goes down the levels of the surrogate (subset simulation,
Au and Beck 2001), started anew each time; of the mixture before; of the failures seen; and of
wider noise. So a mode that one of them has found once is not lost.
"""

import math
from typing import NamedTuple

import numpy as np

from jast.estimate import gaussians
from jast.estimate.design_points import distinct
from jast.estimate.gaussians import Gaussians, unit
from jast.estimate.surrogate import Surrogate, normal_cdf, predict

__all__ = ["Pool", "pool"]

POPULATION, QUANTILE, MOVES, LAST, ACCEPTANCE, LEVELS = 600, 0.2, 3, 3, 0.35, 40
PLAUSIBLE = 2.5
"""Standard deviations within which a failure is plausible."""
DOUBT = 2.0
"""By which those of the surrogate are multiplied where it is asked what it does not know."""
SAMPLE, FITTED, DISTINCT, COMPONENTS = 3000, 600, 12, 8


class Pool(NamedTuple):
    """Points drawn from ``mixture`` [n, D], and their weights p / q."""

    z: np.ndarray
    weights: np.ndarray
    mixture: Gaussians


def pool(
    rng: np.random.Generator,
    s: Surrogate,
    failures: np.ndarray,
    before: Gaussians | None,
    n: int,
    anew: bool = True,
) -> tuple[Pool, Gaussians]:
    """`Pool` of ``n`` points, and the `Gaussians` fitted on the way: ``before`` of the next one.
    ``anew``: with a population.
    """
    d = s.z.shape[1]
    origin = unit(np.zeros((1, d)))
    wide = origin._replace(values=origin.values * (2.25 if d <= 6 else 1.5))
    seen = [(0.2, unit(distinct(failures, DISTINCT)))] if len(failures) else []
    parts = [(0.1, wide), *seen, *([(0.5, before)] if before is not None else [])]
    population = plausible(rng, s) if anew else None
    if population is not None:
        parts.append((0.4, _fitted(rng, population, np.full(len(population), 1.0))))
    z, w = drawn(rng, mixed(parts), SAMPLE)
    _, p = expected(s, z)
    fitted = _fitted(rng, z, w * (np.sqrt(p * (1 - p)) + 0.3 * p))
    mixture = mixed([(0.7, fitted), (0.1, wide), *seen])
    return Pool(*drawn(rng, mixture, n), mixture), fitted


def expected(s: Surrogate, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probability [n] that the surrogate gives to a failure at ``z`` [n, D], and in `DOUBT`."""
    mean, sd = predict(s, z)
    return normal_cdf(-mean / sd), normal_cdf(-mean / (DOUBT * sd))


def plausible(rng: np.random.Generator, s: Surrogate) -> np.ndarray | None:
    """A population [n, D] of the model given that a failure is plausible; None where it does not
    get there.
    """
    score = lambda z: np.subtract(
        *(a * b for a, b in zip(predict(s, z), (1, PLAUSIBLE), strict=True))
    )
    z, scale = rng.standard_normal((POPULATION, s.z.shape[1])), 0.7
    now = score(z)
    for _ in range(LEVELS):
        level = max(float(np.quantile(now, QUANTILE)), 0.0)
        elites = np.flatnonzero(now <= level)
        rows = elites[np.arange(POPULATION) % len(elites)]
        z, now = z[rows], now[rows]
        for _ in range(MOVES if level > 0 else MOVES + LAST):
            new = math.sqrt(1 - scale**2) * z + scale * rng.standard_normal(z.shape)
            value = score(new)
            good = value <= level
            z, now = np.where(good[:, None], new, z), np.where(good, value, now)
            scale = float(np.clip(scale * math.exp(good.mean() - ACCEPTANCE), 0.05, 1.0))
        if level == 0:
            return z
    return None


def mixed(parts: list) -> Gaussians:
    """One mixture of [(share, `Gaussians`), ...]; shares of any sum."""
    weights = np.concatenate([share * g.weights for share, g in parts])
    rest = (np.concatenate([g[i] for _, g in parts]) for i in (1, 2, 3))
    return Gaussians(weights / weights.sum(), *rest)


def drawn(rng: np.random.Generator, q: Gaussians, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, D] of ``q`` and their weights p / q."""
    k, z = rng.choice(len(q.weights), n, p=q.weights), rng.standard_normal((n, q.means.shape[1]))
    for i in np.unique(k):
        rows = k == i
        z[rows] = q.means[i] + (np.sqrt(q.values[i]) * z[rows]) @ q.vectors[i].T
    log_p = -0.5 * (z**2).sum(axis=1) - 0.5 * z.shape[1] * math.log(2 * math.pi)
    return z, np.exp(log_p - gaussians.log_density(q, z))


def _fitted(rng, z, weights):
    """`Gaussians` of weighted points, and wide copies."""
    weights = weights + 1e-300
    weights = weights / weights.sum()
    if 1 / (weights**2).sum() < 10:  # few great weights: softened, so that they do not stand alone
        weights = np.sqrt(weights) / np.sqrt(weights).sum()
    count = min(1 / (weights**2).sum(), FITTED)
    rows = rng.choice(len(z), FITTED, p=weights)
    g = gaussians.fit(rng, z[rows], np.full(FITTED, 1 / FITTED), count, count / 3, COMPONENTS)
    return mixed(
        [
            (0.7, g._replace(values=np.maximum(g.values, 0.3))),
            (0.3, g._replace(values=np.maximum(1.3 * g.values, 1.0))),
        ]
    )
