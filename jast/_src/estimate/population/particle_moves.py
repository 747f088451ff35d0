"""A population of points of normal numbers that stays on the device: one compiled program draws it,
moves it, and simulates it, whatever its level and its width.

A move proposes a point that N(0, width^2 I) has as often as the old one, and is taken where the
episode of the new point is at most at the level. Two kinds of moves alternate. One of them changes
all numbers a little (preconditioned Crank-Nicolson: Cotter, Roberts, Stuart and White 2013). On the
way down the levels of the miss distance, the other keeps what led to the level and draws anew all
that came after: every draw stays below it, as in splitting (Cerou and Guyader 2007). Among failures
nothing comes after, and the other draws a few neighbouring numbers anew, which is a Gibbs move of
a random window; in long episodes it mixes where small changes of everything do not. At small widths
failures are a thin layer at right angles to their own direction, and a small change is as small as
the layer is thin: there the other move goes along the difference of two other points, as in
differential evolution (ter Braak 2006), and then back to as far from the origin as it began.
`python -m benchmarks.populations` measures the first three, `python -m benchmarks.stress --methods
stress windows` the last.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.simulator import Simulator
from jast._src.distributions import fine_draws
from jast._src.normal_space.transform import dimension, normal_numbers, outcome_by_level
from jast._src.runtime.device import block_size
from jast._src.util.pytrees import index_tree, select_rows

__all__ = [
    "AFTER",
    "DIFFERENCE",
    "SMALL",
    "WINDOW",
    "Particles",
    "Steering",
    "allocate_particles",
    "draw_particles",
    "initial_steering",
    "move_particles",
    "record_crossings",
]

TARGET_ACCEPTANCE = 0.35
"""Share of the moves that are taken, to which their sizes are steered; .2 to .5 serve alike."""
SMALL, WINDOW, AFTER, DIFFERENCE, STAY = range(5)
"""Kinds of moves: of all numbers, of some neighbours, of those after the level was reached, along
the difference of two other points; and the point as it is.
"""
SIZE_BOUNDS = 0.002, 1.0
"""Least and greatest size of a move: 1 is an independent draw, a window of all numbers, or a whole
difference. Failures of the grid that are cooled to a width of .1 move by less than .02."""
FIRST_SIZES = 0.5, 0.3
"""Of the two moves, before they are steered."""


class Particles(NamedTuple):
    """Points and what their episodes came to. On the device."""

    z: jax.Array
    """[n, D]"""
    score: jax.Array
    """[n] miss distance; -inf for a failure, inf for an invalid episode"""
    used: jax.Array
    """[n] int32: how many of the numbers decided the episode"""
    square: jax.Array
    """[n] sum of the squares of those of these that the width is of"""
    distance: jax.Array
    """[n] miss distance, of failures too"""
    reached: jax.Array
    """[n] int32: how many of the numbers were used when the last level was reached"""


class Steering(NamedTuple):
    """Sizes of the two moves, and what became of them. On the host, [2] each."""

    size: np.ndarray
    """Of the small change, from 0 to 1; of the window, as a share of all numbers; of a difference,
    as a share of it. What draws anew all after a level has none."""
    accepted: np.ndarray
    """Share of the last moves that were taken"""


def initial_steering() -> Steering:
    """Before the first move."""
    return Steering(np.array(FIRST_SIZES, np.float32), np.full(2, np.nan, np.float32))


def allocate_particles(sim: Simulator, n: int) -> Particles:
    """``n`` places for points."""
    dtype = np.dtype(normal_numbers(sim))
    zeros = np.zeros(n, dtype)
    return jax.device_put(
        Particles(
            z=np.zeros((n, dimension(sim)), dtype),
            score=zeros + np.inf,
            used=np.zeros(n, np.int32),
            square=zeros,
            distance=zeros,
            reached=np.zeros(n, np.int32),
        )
    )


def draw_particles(
    sim: Simulator,
    particles: Particles,
    key: jax.Array,
    n: int,
    width: float = 1.0,
    wide: np.ndarray | None = None,
) -> tuple[Particles, int]:
    """``n`` new independent points of N(0, width^2 I) in the place of ``particles``, and how many
    of their episodes are invalid; ``wide``: see `move_particles`.
    """
    rows = np.arange(n, dtype=np.int32)
    steering = Steering(np.ones(2, np.float32), np.zeros(2, np.float32))
    after, _, invalid = move_particles(
        sim, particles, key, rows, steering, moves=1, level=np.inf, width=width, wide=wide
    )
    return after, invalid


def record_crossings(
    sim: Simulator, particles: Particles, key: jax.Array, rows: np.ndarray, level: float
) -> Particles:
    """The points of ``rows`` [m], which are at most at the ``level``, in the first m places, with
    the moment at which each came to it.
    """
    after, _, _ = move_particles(
        sim, particles, key, rows, initial_steering(), moves=1, level=level, kinds=(STAY, STAY)
    )
    return after


def move_particles(
    sim: Simulator,
    particles: Particles,
    key: jax.Array,
    rows: np.ndarray,
    steering: Steering,
    *,
    moves: int,
    level: float,
    width: float = 1.0,
    before: float | None = None,
    wide: np.ndarray | None = None,
    kinds: tuple[int, int] = (SMALL, WINDOW),
) -> tuple[Particles, Steering, int]:
    """The points of ``rows`` [m] after so many moves that keep N(0, width^2 I) given a score of at
    most ``level``, in the first m places; their new sizes; invalid episodes that were met. What
    stands in the other places means nothing.

    ``before``: the width that the points were drawn with, where it was another one. Numbers that an
    episode did not use are scaled to the new one, as nothing ties them. ``wide`` [D], bool: the
    numbers that have this width; the others have that of the model. Default: all. ``kinds``: of
    the moves, which alternate. Differences serve where all numbers have the width, and keep
    N(0, width^2 I) but nearly: points that move side by side are tied to one another, and the way
    back is scaled otherwise.
    """
    dtype, live = np.dtype(particles.z.dtype), len(rows)
    places = np.arange(len(particles.z), dtype=np.int32)
    places[:live] = rows
    ratio = 1.0 if before is None else width / before
    counts = np.int32(live), np.int32(moves), np.array(kinds, np.int32)
    wide = np.ones(dimension(sim), bool) if wide is None else wide
    numbers = (dtype.type(v) for v in (level, width, ratio))
    out, size, accepted, invalid = _move_on_device(
        sim, particles, key, places, steering.size, wide, *counts, *numbers
    )
    return out, Steering(np.asarray(size), np.asarray(accepted)), int(invalid)


@partial(jax.jit, donate_argnums=1)
def _move_on_device(sim, particles, key, rows, size, wide, live, moves, kinds, level, width, ratio):
    wide = wide[None]
    width, ratio = (jnp.where(wide, a, 1) for a in (width, ratio))
    n, d = particles.z.shape
    lanes = block_size(n)
    play = jax.vmap(lambda z: outcome_by_level(sim, z, level))
    number = jnp.arange(d, dtype=jnp.int32)[None]
    lane = jnp.arange(lanes, dtype=jnp.int32)

    def change_all(z, noise, key, size, reached, beside):
        return jnp.sqrt(1 - size**2) * z + size * noise

    def change_window(z, noise, key, size, reached, beside):
        begin = jnp.floor(jax.random.uniform(key, (lanes, 1), z.dtype) * d).astype(jnp.int32)
        length = jnp.maximum(jnp.floor(size * d), 1).astype(jnp.int32)
        return jnp.where(jnp.mod(number - begin, d) < length, noise, z)

    def change_after(z, noise, key, size, reached, beside):
        return jnp.where(number < reached[:, None], z, noise)

    def add_difference(z, noise, key, size, reached, beside):
        one, other = jax.random.randint(key, (2, 1), 1, jnp.maximum(beside, 2), jnp.int32)
        moved = z + size * (z[(lane + one) % beside] - z[(lane + other) % beside])
        before, after = (jnp.sum(a**2, axis=1, keepdims=True) for a in (z, moved))
        return jnp.where(after > 0, jnp.sqrt(before / after), 1) * moved

    def stay(z, noise, key, size, reached, beside):
        return z

    # SMALL, WINDOW, AFTER, DIFFERENCE, STAY
    by_kind = change_all, change_window, change_after, add_difference, stay

    def block(i, carry, key, kind, size):
        particles, accepted, invalid = carry
        old = jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, i * lanes, lanes), particles)
        for_noise, for_choice = jax.random.split(jax.random.fold_in(key, i))
        noise = lax.cond(
            kind < DIFFERENCE,
            lambda: width * fine_draws.normal(for_noise, old.z.shape, old.z.dtype),
            lambda: jnp.zeros_like(old.z),
        )
        beside = jnp.clip(live - i * lanes, 1, lanes)  # points that live in this block
        about = old.z, noise, for_choice, size.astype(old.z.dtype), old.reached, beside
        z = lax.switch(kind, by_kind, *about)
        o, reached = play(z)
        score = o.score.astype(old.score.dtype)
        proposed = Particles(
            z=z,
            score=score,
            used=o.used,
            square=jnp.sum(jnp.where(wide & (number < o.used[:, None]), z**2, 0), axis=1),
            distance=o.distance.astype(score.dtype),
            reached=reached,
        )
        taken = score <= level
        new = select_rows(taken, proposed, old)
        particles = jax.tree.map(
            lambda a, b: lax.dynamic_update_slice_in_dim(a, b, i * lanes, 0), particles, new
        )
        own = i * lanes + lane < live
        accepted += jnp.sum(taken & own, dtype=jnp.int32)
        return particles, accepted, invalid + jnp.sum(o.invalid & own, dtype=jnp.int32)

    def move(t, carry):
        particles, size, accepted, invalid = carry
        i = t % 2
        run = partial(block, key=jax.random.fold_in(key, t), kind=kinds[i], size=size[i])
        zero = jnp.zeros((), jnp.int32)
        particles, taken, wrong = lax.fori_loop(
            0, (live + lanes - 1) // lanes, run, (particles, zero, zero)
        )
        share = taken.astype(size.dtype) / live.astype(size.dtype)
        steered = jnp.clip(size[i] * jnp.exp(share - TARGET_ACCEPTANCE), *SIZE_BOUNDS)
        size, accepted = size.at[i].set(steered), accepted.at[i].set(share)
        return particles, size, accepted, invalid + wrong

    particles = index_tree(particles, rows)
    unused = number >= particles.used[:, None]
    particles = particles._replace(z=jnp.where(unused, ratio * particles.z, particles.z))
    start = particles, size, jnp.zeros_like(size), jnp.zeros((), jnp.int32)
    return lax.fori_loop(0, moves, move, start)
