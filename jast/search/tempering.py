"""Chains on the failures at several widths of the noise: their moves and exchanges, compiled
(`jast.search.chain`).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._jax import jit
from jast.distributions.numbers import unflat
from jast.limit_state import dimension, normal_numbers
from jast.markov import proposed
from jast.outline import outline
from jast.pytrees import count_numbers
from jast.search import kept as K
from jast.search import lockstep as E
from jast.simulator import Simulator

__all__ = ["Chains", "look", "walk"]

ACCEPTANCE = 0.3
MOVES, SWAPS = np.uint32(1), np.uint32(2)
"""Addresses of random numbers."""


class Chains(NamedTuple):
    """L widths, of C chains each."""

    z: Any
    """[L, C, D]"""
    used: Any
    """[L, C] int32: how many of the numbers decide the episode."""
    failing: Any
    """[L, C] bool; one that does not fail yet goes to lesser distances."""
    distance: Any
    """[L, C]"""
    scale: Any
    """[L] of the moves."""
    accepted: Any
    """[L] share of the moves so far, of late."""
    swapped: Any
    """[L - 1] share of the exchanges with the next width, of late."""


@partial(jit, static_argnames="lanes")
def look(key, sim, reward, lanes, kept, begin, end, width):
    """Draws of noise of this width: ((`Kept`, (z, used, failing, distance) of the lanes),
    `E.Tally`).
    """
    number = begin + jnp.arange(lanes, dtype=jnp.int32)
    live = number < end
    z = width * _noise(key, sim, number)
    played = play(sim, reward, z, live)
    kept = K.merged(kept, played, live, number)
    return (kept, (z, *_state(sim, played, live))), E.tally(played, live, number)


@jit
def walk(key, sim, reward, kept, chains, widths, begin, end):
    """Moves of all chains, and after each round exchanges, until ``end``: ((`Kept`, `Chains`),
    `E.Tally`).
    """
    levels, each, d = chains.z.shape
    lanes, real = levels * each, chains.z.dtype
    flat, apart = (lambda a: a.reshape(lanes, *a.shape[2:])), (lambda a: a.reshape(levels, each))

    def block(carry):
        at, (kept, chains), counted = carry
        number = at + jnp.arange(lanes, dtype=jnp.int32)
        live = (number < end) & (number >= begin)
        noise = _noise(key, sim, number).reshape(levels, each, d)
        scale, width = chains.scale[:, None, None], widths[:, None, None]
        z = jnp.where(
            chains.failing[:, :, None],
            proposed(chains.z, noise, scale, width),
            chains.z + scale * width * noise,
        )
        played = play(sim, reward, flat(z), live)
        kept = K.merged(kept, played, live, number)
        counted = E.add(counted, E.tally(played, live, number))
        used, failing, distance = map(apart, _state(sim, played, live))
        take = apart(live & ~played.invalid) & (
            failing | (~chains.failing & (distance <= chains.distance))
        )
        pick = lambda a, b: jax.vmap(jax.vmap(jnp.where))(take, a, b)
        share = jnp.mean(take, axis=1, dtype=real)
        scale = jnp.clip(chains.scale * jnp.exp(0.3 * (share - ACCEPTANCE)), 0.005, 1)
        chains = chains._replace(
            z=pick(z, chains.z),
            used=pick(used, chains.used),
            failing=pick(failing, chains.failing),
            distance=pick(distance, chains.distance),
            scale=scale,
            accepted=0.95 * chains.accepted + 0.05 * share,
        )
        coin = jax.random.fold_in(jax.random.fold_in(key, SWAPS), at)
        return at + lanes, (kept, _exchanged(chains, widths, coin, at // lanes)), counted

    _, carry, counted = lax.while_loop(
        lambda c: (c[0] < end) & (c[0] >= begin), block, (begin, (kept, chains), E.nothing())
    )
    return carry, counted


def _exchanged(chains, widths, key, turn):
    """The chains after exchanges between neighbouring widths, at every other place by turns.

    Numbers that decide nothing are independent of the others: they are left out of the odds, and
    scaled to their new width.
    """
    levels, each, d = chains.z.shape
    real = chains.z.dtype
    live = jnp.arange(d, dtype=jnp.int32)[None, None] < chains.used[:, :, None]
    square = jnp.sum(jnp.where(live, chains.z, 0) ** 2, axis=2)
    used = chains.used.astype(real)
    upper, lower = widths[:-1, None], widths[1:, None]
    odds = 0.5 * (upper**-2 - lower**-2) * (square[:-1] - square[1:]) + (
        used[:-1] - used[1:]
    ) * jnp.log(upper / lower)
    coin = jnp.log(jax.random.uniform(key, odds.shape, real, minval=1e-30))
    ours = (jnp.arange(levels - 1, dtype=jnp.int32) % 2 == turn % 2)[:, None]
    swap = ours & (coin < odds) & chains.failing[:-1] & chains.failing[1:]
    no = jnp.zeros((1, each), jnp.int32)
    down, up = swap.astype(jnp.int32), -swap.astype(jnp.int32)
    place = jnp.arange(levels, dtype=jnp.int32)[:, None]
    source = place + jnp.concatenate([down, no]) + jnp.concatenate([no, up])
    column = jnp.broadcast_to(jnp.arange(each, dtype=jnp.int32)[None], source.shape)
    z, used, failing, distance = jax.tree.map(
        lambda a: a[source, column], (chains.z, chains.used, chains.failing, chains.distance)
    )
    ratio = (widths[:, None] / widths[source])[:, :, None]
    live = jnp.arange(d, dtype=jnp.int32)[None, None] < used[:, :, None]
    z = jnp.where(live, z, ratio * z)
    share = jnp.mean(swap, axis=1, dtype=real)
    swapped = jnp.where(ours[:, 0], 0.9 * chains.swapped + 0.1 * share, chains.swapped)
    return chains._replace(z=z, used=used, failing=failing, distance=distance, swapped=swapped)


def play(sim: Simulator, reward: Any, z: jax.Array, live: jax.Array) -> E.Played:
    """The episodes of the points ``z`` [n, D], with their disturbances."""
    like = outline(sim)
    size = count_numbers(like.x0)
    z0 = jax.vmap(lambda row: unflat(row[:size], like.x0))(z)
    steps = jax.vmap(jax.vmap(lambda row: unflat(row, like.x)))(
        z[:, size:].reshape(len(z), sim.horizon, -1)
    )
    rows = jax.tree.map(lambda a: a[None], z0), jax.tree.map(lambda a: jnp.moveaxis(a, 1, 0), steps)
    draw = lambda key, row, dist: D.from_normal(dist, row)
    keys = jax.vmap(jax.random.key)(jnp.zeros(len(z), jnp.uint32))
    return E.play(sim, reward, keys, draw, draw, live, rows, record=True)


def _state(sim, played, live):
    """Of played episodes: how many of the numbers decided them, whether they failed, distances."""
    like, e = outline(sim), played.episode
    used = count_numbers(like.x0) + e.length * count_numbers(like.x)
    distance = jnp.where(live & ~played.invalid, e.distance, jnp.inf)
    return used.astype(jnp.int32), e.failure & live, distance


def _noise(key, sim, number):
    """Standard normal numbers [n, D] of the episodes of these numbers [n]."""
    key = jax.random.fold_in(key, MOVES)
    draw = lambda i: jax.random.normal(
        jax.random.fold_in(key, i), (dimension(sim),), normal_numbers(sim)
    )
    return jax.vmap(draw)(number)
