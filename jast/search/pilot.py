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

from jast import actions as choices
from jast import failures as archive
from jast._jax import is_tracing, jit
from jast._threads import run_in_thread
from jast.counter import tree_keys
from jast.episode import Episode, play_back
from jast.incidents import runs_on_host
from jast.outline import outline
from jast.rewards import LogLikelihood
from jast.search import lockstep as E
from jast.search.result import SearchResult
from jast.simulator import Simulator

__all__ = ["Pilot", "fly", "joined"]

EPISODES, HOSTED = 128, 10
"""Of a batch; of a system on the host, where episodes are dear."""
WIDTHS, FAILING, NEAREST = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0), 0.01, 0.1
"""The widths that are tried; the share that is to fail, from which a search goes on (more noise
found less likely failures); the share of episodes that are near.
"""


class Pilot(NamedTuple):
    """What the episodes showed."""

    near: Any
    """Median of the plain episodes' miss distance, of those above 0; 1 where there is none."""
    rare: Any
    """Median of how far their log p is below ``likely``, of those above 0; 1 where there is
    none.
    """
    likely: Any
    width: Any
    """For `jast.actions.wide`."""
    episodes: Episode
    """[WIDTHS * EPISODES, ...] all of them; those of widths that were not tried have length 0."""
    tally: E.Tally


def fly(sim: Simulator, density: str, widen: str) -> Pilot:
    """Run plain episodes of ``sim``, and wider ones till enough of them fail.

    Args:
        sim: the system.
        density: "mode" or "raw", in which ``rare`` and ``likely`` are told.
        widen: "never": the width is 1; "always": till a hundredth fails; "blind": only where
            nothing else points to failures, as all plain episodes have one miss distance.
    """
    widths = 1 if widen == "never" else len(WIDTHS)
    host = runs_on_host(sim)
    run = lambda: _fly(sim, density, widths, widen == "blind", HOSTED if host else EPISODES)
    return (
        run_in_thread(lambda: jax.block_until_ready(run())) if host and not is_tracing() else run()
    )


@partial(jit, static_argnames=("density", "widths", "blind", "lanes"))
def _fly(sim: Simulator, density: str, widths: int, blind: bool, lanes: int) -> Pilot:
    key, like = tree_keys(jax.random.key(0), 1)[0], outline(sim)
    reward = LogLikelihood(density)
    live, number = jnp.ones((lanes,), bool), jnp.arange(lanes, dtype=jnp.int32)
    table = jnp.asarray(WIDTHS[:widths], like.dtype)

    def batch(i: Any) -> E.Played:
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, i * lanes + number)
        wide = choices.wide(table[i]) if widths > 1 else choices.samples()
        of = lambda draw: lambda key, row, dist: draw(key, dist)
        return E.play(sim, reward, keys, of(wide.draw_start), of(wide.draw), live, record=True)

    def body(carry: Any) -> Any:
        i, _, shares, nearest, episodes, tally = carry
        played = batch(i)
        e = played.episode
        share = jnp.mean(e.failure, dtype=like.dtype)
        ordered = jnp.sort(jnp.where(e.failure, 0, e.distance))
        enough = share >= FAILING
        if blind:
            most = jnp.max(jnp.where(jnp.isfinite(e.distance), e.distance, -jnp.inf))
            enough |= most > jnp.min(jnp.where(e.failure, jnp.inf, e.distance))
        return (
            i + 1,
            enough,
            shares.at[i].set(share),
            nearest.at[i].set(ordered[int(NEAREST * (lanes - 1))]),
            jax.tree.map(
                lambda all, new: lax.dynamic_update_slice_in_dim(all, new, i * lanes, 0),
                episodes,
                e,
            ),
            E.add(tally, E.tally(played, live, i * lanes + number)),
        )

    none = jnp.zeros((widths,), like.dtype)
    start = (
        jnp.int32(0),
        jnp.zeros((), bool),
        none - 1,
        none + jnp.inf,
        E.blank(sim, widths * lanes),
        E.nothing(),
    )
    tried, enough, shares, nearest, episodes, tally = lax.while_loop(
        lambda c: (c[0] < widths) & ~c[1], body, start
    )
    best = jnp.where(jnp.any(shares > 0), jnp.argmax(shares), jnp.argmin(nearest))
    plain = jax.tree.map(lambda a: a[:lanes], episodes)
    log_p, distance = plain.reward, plain.distance
    likely = jnp.zeros((), like.dtype) if density == "mode" else jnp.max(log_p)
    likely = jnp.where(jnp.isfinite(likely), likely, 0)
    return Pilot(
        _median(jnp.where(plain.failure, 0, distance)),
        _median(jnp.where(jnp.isfinite(log_p), likely - log_p, 0)),
        likely,
        table[jnp.where(enough, tried - 1, best.astype(jnp.int32))],
        episodes,
        tally,
    )


def _median(values: jax.Array) -> jax.Array:
    """The (lower) median of those above 0 and finite, one of them, so that it has their unit to the
    bit; 1 where there is none.
    """
    counts = (values > 0) & jnp.isfinite(values)
    n = jnp.sum(counts, dtype=jnp.int32)
    middle = jnp.sort(jnp.where(counts, values, jnp.inf))[jnp.maximum(n - 1, 0) // 2]
    return jnp.where(n > 0, middle, 1)


def joined(
    sim: Simulator, reward: Any, pilot: Pilot | None, found: SearchResult, top: int
) -> SearchResult:
    """The `SearchResult` with the pilot's episodes: they stand before all others, and their
    failures are those of tree -1.
    """
    if pilot is None:
        return found
    n, own = pilot.tally, _best(sim, reward, pilot.episodes)
    if found.failures is None:  # traced
        later = jnp.where(found.first_failure < 0, -1, found.first_failure + n.episodes)
        found = found._replace(
            first_failure=jnp.where(n.first < E.NEVER, n.first, later),
            best=_better(own, found.best),
        )
    else:
        n, own = jax.device_get((n, own))
        n = E.Tally(*(int(v) for v in n[:5]), n.failing)
        later = None if found.first_failure is None else found.first_failure + n.episodes
        found = found._replace(
            first_failure=n.first if n.first < E.NEVER else later,
            best=jax.device_get(_better(own, found.best)),
        )
    if found.failures is not None and n.failures:
        where = np.full(len(pilot.episodes.length), -1, np.int32)
        more = archive.collect(sim, reward, pilot.episodes, where, seen=n.failures, top=top)
        found = found._replace(failures=archive.merge(found.failures, more, top=top))
    episodes, failing = found.episodes + n.episodes, found.failing + n.failures
    return found._replace(
        episodes=episodes,
        steps=found.steps + n.steps,
        failing=failing,
        failing_share=failing / episodes,
        invalid=found.invalid + n.invalid,
    )


@jax.jit
def _best(sim: Simulator, reward: Any, episodes: Episode) -> Episode:
    """The best of the pilot's, likeliest of those that failed or else nearest, as it replays."""
    e = episodes
    score = jnp.where(e.failure, e.reward, -e.distance)
    i = jnp.argmax(jnp.where(e.failure | ~jnp.any(e.failure), score, -jnp.inf))
    x0, x, length = jax.tree.map(lambda a: a[i], (e.x0, e.disturbances, e.length))
    return play_back(sim, reward, x0, x, length)


@jax.jit
def _better(a: Episode, b: Episode) -> Episode:
    """The one that failed, or else has the higher reward; ``b`` where they are equal."""
    first = (a.failure & ~b.failure) | ((a.failure == b.failure) & (a.reward > b.reward))
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), a, b)
