"""Subset simulation, as an estimator of its own and as what is left where no proposal was found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from jast import limit_state as latent
from jast import units
from jast._checks import check_random_key, whole_number
from jast.checkpoints import open_checkpoint
from jast.estimate.estimate import Estimate
from jast.estimate.populations import LAST, QUANTILE, Explored, explore
from jast.intervals import checked_level, log_normal
from jast.memory import require_episodes
from jast.places import Task
from jast.results import call_settings
from jast.simulator import Simulator
from jast.watch import Watch

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback, Executor, PathLike

__all__ = ["subset_simulation"]

LOST = "a failure mode that few members of a population reach can be lost without a sign"
REPLICATES, FEWEST, LEAST = 5, 3, 100


def subset_simulation(
    key: chex.PRNGKey,
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
    samples, replicates = (
        whole_number(name, "samples", samples, 100),
        whole_number(name, "replicates", replicates, FEWEST),
    )
    level = checked_level(name, level)
    latent.check(name, sim)
    require_episodes(name, sim, samples)
    ways = units.placement(name, executor, devices)
    about = dict(sim=sim, samples=samples, replicates=replicates)
    with (
        open_checkpoint(name, checkpoint, key, **about) as store,
        Watch(name, replicates, "population", progress, callback) as watch,
    ):
        task = Task(_unit, (jax.random.split(key, replicates), sim, samples), lambda: (0,) * 7)
        add = lambda runs, number, parts: (*runs, _explored(*parts))
        ran = units.run(task, replicates, add, (), watch, ways._replace(store=store))
    runs, short = ran.state, units.describe_missing("populations", ran, len(ran.state), replicates)
    if len(runs) < FEWEST:
        raise KeyboardInterrupt if ran.ended == "" else RuntimeError(f"{name}: {short}")
    reasons = [] if short is None else [short, *map(str, ran.incidents)]
    settings = call_settings(name, key, samples=samples, replicates=replicates, level=level)
    return of_populations(name, runs, samples, level, reasons)._replace(settings=settings)


def _unit(shared, number, post):
    """The `Explored` of a population, as arrays."""
    keys, sim, samples = shared
    return tuple(map(np.asarray, explore(keys[number], sim, samples, least=-690.0)))


def _explored(points, used, log_mean, levels, evaluations, invalid, complete):
    """`Explored` of its arrays."""
    numbers = float(log_mean), tuple(levels.tolist()), int(evaluations), int(invalid)
    return Explored(points, used, *numbers, bool(complete))


def of_populations(
    method: str, runs: list[Explored], samples: int, level: float, reasons: Sequence[str] = ()
) -> Estimate:
    """The `Estimate` of independent populations of ``samples``; ``reasons`` speak against it."""
    replicates = len(runs)
    evaluations, invalid = sum(r.evaluations for r in runs), sum(r.invalid for r in runs)
    logs = np.array([r.log_mean for r in runs])
    history = tuple(
        f"population: {len(r.levels)} levels, log p {r.log_mean:.3f}, {r.evaluations} evaluations"
        for r in runs
    )
    seen, found = int(np.isfinite(logs).sum()), list(reasons)
    if seen < replicates:
        found.append(f"{replicates - seen} of {replicates} populations reached no failure")
    top = logs.max() if seen else 0.0
    p = np.exp(logs - top)
    log_mean, relative = (
        (top + math.log(p.mean()), float(p.std(ddof=1) / math.sqrt(replicates) / p.mean()))
        if seen
        else (math.nan, math.nan)
    )
    if relative > 0.5:
        found.append(f"the replicates disagree: relative standard error {relative:.0%}")
    # few replicates: Student's t in place of the normal quantile, as a wider error
    interval = (
        log_normal(log_mean, relative * _student(replicates - 1, level), level)
        if seen
        else (0.0, 1.0)
    )
    mean = math.exp(log_mean)
    return Estimate(
        method=method,
        log_mean=log_mean,
        mean=mean,
        standard_error=mean * relative,
        relative_error=relative,
        interval=interval,
        level=level,
        ess=float(p.sum() ** 2 / (p**2).sum()) if seen else 0.0,
        k_hat=math.nan,
        max_share=float(p.max() / p.sum()) if seen else math.nan,
        failing=sum(len(r.points) for r in runs),
        samples=sum(max(len(r.points), samples) for r in runs),
        episodes=evaluations,
        steps=0,
        invalid=invalid,
        modes=None,
        reliable=not found,
        warnings=(*found, LOST),
        history=history,
    )


def by_levels(
    key: jax.Array, sim: Simulator, budget: int, log_mean: float, level: float, reasons: list[str]
) -> Estimate | None:
    """The `Estimate` of populations for ``budget`` evaluations, where ``log_mean`` is about what
    they will find; None where the budget is too small.
    """
    levels = max(log_mean, -690.0) / math.log(QUANTILE) + 2
    size = int(budget / REPLICATES / (levels + LAST + 1))
    if size < LEAST:
        return None
    runs = [
        explore(k, sim, size, least=-690.0, most=budget // REPLICATES)
        for k in jax.random.split(key, REPLICATES)
    ]
    if not any(r.reached for r in runs):
        return None
    words = f"this is the answer of subset simulation, {REPLICATES} populations of {size}"
    return of_populations("failure_probability", runs, size, level, [*reasons, words])


def _student(degrees, level):
    """The quantile of Student's t over that of the normal distribution (Cornish and Fisher's
    expansion; to 2 % from 2 degrees on).
    """
    from statistics import NormalDist

    z = NormalDist().inv_cdf((1 + level) / 2)
    terms = (
        (z**3 + z) / 4 / degrees
        + (5 * z**5 + 16 * z**3 + 3 * z) / 96 / degrees**2
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384 / degrees**3
    )
    return 1 + terms / z
