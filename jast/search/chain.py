"""Markov chains on the failures, side by side at several widths of the noise.

A chain of width w moves over the normal numbers z of the disturbances and keeps N(0, w^2 I) given
failure, by the proposal of Cotter, Roberts, Stuart and White 2013. Wide ones go from failure mode
to failure mode, narrow ones are near the likeliest failure of theirs, and neighbours exchange their
points (parallel tempering, Geyer 1991; Earl and Deem 2005). There is no drift by the gradient: the
density of z is Gaussian, and the proposal has that drift already, exactly.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import _checks
from jast import distributions as D
from jast._jax import is_traced, is_tracing
from jast.counter import tree_keys
from jast.distributions.numbers import unflat
from jast.incidents import hosted, incidents, since
from jast.limit_state import check, dimension, normal_numbers
from jast.markov import WIDTHS, proposed
from jast.outline import outline
from jast.pytrees import count
from jast.results import asked
from jast.search import kept as K
from jast.search import lockstep as E
from jast.search.result import SearchResult
from jast.simulator import Simulator

__all__ = ["chain"]

LANES, MOMENTS = 64, 100
"""Chains, of all widths together: few, as what they need is many moves."""
FAILING, LOST = 0.1, 3.0
"""The widest noise is the first of `WIDTHS` of which so many fail; where nothing does, this."""
LEVELS = 4, 16
ACCEPTANCE = 0.3
MOVES, SWAPS = np.uint32(1), np.uint32(2)


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


def chain(
    key: jax.Array,
    sim: Simulator,
    *,
    episodes: int = 100_000,
    narrowest: float = 0.25,
    top: int = 64,
    progress: bool = False,
    callback: Callable | None = None,
) -> SearchResult:
    """Find likely failures of many kinds by Markov chains that never leave the failures.

    First, failures are looked for with ever wider noise. From those that are found chains go on, at
    widths from that one to ``narrowest`` times the model's; each move is an episode, taken where it
    fails. Chains that have no failure to begin with take moves of lesser miss distance until they
    have one.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        episodes: moves of all chains, and the draws before.
        narrowest: width of the narrowest noise, above 0 and below 1. The narrower, the nearer to
            the likeliest failures, and the smaller the moves.
        top: distinct failures kept.
        progress: show a bar.
        callback: called as ``callback(done, total, None)``, in episodes.

    Returns:
        `SearchResult`: the likeliest of all failures that a chain was offered. Their reward is that
        of `jast.rewards.standard` with the density relative to the mode (raw, where there is none).
        ``settings`` has the ``widths`` and for each the share of moves taken (``accepted``) and of
        exchanges with the next (``swapped``): where these are nearly 0 the narrow chains know of no
        failure mode that the wide ones found since. KeyboardInterrupt ends the search with what it
        has.

    Raises:
        ValueError: for a count below 1, ``narrowest`` outside its range, disturbances without a
            quantile function, a simulator whose functions do not fit together, and inside of a
            transformation of JAX.
    """
    name = "chain"
    episodes, top = E.whole(name, episodes=episodes, top=top)
    expected = "above 0 and below 1"
    narrowest = _checks.number(name, "narrowest", narrowest, lambda v: 0 < v < 1, expected)
    _checks.random_key(name, key)
    if is_traced(key, sim) or is_tracing():
        raise ValueError(f"{name}: cannot be traced; call it outside of jax.jit and jax.vmap")
    check(name, sim)
    settings = asked(name, key, episodes=episodes, narrowest=narrowest)
    size = max(2 * LEVELS[0], min(LANES, 1 << max(0, (episodes // 16).bit_length())))
    steps = math.ceil(math.log(LOST / narrowest) * math.sqrt(dimension(sim)) / 2)
    levels = min(max(steps + 1, LEVELS[0]), LEVELS[1], size // 2)
    shape = levels, size // levels
    search = _Search(key, sim, shape, narrowest)
    lanes = shape[0] * shape[1]
    before = incidents(sim)
    stretch = lanes if hosted(sim) else lanes * max(1, episodes // (lanes * MOMENTS))
    looks = [lanes * (i + 1) for i in range(len(WIDTHS))]
    ends = [*looks, *range(looks[-1] + stretch, episodes, stretch)]
    ends = [*(end for end in ends if end < episodes), episodes]
    (kept, chains, widths, _), log = E.drive(
        search.chunk,
        (K.none(sim, max(top, 64)), None, (), []),
        ends,
        host=hosted(sim),
        progress=progress,
        callback=callback,
        name=name,
    )
    if chains is not None:
        share = lambda a: [round(float(v), 4) for v in a]
        settings |= dict(
            widths=share(widths), accepted=share(chains.accepted), swapped=share(chains.swapped)
        )
    found = K.result(sim, search.reward, log, kept, settings, top)
    return found._replace(incidents=since(before, incidents(sim)))


class _Search:
    """What does not change while a search runs."""

    def __init__(self, key, sim, shape, narrowest):
        self.key, self.sim, self.reward = tree_keys(key, 1)[0], sim, K.likelihood(sim)
        self.shape, self.narrowest = shape, narrowest

    def chunk(self, carry, begin, end):
        """Episodes ``begin`` .. ``end - 1``: look for failures, or move the chains."""
        kept, chains, widths, looks = carry
        ends = jnp.asarray(begin, jnp.int32), jnp.asarray(end, jnp.int32)
        if chains is None and not self._enough(looks):
            width = jnp.asarray(WIDTHS[len(looks)], normal_numbers(self.sim))
            lanes = self.shape[0] * self.shape[1]
            (kept, look), counted = _look(
                self.key, self.sim, self.reward, lanes, kept, *ends, width
            )
            looks = [*looks, (float(width), look)]
        else:
            if chains is None:
                chains, widths = self._begun(looks)
            (kept, chains), counted = _walk(
                self.key, self.sim, self.reward, kept, chains, widths, *ends
            )
        return (kept, chains, widths, looks), counted, K.best_of(kept), None

    def _enough(self, looks):
        share = lambda look: float(look[1][2].mean())
        return len(looks) == len(WIDTHS) or (looks and share(looks[-1]) >= FAILING)

    def _begun(self, looks):
        """The chains and their widths: of the failures at the width that has most of them, up to
        the first that has enough; else of the nearest draws.
        """
        shares = [float(look[2].mean()) for _, look in looks]
        i = int(np.argmax(shares)) if max(shares) > 0 else [w for w, _ in looks].index(LOST)
        widest, (z, used, failing, distance) = looks[i]
        rank = np.where(np.asarray(failing), -np.inf, np.asarray(distance))
        order = np.argsort(rank, kind="stable")
        known = int(np.asarray(failing).sum()) or len(order)
        levels, chains = self.shape
        # those of one width differ as far as there are enough
        rows = order[(np.arange(levels)[:, None] + levels * np.arange(chains)[None]) % known]
        real = z.dtype
        widths = np.geomspace(max(widest, 1.0), self.narrowest, levels)
        none = jnp.zeros(levels, real)
        scale = jnp.full(levels, 0.5, real)
        state = jax.tree.map(lambda a: a[rows], (z, used, failing, distance))
        return Chains(*state, scale, none, none[1:]), jnp.asarray(widths, real)


@partial(jax.jit, static_argnames="lanes")
def _look(key, sim, reward, lanes, kept, begin, end, width):
    """Draws of noise of this width: ((`Kept`, (z, used, failing, distance) of the lanes),
    `E.Tally`).
    """
    number = begin + jnp.arange(lanes, dtype=jnp.int32)
    live = number < end
    z = width * _noise(key, sim, number)
    played = play(sim, reward, z, live)
    kept = K.merged(kept, played, live, number)
    return (kept, (z, *_state(sim, played, live))), E.tally(played, live, number)


@jax.jit
def _walk(key, sim, reward, kept, chains, widths, begin, end):
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
    size = count(like.x0)
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
    used = count(like.x0) + e.length * count(like.x)
    distance = jnp.where(live & ~played.invalid, e.distance, jnp.inf)
    return used.astype(jnp.int32), e.failure & live, distance


def _noise(key, sim, number):
    """Standard normal numbers [n, D] of the episodes of these numbers [n]."""
    key = jax.random.fold_in(key, MOVES)
    draw = lambda i: jax.random.normal(
        jax.random.fold_in(key, i), (dimension(sim),), normal_numbers(sim)
    )
    return jax.vmap(draw)(number)
