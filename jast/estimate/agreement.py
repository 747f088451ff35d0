"""The populations of one estimate: which ways are gone, how often, and whether they agree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from jast import units
from jast.estimate.descents import WAYS, Descent
from jast.estimate.estimate import Estimate, of_counts
from jast.estimate.particles import LANES, Particles, blank, counter_key, fresh
from jast.estimate.sample import KEPT, Sample, counted, independent, sample_of
from jast.estimate.sums import nothing
from jast.intervals import clopper_pearson, log_normal
from jast.places import Task
from jast.rounding import rounded

__all__ = ["Answer", "Kind", "Search", "answer_of"]

AUDIT = 1 / 3
"""Share of the evaluations that the less exact way has, to be a witness."""
APART = 3.0
"""Standard errors of their difference within which two ways agree: chance parts one of 370."""
BLUNT = 0.3
"""Relative standard error above which a way witnesses nothing."""
SURE = 1e-4
"""One minus the level of the interval of the plain draws that an answer must lie in."""
PLENTY = 1000
"""Failures among plain draws that tell a probability to 3 %: then they are all that is drawn."""
SEEN = 10
"""Failures among the first plain draws from which the probability is roughly known."""
ROUGH = 0.05
"""Relative standard error above which 10 % more or less lies within a 95 % interval."""
INVALID = 0.01
"""Part of an answer that invalid episodes may add, if they failed."""
FEWEST = 512
"""Points that a population at least has where it is one of several: its own error is then told."""
REPEATED = 4
"""Populations from which on their spread speaks beside what their genealogies say."""


class Answer(NamedTuple):
    """What populations of one kind say."""

    log_mean: float
    relative: float
    """Relative standard error"""

    def apart(self, other: Answer) -> float:
        """The difference of two logarithms in its standard errors."""
        return abs(self.log_mean - other.log_mean) / math.hypot(self.relative, other.relative)


class Kind(NamedTuple):
    """A way down, and how often a point moves between two levels."""

    way: str
    moves: int

    def __str__(self) -> str:
        return f"by {self.way}, {self.moves} moves"


class Search:
    """The populations so far, and what they cost."""

    def __init__(self, key, sim, budget, n, capacity, watch, ways, settings):
        self.key, self.sim, self.budget, self.n, self.capacity = key, sim, budget, n, capacity
        self.watch, self.ways, self.settings = watch, ways, settings
        self.runs: dict[Kind, tuple[Descent, ...]] = {}
        self.spent = self.invalid = 0
        self.plain = np.zeros(3, np.int64)
        self.interrupted = ""
        self.reasons = [] if (coarse := rounded(sim)) is None else [coarse]
        self.history = []
        self.found, self.looked = [], 0  # failures of plain draws, and among how many

    def run(self, kind, count, n=None):
        """``count`` more populations of a kind, of ``n`` points."""
        before, n = self.runs.get(kind, ()), self.n if n is None else n
        shared = self.key, self.sim, kind.way, n, self.capacity, kind.moves, len(before)
        task = Task(_unit, (*shared, self.settings), lambda: Descent(*Descent._fields))
        cost = before[-1].evaluations if before else 0
        done, total = self.spent, self.budget
        try:
            ran = units.run(
                task,
                count,
                lambda runs, number, run: (*runs, run),
                (),
                self.watch,
                self.ways._replace(name=f"{kind.way}-{kind.moves}-{len(before)}"),
                size=lambda units: min(int(done + units * cost), total),
            )
        except KeyboardInterrupt:
            if not self.runs:
                raise
            self.interrupted = f"interrupted after {self.spent} of {self.budget} evaluations"
            return
        self.runs[kind] = before + ran.state
        for r in ran.state:
            self.spent += int(r.evaluations)
            self.invalid += int(r.invalid)
            self.plain += r.plain
            self.history.append(_told(kind, r))
        if ran.ended is not None:
            self.interrupted = f"interrupted after {self.spent} of {self.budget} evaluations"
        self.reasons += map(str, ran.incidents)

    def cost(self, kind):
        """Evaluations a point of a population of this kind; of one that moves twice as often, twice
        as many.
        """
        if kind in self.runs:
            return float(np.mean([r.evaluations / r.size for r in self.runs[kind]]))
        return 2 * self.cost(Kind(kind.way, kind.moves // 2))

    def answer(self, kind):
        """The `Answer` of a kind; None where none of its populations reached a failure."""
        return answer_of(self.runs.get(kind, ()))

    def promised(self, kind):
        """The relative standard error of this kind after the witness's part of the budget."""
        cost = self.answer(kind).relative ** 2 * self.cost(kind) * self.n
        return math.sqrt(cost / (AUDIT * self.budget))

    def plain_is_best(self):
        """Whether plain draws alone tell the probability."""
        failing, _, drawn = self.plain
        return failing >= SEEN and failing / drawn * (self.budget - self.spent) >= PLENTY

    def draw_plainly(self):
        """Spend the rest on the model's own draws."""
        particles, key, i = blank(self.sim, self.capacity), counter_key(self.key, 5), 0
        try:
            while self.spent < self.budget:
                m = min(self.capacity, self.budget - self.spent)
                particles, invalid = fresh(self.sim, particles, jax.random.fold_in(key, i), m)
                rows = np.flatnonzero(np.asarray(particles.score)[:m] == -np.inf)
                if sum(map(len, self.found)) < KEPT:  # the rest adds to the count alone
                    self.found.append(Particles(*(np.asarray(a)[rows] for a in particles)))
                    self.looked += m
                self.plain += len(rows), invalid, m
                self.spent, self.invalid, i = self.spent + m, self.invalid + invalid, i + 1
                self.watch.reach(min(self.spent, self.budget))
                self.watch.tell()
        except KeyboardInterrupt:
            self.interrupted = f"interrupted after {self.spent} of {self.budget} evaluations"
        self.history.append(f"plain draws: {self.plain[0]} of {self.plain[2]} fail")

    def counted(self, name, level):
        """The `Estimate` of plain draws."""
        failing, invalid, drawn = map(int, self.plain)
        total = nothing(drawn)._replace(
            samples=drawn, failures=failing, invalid=invalid, draws=self.drawn_plainly()
        )
        return of_counts(
            f"{name}: plain draws",
            total,
            level=level,
            reasons=self.reasons,
            notes=(self.interrupted,) if self.interrupted else (),
            evaluations=self.spent,
            history=tuple(self.history),
        )

    def drawn_plainly(self):
        """`Draws` of plain draws; None where there were none but those of populations."""
        if not self.found:
            return None
        p = jax.tree.map(lambda *a: np.concatenate(a), *self.found)
        none = np.zeros(len(p.z))
        sample = Sample(p.z, p.used, p.distance, none, none.astype(np.int32))
        return counted(self.key, self.sim, sample, self.looked)

    def witnesses(self):
        """The two kinds that are to agree, the more exact for its cost first; one where there is
        no second, and () where no failure was reached.
        """
        first = [Kind(way, self.settings.moves) for way in WAYS]
        seen = [k for k in first if self.answer(k) is not None]
        work = lambda k: self.answer(k).relative ** 2 * self.cost(k)
        seen = sorted(seen, key=work)
        if len(seen) == 2 and self.promised(seen[1]) <= BLUNT:
            return tuple(seen)
        if not seen:
            return ()
        slow, fast = seen[0], Kind(seen[0].way, 2 * seen[0].moves)
        while self.spent + self.n * self.cost(fast) <= self.budget and not self.interrupted:
            self.run(fast, 1)
            if (new := self.answer(fast)) is None:
                break
            if self.answer(slow).apart(new) <= APART:
                return fast, slow
            slow, fast = fast, Kind(fast.way, 2 * fast.moves)
        return (slow,)

    def repeat(self, kinds):
        """Spend the rest on populations of these kinds; a third of all is the witness's."""
        if len(kinds) == 2 and kinds[0].way != kinds[1].way:
            held = sum(int(r.evaluations) for r in self.runs[kinds[1]])
            self.fill(kinds[1], min(AUDIT * self.budget - held, self.budget - self.spent))
        self.fill(kinds[0], self.budget - self.spent)

    def fill(self, kind, evaluations):
        """Populations of this kind, alike in size, for so many ``evaluations``."""
        points, most = evaluations / self.cost(kind), min(2 * self.n, self.capacity)
        count = max(math.ceil(points / most), 1)
        n = int(points / count) // LANES * LANES
        if n >= min(FEWEST, self.n) and not self.interrupted:
            self.run(kind, count, n)

    def estimate(self, name, kinds, level):
        """The `Estimate` of all populations of ``kinds``."""
        reasons, (failing, invalid, drawn) = [*self.reasons], map(int, self.plain)
        if self.interrupted:
            reasons.append(self.interrupted)
        answers = [a for a in map(self.answer, kinds) if a is not None]
        if not answers:
            reasons.append(
                "no population reached a failure: only what plain draws guarantee is known"
            )
            found = self.counted(name, level)
            return found._replace(
                method=f"{name}: populations",
                reliable=False,
                warnings=(*reasons, *found.warnings),
            )
        exact = answers[0]
        if len(answers) == 1:
            reasons.append(
                f"populations {kinds[0]}, are all that tells the probability, and none checks them"
            )
        else:
            apart = answers[0].apart(answers[1])
            said = " and ".join(
                f"{math.exp(a.log_mean):.3g} +- {a.relative:.1%} {k}"
                for k, a in zip(kinds, answers, strict=True)
            )
            self.history.append(f"{said}: {apart:.1f} standard errors apart")
            if apart > APART:
                reasons.append(f"the ways do not agree: {said}")
            else:
                exact = _pooled(answers)
        low, high = clopper_pearson(failing, drawn, 1 - SURE)
        if not low <= math.exp(exact.log_mean) <= high:
            reasons.append(
                f"plain draws say otherwise: {failing} of {drawn} fail, so the probability lies"
                f" between {low:.3g} and {high:.3g}"
            )
        if (share := invalid / drawn) > INVALID * math.exp(exact.log_mean):
            reasons.append(
                f"{share:.2g} of the model's own episodes are invalid (a number that is not"
                " finite), which counts as not failing"
            )
        if not reasons and exact.relative > ROUGH:
            reasons.append(
                f"relative standard error {exact.relative:.2g}, above {ROUGH}: the interval holds"
                " the truth as often as it says, and a greater budget narrows it"
            )
        runs, sample = [r for k in kinds for r in self.runs[k]], sample_of(self.runs[kinds[0]])
        log_mean, mean = min(exact.log_mean, 0.0), math.exp(min(exact.log_mean, 0.0))
        return Estimate(
            method=f"{name}: populations " + " and ".join(dict.fromkeys(str(k) for k in kinds)),
            log_mean=log_mean,
            mean=mean,
            standard_error=mean * exact.relative,
            relative_error=exact.relative,
            interval=log_normal(log_mean, exact.relative, level),
            level=level,
            ess=exact.relative**-2 if exact.relative > 0 else math.inf,
            k_hat=math.nan,
            max_share=math.nan,
            failing=sum(len(r.points) for r in runs),
            samples=sum(int(r.size) for r in runs),
            episodes=self.spent,
            steps=0,
            invalid=self.invalid,
            modes=None,
            reliable=not reasons,
            warnings=tuple(reasons),
            proposal=sample,
            history=tuple(self.history),
            plain=(failing, drawn),
            draws=independent(self.key, self.sim, sample, log_mean, int(exact.relative**-2)),
        )


def answer_of(runs: Sequence[Descent]) -> Answer | None:
    """The `Answer` of populations of one kind; None where none of them reached a failure."""
    logs = np.array([float(r.log_mean) for r in runs])
    if not np.isfinite(logs).any():
        return None
    sizes = np.array([float(r.size) for r in runs])
    top, share, n = logs.max(), sizes / sizes.sum(), len(logs)
    p = np.exp(logs - top)
    mean = share @ p
    own = np.where(p > 0, np.array([float(r.variance) for r in runs]), 0)
    variance = share**2 @ (own * p**2)
    if n >= REPEATED or (n > 1 and not (p > 0).all()):
        variance = max(variance, share**2 @ (p - mean) ** 2 * n / (n - 1))
    return Answer(top + math.log(mean), math.sqrt(variance) / mean)


def _pooled(answers):
    """Two answers as one, by their variances."""
    weights = np.array([a.relative**-2 for a in answers])
    weights /= weights.sum()
    logs = np.array([a.log_mean for a in answers])
    top = logs.max()
    return Answer(
        top + math.log(weights @ np.exp(logs - top)),
        math.sqrt(sum((w * a.relative) ** 2 for w, a in zip(weights, answers, strict=True))),
    )


def _told(kind, r):
    """A population in words."""
    levels = ", ".join(f"{v:.4g}" for v in r.levels[-3:])
    said = f"{len(r.levels)} {'levels' if kind.way == 'distance' else 'widths'}"
    if len(r.levels):
        said += f", the last {levels}"
    if np.isfinite(r.log_mean):
        end = f"log p {r.log_mean:.3f}, relative standard error {math.sqrt(r.variance):.2g}"
    else:
        end = "no failure reached"
    return f"population {kind}: {said}; {end}; {r.evaluations} evaluations"


def _unit(shared, number, post):
    """The `Descent` of a population."""
    key, sim, way, n, capacity, moves, first, settings = shared
    key = jax.random.fold_in(
        jax.random.fold_in(key, moves), 2 * (first + number) + (way == "width")
    )
    return WAYS[way](key, sim, n, moves, capacity, settings)
