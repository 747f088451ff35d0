"""Failure modes: which failures are variants of one another, and the likeliest of each kind."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.episode import Episode, replay
from jast._src.core.failures import Failures
from jast._src.core.rewards import likelihood
from jast._src.core.simulator import Simulator
from jast._src.io.data_frames import dataframe
from jast._src.normal_space.mode_coordinates import centred
from jast._src.normal_space.transform import normal_of, unit
from jast._src.search.refine.connectivity import ALIKE, Paths, assigned, components, moved_in_time
from jast._src.util import display
from jast._src.util.checks import instance

__all__ = ["UNKNOWN", "Mode", "Modes", "modes", "owners", "pointing", "spread"]

UNKNOWN = (math.nan, math.nan)


@display.printable()
class Mode(NamedTuple):
    """One way to fail.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(key, sim, episodes=500, refine=0).failures
        >>> ways = jast.search.modes(sim, jast.search.refine(key, sim, found, budget=2000).failures)
        >>> bool(ways[0].failure.failure), 0 < ways[0].share < 1
        (True, True)
    """

    failure: Episode
    """Its likeliest failure, an `jast.Episode`; its ``reward`` is log p relative to the mode of the
    disturbances."""
    members: int
    """How many of the failures found are of it."""
    share: float
    """Of the probability of failure, where there is an estimate, or NaN where that is too small to
    be divided; else of the failures found."""
    share_interval: tuple[float, float] = UNKNOWN
    """(low, high) of a share of the probability, at 95 %; NaN where that is not known."""

    @property
    def share_words(self) -> str:
        """The share and its interval, rounded outwards, in per cent."""
        if np.isnan(self.share):
            return "-"
        low, high = self.share_interval
        of_members = " of members" if np.isnan(low) else ""
        more = f" [{math.floor(100 * low)}, {math.ceil(100 * high)}]" if low < high else of_members
        return f"{100 * self.share:.0f} %{more}"


class Modes(tuple):
    """A tuple of `Mode`, the likeliest first; prints as a table. ``evaluations``: episodes that it
    took to tell them apart.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(key, sim, episodes=500, refine=0).failures
        >>> ways = jast.search.modes(sim, jast.search.refine(key, sim, found, budget=2000).failures)
        >>> sum(way.members for way in ways) > 1, ways.evaluations > 0
        (True, True)
    """

    evaluations = 0

    def __new__(cls, items: Iterable[Mode] = (), evaluations: int = 0) -> Modes:
        self = super().__new__(cls, items)
        self.evaluations = evaluations
        return self

    @property
    def others(self) -> float:
        """The share of the probability that is of none of these modes, as far as failures of the
        estimate tell; 0 where nothing tells.
        """
        told = [m.share for m in self if not np.isnan([m.share, *m.share_interval]).any()]
        return max(1.0 - sum(told), 0.0) if told else 0.0

    def _asdict(self) -> dict[str, Any]:
        """For files."""
        return dict(items=tuple(self), evaluations=self.evaluations)

    def to_dataframe(self) -> Any:
        """The modes as a table of pandas (the extra ``tables``): of the likeliest failure of each
        ``log_prob_from_mode``, ``log_prob``, ``distance`` and ``length``, then ``members``,
        ``share``, ``share_low`` and ``share_high``.

        Returns:
            The ``pandas.DataFrame``; its index is ``mode``, from 1.

        Raises:
            ImportError: where pandas is not installed.
        """
        columns = [("mode", np.arange(1, len(self) + 1))]
        for field in ("reward", "log_prob", "distance", "length"):
            name = "log_prob_from_mode" if field == "reward" else field
            columns.append((name, [np.asarray(getattr(m.failure, field)).item() for m in self]))
        columns += [("members", [m.members for m in self]), ("share", [m.share for m in self])]
        for i, end in enumerate(("share_low", "share_high")):
            columns.append((end, [m.share_interval[i] for m in self]))
        return dataframe(columns, ["mode"])

    def __str__(self) -> str:
        if not self:
            return "no failure mode"
        wide = max(7, *(len(mode.share_words) for mode in self))
        head = f"{'mode':>4} {'log p rel.':>11} {'log p':>11} {'steps':>6} {'members':>8}"
        lines = [f"{head} {'share':>{wide}}"]
        for i, mode in enumerate(self, 1):
            e = mode.failure
            lines.append(
                f"{i:4d} {float(e.reward):11.4f} {float(e.log_prob):11.4f} {int(e.length):6d}"
                f" {mode.members:8d} {mode.share_words:>{wide}}"
            )
        if round(100 * self.others) > 0:
            lines.append(f"failures of no mode above {100 * self.others:{17 + wide}.0f} %")
        return "\n".join(lines)

    __repr__ = __str__


def modes(
    sim: Simulator, likeliest: Failures, others: Failures | None = None, *, budget: int = 100_000
) -> Modes:
    """Sort failures into modes.

    Two failures are of one mode where a path between them never leaves the failures by much: the
    great arc between their normal numbers, each point of it failing at most a tenth farther from
    the origin (the episode of modes) than the arc itself, or bent to a failure beside the arc, at
    most a tenth of that way from it. The same failure some steps sooner or
    later is of the same mode: where there is no path, one is looked for once more from the shorter
    one moved in time, so that both end together. A path may lead by way of other failures
    that are known, where none is more than a nat rarer than both ends.

    Args:
        sim: the simulator; its disturbances have quantile functions.
        likeliest: refined failures, by falling log p relative to the mode (`jast.search.refine`).
        others: further failures, to be counted as members, and for paths to lead by.
        budget: evaluations, nearly. Where they are used up, failures are told apart by direction
            alone: of one mode are those with a cosine above 0.8.

    Returns:
        `Modes`. A further failure that has no path to any of ``likeliest`` counts for the mode
        whose likeliest failure it points most nearly to. Each share is of the members.

    Raises:
        ValueError: for what is no archive of failures.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(key, sim, episodes=500, refine=0).failures
        >>> ways = jast.search.modes(sim, jast.search.refine(key, sim, found, budget=2000).failures)
        >>> len(ways)  # upwards and downwards
        2
    """
    for name, given in (("likeliest", likeliest), ("others", others)):
        if name == "likeliest" or given is not None:
            words = "an archive of jast.failures, as the failures of a result"
            instance("modes", name, given, Failures, words)
    n = len(likeliest)
    if not n:
        return Modes()
    found = [likeliest] if others is None or not len(others) else [likeliest, others]
    paths = Paths(centred(sim), budget)
    points = [np.asarray(normal_of(paths.sim, f.episodes), np.float64) for f in found]
    v, cost = np.concatenate(points), np.concatenate([_cost(paths, sim, f) for f in found])
    ends = np.concatenate([f.episodes.length for f in found])
    counts = np.concatenate([f.counts for f in found])
    owner = components(paths, v, ends, cost, n)
    known = np.isin(owner, owner[:n])
    if not known.all():
        owner[~known] = assigned(
            paths, (v[~known], ends[~known]), (v[known], ends[known]), owner[known]
        )
    kinds, total = [], int(counts.sum())
    for k in dict.fromkeys(owner[:n]):  # as those given fall
        members = int(counts[owner == k].sum())
        kinds.append(Mode(likeliest[int(np.argmax(owner[:n] == k))], members, members / total))
    return Modes(kinds, paths.spent)


def _cost(paths, sim, failures):
    """By how many nats each of ``failures`` is rarer than the mode: [n]; their reward says it,
    unless another one ranks them.
    """
    rewards = failures.episodes.reward

    def log_p(e):
        return float(replay(sim, e, reward=likelihood(sim)).reward)

    other = not np.isclose(log_p(failures[0]), rewards[0])
    paths.judge.spent += 1 + other * len(failures)
    return -np.array([log_p(e) for e in failures]) if other else -rewards


def spread(sim: Simulator, failures: Failures, top: int) -> Failures:
    """At most ``top`` of ``failures``: the best, which are the first half, and of the others those
    that have the fewest better ones in their direction, so that no mode crowds out another one.
    """
    if len(failures) <= top:
        return failures
    ways = unit(np.asarray(normal_of(centred(sim), failures.episodes), np.float64))
    better = np.tril(ways @ ways.T > ALIKE, -1).sum(axis=1)
    better[: top // 2] = 0
    rows = np.sort(np.argsort(better, kind="stable")[:top])
    return failures.take(rows)


def owners(sim: Simulator, episodes: Episode, heads: Episode) -> np.ndarray:
    """Of each of ``episodes`` [n] the one of ``heads`` [k] in whose direction it lies, as it is or
    moved in time so that both end together: [n]. Nothing is judged.
    """
    if len(heads.length) == 1:
        return np.zeros(len(episodes.length), int)
    of_modes, last = centred(sim), np.asarray(heads.length)
    points, ends = normal_of(of_modes, episodes), np.asarray(episodes.length)
    return pointing(sim, points, ends, normal_of(of_modes, heads), last)


def pointing(
    sim: Simulator, points: np.ndarray, ends: np.ndarray, heads: np.ndarray, last: np.ndarray
) -> np.ndarray:
    """The same of ``points`` [n, D] that end after ``ends`` [n] steps, and of ``heads`` [k, D]."""
    cosines = [unit(points) @ unit(heads).T]
    for head, end in zip(heads, last, strict=True):
        cosines.append(unit(moved_in_time(sim, points, end - ends)) @ unit(head))
    return np.argmax(np.maximum(cosines[0], np.stack(cosines[1:], axis=1)), axis=1)
