"""failure_probability: an estimate from a proposal that is found within the budget, and the plainer
methods beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax

from jast._src.core.failures import Failures
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, Executor, PathLike, PRNGKey
from jast._src.estimate import budgets
from jast._src.estimate.estimate import Estimate, flag_imprecise
from jast._src.estimate.few_calls import few_calls
from jast._src.estimate.importance_sampling import importance
from jast._src.estimate.multilevel import failure_proposal
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.population.population import MIN_BUDGET as POPULATIONS_LEAST
from jast._src.estimate.population.population import by_populations
from jast._src.estimate.proposal_search.by_proposal import Request, estimate_by_proposal
from jast._src.estimate.redraw import is_proposal_of
from jast._src.normal_space import transform
from jast._src.runtime import work
from jast._src.runtime._jax import briefly
from jast._src.runtime.checkpoints import keep_answers, open_checkpoint
from jast._src.runtime.host_errors import runs_on_host, showing_runs
from jast._src.runtime.progress_bar import Watch
from jast._src.util.checks import check_random_key, whole_number, wrong
from jast._src.util.display import call_settings
from jast._src.util.intervals import checked_level

__all__ = [
    "MAX_SURROGATE_NUMBERS",
    "MIN_BUDGET",
    "adaptive_cross_entropy",
    "failure_probability",
]

MIN_BUDGET = 5000
"""Episodes below which a surrogate answers, or the moments of an episode alone."""
MAX_SURROGATE_NUMBERS = 20
"""Numbers of an episode up to which it does."""
LEVELS = 20
"""Iterations of `adaptive_cross_entropy`."""


def failure_probability(
    key: PRNGKey,
    sim: Simulator,
    budget: int | None = None,
    *,
    seconds: float | None = None,
    failures: Failures | None = None,
    near: Estimate | None = None,
    gradients: bool = True,
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Estimate:
    """The probability that a system fails, by the way that suits what an episode costs.

    By default the rate of the system is measured. One that simulates 300,000 episodes in 24 CPU
    seconds is answered by populations that stay on the device (`population`), and by draws of
    Gaussians or tilts that are fitted to their failures; and so is every system in JAX with a
    budget from 300,000 on. ``settings`` names the budget that was used: the
    same key with that budget gives the same bits. The others, and calls with ``failures`` or
    ``near``, are answered by a proposal that this function finds itself.

    An episode is a point of normal numbers (x_t is the quantile of p(x | s) at Phi(z_t)). The
    search explores, adapts, audits. It explores by gradients of the miss distance, by noise that is
    wide first and then cooled, and by the mirror images of what these found; by a population of
    subset simulation where none of them found a failure. Mixtures of Gaussians are fitted to the
    weighted failures of a few batches, for as long as they get better; up to 128 directions are
    kept, fewer of more than 250 numbers. The audit, a population that is kept out of what the
    proposal covers, looks for lost failure modes; what it finds is taken in, or else the estimate
    is UNRELIABLE. Systems of 30 steps or more, or whose disturbances hold choices (Bernoulli,
    Categorical), are first tried with tilts: each step's own disturbance is tilted by the state and
    the time, choices by their odds, and the tilts are fitted by cross-entropy; a normal number
    comes from one of three Gaussians where a single one serves badly. Where tilts do not serve
    them, populations spend what is left (of calls of 40,000 evaluations or more, without
    ``failures`` or ``near``, and not of black boxes). Others are tried with tilts where the
    Gaussians promise few effective draws.

    What is left of the budget, about half, is drawn from the proposal as it then stands. The
    estimate and its interval come from these episodes alone. A tenth of them or more, up to two
    fifths where the standard error stays below 1 %, are the model's own draws, which meet what no
    explorer was led to; ``unseen`` bounds what they did not meet. All are drawn from the model
    where plain Monte Carlo would be more exact, and where the proposal is given up but the model
    fails often enough. Where it does not, the answer is subset simulation's, and UNRELIABLE. So is
    that of a system whose floats are too coarse, and an estimate with a relative standard error
    above 5 %.

    Fewer than 5000 episodes are for systems that cost a second each. A Gaussian process learns the
    limit state from two thirds of them, 240 at most: the miss distance of the safe ones, and where
    failures are; of those whose distance is below 0, where an episode is judged at its end alone,
    how deep they are. The others, drawn at random, correct it: the interval comes from these, and
    holds the surrogate's error. Batches of calls suit black boxes with workers. The estimate is
    UNRELIABLE if one call changes much, the relative standard error is above 25 %, or there are
    fewer than 10 failures; if there are none, draws of the model give an upper bound. The method
    itself takes some 4 CPU seconds for 200 calls,
    more where NumPy's threads wait for one another (OPENBLAS_NUM_THREADS=1); their number changes
    what is drawn.

    Of episodes of more than 20 numbers, calls with at most 10,000 episodes first ask each moment. A
    simulator says at every state how far it is from failing, so that one run tells as many limit
    states as it has moments. The system is linearised next to the boundary that is nearest, by one
    run for each number, or by gradients where it is judged at its end alone. Each moment then has a
    half-space of failure, whose depth a run or two correct and whose mirror image is tried.
    Failures of wide noise that none of them has lead to others. The proposal draws beyond these
    half-spaces, nearer where the failures of three batches lie nearer. Half of the last episodes
    are spent on lines to the boundaries where these tell more than draws (line sampling,
    Koutsourelakis, Pradlwarter and Schueller 2004), each corrected by a run at random, so that
    boundaries need not be flat; draws and lines must agree. The audit is a small one: it finds
    modes of a tenth of the probability or more. With some hundred episodes it is 40 draws of wide
    noise, whose failures must come to lie where the proposal draws. Fewer than 30 effective draws
    make an estimate without lines UNRELIABLE, and with them a relative standard error above 18 %.
    Where such proposals do not serve, the other searches have what is left, if that is 5000
    episodes or more; else plain draws or subset simulation answer, and mostly UNRELIABLE.

    A failure mode below ``unseen`` that all explorers miss is missing without a sign. A
    KeyboardInterrupt during the last part ends it with the estimate of the draws so far; before
    that, with an UNRELIABLE estimate from the batches of the search, and it is raised where there
    is none yet. Host loop, not for `jax.jit` or `jax.vmap`.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        budget: episodes to simulate, at least 40. Default: what the system simulates in some four
            CPU seconds, from 300,000 to 33,554,432; 100,000 where 300,000 take more than 24. Where
            the standard error of an answer by populations or plain draws is above 5 %, or nothing
            confirms it, and 4,194,304 would do, it is made again with as many as it needs (but not
            with a ``checkpoint``).
        seconds: in place of ``budget``: as many episodes as the system simulates in so many CPU
            seconds (a black box: seconds), rounded down to 2^k or 3 2^k. Compilation and the
            method's own work come on top.
        failures: known ones (an archive, `jast.failures`), which join what the explorers find, so
            that no mode among them is lost. They lead to a proposal and never enter the estimate.
            Tilts take in two modes that they hardly draw; where others are left, or these could not
            be learned, the estimate is UNRELIABLE.
        near: the `Estimate` of a similar system, such as the neighbour in a sweep. Its proposal,
            fitted to two or three batches, takes the place of the search where it serves; the audit
            and the last draws stay. One without a proposal that fits changes nothing.
        gradients: differentiate the miss distance. Where its gradients lead nowhere, nothing
            depends on them.
        level: of the interval, in (0, 1).
        progress: whether to show a progress bar: of the runs of a black box where there is no
            executor, else of the last part.
        callback: called as ``callback(done, total, None)`` after each chunk of the last part.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Estimate`. ``modes`` are parts of the estimate by direction; ``proposal`` serves
        `jast.estimate.failure_samples`; ``history`` tells how the search went; ``evaluations``
        counts each episode, and three for one with its gradient.

    Raises:
        ValueError: for a budget below 40, a budget together with ``seconds``, ``seconds`` not above
            0, a level outside (0, 1), disturbances without a quantile function, and where the
            simulator's functions do not fit together.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing(b=0.8)  # truly 6e-9
        >>> found = jast.estimate.failure_probability(jax.random.key(0), sim, 6000)
        >>> truth = float(jast.simulators.landing_probability(b=0.8))
        >>> 0.8 < found.mean / truth < 1.25
        True
    """
    name = "failure_probability"
    check_random_key(name, key)
    budgets.check_budget_or_seconds(name, budget, seconds)
    if budget is not None:
        budget = whole_number(name, "budget", budget, few_calls.LEAST)
    level = checked_level(name, level)
    transform.check(name, sim)
    if near is not None and not isinstance(near, Estimate):
        raise ValueError(f"{name}: near must be an Estimate, received {type(near).__name__}")
    if failures is not None and not isinstance(failures, Failures):
        must = "be an archive of jast.failures, as the failures of a search"
        raise wrong(name, "failures", must, type(failures).__name__)
    similar = None if near is None else near.proposal
    if isinstance(similar, Sample) or not is_proposal_of(sim, similar):  # a sample draws nothing
        similar = None
    guided = failures is not None or similar is not None
    by_default = budget is None and seconds is None and not guided and checkpoint is None
    if budget is None:
        budget = budgets.DEFAULT_BUDGET
        if not guided or seconds is not None:
            budget = budgets.measure_budget(name, key, sim, seconds, few_calls.LEAST)
    settings = call_settings(name, key, budget=budget, gradients=bool(gradients), level=level)
    known = None if failures is None else transform.normal_of(sim, failures.episodes)
    placement, watched = work.placement(name, executor, devices), (progress, callback)
    about = dict(sim=sim, budget=budget, gradients=bool(gradients), known=known, near=similar)
    few = not budgets.uses_populations(sim, budget)
    with (
        open_checkpoint(name, checkpoint, key, **about) as store,
        keep_answers(store),
        briefly(few),
    ):
        placement = placement._replace(store=store)
        about = dict(level=level, watched=watched, placement=placement)
        populations = partial(by_populations, name, key, sim, **about)
        if not (guided or few):
            found = populations(budget)
        elif budget < MIN_BUDGET and transform.dimension(sim) <= MAX_SURROGATE_NUMBERS:
            found = few_calls.few_calls(key, sim, budget, level, known, progress, callback)
        else:
            # tilts may have spent half, and populations know nothing of failures given
            serve = not (guided or runs_on_host(sim)) and budget >= 2 * POPULATIONS_LEAST
            wanted = Request(
                name=name,
                key=key,
                sim=sim,
                budget=budget,
                gradients=bool(gradients),
                failures=failures,
                failure_points=known,
                near=similar,
                **about,
                otherwise=populations if serve else None,
            )
            if progress and runs_on_host(sim) and executor is None:
                wanted = wanted._replace(watched=(False, callback))
                with Watch(name, budget, "run", progress, None) as watch, showing_runs(sim, watch):
                    found = estimate_by_proposal(wanted)
            else:
                found = estimate_by_proposal(wanted)
            found = flag_imprecise(found) if budget >= MIN_BUDGET else found
    found = found._replace(settings=settings)
    while by_default and not few and (budget := budgets.next_budget(found, budget)) is not None:
        try:
            again = failure_probability(
                *(key, sim, budget),
                gradients=gradients,
                level=level,
                progress=progress,
                callback=callback,
                executor=executor,
                devices=devices,
            )
        except KeyboardInterrupt:
            said = f"interrupted while it was made again with {budget} evaluations"
            return found._replace(history=(*found.history, said))
        said = f"{found.evaluations} evaluations were too few: {found.relative_error:.1%}"
        found = again._replace(history=(said, *again.history))
    return found


def adaptive_cross_entropy(
    key: PRNGKey, sim: Simulator, budget: int = 100_000, *, level: float = 0.95
) -> Estimate:
    """The multi-level cross-entropy method (de Boer, Kroese, Mannor and Rubinstein 2005) with one
    Gaussian, then importance sampling with the rest of the budget.

    Each of 20 iterations spends ``budget // 100`` episodes on finding the proposal
    (`jast.estimate.failure_proposal`). It settles on one failure mode without a sign of the others:
    a baseline, and quick where there is only one.

    Args:
        key: consumed.
        sim: the simulator.
        budget: episodes in all, at least 5000.
        level: of the interval, in (0, 1).

    Returns:
        `Estimate`.

    Raises:
        ValueError: for a budget below 5000, and as `failure_proposal`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing()
        >>> found = jast.estimate.adaptive_cross_entropy(jax.random.key(0), sim, 5000)
        >>> found.episodes
        5000
    """
    name = "adaptive_cross_entropy"
    check_random_key(name, key)
    budget = whole_number(name, "budget", budget, MIN_BUDGET)
    level = checked_level(name, level)
    settings = call_settings(name, key, budget=budget, level=level)
    for_search, key = jax.random.split(key)
    found = failure_proposal(for_search, sim, samples=budget // 100, iterations=LEVELS)
    result = importance(key, sim, found.policy, budget - int(found.episodes), level=level)
    reasons = () if bool(found.reached) else ("the search for a proposal did not reach failures",)
    remark = "one Gaussian covers one failure mode, and no others were looked for"
    return result._replace(
        method=name,
        episodes=int(found.episodes) + result.episodes,
        settings=settings,
        reliable=result.reliable and not reasons,
        warnings=(*reasons, *result.warnings, remark),
        history=tuple(str(found).splitlines()),
    )
