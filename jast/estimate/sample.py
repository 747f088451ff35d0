"""The failures that populations leave, as draws for further answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jast.estimate.batches import resampled
from jast.estimate.draws import Draws, drawn_by
from jast.outline import outline
from jast.pytrees import count_numbers

if TYPE_CHECKING:
    from jast.estimate.descents import Descent
    from jast.simulator import Simulator

__all__ = ["KEPT", "Sample", "counted", "independent", "sample_of"]

KEPT = 20_000
"""Failures that are kept for further answers."""


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

    points: Any
    """[m, D]"""
    used: Any
    """[m] int32: how many of the numbers decided each"""
    distance: Any
    """[m] miss distances"""
    log_weight: Any
    """[m] of the population that it comes from, whose estimate may be greater or less"""
    group: Any
    """[m] int32: which first point of which population it descends from; members of one are not
    independent
    """


def sample_of(runs: Sequence[Descent]) -> Sample:
    """The `Sample` of all populations of one kind."""
    runs = [r for r in runs if len(r.points)]
    parts = [
        (r.points, r.used, r.distance, np.full(len(r.points), float(r.log_mean))) for r in runs
    ]
    first = np.cumsum([0, *(int(r.size) for r in runs)])
    families = [r.family + n for r, n in zip(runs, first[:-1], strict=True)]
    groups = np.unique(np.concatenate(families), return_inverse=True)[1].astype(np.int32)
    return Sample(*map(np.concatenate, zip(*parts, strict=True)), groups)


def independent(key: Any, sim: Simulator, sample: Sample, log_mean: float, worth: int) -> Draws:
    """`Draws` as of ``worth`` independent ones, half of them failures of the ``sample``: those of
    one population have common ancestors, and all of them would claim too much.
    """
    m = int(np.clip(worth // 2, 2, min(len(sample.points), KEPT)))
    rows = resampled(sample.log_weight, m, 0.5)
    some = Sample(*(a[rows] for a in sample))
    return counted(key, sim, some, 2 * m)._replace(log_weight=np.full(m, log_mean + math.log(2)))


def counted(key: Any, sim: Simulator, sample: Sample, samples: int) -> Draws:
    """`Draws` of the model, so many, whose failures are the ``sample``."""
    about, m = outline(sim), len(sample.points)
    steps = (sample.used - count_numbers(about.x0)) // max(count_numbers(about.x), 1)
    found = Draws(
        log_weight=np.zeros(m),
        distance=sample.distance,
        failure=np.ones(m, bool),
        length=steps.astype(np.int32),
        row=np.arange(m),
        samples=samples,
        reach=0.0,
    )
    return drawn_by(found, key, max(m, 1), sample)
