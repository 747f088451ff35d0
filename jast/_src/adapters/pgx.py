"""Environments with ``init(key) -> State`` and ``step(State, action, key) -> State``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.adapters import closed_loop
from jast._src.adapters.closed_loop import Instant
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array

__all__ = ["pgx"]


class _Turn(NamedTuple):
    """What the player who is to move knows."""

    observation: Any
    legal_action_mask: Array
    current_player: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Environment:
    subject: Any = field(metadata=dict(static=True))
    """The game"""

    def reset(self, key: Any) -> closed_loop.Outcome:
        return _outcome(self.subject.init(key))

    def step(self, key: Any, state: Any, action: Any, push: Callable) -> closed_loop.Outcome:
        return _outcome(self.subject.step(push(state), action, key))


def _outcome(state: Any) -> closed_loop.Outcome:
    turn = _Turn(*(getattr(state, name) for name in _Turn._fields))
    return closed_loop.Outcome(state, turn, jnp.ravel(state.rewards)[0], state.terminated)


def pgx(
    env: Any,
    policy: Callable[[Any], Any],
    *,
    horizon: int,
    observation: closed_loop.Noise | None = None,
    action: closed_loop.Noise | None = None,
    force: closed_loop.Change | None = None,
    parameters: closed_loop.Change | None = None,
    seed: int | Literal["episode", "step"] = 0,
    failure: closed_loop.Judgement | None = None,
    distance: closed_loop.Judgement | None = None,
    observe: closed_loop.Judgement | None = None,
) -> Simulator:
    """A policy in a game of pgx: ``init(key)`` and ``step(state, action, key)`` return a state.

    Arguments are those of `gymnax`, with the same meaning. The policy makes the moves of all
    players, and sees whose turn it is. It can leave the other player's moves to ``action``, and
    these are then what is random. ``now.reward`` is that of player 0. A failure by default is that
    player 0 has lost, by a negative reward at the end; of a game for one, that it has ended.

    Args:
        env: the game, such as ``pgx.make(name)``.
        policy: what the player who is to move knows, with fields ``observation``,
            ``legal_action_mask`` and ``current_player`` -> action.
        horizon: moves of an episode, of all players together.
        observation, action, force: pairs (distribution, function (it, draw) -> it) of what is seen,
            of the move, and of the state.
        parameters: a pair (distribution, function (env, draw) -> env), as in `brax`.
        seed: of the deal, of who begins, and of dice; a number, "episode" or "step".
        failure, distance, observe: functions of the `Instant`, as in `gymnax`.

    Returns:
        `Simulator`, whose states are `Instant`.

    Raises:
        ValueError: for an environment without these methods, an argument of another kind, and where
            nothing is random.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from typing import Any, NamedTuple
        >>> from jast.distributions import Categorical
        >>> class State(NamedTuple):  # as pgx has them
        ...     observation: Any = jnp.int32(5)
        ...     legal_action_mask: Any = jnp.ones(3, bool)
        ...     current_player: Any = jnp.int32(0)
        ...     rewards: Any = jnp.zeros(2)
        ...     terminated: Any = False
        >>> class Nim:  # takes one to three of five; who takes the last has lost
        ...     num_players = 2
        ...
        ...     def init(self, key):
        ...         return State()
        ...
        ...     def step(self, state, action, key):
        ...         left, mover = state.observation - action - 1, state.current_player
        ...         lost = jnp.where(jnp.arange(2) == mover, -1.0, 1.0)
        ...         rewards = jnp.where(left <= 0, lost, 0.0)
        ...         return State(left, jnp.arange(3) < left, 1 - mover, rewards, left <= 0)
        >>> sim = jast.adapters.pgx(
        ...     Nim(),
        ...     policy=lambda seen: jnp.where(seen.current_player == 0, 0, -1),  # takes one
        ...     horizon=5,
        ...     action=(
        ...         lambda now: Categorical(
        ...             probs=jnp.where(now.observation.legal_action_mask, 1 / 3, 0.0)
        ...         ),
        ...         lambda action, draw: jnp.where(action < 0, draw, action),
        ...     ),
        ... )
        >>> jast.replay(jast.check(sim), {"action": jnp.array([0, 2, 0, 0, 0])}).failure.item()
        True
    """
    given = dict(locals())
    closed_loop.check_environment("pgx", env, "init(key)", "step(state, action, key)", seed=seed)
    if failure is None and getattr(env, "num_players", 1) > 1:
        given["failure"] = Partial(_lost)
    return closed_loop.simulator("pgx", _Environment(given.pop("env")), **given)


def _lost(now: Instant) -> jax.Array:
    return now.terminated & (now.reward < 0)
