"""Chains on the failures at several widths of the noise: their moves and exchanges, compiled
(`jast.search.chain`).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.core.simulator import Simulator
from jast._src.normal_space.pcn import proposed
from jast._src.normal_space.transform import dimension, normal_numbers, split_point, used_numbers
from jast._src.runtime._jax import jit
from jast._src.search.lanes import Played, Tally, in_blocks, play_lanes
from jast._src.util.pytrees import index_tree, merge_axes, select_rows

__all__ = ["Chains", "Points", "draw_wider", "move_chains", "no_points"]

ACCEPTANCE = 0.3
"""Share of the moves taken that the scale of the moves is adapted to: near what is optimal for
random walks (Roberts, Gelman and Gilks 1997)."""
ADAPTATION = 0.3  # how fast: change of the logarithm of the scale per share too much
MIN_SCALE = 0.005  # of the moves
MEMORY = 0.95  # of the share of the moves taken, kept from one move to the next
SWAP_MEMORY = 0.9  # of the share of the exchanges, kept from one to the next
MOVES = np.uint32(1)  # address of the random numbers of moves
SWAPS = np.uint32(2)  # address of those of exchanges


class Points(NamedTuple):
    """Points [...] of normal numbers, and what their episodes came to."""

    z: jax.Array
    """[..., D]"""
    used: jax.Array
    """int32: how many of the numbers decide the episode."""
    failing: jax.Array
    """bool; one that does not fail yet goes to lesser distances."""
    distance: jax.Array


class Chains(NamedTuple):
    """L widths, of C chains each."""

    points: Points
    """[L, C]"""
    scale: jax.Array
    """[L] of the moves."""
    accepted: jax.Array
    """[L] share of the moves so far, of late."""
    swapped: jax.Array
    """[L - 1] share of the exchanges with the next width, of late."""


def no_points(n: int, d: int, dtype: Any) -> Points:
    """Points [n] that mean nothing."""
    zero = np.zeros(n, np.int32)
    return Points(np.zeros((n, d), dtype), zero, zero > 0, zero.astype(dtype))


@partial(jit, static_argnames="lanes")
def draw_wider(key, sim, reward, lanes, best, begin, end, width):
    """Draws of noise of this width: ((`BestEpisodes`, `Points` of the lanes), `Tally`)."""
    number = begin + jnp.arange(lanes, dtype=jnp.int32)
    live = number < end
    z = width * _noise(key, sim, number)
    played = play(sim, reward, z, live)
    best = best.merge(played, live, number)
    return (best, _points(sim, z, played, live)), Tally.of(played, live, number)


@jit
def move_chains(key, sim, reward, best, chains, widths, begin, end):
    """Moves of all chains, and after each round exchanges, until ``end``: ((`BestEpisodes`,
    `Chains`), `Tally`).
    """
    levels, each, d = chains.points.z.shape
    lanes, real = levels * each, chains.points.z.dtype

    def by_level(tree):
        return jax.tree.map(lambda a: a.reshape(levels, each, *a.shape[1:]), tree)

    def block(number, live, carry):
        best, chains = carry
        at, old = number[0], chains.points
        noise = _noise(key, sim, number).reshape(levels, each, d)
        scale, width = chains.scale[:, None, None], widths[:, None, None]
        moved = proposed(old.z, noise, scale, width), old.z + scale * width * noise
        z = jnp.where(old.failing[:, :, None], *moved)
        played = play(sim, reward, merge_axes(z), live)
        best = best.merge(played, live, number)
        new = by_level(_points(sim, merge_axes(z), played, live))
        nearer = ~old.failing & (new.distance <= old.distance)
        take = by_level(live & ~played.invalid) & (new.failing | nearer)
        share = jnp.mean(take, axis=1, dtype=real)
        scale = chains.scale * jnp.exp(ADAPTATION * (share - ACCEPTANCE))
        chains = chains._replace(
            points=jax.vmap(select_rows)(take, new, old),
            scale=jnp.clip(scale, MIN_SCALE, 1),
            accepted=MEMORY * chains.accepted + (1 - MEMORY) * share,
        )
        coin = jax.random.fold_in(jax.random.fold_in(key, SWAPS), at)
        chains = _exchanged(chains, widths, coin, at // lanes)
        return (best, chains), Tally.of(played, live, number)

    return in_blocks(block, lanes, begin, end, (best, chains))


def _exchanged(chains, widths, key, turn):
    """The chains after exchanges between neighbouring widths, at every other place by turns.

    Numbers that decide nothing are independent of the others: they are left out of the odds, and
    scaled to their new width.
    """
    points = chains.points
    levels, each, d = points.z.shape
    real = points.z.dtype
    number = jnp.arange(d, dtype=jnp.int32)[None, None]
    decides = number < points.used[:, :, None]
    square = jnp.sum(jnp.where(decides, points.z, 0) ** 2, axis=2)
    used = points.used.astype(real)
    upper, lower = widths[:-1, None], widths[1:, None]
    odds = 0.5 * (upper**-2 - lower**-2) * (square[:-1] - square[1:]) + (
        used[:-1] - used[1:]
    ) * jnp.log(upper / lower)
    coin = jnp.log(jax.random.uniform(key, odds.shape, real, minval=1e-30))
    ours = (jnp.arange(levels - 1, dtype=jnp.int32) % 2 == turn % 2)[:, None]
    swap = ours & (coin < odds) & points.failing[:-1] & points.failing[1:]
    none = jnp.zeros((1, each), jnp.int32)
    down, up = swap.astype(jnp.int32), -swap.astype(jnp.int32)
    level = jnp.arange(levels, dtype=jnp.int32)[:, None]
    source = level + jnp.concatenate([down, none]) + jnp.concatenate([none, up])
    column = jnp.broadcast_to(jnp.arange(each, dtype=jnp.int32)[None], source.shape)
    points = index_tree(points, (source, column))
    ratio = (widths[:, None] / widths[source])[:, :, None]
    decides = number < points.used[:, :, None]
    points = points._replace(z=jnp.where(decides, points.z, ratio * points.z))
    share = SWAP_MEMORY * chains.swapped + (1 - SWAP_MEMORY) * jnp.mean(swap, axis=1, dtype=real)
    return chains._replace(points=points, swapped=jnp.where(ours[:, 0], share, chains.swapped))


def play(sim: Simulator, reward: Any, z: jax.Array, live: jax.Array) -> Played:
    """The episodes of the points ``z`` [n, D], with their disturbances."""
    z0, steps = jax.vmap(partial(split_point, sim))(z)
    rows = index_tree(z0, None), jax.tree.map(lambda a: jnp.moveaxis(a, 1, 0), steps)
    keys = jax.vmap(jax.random.key)(jnp.zeros(len(z), jnp.uint32))

    def draw(key, row, dist):
        return D.from_normal(dist, row)

    return play_lanes(sim, reward, keys, draw, draw, live, rows, record=True)


def _points(sim, z, played, live):
    """The `Points` of ``z`` [n, D], as they were played."""
    e = played.episode
    used = used_numbers(sim, e.length).astype(jnp.int32)
    distance = jnp.where(live & ~played.invalid, e.distance, jnp.inf)
    return Points(z, used, e.failure & live, distance)


def _noise(key, sim, number):
    """Standard normal numbers [n, D] of the episodes of these numbers [n]."""
    key = jax.random.fold_in(key, MOVES)
    shape, dtype = (dimension(sim),), normal_numbers(sim)
    return jax.vmap(lambda i: jax.random.normal(jax.random.fold_in(key, i), shape, dtype))(number)
