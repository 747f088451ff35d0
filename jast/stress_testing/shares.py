"""Which part of the probability of failure is of which failure mode."""

from typing import Any

import jax
import numpy as np

from jast import limit_state as latent
from jast.estimate.batches import resampled
from jast.estimate.redrawn import redrawn
from jast.estimate.sample import Sample
from jast.search.centred import centred
from jast.search.failure_modes import Modes
from jast.search.paths import Paths, assigned, nearest
from jast.simulator import Simulator

__all__ = ["cost", "shares"]

DRAWS, LARGE, LEAST = (1024, 4096), 100_000, 10_000
"""Draws of the proposal, the more of them from the next number of evaluations of the whole budget
on; below the last they would be too great a part of it, and nothing is told.
"""
PART, PATHS, WALKS = 4, 128, 0.05
"""Of this many draws one failure is chosen, by weight; failures that are told apart by paths, too,
and what these may cost, as a share of the budget.
"""


def cost(budget: int) -> int:
    """Evaluations that `shares` takes at most."""
    n = _draws(budget)
    return n + n // PART + int(WALKS * budget) if n else 0


def shares(
    key: jax.Array, sim: Simulator, q: Any, modes: Modes, budget: int
) -> tuple[np.ndarray, int, int]:
    """The share of the probability of each of ``modes``, told from failures of the proposal ``q``.

    Every failure is of the mode in whose direction it lies; a part of them are told apart by paths,
    too, and correct the shares by the mean difference (a control variate).

    Returns:
        (shares [K], NaN where there was nothing to tell them from; draws that failed; evaluations).
    """
    n, k = _draws(budget), len(modes)
    if k == 1:
        return np.ones(1), 0, 0
    if not n:
        return np.full(k, np.nan), 0, 0
    z, o, log_w = redrawn(key, sim, q, n)
    if not (failing := int(o.failure.sum())):
        return np.full(k, np.nan), 0, n
    rows = resampled(np.where(o.failure, log_w.astype(np.float64), -np.inf), n // PART, 0.5)
    n = 0 if isinstance(q, Sample) else n  # they had been run before
    of_modes = centred(sim)
    place = lambda e: (latent.normal_of(of_modes, e).astype(np.float64), np.asarray(e.length))
    bests = [m.failure._replace(states=None) for m in modes]
    known = place(jax.tree.map(lambda *a: np.stack([np.asarray(b) for b in a]), *bests))
    points, ends = place(latent.played(sim, z[rows]))
    near = nearest(points, known[0])
    few = slice(len(rows) // PATHS // 2, None, len(rows) // PATHS)
    paths = Paths(of_modes, int(WALKS * budget))
    exact = assigned(paths, (points[few], ends[few]), known, np.arange(k))
    part = lambda owner: np.bincount(owner, minlength=k) / len(owner)
    found = np.maximum(part(near) + part(exact) - part(near[few]), 0)
    return found / found.sum(), failing, n + len(rows) + paths.spent


def _draws(budget):
    return 0 if budget < LEAST else DRAWS[budget >= LARGE]
