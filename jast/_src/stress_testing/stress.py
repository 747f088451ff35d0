"""jast.stress: check, nominal, explorers, refinement, modes, probability; one budget."""

from __future__ import annotations

from collections.abc import Sequence

import jax

from jast._src.core.check import check
from jast._src.core.simulator import Simulator, require_simulator
from jast._src.core.typing import Callback, Executor, PathLike, PRNGKey
from jast._src.estimate import budgets
from jast._src.estimate.population.failure_sample import Sample
from jast._src.runtime import work
from jast._src.runtime._jax import briefly
from jast._src.runtime.checkpoints import keep_answers, open_checkpoint
from jast._src.runtime.host_errors import runs_apart, telling_runs
from jast._src.runtime.progress_bar import Watch
from jast._src.stress_testing.budget_shares import DEFAULT_BUDGET
from jast._src.stress_testing.explorers import has_quantiles
from jast._src.stress_testing.report import Report
from jast._src.stress_testing.stress_test import StressTest
from jast._src.util import checks
from jast._src.util.display import call_settings

__all__ = ["DEFAULT_BUDGET", "stress"]

MIN_BUDGET = 300  # evaluations of a call, at least: with fewer no explorer is worth a call


def stress(
    key: PRNGKey,
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
    then measured. A system that simulates 300,000 episodes in 24 CPU seconds is answered by
    populations that stay on the device (`jast.estimate.population`): they tell the probability,
    their failures are cooled to the likeliest near to each, pulled to where log p is greatest
    (`jast.search.refine`), and sorted into failure modes, each with its share of the probability.
    What the estimate left of the budget cools them once more, slowly, unless slopes say that the
    likeliest is found. The same holds of every system in JAX with a budget from 300,000 on.

    For the others a portfolio of explorers looks for failures (those whose failures get likelier
    are given more of the budget), and the probability is that of
    `jast.estimate.failure_probability`, for which the modes found are where to look; they never
    enter the estimate itself.

    Args:
        key: consumed.
        sim: the simulator.
        budget: evaluations (episodes; one with its gradient counts as 3 or 4) in all, nearly; of
            a black box its runs, never more, with all that the call runs; at least 300. Default:
            what the system simulates in some four CPU seconds, from 300,000 to 33,554,432; 200,000
            where 300,000 take more than 24. Where the standard error of a probability by
            populations or plain draws is above 5 %, or nothing confirms it, and 4,194,304 would do,
            it is asked again with as many as it needs (but not with a ``checkpoint``). The report's
            ``settings`` name the one that was used. Below 10,417 the probability is that of
            `failure_probability` with few calls.
        seconds: in place of ``budget``: as many evaluations as the system simulates in so many CPU
            seconds (a black box: seconds), rounded down to 2^k or 3 2^k.
        top: failures kept, at least one for each mode.
        progress: whether there is a bar.
        callback: called as ``callback(done, total, None)`` after every piece of the work.
        checkpoint: a folder that keeps finished populations and what the system answered to
            searches, refinement and draws. The same call, with its ``budget``, then goes on where
            it was stopped, to the same result; first looks run again, unless it is a black box,
            of which every finished run is kept.
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
    checks.check_random_key(name, key)
    budgets.check_budget_or_seconds(name, budget, seconds)
    if budget is not None:
        budget = checks.whole_number(name, "budget", budget, MIN_BUDGET)
    top = checks.whole_number(name, "top", top, 1)
    require_simulator(name, sim)
    with runs_apart(sim):  # so that the same call is the same, whatever ran before
        check(sim)
        by_default = budget is None and seconds is None and checkpoint is None
        if budget is None and seconds is None and not has_quantiles(sim):
            budget = DEFAULT_BUDGET
        if budget is None:
            budget = budgets.measure_budget(name, key, sim, seconds, MIN_BUDGET, DEFAULT_BUDGET)
        about = dict(top=top, progress=progress, callback=callback, checkpoint=checkpoint)
        about |= dict(placement=work.placement(name, executor, devices), by_default=by_default)
        report, more = _stress_once(key, sim, budget, **about)
        while more is not None:
            interrupted = f"while it was made again with {more} evaluations"
            try:
                again, more = _stress_once(key, sim, more, **about)
            except KeyboardInterrupt:
                again = None
            if again is None or again.probability is None:  # the first answer is not lost
                return report._replace(settings=report.settings | dict(interrupted=interrupted))
            report = again
        return report


def _stress_once(key, sim, budget, *, top, progress, callback, checkpoint, placement, by_default):
    """The `Report` of so many evaluations, and with how many it is to be made again: then it has
    only the probability by which that was decided. None: it is not.
    """
    name, more = "stress", None
    settings = call_settings(name, key, budget=budget, top=top)
    with (
        open_checkpoint(name, checkpoint, key, sim=sim, budget=budget, top=top) as store,
        keep_answers(store),
        briefly(not budgets.uses_populations(sim, budget)),
        Watch(name, budget, "sim", progress, callback) as watch,
    ):
        placement = placement._replace(store=store)
        test = StressTest(
            key, sim, budget, top=top, watch=watch, placement=placement, checkpoint=checkpoint
        )
        try:
            with telling_runs(sim, test.tell_runs):
                test.run_nominal()
                if test.cheap:
                    test.run_populations()
                    more = budgets.next_budget(test.probability, budget) if by_default else None
                    if more is None:
                        # draws of Gaussians and of the model have compiled the program that this
                        # plays some ten thousand episodes with; populations have not
                        drawn = test.probability.draws
                        with briefly(drawn is not None and isinstance(drawn.source, Sample)):
                            test.find_likeliest()
                else:
                    test.search()
                    test.refine()
                    test.estimate()
        except KeyboardInterrupt:
            if test.nominal is None:
                raise
            settings["interrupted"] = f"after {test.spent} of {budget} evaluations"
        return test.report(settings), more
