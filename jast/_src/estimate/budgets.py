"""How many evaluations a call is given, by what they cost: the rate of a system is measured, and
the budget that follows from it is named, so that the same call can be made again.
"""

import math
from typing import Any

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.estimate.estimate import MAX_RELATIVE_ERROR, Estimate, times_too_few
from jast._src.estimate.population.population import episodes_a_second
from jast._src.normal_space import transform
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.runtime.host_errors import runs_on_host, seconds_of_runs

__all__ = [
    "DEFAULT_BUDGET",
    "MIN_POPULATION_BUDGET",
    "check_budget_or_seconds",
    "measure_budget",
    "next_budget",
    "uses_populations",
]

DEFAULT_SECONDS = 4.0
"""CPU seconds of simulation that a call takes by default; the rest of ten is compilation."""
MIN_POPULATION_BUDGET = 300_000
"""Evaluations from which populations answer rather than a proposal. Of the drone, the grid and the
crossing of `benchmarks.closed_loops` they have standard errors of 12 to 16 % with 100,000 and of 6
to 8 % with 300,000; a proposal of tilts has 1 % of the drone with 100,000."""
MAX_POPULATION_SECONDS = 24.0
"""CPU seconds of simulation up to which a call by default has `MIN_POPULATION_BUDGET` of them.
Loops 6, 21 and 28 of `benchmarks.random_loops` take 27 microseconds an episode: with 100,000, by
tilts, calls took 77 to 139 CPU seconds and were flagged; with these, and again with what they
need, 22 to 68, and all were answered."""
MAX_DEFAULT_BUDGET = 2**25
"""Evaluations by default at most: static problems of few numbers are then answered within 3 % down
to 1e-9, in seconds."""
DEFAULT_BUDGET = 100_000
"""Evaluations by default of a system that does not simulate `MIN_POPULATION_BUDGET` in
`MAX_POPULATION_SECONDS`."""
STEADY_BUDGET = 2**22
"""Evaluations at most with which a call by default is made again where its first answer is
too imprecise, or not confirmed, and these would do: so the verdict follows from the system, not
from how busy the machine was. What is not confirmed has what plain draws need. The landing of
`benchmarks.closed_loops` needs 2.3 million, and was given 1."""
PLAIN_SHARE = 2 / 3
"""Share of a budget that plain draws have where they are best: two populations were first."""
TIMED_SECONDS = 0.2
"""Seconds of the runs by which the rate of a black box is measured."""
MAX_TIMED_RUNS = 1024
"""Runs of them at most."""
WORK_OF_A_RUN = 1e-3
"""Seconds of jast's own work for a run of a black box. With one of 4 microseconds a run `stress`
took 15 s for 12,288 and 109 s for 524,288, `failure_probability` 6 s for 20,000."""


def uses_populations(sim: Simulator, budget: int) -> bool:
    """Whether so many evaluations of a system are spent by populations."""
    return budget >= MIN_POPULATION_BUDGET and not runs_on_host(sim)


def measure_budget(
    name: str,
    key: jax.Array,
    sim: Simulator,
    seconds: float | None,
    least: int,
    default: int = DEFAULT_BUDGET,
) -> int:
    """Evaluations for the ``seconds`` of a call (None: as many as a cheap system simulates in
    `DEFAULT_SECONDS`, ``default`` of others), at least ``least``.

    They are 2^k or 3 2^k, so that two calls on one machine mostly agree.

    Raises:
        ValueError: for ``seconds`` that are not a number above 0.
    """
    if seconds is None:
        if runs_on_host(sim):
            return default
        rate = episodes_a_second(key, sim)
        if rate * MAX_POPULATION_SECONDS < MIN_POPULATION_BUDGET:
            return default
        budget = min(_round_down(DEFAULT_SECONDS * rate), MAX_DEFAULT_BUDGET)
        return max(budget, MIN_POPULATION_BUDGET)
    real = isinstance(seconds, int | float | np.number) and not isinstance(seconds, bool)
    if not real or not 0 < float(seconds) < math.inf:
        raise ValueError(f"{name}: seconds must be a number above 0, received {seconds!r}")
    rate = _episodes_a_second_on_host if runs_on_host(sim) else episodes_a_second
    return max(_round_down(float(seconds) * rate(key, sim)), least)


def next_budget(found: Estimate, budget: int) -> int | None:
    """The budget with which a call by default that ended with ``found`` is made again; None where
    it is not.
    """
    times = times_too_few(found)
    if times <= 1 or budget >= STEADY_BUDGET:
        return None
    plain = 1 / (MAX_RELATIVE_ERROR**2 * found.mean * PLAIN_SHARE)
    enough = max(min(times * budget, plain), budget)
    if enough > STEADY_BUDGET:
        return None
    # 1.3 to 2 times as many, for a standard error is itself an estimate
    return min(2 * _round_down(enough), STEADY_BUDGET)


def check_budget_or_seconds(name: str, budget: Any, seconds: Any) -> None:
    """ValueError where both are given."""
    if budget is not None and seconds is not None:
        raise ValueError(
            f"{name}: give budget or seconds, received budget={budget!r} and seconds={seconds!r}"
        )


def _round_down(evaluations: float) -> int:
    power = 2 ** int(math.log2(max(evaluations, 2)))
    return power * 3 // 2 if evaluations >= 1.5 * power else power


def _episodes_a_second_on_host(key: jax.Array, sim: Simulator) -> float:
    """Episodes a second of a system that is not in JAX, by as many as take a fifth of one."""
    n, rng = 1, numpy_generator(key, 6)
    while True:
        z = rng.standard_normal((n, transform.dimension(sim))).astype(transform.normal_numbers(sim))
        before = seconds_of_runs(sim)  # without the compilation of what calls it
        evaluate_points(sim, z)
        spent = seconds_of_runs(sim) - before
        if spent > TIMED_SECONDS or n >= MAX_TIMED_RUNS:
            return n / (spent + n * WORK_OF_A_RUN)
        n *= 4
