"""The populations of one estimate: which ways are gone and how often, what they say, and whether
they agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from jast._src.core.float_resolution import rounding_problem
from jast._src.estimate.estimate import MAX_INVALID_SHARE, MAX_RELATIVE_ERROR
from jast._src.estimate.population.descents import DESCENTS, SETTINGS, Descent
from jast._src.runtime import work as units
from jast._src.runtime.backends import Task
from jast._src.runtime.device import BLOCK
from jast._src.util.intervals import clopper_pearson

__all__ = [
    "MAX_DISAGREEMENT",
    "MAX_WITNESS_ERROR",
    "Answer",
    "Kind",
    "PopulationSearch",
    "answer_of",
    "contradictions",
    "pool_answers",
]

MAX_DISAGREEMENT = 3.0
"""Standard errors of their difference within which two ways agree: chance parts one of 370."""
MAX_WITNESS_ERROR = 0.3
"""Relative standard error above which a way witnesses nothing."""
PLAIN_TAIL = 1e-4
"""One minus the level of the interval of the plain draws that an answer must lie in."""
MIN_FOR_SPREAD = 4
"""Populations from which on their spread speaks beside what their genealogies say."""
WITNESS_SHARE = 1 / 3
"""Share of the evaluations that the less exact way has, to be a witness."""
ENOUGH_PLAIN_FAILURES = 1000
"""Failures among plain draws that tell a probability to 3 %: then they are all that is drawn."""
MIN_PLAIN_FAILURES = 10
"""Failures among plain draws from which the probability is roughly known."""
MAX_PLAIN_ERROR = 0.2
"""Relative standard error that plain draws promise at most, where populations could answer: 25
failures expected, of which chance leaves fewer than the ten of a plain answer
(`estimate.MIN_COUNTED_FAILURES`) once in 4500."""
DOUBT = 1.5
"""How many times as great as promised the standard error of populations may turn out, where it is
to make them UNRELIABLE anyway. Of 75 calls of eight hard loops of `benchmarks.random_loops` (10 to
35, with 400,000 and 1,500,000 evaluations, 5 keys) 39 were reliable; with a factor of 1, 28."""
ANEW = 2.0
"""How many times as great a standard error two ways have that begin anew: the moves are twice as
many, and half of the budget is spent."""
MIN_POINTS = 512
"""Points that a population at least has where it is one of several: its own error is then told."""


class Answer(NamedTuple):
    """What populations of one kind say."""

    log_mean: float
    relative: float
    """Relative standard error"""

    def apart(self, other: Answer) -> float:
        """The difference of two logarithms in its standard errors."""
        return abs(self.log_mean - other.log_mean) / math.hypot(self.relative, other.relative)

    def __str__(self) -> str:
        return f"{math.exp(self.log_mean):.3g} +- {self.relative:.1%}"


class Kind(NamedTuple):
    """A way down, and how often a point moves between two levels."""

    way: str
    moves: int

    @property
    def doubled(self) -> Kind:
        """The same way with twice the moves."""
        return self._replace(moves=2 * self.moves)

    def __str__(self) -> str:
        return f"by {self.way}, {self.moves} moves"


class PopulationSearch:
    """The populations so far, and what they cost. The first one of each kind has ``n`` points; the
    compiled program takes ``capacity``.
    """

    def __init__(self, key, sim, budget, n, capacity, watch, placement):
        self.key, self.sim = key, sim
        self.n, self.capacity = n, capacity
        self.watch, self.placement = watch, placement
        self.runs: dict[Kind, tuple[Descent, ...]] = {}
        self.budget, self.spent = budget, 0
        self.invalid, self.plain = 0, np.zeros(3, np.int64)
        self.interrupted, self.history = "", []
        self.reasons = [] if (coarse := rounding_problem(sim)) is None else [coarse]

    def first_kind(self, way):
        """A way with its first number of moves."""
        return Kind(way, getattr(SETTINGS, f"moves_by_{way}"))

    def run(self, kind, count, n=None):
        """``count`` more populations of a kind, of ``n`` points; none after an interruption."""
        if self.interrupted:
            return
        before, n = self.runs.get(kind, ()), self.n if n is None else n
        # the first one shows what it costs
        most = math.inf if before else WITNESS_SHARE * self.budget / 2
        shared = self.key, self.sim, kind, n, self.capacity, len(before), most
        task = Task(_run_population, shared, lambda: Descent(*Descent._fields))
        placement = self.placement._replace(name=f"{kind.way}-{kind.moves}-{len(before)}")
        cost, done = before[-1].evaluations if before else 0, self.spent
        try:
            ran = units.run(
                task,
                count,
                lambda runs, number, run: (*runs, run),
                (),
                self.watch,
                placement,
                size=lambda units: min(int(done + units * cost), self.budget),
            )
        except KeyboardInterrupt:
            if not self.runs:
                raise
            self.note_interruption()
            return
        self.runs[kind] = before + ran.state
        for r in ran.state:
            self.spent += int(r.evaluations)
            self.invalid += int(r.invalid)
            self.plain += r.plain
            self.history.append(describe_run(kind, r))
        if ran.ended is not None:
            self.note_interruption()
        self.reasons += map(str, ran.incidents)

    def note_interruption(self):
        """Note that the call was interrupted."""
        self.interrupted = f"interrupted after {self.spent} of {self.budget} evaluations"

    def cost(self, kind):
        """Evaluations a point of a population of this kind; of one that moves twice as often, twice
        as many.
        """
        if kind in self.runs:
            return float(np.mean([r.evaluations / r.size for r in self.runs[kind]]))
        return 2 * self.cost(Kind(kind.way, kind.moves // 2))

    def evaluations(self, kind):
        """What the populations of this kind took."""
        return sum(int(r.evaluations) for r in self.runs[kind])

    def answer(self, kind):
        """The `Answer` of a kind; None where none of its populations reached a failure."""
        return answer_of(self.runs.get(kind, ()))

    def expected_error(self, kind):
        """The relative standard error of this kind after the witness's part of the budget."""
        return math.sqrt(self.evaluations_for_one(kind) / (WITNESS_SHARE * self.budget))

    def evaluations_for_one(self, kind):
        """How many evaluations of this kind tell the probability with a relative variance of 1."""
        return self.answer(kind).relative ** 2 * self.evaluations(kind)

    def failures_are_frequent(self):
        """Whether plain draws meet enough of them."""
        failing, _, drawn = self.plain
        expected = failing / drawn * (self.budget - self.spent)
        return failing >= MIN_PLAIN_FAILURES and expected >= ENOUGH_PLAIN_FAILURES

    def reached(self):
        """The kinds so far that reached failures, the more exact for its cost first."""
        return self.sorted_by_cost(k for k in self.runs if self.answer(k) is not None)

    def plain_error(self):
        """The relative standard error of plain draws of what is left of the budget, by the most
        exact of the kinds that reached failures.
        """
        expected = math.exp(self.answer(self.reached()[0]).log_mean) * (self.budget - self.spent)
        return expected**-0.5 if expected > 0 else math.inf

    def promised_error(self):
        """The relative standard error that populations promise: of two kinds that reached failures
        the better one has what the witness leaves.
        """
        shares = (1 - WITNESS_SHARE) / WITNESS_SHARE, 1.0
        each = zip(shares, self.reached())
        return sum(share * self.expected_error(kind) ** -2 for share, kind in each) ** -0.5

    def plain_answers(self, compared=()):
        """Whether plain draws answer, and more exactly than populations promise to: those that were
        ``compared`` and do not agree would have to begin anew, and one alone is not confirmed.
        """
        if self.interrupted or not self.reached():
            return False
        if len(compared) == 1:  # UNRELIABLE, however exact it becomes
            return self.plain_error() <= MIN_PLAIN_FAILURES**-0.5
        promised, times = self.promised_error(), 1.0
        if not self.agree(compared):
            times = ANEW
        elif promised > MAX_RELATIVE_ERROR:  # which would be UNRELIABLE
            times = DOUBT
        return self.plain_error() <= min(times * promised, MAX_PLAIN_ERROR)

    def choose_kinds(self):
        """The two kinds that are to agree, the more exact for its cost first; one where there is
        no second, and () where no failure was reached.
        """
        seen = self.reached()
        if not seen:
            return ()
        if len(seen) == 2 and self.expected_error(seen[1]) <= MAX_WITNESS_ERROR:
            return seen
        # one way alone: its moves are doubled until its answer stays
        before, doubled = seen[0], seen[0].doubled
        while self.spent + self.n * self.cost(doubled) <= self.budget:
            self.run(doubled, 1)
            if self.answer(doubled) is None:
                break
            if self.agree((before, doubled)):
                return self.sorted_by_cost([doubled, before])
            before, doubled = doubled, doubled.doubled
        return (before,)

    def sorted_by_cost(self, kinds):
        """The ``kinds``, those first whose variance costs least."""
        return tuple(sorted(kinds, key=self.evaluations_for_one))

    def compare(self, kinds):
        """Spend a third of all on the second of two ways. Where they do not agree, both begin anew
        with twice the moves, as the more slowly mixing one may be wrong within its error, unless
        plain draws answer. Returns the kinds that were compared last.
        """
        if len(kinds) < 2 or kinds[0].way == kinds[1].way:
            return kinds
        while True:
            share = WITNESS_SHARE * self.budget - self.evaluations(kinds[1])
            self.fill(kinds[1], min(share, self.budget - self.spent))
            doubled = tuple(k.doubled for k in kinds)
            cost = self.n * sum(map(self.cost, doubled))
            if self.agree(kinds) or self.plain_answers(kinds) or self.spent + cost > self.budget:
                return kinds
            for kind in doubled:
                self.run(kind, 1)
            if any(self.answer(kind) is None for kind in doubled):
                return kinds
            kinds = self.sorted_by_cost(doubled)

    def agree(self, kinds):
        """Whether two kinds agree within their errors; fewer do."""
        if len(kinds) < 2:
            return True
        return self.answer(kinds[0]).apart(self.answer(kinds[1])) <= MAX_DISAGREEMENT

    def fill(self, kind, evaluations):
        """Populations of this kind, alike in size, for so many ``evaluations``."""
        points, most = evaluations / self.cost(kind), min(2 * self.n, self.capacity)
        count = max(math.ceil(points / most), 1)
        n = int(points / count) // BLOCK * BLOCK
        if n >= min(MIN_POINTS, self.n):
            self.run(kind, int(points) // n, n)  # what whole blocks of lanes leave is one more


def _run_population(shared, number, context):
    """The `Descent` of a population."""
    key, sim, kind, n, capacity, first, most = shared
    by_width = kind.way == "width"
    key = jax.random.fold_in(jax.random.fold_in(key, kind.moves), 2 * (first + number) + by_width)
    about = dict(max_evaluations=most) if by_width else {}
    return DESCENTS[kind.way](key, sim, n, kind.moves, capacity, **about)


def answer_of(runs: Sequence[Descent]) -> Answer | None:
    """The `Answer` of populations of one kind; None where none of them reached a failure."""
    logs = np.array([float(r.log_mean) for r in runs])
    if not np.isfinite(logs).any():
        return None
    sizes = np.array([float(r.size) for r in runs])
    share, n = sizes / sizes.sum(), len(logs)
    p = np.exp(logs - logs.max())
    mean = share @ p
    own = np.where(p > 0, np.array([float(r.variance) for r in runs]), 0)
    variance = share**2 @ (own * p**2)
    if n >= MIN_FOR_SPREAD or (n > 1 and not (p > 0).all()):
        variance = max(variance, share**2 @ (p - mean) ** 2 * n / (n - 1))
    return Answer(logs.max() + math.log(mean), math.sqrt(variance) / mean)


def pool_answers(answers: Sequence[Answer]) -> Answer:
    """Answers as one, by their variances."""
    weights = np.array([a.relative**-2 for a in answers])
    weights /= weights.sum()
    logs = np.array([a.log_mean for a in answers])
    log_mean = logs.max() + math.log(weights @ np.exp(logs - logs.max()))
    return Answer(log_mean, math.hypot(*(w * a.relative for w, a in zip(weights, answers))))


def contradictions(exact: Answer, plain: tuple[int, int, int]) -> list[str]:
    """What the model's own draws, (failing, invalid, all), say against an answer."""
    (failing, invalid, drawn), reasons = plain, []
    low, high = clopper_pearson(failing, drawn, 1 - PLAIN_TAIL)
    if not low <= math.exp(exact.log_mean) <= high:
        reasons.append(
            f"plain draws say otherwise: {failing} of {drawn} fail, so the probability lies"
            f" between {low:.3g} and {high:.3g}"
        )
    if (share := invalid / drawn) > MAX_INVALID_SHARE * math.exp(exact.log_mean):
        reasons.append(
            f"{share:.2g} of the model's own episodes are invalid (a number that is not finite),"
            " which counts as not failing"
        )
    return reasons


def describe_run(kind: Kind, r: Descent) -> str:
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
