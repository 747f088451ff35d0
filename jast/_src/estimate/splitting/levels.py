"""The levels of adaptive multilevel splitting: who is killed, and from whom it goes on."""

import math
from typing import NamedTuple, Protocol

import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.estimate.proposal_search.mixture_draws import resample

__all__ = ["FRESH", "NAME", "Played", "Run", "climb"]

NAME = "splitting"  # of the call, in messages
FRESH = -1
"""The parent of a new episode."""
KILLED = 0.25
"""Share of the particles that a level kills at least. Each level costs a round trip, and more of
them pay little: with the best score and p = 6e-5, variance times branches is 2 % above that of one
killed at a time, 8 % with a half."""
MIN_LOG_PROBABILITY = -690.0
"""Where a run gives up: the log of the least double, nearly."""


class Played(NamedTuple):
    """What came of paths that were played. On the host."""

    top: np.ndarray
    """[m] greatest score of a state of each; inf where it failed"""
    invalid: np.ndarray
    """[m] bool: it ended by a number that is not finite"""
    steps: int
    """Of all of them, from their branchings on"""
    undefined: int
    """Scores that were NaN"""


class Paths(Protocol):
    """A fixed number of paths, each with its states from where it branched off."""

    n: int

    def play(self, paths: np.ndarray, parents: np.ndarray, level: float) -> Played:
        """Replace ``paths`` [m]: by a new episode where its one of ``parents`` [m] is `FRESH`, else
        by one that goes on from that parent's first state whose score is above ``level``. No parent
        is among ``paths``.
        """
        ...


class Run(NamedTuple):
    """What one repetition came to. On the host."""

    log_mean: float
    """-inf where it died out"""
    levels: np.ndarray
    """Scores, rising"""
    failing: int
    """Particles that fail at the end"""
    ancestors: int
    """First episodes from which these descend"""
    plain: np.ndarray
    """(failing, invalid, all) of the first episodes, which are draws of the model"""
    branches: int
    steps: int
    invalid: int
    undefined: int


def climb(key, paths: Paths, killed: float = KILLED) -> Run:
    """One repetition: generalised adaptive multilevel splitting (Brehier, Gazeau, Goudenege,
    Lelievre and Rousset 2016), whose estimate is unbiased for any score, ties included.
    """
    n, rng = paths.n, numpy_generator(key, 2)
    least = max(1, math.ceil(killed * n))
    everyone = np.arange(n)
    first = paths.play(everyone, np.full(n, FRESH), -math.inf)
    top, ancestor, log_weight, levels = first.top.copy(), everyone.copy(), 0.0, []
    place = everyone.copy()  # rank in an order in which each branch stands beside its parent
    branches, steps, invalid, undefined = 0, first.steps, first.invalid.sum(), first.undefined
    while True:
        level = np.partition(top, least - 1)[least - 1]
        if level == math.inf:  # fewer than that have not failed
            break
        dead, alive = np.flatnonzero(top <= level), np.flatnonzero(top > level)
        levels.append(level)
        log_weight += math.log1p(-len(dead) / n) if len(alive) else -math.inf
        if log_weight < MIN_LOG_PROBABILITY:
            log_weight = -math.inf
            break
        # each that is alive has as many children as another in the mean, and a family as its size
        # says, to within one
        ordered = alive[np.argsort(place[alive])]
        parents = ordered[resample(np.zeros(len(alive)), len(dead), rng.random())]
        played = paths.play(dead, parents, float(level))
        top[dead], ancestor[dead] = played.top, ancestor[parents]
        place = 2 * place
        place[dead] = place[parents] + 1
        place = np.argsort(np.argsort(place, kind="stable"))
        branches, steps = branches + len(dead), steps + played.steps
        invalid, undefined = invalid + played.invalid.sum(), undefined + played.undefined
    failing = top == math.inf if log_weight > -math.inf else np.zeros(n, bool)
    count = int(failing.sum())
    return Run(
        # prod (1 - K_q / n) times the share that fails
        log_mean=log_weight + math.log(count / n) if count else -math.inf,
        levels=np.array(levels, float),
        failing=count,
        ancestors=len(np.unique(ancestor[failing])),
        plain=np.array([(first.top == math.inf).sum(), first.invalid.sum(), n]),
        branches=branches,
        steps=steps,
        invalid=int(invalid),
        undefined=undefined,
    )
