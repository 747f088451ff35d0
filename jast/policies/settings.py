"""Settings that the learners of failures share, checked, and the course of a training by them."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from jast._checks import real, whole
from jast._jax import is_traced
from jast.incidents import hosted
from jast.simulator import Simulator

__all__ = ["Plan", "auto", "number", "plan", "positive", "shaped", "widening", "widths"]

STRETCHES = 20
NOMINAL, AROUND = 0.03, 0.05
"""Shares of the steps: of the model itself and of the exploration, before the learning."""


class Plan(NamedTuple):
    """Steps of all lanes: int each."""

    nominal: int
    around: int
    learning: int
    stretch: int

    @property
    def total(self) -> int:
        return self.nominal + self.around + self.learning


def plan(function: str, episodes: int, horizon: int, lanes: int, piece: int = 1) -> Plan:
    """The `Plan` of ``episodes`` of full length; what is learned by, in ``piece`` steps at once.

    Raises:
        ValueError: for fewer than 4 episodes a lane.
    """
    if episodes < 4 * lanes:
        raise ValueError(
            f"{function}: episodes must be at least 4 for each lane, {4 * lanes}, received"
            f" {episodes}"
        )
    steps = -(-episodes * horizon // lanes)
    nominal, around = (max(horizon, int(share * steps)) for share in (NOMINAL, AROUND))
    pieces = -(-(steps - nominal - around) // piece)
    return Plan(nominal, around, piece * pieces, piece * -(-pieces // STRETCHES))


def auto(setting: Any) -> bool:
    return isinstance(setting, str) and setting == "auto"


def number(
    function: str, name: str, value: Any, holds: Callable[[float], bool], expected: str
) -> float:
    """``value`` as a float for which ``holds``, and that is not traced."""
    value = real(function, name, value, holds, expected)
    if is_traced(value):
        raise ValueError(
            f"{function}: {name} must be a number {expected}, received a traced one: {function}"
            " runs on the host"
        )
    return float(value)


def positive(function: str, name: str, value: Any) -> float:
    """``value`` as a finite float above 0."""
    return number(function, name, value, lambda v: 0 < v < math.inf, "above 0")


def widening(function: str, widen: Any) -> float | None:
    """``widen`` as a float of at least 1, None for "auto"."""
    if auto(widen):
        return None
    return number(function, "widen", widen, lambda v: 1 <= v < math.inf, "of at least 1")


def widths(function: str, hidden: Any) -> tuple[int, ...]:
    """``hidden`` as widths of layers."""
    if not isinstance(hidden, tuple | list) or not hidden:
        raise ValueError(
            f"{function}: hidden must be the widths of one or more layers, received {hidden!r}"
        )
    return tuple(whole(function, "hidden", width) for width in hidden)


def shaped(function: str, shaping: Any, sim: Simulator) -> bool:
    """Whether the distance counts at every state."""
    if shaping not in ("auto", "steps", "end"):
        raise ValueError(
            f'{function}: shaping must be "auto", "steps" or "end", received {shaping!r}'
        )
    if shaping == "auto":
        return not (sim.episodic and hosted(sim))
    return shaping == "steps"
