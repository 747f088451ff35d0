"""A few episodes before a search, from which it takes the scales that it was not told: of its
reward (`jast.rewards.lexicographic`) and of its actions (`jast.actions.wide`).

They are a matter of the system alone: the same for every key and every search, so that rewards of
different searches compare.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core import actions
from jast._src.core.counter_prng import tree_keys
from jast._src.core.episode import Episode, play_back
from jast._src.core.failures import collect, merge
from jast._src.core.rewards import LogLikelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.runtime._jax import is_traced, is_tracing, jit
from jast._src.runtime.host_errors import runs_on_host
from jast._src.runtime.jax_settings import run_in_thread
from jast._src.search.lanes import NEVER, Tally, blank_episodes, play_drawn
from jast._src.search.result import SearchResult
from jast._src.util.pytrees import index_tree, select

__all__ = ["Calibration", "calibrate", "with_calibration"]

EPISODES = 128  # episodes of a batch
HOSTED_EPISODES = 10  # episodes of a batch of a system on the host, where they are dear
WIDTHS = 1.0, 1.5, 2.0, 3.0, 4.0, 6.0  # widths of the noise that are tried, in this order
FAILING_SHARE = 0.01
"""Share of failing episodes from which no wider noise is tried: that found less likely failures."""
NEAR_SHARE = 0.1  # where no episode fails, that width is taken of which so many come nearest


class Calibration(NamedTuple):
    """What the episodes showed."""

    near: jax.Array
    """Median of the plain episodes' miss distance, of those above 0; 1 where there is none."""
    rare: jax.Array
    """Median of how far their log p is below ``likely``, of those above 0; 1 where there is
    none.
    """
    likely: jax.Array
    """The greatest log p of theirs; 0 where it is relative to the mode."""
    width: jax.Array
    """For `jast.actions.wide`."""
    episodes: Episode
    """[WIDTHS * EPISODES, ...] all of them; those of widths that were not tried have length 0."""
    tally: Tally


def calibrate(sim: Simulator, density: str, widen: str) -> Calibration:
    """Run plain episodes of ``sim``, and wider ones till enough of them fail.

    Args:
        sim: the system.
        density: "mode" or "raw", in which ``rare`` and ``likely`` are told.
        widen: "never": the width is 1; "always": till a hundredth fails; "blind": only where
            nothing else points to failures, as all plain episodes have one miss distance.
    """
    host = runs_on_host(sim)
    lanes = HOSTED_EPISODES if host else EPISODES
    widths = WIDTHS[:1] if widen == "never" else WIDTHS

    work = partial(_calibrated, sim, density, widths, np.bool_(widen == "blind"), lanes)
    if not host or is_tracing():
        return work()
    return run_in_thread(lambda: jax.block_until_ready(work()))


@partial(jit, static_argnames=("density", "widths", "lanes"))
def _calibrated(
    sim: Simulator, density: str, widths: tuple[float, ...], blind: Any, lanes: int
) -> Calibration:
    key, real = tree_keys(jax.random.key(0), 1)[0], signature_of(sim).dtype
    live, number = jnp.ones((lanes,), bool), jnp.arange(lanes, dtype=jnp.int32)
    table, reward = jnp.asarray(widths, real), LogLikelihood(density)

    def body(carry: Any) -> Any:
        i, _, shares, nearest, episodes, tally = carry
        drawn = actions.wide(table[i]) if len(widths) > 1 else actions.samples()
        order = i * lanes + number
        played = play_drawn(key, sim, reward, drawn, order, live, record=True)
        e = played.episode
        share = jnp.mean(e.failure, dtype=real)
        near = jnp.sort(jnp.where(e.failure, 0, e.distance))[int(NEAR_SHARE * (lanes - 1))]
        enough = share >= FAILING_SHARE
        most = jnp.max(jnp.where(jnp.isfinite(e.distance), e.distance, -jnp.inf))
        enough |= blind & (most > jnp.min(jnp.where(e.failure, jnp.inf, e.distance)))
        put = partial(lax.dynamic_update_slice_in_dim, start_index=i * lanes, axis=0)
        episodes = jax.tree.map(put, episodes, e)
        tally = tally.add(Tally.of(played, live, order))
        return i + 1, enough, shares.at[i].set(share), nearest.at[i].set(near), episodes, tally

    zero, none = jnp.zeros((), jnp.int32), jnp.zeros((len(widths),), real)
    episodes = blank_episodes(sim, len(widths) * lanes)
    tried, enough, shares, nearest, episodes, tally = lax.while_loop(
        lambda c: (c[0] < len(widths)) & ~c[1],
        body,
        (zero, zero > 0, none - 1, none + jnp.inf, episodes, Tally.none()),
    )
    best = jnp.where(jnp.any(shares > 0), jnp.argmax(shares), jnp.argmin(nearest))
    plain = index_tree(episodes, np.s_[:lanes])
    log_p, distance = plain.reward, plain.distance
    likely = jnp.zeros((), real) if density == "mode" else jnp.max(log_p)
    likely = jnp.where(jnp.isfinite(likely), likely, 0)
    return Calibration(
        near=_median(jnp.where(plain.failure, 0, distance)),
        rare=_median(jnp.where(jnp.isfinite(log_p), likely - log_p, 0)),
        likely=likely,
        width=table[jnp.where(enough, tried - 1, best.astype(jnp.int32))],
        episodes=episodes,
        tally=tally,
    )


def _median(values: jax.Array) -> jax.Array:
    """The (lower) median of those above 0 and finite, one of them, so that it has their unit to the
    bit; 1 where there is none.
    """
    counts = (values > 0) & jnp.isfinite(values)
    n = jnp.sum(counts, dtype=jnp.int32)
    middle = jnp.sort(jnp.where(counts, values, jnp.inf))[jnp.maximum(n - 1, 0) // 2]
    return jnp.where(n > 0, middle, 1)


def with_calibration(
    sim: Simulator, reward: Any, calibration: Calibration | None, found: SearchResult, top: int
) -> SearchResult:
    """The `SearchResult` with the episodes of the calibration: they stand before all others, and
    their failures are those of tree -1.
    """
    if calibration is None:
        return found
    n, e = calibration.tally, calibration.episodes
    if found.failures is None:  # traced
        best = _better(_best(sim, reward, e, jnp), found.best)
        later = jnp.where(found.first_failure < 0, -1, found.first_failure + n.episodes)
        first = jnp.where(n.first < NEVER, n.first, later)
    else:
        n, e = jax.device_get((n, e))
        best = _better(jax.device_get(_best(sim, reward, e, np)), found.best)
        n = Tally(*(int(v) for v in n[:5]), n.failing)
        later = None if found.first_failure is None else found.first_failure + n.episodes
        first = n.first if n.first < NEVER else later
        if n.failures:
            trees = np.full(len(e.length), -1, np.int32)
            more = collect(sim, reward, e, trees, seen=n.failures, top=top)
            found = found._replace(failures=merge(found.failures, more, top=top))
    episodes, failing = found.episodes + n.episodes, found.failing + n.failures
    return found._replace(
        best=best,
        first_failure=first,
        episodes=episodes,
        steps=found.steps + n.steps,
        failing=failing,
        failing_share=failing / episodes,
        invalid=found.invalid + n.invalid,
    )


def _best(sim: Simulator, reward: Any, e: Episode, numpy: Any) -> Episode:
    """The best of the episodes, likeliest of those that failed or else nearest, as it replays;
    ``numpy``: NumPy, or that of JAX.
    """
    score = numpy.where(e.failure, e.reward, -e.distance)
    i = numpy.argmax(numpy.where(e.failure | ~numpy.any(e.failure), score, -numpy.inf))
    x0, x, length = index_tree((e.x0, e.disturbances, e.length), i)
    return play_back(sim, reward, x0, x, length)


def _better(a: Episode, b: Episode) -> Episode:
    """The one that failed, or else has the higher reward; ``b`` where they are equal."""
    first = (a.failure & ~b.failure) | ((a.failure == b.failure) & (a.reward > b.reward))
    return select(first, a, b) if is_traced(first) else a if first else b
