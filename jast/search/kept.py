"""The best distinct episodes that a search has seen so far, in arrays of a fixed size."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import rewards
from jast.episode import Episode
from jast.outline import outline
from jast.search import lockstep as E
from jast.simulator import Simulator

__all__ = ["Kept", "best_of", "likelihood", "merged", "none"]


class Kept(NamedTuple):
    """K episodes, the best first: failures by falling reward, then the others, the nearest
    first.
    """

    episode: Episode
    """Leading axis [K], without states."""
    value: Any
    """[K] what they rank by: the reward of a failure, less the distance of another; -inf where
    there are fewer."""
    tag: Any
    """[K] uint32: a hash of the disturbances."""
    number: Any
    """[K] int32: which episode of the search was the first of these disturbances."""
    count: Any
    """[K] int32: how often they were found."""
    mark: Any = ()
    """[K, ...]: what a search wants to know of them."""


def likelihood(sim: Simulator) -> rewards.Standard:
    """The reward of searches that want failures alone, and of these the likeliest: log p of a
    failure, relative to the mode where the disturbances of ``sim`` have modes.
    """
    return rewards.standard(density=outline(sim).density)


def none(sim: Simulator, k: int, mark: Any = ()) -> Kept:
    """No episode yet. ``mark``: of one, shapes and dtypes."""
    episode, whole = E.blank(sim, k), np.zeros(k, np.int32)
    mark = jax.tree.map(lambda s: np.zeros((k, *s.shape), s.dtype), mark)
    return Kept(episode, episode.reward, whole.astype(np.uint32), whole, whole, mark)


def merged(kept: Kept, played: E.Played, live: Any, number: Any, mark: Any = ()) -> Kept:
    """``kept`` and the ``live`` [n] ones of the episodes ``played``, as many as there were."""
    e = played.episode
    good = live & ~played.invalid
    value = jnp.where(good, jnp.where(e.failure, e.reward, -e.distance), -jnp.inf)
    times = jnp.ones_like(number)
    new = Kept(e, value.astype(kept.value.dtype), played.tag, number, times, mark)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b.astype(a.dtype)]), kept, new)
    (k,), (n,) = kept.tag.shape, both.tag.shape
    rank = both.episode.failure, both.value
    places, counts = E.distinct(*rank, both.tag, both.number, both.count, k)
    taken = jax.tree.map(lambda a: a.at[places].get(mode="fill", fill_value=0), both)
    return taken._replace(value=jnp.where(places < n, taken.value, -jnp.inf), count=counts)


@jax.jit
def best_of(kept: Kept) -> jax.Array:
    """The reward of the best episode: [1], as of one tree."""
    return jnp.where(kept.value[:1] > -jnp.inf, kept.episode.reward[:1], -jnp.inf)


def failures_of(kept: Kept, top: int) -> tuple[Episode, Any, Any]:
    """On the host: the failures among the ``top`` best, their numbers and counts."""
    kept = jax.device_get(kept)
    rows = (kept.value > -jnp.inf) & kept.episode.failure
    n = min(int(rows.sum()), top)
    return jax.tree.map(lambda a: a[:n], (kept.episode, kept.number, kept.count))


def result(
    sim: Simulator, reward: Any, log: E.Log, kept: Kept, settings: dict[str, Any], top: int
) -> Any:
    """The `SearchResult` of a search of one tree."""
    episodes, number, count = failures_of(kept, top)
    best = jax.tree.map(lambda a: a[0], jax.device_get(kept.episode))
    zeros = [0] * len(number)
    return E.finish(sim, reward, log, best, episodes, zeros, number, count, settings, top)
