"""The meaning of an episode, once, for every rollout, replay, search and estimate of the package:
`begin`, `advance` and `conclude`.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast import rewards
from jast.outline import outline
from jast.pytrees import strong
from jast.simulator import Simulator

__all__ = ["Progress", "begin"]


class Progress(NamedTuple):
    """An episode so far, at a state."""

    state: Any
    log_prob: jax.Array
    reward: jax.Array
    distance: jax.Array
    failure: jax.Array
    done: jax.Array
    invalid: jax.Array
    """The simulator, the density or the reward returned NaN, or an infinity that has no meaning:
    the episode ended there.
    """
    owed: Any = ()
    """Of an episodic system: the log p of the arrival at its end, which the reward has not seen
    before `conclude`; 0 before the end. Else ``()``.
    """


def blank(sim: Simulator, state: Any) -> Progress:
    """The `Progress` at ``state``, with nothing behind it."""
    zero, no = jnp.zeros((), outline(sim).dtype), jnp.zeros((), bool)
    return Progress(state, zero, zero, zero + jnp.inf, no, no, no, zero if sim.episodic else ())


def begin(sim: Simulator, reward: Callable, x0: Any, last: Any = False) -> Progress:
    """The `Progress` at s0, which x0 leads to; a failure there is an episode of length 0. ``last``:
    the episode is to end here.
    """
    return _begun(sim, rewards.as_pytree(reward), x0, last)


@jax.jit  # programs with the system in them trace it once for all of them
def _begun(sim: Simulator, reward: Callable, x0: Any, last: Any) -> Progress:
    """`begin`, of a ``reward`` that is a pytree."""
    start = sim.start()
    state = strong(sim.init(x0))
    log_p = (D.log_density(start, x0, density) for density in ("raw", rewards.density_of(reward)))
    return _arrive(
        sim, reward, blank(sim, state), state, log_p, jnp.asarray(last), lambda d: jnp.zeros_like(d)
    )


def advance(sim: Simulator, reward: Callable, progress: Progress, x: Any, last: Any) -> Progress:
    """The `Progress` one step on, by disturbance ``x``; ``last``: the horizon is reached by it.
    Meaningless once ``progress.done``.
    """
    return _advanced(sim, rewards.as_pytree(reward), progress, x, last)


@jax.jit  # as `_begun`
def _advanced(sim: Simulator, reward: Callable, progress: Progress, x: Any, last: Any) -> Progress:
    """`advance`, of a ``reward`` that is a pytree."""
    dist = sim.disturbance(progress.state)
    log_p = (D.log_density(dist, x, density) for density in ("raw", rewards.density_of(reward)))
    state = strong(sim.step(progress.state, x))
    return _arrive(
        sim, reward, progress, state, log_p, last, lambda d: sim.evaluate(progress.state)[1] - d
    )


def conclude(sim: Simulator, reward: Callable, progress: Progress, live: Any = True) -> Progress:
    """The `Progress` with the outcome of an episodic system, whose episode is ``done``; that of any
    other system stays as it is.

    Here such a system is evaluated. Where not ``live`` it is shown a state of zeros, and the
    `Progress` stays as it is.
    """
    if not sim.episodic:
        return progress
    live = jnp.asarray(live) & progress.done & ~progress.invalid
    event, own, *told = sim.evaluate(
        jax.tree.map(lambda a: jnp.where(live, a, jnp.zeros((), a.dtype)), progress.state)
    )
    event, own = jnp.asarray(event), jnp.asarray(own).astype(progress.reward.dtype)
    told = sum(jnp.asarray(p).astype(own.dtype) for p in told)
    owed, log_prob = progress.owed + told, progress.log_prob + told
    total = _paid(reward, progress.reward, owed, event, own, jnp.ones((), bool), -own)
    invalid = ~jnp.isfinite(own) | _wrong(log_prob) | _wrong(total)
    new = dict(owed=jnp.zeros_like(progress.owed), log_prob=log_prob) | _outcome(
        total, own, event, jnp.ones((), bool), invalid
    )
    return progress._replace(
        **{name: jnp.where(live, value, getattr(progress, name)) for name, value in new.items()}
    )


def _arrive(
    sim: Simulator,
    reward: Callable,
    before: Progress,
    state: Any,
    log_p: Iterable[Any],
    last: Any,
    approach: Callable[[jax.Array], Any],
) -> Progress:
    """The `Progress` at ``state``, which a disturbance of the log densities ``log_p`` (raw, and as
    the reward counts it) led to from ``before``; ``approach``: of the state's own distance.
    """
    dtype = before.reward.dtype
    log_prob, counted = (jnp.asarray(p).astype(dtype) for p in log_p)
    ends = jnp.asarray(sim.is_terminal(state)) | last
    if sim.episodic:  # evaluated at its end, by `conclude`
        none = jnp.zeros((), dtype)
        total, owed = (
            jnp.where(
                ends, before.reward, _paid(reward, before.reward, counted, False, none, False, none)
            ),
            jnp.where(ends, counted, 0),
        )
        event, distance, done = jnp.zeros((), bool), before.distance, ends
    else:
        event, own, *told = sim.evaluate(state)
        event, own = jnp.asarray(event), jnp.asarray(own).astype(dtype)
        for p in told:
            log_prob, counted = (a + jnp.asarray(p).astype(dtype) for a in (log_prob, counted))
        # the order at a state: failure, then is_terminal, then the horizon
        done, distance, owed = event | ends, jnp.minimum(before.distance, own), ()
        total = _paid(
            reward, before.reward, counted, event, distance, done, approach(own).astype(dtype)
        )
    invalid = _wrong(log_prob) | _wrong(total)
    if not sim.episodic:
        invalid |= ~jnp.isfinite(own)
    return Progress(
        state,
        before.log_prob + log_prob,
        owed=owed,
        **_outcome(total, distance, event, done, invalid),
    )


def _wrong(number: jax.Array) -> jax.Array:
    """Whether a log p or a reward is NaN, or an infinity that has no meaning."""
    return jnp.isnan(number) | (number == jnp.inf)


def _paid(
    reward: Callable,
    total: jax.Array,
    log_p: jax.Array,
    event: Any,
    distance: jax.Array,
    terminal: Any,
    approach: jax.Array,
) -> jax.Array:
    """The episode's reward, ``total`` before, after one more arrival."""
    event, terminal = jnp.asarray(event), jnp.asarray(terminal)
    if rewards.once(reward):  # it is paid for the whole episode, at its end
        total = total + log_p
        return jnp.where(
            terminal,
            jnp.asarray(reward(total, event, distance, terminal, approach)).astype(total.dtype),
            total,
        )
    return total + jnp.asarray(reward(log_p, event, distance, terminal, approach)).astype(
        total.dtype
    )


def _outcome(
    reward: jax.Array,
    distance: jax.Array,
    failure: jax.Array,
    done: jax.Array,
    invalid: jax.Array,
) -> dict[str, jax.Array]:
    """Those fields of a `Progress`, as they are where it is ``invalid``."""
    reward, distance = jnp.where(invalid, -jnp.inf, reward), jnp.where(invalid, jnp.inf, distance)
    return dict(
        reward=reward,
        distance=distance,
        failure=failure & ~invalid,
        done=done | invalid,
        invalid=invalid,
    )
