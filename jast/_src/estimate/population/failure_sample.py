"""The failures that populations leave, as draws for further answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.estimate.population.descents import Descent
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.estimate.weighted_draws import Draws, with_source
from jast._src.util.pytrees import count_numbers

__all__ = [
    "MAX_FAILURES",
    "Sample",
    "draws_of_sample",
    "independent_draws",
    "sample_from",
    "steps_of",
]

MAX_FAILURES = 20_000
"""Failures that are kept for further answers: their shares are then known to less than a per cent.
"""


class Sample(NamedTuple):
    """Failures nearly as p(z | failure) has them: what populations leave, as points of normal
    numbers. NumPy.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing()  # 11 numbers an episode, probability 4e-13
        >>> found = jast.estimate.population(jax.random.key(0), sim, 300_000)
        >>> found.proposal.points.shape[1]
        11
    """

    points: np.ndarray
    """[m, D]"""
    used: np.ndarray
    """[m] int32: how many of the numbers decided each"""
    distance: np.ndarray
    """[m] miss distances"""
    log_weight: np.ndarray
    """[m] of the population that it comes from, whose estimate may be greater or less"""
    group: np.ndarray
    """[m] int32: which first point of which population it descends from; members of one are not
    independent
    """


def sample_from(runs: Sequence[Descent]) -> Sample:
    """The `Sample` of all populations of one kind."""
    runs = [r for r in runs if len(r.points)]
    log_weight = [np.full(len(r.points), float(r.log_mean)) for r in runs]
    first = np.cumsum([0, *(int(r.size) for r in runs)])[:-1]
    families = [r.family + n for r, n in zip(runs, first, strict=True)]
    group = np.unique(np.concatenate(families), return_inverse=True)[1]
    return Sample(
        points=np.concatenate([r.points for r in runs]),
        used=np.concatenate([r.used for r in runs]),
        distance=np.concatenate([r.distance for r in runs]),
        log_weight=np.concatenate(log_weight),
        group=group.astype(np.int32),
    )


def steps_of(sim: Simulator, used: np.ndarray) -> np.ndarray:
    """The steps [m] of episodes that ``used`` so many numbers."""
    signature = signature_of(sim)
    return (used - count_numbers(signature.x0)) // max(count_numbers(signature.x), 1)


def independent_draws(
    key: Any, sim: Simulator, sample: Sample, log_mean: float, worth: int
) -> Draws:
    """`Draws` as of ``worth`` independent ones, half of them failures of the ``sample``: those of
    one population have common ancestors, and all of them would claim too much.
    """
    m = int(np.clip(worth // 2, 2, min(len(sample.points), MAX_FAILURES)))
    rows = resample(sample.log_weight, m, 0.5)
    drawn = draws_of_sample(key, sim, Sample(*(a[rows] for a in sample)), 2 * m)
    return drawn._replace(log_weight=np.full(m, log_mean + math.log(2)))


def draws_of_sample(key: Any, sim: Simulator, sample: Sample, samples: int) -> Draws:
    """`Draws` of the model, so many, whose failures are the ``sample``."""
    m = len(sample.points)
    found = Draws(
        log_weight=np.zeros(m),
        distance=sample.distance,
        failure=np.ones(m, bool),
        length=steps_of(sim, sample.used).astype(np.int32),
        row=np.arange(m),
        samples=samples,
        reach=0.0,
    )
    return with_source(found, key, max(m, 1), sample)
