"""The miss distance at every moment of an episode, and how these depend on its normal numbers.

A simulator says at every state how far it is from failing, so one run tells as many limit states as
the episode has moments: it fails if any of them does.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core.rewards import likelihood
from jast._src.core.simulator import Simulator
from jast._src.core.transition import advance, begin, conclude
from jast._src.normal_space.design_point_descent import differentiable
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.transform import Outcomes, outcomes_of, policy_of
from jast._src.runtime._jax import quick
from jast._src.runtime.checkpoints import answer_once

__all__ = ["Linearised", "cost_of_slopes", "distances", "slopes"]

STEP = 0.1
"""Standard deviations that one number is moved by, to see what it changes."""
GRADIENT = 3  # evaluations that a value with its gradient counts as


class Linearised(NamedTuple):
    """How far M moments are from failing near to a point. On the host."""

    point: np.ndarray
    """[D]"""
    distance: np.ndarray
    """[M] there; NaN of moments that its episode did not come to"""
    slope: np.ndarray
    """[M, D]"""


def distances(sim: Simulator, z: np.ndarray) -> tuple[Outcomes, np.ndarray]:
    """`Outcomes` of the points ``z`` [n, D], and the miss distance at each moment [n, M]: at s_0 ..
    s_T, or at the end of a system that is judged there. NaN where an episode had failed, or ended.
    """
    o, g = evaluate_points(sim, z, _play)
    return o, np.where(np.isfinite(g), g, np.nan).astype(np.float64)


def _play(sim: Simulator, z: jax.Array) -> tuple[Outcomes, jax.Array]:
    """`distances` of the one episode of ``z`` [D]."""
    policy, last, reward = policy_of(sim, z), jnp.asarray(sim.horizon, jnp.int32), likelihood(sim)

    def safe(progress):
        return jnp.where(progress.failure, jnp.nan, sim.evaluate(progress.state)[1])

    def body(carry):
        progress, t, g = carry
        x = D.mode(policy.disturbance(progress.state, t))
        new = advance(sim, reward, progress, x, t + 1 >= last)
        return new, t + 1, g if sim.episodic else g.at[t + 1].set(safe(new))

    begun = begin(sim, reward, D.mode(policy.start()))
    nothing = jnp.full(1 if sim.episodic else sim.horizon + 1, jnp.nan, begun.distance.dtype)
    first = nothing if sim.episodic else nothing.at[0].set(safe(begun))
    carry = begun, jnp.zeros((), jnp.int32), first
    end, length, g = lax.while_loop(lambda c: ~c[0].done, body, carry)
    end = conclude(sim, reward, end)
    if sim.episodic:
        g = jnp.where(end.failure, jnp.nan, end.distance)[None]
    return outcomes_of(sim, end, length), g


def cost_of_slopes(sim: Simulator, d: int, gradients: bool) -> int:
    """Evaluations of `slopes`. A gradient tells of one moment, so that differences are cheaper
    where there are many.
    """
    return GRADIENT if gradients and sim.episodic else d + 1


def slopes(sim: Simulator, point: np.ndarray, gradients: bool) -> Linearised:
    """The system linearised at a ``point`` [D] that is safe: by its gradient, or by differences,
    each towards the model's middle, where failures are rarer.
    """
    if gradients and sim.episodic:
        g, slope = answer_once(_gradients, sim, point[None])
        return Linearised(point, g.astype(np.float64), slope.astype(np.float64))
    step = np.where(point > 0, -STEP, STEP)
    moved = point + np.concatenate([np.zeros((1, len(point))), np.diag(step)]).astype(point.dtype)
    _, g = distances(sim, moved)
    slope = ((g[1:] - g[0]) / step[:, None]).T
    return Linearised(point, g[0], np.nan_to_num(slope))


@quick
def _gradients(sim: Simulator, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distances [n] and their gradients [n, D]."""
    return jax.vmap(jax.value_and_grad(lambda z: differentiable(sim, z).distance))(z)
