"""nominal: what the system does when nobody searches. The baseline that every search and estimate
is compared with.
"""

import math
import time
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast import distributions as D
from jast import results, rewards
from jast._checks import random_key
from jast._threads import apart
from jast.contract import contract
from jast.episode import Episode, rollout
from jast.incidents import incidents, since
from jast.intervals import clopper_pearson
from jast.outline import outline
from jast.policy import undisturbed
from jast.progress import advance, begin, conclude
from jast.watch import Watch, in_pieces

__all__ = ["nominal"]

LANES = 1024
PIECE = 0.2
"""Seconds between two looks at the keyboard, about; at least `LANES` episodes."""


@results.result("episodes")
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
    """failing / episodes."""
    interval: tuple[float, float]
    """95 % Clopper-Pearson interval of the failure probability."""
    mean_distance: float
    """Mean miss distance over the valid episodes; NaN where there are none."""
    invalid: int
    """Episodes in which the simulator returned a number that is not finite; they count as not
    failing.
    """
    first: int | None = None
    """Number of the first episode that failed, which ``rollout(jax.random.fold_in(key, first),
    sim)`` plays again; None where none did.
    """
    settings: Mapping = {}
    """``method``, ``seed``, the ``episodes`` asked for, and ``interrupted`` where not all were
    played.
    """

    failures = results.former("failures", "failing")

    def __str__(self):
        quiet = "not defined: a disturbance has neither a mode nor a median"
        if self.undisturbed is not None:
            quiet = (
                f"{'FAILS' if self.undisturbed.failure else 'no failure'}, distance"
                f" {self.undisturbed.distance:.4g}, {self.undisturbed.length} steps"
            )
        low, high = self.interval
        rows = [
            ("undisturbed", quiet),
            ("failures", f"{self.failing} of {self.episodes} episodes"),
            ("rate", f"{self.rate:.4g}   95 % [{low:.4g}, {high:.4g}]"),
            ("mean distance", f"{self.mean_distance:.4g}"),
            ("invalid", f"{self.invalid}"),
        ]
        if "interrupted" in self.settings:
            rows.append(("interrupted", self.settings["interrupted"]))
        return "\n".join(f"{name:<14} {text}" for name, text in rows)


def nominal(key, sim, episodes=100_000, *, progress=False, callback=None):
    """How does the system do when nobody searches? Simulate it under its own disturbance model:
    `Nominal`, the undisturbed outcome and the failure rate with its exact interval.

    Of the three that draw from the model alone, this one keeps no episode and asks nothing of a
    reward; `jast.search.monte_carlo` keeps the best failures, and `jast.estimate.monte_carlo` gives
    an `Estimate`, to be compared with those of other estimators.

    The key is consumed; episode i is ``rollout(jax.random.fold_in(key, i), sim)``. Memory does not
    grow with ``episodes``. ``progress=True`` shows a bar; ``callback(done, total, None)`` is called
    now and then. Warns (UserWarning) where the system fails undisturbed and where
    episodes are invalid. A KeyboardInterrupt ends it with the result of the episodes played by
    then, and is raised where there are none. Raises ValueError for ``episodes`` below 1 and where
    the simulator's functions do not fit together.
    """
    random_key("nominal", key)
    if isinstance(episodes, bool) or int(episodes) != episodes or not 1 <= episodes < 2**31:
        raise ValueError(
            f"nominal: episodes must be a whole number from 1 to 2^31 - 1, received {episodes!r}"
        )
    contract(sim, observed=False)
    asked, before = int(episodes), incidents(sim)
    about = outline(sim)
    calm = about.start.mode and about.disturbance.mode
    quiet = rollout(key, sim, undisturbed(sim)) if calm else None  # draws nothing
    episodes, (failures, invalid, mean, first) = _played(
        key, sim, asked, Watch("nominal", asked, "episode", progress, callback)
    )
    settings = results.asked("nominal", key, episodes=asked)
    if episodes < asked:
        settings["interrupted"] = f"after {episodes} of {asked} episodes"
    if quiet is not None and bool(quiet.failure):
        warnings.warn(
            "the system fails undisturbed: its likeliest disturbances already lead to a failure, so"
            " a search for failures has nothing to find out",
            stacklevel=2,
        )
    if invalid:
        said = (
            f"{invalid} of {episodes} nominal episodes are invalid: the simulator returned a number"
            " that is not finite; they count as not failing"
        )
        warnings.warn("\n  ".join([said, *map(str, since(before, incidents(sim)))]), stacklevel=2)
    return Nominal(
        quiet,
        failures,
        episodes,
        failures / episodes,
        clopper_pearson(failures, episodes),
        mean if invalid < episodes else math.nan,
        invalid,
        first if failures else None,
        settings,
    )


def _played(key, sim, episodes, watch):
    """How many episodes were played, all unless interrupted, and of these: failures, invalid ones,
    the mean distance of the valid ones, and the number of the first failure.
    """
    zero = jnp.zeros((), jnp.int32)
    counts = zero, zero, jnp.zeros((), outline(sim).dtype), jnp.asarray(episodes, jnp.int32)

    played = lambda chunks: min(chunks * LANES, episodes)

    def work(counts, begin, end):
        bounds = (jnp.asarray(n, jnp.int32) for n in (episodes, begin, end))
        return apart(lambda: jax.block_until_ready(_count(key, sim, *bounds, counts, LANES)))

    counts, done = in_pieces(work, counts, _ends(-(-episodes // LANES)), watch, played)
    failures, invalid, mean, first = jax.device_get(counts)
    return played(done), (int(failures), int(invalid), float(mean), int(first))


def _ends(chunks: int) -> Iterator[int]:
    """Ends of pieces that take about `PIECE`: more chunks at a time while they are quick."""
    done, more = 0, 1
    while done < chunks:
        begin, done = time.perf_counter(), min(done + more, chunks)
        yield done
        if time.perf_counter() - begin < PIECE:
            more *= 2


@partial(jax.jit, static_argnums=6)
def _count(key, sim, episodes, begin, end, counts, lanes):
    """``counts``, (failures, invalid episodes, mean distance of the valid ones, number of the first
    failure), with the chunks ``begin`` to ``end`` of ``lanes`` episodes as well.
    """

    def chunk(i, carry):
        failures, invalid, mean, first = carry
        index = i * lanes + jnp.arange(lanes, dtype=jnp.int32)
        live = index < episodes
        last = jax.vmap(lambda k, on: _outcome(jax.random.fold_in(key, k), sim, on))(index, live)
        valid = live & ~last.invalid
        before = (i * lanes - invalid).astype(mean.dtype)
        count = jnp.sum(valid, dtype=jnp.int32)
        total = jnp.sum(jnp.where(valid, last.distance, 0))
        # a running mean: a running sum would lose digits in float32
        mean = jnp.where(
            count > 0,
            mean
            + (total - count.astype(mean.dtype) * mean)
            / jnp.maximum(before + count.astype(mean.dtype), 1),
            mean,
        )
        failing = live & last.failure
        return (
            failures + jnp.sum(failing, dtype=jnp.int32),
            invalid + jnp.sum(live & last.invalid, dtype=jnp.int32),
            mean,
            jnp.minimum(first, jnp.min(jnp.where(failing, index, episodes))),
        )

    return lax.fori_loop(begin, end, chunk, counts)


def _outcome(key, sim, live):
    """The end of the episode that `rollout` plays with ``key``, without its rows; not played where
    ``live`` is False.
    """
    reward = rewards.standard()
    keys = jax.random.split(key, sim.horizon + 1)
    first = begin(sim, reward, D.sample(sim.start(), keys[0]))

    def step(carry):
        progress, t = carry
        # each once: JAX's check of reused keys cannot see that
        x = D.sample(sim.disturbance(progress.state), jax.random.clone(keys[t + 1]))
        return advance(sim, reward, progress, x, t + 1 >= sim.horizon), t + 1

    first = first._replace(done=first.done | ~jnp.asarray(live))
    last, _ = lax.while_loop(lambda c: ~c[0].done, step, (first, jnp.zeros((), jnp.int32)))
    return conclude(sim, reward, last, live)
