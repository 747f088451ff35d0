"""The gains of the F-16's inner loops: linear-quadratic regulators with integral action, designed
about level flight at 502 ft/s and sea level.

The loops are those of Heidlauf, Collins, Bolender and Bak (2018), Verification challenges in F-16
ground collision avoidance and other automated maneuvers. Their gains are not used: these are a
design of our own, with the weights below. `jast._src.simulators.arch.gcas` has the result, so that
nothing is designed when it is imported.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.typing import Numeric
from jast._src.simulators.arch.f16 import F16, Controls, motion
from jast._src.simulators.arch.gcas import measured

__all__ = ["Design", "design", "level", "trim"]

SPEED = 502.0
"""ft/s"""
POWER = 64.94
"""Of full throttle, below military power."""
LOOPS = (
    ([0, 1], [0], [5], [0, 20, 100]),
    ([2, 3, 4], [1, 2], [6, 7], [0, 0, 0, 10, 100]),
)
"""Of `_rates`: a loop's states, its surfaces, what it controls, and its weights, of the squares of
the states and of the integrals of the errors."""
EFFORT = 0.03
"""Weight of the square of a surface's angle in degrees."""
NEWTON = 20  # steps of Newton's method, more than it takes


class Design(NamedTuple):
    """Level flight, and the gains about it."""

    alpha: float
    """rad"""
    controls: Controls
    pitch: np.ndarray
    """[3]: degrees by which alpha, q and the integral lower the elevator's angle"""
    lateral: np.ndarray
    """[2, 5]: degrees by which beta, p, r and the integrals lower those of aileron and rudder"""


def level(speed: Numeric, alpha: Numeric, power: Numeric) -> F16:
    """The aircraft in level flight at sea level."""
    zero = jnp.zeros(3)
    along = jnp.stack([jnp.cos(alpha), jnp.zeros(()), jnp.sin(alpha)])
    return F16(
        velocity=speed * along,
        attitude=zero.at[1].set(alpha),
        rates=zero,
        position=zero,
        power=jnp.asarray(power),
    )


def trim(speed: Numeric) -> tuple[jax.Array, Controls]:
    """Angle of attack (rad) and controls of level flight at ``speed`` (ft/s) and less than military
    power, by Newton's method.
    """
    zero = jnp.zeros(())

    def residual(v: jax.Array) -> jax.Array:
        alpha, elevator, throttle = v
        now = level(speed, alpha, POWER * throttle)
        rate, _ = motion(now, Controls(throttle, elevator, zero, zero))
        return jnp.stack([rate.velocity[0], rate.velocity[2], rate.rates[1]])

    def better(_: int, v: jax.Array) -> jax.Array:
        return v - jnp.linalg.solve(jax.jacfwd(residual)(v), residual(v))

    alpha, elevator, throttle = lax.fori_loop(0, NEWTON, better, jnp.array([0.1, -1.0, 0.2]))
    return alpha, Controls(throttle, elevator, zero, zero)


def design() -> Design:
    """The design, in float64."""
    from scipy.linalg import solve_continuous_are

    with jax.enable_x64(True):
        alpha, controls = jax.jit(trim)(SPEED)
        at = jnp.array([alpha, 0, 0, 0, 0]), jnp.array([controls.elevator, 0, 0])
        slopes = jax.jit(jax.jacfwd(partial(_rates, alpha, controls.throttle), (0, 1)))(*at)
    by_x, by_u = (np.asarray(m) for m in slopes)
    gains = []
    for states, surfaces, controlled, weights in LOOPS:
        rows = states + controlled
        a = np.pad(by_x[np.ix_(rows, states)], ((0, 0), (0, len(controlled))))
        b, effort = by_u[np.ix_(rows, surfaces)], EFFORT * np.eye(len(surfaces))
        cost = solve_continuous_are(a, b, np.diag(weights), effort)
        gains.append(np.linalg.solve(effort, b.T @ cost))
    controls = Controls(*(float(c) for c in controls))
    return Design(float(alpha), controls, gains[0][0], gains[1])


def _rates(level_alpha: jax.Array, throttle: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
    """[8]: the rates of alpha, q, beta, p and r, and what the loops control; of x = alpha, q, beta,
    p, r and u = elevator, aileron, rudder.
    """
    alpha, q, beta, p, r = x
    ahead = jnp.cos(beta)
    way = jnp.stack([jnp.cos(alpha) * ahead, jnp.sin(beta), jnp.sin(alpha) * ahead])
    now = level(SPEED, level_alpha, POWER * throttle)
    now = now._replace(velocity=SPEED * way, rates=jnp.stack([p, q, r]))
    rate, loads = motion(now, Controls(throttle, *u))
    alphas, betas = jax.jvp(lambda now: (now.alpha, now.beta), (now,), (rate,))[1]
    dp, dq, dr = rate.rates
    return jnp.concatenate([jnp.stack([alphas, dq, betas, dp, dr]), measured(now, loads)])
