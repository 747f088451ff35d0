"""Gambler's ruin: a gambler at bad odds wins a fortune before he is ruined (the textbook's rare
event with discrete disturbances).

A step wins 1 with probability ``up``, else loses 1; failure at ``goal``, ruin at 0 ends an episode.
Known truth (up = .4, start 1, goal 30), without a horizon: P = (r^start - 1) / (r^goal - 1) =
2.6075611241e-6, r = (1 - up) / up; within the 371 steps of the default: 2.6049921451e-6, less by
9.9e-4 of it (powers of the transition matrix).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array, Numeric
from jast._src.runtime._jax import is_traced
from jast._src.util.checks import real_number, whole_number
from jast.distributions import Categorical

__all__ = ["ruin", "ruin_probability"]


def ruin(up: Numeric = 0.4, start: int = 1, goal: int = 30, horizon: int = 371) -> Simulator:
    """A gambler: a `Simulator` with his fortune as the state (int32 scalar) and x = 1 (won) or 0
    (lost), int32. Reaching the goal is the failure; miss distance: max(goal - fortune, 0).

    Args:
        up: probability of winning, between 0 and 1; traced.
        start: his fortune at first, above 0; traced.
        goal: above ``start``; traced.
        horizon: steps; static.

    Raises:
        ValueError: for parameters outside these ranges.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.ruin(goal=5)
        >>> bool(jast.replay(sim, jnp.ones(4, jnp.int32)).failure)
        True
    """
    up, start, goal = _checked("ruin", up, start, goal)
    start, goal = jnp.asarray(start, jnp.int32), jnp.asarray(goal, jnp.int32)
    return Simulator(
        init=Partial(_init, start),
        step=_step,
        disturbance=Partial(_disturbance, up),
        evaluate=Partial(_evaluate, goal, up),
        horizon=horizon,
        is_terminal=_is_terminal,
    )


def ruin_probability(
    up: Numeric = 0.4, start: int = 1, goal: int = 30, horizon: int | None = None
) -> Array:
    """The failure probability of `ruin`, scalar: in closed form without a horizon, else exactly,
    step by step.

    Args:
        up, start, goal: as for `ruin`.
        horizon: steps, or None for a game without end.

    Raises:
        ValueError: as `ruin`.

    Example:
        >>> import jast
        >>> round(float(jast.simulators.ruin_probability(0.5, 1, 4)), 6)
        0.25
    """
    up, start, goal = _checked("ruin_probability", up, start, goal)
    if horizon is None:
        log_r = jnp.log1p(-up) - jnp.log(up)
        fair = log_r == 0
        log_r = jnp.where(fair, 1, log_r)
        # (r^i - 1) / (r^n - 1) with the greater power taken out where r > 1, so that nothing
        # overflows
        ratio = (
            jnp.expm1(-jnp.abs(log_r) * start)
            / jnp.expm1(-jnp.abs(log_r) * goal)
            * jnp.exp(jnp.maximum(log_r, 0) * (start - goal))
        )
        return jnp.where(fair, jnp.asarray(start / goal, up.dtype), ratio)

    def step(_, carry):
        mass, won = carry  # mass at the fortunes 1 to goal - 1
        end = jnp.zeros((1,), up.dtype)
        gained = jnp.concatenate([end, up * mass[:-1]])
        lost = jnp.concatenate([(1 - up) * mass[1:], end])
        return gained + lost, won + up * mass[-1]

    mass = jnp.zeros((goal - 1,), up.dtype).at[start - 1].set(1)
    return lax.fori_loop(0, horizon, step, (mass, jnp.zeros((), up.dtype)))[1]


def _checked(function, up, start, goal):
    up = real_number(function, "up", up, lambda p: 0 < p < 1, "between 0 and 1")
    start, goal = (
        v if is_traced(v) else whole_number(function, name, v)
        for name, v in (("start", start), ("goal", goal))
    )
    if not is_traced(start) and not is_traced(goal) and goal <= start:
        raise ValueError(f"{function}: goal must be above start = {start}, received {goal}")
    return up.astype(up.dtype), start, goal  # no longer weakly typed


def _init(start, x0):
    return start


def _step(s, x):
    return s + 2 * x - 1


def _disturbance(up, s):
    # a Bernoulli mixes dtypes in its density
    return Categorical(probs=jnp.stack([1 - up, up]), dtype=jnp.int32)


def _evaluate(goal, up, s):
    return s >= goal, jnp.maximum(goal - s, 0).astype(up.dtype)


def _is_terminal(s):
    return s <= 0
