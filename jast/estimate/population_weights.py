"""Importance sampling after populations: Gaussians that are fitted to thousands of their failures
draw the last part, where they promise more than further populations.

Where failures lie in a curved set of many numbers no Gaussians serve, and their weights would not
say so; the failures of populations do (`benchmarks.closed_loops`: crossing, cart-pole).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from jast.counter import numpy_generator
from jast.estimate.agreement import Answer, Kind
from jast.estimate.batches import log_ratio
from jast.estimate.estimate import Estimate
from jast.estimate.final_draws import estimated
from jast.estimate.gaussian_family import defended
from jast.estimate.gaussians import as_latent, fit
from jast.estimate.importance_sampling import even
from jast.estimate.particles import LANES
from jast.estimate.population_search import Search
from jast.estimate.sample import sample_of
from jast.estimate.sums import tail_size
from jast.limit_state import Latent, dimension, normal_numbers
from jast.watch import Watch

__all__ = ["weighted"]

EXACT = 0.005
"""Relative standard error at which it ends: no population checks a smaller one."""
PRODUCTS = 5e10
"""Products that the densities of a proposal may cost: some five seconds of a core."""
COMPONENTS = 16
"""Gaussians at most."""
DRAWS = 100_000
"""Draws that `PRODUCTS` are to pay: of long episodes there are fewer Gaussians."""
PILOT = 8
"""Share of the draws, as its denominator, that is drawn first."""
FINITE = 0.5
"""Pareto shape of weights above which they have no variance (Vehtari and others 2024)."""
SURELY = 2.0
"""Standard errors that the shape of a pilot is above `FINITE` where its weights are left. Of sums
of ten numbers, which Gaussians serve, pilots say .51 to .60 by chance, one error above; of the
follower in `benchmarks.time_to_answer`, which they do not, .6 to .75, two to five."""


class Promise(NamedTuple):
    """A proposal, and what it promises."""

    q: Latent
    draws: int
    """As many as serve"""
    relative: float
    """Relative standard error of these"""


def weighted(s: Search, name: str, kinds: Sequence[Kind], level: float) -> Estimate | None:
    """The `Estimate` by Gaussians fitted to the failures of ``kinds``; None where populations
    promise as much with what is left of the budget, and where its own weights speak against it.
    """
    left = (s.budget - s.spent) * PILOT // (PILOT + 1)
    if left < LANES:
        return None
    wide = 2  # of each component there is a wide copy
    several = int(min(PRODUCTS / (wide * DRAWS * dimension(s.sim) ** 2), COMPONENTS))
    samples = [sample_of(s.runs[k]) for k in kinds]
    log_mean = s.pooled(kinds).log_mean
    tried = [_promise(s, samples, log_mean, left, k) for k in sorted({1, max(several, 1)})]
    promise = min(tried, key=lambda p: p.relative)
    if promise.relative > _of_populations(s, kinds[0], left):
        return None
    pilot, last = jax.random.split(s.key)
    few = promise._replace(draws=max(promise.draws // PILOT, LANES))
    found = _drawn(s, name, "a pilot of importance sampling", pilot, few, level)
    if found is None or s.interrupted:
        return None
    # the standard error of a shape by so long a tail (Smith 1987)
    error = (1 + FINITE) / math.sqrt(tail_size(found.samples))
    if found.k_hat > FINITE + SURELY * error:
        return _left(s, f"Pareto k-hat above {FINITE}: the weights have no variance")
    found = _drawn(s, name, "importance sampling", last, promise, level)
    if found is None or found.reliable:
        return found
    return _left(s, "; ".join(found.warnings))


def _left(s, why):
    """None, and a line of history that says why importance sampling is not used."""
    s.history.append(f"which is not used: {why}")


def _promise(s, samples, log_mean, left, components):
    """The `Promise` of so many Gaussians at most, fitted to the first of the `Sample`. The second
    moment of their weights, E[p / q | failure] / P, is the greatest one that a `Sample` tells.
    """
    points, log_w = samples[0].points.astype(np.float64), samples[0].log_weight
    weights = np.exp(log_w - np.logaddexp.reduce(log_w))
    g = fit(numpy_generator(s.key, 7), points, weights, len(points), limit=components)
    q = as_latent(defended(g, 0.0, True), normal_numbers(s.sim))
    log_w = [a.log_weight - log_ratio(q, a.points, a.used) for a in samples]
    log_moment = max(
        np.logaddexp.reduce(w) - np.logaddexp.reduce(a.log_weight)
        for w, a in zip(log_w, samples, strict=True)
    )
    moment = math.exp(min(log_moment - log_mean, 700.0))  # e^700: no Gaussians serve
    products = len(q.means) * points.shape[1] ** 2
    draws = max(int(min(moment / EXACT**2, PRODUCTS / products, left)), LANES)
    return Promise(q, draws, math.sqrt(moment / draws))


def _of_populations(s, kind, left):
    """The relative standard error that populations of this kind promise with the rest."""
    held = sum(int(r.evaluations) for r in s.runs[kind])
    return s.answer(kind).relative / math.sqrt(1 + left / held)


def _drawn(s, name, said, key, promise, level):
    """The `Estimate` of the draws that are promised, which are ``said`` to be so; None where an
    interruption left none.
    """
    watch = Watch(name, promise.draws, "episode", False, None)
    about = dict(spent=s.spent, reasons=(), drawn=int(s.plain[2]), level=level)
    ways = s.ways._replace(name=said.replace(" ", "-"))  # each has a checkpoint of its own
    try:
        found = estimated(key, s.sim, promise.q, even(promise.draws), watch, ways, **about)
    except KeyboardInterrupt:
        s.interrupt()
        return None
    s.spent, s.invalid = s.spent + found.samples, s.invalid + found.invalid
    if found.samples < promise.draws:
        s.interrupt()
    answer = Answer(found.log_mean, found.relative_error)
    s.history.append(f"{said}: {answer}, {found.samples} draws, k-hat {found.k_hat:.2f}")
    return found
