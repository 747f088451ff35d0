"""walk1D, the field's first example: a random walk that fails on leaving a band.

Known truth (sigma = 1, threshold = 10, failure at any step; quadrature, two grids agree to 1e-9):
"two-sided", T = 30 (POMDPStressTesting.jl): P = .1087363323; "one-sided", T = 10 (AdaStress.jl): P
= 9.578759495e-4. Likeliest failure by raw log density, two-sided: 7 equal steps of 10/7, log p =
-13.5754; by density over that of the mode: 30 steps of 1/3, -1.6667.
"""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Numeric
from jast._src.simulators.parameter import positive
from jast._src.util.checks import one_of
from jast.distributions import Normal

__all__ = ["walk1d"]

HORIZON = {"two-sided": 30, "one-sided": 10}  # steps of an episode, as published


def walk1d(
    form: Literal["two-sided", "one-sided"] = "two-sided",
    sigma: Numeric = 1.0,
    threshold: Numeric = 10.0,
    horizon: int | None = None,
) -> Simulator:
    """A random walk from 0, s += x with x ~ N(0, sigma^2): a `Simulator` with a scalar state.

    Args:
        form: "two-sided" fails where abs(s) >= threshold within 30 steps, miss distance
            max(threshold - abs(s), 0); "one-sided" where s >= threshold within 10 steps,
            max(threshold - s, 0).
        sigma: of a step; traced.
        threshold: see ``form``; traced.
        horizon: steps; static. Default: by the form.

    Raises:
        ValueError: for another form, or a parameter that is not positive.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> bool(jast.replay(jast.simulators.walk1d(), jnp.ones(30)).failure)
        True
    """
    one_of("walk1d", "form", form, HORIZON)
    sigma, threshold = positive("walk1d", sigma=sigma, threshold=threshold)
    evaluate = Partial(_two_sided if form == "two-sided" else _one_sided, threshold)
    return Simulator(
        init=Partial(_init, sigma),
        step=_step,
        disturbance=Partial(_disturbance, sigma),
        evaluate=evaluate,
        horizon=HORIZON[form] if horizon is None else horizon,
    )


def _init(sigma, x0):
    return jnp.zeros((), sigma.dtype)


def _step(s, x):
    return s + x


def _disturbance(sigma, s):
    return Normal(jnp.zeros_like(sigma), sigma)


def _two_sided(threshold, s):
    return jnp.abs(s) >= threshold, jnp.maximum(threshold - jnp.abs(s), 0)


def _one_sided(threshold, s):
    return s >= threshold, jnp.maximum(threshold - s, 0)
