"""Simulated episodes one beside the other, each begun anew where it ends, and the transitions that
a learner keeps of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast.heads.heads import observed
from jast.policies.latent import x_of
from jast.pytrees import select, strong

__all__ = ["Lane", "Rows", "at", "begin", "empty", "potential", "put", "step"]


class Lane(NamedTuple):
    """An episode at a state."""

    state: Any
    t: Any
    """int32: steps taken."""
    seen: Any
    """[m] float32: what the networks see of the state, the time left out."""
    potential: Any
    """float32: the state's miss distance as it shapes the reward, 0 at a failure; also 0 before the
    end where only the last distance counts.
    """
    nearest: Any
    """float32: the episode's miss distance so far."""
    over: Any
    """bool: no step follows this state."""
    failed: Any
    """bool: ... as it is a failure."""
    drift: Any
    """[n] float32: what the latents of this episode have in common while the learner only looks
    around.
    """
    log_p: Any
    """float32: sum of -|z|^2 / 2 so far, x0's too."""
    gain: Any
    """float32: d(s0) - d(s)."""


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


def at(sim, dense, x0, drift=()):
    """A `Lane` at the start ``x0``; ``dense``: the distance counts at every state."""
    state = strong(sim.init(x0))
    distance, failed, over = _judge(sim, state, jnp.zeros((), bool))
    zero = jnp.zeros((), jnp.float32)
    return Lane(
        state,
        jnp.int32(0),
        observed(sim, state),
        _potential(distance, failed, dense | over),
        distance,
        over,
        failed,
        drift,
        zero,
        zero,
    )


def begin(sim, dense, key, z0, drift):
    """A `Lane` at the start with the latents ``z0`` [n0]; where there are none, at one drawn with
    ``key``.
    """
    x0 = x_of(sim.start(), z0) if z0.size else D.sample(sim.start(), key)
    return at(sim, dense, x0, drift)._replace(log_p=-0.5 * jnp.sum(z0**2))


def step(sim, dense, lane, z):
    """One step with the latents ``z`` [n]: ``(Lane, Rows of one transition, valid, invalid)``.

    ``valid``: it may be learned from. ``invalid``: a number was not finite, the episode ends there.
    A lane that was ``over`` stays as it is.
    """
    x = x_of(sim.disturbance(lane.state), z)
    state = strong(sim.step(lane.state, x))
    distance, failed, done = _judge(sim, state, lane.t + 1 >= sim.horizon)
    potential, seen = _potential(distance, failed, dense | done), observed(sim, state)
    before = jnp.all(jnp.isfinite(lane.seen)) & jnp.isfinite(lane.potential)
    after = jnp.stack([jnp.all(jnp.isfinite(a)) for a in (seen, potential, z, *jax.tree.leaves(x))])
    invalid = ~(before & (lane.over | jnp.all(after)))
    nearest = distance if sim.episodic else jnp.minimum(lane.nearest, distance)
    approach = lane.potential - potential
    log_p = lane.log_p - 0.5 * jnp.sum(z**2)
    moved = Lane(
        state,
        lane.t + 1,
        seen,
        potential,
        nearest,
        done | invalid,
        failed & ~invalid,
        lane.drift,
        log_p,
        lane.gain + approach,
    )
    stopped = lane._replace(failed=lane.failed & ~invalid)
    row = Rows(
        lane.seen, lane.t.astype(jnp.float32), lane.potential, z, approach, failed, done, seen
    )
    return select(lane.over, stopped, moved), row, ~lane.over & ~invalid, invalid


def _judge(sim, state, last):
    """(miss distance float32, failed, over) of a state, in the order of `jast.Simulator`."""
    event, distance = sim.evaluate(state)
    ends = jnp.asarray(sim.is_terminal(state)) | last
    failed, over = (event & ends, ends) if sim.episodic else (event, event | ends)
    return jnp.asarray(distance).astype(jnp.float32), jnp.asarray(failed), jnp.asarray(over)


def _potential(distance, failed, counts):
    # at a failure the distance counts 0, whatever a simulator gives there: failures are the nearest
    # of all, and none is nearer than another
    return jnp.where(counts & ~failed, distance, 0)


def potential(sim, dense, state):
    """The `Lane`'s at a state that is not its last; 0 where the distance is not finite."""
    distance, failed, _ = _judge(sim, state, jnp.zeros((), bool))
    return jnp.where(jnp.isfinite(distance), _potential(distance, failed, dense), 0)


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
