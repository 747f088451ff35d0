"""A Gymnasium environment as a system, by its methods ``reset`` and ``step``: nothing is imported
for it. Goes to the workers by value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jast._src.util.checks import whole_number

__all__ = ["Moment", "gymnasium_system"]


class Moment(NamedTuple):
    """What an environment returned last.

    Example:
        >>> from jast.blackbox import Moment
        >>> distance = lambda now: max(200.0 + now.total, 0.0)  # fails once it has lost 200
        >>> distance(Moment([0.1, 0.2], -1.0, -50.0, False, False, {}, None))
        150.0
    """

    observation: Any
    reward: float
    """Of the last step; 0 after a reset."""
    total: float
    """The sum of the rewards so far."""
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    env: Any
    """The environment itself, for what it does not return."""


@dataclass(eq=False)
class _Environment:
    """The methods that `from_python` asks for."""

    make: Callable[[], Any]
    agent: Callable[[Any], Any] | None
    apply: Callable[[Any, Any], Any] | None
    event: Callable[[Moment], bool] | None
    distance: Callable[[Moment], float]
    seed: int

    def __post_init__(self):
        self.env = self.make()

    def initialize(self, x0=None):
        seed = self.seed if x0 is None else x0
        if np.shape(seed) != () or np.asarray(seed).dtype.kind not in "iu":
            raise ValueError(
                "gymnasium_system: x0 is the seed of the environment, a whole number, received"
                f" {seed!r}"
            )
        observation, info = self.env.reset(seed=int(seed))
        self.now = Moment(observation, 0.0, 0.0, False, False, info, self.env)

    def transition(self, x):
        if self.is_terminal():
            return
        action = None if self.agent is None else self.agent(self.now.observation)
        action = x if self.apply is None else self.apply(action, x)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.now = Moment(
            observation,
            reward=float(reward),
            total=self.now.total + float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            info=info,
            env=self.env,
        )

    def is_event(self):
        return self.now.terminated if self.event is None else bool(self.event(self.now))

    def miss_distance(self):
        return self.distance(self.now)

    def is_terminal(self):
        return self.now.terminated or self.now.truncated

    def observe(self):
        """Its numbers; none where it is a dict, a text or rows of different lengths."""
        try:
            seen = np.ravel(self.now.observation)
        except ValueError:
            seen = np.zeros(0, object)
        return seen if seen.dtype.kind in "fiub" else np.zeros(0)


def gymnasium_system(
    make: Callable[[], Any],
    distance: Callable[[Moment], float],
    *,
    event: Callable[[Moment], bool] | None = None,
    agent: Callable[[Any], Any] | None = None,
    apply: Callable[[Any, Any], Any] | None = None,
    seed: int = 0,
) -> Callable[..., Any]:
    """A system for `from_python` from a Gymnasium environment: the agent is under test, the
    disturbances are what happens to its actions.

    Terminated or truncated ends the episode; transitions after that do nothing. Observations that
    are arrays of numbers are observed. With neither ``agent`` nor ``apply`` the disturbance is the
    action.

    Args:
        make: () -> environment, such as ``lambda: gymnasium.make("Pendulum-v1")``.
        distance: `Moment` -> float, the miss distance.
        event: `Moment` -> bool, the failure. Default: that the environment has terminated.
        agent: observation -> action.
        apply: (action, disturbance) -> action, what is done in its place; without an agent the
            action that it gets is None.
        seed: of each reset; x0 stands in its place where the start is random
            (``start=jast.distributions.seeds``).

    Raises:
        ValueError: for what is no function, and an agent without ``apply``: no disturbance would
            reach the environment.

    Example:
        >>> import gymnasium, jax, jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> system = jast.blackbox.gymnasium_system(
        ...     lambda: gymnasium.make("Pendulum-v1"),
        ...     distance=lambda now: float(now.observation[0] + 1.0),  # hanging straight down
        ...     event=lambda now: bool(now.observation[0] < -0.99),
        ... )
        >>> torque = D.Independent(D.Normal(jnp.zeros(1), 1.0), 1)
        >>> sim = jast.blackbox.from_python(system, horizon=5, disturbance=torque)
        >>> jast.rollout(jax.random.key(0), sim).disturbances.shape
        (5, 1)
    """
    seed = whole_number("gymnasium_system", "seed", seed, 0)
    needed = dict(make=make, distance=distance)
    optional = dict(event=event, agent=agent, apply=apply)
    for name, value in (needed | optional).items():
        if not (callable(value) or name in optional and value is None):
            raise ValueError(f"gymnasium_system: {name} must be a function, received {value!r}")
    if agent is not None and apply is None:
        raise ValueError(
            "gymnasium_system: an agent needs apply=, a function (action, disturbance) -> action;"
            " without it no disturbance reaches the environment"
        )
    return partial(_Environment, **needed, **optional, seed=seed)
