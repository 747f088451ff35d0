"""Failure modes: which failures are variants of one another, and the likeliest of each kind."""

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from jast import results
from jast.episode import Episode
from jast.failures import Failures
from jast.judge import Judge
from jast.limit_state import normal_of, unit
from jast.search.centred import centred
from jast.search.moves import moved_in_time
from jast.simulator import Simulator

__all__ = ["Mode", "Modes", "modes"]

PLACES = 7
LIFTS, OPPOSITE, ALIKE = (1.0, 1.03, 1.06, 1.1), -0.5, 0.8
"""Points of a path between two failures, and how much farther out than the line between the two a
path may run: "by much" is a tenth of the way from the origin. The least cosine between the two; the
least of those that are alike.
"""


@results.shown()
class Mode(NamedTuple):
    """One way to fail."""

    failure: Episode
    """Its likeliest failure, an `jast.Episode`; its ``reward`` is log p relative to the mode of the
    disturbances."""
    members: int
    """How many of the failures found are of it."""
    share: float
    """Of the probability of failure, where there is an estimate, or NaN where that is too small to
    be divided; else of the failures found."""


class Modes(tuple):
    """A tuple of `Mode`, the likeliest first; prints as a table. ``evaluations``: episodes that it
    took to tell them apart.
    """

    evaluations = 0

    def __new__(cls, items: Iterable[Mode] = (), evaluations: int = 0):
        self = super().__new__(cls, items)
        self.evaluations = evaluations
        return self

    def _asdict(self):
        """For files."""
        return dict(items=tuple(self), evaluations=self.evaluations)

    def __str__(self):
        if not self:
            return "no failure mode"
        lines = [
            f"{'mode':>4} {'log p rel.':>11} {'log p':>11} {'steps':>6} {'members':>8} {'share':>7}"
        ]
        for i, mode in enumerate(self, 1):
            e = mode.failure
            share = "-" if np.isnan(mode.share) else f"{100 * mode.share:.0f} %"
            lines.append(
                f"{i:4d} {float(e.reward):11.4f} {float(e.log_prob):11.4f} {int(e.length):6d}"
                f" {mode.members:8d} {share:>7}"
            )
        return "\n".join(lines)

    __repr__ = __str__


def modes(
    sim: Simulator, likeliest: Failures, others: Failures | None = None, *, budget: int = 100_000
) -> Modes:
    """Sort failures into modes.

    Two failures are of one mode where a path between them never leaves the failures by much: the
    great arc between their normal numbers, each point of it failing at most a tenth farther from
    the origin (the episode of modes) than the arc itself. The same failure some steps sooner or
    later is of the same mode: where there is no path, one is looked for once more from the first
    of the two moved in time, so that both end together.

    Args:
        sim: the simulator; its disturbances have quantile functions.
        likeliest: refined failures, by falling log p relative to the mode (`jast.search.refine`).
        others: further failures to be counted as members.
        budget: evaluations, nearly. Where they are used up, failures are told apart by direction
            alone: of one mode are those with a cosine above 0.8.

    Returns:
        `Modes`. A further failure that has no path to any of ``likeliest`` counts for the mode
        whose likeliest failure it points most nearly to. Each share is of the members.
    """
    sim = centred(sim)
    centre = lambda f: np.asarray(normal_of(sim, f.episodes), np.float64)
    v, n = centre(likeliest), len(likeliest)
    if not n:
        return Modes()
    ends = likeliest.episodes.length
    i, j = np.tril_indices(n, -1)
    pairs = list(zip(i, j, strict=True))
    known = Paths(sim, budget)
    joined = known.between((v[i], ends[i]), (v[j], ends[j]))
    owner = np.arange(n)
    for (i, j), one in zip(pairs, joined, strict=True):
        if one:
            owner[owner == owner[i]] = owner[j]
    heads = sorted(set(owner), key=lambda k: np.flatnonzero(owner == k)[0])
    first = {k: int(np.flatnonzero(owner == k)[0]) for k in heads}
    members = {k: int(likeliest.counts[owner == k].sum()) for k in heads}
    if others is not None and len(others):
        rest = centre(others), others.episodes.length
        for k, times in zip(assigned(known, rest, (v, ends), owner), others.counts, strict=True):
            members[k] += int(times)
    total = max(sum(members.values()), 1)
    each = (Mode(likeliest[first[k]], members[k], members[k] / total) for k in heads)
    return Modes(each, known.spent)


def assigned(paths, many, known, owner):
    """Of each of ``many`` failures (points [m, D], steps [m]) the owner, given those of ``known``
    (points [n, D], steps [n]).
    """
    (w, ends), (v, known_ends) = many, known
    order = np.argsort(-unit(w) @ unit(v).T, axis=1)
    out = owner[order[:, 0]]
    left = np.ones(len(w), bool)
    for k in range(min(order.shape[1], 8)):
        rows = np.flatnonzero(left)
        if not len(rows):
            break
        other = order[rows, k]
        joined = paths.between((w[rows], ends[rows]), (v[other], known_ends[other]))
        out[rows[joined]] = owner[order[rows[joined], k]]
        left[rows[joined]] = False
    return out


def nearest(w, v):
    """Of each of the points ``w`` [m, D] the index of that of ``v`` [n, D] in whose direction it
    lies most nearly: [m].
    """
    return np.argmax(unit(w) @ unit(v).T, axis=1)


def owners(sim: Simulator, episodes: Episode, heads: Episode) -> np.ndarray:
    """Of each of ``episodes`` [n] the one of ``heads`` [k] in whose direction it lies, as it is or
    moved in time so that both end together: [n]. Nothing is judged.
    """
    if len(heads.length) == 1:
        return np.zeros(len(episodes.length), int)
    of_modes = centred(sim)
    there, best = (normal_of(of_modes, each) for each in (episodes, heads))
    move = jax.vmap(partial(moved_in_time, of_modes))
    cosines = [unit(there) @ unit(best).T]
    ends = np.asarray(episodes.length)
    for head, end in zip(best, heads.length, strict=True):
        moved = np.asarray(move(there, np.asarray(end - ends, np.int32)))
        cosines.append(unit(moved) @ unit(head))
    return np.argmax(np.maximum(cosines[0], np.stack(cosines[1:], axis=1)), axis=1)


class Paths:
    """Looks for paths of failures between points of ``sim``, `jast.search.centred`, for at most
    ``budget`` evaluations.
    """

    def __init__(self, sim: Simulator, budget: int):
        self.sim, self.budget, self.judge = sim, budget, Judge(sim)

    @property
    def spent(self) -> int:
        return self.judge.spent

    def between(self, first, second):
        """Whether there is a path between each of the failures ``first`` and that of ``second``
        (points [n, D], steps [n]), as they are or with the first moved in time: [n].
        """
        (v, v_ends), (w, w_ends) = first, second
        joined = self.straight(v, w)
        rows = np.flatnonzero(~joined & (v_ends != w_ends))
        if len(rows):
            steps = (w_ends - v_ends)[rows]
            moved = jax.vmap(partial(moved_in_time, self.sim))(v[rows], steps)
            joined[rows] = self.straight(np.asarray(moved), w[rows], of_both=True)
        return joined

    def straight(self, v, w, of_both=False):
        """Whether the arc between each of ``v`` [n, D] and that of ``w`` keeps to the failures:
        [n]. ``of_both``: ``v`` itself is yet to be seen failing.
        """
        n, d = v.shape
        if not n:
            return np.zeros(0, bool)
        t = (np.arange(0 if of_both else 1, PLACES + 1) / (PLACES + 1))[:, None, None]
        cosine = np.sum(unit(v) * unit(w), axis=1)
        norm = partial(np.linalg.norm, axis=-1, keepdims=True)
        total = n * len(t) * len(LIFTS)
        if self.spent + total > self.budget:
            return cosine > ALIKE
        line = (1 - t) * unit(v) + t * unit(w)
        size = (1 - t) * norm(v) + t * norm(w)
        arc = np.where(norm(line) > 1e-3, unit(line) * size, 0)
        points = arc[None] * np.array(LIFTS)[:, None, None, None]
        fails = self.judge(points.reshape(-1, d)).failure.reshape(len(LIFTS), len(t), n)
        # no arc is meant between opposite points
        return fails.any(axis=0).all(axis=0) & (cosine > OPPOSITE)
