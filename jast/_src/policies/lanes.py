"""Episodes simulated side by side, each begun anew where it ends, and the transitions that a
learner keeps of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast._src.core import transition
from jast._src.core.rewards import log_likelihood
from jast._src.core.simulator import Simulator
from jast._src.distributions.mixtures import x_of
from jast._src.heads.heads import observation
from jast._src.util.pytrees import select

__all__ = ["Lane", "Transitions", "begin_lane", "lane_at", "potential", "step_lane"]


class Lane(NamedTuple):
    """An episode at a state, and what a learner asks of it."""

    progress: transition.Progress
    """The episode so far."""
    t: jax.Array
    """int32: steps taken."""
    observation: jax.Array
    """[m] float32: what the networks see of the state."""
    potential: jax.Array
    """float32: the state's miss distance as it shapes the reward, 0 at a failure; also 0 before the
    end where only the last distance counts.
    """
    drift: jax.Array
    """[n] float32: mean of this episode's latents during the exploration."""
    log_p: jax.Array
    """float32: sum of -|z|^2 / 2 so far, x0's too."""
    gain: jax.Array
    """float32: d(s0) - d(s)."""

    @property
    def over(self) -> jax.Array:
        """bool: no step follows this state."""
        return self.progress.done

    @property
    def failed(self) -> jax.Array:
        """bool: the state is a failure."""
        return self.progress.failure

    @property
    def nearest(self) -> jax.Array:
        """float32: the miss distance so far; of an episodic system, inf before its end."""
        return self.progress.distance.astype(jnp.float32)


class Transitions(NamedTuple):
    """Steps of episodes, [rows] in front; float32 but for the flags."""

    observation: jax.Array
    t: jax.Array
    potential: jax.Array
    """d(s)."""
    z: jax.Array
    approach: jax.Array
    """d(s) - d(s')."""
    failure: jax.Array
    done: jax.Array
    next_observation: jax.Array

    @classmethod
    def empty(cls, capacity: int, m: int, n: int) -> "Transitions":
        """Rows of zeros, with observations [m] and latents [n]."""
        number, flag = jnp.zeros((capacity,), jnp.float32), jnp.zeros((capacity,), bool)
        seen, z = (jnp.zeros((capacity, k), jnp.float32) for k in (m, n))
        return cls(seen, number, number, z, number, failure=flag, done=flag, next_observation=seen)

    def put(
        self, stored: jax.Array, new: "Transitions", valid: jax.Array
    ) -> tuple["Transitions", jax.Array]:
        """``(buffer, stored)`` with those of ``new`` [lanes] that are ``valid`` in the places of
        the oldest ones; ``stored`` counts all that ever were.
        """
        capacity = self.t.shape[0]
        number = stored + jnp.cumsum(valid, dtype=jnp.int32) - 1
        place = jnp.where(valid, number % capacity, capacity)
        buffer = jax.tree.map(lambda a, b: a.at[place].set(b, mode="drop"), self, new)
        return buffer, stored + jnp.sum(valid, dtype=jnp.int32)

    def reward(self, scale: jax.Array, bonus: jax.Array) -> jax.Array:
        """Log p relative to its mode, the shaping and the bonus: Lipkis and Agogino eq. 21;
        ``scale`` is lambda.
        """
        log_p = -0.5 * jnp.sum(self.z**2, axis=-1)
        return log_p + scale * self.approach + bonus * self.failure.astype(jnp.float32)


def lane_at(sim: Simulator, dense_reward: bool, x0: Any, drift: Any = ()) -> Lane:
    """A `Lane` at the start ``x0``; ``dense_reward``: the distance counts at every state."""
    episode = transition.begin(sim, log_likelihood, x0)
    return _lane(sim, dense_reward, episode, jnp.int32(0), drift, jnp.zeros((), jnp.float32))


def begin_lane(sim, dense_reward, key, z0, drift):
    """A `Lane` at the start with the latents ``z0`` [n0]; where there are none, at one drawn with
    ``key``.
    """
    x0 = x_of(sim.start(), z0) if z0.size else D.sample(sim.start(), key)
    return lane_at(sim, dense_reward, x0, drift)._replace(log_p=-0.5 * jnp.sum(z0**2))


def step_lane(
    sim: Simulator, dense_reward: bool, lane: Lane, z: jax.Array
) -> tuple[Lane, Transitions, jax.Array, jax.Array]:
    """One step with the latents ``z`` [n]: ``(Lane, Transitions of one row, valid, invalid)``.

    ``valid``: it may be learned from. ``invalid``: a number was not finite, the episode ends there.
    A lane that was ``over`` stays as it is.
    """
    x = x_of(sim.disturbance(lane.progress.state), z)
    after = transition.advance(sim, log_likelihood, lane.progress, x, lane.t + 1 >= sim.horizon)
    log_p = lane.log_p - 0.5 * jnp.sum(z**2)
    finite = _finite(z, *jax.tree.leaves(x))
    moved = _lane(sim, dense_reward, after, lane.t + 1, lane.drift, log_p, ~lane.over, finite)
    approach = lane.potential - moved.potential
    moved = moved._replace(gain=lane.gain + approach)
    row = Transitions(
        observation=lane.observation,
        t=lane.t.astype(jnp.float32),
        potential=lane.potential,
        z=z,
        approach=approach,
        failure=moved.failed,
        done=moved.over,
        next_observation=moved.observation,
    )
    kept = select(lane.over, lane, moved)
    invalid = kept.progress.invalid
    return kept, row, ~lane.over & ~invalid, invalid


def _lane(sim, dense_reward, episode, t, drift, log_p, live=True, finite=True):
    """The `Lane` of an ``episode``, without a gain; invalid unless its disturbance is ``finite``,
    and what the learner would see.
    """
    episode = transition.conclude(sim, log_likelihood, episode, live)
    if sim.episodic and not dense_reward:
        distance = episode.distance  # evaluated at its end alone
    else:
        distance = jnp.asarray(sim.evaluate(episode.state)[1])
    # 0 at a failure, whatever a simulator gives there: no failure is nearer than another
    counts = (dense_reward | episode.done) & ~episode.failure
    shaping = jnp.where(counts, distance.astype(jnp.float32), 0)
    seen = observation(sim, episode.state)
    invalid = episode.invalid | ~(finite & _finite(seen, shaping))
    episode = episode._replace(
        invalid=invalid, done=episode.done | invalid, failure=episode.failure & ~invalid
    )
    return Lane(
        progress=episode,
        t=t,
        observation=seen,
        potential=shaping,
        drift=drift,
        log_p=log_p,
        gain=jnp.zeros((), jnp.float32),
    )


def _finite(*arrays: jax.Array) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(a)) for a in arrays]))


def potential(sim: Simulator, dense_reward: Any, state: Any) -> jax.Array:
    """The `Lane`'s at a state that is not its last; 0 where the distance is not finite."""
    distance = jnp.asarray(sim.evaluate(state)[1]).astype(jnp.float32)
    return jnp.where(dense_reward & jnp.isfinite(distance), distance, 0)
