"""Environments with ``reset(key, params)`` and ``step_env(key, state, action, params)``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import jax

from jast._src.adapters import closed_loop
from jast._src.core.simulator import Simulator
from jast._src.runtime._jax import is_traced, without_stops

__all__ = ["gymnax"]

# of gymnax, craftax and JaxMARL
LIMITS = (("params", "max_steps_in_episode"), ("params", "max_timesteps"), ("env", "max_steps"))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Environment:
    env: Any = field(metadata=dict(static=True))
    subject: Any
    """Its params"""

    def reset(self, key: Any) -> closed_loop.Outcome:
        observation, state = self.env.reset(key, *self._given())
        return closed_loop.Outcome(state, observation, 0.0, False)

    def step(self, key: Any, state: Any, action: Any, push: Callable) -> closed_loop.Outcome:
        step = without_stops(self.env.step_env)
        observation, state, reward, done, _ = step(key, push(state), action, *self._given())
        # of several agents: those of each by its name
        done = done["__all__"] if type(done) is dict else done
        return closed_loop.Outcome(state, observation, reward, done)

    def _given(self) -> tuple[Any, ...]:
        return () if self.subject is None else (self.subject,)


def gymnax(
    env: Any,
    params: Any,
    policy: Callable[[Any], Any],
    *,
    horizon: int,
    observation: closed_loop.Noise | None = None,
    action: closed_loop.Noise | None = None,
    force: closed_loop.Change | None = None,
    parameters: dict[str, Any] | closed_loop.Change | None = None,
    seed: int | Literal["episode", "step"] = 0,
    failure: closed_loop.Judgement | None = None,
    distance: closed_loop.Judgement | None = None,
    observe: closed_loop.Judgement | None = None,
) -> Simulator:
    """A policy in an environment of gymnax, or of a library with the same ``reset(key, params)``
    and ``step_env(key, state, action, params)``, such as craftax; JaxMARL has them without params.

    Uses ``step_env``, as ``step`` starts anew by itself and so hides failures. Derivatives go
    through what the environment wraps in ``stop_gradient``: gymnax does so with each state. An
    episode in whose state, observation or reward a NaN stands is invalid.

    What is random is any of five arguments. Draws of ``observation``, ``action``, ``force`` and a
    seed a step are the disturbances, by these names; ``parameters`` and a seed an episode are x0.
    In the place of a distribution may stand a function `Instant` -> distribution (not of
    ``parameters``). A batch of distributions counts as independent numbers.

    Args:
        env: the environment, without wrappers.
        params: its parameters; traced, so that others do not compile again. None: its methods take
            none.
        policy: observation -> action; of several agents, all their observations -> all their
            actions. Bind what you want to sweep by `jax.tree_util.Partial`.
        horizon: steps of an episode.
        observation: noise added to what the policy sees: a distribution of the shape of the
            observation, such as ``Normal(jnp.zeros(4), 0.1)``; or a pair (distribution, function
            (observation, draw) -> observation).
        action: the same of the action, which has to be of floats where noise is added.
        force: a pair (distribution, function (state, draw) -> state): what happens to the
            environment's own state before each step.
        parameters: names of params and their distributions, drawn once an episode; or a pair
            (distribution, function (params, draw) -> params).
        seed: of the environment's own key. A number: the same start and the same draws in all
            episodes. "episode" or "step": drawn for each of them, so that a failure is its seed; of
            unknown density, as only the seed is chosen.
        failure: `Instant` -> bool. Default: the environment has terminated. Where that is not the
            failure, it ends the episode.
        distance: `Instant` -> float, smaller where a failure is nearer. Default: 1, which leads no
            search to a failure.
        observe: `Instant` -> float vector, 64 numbers at most, of what learned policies and
            networks of jast see. Default: the observation; where that is longer, the time.

    Returns:
        `Simulator`, whose states are `Instant`.

    Raises:
        ValueError: for an environment without these methods or with wrappers, an argument of
            another kind, where nothing is random, and for a horizon at which ``step_env`` itself
            says that the time is over.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from jast.distributions import Normal
        >>> class Drift:  # as gymnax has them
        ...     def reset(self, key, params):
        ...         return jnp.zeros(1), jnp.zeros(1)
        ...
        ...     def step_env(self, key, state, action, params):
        ...         state = params * state + action
        ...         return state, state, -jnp.abs(state[0]), jnp.abs(state[0]) > 1.0, {}
        >>> sim = jast.adapters.gymnax(
        ...     Drift(),
        ...     jnp.array(1.1),
        ...     policy=lambda seen: -0.5 * seen,
        ...     horizon=20,
        ...     observation=Normal(jnp.zeros(1), 0.2),
        ...     distance=lambda now: 1.0 - jnp.abs(now.observation[0]),
        ... )
        >>> jast.rollout(jax.random.key(0), jast.check(sim)).disturbances["observation"].shape
        (20, 1)
    """
    given = dict(locals())
    kind = type(env)
    if not (hasattr(kind, "step_env") and hasattr(kind, "reset")):
        wraps = hasattr(env, "step_env")
        raise ValueError(
            "gymnax: env must be an environment with reset(key, params) and step_env(key, state,"
            f" action, params), received {kind.__name__}"
            + ("; give the environment that it wraps" if wraps else "")
        )
    # but for gymnax 1.0, `done` of step_env says also that the time is over
    for place, name in LIMITS if not hasattr(env, "is_terminated") else ():
        limit = getattr(params if place == "params" else env, name, None)
        if not (limit is None or is_traced(limit)) and horizon >= limit:
            raise ValueError(
                f"gymnax: horizon must be below {place}.{name}, which is {limit}: there step_env"
                f" says that it has terminated; received {horizon}"
            )
    system = _Environment(given.pop("env"), given.pop("params"))
    return closed_loop.simulator("gymnax", system, **given)
