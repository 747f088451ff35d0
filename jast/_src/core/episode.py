"""Episodes: one run of a simulated system, from its start to a failure, an end or the horizon.

What an episode is stands in `core.transition`; here whole ones are played and replayed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core import rewards
from jast._src.core.policy import Policy, nominal_policy
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, require_simulator
from jast._src.core.transition import advance, begin, conclude
from jast._src.core.typing import Array, ArrayTree, PRNGKey, Reward
from jast._src.runtime._jax import is_traced, quick
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util import display
from jast._src.util.checks import check_random_key, wrong
from jast._src.util.pytrees import conform, pad_rows, select, with_rows_of, zero_where

__all__ = ["Episode", "play_back", "play_chosen", "replay", "rollout", "stacked"]


@display.printable()
class Episode(NamedTuple):
    """One episode, or many along leading axes. Rows from ``length`` on are zero and mean nothing.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> many = jax.vmap(jast.rollout, (0, None))(jax.random.split(jax.random.key(0), 5), sim)
        >>> many.distance.shape, many.disturbances.shape
        ((5,), (5, 30))
    """

    x0: ArrayTree
    """Initial disturbance, ``()`` for a system with one start."""
    disturbances: ArrayTree
    """[horizon, ...]: x_1 .. x_length in the first rows."""
    log_prob: Array
    """True log density of x0 and the ``length`` steps: never normalised."""
    distance: Array
    """Miss distance: the least, or the last one of an episodic system; inf where the simulator
    returned a number that is not finite.
    """
    failure: Array
    """bool: ended in a failure event."""
    length: Array
    """int32: steps taken, 0 .. horizon."""
    reward: Array
    """Sum of the reward over the episode; -inf where the simulator returned a number that is not
    finite.
    """
    states: ArrayTree | None = None
    """[horizon + 1, ...]: s_0 .. s_length in the first rows, or None where they were not kept."""

    def to_xarray(self) -> Any:
        """One episode, or a batch, as an xarray Dataset that arviz reads (the extra ``tables``).

        Dimensions are ``chain`` (one), ``draw`` (the episodes) and ``step``, from 0 to the horizon;
        those of arrays come after them. Variables are ``x`` (that of step t led to state t; a
        disturbance of several arrays has one for each, as "x.gust"), ``x0`` where the start is
        random, ``state`` where states were kept, likewise, and ``log_prob``, ``distance``,
        ``reward``, ``failure`` and ``length``. What an episode did not come to is NaN, and whole
        numbers of disturbances and states are floats.

        Returns:
            The ``xarray.Dataset``.

        Raises:
            ImportError: where xarray is not installed.
            ValueError: for more than one leading axis.
        """
        from jast._src.io.data_frames import dataset

        return dataset(self)


def rollout(
    key: PRNGKey,
    sim: Simulator,
    policy: Policy | None = None,
    reward: Reward = rewards.STANDARD,
) -> Episode:
    """Simulate one episode.

    ``jax.vmap`` over keys, simulators or policies gives many. Differentiable in the simulator's and
    the policy's parameters. An episode in which the simulator returns NaN has no failure, distance
    inf and reward -inf. The `replay` of an episode is the same to the bit; inside a transformation,
    where drawing and stepping are one program, up to rounding.

    Args:
        key: consumed.
        sim: the simulator.
        policy: chooses the disturbances. Default: the simulator's own model, the nominal system.
        reward: of `jast.rewards`; scores the episode.

    Returns:
        `Episode`.

    Raises:
        ValueError: for what is no key, simulator, policy or reward.

    Example:
        >>> import jax, jast
        >>> episode = jast.rollout(jax.random.key(0), jast.simulators.walk1d())
        >>> episode.disturbances.shape, bool(episode.failure)
        ((30,), False)
    """
    check_random_key("rollout", key)
    require_simulator("rollout", sim)
    if policy is not None and not isinstance(policy, Policy):
        raise ValueError(f"rollout: policy must be a jast.Policy, received {policy!r:.80}")
    reward = rewards.as_pytree(reward)
    episode = _rollout(key, sim, policy, reward)
    if is_traced(episode):
        return episode
    # a draw that is fused into the step is not rounded to what is recorded (a multiply-add), so the
    # recording is played
    return play_back(sim, reward, episode.x0, episode.disturbances, episode.length)


@quick
def _rollout(key: jax.Array, sim: Simulator, policy: Policy | None, reward: Callable) -> Episode:
    policy = nominal_policy(sim) if policy is None else policy
    keys = jax.random.split(key, sim.horizon + 1)
    x0 = D.sample(policy.start(), keys[0])

    def choose(state, t, key):
        return D.sample(policy.disturbance(state, t), key)

    return play_chosen(sim, reward, x0, choose, keys[1:], sim.horizon)


def replay(
    sim: Simulator,
    episode: Any,
    x0: ArrayTree | None = None,
    reward: Reward = rewards.STANDARD,
) -> Episode:
    """Run recorded disturbances again. Exact: the same input gives the same bits.

    An episode that has neither failed nor ended when the disturbances run out ends there.

    Args:
        sim: the simulator.
        episode: an `Episode`, or its disturbances [T, ...] with T <= horizon (a pytree where x is
            one).
        x0: with disturbances alone, the initial one of a system with a random start.
        reward: of `jast.rewards`; scores the episode.

    Returns:
        `Episode` with its states.

    Raises:
        ValueError: for a report or an archive in place of one episode, and where the disturbances
            do not fit the simulator.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> episode = jast.replay(jast.simulators.walk1d(), jnp.full(6, 2.0))
        >>> bool(episode.failure), int(episode.length)
        (True, 5)
    """
    require_simulator("replay", sim)
    if hasattr(episode, "failures") or hasattr(episode, "episodes"):
        must = "be one Episode, such as report.failures[0]"
        raise wrong("replay", "episode", must, type(episode).__name__)
    disturbances, length = episode, None
    if isinstance(episode, Episode):
        disturbances, x0, length = episode.disturbances, episode.x0, episode.length
    like = signature_of(sim)
    x0 = like.x0 if x0 is None and not like.random_start else x0
    x0 = conform("replay: x0", x0, like.x0)
    leaves = jax.tree.leaves(disturbances)
    rows = {jnp.shape(leaf)[0] if jnp.ndim(leaf) else -1 for leaf in leaves} or {sim.horizon}
    if len(rows) != 1 or not 0 <= (steps := rows.pop()) <= sim.horizon:
        must = f"have between 0 and {sim.horizon} rows (the horizon)"
        raise wrong("replay", "disturbances", must, jax.tree.map(jnp.shape, disturbances))
    rows = jax.tree.map(lambda s: jax.ShapeDtypeStruct((steps, *s.shape), s.dtype), like.x)
    disturbances = conform("replay: disturbances", disturbances, rows)
    steps = jnp.asarray(steps if length is None else length, jnp.int32)
    return play_back(sim, rewards.as_pytree(reward), x0, pad_rows(disturbances, sim.horizon), steps)


def stacked(episodes: Iterable[Episode]) -> Episode:
    """Single episodes as a batch [n], on the host and without states."""
    each = [e._replace(states=None) for e in episodes]
    return jax.tree.map(lambda *a: np.stack([np.asarray(b) for b in a]), *each)


@quick
def play_back(
    sim: Simulator, reward: Callable, x0: Any, disturbances: Any, steps: jax.Array
) -> Episode:
    """`replay` without its checks: ``disturbances`` [horizon, ...], of which at most ``steps`` rows
    are played; may be vmapped.
    """
    return play_chosen(sim, reward, x0, lambda state, t, x: x, disturbances, steps)


def play_chosen(
    sim: Simulator,
    reward: Callable,
    x0: Any,
    choose: Callable,
    rows: Any,
    steps: Any,
    numbers: jax.Array | None = None,
) -> Episode:
    """The episode of at most ``steps`` steps in which ``choose(state, t, rows[t])`` gives the
    disturbances. ``numbers``: those that these depend on, for `with_rows_of`.
    """
    first = begin(sim, reward, x0, last=steps <= 0)
    if numbers is not None:
        first = with_rows_of(numbers, first)
    # an ended lane goes on from the start state, so that no NaN reaches a gradient; of a state of
    # zeros no black box is asked
    rest = jax.tree.map(jnp.zeros_like, first.state) if runs_on_host(sim) else first.state

    def body(before, at):
        t, row = at
        safe = before._replace(state=select(before.done, rest, before.state))
        x = choose(safe.state, t, row)
        after = advance(sim, reward, safe, x, t + 1 >= steps)
        kept = select(before.done, before, after)
        return kept, (*zero_where(before.done, (x, after.state)), ~before.done)

    last, (disturbances, states, live) = lax.scan(
        body, first, (jnp.arange(sim.horizon, dtype=jnp.int32), rows)
    )
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first.state, states)
    length, last = jnp.sum(live, dtype=jnp.int32), conclude(sim, reward, last)
    return Episode(
        x0, disturbances, last.log_prob, last.distance, last.failure, length, last.reward, states
    )
