"""One stress test: the pieces of its work, what each of them found, and what it cost."""

import warnings
from pathlib import Path

import jax
import numpy as np

from jast._src.core.black_boxes import runs_for_objects
from jast._src.core.episode import Episode, rollout, stacked
from jast._src.core.failures import Failures, collect, empty, merge, rank
from jast._src.core.nominal import nominal
from jast._src.core.rewards import likelihood
from jast._src.core.simulator import Simulator
from jast._src.estimate import budgets
from jast._src.estimate.budgets import MIN_POPULATION_BUDGET
from jast._src.estimate.failure_probability import failure_probability
from jast._src.estimate.few_calls import few_calls
from jast._src.estimate.monte_carlo import monte_carlo
from jast._src.estimate.population.descents import SETTINGS, cool_failures
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.population.population import by_populations
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.estimate.redraw import redraw
from jast._src.normal_space import transform
from jast._src.runtime.device import on_cpu, where_few_points_run
from jast._src.runtime.host_errors import failing_runs, runs_made, runs_on_host
from jast._src.search.refine.modes import Mode, Modes, modes, owners, spread
from jast._src.search.refine.refine import refine
from jast._src.stress_testing.budget_shares import DEFAULT_BUDGET, BudgetShares, divided
from jast._src.stress_testing.explorers import (
    EXPLORERS,
    ExplorerResult,
    divide_budget,
    failing_episodes,
    failures_at,
    has_quantiles,
    nominal_points,
    slow_cross_entropy,
)
from jast._src.stress_testing.mode_shares import mode_shares, shares_cost
from jast._src.stress_testing.report import Report, Tried

__all__ = ["StressTest"]

REDRAWN_EPISODES = 400
"""Draws of the estimate's proposal, where only it found failures, but no more than all batches
together may have of a small budget."""
REDRAWN_BATCHES = 20
"""Of so many draws at most, until one fails: of the ferry's proposal with 20,000 evaluations (key
0) that was one of the seventh batch."""
MIN_COUNTED_EPISODES = 100  # plain draws for the probability, at least, where nothing else tells it
MODES_SHARE = 0.05  # share of the budget that telling modes apart may cost at most
EVEN_SHARE = 0.5  # share of the search that all explorers divide evenly
FURTHER_CALLS = 6  # calls of explorers that divide the rest
GAIN_DECAY = 0.1  # how much of its last gain is expected of an explorer that gained nothing since
MIN_DIVIDED_BUDGET = 2000  # below it each explorer is called once, and failures are refined once
OPTIMAL_RESIDUAL = 1e-2  # a residual at which a failure is locally likeliest
FEW_MODES = 4
"""With so few modes, and a likeliest failure that is locally so, `slow_cross_entropy` would find
nothing else: its evaluations are the estimate's."""
NOMINAL = 4096  # plain draws where populations follow, which begin with some themselves
COOLING_SHARE = 0.2  # of the evaluations, to cool failures of the populations to the likeliest
MAX_COOLING = 2**19
"""Evaluations that cooling takes at most, and slow cooling as many again: two million that cooled
slowly made a call of the landing 5 CPU seconds slower, and its likeliest failure no likelier."""
INDEPENDENT_SHARE = 0.25
"""Share of these by which no point replaces another, so that no mode is lost. With all of them the
likeliest failure of the crossing is .35 nats less likely, of the cart-pole 6, of the ship 4; with
none they are as likely as with a quarter, or up to 2 nats likelier."""
REFINE_EVALUATIONS = 100_000
"""Evaluations for pulling what was cooled to where log p is greatest, at most an eighth of all.
With half as many the likeliest failure of the ship is .14 nats less likely and of the packets .24,
with twice as many .1 and .04 likelier. It ends by itself where no failure is left that gains."""
POOL_FACTOR = 32  # failures in the pool for each that is returned: modes are told apart among these
HOSTED_EXTRA = 14
"""Runs of a black box that no other piece of the work counts: of `check` 10, and those for objects,
the undisturbed episode and its proof, and two that are made again to see whether they are answered
the same."""
LAST_SHARE = 0.15  # of the budget, what a black box keeps for the probability, whatever came before
FALSIFY_SHARE = 0.2
"""Share of a black box's search that looks for a first failure, at most, where several explorers
follow; below `MIN_DIVIDED_BUDGET` all of it may."""
OTHERS_SHARE = 0.025
"""Share of the budget, beyond it, by which failures of the estimate are refined that are of no mode
known, where these are more than a few. Modes are then told apart once more, and so are their
shares: together up to some 15 % of the budget."""
LEAST_REFINED = 100  # evaluations that `refine` takes at least
REFINED_FACTOR = 8  # failures that refinement starts from for each that is returned
FOUND_FACTOR = 4  # failures of one explorer for each that is returned


class StressTest:
    """What is known so far, and what it cost.

    ``pool`` has the failures of explorers, ``refined`` those that refinement came to, and
    ``failures`` what the report shows.
    """

    def __init__(self, key, sim, budget, top, watch, placement, checkpoint):
        self.key, self.sim = key, sim
        self.budget, self.top = budget, top
        self.watch, self.placement = watch, placement
        self.checkpoint, self.reward = checkpoint, likelihood(sim)
        self.nominal = self.probability = None
        self.pool = self.failures = self.refined = empty(sim)
        self.modes, self.tried = Modes(), []
        self.cooled = None  # points [m, D] of populations that were cooled
        self.spent = self.invalid = 0
        self.residual = self.late = np.nan
        self.has_points = has_quantiles(sim)
        self.hosted, self.made, self.failing_runs = runs_on_host(sim), runs_made(sim), 0
        self.cheap = self.has_points and budgets.uses_populations(sim, budget)
        self.parts = divided(sim, budget, self.has_points)
        self.modes_budget = int(MODES_SHARE * budget)
        # evaluations that a black box, which must not run once too often, keeps for its estimate
        self.last = int(LAST_SHARE * budget) if self.hosted else 0
        if self.hosted:
            self.note("check", HOSTED_EXTRA + runs_for_objects(sim))

    def next_key(self):
        self.key, key = jax.random.split(self.key)
        return key

    def note(self, name, evaluations, failing=0, best=-np.inf, invalid=0):
        """Count a piece of the work."""
        self.made = runs_made(self.sim)
        self.tried.append(Tried(name, int(evaluations), int(failing), float(best)))
        self.spent += int(evaluations)
        self.invalid += int(invalid)
        self.watch.reach(min(self.spent, self.budget))
        self.watch.tell()

    def tell_runs(self, failing: int) -> None:
        """The bar moves with every batch of runs of a black box."""
        self.failing_runs += failing
        done = self.spent + runs_made(self.sim) - self.made
        self.watch.reach(min(done, self.budget), failures=self.failing_runs)

    def affordable(self, evaluations: int) -> int:
        """``evaluations``, of a black box at most those that it may still run before its
        estimate.
        """
        if not self.hosted:
            return evaluations
        return max(min(evaluations, self.budget - self.spent - self.last), 0)

    def run_nominal(self):
        """The system as it is."""
        key, episodes = self.next_key(), NOMINAL if self.cheap else self.parts.nominal
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the report says it
            if self.has_points and not self.hosted:
                self.nominal, found = nominal_points(key, self.sim, episodes, self.cheap)
            else:
                self.nominal = nominal(key, self.sim, episodes)
                found, first = empty(self.sim).episodes, self.nominal.first
                if first is not None:
                    found = stacked([rollout(jax.random.fold_in(key, first), self.sim)])
        n = self.nominal
        if n.undisturbed is not None and bool(n.undisturbed.failure):
            self.pool = self.collect([n.undisturbed])
        self.pool = merge(
            self.pool, collect(self.sim, self.reward, found), top=FOUND_FACTOR * self.top
        )
        self.note("nominal", n.episodes, n.failing, _best_log_density(self.pool), n.invalid)

    def collect(self, episodes):
        """The `Failures` of single episodes."""
        return collect(self.sim, self.reward, stacked(episodes))

    def run_populations(self):
        """The probability by populations."""
        cooling, refining = self.cooling_and_refining()
        after = refining + 2 * (refining // 8) + shares_cost(min(self.budget, DEFAULT_BUDGET))
        rest = self.budget - self.spent - cooling - after
        rest = max(rest, MIN_POPULATION_BUDGET // 2)
        self.watch.doing("estimating")
        p = by_populations("stress", self.next_key(), self.sim, rest, placement=self.placement)
        self.keep_probability(p, "populations")

    def cooling_and_refining(self):
        """Evaluations to cool failures of populations, and to refine what was cooled."""
        cooling = min(int(COOLING_SHARE * self.budget), MAX_COOLING)
        return cooling, min(REFINE_EVALUATIONS, self.budget // 8)

    def find_likeliest(self):
        """The likeliest failures, from those of the populations, and their modes."""
        cooling, refining = self.cooling_and_refining()
        sample = self.probability.proposal
        if not isinstance(sample, Sample):
            # nothing leads to failures
            self.parts = BudgetShares(nominal=0, search=refining, slow_search=0, refine=refining)
            if not len(self.pool):
                self.search()
            return self.refine()
        rows = resample(sample.log_weight, SETTINGS.cooled_failures, 0.5)
        for name, replace, share in (
            ("cooled", False, INDEPENDENT_SHARE),
            ("cooled together", True, 1 - INDEPENDENT_SHARE),
        ):
            self.cool(name, sample.points[rows], int(share * cooling), replace)
        self.parts = BudgetShares(nominal=0, search=0, slow_search=cooling, refine=refining)
        self.modes_budget, self.cooled = refining // 8, sample.points[rows]
        self.refine()
        self.tell_shares(sample)

    def cool(self, name, points, budget, replace):
        """The failures that ``points`` [m, D] are once they are cooled, which join the pool."""
        self.watch.doing("cooling failures")
        with where_few_points_run():
            points, spent = cool_failures(self.next_key(), self.sim, points, budget, replace)
        found = failures_at(self.sim, points)._replace(evaluations=spent)
        return self.add_failures(name, found)

    def search(self):
        """Every explorer once; then those again whose failures get likelier for what they cost."""
        total = self.affordable(self.parts.search)
        once = total < MIN_DIVIDED_BUDGET
        if self.hosted and self.has_points:  # does it fail at all?
            before = self.spent
            self.explore("falsify", total if once else int(FALSIFY_SHARE * total))
            total -= self.spent - before
        end = self.spent + total
        first = divide_budget(self.sim, total if once else int(EVEN_SHARE * total))
        gains = {name: self.explore(name, each) for name, each in first.items()}
        if once:
            return
        if not len(self.pool):  # nothing points to failures, or they are far away
            more = self.affordable(end - self.spent + self.parts.slow_search)
            if more > 0:
                self.explore("kept states", more)
        calls = dict.fromkeys(first, 1)
        again = int((1 - EVEN_SHARE) * total / FURTHER_CALLS)
        while self.spent + again <= end:
            # of those that expect as much, the one that was called least
            name = max(first, key=lambda n: (gains[n], -calls[n]))
            # what paid once may pay again, but less is expected of it
            gains[name] = max(self.explore(name, again), GAIN_DECAY * gains[name])
            calls[name] += 1

    def explore(self, name, budget):
        """Call one explorer; returns by how much the likeliest failure got likelier per
        evaluation.
        """
        before = _best_log_density(self.pool)
        self.watch.doing(f"searching by {name}")
        result = EXPLORERS[name].run(self.next_key(), self.sim, budget)
        best = _best_log_density(self.add_failures(name, result))
        if best <= before:
            return 0.0
        gain = 1.0 if before == -np.inf else best - before
        return gain / max(result.evaluations, 1)

    def add_failures(self, name: str, result: ExplorerResult) -> Failures:
        """The failures that an explorer found, which join the pool."""
        found = collect(self.sim, self.reward, result.episodes, top=FOUND_FACTOR * self.top)
        self.pool = merge(self.pool, found, top=POOL_FACTOR * self.top)
        best = _best_log_density(found)
        self.note(name, result.evaluations, result.failing, best, result.invalid)
        return found

    def refine(self):
        """The pool to where log p is greatest: many failures a little, then each mode's best."""
        if not len(self.pool):
            return
        if not self.has_points:
            self.failures, best = self.pool, self.pool[0]
            self.modes = Modes([Mode(best, int(self.pool.counts.sum()), 1.0)])
            return
        self.pool = self.failures = spread(self.sim, self.pool, REFINED_FACTOR * self.top)
        budget, start = self.parts.refine, self.pool
        if budget < MIN_DIVIDED_BUDGET:
            self.refine_from(start, budget)
        else:
            start = self.refine_from(start, int(0.5 * budget))
            if not self.is_locally_likeliest():
                start = self.search_slowly(start)
            self.refine_from(start, int(0.5 * budget))
        self.failures = merge(self.best_of_modes(), self.failures, top=self.top)

    def refine_from(self, start: Failures, budget: int) -> Failures:
        """Refine the failures ``start`` and tell modes apart; returns the best of each mode."""
        budget = self.affordable(max(LEAST_REFINED, budget))
        if budget < LEAST_REFINED:  # of a black box that may run no longer
            self.tell_modes(start[: self.top])
            return self.best_of_modes()
        self.watch.doing("refining failures")
        result = refine(self.next_key(), self.sim, start, budget=budget)
        found = result.failures
        if len(found):
            self.residual, self.late = float(result.residual[0]), float(result.late[0])
            self.failures = merge(self.failures, found, top=REFINED_FACTOR * self.top)
            self.refined = merge(self.refined, found, top=self.top)
        best = _best_log_density(found)
        self.note("refine", result.episodes, len(found), best, result.invalid)
        self.tell_modes(found if len(found) else self.pool[:1])
        return self.best_of_modes()

    def tell_modes(self, candidates: Failures) -> None:
        """The modes of refined failures."""
        self.watch.doing("telling modes apart")
        if self.modes:  # none is lost to a second refinement that had no time for it
            candidates = merge(candidates, self.best_of_modes(), top=REFINED_FACTOR * self.top)
        budget = self.affordable(self.modes_budget)
        self.modes = modes(self.sim, candidates, self.pool, budget=budget)
        self.note("telling modes apart", self.modes.evaluations)

    def is_locally_likeliest(self) -> bool:
        """Whether slopes have led to the likeliest failure, and there are few basins."""
        return self.residual < OPTIMAL_RESIDUAL and len(self.modes) <= FEW_MODES

    def search_slowly(self, start: Failures) -> Failures:
        """Likelier failures by many small steps. After populations their failures are cooled again,
        by what the estimate left of the budget; else half of the steps of cross-entropy begin at
        the likeliest known.
        """
        if self.cooled is not None:
            left = self.budget - self.spent - self.parts.refine - self.modes_budget
            if left < self.parts.slow_search or not on_cpu():  # less than the first coolings had
                return start
            found = self.cool("cooled slowly", self.cooled, min(left, MAX_COOLING), True)
            # all of them would take what is left to refine the likeliest
            return merge(start, found[:1], top=REFINED_FACTOR * self.top)
        budget = self.affordable(self.parts.slow_search) // 2
        if budget < MIN_DIVIDED_BUDGET:
            return start
        self.watch.doing("searching by slow cross-entropy")
        for name, around in (("slow cross-entropy", None), ("the same, from the best", start)):
            result = slow_cross_entropy(self.next_key(), self.sim, budget, around)
            start = merge(start, self.add_failures(name, result), top=REFINED_FACTOR * self.top)
        return start

    def best_of_modes(self) -> Failures:
        """The likeliest failure of each mode."""
        return self.collect([m.failure for m in self.modes])

    def estimate(self):
        """The probability, with what is left."""
        self.watch.doing("estimating")
        rest = max(self.budget - self.spent, 1)
        folder = None if self.checkpoint is None else Path(self.checkpoint) / "probability"
        places = dict(
            executor=self.placement.executor, devices=self.placement.devices, checkpoint=folder
        )
        if not self.has_points or self.hosted and rest < few_calls.LEAST:
            n = rest if self.hosted else max(rest, MIN_COUNTED_EPISODES)
            p = monte_carlo(self.next_key(), self.sim, n, **places)
            return self.keep_probability(p, "plain draws")
        if not len(self.pool):  # the estimate may find what the search did not
            rest -= self.parts.refine + self.parts.slow_search
        rest -= shares_cost(self.budget, len(self.modes)) if self.modes else 0
        failures = self.refined if len(self.refined) else None
        rest = max(rest, few_calls.LEAST)
        p = failure_probability(self.next_key(), self.sim, rest, failures=failures, **places)
        self.keep_probability(p, "probability")
        left = self.budget - self.spent
        short = self.hosted and left < shares_cost(self.budget, len(self.modes))
        if p.proposal is None or short:
            return
        if not len(self.pool):
            self.redraw_failures(p.proposal)
        self.tell_shares(p.proposal)

    def keep_probability(self, p, name):
        """Keep the `Estimate` ``p``, with the nominal draws among its plain ones, which they are
        too.
        """
        drawn, own = p.plain or (0, 0, 0), self.nominal
        own = own.failing, own.invalid, own.episodes
        plain = tuple(a + b for a, b in zip(drawn, own, strict=True))
        self.probability = p._replace(plain=plain)
        self.note(name, p.episodes, p.failing, invalid=p.invalid)

    def keep_failing_runs(self):
        """Every failing run of a black box joins what the report shows, whoever made it."""
        runs = failing_runs(self.sim)
        if runs:
            found = collect(self.sim, self.reward, failing_episodes(self.sim, runs), top=self.top)
            best = _best_log_density(found)
            if best > _best_log_density(self.failures):
                self.residual = self.late = np.nan  # those of another failure
            self.failures = merge(self.failures, found, top=self.top)
            if self.modes:
                self.modes = _with_likelier(self.sim, self.modes, found)
            self.note("failing runs kept", 0, best=best)

    def redraw_failures(self, q):
        """Failures that the estimate's proposal draws, where the search found none; a few draws of
        one that fails rarely may have none.
        """
        most = REDRAWN_BATCHES if self.probability.failing and not self.hosted else 1
        failing, batches = np.zeros(1, bool), 0
        each = min(REDRAWN_EPISODES, max(self.budget // REDRAWN_BATCHES, 1))
        while not failing.any() and batches < most:
            points, drawn, _ = redraw(self.next_key(), self.sim, q, each)
            failing, batches = np.asarray(drawn.failure), batches + 1
        result = failures_at(self.sim, np.asarray(points)[failing])
        evaluations = batches * each + result.evaluations
        self.add_failures("the estimate's failures", result._replace(evaluations=evaluations))
        self.refine()

    def tell_shares(self, q):
        """The share of the probability that each mode has, of failures drawn from the proposal."""
        p = self.probability
        if not (self.modes and p.reliable):
            return
        if p.draws is not None and isinstance(p.draws.source, transform.Latent):
            q = p.draws.source  # independent draws tell more than few populations
        self.watch.doing("shares of modes")
        budget = min(self.budget, DEFAULT_BUDGET)
        more = None if self.hosted else self.modes_with
        self.modes, failing, cost = mode_shares(
            self.next_key(), self.sim, q, self.modes, budget, more
        )
        if cost:
            self.note("shares of modes", cost, failing)

    def modes_with(self, others: Episode) -> Modes:
        """The modes with those of failures of the estimate that are of none of them."""
        before, kept = _best_log_density(self.failures), (self.residual, self.late)
        n = len(others.length)
        start = self.add_failures("failures of no mode", ExplorerResult(others, 0, n, 0))
        found = self.refine_from(start, int(OTHERS_SHARE * min(self.budget, DEFAULT_BUDGET)))
        if _best_log_density(self.failures) <= before:
            self.residual, self.late = kept
        self.failures = merge(self.failures, found, top=self.top)
        return self.modes

    def report(self, settings):
        """All that was found, as `jast.stress` returns it."""
        self.keep_failing_runs()
        return Report(
            nominal=self.nominal,
            failures=self.failures[: self.top],
            modes=self.modes,
            probability=self.probability,
            residual=self.residual,
            late=self.late,
            tried=tuple(self.tried),
            episodes=self.spent,
            invalid=self.invalid,
            settings=settings,
            sim=self.sim,
        )


def _with_likelier(sim: Simulator, found: Modes, failures: Failures) -> Modes:
    """The modes with the ``failures`` that are likelier than those of the modes in whose direction
    they lie.
    """
    heads = [m.failure for m in found]
    for e, k in zip(failures, owners(sim, failures.episodes, stacked(heads)), strict=True):
        if rank(stacked([e, heads[k]]))[1] > 0:
            heads[k] = e
    order = np.argsort(rank(stacked(heads)), kind="stable")
    return Modes([found[i]._replace(failure=heads[i]) for i in order], found.evaluations)


def _best_log_density(failures: Failures) -> float:
    """log p relative to the mode of the likeliest; -inf where there is none."""
    return float(failures.best.reward) if len(failures) else -np.inf
