"""Environments with ``reset(key) -> State`` and ``step(State, action) -> State``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp

from jast._src.adapters import closed_loop
from jast._src.adapters.state_arrays import refuse_warp
from jast._src.core.simulator import Simulator

__all__ = ["brax"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Environment:
    subject: Any = field(metadata=dict(static=True))
    """The environment"""

    def reset(self, key: Any) -> closed_loop.Outcome:
        return _outcome(self.subject.reset(key))

    def step(self, key: Any, state: Any, action: Any, push: Callable) -> closed_loop.Outcome:
        return _outcome(self.subject.step(push(state), action))


def _outcome(state: Any) -> closed_loop.Outcome:
    done = jnp.asarray(state.done).astype(bool)
    # what counts steps says so when the time is over, which is no failure
    late = state.info.get("truncation", 0.0) if isinstance(state.info, dict) else 0.0
    return closed_loop.Outcome(state, state.obs, state.reward, done & ~jnp.asarray(late, bool))


def brax(
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
    """A policy in an environment of brax or mujoco_playground: ``reset(key)`` and ``step(state,
    action)`` return a state with ``obs``, ``reward``, ``done`` and ``info``.

    Arguments that are not explained here are those of `gymnax`, with the same meaning. ``done`` is
    a failure by default, but for the end of the time that ``info["truncation"]`` tells.

    Args:
        env: the environment, without a wrapper that starts anew by itself and so hides failures:
            ``brax.envs.get_environment(name)``, or ``create(name, auto_reset=False)``.
        policy: observation -> action. A policy of brax's training is ``lambda seen: act(seen,
            key)[0]``.
        horizon: steps of an episode.
        observation, action: noise on what the policy sees and on what it does, as in `gymnax`.
        force: a pair (distribution, function (state, draw) -> state): what happens to the whole
            state before each step, such as a change of ``state.pipeline_state``.
        parameters: a pair (distribution, function (env, draw) -> env), drawn once an episode. The
            function gets a copy of the environment that it may change, such as ``env.sys``.
        seed: of the key of ``reset``, from which an environment also draws later on: a number, or
            "episode" for one drawn for each episode.
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
        >>> class State(NamedTuple):  # as brax has them
        ...     pipeline_state: Any
        ...     obs: Any
        ...     reward: Any
        ...     done: Any
        ...     info: dict
        >>> class Drift:
        ...     def reset(self, key):
        ...         return State(jnp.zeros(1), jnp.zeros(1), 0.0, 0.0, {})
        ...
        ...     def step(self, state, action):
        ...         x = 1.1 * state.pipeline_state + action
        ...         return State(x, x, -jnp.abs(x[0]), jnp.where(jnp.abs(x[0]) > 1.0, 1.0, 0.0), {})
        >>> sim = jast.adapters.brax(
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
    hint = "; brax.envs.get_environment(name) makes one"
    instead = 'of mujoco_playground, registry.load(name, config_overrides={"impl": "jax"})'
    refuse_warp("brax", getattr(env, "mjx_model", None), instead)
    closed_loop.check_environment(
        "brax", env, "reset(key)", "step(state, action)", seed=seed, hint=hint
    )
    return closed_loop.simulator("brax", _Environment(given.pop("env")), **given)
