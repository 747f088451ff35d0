"""The meaning of an episode, once, for every rollout, replay, search and estimate of the package:
`begin`, `advance` and `conclude`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast._src.core import rewards
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, first_state, next_state
from jast._src.core.typing import ArrayTree
from jast._src.util.pytrees import select, zero_where

__all__ = ["Progress", "advance", "begin", "blank", "conclude"]


class Progress(NamedTuple):
    """An episode so far, at a state."""

    state: ArrayTree
    log_prob: jax.Array
    reward: jax.Array
    distance: jax.Array
    failure: jax.Array
    done: jax.Array
    invalid: jax.Array
    """The simulator, the density or the reward returned NaN, or an infinity that has no meaning:
    the episode ended there.
    """
    owed: jax.Array | tuple[()] = ()
    """Of an episodic system: the log p of the arrival at its end, which the reward has not seen
    before `conclude`; 0 before the end. Else ``()``.
    """


def blank(sim: Simulator, state: Any) -> Progress:
    """The `Progress` at ``state``, with nothing behind it."""
    zero, no = jnp.zeros((), signature_of(sim).dtype), jnp.zeros((), bool)
    return Progress(
        state=state,
        log_prob=zero,
        reward=zero,
        distance=zero + jnp.inf,
        failure=no,
        done=no,
        invalid=no,
        owed=zero if sim.episodic else (),
    )


def begin(sim: Simulator, reward: Callable, x0: Any, last: Any = False) -> Progress:
    """The `Progress` at s0, which x0 leads to; a failure there is an episode of length 0. ``last``:
    the episode is to end here.
    """
    return _begin(sim, rewards.as_pytree(reward), x0, last)


@jax.jit  # programs with the system in them trace it once for all of them
def _begin(sim: Simulator, reward: Callable, x0: Any, last: Any) -> Progress:
    """`begin`, of a ``reward`` that is a pytree."""
    start = sim.start()
    state = first_state(sim, x0)
    before, last = blank(sim, state), jnp.asarray(last)
    log_p = _log_densities(start, x0, reward)
    return _arrive(sim, reward, before, state, log_p, last, jnp.zeros_like)


def advance(sim: Simulator, reward: Callable, progress: Progress, x: Any, last: Any) -> Progress:
    """The `Progress` one step on, by disturbance ``x``; ``last``: the horizon is reached by it.
    Meaningless once ``progress.done``.
    """
    return _advance(sim, rewards.as_pytree(reward), progress, x, last)


@jax.jit  # as `_begin`
def _advance(sim: Simulator, reward: Callable, progress: Progress, x: Any, last: Any) -> Progress:
    """`advance`, of a ``reward`` that is a pytree."""
    dist = sim.disturbance(progress.state)
    state = next_state(sim, progress.state, x)
    log_p = _log_densities(dist, x, reward)

    def approach(distance: jax.Array) -> jax.Array:
        return sim.evaluate(progress.state)[1] - distance

    return _arrive(sim, reward, progress, state, log_p, last, approach)


def _log_densities(dist: Any, x: Any, reward: Callable) -> list[Any]:
    """That of ``x``, raw and as the reward counts it."""
    return [D.log_density(dist, x, density) for density in ("raw", rewards.density_of(reward))]


def conclude(sim: Simulator, reward: Callable, progress: Progress, live: Any = True) -> Progress:
    """The `Progress` with the outcome of an episodic system, whose episode is ``done``; that of any
    other system stays as it is.

    Here such a system is evaluated. Where not ``live`` it is shown a state of zeros, and the
    `Progress` stays as it is.
    """
    if not sim.episodic:
        return progress
    live = jnp.asarray(live) & progress.done & ~progress.invalid
    event, own, *told = sim.evaluate(zero_where(~live, progress.state))
    event, own = jnp.asarray(event), jnp.asarray(own).astype(progress.reward.dtype)
    told = sum(jnp.asarray(p).astype(own.dtype) for p in told)
    owed, log_prob = progress.owed + told, progress.log_prob + told
    total = _pay(reward, progress.reward, owed, event, own, jnp.ones((), bool), -own)
    invalid = ~jnp.isfinite(own) | _wrong(log_prob) | _wrong(total)
    outcome = _outcome(total, own, event, jnp.ones((), bool), invalid)
    new = dict(owed=jnp.zeros_like(progress.owed), log_prob=log_prob) | outcome
    return progress._replace(**select(live, new, {name: getattr(progress, name) for name in new}))


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
        paid = _pay(reward, before.reward, counted, False, none, False, none)
        total, owed = jnp.where(ends, before.reward, paid), jnp.where(ends, counted, 0)
        event, done = jnp.zeros((), bool), ends
        distance = before.distance
    else:
        event, own, *told = sim.evaluate(state)
        event, own = jnp.asarray(event), jnp.asarray(own).astype(dtype)
        for p in told:
            log_prob, counted = (a + jnp.asarray(p).astype(dtype) for a in (log_prob, counted))
        # the order at a state: failure, then is_terminal, then the horizon
        done, owed = event | ends, ()
        distance = jnp.minimum(before.distance, own)
        nearer = approach(own).astype(dtype)
        total = _pay(reward, before.reward, counted, event, distance, done, nearer)
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


def _pay(
    reward: Callable,
    total: jax.Array,
    log_p: jax.Array,
    event: Any,
    distance: jax.Array,
    terminal: Any,
    approach: jax.Array,
) -> jax.Array:
    """The episode's reward, ``total`` before, after one more arrival."""
    once = rewards.once(reward)  # it is paid for the whole episode, at its end
    log_p = total + log_p if once else log_p
    event, terminal = jnp.asarray(event), jnp.asarray(terminal)
    paid = jnp.asarray(reward(log_p, event, distance, terminal, approach)).astype(total.dtype)
    return jnp.where(terminal, paid, log_p) if once else total + paid


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
