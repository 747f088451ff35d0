"""population: the probability of a failure by populations that stay on the device, and by whether
ways that know nothing of each other agree.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from jast._src.core.counter_prng import counter_key
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, Executor, PathLike, PRNGKey
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.population.answer import (
    estimate_from_plain_draws,
    estimate_from_populations,
)
from jast._src.estimate.population.descents import population_size
from jast._src.estimate.population.importance import gaussians_promise_more, importance_estimate
from jast._src.estimate.population.particle_moves import allocate_particles, draw_particles
from jast._src.estimate.population.search import PopulationSearch
from jast._src.normal_space import transform
from jast._src.runtime import work
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.device import on_cpu, read_clock
from jast._src.runtime.memory import require
from jast._src.runtime.progress_bar import Watch
from jast._src.util.checks import check_random_key, whole_number
from jast._src.util.display import call_settings
from jast._src.util.intervals import checked_level

__all__ = ["MIN_BUDGET", "by_populations", "episodes_a_second", "population"]

MIN_BUDGET = 20_000
"""Evaluations of a call at least: a population of 128 points meets 1e-6 within them."""
MIN_PARTICLES = 128
"""Points of a population at least: as many as are simulated side by side."""
POINTS_DIVISOR = 500
"""Share of the budget, as its denominator, that a population has as points: at 5 moves and 13
levels, as of a probability of 1e-9, one takes an eighth of the budget."""
TIMED_SECONDS = 0.05
"""CPU seconds of the draws by which a rate is measured."""


def population(
    key: PRNGKey,
    sim: Simulator,
    budget: int = 2_000_000,
    *,
    particles: int | None = None,
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Estimate:
    """The probability that a system fails, by populations of points that stay on the device: for
    systems of which a CPU simulates ten thousand episodes a second or more.

    A point is an episode as normal numbers. A population goes down the levels of the miss distance
    (subset simulation, Au and Beck 2001), another one from wide noise to the model's own (which
    needs no distance); both by the same few compiled programs. Populations are repeated within the
    budget. Standard errors come from their genealogies (Lee and Whiteley 2018) and from their
    spread, whichever is greater.

    Where a mixture of Gaussians that is fitted to their failures promises a smaller error than
    further populations, it draws the last part (importance sampling), down to a standard error of
    half a per cent. Where it does not promise 1 %, tilts of each step are fitted, too, of systems
    of 30 steps or more or with choices (on a CPU). The populations check it: one way must agree
    with it, and none may say more, by three standard errors.

    Otherwise two ways that know nothing of each other must agree within three standard errors;
    where they do not, both go again with twice the moves, while the budget lasts. Where only one of
    them reaches failures, its moves are doubled until its answer stays. The model's own draws, with
    which each population begins, are a third witness. Otherwise the estimate is UNRELIABLE and says
    which way saw what; so it is with a relative standard error above 5 %, and with coarse floats.
    Where plain draws promise more than these, or ten failures while nothing confirms what one way
    says, it draws plainly: their interval is exact, and they are UNRELIABLE with fewer than ten
    failures only.

    A failure mode that no way meets is missing without a sign. A KeyboardInterrupt ends it with the
    estimate of the populations that are done, and is raised where there is none. Host loop, not for
    `jax.jit` or `jax.vmap`.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        budget: episodes to simulate, at least 20,000, nearly: a population that has begun is ended.
            With fewer than 300,000 a population has some hundred points, and where the miss
            distance takes few values its levels are chosen too high in the mean, by more than the
            standard error tells (of a gambler's ruin with 100,000, which is UNRELIABLE, by 26 %).
        particles: points of a population at most, at least 128, or None for 8192 (262,144 on an
            accelerator); fewer where the budget is small, or episodes have very many numbers.
        level: of the interval, in (0, 1).
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after each population, and at the end.
        checkpoint: a folder that keeps finished populations. The same call then goes on where it
            was stopped, to the same result.
        executor: runs the populations: anything with ``submit(function, *args)``, such as the
            executors of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Estimate`; ``method`` and ``history`` say which ways were gone and how they agreed, and
        ``proposal`` is a `Sample` of failures, which serves `jast.estimate.failure_samples`.

    Raises:
        ValueError: for a budget below 20,000, fewer than 128 particles, a level outside (0, 1),
            disturbances without a quantile function, and where the simulator's functions do not fit
            together.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing(b=0.5)  # truly 2.9e-4
        >>> found = jast.estimate.population(jax.random.key(0), sim, 300_000)
        >>> truth = float(jast.simulators.landing_probability(b=0.5))
        >>> 0.8 < found.mean / truth < 1.25
        True
    """
    name = "population"
    check_random_key(name, key)
    budget = whole_number(name, "budget", budget, MIN_BUDGET)
    if particles is not None:
        particles = whole_number(name, "particles", particles, MIN_PARTICLES)
    level = checked_level(name, level)
    transform.check(name, sim)
    placement = work.placement(name, executor, devices)
    with open_checkpoint(
        name, checkpoint, key, sim=sim, budget=budget, particles=particles
    ) as store:
        found = by_populations(
            name,
            key,
            sim,
            budget,
            particles=particles,
            level=level,
            watched=(progress, callback),
            placement=placement._replace(store=store),
        )
    asked = dict(budget=budget, level=level)
    asked |= {} if particles is None else dict(particles=particles)
    return found._replace(settings=call_settings(name, key, **asked))


def episodes_a_second(key: jax.Array, sim: Simulator) -> float:
    """How many episodes a population simulates in a CPU second (of an accelerator: a second), by
    two timed draws after two that compile.
    """
    n = population_size(sim)
    particles, key = allocate_particles(sim, n), counter_key(key, 4)
    for _ in range(2):  # arrays that the system has put on a device take the points there, too
        particles, _ = draw_particles(sim, particles, key, MIN_PARTICLES)
    jax.block_until_ready(particles)
    m = MIN_PARTICLES if on_cpu() else n  # an accelerator takes as long for few
    while True:  # an expensive system is not run so often for this
        begun = read_clock()
        particles, _ = draw_particles(sim, particles, key, m)
        jax.block_until_ready(particles)
        spent = read_clock() - begun
        if spent > TIMED_SECONDS or m == n:
            return m / max(spent, 1e-9)
        m = min(8 * m, n)


def by_populations(
    name: str,
    key: jax.Array,
    sim: Simulator,
    budget: int,
    *,
    particles: int | None = None,
    level: float = 0.95,
    watched: tuple = (False, None),
    placement: work.Placement = work.HERE,
) -> Estimate:
    """The `Estimate` of `population`, for the function of this ``name``."""
    capacity = population_size(sim, particles)
    n = population_size(sim, min(capacity, max(budget // POINTS_DIVISOR, MIN_PARTICLES)))
    numbers = capacity * transform.dimension(sim) * np.dtype(transform.normal_numbers(sim)).itemsize
    require(name, 4 * numbers, f"populations of {capacity} points", "use fewer particles")
    with Watch(name, budget, "episode", *watched) as watch:
        search = PopulationSearch(
            key, sim, budget, n=n, capacity=capacity, watch=watch, placement=placement
        )
        search.run(search.first_kind("distance"), 1)
        plain = search.failures_are_frequent()
        if not plain:
            search.run(search.first_kind("width"), 1)
            plain = search.plain_answers() and not gaussians_promise_more(search)
        kinds, by_weights = () if plain else search.choose_kinds(), None
        if kinds:
            kinds = search.compare(kinds)
            settled = search.agree(kinds) or not search.plain_answers(kinds)
            if len(kinds) == 2 and settled and not search.interrupted:
                by_weights = importance_estimate(search, name, kinds, level)
            plain = by_weights is None and search.plain_answers(kinds)
        if plain or not kinds:
            return estimate_from_plain_draws(search, name, level)
        if by_weights is None:
            search.fill(kinds[0], search.budget - search.spent)
        else:
            watch.reach(budget)
            watch.tell()
    return estimate_from_populations(search, name, kinds, level, by_weights)
