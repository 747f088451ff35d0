"""Pendulum: a torque-limited controller holds an inverted pendulum upright and sees its state
through noise (Algorithms for Validation).

theta0 ~ N(0, (pi/32)^2), omega0 ~ N(0, .5^2); each of 40 steps of .05 s: o = s + x, x ~ N(0, .1^2
I); a = clip(-15 o1 - 8 o2, -2, 2); omega += (15 sin theta + 3 a) .05; theta += .05 omega; omega is
clipped to +-8 (m = l = 1, g = 10). Failure where abs(theta) >= pi/4 at any of the 41 states. Known
truth: P = 8.169e-3 +- .009e-3 (Monte Carlo, 1e8 episodes, one standard error). Undisturbed: no
failure.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Numeric
from jast._src.simulators.parameter import positive
from jast.distributions import MultivariateNormalDiag

__all__ = ["PendulumState", "pendulum"]

STEPS = 40  # of an episode
DT = 0.05  # s
TORQUE = 2.0  # N m, at most
SPEED = 8.0  # rad/s, at most


class PendulumState(NamedTuple):
    """Angle from upright (radians) and angular velocity (radians a second)."""

    theta: jax.Array
    omega: jax.Array


def pendulum(
    noise: Numeric = 0.1,
    sigma_theta: Numeric = jnp.pi / 32,
    sigma_omega: Numeric = 0.5,
    limit: Numeric = jnp.pi / 4,
) -> Simulator:
    """A controlled pendulum: a `Simulator` of 40 steps, with (theta0, omega0) as x0 [2] and the
    error of the observation as x [2]. Miss distance: max(limit - abs(theta), 0).

    Args:
        noise: standard deviation of both errors; traced, like the others.
        sigma_theta, sigma_omega: standard deviations of the start.
        limit: the angle (radians) of a failure.

    Raises:
        ValueError: for a parameter that is not positive.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.pendulum()
        >>> bool(jast.replay(sim, jnp.zeros((40, 2)), x0=jnp.zeros(2)).failure)
        False
    """
    noise, sigma_theta, sigma_omega, limit = positive(
        "pendulum", noise=noise, sigma_theta=sigma_theta, sigma_omega=sigma_omega, limit=limit
    )
    return Simulator(
        init=_init,
        step=_step,
        disturbance=Partial(_disturbance, noise),
        evaluate=Partial(_evaluate, limit),
        horizon=STEPS,
        start=Partial(_start, jnp.stack([sigma_theta, sigma_omega])),
    )


def _start(sigma):
    return MultivariateNormalDiag(jnp.zeros_like(sigma), sigma)


def _init(x0):
    return PendulumState(x0[0], x0[1])


def _step(s, x):
    torque = jnp.clip(-15 * (s.theta + x[0]) - 8 * (s.omega + x[1]), -TORQUE, TORQUE)
    omega = s.omega + (15 * jnp.sin(s.theta) + 3 * torque) * DT
    return PendulumState(s.theta + DT * omega, jnp.clip(omega, -SPEED, SPEED))


def _disturbance(noise, s):
    scale = jnp.stack([noise, noise])
    return MultivariateNormalDiag(jnp.zeros_like(scale), scale)


def _evaluate(limit, s):
    angle = jnp.abs(s.theta)
    return angle >= limit, jnp.maximum(limit - angle, 0)
