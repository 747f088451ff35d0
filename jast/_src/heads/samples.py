"""What heads learn from: the statistics of roots, and of all edges, as rows of numbers."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core import rewards
from jast._src.core.episode import play_back
from jast._src.distributions.flat_rows import flat
from jast._src.heads.heads import observation
from jast._src.util.pytrees import index_tree, merge_axes

__all__ = ["Samples", "cells", "samples_of_edges", "samples_of_episodes", "samples_of_roots"]


class Samples(NamedTuple):
    """Rows of numbers, float32 on the host; only finite ones."""

    seen: np.ndarray
    """[m, n] observations."""
    x: np.ndarray
    """[m, d] disturbances; [m, 0] for a policy head."""
    target: np.ndarray
    """[m, d, bins] shares of the visits, or [m] rewards to come."""
    dropped: int = 0
    """Rows left out because something in them was not finite."""

    @classmethod
    def joined(cls, parts: "Sequence[Samples]") -> "Samples":
        """Several as one."""
        columns = zip(*(p[:3] for p in parts), strict=True)
        return cls(*map(np.concatenate, columns), sum(p.dropped for p in parts))


def samples_of_roots(sim, actions, roots, bins, good, first=0):
    """`Samples` for a policy head, one a root, and for a value head, one an edge of a root, from
    `Roots` [turns, B].

    They come tree by tree, so that the groups in which trees grew do not show. Per root and number
    of the disturbance, the target of the policy head is the share of the visits in each of ``bins``
    equal cells of the unit interval that ``actions`` maps to it; only trees that are ``good`` [B]
    count. Without ``bins`` there are none of the first kind. Roots at levels above ``first`` choose
    x0 and teach nothing.
    """
    turns = len(roots.depth)
    roots = _tree_by_tree(roots._replace(starts=()))
    seen, x, shares = _root_rows(sim, actions, roots, bins)
    good = np.repeat(good, turns)
    use = roots.valid & good & (roots.depth >= first) & (jnp.sum(roots.visits, axis=1) > 0)
    policy = None if bins is None else _policy_samples(use, seen, shares)
    edges = roots.visits > 0
    each = jnp.broadcast_to(seen[:, None], (*edges.shape, seen.shape[1]))
    use = roots.valid & (roots.depth >= first)
    value = _finite_samples(*merge_axes((use[:, None] & edges, each, x, roots.q)))
    return policy, value


def samples_of_edges(edges, target):
    """`Samples` for a value head from `search.tree.edges.Edges`: Q(s, a), or the Q of the edge
    that leads to s, as published (``target="parent"``).
    """
    edges = _tree_by_tree(edges)
    q = edges.q if target == "own" else edges.parent_q
    return _finite_samples(edges.valid, edges.seen, edges.x, q)


def samples_of_episodes(sim, actions, episodes, bins, good):
    """`Samples` for a policy head from whole episodes [B, ...], those of ``good`` [B]: at each
    state, all of the histogram in the cell of what came next.
    """
    seen, shares, use = _episode_rows(sim, actions, episodes._replace(states=None), bins)
    return _policy_samples(*merge_axes((use & good[:, None], seen, shares)))


@functools.partial(jax.jit, static_argnames="bins")
def _episode_rows(sim, actions, episodes, bins):
    def one(episode):
        x0, xs, length = episode.x0, episode.disturbances, episode.length
        states = play_back(sim, rewards.STANDARD, x0, xs, length).states

        def step(state, x):
            return observation(sim, state), _cell_of(actions, x, sim.disturbance(state), bins)

        rows = jax.vmap(step)(index_tree(states, np.s_[:-1]), xs)
        return *rows, jnp.arange(sim.horizon, dtype=jnp.int32) < length

    return jax.vmap(one)(episodes)


def cells(u, bins):
    """The cell of each point of the unit interval."""
    return jnp.clip(jnp.floor(u * bins).astype(jnp.int32), 0, bins - 1)


def _cell_of(actions, x, dist, bins):
    """[d, bins]: 1 in the cell of each number of ``x``, else 0."""
    u = flat(actions.locate(x, dist))
    return jax.nn.one_hot(cells(u, bins), bins, dtype=jnp.float32)


@functools.partial(jax.jit, static_argnames="bins")
def _root_rows(sim, actions, roots, bins):
    def one(state, xs, visits):
        if bins is None:
            return observation(sim, state), jax.vmap(flat)(xs), ()
        dist, n = sim.disturbance(state), visits.astype(jnp.float32)
        hits = jax.vmap(lambda x: _cell_of(actions, x, dist, bins))(xs)  # [K, d, bins]
        shares = jnp.einsum("k,kdb->db", n, hits) / jnp.maximum(jnp.sum(n), 1)
        return observation(sim, state), jax.vmap(flat)(xs), shares

    return jax.vmap(one)(roots.state, roots.actions, roots.visits)


def _tree_by_tree(rows):
    """Rows [n, B, ...] as [B * n, ...]."""
    return merge_axes(jax.tree.map(lambda a: np.swapaxes(a, 0, 1), rows))


def _policy_samples(use, seen, shares):
    """`Samples` without disturbances."""
    return _finite_samples(use, seen, np.zeros((len(seen), 0)), shares)


def _finite_samples(use, *columns):
    use, columns = np.asarray(use), [np.asarray(c, np.float32) for c in columns]
    good = use & np.all([np.isfinite(c.reshape(len(c), -1)).all(1) for c in columns], axis=0)
    return Samples(*(c[good] for c in columns), int((use & ~good).sum()))
