"""Simulated episodes one beside the other, each begun anew where it ends, and the transitions that
a learner keeps of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast import progress as P
from jast.distributions.mixtures import x_of
from jast.heads.heads import observed
from jast.pytrees import select
from jast.rewards import log_likelihood
from jast.simulator import Simulator

__all__ = ["at", "empty", "put", "step"]


class Lane(NamedTuple):
    """An episode at a state, and what a learner asks of it."""

    progress: P.Progress
    """The episode so far: `jast.progress`."""
    t: Any
    """int32: steps taken."""
    seen: Any
    """[m] float32: what the networks see of the state, the time left out."""
    potential: Any
    """float32: the state's miss distance as it shapes the reward, 0 at a failure; also 0 before the
    end where only the last distance counts.
    """
    drift: Any
    """[n] float32: what the latents of this episode have in common while the learner only looks
    around.
    """
    log_p: Any
    """float32: sum of -|z|^2 / 2 so far, x0's too."""
    gain: Any
    """float32: d(s0) - d(s)."""

    @property
    def over(self) -> jax.Array:
        """bool: no step follows this state."""
        return self.progress.done

    @property
    def failed(self) -> jax.Array:
        """bool: ... as it is a failure."""
        return self.progress.failure

    @property
    def nearest(self) -> jax.Array:
        """float32: the miss distance so far; of an episodic system, inf before its end."""
        return self.progress.distance.astype(jnp.float32)


class Rows(NamedTuple):
    """Transitions: a ring buffer, [capacity] in front, or some of it. float32 but for the flags."""

    seen: Any
    t: Any
    potential: Any
    """d(s)."""
    z: Any
    approach: Any
    """d(s) - d(s')."""
    failure: Any
    done: Any
    next_seen: Any


def at(sim: Simulator, dense: bool, x0: Any, drift: Any = ()) -> Lane:
    """A `Lane` at the start ``x0``; ``dense``: the distance counts at every state."""
    first = P.begin(sim, log_likelihood, x0)
    return _lane(sim, dense, first, jnp.int32(0), drift, jnp.zeros((), jnp.float32))


def begin(sim: Simulator, dense: bool, key: jax.Array, z0: jax.Array, drift: jax.Array) -> Lane:
    """A `Lane` at the start with the latents ``z0`` [n0]; where there are none, at one drawn with
    ``key``.
    """
    x0 = x_of(sim.start(), z0) if z0.size else D.sample(sim.start(), key)
    return at(sim, dense, x0, drift)._replace(log_p=-0.5 * jnp.sum(z0**2))


def step(
    sim: Simulator, dense: bool, lane: Lane, z: jax.Array
) -> tuple[Lane, Rows, jax.Array, jax.Array]:
    """One step with the latents ``z`` [n]: ``(Lane, Rows of one transition, valid, invalid)``.

    ``valid``: it may be learned from. ``invalid``: a number was not finite, the episode ends there.
    A lane that was ``over`` stays as it is.
    """
    x = x_of(sim.disturbance(lane.progress.state), z)
    after = P.advance(sim, log_likelihood, lane.progress, x, lane.t + 1 >= sim.horizon)
    log_p = lane.log_p - 0.5 * jnp.sum(z**2)
    drawn = _finite(z, *jax.tree.leaves(x))
    moved = _lane(sim, dense, after, lane.t + 1, lane.drift, log_p, ~lane.over, drawn)
    approach = lane.potential - moved.potential
    moved = moved._replace(gain=lane.gain + approach)
    row = Rows(
        lane.seen,
        lane.t.astype(jnp.float32),
        lane.potential,
        z,
        approach,
        moved.failed,
        moved.over,
        moved.seen,
    )
    kept = select(lane.over, lane, moved)
    invalid = kept.progress.invalid
    return kept, row, ~lane.over & ~invalid, invalid


def _lane(
    sim: Simulator,
    dense: bool,
    episode: P.Progress,
    t: jax.Array,
    drift: Any,
    log_p: jax.Array,
    live: Any = True,
    drawn: Any = True,
) -> Lane:
    """The `Lane` of an ``episode``, without a gain; invalid where ``drawn`` does not hold, or a
    number that the learner would see is not finite.
    """
    episode = P.conclude(sim, log_likelihood, episode, live)
    if sim.episodic and not dense:
        distance = episode.distance  # evaluated at its end alone
    else:
        distance = jnp.asarray(sim.evaluate(episode.state)[1])
    # at a failure the distance counts 0, whatever a simulator gives there: failures are the nearest
    # of all, and none is nearer than another
    counts = (dense | episode.done) & ~episode.failure
    shaping = jnp.where(counts, distance.astype(jnp.float32), 0)
    seen = observed(sim, episode.state)
    invalid = episode.invalid | ~(drawn & _finite(seen, shaping))
    episode = episode._replace(
        invalid=invalid, done=episode.done | invalid, failure=episode.failure & ~invalid
    )
    return Lane(episode, t, seen, shaping, drift, log_p, jnp.zeros((), jnp.float32))


def _finite(*arrays: jax.Array) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(a)) for a in arrays]))


def potential(sim: Simulator, dense: Any, state: Any) -> jax.Array:
    """The `Lane`'s at a state that is not its last; 0 where the distance is not finite."""
    distance = jnp.asarray(sim.evaluate(state)[1]).astype(jnp.float32)
    return jnp.where(dense & jnp.isfinite(distance), distance, 0)


def empty(capacity, m, n):
    """`Rows` of zeros."""
    zeros = lambda *shape, dtype=jnp.float32: jnp.zeros((capacity, *shape), dtype)
    return Rows(
        zeros(m),
        zeros(),
        zeros(),
        zeros(n),
        zeros(),
        zeros(dtype=bool),
        zeros(dtype=bool),
        zeros(m),
    )


def put(buffer, stored, new, valid):
    """``(buffer, stored)`` with those of ``new`` [lanes] that are ``valid`` in the places of the
    oldest ones; ``stored`` counts all that ever were.
    """
    capacity = buffer.t.shape[0]
    place = jnp.where(valid, (stored + jnp.cumsum(valid, dtype=jnp.int32) - 1) % capacity, capacity)
    return jax.tree.map(
        lambda a, b: a.at[place].set(b, mode="drop"), buffer, new
    ), stored + jnp.sum(valid, dtype=jnp.int32)
