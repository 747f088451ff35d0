"""Landing: an aircraft drifts sideways on its way down and must touch down within the runway
(Lipkis and Agogino, NASA).

x1(0) = 0, x2(0) = s0 ~ N(0, sigma_i^2); ten steps of x1 += 1, x2 += x_t, x_t ~ N(0, sigma_t^2) (a =
10, v = 1); failure where abs(x2) > b at the end only. Known truth: P = 2 Phi(-b / sqrt(sigma_i^2 +
10 sigma_t^2)) = 4.0236721906842e-13 at b = 1, sigma_i = .1, sigma_t = .03 (published estimate
3.253e-13 +- 1.378e-13), with two equal modes: s0 = sigma_i^2 b / var = .5263, x_t = sigma_t^2 b /
var = .04737 and their mirror image, var = .019.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array, Numeric
from jast._src.simulators.parameter import positive
from jast.distributions import Normal

__all__ = ["LandingState", "landing", "landing_probability"]

STEPS = 10  # of an approach


class LandingState(NamedTuple):
    """Distance flown and lateral offset from the centre line, no units."""

    x1: jax.Array
    x2: jax.Array


def landing(b: Numeric = 1.0, sigma_i: Numeric = 0.1, sigma_t: Numeric = 0.03) -> Simulator:
    """A landing: an episodic `Simulator` of ten steps, with the initial offset as x0 (scalar) and
    the drift of a step as x (scalar). Miss distance: max(b - abs(offset), 0) at the end.

    Args:
        b: half width of the runway; traced, like the others.
        sigma_i: standard deviation of the initial offset.
        sigma_t: standard deviation of a step's drift.

    Raises:
        ValueError: for a parameter that is not positive.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.landing()
        >>> bool(jast.replay(sim, jnp.full(10, 0.1), x0=0.1).failure)
        True
    """
    b, sigma_i, sigma_t = positive("landing", b=b, sigma_i=sigma_i, sigma_t=sigma_t)
    return Simulator(
        init=_init,
        step=_step,
        disturbance=Partial(_disturbance, sigma_t),
        evaluate=Partial(_evaluate, b),
        horizon=STEPS,
        start=Partial(_start, sigma_i),
        episodic=True,
    )


def landing_probability(b: Numeric = 1.0, sigma_i: Numeric = 0.1, sigma_t: Numeric = 0.03) -> Array:
    """The failure probability of `landing` in closed form: 2 Phi(-b / sqrt(sigma_i^2 + 10
    sigma_t^2)).

    Args:
        b, sigma_i, sigma_t: as for `landing`.

    Example:
        >>> import jast
        >>> 5e-9 < float(jast.simulators.landing_probability(0.8)) < 7e-9
        True
    """
    b, sigma_i, sigma_t = (jnp.asarray(v) for v in (b, sigma_i, sigma_t))
    return 2 * ndtr(-b / jnp.sqrt(sigma_i**2 + STEPS * sigma_t**2))


def _start(sigma_i):
    return Normal(jnp.zeros_like(sigma_i), sigma_i)


def _init(x0):
    return LandingState(jnp.zeros_like(x0), x0)


def _step(s, x):
    return LandingState(s.x1 + 1, s.x2 + x)


def _disturbance(sigma_t, s):
    return Normal(jnp.zeros_like(sigma_t), sigma_t)


def _evaluate(b, s):
    return jnp.abs(s.x2) > b, jnp.maximum(b - jnp.abs(s.x2), 0)
