"""The model's own draws, counted: crude Monte Carlo."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.contract import contract
from jast._src.core.nominal import outcome
from jast._src.core.rewards import log_likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, Executor, PathLike, PRNGKey
from jast._src.estimate.estimate import Estimate, estimate_from_counts
from jast._src.estimate.importance_sampling import Traces, chunks
from jast._src.estimate.proposal_search.mixture_draws import plain_chunk, plain_parts, rows_of
from jast._src.estimate.weighted_draws import with_source
from jast._src.normal_space.evaluate_points import evaluate_on_device, evaluate_points
from jast._src.runtime import work
from jast._src.runtime._jax import jit
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.device import block_size
from jast._src.runtime.host_errors import runs_on_host
from jast._src.runtime.progress_bar import Watch
from jast._src.util.checks import check_random_key, whole_number
from jast._src.util.display import call_settings
from jast._src.util.intervals import checked_level
from jast._src.util.pytrees import join_rows

__all__ = ["episode_keys", "lanes_of_points", "monte_carlo", "plain_traces", "simulate_points"]

CHUNK_EPISODES = 16384
"""Episodes of a unit of work that are drawn by keys: a second of a cheap system, or less."""


def monte_carlo(
    key: PRNGKey,
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
    failures. Where disturbances are cheap functions of normal numbers, these come from a counter:
    Threefry would take most of the time of a cheap system. In float32 the
    normal numbers of a step end at 5.42 standard deviations. A KeyboardInterrupt is treated as in
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
    by_points = signature_of(sim).closed
    simulate = simulate_points if by_points else _simulate_keys
    lanes = lanes_of_points(sim) if by_points else CHUNK_EPISODES
    placement = work.placement(name, executor, devices)
    with open_checkpoint(name, checkpoint, key, sim=sim, samples=samples) as store:
        watch = Watch(name, samples, "episode", progress, callback)
        shared = key, sim, lanes, samples
        placement = placement._replace(store=store)
        total, notes, reasons = chunks(simulate, shared, lanes, watch, placement)
    settings = call_settings(name, key, samples=samples, level=level)
    found = estimate_from_counts(name, total, level=level, notes=notes, reasons=reasons)
    draws = with_source(found.draws, key, lanes, "model" if by_points else "keys")
    return found._replace(settings=settings, draws=draws)


def lanes_of_points(sim: Simulator) -> int:
    """Episodes of a unit of `simulate_points`: fewer where they take many random numbers."""
    return 4 * rows_of(sim)


def simulate_points(shared: tuple[Any, ...], i: int, context: Any) -> Traces:
    """`Traces` of chunk ``i`` of the model, by normal numbers, in the program of
    `normal_space.evaluate_points`.
    """
    key, sim, lanes, samples = shared
    n, m = min(lanes, samples - i * lanes), rows_of(sim)
    if runs_on_host(sim):
        o = evaluate_points(sim, plain_chunk(key, i, n, sim))
    else:
        parts = enumerate(plain_parts(key, i, n, sim))
        found = [evaluate_on_device(sim, z, min(m, n - j * m)) for j, z in parts]
        o = join_rows(*found)
    return plain_traces(o.failure, o.invalid, o.length, o.distance)


def episode_keys(key: jax.Array, chunk: int, rows: np.ndarray) -> jax.Array:
    """The keys of the episodes ``rows`` [m] of a chunk, which `jast.rollout` takes."""
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.fold_in(key, chunk), rows)


def _simulate_keys(shared, i, context):
    """As `simulate_points`, where distributions have no quantile function in closed form."""
    key, sim, lanes, samples = shared
    n = min(lanes, samples - i * lanes)
    # of a system on the host no episode is run in vain
    size = n if runs_on_host(sim) else block_size(CHUNK_EPISODES)
    out = jax.device_get(_simulate_chunk(jax.random.fold_in(key, i), sim, np.int32(n), size))
    return plain_traces(*(a[:n] for a in out))


def plain_traces(failure, invalid, length, distance=None):
    """`Traces` [n] of which all weights are 1, of NumPy's arrays."""
    log_weight = np.zeros(len(failure))
    return Traces(
        log_weight=log_weight,
        shares=log_weight[:, None],
        failure=failure,
        invalid=invalid,
        length=length,
        distance=distance,
    )


@partial(jit, static_argnames="size")
def _simulate_chunk(key, sim, n, size):
    """(failure, invalid, length, distance) [CHUNK_EPISODES] of the first ``n`` episodes of a chunk,
    ``size`` of them side by side; of the others what is left of their blocks.
    """

    def one(number):
        end, length = outcome(jax.random.fold_in(key, number), sim, number < n, log_likelihood)
        return end.failure, end.invalid, length, end.distance

    def block(i, out):
        new = jax.vmap(one)(i * size + jnp.arange(size, dtype=jnp.int32))
        return tuple(lax.dynamic_update_slice(a, b, (i * size,)) for a, b in zip(out, new))

    dtypes = bool, bool, jnp.int32, signature_of(sim).dtype
    start = tuple(jnp.zeros(CHUNK_EPISODES, dtype) for dtype in dtypes)
    return lax.fori_loop(0, (n + size - 1) // size, block, start)
