"""nominal: what the system does when nobody searches. The baseline that every search and estimate
is compared with.
"""

import warnings
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast import distributions as D
from jast import results, rewards
from jast.contract import contract
from jast.episode import Episode, rollout
from jast.incidents import incidents, since
from jast.intervals import clopper_pearson
from jast.outline import outline
from jast.policy import undisturbed
from jast.progress import advance, begin, conclude

__all__ = ["Nominal", "nominal"]

LANES = 1024


@results.result("episodes")
class Nominal(NamedTuple):
    """What `nominal` found: Python numbers and one `Episode`."""

    undisturbed: Episode | None
    """The episode of every disturbance at its mode, else its median; None where a distribution has
    neither.
    """
    failures: int
    """Episodes that failed."""
    episodes: int
    """Episodes simulated."""
    rate: float
    """failures / episodes."""
    interval: tuple[float, float]
    """95 % Clopper-Pearson interval of the failure probability."""
    mean_distance: float
    """Mean miss distance over the valid episodes; NaN where there are none."""
    invalid: int
    """Episodes in which the simulator returned a number that is not finite; they count as not
    failing.
    """

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
            ("failures", f"{self.failures} of {self.episodes} episodes"),
            ("rate", f"{self.rate:.4g}   95 % [{low:.4g}, {high:.4g}]"),
            ("mean distance", f"{self.mean_distance:.4g}"),
            ("invalid", f"{self.invalid}"),
        ]
        return "\n".join(f"{name:<14} {text}" for name, text in rows)


def nominal(key, sim, episodes=100_000):
    """Simulate the system under its own disturbance model: `Nominal`, the undisturbed outcome and
    the failure rate with its exact interval.

    The key is consumed; episode i is ``rollout(jax.random.fold_in(key, i), sim)``. Memory does not
    grow with ``episodes``. Warns (UserWarning) where the system fails undisturbed and where
    episodes are invalid. Raises ValueError for ``episodes`` below 1 and where the simulator's
    functions do not fit together.
    """
    if isinstance(episodes, bool) or int(episodes) != episodes or not 1 <= episodes < 2**31:
        raise ValueError(
            f"nominal: episodes must be a whole number from 1 to 2^31 - 1, received {episodes!r}"
        )
    contract(sim, observed=False)
    episodes, before = int(episodes), incidents(sim)
    about = outline(sim)
    calm = about.start.mode and about.disturbance.mode
    quiet = rollout(key, sim, undisturbed(sim)) if calm else None  # draws nothing
    failures, invalid, mean = jax.device_get(
        _count(key, sim, jnp.asarray(episodes, jnp.int32), LANES)
    )
    failures, invalid = int(failures), int(invalid)
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
        float(mean),
        invalid,
    )


@partial(jax.jit, static_argnums=3)
def _count(key, sim, episodes, lanes):
    """Failures, invalid episodes and the mean distance of the valid ones, ``lanes`` episodes at a
    time.
    """

    def chunk(i, carry):
        failures, invalid, mean = carry
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
        return (
            failures + jnp.sum(live & last.failure, dtype=jnp.int32),
            invalid + jnp.sum(live & last.invalid, dtype=jnp.int32),
            mean,
        )

    zero = jnp.zeros((), jnp.int32)
    failures, invalid, mean = lax.fori_loop(
        0, (episodes - 1) // lanes + 1, chunk, (zero, zero, jnp.zeros((), outline(sim).dtype))
    )
    return failures, invalid, jnp.where(invalid < episodes, mean, jnp.nan)


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
