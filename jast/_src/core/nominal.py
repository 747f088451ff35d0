"""nominal: what the system does when nobody searches. The baseline that every search and estimate
is compared with.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core import rewards
from jast._src.core.contract import contract
from jast._src.core.episode import Episode, rollout
from jast._src.core.policy import undisturbed
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.transition import Progress, advance, begin, conclude
from jast._src.core.typing import Array, Callback, Executor, PathLike, PRNGKey
from jast._src.runtime import work
from jast._src.runtime._jax import jit, quick
from jast._src.runtime.backends import Task, UnitContext
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.host_errors import incidents, merge_incidents, new_incidents
from jast._src.runtime.progress_bar import Watch
from jast._src.util import display
from jast._src.util.checks import check_random_key, whole_number
from jast._src.util.intervals import clopper_pearson
from jast._src.util.pytrees import with_rows_of, zero_where

__all__ = ["Nominal", "describe_undisturbed", "nominal", "outcome", "rate_of"]

BRIEF = 4096
"""Episodes up to which the program is compiled quickly, as it runs briefly: on the ferry and three
closed loops that takes .4 CPU seconds in place of 2.8, and the episodes .08 to .9 in place of .02
to .2.
"""
LANES = 1024  # episodes of a chunk, which run side by side
UNITS = 64  # of a call, about: enough for the cores of a machine, few enough to be kept one by one
CHUNKS = 64  # of a unit at most: the size of what it returns


@display.result_class("episodes")
class Nominal(NamedTuple):
    """What `nominal` found: Python numbers and one `Episode`."""

    undisturbed: Episode | None
    """The episode of every disturbance at its mode, else its median; None where a distribution has
    neither.
    """
    failing: int
    """Episodes that failed."""
    episodes: int
    """Episodes simulated."""
    rate: float
    """failing / episodes; NaN where all are invalid."""
    interval: tuple[float, float]
    """95 % Clopper-Pearson interval of the failure probability; (0, 1) where all are invalid."""
    mean_distance: float
    """Mean miss distance over the valid episodes; NaN where there are none."""
    invalid: int
    """Episodes in which the simulator returned a number that is not finite; they count as not
    failing.
    """
    first: int | None = None
    """Number of the first episode that failed, which ``rollout(jax.random.fold_in(key, first),
    sim)`` plays again; None where none did, and of a `jast.stress`, whose failures are its own.
    """
    settings: Mapping[str, Any] = {}
    """``method``, ``seed``, the ``episodes`` asked for, and ``interrupted`` where not all were
    played.
    """

    @display.Former
    def failures(self) -> int:
        """Deprecated: ``failing``."""
        return display.renamed(self, "failures", "failing")

    def __str__(self) -> str:
        low, high = self.interval
        rows = [
            ("undisturbed", describe_undisturbed(self.undisturbed)),
            ("failures", f"{self.failing} of {self.episodes} episodes"),
            ("rate", f"{self.rate:.4g}   95 % [{low:.4g}, {high:.4g}]"),
            ("mean distance", f"{self.mean_distance:.4g}"),
            ("invalid", f"{self.invalid}" + ", all: nothing is known" * math.isnan(self.rate)),
        ]
        if "interrupted" in self.settings:
            rows.append(("interrupted", self.settings["interrupted"]))
        return "\n".join(f"{name:<14} {text}" for name, text in rows)


def describe_undisturbed(e: Episode | None) -> str:
    """What the undisturbed episode came to, or why there is none."""
    if e is None:
        return "not defined: a disturbance has neither a mode nor a median"
    outcome = "FAILS" if bool(e.failure) else "no failure"
    if not np.isfinite(e.distance):
        outcome = "INVALID: its distance is not finite"
    return f"{outcome}, distance {float(e.distance):.4g}, {int(e.length)} steps"


def nominal(
    key: PRNGKey,
    sim: Simulator,
    episodes: int = 100_000,
    *,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Nominal:
    """How does the system do when nobody searches? Simulate it under its own disturbance model: the
    undisturbed outcome, and the failure rate with its exact interval.

    Three functions draw from the model alone. This one keeps no episode and needs no reward;
    `jast.search.monte_carlo` keeps the best failures; `jast.estimate.monte_carlo` gives an
    `Estimate` to be compared with those of other estimators.

    Episode i is ``rollout(jax.random.fold_in(key, i), sim)``. Memory does not grow with
    ``episodes``. Warns (UserWarning) where the system fails undisturbed and where episodes are
    invalid. A KeyboardInterrupt ends the work with the result of the episodes played by then, and
    is raised where there are none.

    Args:
        key: consumed.
        sim: the simulator.
        episodes: how many to simulate, at least 1.
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` now and then.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Nominal`: print it.

    Raises:
        ValueError: for ``episodes`` below 1, and where the simulator's functions do not fit
            together.

    Example:
        >>> import jax, jast
        >>> found = jast.nominal(jax.random.key(0), jast.simulators.walk1d(), 1000)
        >>> found.episodes, 0.0 < found.rate < 0.2
        (1000, True)
    """
    check_random_key("nominal", key)
    asked = whole_number("nominal", "episodes", episodes, bits=31)
    contract("nominal", sim)
    placement = work.placement("nominal", executor, devices)
    before = incidents(sim)
    calm = signature_of(sim).has_mode
    quiet = rollout(key, sim, undisturbed(sim)) if calm else None  # draws nothing
    with (
        open_checkpoint("nominal", checkpoint, key, sim=sim, episodes=asked) as store,
        Watch("nominal", asked, "episode", progress, callback) as watch,
    ):
        ran = _play(key, sim, asked, watch, placement._replace(store=store))
    episodes, failures, invalid, mean, first = ran.state
    before = new_incidents(before, incidents(sim)), ran.incidents
    settings = display.call_settings("nominal", key, episodes=asked)
    if short := work.describe_missing("episodes", ran, episodes, asked):
        settings["interrupted"] = short
    if quiet is not None and bool(quiet.failure):
        warnings.warn(
            "the system fails undisturbed: its likeliest disturbances already lead to a failure,"
            " so a search for failures can find nothing new",
            stacklevel=2,
        )
    if invalid:
        said = (
            f"{invalid} of {episodes} nominal episodes are invalid: the simulator returned a number"
            " that is not finite; they count as not failing"
        )
        warnings.warn("\n  ".join([said, *map(str, merge_incidents(*before))]), stacklevel=2)
    rate, interval = rate_of(failures, invalid, episodes)
    return Nominal(
        undisturbed=quiet,
        failing=failures,
        episodes=episodes,
        rate=rate,
        interval=interval,
        mean_distance=float(mean) if invalid < episodes else math.nan,
        invalid=invalid,
        first=first,
        settings=settings,
    )


def rate_of(failing: int, invalid: int, episodes: int) -> tuple[float, tuple[float, float]]:
    """The rate and the interval of a `Nominal`."""
    if invalid == episodes:
        return math.nan, (0.0, 1.0)
    return failing / episodes, clopper_pearson(failing, episodes)


class Job(NamedTuple):
    """What all units of a call have in common."""

    key: PRNGKey
    sim: Simulator
    episodes: int
    chunks: int
    """Of a unit."""


class Counts(NamedTuple):
    """Of the chunks of a unit, [CHUNKS]; zeros where it has fewer."""

    failures: Array
    invalid: Array
    valid: Array
    distance: Array
    """Sum over the valid ones."""
    first: Array
    """Number of the first failure; that of all episodes where there is none."""


class Seen(NamedTuple):
    """What is known of the first episodes."""

    episodes: int
    failures: int
    invalid: int
    mean: np.ndarray
    """Miss distance of the valid ones."""
    first: int | None


def _play(
    key: PRNGKey, sim: Simulator, episodes: int, watch: Watch, where: work.Placement
) -> work.UnitsRun:
    """`runtime.work.UnitsRun` with `Seen` of all episodes, unless interrupted."""
    chunks = -(-episodes // LANES)
    job = Job(key, sim, episodes, min(-(-chunks // UNITS), CHUNKS))
    seen = Seen(0, 0, 0, np.zeros((), signature_of(sim).dtype), None)
    task = Task(_unit, job, lambda: Counts(*Counts._fields))

    def episodes_of(done: int) -> int:
        return min(done * job.chunks * LANES, episodes)

    n = -(-chunks // job.chunks)
    return work.run(task, n, _add, seen, watch, where, size=episodes_of)


def _unit(job: Job, number: int, context: UnitContext) -> Counts:
    end = min((number + 1) * job.chunks, -(-job.episodes // LANES))
    bounds = job.episodes, number * job.chunks, end
    count = _count_quickly if job.episodes <= BRIEF else _count
    return count(job.key, job.sim, *(np.int32(n) for n in bounds))


def _add(seen: Seen, number: int, counts: Counts) -> Seen:
    """``seen`` with the chunks of a unit as well."""
    mean, valid = seen.mean, seen.episodes - seen.invalid
    for count, total in zip(counts.valid, counts.distance, strict=True):
        if count:
            valid += int(count)
            # a running mean: a running sum would lose digits in float32
            step = (total - mean.dtype.type(count) * mean) / mean.dtype.type(valid)
            mean = mean + step
    failures = seen.failures + int(counts.failures.sum())
    invalid = seen.invalid + int(counts.invalid.sum())
    first, failing = seen.first, counts.failures > 0
    if first is None and failing.any():
        first = int(counts.first[failing].min())
    return Seen(valid + invalid, failures, invalid, mean, first)


def _counts(key, sim, episodes, begin, end):
    """`Counts` of the chunks ``begin`` to ``end - 1`` of `LANES` episodes."""

    def chunk(i, counts):
        index = i * LANES + jnp.arange(LANES, dtype=jnp.int32)
        live = (index < episodes) & (index >= 0)

        def play(number, live):
            return outcome(jax.random.fold_in(key, number), sim, live, rewards.STANDARD)[0]

        last = jax.vmap(play)(index, live)
        valid, failing = live & ~last.invalid, live & last.failure
        new = Counts(
            jnp.sum(failing, dtype=jnp.int32),
            jnp.sum(live & last.invalid, dtype=jnp.int32),
            jnp.sum(valid, dtype=jnp.int32),
            jnp.sum(jnp.where(valid, last.distance, 0)).astype(counts.distance.dtype),
            jnp.min(jnp.where(failing, index, episodes)),
        )
        return jax.tree.map(lambda a, b: a.at[i - begin].set(b), counts, new)

    none = jnp.zeros((CHUNKS,), jnp.int32)
    counts = Counts(none, none, none, jnp.zeros((CHUNKS,), signature_of(sim).dtype), none)
    return lax.fori_loop(begin, end, chunk, counts)


_count, _count_quickly = jit(_counts), quick(_counts)


def outcome(key: Any, sim: Any, live: Any, reward: Callable) -> tuple[Progress, Any]:
    """The end of the episode that `rollout` plays with ``key``, without its rows, and its steps;
    not played where ``live`` is False.
    """
    keys = jax.random.split(key, sim.horizon + 1)
    first = begin(sim, reward, D.sample(sim.start(), keys[0]))

    def step(carry):
        progress, t = carry
        # each once: JAX's check of reused keys cannot see that
        x = D.sample(sim.disturbance(progress.state), jax.random.clone(keys[t + 1]))
        return advance(sim, reward, progress, x, t + 1 >= sim.horizon), t + 1

    live = jnp.asarray(live)
    # of a state of zeros no black box is asked, whatever the lanes beside it go on with
    first = first._replace(done=first.done | ~live, state=zero_where(~live, first.state))
    start = with_rows_of(live, (first, jnp.zeros((), jnp.int32)))
    last, steps = lax.while_loop(lambda c: ~c[0].done, step, start)
    return conclude(sim, reward, last, live), steps
