"""Policies: who chooses the disturbances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import jax
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.util import display

__all__ = ["Policy", "nominal_policy", "undisturbed"]


@display.printable()
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Policy:
    """Chooses disturbances. A pytree of two functions: ``start() -> Distribution`` over x0 and
    ``disturbance(state, t) -> Distribution`` over x_t, t = 0, 1, ...

    Example:
        >>> import jax, jast
        >>> from jast import distributions as D
        >>> sim = jast.simulators.walk1d()
        >>> push = jast.Policy(sim.start, lambda state, t: D.Normal(1.0, 0.1))
        >>> bool(jast.rollout(jax.random.key(0), sim, push).failure)
        True
    """

    start: Callable[[], Any]
    disturbance: Callable[[Any, Any], Any]

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if callable(value) and not isinstance(value, Partial):
                object.__setattr__(self, f.name, Partial(value))


def nominal_policy(sim):
    """The simulator's own disturbance model."""
    return Policy(sim.start, Partial(_nominal, sim.disturbance))


def undisturbed(sim):
    """The mode of every disturbance (the median where a distribution names no mode)."""
    return Policy(Partial(_mode_start, sim.start), Partial(_mode_step, sim.disturbance))


def _nominal(disturbance, state, t):
    return disturbance(state)


def _mode_start(start):
    return D.Deterministic(D.mode(start()))


def _mode_step(disturbance, state, t):
    return D.Deterministic(D.mode(disturbance(state)))
