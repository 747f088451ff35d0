"""The best distinct episodes that a search has seen so far, in arrays of a fixed size."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core import rewards
from jast._src.core.episode import Episode
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import ArrayTree
from jast._src.search.driver import Log, finish
from jast._src.search.lanes import Played, blank_episodes, distinct_episodes, take_rows
from jast._src.search.result import SearchResult
from jast._src.util.pytrees import index_tree

__all__ = ["BestEpisodes", "standard_reward"]


class BestEpisodes(NamedTuple):
    """K episodes, the best first: failures by falling reward, then the others, the nearest
    first.
    """

    episode: Episode
    """Leading axis [K], without states."""
    value: jax.Array
    """[K] what they rank by: the reward of a failure, less the distance of another; -inf where
    there are fewer."""
    tag: jax.Array
    """[K] uint32: a hash of the disturbances."""
    number: jax.Array
    """[K] int32: which episode of the search was the first of these disturbances."""
    count: jax.Array
    """[K] int32: how often they were found."""
    mark: ArrayTree = ()
    """[K, ...]: what a search wants to know of them."""

    @classmethod
    def none(cls, sim: Simulator, k: int, mark: Any = ()) -> "BestEpisodes":
        """No episode yet. ``mark``: of one, shapes and dtypes."""
        e, zero = blank_episodes(sim, k), np.zeros(k, np.int32)
        mark = jax.tree.map(lambda s: np.zeros((k, *s.shape), s.dtype), mark)
        return cls(e, e.reward, zero.astype(np.uint32), number=zero, count=zero, mark=mark)

    def merge(
        self, played: Played, live: jax.Array, number: jax.Array, mark: Any = ()
    ) -> "BestEpisodes":
        """These and the ``live`` [n] ones of the episodes ``played``, as many as there were."""
        e, once = played.episode, jnp.ones_like(number)
        value = jnp.where(e.failure, e.reward, -e.distance)
        value = jnp.where(live & ~played.invalid, value, -jnp.inf)
        new = BestEpisodes(e, value, played.tag, number=number, count=once, mark=mark)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b.astype(a.dtype)]), self, new)
        (k,), (n,) = self.tag.shape, both.tag.shape
        places, counts = distinct_episodes(both.episode.failure, *both[1:5], k)
        taken = take_rows(both, places)
        return taken._replace(value=jnp.where(places < n, taken.value, -jnp.inf), count=counts)

    @jax.jit
    def reward(self) -> jax.Array:
        """That of the best: [1], as of one tree."""
        return jnp.where(self.value[:1] > -jnp.inf, self.episode.reward[:1], -jnp.inf)

    def result(self, search: Any, log: Log, settings: dict[str, Any]) -> SearchResult:
        """The `SearchResult` of a search (its ``sim``, ``reward`` and ``top``) of one tree."""
        best = jax.device_get(self)
        n = min(int(((best.value > -np.inf) & best.episode.failure).sum()), search.top)
        first = index_tree(best.episode, 0)
        failing, numbers, counts = index_tree((best.episode, best.number, best.count), np.s_[:n])
        return finish(search, log, first, failing, numbers, counts=counts, settings=settings)


def standard_reward(sim: Simulator) -> rewards.Standard:
    """The reward of searches that want failures alone, and of these the likeliest: log p of a
    failure, relative to the mode where the disturbances of ``sim`` have modes.
    """
    return rewards.standard(density=signature_of(sim).density)
