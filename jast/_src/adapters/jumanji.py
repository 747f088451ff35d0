"""Environments with ``reset(key)`` and ``step(state, action)`` that return (state, timestep)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp

from jast._src.adapters import closed_loop
from jast._src.core.simulator import Simulator

__all__ = ["jumanji"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Environment:
    subject: Any = field(metadata=dict(static=True))
    """The environment"""

    def reset(self, key: Any) -> closed_loop.Outcome:
        state, first = self.subject.reset(key)
        return closed_loop.Outcome(state, first.observation, 0.0, False)

    def step(self, key: Any, state: Any, action: Any, push: Callable) -> closed_loop.Outcome:
        state, now = self.subject.step(push(state), action)
        # the end of the time, which is no failure, keeps a discount
        terminated = now.last() & jnp.all(jnp.asarray(now.discount) == 0)
        return closed_loop.Outcome(state, now.observation, now.reward, terminated)


def jumanji(
    env: Any,
    policy: Callable[[Any], Any],
    *,
    horizon: int,
    observation: closed_loop.Noise | None = None,
    action: closed_loop.Noise | None = None,
    force: closed_loop.Change | None = None,
    parameters: closed_loop.Change | None = None,
    seed: int | Literal["episode"] = 0,
    failure: closed_loop.Judgement | None = None,
    distance: closed_loop.Judgement | None = None,
    observe: closed_loop.Judgement | None = None,
) -> Simulator:
    """A policy in an environment of jumanji, or another whose ``reset(key)`` and ``step(state,
    action)`` return a state and a timestep with ``observation``, ``reward``, ``discount`` and
    ``last()``.

    Arguments are those of `brax`, with the same meaning. The environment has terminated where the
    last timestep has no discount. Many do so also when a task is solved or the time is over: there,
    say what a failure is. Rewards of several agents are added up.

    Args:
        env: the environment, without a wrapper that starts anew by itself: ``jumanji.make(name)``.
        policy: observation, most often with fields such as ``seen.action_mask`` -> action.
        horizon: steps of an episode.
        observation, action: noise on what the policy sees and on what it does, as in `gymnax`.
        force: a pair (distribution, function (state, draw) -> state).
        parameters: a pair (distribution, function (env, draw) -> env), as in `brax`.
        seed: of the key of ``reset``, from which an environment also draws later on.
        failure, distance, observe: functions of the `Instant`, as in `gymnax`.

    Returns:
        `Simulator`, whose states are `Instant`.

    Raises:
        ValueError: for an environment without these methods or one that starts anew by itself, an
            argument of another kind, and where nothing is random.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from typing import Any, NamedTuple
        >>> from jast.distributions import Normal
        >>> class TimeStep(NamedTuple):  # as jumanji has them
        ...     observation: Any
        ...     reward: Any = 0.0
        ...     discount: Any = 1.0
        ...     last: Any = lambda: False
        >>> class Drift:
        ...     def reset(self, key):
        ...         return jnp.zeros(1), TimeStep(jnp.zeros(1))
        ...
        ...     def step(self, state, action):
        ...         x = 1.1 * state + action
        ...         ended = jnp.abs(x[0]) > 1.0
        ...         return x, TimeStep(x, -jnp.abs(x[0]), jnp.where(ended, 0.0, 1.0), lambda: ended)
        >>> sim = jast.adapters.jumanji(
        ...     Drift(),
        ...     policy=lambda seen: -0.5 * seen,
        ...     horizon=20,
        ...     action=Normal(jnp.zeros(1), 0.1),
        ...     distance=lambda now: 1.0 - jnp.abs(now.observation[0]),
        ... )
        >>> jast.rollout(jax.random.key(0), jast.check(sim)).disturbances["action"].shape
        (20, 1)
    """
    given = dict(locals())
    closed_loop.check_environment("jumanji", env, "reset(key)", "step(state, action)", seed=seed)
    return closed_loop.simulator("jumanji", _Environment(given.pop("env")), **given)
