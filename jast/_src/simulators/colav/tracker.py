"""What the ferry knows of the adversary: its past, read with a delay, and a tracker that follows
what is read.

The past is kept at the ends of search steps and read in between by cubic Hermite interpolation,
which for the adversary's first-order velocities is right to 5 cm (tested; to 3 cm unless it turns
sharply). So the state holds 64 numbers in place of the 1600 of a buffer of 0.1 s samples, and a
tree that keeps states stays small.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

__all__ = ["BUFFER", "PERIOD", "Track", "begin", "push", "reader", "track"]

PERIOD = 3.0  # s: a search step
BUFFER = 40.0  # s: the published buffer's 400 samples of 0.1 s
# both ends of the 40 s, of the search step in progress and of the one in which the buffer begins
KNOTS = 16
LAG = 1.0  # s: our reading of the published T_p = k_p = T_v = k_v = 1


class Track(NamedTuple):
    """Position (m) and velocity (m/s), north and east."""

    n: jax.Array
    e: jax.Array
    v_n: jax.Array
    v_e: jax.Array


def begin(now):
    """The past [KNOTS, 4] of an adversary that has been nowhere but at the `Track` ``now``."""
    return jnp.tile(jnp.stack(now)[None], (KNOTS, 1))


def push(past, now):
    """The past one period on, ``now`` its newest row; the oldest is dropped."""
    return jnp.concatenate([past[1:], jnp.stack(now)[None]])


def reader(past, step, delay):
    """What is read during a search step: a function of the time since its start, in periods, to a
    `Track`.

    ``past``: up to the end of the step; ``step``: its number, from 0; ``delay``: in periods, at
    most `BUFFER`. Before the start of the episode there is nothing: the first state is read.
    """
    now = step.astype(delay.dtype)
    # a whole step is read from two intervals
    first = jnp.minimum(jnp.floor(jnp.maximum(now - delay, 0)), now - 1)
    rows = lax.dynamic_slice_in_dim(past, KNOTS - 2 + (first - now).astype(jnp.int32), 3)
    one, two = _cubic(rows[0], rows[1]), _cubic(rows[1], rows[2])

    def read(since):
        time = jnp.maximum(now + since - delay, 0) - first
        later = time >= 1
        a, b, c, d = (jnp.where(later, q, p) for p, q in zip(one, two, strict=True))
        t = time - later.astype(time.dtype)
        place, speed = ((a * t + b) * t + c) * t + d, (3 * a * t + 2 * b) * t + c
        return Track(place[0], place[1], speed[0] / PERIOD, speed[1] / PERIOD)

    return read


def track(before, seen, dt):
    """The track ``dt`` seconds on: it goes on at its velocity, and then comes nearer to what is
    ``seen``, exponentially with `LAG`.
    """
    gain = 1 - jnp.exp(jnp.asarray(-dt / LAG, before.n.dtype))
    expected = before._replace(n=before.n + dt * before.v_n, e=before.e + dt * before.v_e)
    return Track(*(a + gain * (b - a) for a, b in zip(expected, seen, strict=True)))


def _cubic(start, end):
    """Coefficients, highest first, of the cubics of north and east through two rows of the past, in
    periods since the first.
    """
    gap, v0, v1 = end[:2] - start[:2], PERIOD * start[2:], PERIOD * end[2:]
    return v0 + v1 - 2 * gap, 3 * gap - 2 * v0 - v1, v0, start[:2]
