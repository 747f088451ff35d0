"""Autoregression: a stationary Gaussian process of memory one, the Ornstein-Uhlenbeck process at
equal times, must stay below a threshold.

s' = a s + sqrt(1 - a^2) x, x ~ N(0, 1), s0 = 0; failure where s >= threshold at any step. Known
truth (a = exp(-.1), threshold 5, 100 steps; Nystrom quadrature of the first-passage mass, two grids
agree to 1e-9): P = 1.7438880336e-5.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Numeric
from jast._src.simulators.parameter import positive
from jast.distributions import Normal

__all__ = ["autoregression"]


def autoregression(rate: Numeric = 0.1, threshold: Numeric = 5.0, horizon: int = 100) -> Simulator:
    """An autoregressive process from 0: a `Simulator` with a scalar state of variance below 1 and a
    standard normal x (scalar). It fails where the state reaches a threshold; miss distance:
    max(threshold - s, 0).

    Args:
        rate: of forgetting: a step keeps exp(-rate) of the state; traced.
        threshold: in stationary standard deviations; traced.
        horizon: steps; static.

    Raises:
        ValueError: for a parameter that is not positive, or a horizon below 1.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.autoregression(threshold=3.0, horizon=50)
        >>> bool(jast.rollout(jax.random.key(0), sim).distance >= 0)
        True
    """
    rate, threshold = positive("autoregression", rate=rate, threshold=threshold)
    return Simulator(
        init=Partial(_init, rate),
        step=Partial(_step, rate),
        disturbance=_disturbance,
        evaluate=Partial(_evaluate, threshold),
        horizon=horizon,
    )


def _init(rate, x0):
    return jnp.zeros_like(rate)


def _step(rate, s, x):
    return jnp.exp(-rate) * s + jnp.sqrt(-jnp.expm1(-2 * rate)) * x


def _disturbance(s):
    return Normal(jnp.zeros_like(s), jnp.ones_like(s))


def _evaluate(threshold, s):
    return s >= threshold, jnp.maximum(threshold - s, 0)
