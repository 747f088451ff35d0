"""The populations of one estimate: which ways are gone, and how often."""

from __future__ import annotations

import math

import jax
import numpy as np

from jast import units
from jast.estimate.agreement import APART, BLUNT, Answer, Kind, answer_of, pooled, told
from jast.estimate.descents import WAYS, Descent
from jast.estimate.particles import LANES
from jast.places import Task
from jast.rounding import rounding_problem

__all__ = ["Search"]

AUDIT = 1 / 3
"""Share of the evaluations that the less exact way has, to be a witness."""
PLENTY = 1000
"""Failures among plain draws that tell a probability to 3 %: then they are all that is drawn."""
SEEN = 10
"""Failures among the first plain draws from which the probability is roughly known."""
FEWEST = 512
"""Points that a population at least has where it is one of several: its own error is then told."""


class Search:
    """The populations so far, and what they cost."""

    def __init__(self, key, sim, budget, n, capacity, watch, ways, settings):
        self.key, self.sim, self.budget, self.n, self.capacity = key, sim, budget, n, capacity
        self.watch, self.ways, self.settings = watch, ways, settings
        self.runs: dict[Kind, tuple[Descent, ...]] = {}
        self.spent = self.invalid = 0
        self.plain = np.zeros(3, np.int64)
        self.interrupted = ""
        self.reasons = [] if (coarse := rounding_problem(sim)) is None else [coarse]
        self.history = []

    def kind(self, way):
        """A way with its first number of moves."""
        return Kind(way, getattr(self.settings, f"moves_by_{way}"))

    def run(self, kind, count, n=None):
        """``count`` more populations of a kind, of ``n`` points."""
        before, n = self.runs.get(kind, ()), self.n if n is None else n
        shared = self.key, self.sim, kind.way, n, self.capacity, kind.moves, len(before)
        most = math.inf if before else AUDIT * self.budget / 2  # the first one shows what it costs
        task = Task(_unit, (*shared, self.settings, most), lambda: Descent(*Descent._fields))
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
            self.interrupt()
            return
        self.runs[kind] = before + ran.state
        for r in ran.state:
            self.spent += int(r.evaluations)
            self.invalid += int(r.invalid)
            self.plain += r.plain
            self.history.append(told(kind, r))
        if ran.ended is not None:
            self.interrupt()
        self.reasons += map(str, ran.incidents)

    def interrupt(self):
        """Note that the call was interrupted."""
        self.interrupted = f"interrupted after {self.spent} of {self.budget} evaluations"

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

    def witnesses(self):
        """The two kinds that are to agree, the more exact for its cost first; one where there is
        no second, and () where no failure was reached.
        """
        seen = [k for k in map(self.kind, WAYS) if self.answer(k) is not None]
        if not seen:
            return ()
        seen = self.by_work(seen)
        if len(seen) == 2 and self.promised(seen[1]) <= BLUNT:
            return seen
        slow, fast = seen[0], Kind(seen[0].way, 2 * seen[0].moves)
        while self.spent + self.n * self.cost(fast) <= self.budget and not self.interrupted:
            self.run(fast, 1)
            if (new := self.answer(fast)) is None:
                break
            if self.answer(slow).apart(new) <= APART:
                return self.by_work([fast, slow])
            slow, fast = fast, Kind(fast.way, 2 * fast.moves)
        return (slow,)

    def by_work(self, kinds):
        """The ``kinds``, those first whose variance costs least."""
        return tuple(sorted(kinds, key=lambda k: self.answer(k).relative ** 2 * self.cost(k)))

    def witness(self, kinds):
        """Spend a third of all on the second of two ways."""
        if len(kinds) == 2 and kinds[0].way != kinds[1].way:
            held = sum(int(r.evaluations) for r in self.runs[kinds[1]])
            self.fill(kinds[1], min(AUDIT * self.budget - held, self.budget - self.spent))

    def fill(self, kind, evaluations):
        """Populations of this kind, alike in size, for so many ``evaluations``."""
        points, most = evaluations / self.cost(kind), min(2 * self.n, self.capacity)
        count = max(math.ceil(points / most), 1)
        n = int(points / count) // LANES * LANES
        if n >= min(FEWEST, self.n) and not self.interrupted:
            self.run(kind, count, n)

    def pooled(self, kinds) -> Answer:
        """The `Answer` of all populations of ``kinds``."""
        return pooled([self.answer(k) for k in kinds])


def _unit(shared, number, post):
    """The `Descent` of a population."""
    key, sim, way, n, capacity, moves, first, settings, most = shared
    key = jax.random.fold_in(
        jax.random.fold_in(key, moves), 2 * (first + number) + (way == "width")
    )
    about = dict(most=most) if way == "width" else {}
    return WAYS[way](key, sim, n, moves, capacity, settings, **about)
