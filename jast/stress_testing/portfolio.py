"""jast.stress: check, nominal, explorers, refinement, modes, probability; one budget."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from jast import _checks, units
from jast import limit_state as latent
from jast._jax import briefly
from jast.checkpoints import keep_answers, open_checkpoint
from jast.contract import check
from jast.crude import BRIEF, nominal
from jast.episode import rollout
from jast.estimate import adaptive, budgets, few_calls
from jast.estimate.batches import resampled
from jast.estimate.budgets import CHEAP
from jast.estimate.descents import SETTINGS, cooled
from jast.estimate.plain import monte_carlo
from jast.estimate.population import by_populations
from jast.estimate.redrawn import redrawn
from jast.estimate.sample import Sample
from jast.failures import Failures, collect, empty, merge
from jast.outline import outline
from jast.results import call_settings
from jast.rewards import likelihood
from jast.search.failure_modes import Mode, Modes, modes, spread
from jast.search.refinement import refine
from jast.simulator import Simulator, require_simulator
from jast.stress_testing.explorers import EXPLORERS, Haul, explorers_of, of_points, onward
from jast.stress_testing.report import Report, Tried
from jast.stress_testing.shares import cost as shares_cost
from jast.stress_testing.shares import shares
from jast.watch import Watch

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback, Executor, PathLike

__all__ = ["PORTFOLIO", "stress"]

DRAWN = 400
"""Draws of the estimate's proposal, where only it found failures."""
LEAST, ESTIMABLE, SMALL = 300, 5000, 20
"""Evaluations of a call, and of an estimate that finds its own proposal; numbers of an episode up
to which a surrogate does with fewer.
"""
PATHS = 0.05
"""Share of the budget that a look at the modes may cost at most."""
FIRST, CALLS, FADING, FEW = 0.5, 6, 0.1, 2000
"""Of the search, the share that all explorers divide evenly; calls that divide the rest; how much
of its last gain is expected of one that gained nothing since; evaluations below which each explorer
is called once, and what was found is pulled once.
"""

SETTLED, BASINS = 1e-2, 4
"""A residual at which a failure is locally likeliest, and as many modes as show that there is
nothing else to find: the evaluations of `onward` are the estimate's then.
"""


def stress(
    key: chex.PRNGKey,
    sim: Simulator,
    budget: int | None = None,
    *,
    seconds: float | None = None,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Report:
    """How does the system fail, how likely, and what is its likeliest failure?

    It checks the simulator, and runs it undisturbed and under plain draws. By default its rate is
    then measured. A system that simulates 300,000 episodes in some eight CPU seconds is answered by
    populations that stay on the device (`jast.estimate.population`): they tell the probability,
    their failures are cooled to the likeliest near to each, pulled to where log p is greatest
    (`jast.search.refine`), and sorted into failure modes, each with its share of the probability.
    The same holds of every system in JAX with a budget from 300,000 on.

    For the others a portfolio of explorers looks for failures (those whose failures get likelier
    are given more of the budget), and the probability is that of
    `jast.estimate.failure_probability`, for which the modes found are where to look; they never
    enter the estimate itself.

    Args:
        key: consumed.
        sim: the simulator.
        budget: evaluations (episodes; one with its gradient counts as 3 or 4) in all, nearly; at
            least 300. Default: what a cheap system simulates in some eight CPU seconds, at most
            33,554,432; 200,000 of others. The report's ``settings`` name the one that was used.
            Below 10,417 the probability is a surrogate's (`failure_probability` with few calls),
            and with more than 20 numbers an episode that of the plain draws alone.
        seconds: in place of ``budget``: as many evaluations as the system simulates in so many CPU
            seconds (a black box: seconds), rounded down to 2^k or 3 2^k.
        top: failures kept, at least one for each mode.
        progress: whether there is a bar.
        callback: called as ``callback(done, total, None)`` after every piece of the work.
        checkpoint: a folder that keeps finished populations and what the system answered to
            searches, refinement and draws. The same call, with its ``budget``, then goes on where
            it was stopped, to the same result; first looks run again.
        executor: runs the parts of the probability: anything with ``submit(function, *args)``, such
            as the executors of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each, likewise (docs/scale.md).

    Returns:
        `Report`: print it. A KeyboardInterrupt ends the work with what was found by then, and is
        raised before there is anything.

    Raises:
        ValueError: for a budget below 300, a budget together with ``seconds``, and where the
            simulator's functions do not fit together.

    Example:
        >>> import jax, jast
        >>> report = jast.stress(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> bool(report.failures.best.failure), report.probability.mean > 0
        (True, True)
    """
    name = "stress"
    _checks.check_random_key(name, key)
    budgets.given(name, budget, seconds)
    if budget is not None:
        budget = _checks.whole_number(name, "budget", budget, LEAST)
    top = _checks.whole_number(name, "top", top, 1)
    require_simulator(name, sim)
    check(sim)
    about = outline(sim)
    quantiles = about.start.quantile and about.disturbance.quantile
    if budget is None and not quantiles and seconds is None:
        budget = PORTFOLIO
    if budget is None:
        budget = budgets.budget_of(name, key, sim, seconds, LEAST, PORTFOLIO)
    settings = call_settings(name, key, budget=budget, top=top)
    ways = units.placement(name, executor, devices)
    with (
        open_checkpoint(name, checkpoint, key, sim=sim, budget=budget, top=top) as store,
        keep_answers(store),
        briefly(not budgets.cheap(sim, budget)),
        Watch(name, budget, "sim", progress, callback) as watch,
    ):
        work = _Work(key, sim, budget, top, watch, ways._replace(store=store), checkpoint)
        try:
            work.look()
            if work.cheap:
                work.populate()
            else:
                work.search()
                work.refine()
                work.estimate()
        except KeyboardInterrupt:
            if work.nominal is None:
                raise
            settings["interrupted"] = f"after {work.spent} of {budget} evaluations"
    return work.report(settings)


class Shares(NamedTuple):
    """Of the budget; what is left is for the probability."""

    nominal: float
    search: float
    onward: float
    refine: float


PORTFOLIO = 200_000
"""Evaluations by default where populations are not the answer."""
COOLED = 0.2
"""Share of the evaluations by which failures of the populations are cooled to the likeliest."""
ALONE = 0.25
"""Share of these by which no point replaces another, so that no mode is lost. With all of them the
likeliest failure of the crossing is .35 nats less likely, of the cart-pole 6, of the ship 4; with
none they are as likely as with a quarter, or up to 2 nats likelier."""
POLISHED = 50_000
"""Evaluations for pulling what was cooled to where log p is greatest, at most an eighth of all: on
the crossing, the cart-pole and the ship failures are as likely with half as many and twice as many
coolings, which cost a tenth of the CPU time."""
LARGE, BY_SURROGATE, NO_ESTIMATE = (
    Shares(0.05, 0.15, 0.14, 0.18),
    Shares(0.05, 0.3, 0, 0.35),
    Shares(0.125, 0.35, 0.2, 0.325),
)


class _Work:
    """What is known so far, and what it cost."""

    def __init__(self, key, sim, budget, top, watch, ways, checkpoint):
        self.key, self.sim, self.budget, self.top, self.watch = key, sim, budget, top, watch
        self.ways, self.checkpoint = ways, checkpoint
        about = outline(sim)
        self.latent = about.start.quantile and about.disturbance.quantile
        self.reward = likelihood(sim)
        self.nominal = self.probability = None
        self.pool = self.failures = self.known = empty(sim)
        self.modes, self.tried, self.spent, self.invalid = Modes(), [], 0, 0
        self.residual = self.late = np.nan
        large = (1 - sum(LARGE)) * budget >= ESTIMABLE
        self.estimable = self.latent and (large or latent.dimension(sim) <= SMALL)
        self.cheap = self.latent and budgets.cheap(sim, budget)
        shares = (LARGE if large else BY_SURROGATE) if self.estimable else NO_ESTIMATE
        self.parts = Shares(*(int(share * min(budget, PORTFOLIO)) for share in shares))
        self.paths = int(PATHS * budget)

    def next_key(self):
        self.key, key = jax.random.split(self.key)
        return key

    def note(self, name, evaluations, failing=0, best=-np.inf, invalid=0):
        self.tried.append(Tried(name, int(evaluations), int(failing), float(best)))
        self.spent += int(evaluations)
        self.invalid += int(invalid)
        self.watch.reach(min(self.spent, self.budget))
        self.watch.tell()

    def look(self):
        """The system as it is."""
        # populations draw plainly, too, and so few are compiled quickly
        key, episodes = self.next_key(), BRIEF if self.cheap else self.parts.nominal
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the report says it
            self.nominal = n = nominal(key, self.sim, episodes)
        found = [] if n.undisturbed is None or not bool(n.undisturbed.failure) else [n.undisturbed]
        if n.first is not None:
            found.append(rollout(jax.random.fold_in(key, n.first), self.sim))
        for e in found:
            one = jax.tree.map(lambda a: np.asarray(a)[None], e._replace(states=None))
            self.pool = merge(self.pool, collect(self.sim, self.reward, one), top=2)
        best = _best(self.pool)
        self.note("nominal", n.episodes, n.failing, best, n.invalid)

    def populate(self):
        """The probability by populations, and the likeliest failures from theirs."""
        cooling = int(COOLED * self.budget)
        polishing = min(POLISHED, self.budget // 8)
        rest = self.budget - self.spent - cooling - 2 * polishing
        rest = max(rest, CHEAP // 2)
        self.watch.doing("estimating")
        p = by_populations("stress", self.next_key(), self.sim, rest, ways=self.ways)
        self.probability = self.beside_nominal(p)
        self.note("populations", p.episodes, p.failing, invalid=p.invalid)
        sample = p.proposal
        if not isinstance(sample, Sample):
            # nothing leads to failures, or all does
            self.parts = Shares(0, polishing, 0, polishing)
            if not len(self.pool):
                self.search()
            return self.refine()
        rows = resampled(sample.log_weight, SETTINGS.cooled, 0.5)
        for name, together, share in (
            ("cooled", False, ALONE),
            ("cooled together", True, 1 - ALONE),
        ):
            some, most = sample.points[rows], int(share * cooling)
            self.watch.doing("cooling failures")
            points, spent = cooled(self.next_key(), self.sim, some, most, together)
            self.gather(name, of_points(self.sim, points)._replace(evaluations=spent))
        self.parts, self.paths = Shares(0, 0, 0, polishing), polishing // 4
        self.refine()
        if self.modes and p.reliable:
            self.tell_shares(sample)

    def search(self):
        """Every explorer once; then those again whose failures get likelier for what they cost."""
        total = self.parts.search
        end, few = self.spent + total, total < FEW
        first = explorers_of(self.sim, total if few else int(FIRST * total))
        gains = {name: self.explore(name, each) for name, each in first.items()}
        calls = dict.fromkeys(first, 1)
        again = int((1 - FIRST) * total / CALLS)
        if not few and not len(self.pool):  # nothing points to failures, or they are far away
            self.explore("kept states", end - self.spent + self.parts.onward)
        while not few and self.spent + again <= end:
            # of those that expect as much, the one that was called least
            name = max(first, key=lambda n: (gains[n], -calls[n]))
            # what paid once may pay again, but less is expected of it
            gains[name] = max(self.explore(name, again), FADING * gains[name])
            calls[name] += 1

    def explore(self, name, budget):
        """Call one explorer; returns by how much the likeliest failure got likelier per
        evaluation.
        """
        before = _best(self.pool)
        self.watch.doing(f"searching by {name}")
        haul = EXPLORERS[name](self.next_key(), self.sim, budget)
        best = _best(self.gather(name, haul))
        if best <= before:
            return 0.0
        gain = 1.0 if before == -np.inf else best - before
        return gain / max(haul.evaluations, 1)

    def gather(self, name: str, haul: Haul) -> Failures:
        """The failures that an explorer brought in, which join the pool."""
        found = collect(self.sim, self.reward, haul.episodes, top=4 * self.top)
        self.pool = merge(self.pool, found, top=32 * self.top)
        self.note(name, haul.evaluations, haul.failing, _best(found), haul.invalid)
        return found

    def refine(self):
        """The pool to where log p is greatest: many failures a little, then each mode's best."""
        if not len(self.pool):
            return
        if not self.latent:
            self.failures, best = self.pool, self.pool[0]
            self.modes = Modes([Mode(best, int(self.pool.counts.sum()), 1.0)])
            return
        self.pool = spread(self.sim, self.pool, 8 * self.top)
        self.failures = chosen = self.pool
        budget = self.parts.refine
        for part in (1.0,) if budget < FEW else (0.5, 0.5):
            if chosen is not self.pool and not self.settled():
                chosen = self.onward(chosen)
            self.watch.doing("refining failures")
            result = refine(self.next_key(), self.sim, chosen, budget=max(100, int(part * budget)))
            found = result.failures
            if len(found):
                self.residual, self.late = float(result.residual[0]), float(result.late[0])
                self.failures = merge(self.failures, found, top=8 * self.top)
                self.known = merge(self.known, found, top=self.top)
            self.note(
                "refine",
                result.episodes,
                len(found),
                _best(found),
                result.invalid,
            )
            known = found if len(found) else self.pool[:1]
            self.watch.doing("telling modes apart")
            if self.modes:  # none is lost to a second refinement that had no time for it
                known = merge(known, self.bests(), top=8 * self.top)
            self.modes = modes(self.sim, known, self.pool, budget=self.paths)
            self.note("telling modes apart", self.modes.evaluations)
            chosen = self.bests()
        self.failures = merge(self.bests(), self.failures, top=self.top)

    def settled(self) -> bool:
        """Whether slopes have led to the likeliest failure, and there are few basins."""
        return self.residual < SETTLED and len(self.modes) <= BASINS

    def onward(self, known: Failures) -> Failures:
        """Likelier failures by many small steps, one half of them from the likeliest known."""
        budget = self.parts.onward // 2
        if budget < FEW:
            return known
        self.watch.doing("searching by slow cross-entropy")
        for name, around in (("slow cross-entropy", None), ("the same, from the best", known)):
            haul = onward(self.next_key(), self.sim, budget, around)
            known = merge(known, self.gather(name, haul), top=8 * self.top)
        return known

    def bests(self) -> Failures:
        """The likeliest failure of each mode."""
        each = [m.failure._replace(states=None) for m in self.modes]
        stacked = jax.tree.map(lambda *a: np.stack([np.asarray(b) for b in a]), *each)
        return collect(self.sim, self.reward, stacked)

    def estimate(self):
        """The probability, with what is left."""
        self.watch.doing("estimating")
        rest = max(self.budget - self.spent, 1)
        folder = None if self.checkpoint is None else Path(self.checkpoint) / "probability"
        places = dict(executor=self.ways.executor, devices=self.ways.devices, checkpoint=folder)
        if not self.estimable:
            more = monte_carlo(self.next_key(), self.sim, max(rest, 100), **places)
            self.note("plain draws", more.episodes, more.failing, invalid=more.invalid)
            self.probability = self.beside_nominal(more)
            return
        known = self.known if len(self.known) else None
        if not len(self.pool):  # the estimate may find what the search did not
            rest -= self.parts.refine + self.parts.onward
        rest = max(rest - self.counted(), few_calls.LEAST)
        p = adaptive.failure_probability(self.next_key(), self.sim, rest, failures=known, **places)
        self.probability = self.beside_nominal(p)
        self.note("probability", p.episodes, p.failing, invalid=p.invalid)
        if p.proposal is None:
            return
        if not len(self.pool):
            self.take(p.proposal)
        if self.modes and p.reliable:
            self.tell_shares(p.proposal)

    def beside_nominal(self, p):
        """The `Estimate` ``p`` with the nominal draws among its plain ones, which they are too."""
        drawn, nominal = p.plain or (0, 0, 0), self.nominal
        own = nominal.failing, nominal.invalid, nominal.episodes
        return p._replace(plain=tuple(a + b for a, b in zip(drawn, own, strict=True)))

    def take(self, q):
        """Failures that the estimate's proposal draws, where the search found none."""
        points, drawn, _ = redrawn(self.next_key(), self.sim, q, DRAWN)
        haul = of_points(self.sim, np.asarray(points)[np.asarray(drawn.failure)])
        self.pool = collect(self.sim, self.reward, haul.episodes, top=4 * self.top)
        best = _best(self.pool)
        self.note("the estimate's failures", DRAWN + haul.evaluations, haul.failing, best)
        self.refine()

    def counted(self):
        """What telling the shares of modes will take."""
        return shares_cost(self.budget) if len(self.modes) > 1 else 0

    def tell_shares(self, q):
        """The share of the probability that each mode has, of failures drawn from the proposal."""
        drawn = self.probability.draws
        if drawn is not None and isinstance(drawn.source, latent.Latent):
            q = drawn.source  # independent draws tell more than few populations
        budget = min(self.budget, PORTFOLIO)
        self.watch.doing("shares of modes")
        self.modes, failing, cost = shares(self.next_key(), self.sim, q, self.modes, budget)
        if cost:
            self.note("shares of modes", cost, failing)

    def report(self, settings):
        return Report(
            self.nominal,
            self.failures[: self.top],
            self.modes,
            self.probability,
            self.residual,
            self.late,
            tuple(self.tried),
            self.spent,
            self.invalid,
            settings,
            self.sim,
        )


def _best(failures: Failures) -> float:
    """log p relative to the mode of the likeliest; -inf where there is none."""
    return float(failures.best.reward) if len(failures) else -np.inf
