"""Failure modes: which failures are variants of one another, and the likeliest of each kind."""

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import results
from jast.episode import Episode
from jast.failures import Failures
from jast.limit_state import normal_numbers, normal_of
from jast.outline import outline
from jast.pytrees import count
from jast.search import moves as M
from jast.simulator import Simulator

__all__ = ["Mode", "Modes", "modes"]

PLACES = 7
LIFTS, OPPOSITE = (1.0, 1.03, 1.06, 1.1), -0.5
"""Points of a path between two failures, and how much farther out than the line between them it may
run: "by much" is a tenth of the way from the anchor. The least cosine between the two.
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
    """Of the probability of failure, where there is an estimate; else of the failures found."""


class Modes(tuple):
    """A tuple of `Mode`, the likeliest first; prints as a table."""

    def __new__(cls, items: Iterable[Mode] = ()):
        return super().__new__(cls, items)

    def _asdict(self):
        """For files."""
        return dict(items=tuple(self))

    def __str__(self):
        if not self:
            return "no failure mode"
        lines = [
            f"{'mode':>4} {'log p rel.':>11} {'log p':>11} {'steps':>6} {'members':>8} {'share':>7}"
        ]
        for i, mode in enumerate(self, 1):
            e = mode.failure
            share = "-" if np.isnan(mode.share) else f"{100 * mode.share:.1f} %"
            lines.append(
                f"{i:4d} {float(e.reward):11.4f} {float(e.log_prob):11.4f} {int(e.length):6d}"
                f" {mode.members:8d} {share:>7}"
            )
        return "\n".join(lines)

    __repr__ = __str__


def modes(sim: Simulator, likeliest: Failures, others: Failures | None = None) -> Modes:
    """Sort failures into modes.

    Two failures are of one mode where a path between them never leaves the failures by much: the
    great arc between their normal numbers, each point of it failing at most a tenth farther from
    the anchor (the episode of modes) than the arc itself. The same failure some steps sooner or
    later is of the same mode: where there is no path, one is looked for once more from the first
    of the two moved in time, so that both end together.

    Args:
        sim: the simulator; its disturbances have quantile functions.
        likeliest: refined failures, by falling log p relative to the mode (`jast.search.refine`).
        others: further failures to be counted as members.

    Returns:
        `Modes`. A further failure that has no path to any of ``likeliest`` counts for the mode
        whose likeliest failure it points most nearly to. Each share is of the members.
    """
    home = np.asarray(M.anchor(sim), np.float64)
    centre = lambda f: np.asarray(normal_of(sim, f.episodes), np.float64) - home
    v, n = centre(likeliest), len(likeliest)
    if not n:
        return Modes()
    ends = likeliest.episodes.length
    i, j = np.tril_indices(n, -1)
    pairs = list(zip(i, j, strict=True))
    joined = joined_by(sim, home, (v[i], ends[i]), (v[j], ends[j]))
    owner = np.arange(n)
    for (i, j), one in zip(pairs, joined, strict=True):
        if one:
            owner[owner == owner[i]] = owner[j]
    heads = sorted(set(owner), key=lambda k: np.flatnonzero(owner == k)[0])
    first = {k: int(np.flatnonzero(owner == k)[0]) for k in heads}
    members = {k: int(likeliest.counts[owner == k].sum()) for k in heads}
    if others is not None and len(others):
        rest = centre(others), others.episodes.length
        for k, times in zip(assigned(sim, home, rest, (v, ends), owner), others.counts):
            members[k] += int(times)
    total = max(sum(members.values()), 1)
    return Modes(Mode(likeliest[first[k]], members[k], members[k] / total) for k in heads)


def assigned(sim, home, many, known, owner):
    """Of each of ``many`` failures (points [m, D], steps [m]) the owner, given those of ``known``
    (points [n, D], steps [n]).
    """
    (w, ends), (v, known_ends) = many, known
    unit = lambda a: a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-12)
    near = unit(w) @ unit(v).T
    order = np.argsort(-near, axis=1)
    out = owner[order[:, 0]]
    left = np.ones(len(w), bool)
    for k in range(min(order.shape[1], 8)):
        rows = np.flatnonzero(left)
        if not len(rows):
            break
        other = order[rows, k]
        joined = joined_by(sim, home, (w[rows], ends[rows]), (v[other], known_ends[other]))
        out[rows[joined]] = owner[order[rows[joined], k]]
        left[rows[joined]] = False
    return out


def joined_by(sim, home, first, second):
    """Whether there is a path between each of the failures ``first`` and that of ``second`` (points
    [n, D], steps [n]), as they are or with the first moved in time: [n].
    """
    (v, v_ends), (w, w_ends) = first, second
    joined = paths(sim, home, v, w)
    rows = np.flatnonzero(~joined & (v_ends != w_ends))
    moved = [moved_by(sim, v[r], int(w_ends[r]) - int(v_ends[r])) for r in rows]
    if len(rows):
        joined[rows] = paths(sim, home, np.stack(moved), w[rows], of_both=True)
    return joined


def moved_by(sim: Simulator, v: np.ndarray, steps: int) -> np.ndarray:
    """``v`` [D], from the anchor, that many steps later; sooner where negative."""
    size = len(v) - sim.horizon * count(outline(sim).x)
    rows = v[size:].reshape(sim.horizon, -1)
    out = np.zeros_like(rows)
    if steps >= 0:
        out[steps:] = rows[: sim.horizon - steps]
    else:
        out[:steps] = rows[-steps:]
    return np.concatenate([v[:size], out.reshape(-1)])


def paths(
    sim: Simulator, home: np.ndarray, v: np.ndarray, w: np.ndarray, of_both: bool = False
) -> np.ndarray:
    """Whether failures lead from each of ``v`` [n, D] to that of ``w``, both from ``home``: [n].
    ``of_both``: ``v`` itself is yet to be seen failing.
    """
    n, d = v.shape
    if not n:
        return np.zeros(0, bool)
    t = (np.arange(0 if of_both else 1, PLACES + 1) / (PLACES + 1))[:, None, None]
    norm = lambda a: np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-12)
    line = (1 - t) * v / norm(v) + t * w / norm(w)
    size = (1 - t) * norm(v) + t * norm(w)
    arc = np.where(norm(line) > 1e-3, line / norm(line) * size, 0)
    points = home + arc[None] * np.array(LIFTS)[:, None, None, None]
    total = n * len(t) * len(LIFTS)
    flat = np.resize(points.reshape(-1, d), (1 << (total - 1).bit_length(), d))
    fails = np.asarray(_fails(sim, jnp.asarray(flat, normal_numbers(sim))))
    fails = fails[:total].reshape(len(LIFTS), len(t), n)
    # no arc is meant between opposite points
    along = np.sum(v / norm(v) * w / norm(w), axis=1) > OPPOSITE
    return fails.any(axis=0).all(axis=0) & along


@jax.jit
def _fails(sim, z):
    return jax.vmap(partial(M.judge, sim))(z).failure
