"""Settings that the learners of failures share, checked, and how a training is divided by them."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from jast._src.core.simulator import Simulator
from jast._src.runtime._jax import is_traced
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.checks import real_number, whole_number

__all__ = [
    "Plan",
    "check_hidden",
    "check_number",
    "check_positive",
    "check_scale",
    "check_shaping",
    "check_widen",
    "is_auto",
    "make_plan",
]

CHUNKS = 20  # of the learning, between which it is watched and kept; a convention
NOMINAL = 0.03  # fraction of the steps that are of the model itself
EXPLORATION = 0.05  # fraction around the model, before the learning
LEAST_EPISODES = 4  # of each lane


class Plan(NamedTuple):
    """Steps of all lanes in each part of a training."""

    nominal: int
    exploration: int
    learning: int
    chunk: int
    """Steps of the learning between two rows of the history."""

    @property
    def total(self) -> int:
        return self.nominal + self.exploration + self.learning


def make_plan(function: str, episodes: int, horizon: int, lanes: int, multiple: int = 1) -> Plan:
    """The `Plan` of ``episodes`` of full length; what is learned by, in a ``multiple`` of steps.

    Raises:
        ValueError: for fewer than 4 episodes a lane.
    """
    if episodes < LEAST_EPISODES * lanes:
        raise ValueError(
            f"{function}: episodes must be at least {LEAST_EPISODES} for each lane,"
            f" {LEAST_EPISODES * lanes}, received {episodes}"
        )
    steps = -(-episodes * horizon // lanes)
    nominal, exploration = (
        max(horizon, int(fraction * steps)) for fraction in (NOMINAL, EXPLORATION)
    )
    pieces = -(-(steps - nominal - exploration) // multiple)
    return Plan(nominal, exploration, multiple * pieces, multiple * -(-pieces // CHUNKS))


def is_auto(setting: Any) -> bool:
    return isinstance(setting, str) and setting == "auto"


def check_number(
    function: str, name: str, value: Any, holds: Callable[[float], bool], expected: str
) -> float:
    """``value`` as a float for which ``holds``, and that is not traced."""
    value = real_number(function, name, value, holds, expected)
    if is_traced(value):
        raise ValueError(
            f"{function}: {name} must be a number {expected}, received a traced one: {function}"
            " runs on the host"
        )
    return float(value)


def check_positive(function: str, name: str, value: Any) -> float:
    """``value`` as a finite float above 0."""
    return check_number(function, name, value, lambda v: 0 < v < math.inf, "above 0")


def check_scale(function: str, scale: Any) -> float | None:
    """``scale`` as a float above 0, None for "auto"."""
    return None if is_auto(scale) else check_positive(function, "scale", scale)


def check_widen(function: str, widen: Any) -> float | None:
    """``widen`` as a float of at least 1, None for "auto"."""
    if is_auto(widen):
        return None
    return check_number(function, "widen", widen, lambda v: 1 <= v < math.inf, "of at least 1")


def check_hidden(function: str, hidden: Any) -> tuple[int, ...]:
    """``hidden`` as widths of layers."""
    if not isinstance(hidden, tuple | list) or not hidden:
        raise ValueError(
            f"{function}: hidden must be the widths of one or more layers, received {hidden!r}"
        )
    return tuple(whole_number(function, "hidden", width) for width in hidden)


def check_shaping(function: str, shaping: Any, sim: Simulator) -> bool:
    """Whether the distance counts at every state."""
    if shaping not in ("auto", "steps", "end"):
        raise ValueError(
            f'{function}: shaping must be "auto", "steps" or "end", received {shaping!r}'
        )
    if shaping == "auto":
        return not (sim.episodic and runs_on_host(sim))
    return shaping == "steps"
