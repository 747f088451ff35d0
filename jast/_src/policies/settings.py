"""Settings that the learners of failures share, checked, and how a training is divided by them."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from jast._src.core.contract import OBSERVED, contract
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.policies.actor import count_latents
from jast._src.policies.training_state import Config
from jast._src.runtime._jax import is_traced
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.checks import check_random_key, real_number, whole_number, wrong

__all__ = ["Asked", "Plan", "is_auto"]

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


class Asked:
    """What a user asks of the learner ``function``, checked in its name."""

    def __init__(self, function: str, key: Any, sim: Simulator):
        check_random_key(function, key)
        contract(function, sim, observed=OBSERVED)
        self.function, self.sim = function, sim
        self.n, self.n0 = count_latents(sim, function)
        (self.m,) = signature_of(sim).observation

    def counts(self, **values: Any) -> list[int]:
        """Each as an int of at least 1."""
        return [whole_number(self.function, name, value) for name, value in values.items()]

    def number(self, name: str, value: Any, holds: Callable[[float], bool], expected: str) -> float:
        """``value`` as a float for which ``holds``, and that is not traced."""
        value = real_number(self.function, name, value, holds, expected)
        if is_traced(value):
            raise ValueError(
                f"{self.function}: {name} must be a number {expected}, received a traced one:"
                f" {self.function} runs on the host"
            )
        return float(value)

    def positive(self, name: str, value: Any) -> float:
        """``value`` as a finite float above 0."""
        return self.number(name, value, lambda v: 0 < v < math.inf, "above 0")

    def finite(self, name: str, value: Any) -> float:
        """``value`` as a finite float."""
        return self.number(name, value, math.isfinite, "that is finite")

    def scale(self, scale: Any) -> float | None:
        """``scale`` as a float above 0, None for "auto"."""
        return None if is_auto(scale) else self.positive("scale", scale)

    def widen(self, widen: Any) -> float | None:
        """``widen`` as a float of at least 1, None for "auto"."""
        if is_auto(widen):
            return None
        return self.number("widen", widen, lambda v: 1 <= v < math.inf, "of at least 1")

    def plan(self, episodes: int, lanes: int, multiple: int = 1) -> Plan:
        """The `Plan` of ``episodes`` of full length, at least 4 a lane; what is learned by, in a
        ``multiple`` of steps.
        """
        if episodes < LEAST_EPISODES * lanes:
            must = f"be at least {LEAST_EPISODES} for each lane, {LEAST_EPISODES * lanes}"
            raise wrong(self.function, "episodes", must, episodes)
        horizon = self.sim.horizon
        steps = -(-episodes * horizon // lanes)
        nominal, exploration = (
            max(horizon, int(fraction * steps)) for fraction in (NOMINAL, EXPLORATION)
        )
        pieces = -(-(steps - nominal - exploration) // multiple)
        return Plan(nominal, exploration, multiple * pieces, multiple * -(-pieces // CHUNKS))

    def networks(self, hidden: Any, shaping: Any, **others: int) -> Config:
        """The `Config` of a learner of networks with the widths ``hidden``."""
        if not isinstance(hidden, tuple | list) or not hidden:
            must = "be the widths of one or more layers"
            raise wrong(self.function, "hidden", must, f"{hidden!r}")
        if shaping not in ("auto", "steps", "end"):
            raise wrong(self.function, "shaping", 'be "auto", "steps" or "end"', f"{shaping!r}")
        hidden = tuple(whole_number(self.function, "hidden", width) for width in hidden)
        auto = shaping == "auto" and not (self.sim.episodic and runs_on_host(self.sim))
        dense_reward = auto or shaping == "steps"
        return self.config(hidden=hidden, dense_reward=dense_reward, **others)

    def config(self, **others: Any) -> Config:
        """The `Config` with the numbers of the simulator."""
        return Config(m=self.m, n=self.n, n0=self.n0, **others)


def is_auto(setting: Any) -> bool:
    return isinstance(setting, str) and setting == "auto"
