"""Where a surrogate expects failures: weighted points of the model, by a mixture of Gaussians
around them. They cost no call of the system.

The mixture is made of a population that goes down the levels of the surrogate (subset simulation,
Au and Beck 2001), started anew each time; of the mixture before; of the failures seen; and of
wider noise. So a mode that one of them has found once is not lost.
"""

import math
from typing import NamedTuple

import numpy as np

from jast._src.estimate.few_calls.surrogate import Surrogate, predict, probability_below_zero
from jast._src.estimate.gaussians.design_points import distinct
from jast._src.estimate.gaussians.mixture_fit import as_latent, fit_mixture, unit_gaussians
from jast._src.estimate.proposal_search import mixture_draws
from jast._src.normal_space import transform
from jast._src.normal_space.pcn import proposed

__all__ = ["DOUBT", "Pool", "expected", "pool"]

POPULATION = 600  # points that go down the levels
QUANTILE = 0.2  # share of them that comes to the next level
MOVES = 3  # Markov moves at each level: they cost no call
LAST_MOVES = 6  # the same at the last one, whose points are used
ACCEPTANCE = 0.35  # share of moves that the size of the moves is adapted to
FIRST_SCALE = 0.7  # the first size of the moves, as in `estimate.host_populations`
LEAST_SCALE = 0.05  # the least size
LEVELS = 40  # at most
PLAUSIBLE = 2.5  # standard deviations within which a failure is plausible
DOUBT = 2.0  # factor on the surrogate's deviations where it is asked what it does not know
SAMPLE = 3000  # weighted points that the mixture is fitted to
FITTED = 600  # of these, drawn by weight; the effective number that a fit counts at most
DISTINCT = 12  # failures seen that get a Gaussian
COMPONENTS = 8  # of a fitted mixture, at most
FAILURES = 0.3  # weight of an expected failure beside the doubt about it
FEW = 10  # effective points below which weights are softened
COVARIANCE_SHARE = 1 / 3  # of the effective number, what counts for covariances
NARROWEST = 0.3  # least variance of a fitted Gaussian
WIDER = 1.3  # factor on the variances of its wide copy
OF_WIDE_COPIES = 0.3  # share of wide copies in a fitted mixture
OF_FITTED = 0.7  # share of what is fitted in the mixture that is drawn from, and below of others
OF_WIDE = 0.1  # share of wide noise in it
OF_SEEN = 0.2  # share of Gaussians about failures seen
OF_BEFORE = 0.5  # share of the mixture of the last batch
OF_POPULATION = 0.4  # share of the moved population
FEW_NUMBERS = 6  # dimensions up to which wide noise is wider
WIDE_FEW = 2.25  # variance of wide noise there
WIDE_MANY = 1.5  # the same of more dimensions


class Pool(NamedTuple):
    """Points drawn from ``mixture`` [n, D], and their weights p / q."""

    z: np.ndarray
    weights: np.ndarray
    mixture: transform.Latent


def pool(
    rng: np.random.Generator,
    surrogate: Surrogate,
    failures: np.ndarray,
    before: list | None,
    n: int,
    anew: bool = True,
) -> tuple[Pool, list]:
    """`Pool` of ``n`` points, and the parts [(share, `Gaussians`), ...] fitted on the way:
    ``before`` of the next one. ``anew``: with a population.
    """
    d = surrogate.points.shape[1]
    wide = unit_gaussians(np.zeros((1, d)))
    wide = wide._replace(values=wide.values * (WIDE_FEW if d <= FEW_NUMBERS else WIDE_MANY))
    always = [(OF_WIDE, wide)]
    if len(failures):
        always.append((OF_SEEN, unit_gaussians(distinct(failures, DISTINCT))))
    parts = [*always, *_scaled(OF_BEFORE, before or [])]
    population = plausible(rng, surrogate) if anew else None
    if population is not None:
        parts += _scaled(OF_POPULATION, _fit(rng, population, np.ones(len(population))))
    z, weights = _draw(rng, as_latent(parts, np.float64), SAMPLE)
    _, p = expected(surrogate, z)
    fitted = _fit(rng, z, weights * (np.sqrt(p * (1 - p)) + FAILURES * p))
    mixture = as_latent([*_scaled(OF_FITTED, fitted), *always], np.float64)
    return Pool(*_draw(rng, mixture, n), mixture), fitted


def expected(surrogate: Surrogate, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probability [n] that the surrogate gives to a failure at ``z`` [n, D], and in `DOUBT`."""
    mean, deviation = predict(surrogate, z)
    return tuple(probability_below_zero(mean, by * deviation) for by in (1.0, DOUBT))


def plausible(rng: np.random.Generator, surrogate: Surrogate) -> np.ndarray | None:
    """A population [n, D] of the model given that a failure is plausible; None where it does not
    get there.
    """

    def score(z):
        mean, deviation = predict(surrogate, z)
        return mean - PLAUSIBLE * deviation

    z, scale = rng.standard_normal((POPULATION, surrogate.points.shape[1])), FIRST_SCALE
    scores = score(z)
    for _ in range(LEVELS):
        level = max(float(np.quantile(scores, QUANTILE)), 0.0)
        elites = np.flatnonzero(scores <= level)
        rows = elites[np.arange(POPULATION) % len(elites)]
        z, scores = z[rows], scores[rows]
        for _ in range(MOVES if level > 0 else LAST_MOVES):
            candidates = proposed(z, rng.standard_normal(z.shape), scale, 1.0)
            values = score(candidates)
            accepted = values <= level
            z = np.where(accepted[:, None], candidates, z)
            scores = np.where(accepted, values, scores)
            scale *= math.exp(accepted.mean() - ACCEPTANCE)
            scale = float(np.clip(scale, LEAST_SCALE, 1.0))
        if level == 0:
            return z
    return None


def _scaled(share, parts):
    """The ``parts`` of a mixture, of ``share`` in all."""
    return [(share * of, g) for of, g in parts]


def _draw(rng, q, n):
    """Points [n, D] of the `Latent` ``q``, and their weights p / q."""
    d = q.means.shape[1]
    z = transform.place(q, *mixture_draws.random_numbers(rng, n, d, np.float64))
    return z, np.exp(-mixture_draws.log_ratio(q, z, np.full(n, d)))


def _fit(rng, z, weights):
    """The parts of a mixture: `Gaussians` of weighted points, and wide copies."""
    weights = weights + 1e-300
    weights = weights / weights.sum()
    if 1 / (weights**2).sum() < FEW:  # so that few great ones do not stand alone
        weights = np.sqrt(weights) / np.sqrt(weights).sum()
    count = min(1 / (weights**2).sum(), FITTED)
    rows = rng.choice(len(z), FITTED, p=weights)
    even = np.full(FITTED, 1 / FITTED)
    g = fit_mixture(rng, z[rows], even, count, COVARIANCE_SHARE * count, COMPONENTS)
    wide = g._replace(values=np.maximum(WIDER * g.values, 1.0))
    narrow = g._replace(values=np.maximum(g.values, NARROWEST))
    return [(1 - OF_WIDE_COPIES, narrow), (OF_WIDE_COPIES, wide)]
