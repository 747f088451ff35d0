"""Subset simulation, as an estimator of its own and as what is left where no proposal was found."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, Executor, PathLike, PRNGKey
from jast._src.estimate.estimate import Estimate, estimate_from_mean
from jast._src.estimate.host_populations import LEVEL_SHARE, Explored, explore
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.population.search import Answer, contradictions
from jast._src.estimate.replicates import LOST_MODE_REMARK, MIN_REPLICATES, mean_of_replicates
from jast._src.normal_space import transform
from jast._src.runtime import work
from jast._src.runtime.backends import Task
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.memory import require_episodes
from jast._src.runtime.progress_bar import Watch
from jast._src.util.checks import check_random_key, whole_number
from jast._src.util.display import call_settings
from jast._src.util.intervals import checked_level

__all__ = ["fallback_estimate", "subset_simulation"]

MIN_SAMPLES = 100
"""Members of a population at least: levels are quantiles of them."""
FALLBACK_REPLICATES = 5
"""Populations where no proposal was found; `MIN_REPLICATES` where these would be small."""
LEAST_SAMPLES = 16
"""Members of such a population at the least: four of them reach the next level."""
MORE_ROUNDS = 1.25
"""Factor on the rounds that a population took, for the next one: of 8 levels they differ by 2."""
PATIENCE = 5
"""Moves at a level that does not fall: of 16 points none may have moved. A convention."""
MIN_LOG_PROBABILITY = -690.0
"""Where a population gives up: the log of the least double, nearly."""


def subset_simulation(
    key: PRNGKey,
    sim: Simulator,
    samples: int = 1000,
    *,
    replicates: int = 10,
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Estimate:
    """Subset simulation (Au and Beck 2001): the mean of several independent populations.

    The interval is that of the populations, log-normal; ``ess`` and ``max_share`` are of them too,
    and ``samples`` counts the members of the last ones. It needs a miss distance that leads to
    failures, and no gradient. A mode that few members reach is lost at times, and the others do not
    show it. A population gives up below a probability of 1e-300. A KeyboardInterrupt ends it with
    the estimate of the populations that are done, UNRELIABLE, and is raised where they are fewer
    than 3.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        samples: members of a population, at least 100.
        replicates: populations, at least 3.
        level: of the interval, in (0, 1).
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after each population.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Estimate`.

    Raises:
        ValueError: for fewer than 100 samples or 3 replicates, and as `failure_probability`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing(b=0.5)
        >>> found = jast.estimate.subset_simulation(jax.random.key(0), sim, 300, replicates=4)
        >>> 0 < found.mean < 1e-2
        True
    """
    name = "subset_simulation"
    check_random_key(name, key)
    samples = whole_number(name, "samples", samples, MIN_SAMPLES)
    replicates = whole_number(name, "replicates", replicates, MIN_REPLICATES)
    level = checked_level(name, level)
    transform.check(name, sim)
    require_episodes(name, sim, samples)
    placement = work.placement(name, executor, devices)
    about = dict(sim=sim, samples=samples, replicates=replicates)
    with (
        open_checkpoint(name, checkpoint, key, **about) as store,
        Watch(name, replicates, "population", progress, callback) as watch,
    ):
        shared = jax.random.split(key, replicates), sim, samples
        task = Task(_run_replicate, shared, lambda: Explored(*Explored._fields))
        placement = placement._replace(store=store)
        ran = work.run(task, replicates, lambda runs, i, run: (*runs, run), (), watch, placement)
    runs = ran.state
    short = work.describe_missing("populations", ran, len(runs), replicates)
    if len(runs) < MIN_REPLICATES:
        raise KeyboardInterrupt if ran.ended == "" else RuntimeError(f"{name}: {short}")
    reasons = [] if short is None else [short, *map(str, ran.incidents)]
    settings = call_settings(name, key, samples=samples, replicates=replicates, level=level)
    return estimate_from_replicates(name, runs, level, reasons)._replace(settings=settings)


def _run_replicate(shared, number, context):
    """The `Explored` of a population, of arrays."""
    keys, sim, samples = shared
    found = explore(keys[number], sim, samples, min_log_probability=MIN_LOG_PROBABILITY)
    return jax.tree.map(np.asarray, found)


def estimate_from_replicates(
    method: str, runs: Sequence[Explored], level: float, reasons: Sequence[str] = ()
) -> Estimate:
    """The `Estimate` of independent populations; ``reasons`` speak against it. It is the mean of
    those that the budget did not cut off.
    """
    told, plain = [r for r in runs if r.complete], tuple(map(int, sum(r.plain for r in runs)))
    found = mean_of_replicates([float(r.log_mean) for r in told], "populations", level)
    if cut := len(runs) - len(told):
        reasons = (*reasons, f"the budget cut off {cut} of {len(runs)} populations")
    answer = Answer(found.log_mean, found.relative)
    against = [] if math.isnan(found.log_mean) else contradictions(answer, plain)
    reasons = (*reasons, *found.reasons, *against)
    history = tuple(
        f"population: {len(r.levels)} levels, log p {r.log_mean:.3f}, {r.evaluations} evaluations"
        for r in runs
    )
    return estimate_from_mean(
        method,
        found.log_mean,
        found.relative,
        level,
        found.interval,
        ess=found.ess,
        max_share=found.max_share,
        failing=sum(len(r.points) for r in runs),
        samples=sum(max(len(r.points), int(r.plain[2])) for r in runs),
        episodes=int(sum(r.evaluations for r in runs)),
        invalid=int(sum(r.invalid for r in runs)),
        plain=plain,
        reliable=not reasons,
        warnings=(*reasons, LOST_MODE_REMARK),
        history=history,
    )


def fallback_estimate(
    key: jax.Array,
    sim: Simulator,
    budget: int,
    log_mean: float,
    level: float,
    reasons: list[str],
    plain_failures: int,
) -> Estimate | None:
    """The `Estimate` of a few populations within ``budget``, where ``log_mean`` is about
    what they will find; None where the budget is too small. If the first one reaches no failure
    with half of the budget, there are no others, and the mean is NaN. Nor are there where it says
    that ``plain_failures`` of as many draws of the model as are left fail.
    """
    rounds = np.clip(log_mean, MIN_LOG_PROBABILITY, 0.0) / math.log(LEVEL_SHARE) + 2
    enough = budget / FALLBACK_REPLICATES / rounds >= MIN_SAMPLES
    replicates = FALLBACK_REPLICATES if enough else MIN_REPLICATES
    if budget / replicates / rounds < LEAST_SAMPLES:
        return None
    runs, left = [], budget
    for i, k in enumerate(jax.random.split(key, replicates)):
        size = int(left / (replicates - i) / rounds)
        if size < LEAST_SAMPLES:
            break
        most = left if i == replicates - 1 else left // 2
        about = dict(min_log_probability=MIN_LOG_PROBABILITY, max_evaluations=most)
        runs.append(explore(k, sim, size, final_moves=0, patience=PATIENCE, **about))
        left -= runs[-1].evaluations
        often = math.exp(runs[-1].log_mean) * left >= plain_failures
        if i == 0 and (often or not runs[-1].reached):
            break
        rounds = MORE_ROUNDS * runs[-1].evaluations / size
    sizes = ", ".join(str(r.plain[2]) for r in runs)
    said = f"this is the answer of subset simulation, populations of {sizes}"
    found = estimate_from_replicates("failure_probability", runs, level, [*reasons, said])
    return found._replace(proposal=_failures_of([r for r in runs if r.reached]))


def _failures_of(runs):
    """The `Sample` of the failures that populations came to; None without any."""
    if not runs:
        return None
    log_weight = [np.full(len(r.points), r.log_mean - math.log(len(r.points))) for r in runs]
    n = sum(len(r.points) for r in runs)
    return Sample(
        points=np.concatenate([r.points for r in runs]),
        used=np.concatenate([r.used for r in runs]),
        distance=np.zeros(n, runs[0].points.dtype),
        log_weight=np.concatenate(log_weight),
        group=np.arange(n, dtype=np.int32),
    )
