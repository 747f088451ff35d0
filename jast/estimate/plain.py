"""The model's own draws, counted: crude Monte Carlo."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import units
from jast._checks import check_random_key, whole_number
from jast._jax import jit
from jast.checkpoints import open_checkpoint
from jast.contract import contract
from jast.crude import outcome
from jast.estimate.batches import plain_chunk, rows_of
from jast.estimate.draws import drawn_by
from jast.estimate.estimate import Estimate, of_counts
from jast.estimate.importance_sampling import Traces, chunks
from jast.incidents import runs_on_host
from jast.intervals import checked_level
from jast.judge import judged
from jast.outline import outline
from jast.results import call_settings
from jast.rewards import log_likelihood
from jast.watch import Watch

if TYPE_CHECKING:
    import chex

    from jast.simulator import Simulator
    from jast.typing import Callback, Executor, PathLike

__all__ = ["episode_keys", "lanes_of_points", "monte_carlo", "of_points"]

LANES = 16384
"""Episodes of a unit of work that are drawn by keys."""
BLOCK = 128
"""Episodes that run side by side: their states then stay in the caches of a core."""


def monte_carlo(
    key: chex.PRNGKey,
    sim: Simulator,
    samples: int = 100_000,
    *,
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Estimate:
    """How probable is a failure, by counting alone? Crude Monte Carlo, the baseline of estimators:
    an exact interval, and Chernoff's and Jeffreys' upper bounds also where no failure was seen.

    `jast.nominal` is for a first look at a system, and `jast.search.monte_carlo` keeps the
    failures. Where disturbances are cheap functions of normal numbers, these come from a counter
    (`jast.counter`): Threefry would take most of the time of a cheap system. In float32 the normal
    numbers of a step end at 5.42 standard deviations. A KeyboardInterrupt is treated as in
    `importance`.

    Args:
        key: consumed.
        sim: any simulator.
        samples: episodes, at least 1.
        level: of the interval, in (0, 1).
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after each chunk.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Estimate`.

    Raises:
        ValueError: as `importance`.

    Example:
        >>> import jax, jast
        >>> found = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> found.interval[0] < found.mean < found.interval[1]
        True
    """
    name = "monte_carlo"
    check_random_key(name, key)
    samples = whole_number(name, "samples", samples)
    level = checked_level(name, level)
    contract(name, sim)
    by_points = outline(sim).closed
    simulate = of_points if by_points else _of_keys
    lanes = lanes_of_points(sim) if by_points else LANES
    ways = units.placement(name, executor, devices)
    with open_checkpoint(name, checkpoint, key, sim=sim, samples=samples) as store:
        watch = Watch(name, samples, "episode", progress, callback)
        shared = key, sim, lanes, samples
        total, notes, lost = chunks(simulate, shared, lanes, watch, ways._replace(store=store))
    settings = call_settings(name, key, samples=samples, level=level)
    found = of_counts(name, total, level=level, notes=notes, reasons=lost)
    draws = drawn_by(found.draws, key, lanes, "model" if by_points else "keys")
    return found._replace(settings=settings, draws=draws)


def lanes_of_points(sim: Simulator) -> int:
    """Episodes of a unit of `of_points`: fewer where they take many random numbers."""
    return 4 * rows_of(sim)


def of_points(shared: tuple[Any, ...], i: int, post: Any) -> Traces:
    """`Traces` of chunk ``i`` of the model, by normal numbers, in the program of `jast.judge`."""
    key, sim, lanes, samples = shared
    n = min(lanes, samples - i * lanes)
    o, none = judged(sim, plain_chunk(key, i, n, sim)), np.zeros(n)
    return Traces(none, none[:, None], o.failure, o.invalid, o.length, o.distance)


def episode_keys(key: jax.Array, chunk: int, rows: np.ndarray) -> jax.Array:
    """The keys of the episodes ``rows`` [m] of a chunk, which `jast.rollout` takes."""
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.fold_in(key, chunk), rows)


def _of_keys(shared, i, post):
    """As `of_points`, by draws of distributions without a quantile function in closed form."""
    key, sim, lanes, samples = shared
    n = min(lanes, samples - i * lanes)
    size = n if runs_on_host(sim) else BLOCK  # of a system on the host no episode is run in vain
    out = jax.device_get(_played(jax.random.fold_in(key, i), sim, np.int32(n), size))
    failure, invalid, length, distance = (a[:n] for a in out)
    none = np.zeros(n)
    return Traces(none, none[:, None], failure, invalid, length, distance)


@partial(jit, static_argnames="size")
def _played(key, sim, n, size):
    """(failure, invalid, length, distance) [LANES] of the first ``n`` episodes of a chunk, ``size``
    of them side by side; of the others what is left of their blocks.
    """

    def block(i, out):
        number = i * size + jnp.arange(size, dtype=jnp.int32)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, number)
        end, length = jax.vmap(lambda k, live: outcome(k, sim, live, log_likelihood))(
            keys, number < n
        )
        new = end.failure, end.invalid, length, end.distance
        return tuple(lax.dynamic_update_slice(a, b, (i * size,)) for a, b in zip(out, new))

    none = jnp.zeros(LANES, bool)
    start = none, none, jnp.zeros(LANES, jnp.int32), jnp.zeros(LANES, outline(sim).dtype)
    return lax.fori_loop(0, (n + size - 1) // size, block, start)
