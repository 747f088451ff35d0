"""Named events on the failures of one estimate: how probable each is, alone and given a failure.

The failing draws are made again from their key, and the system is run to where each ended. That it
fails there is only to show that it is the simulator of the estimate: the weights stay what they
were.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core import rewards
from jast._src.core.contract import called
from jast._src.core.episode import play_back
from jast._src.core.policy import Policy
from jast._src.core.simulator import Simulator, first_state, next_state
from jast._src.core.typing import PRNGKey
from jast._src.estimate import diagnostics
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.exceedance_and_times import draws_and_level
from jast._src.estimate.importance_sampling import choose_component
from jast._src.estimate.monte_carlo import episode_keys
from jast._src.estimate.proposals import Proposal, as_proposal
from jast._src.estimate.redraw import dimension_of, redraw_chunk
from jast._src.estimate.weighted_draws import (
    mean_interval,
    moments_of_weights,
    scaled_weights,
    share_interval,
    source_key,
)
from jast._src.normal_space.transform import dimension, policy_of
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util import display
from jast._src.util.checks import check_random_key, one_of, whole_number, wrong
from jast._src.util.intervals import clopper_pearson, log_normal
from jast._src.util.pytrees import as_partial, select, zero_where

__all__ = ["Event", "GivenStart", "events", "given_start"]

BLOCK_EPISODES = 1024
"""Draws that are made again side by side, in one program whatever their number."""
BLOCK_STARTS = 2**16
"""First states of the model that are looked at side by side."""
LEAST_FAILING = 0.5
"""Share of the failing draws that fail again, below which the simulator is another one: rounding
changes few of them."""
EVENT_ARGUMENTS = ("state", "start", "episode")


@display.printable()
class Event(NamedTuple):
    """An event among the failures. Python numbers.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), sim, 1000)
        >>> above = jast.estimate.events(sim, counted, {"above": lambda s: s > 0})["above"]
        >>> above.given_interval[0] < above.given_failure < above.given_interval[1]
        True
    """

    probability: float
    """That an episode fails and the event happens in it"""
    interval: tuple[float, float]
    """(low, high) at ``level``"""
    given_failure: float
    """Probability of the event given a failure"""
    given_interval: tuple[float, float]
    """(low, high) at ``level``"""
    ess: float
    """Effective sample size of the failures in which it happened"""
    failing: int
    """How many these are"""
    reliable: bool
    """Whether the estimate is, and these failures are enough for a number"""
    warnings: tuple[str, ...]
    """Why not"""
    level: float


@display.printable()
class GivenStart(NamedTuple):
    """A failure given where the episode starts. Python numbers.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.pendulum()
        >>> counted = jast.estimate.monte_carlo(key, sim, 3000)
        >>> near = {"tilted": lambda s: abs(s[0]) > 0.1}
        >>> found = jast.estimate.given_start(key, sim, counted, near, draws=1000)["tilted"]
        >>> found.start_interval[0] < found.start < found.start_interval[1]
        True
    """

    probability: float
    """Of a failure, given a start in the set"""
    interval: tuple[float, float]
    """(low, high) at ``level``"""
    start: float
    """Probability of a start in the set"""
    start_interval: tuple[float, float]
    """(low, high) at ``level``"""
    together: Event
    """The failures that start there"""
    reliable: bool
    warnings: tuple[str, ...]
    level: float


def events(
    sim: Simulator,
    estimate: Estimate,
    named: Mapping[str, Callable[[Any], Any]],
    *,
    of: Literal["state", "start", "episode"] = "state",
    proposal: Proposal | Policy | None = None,
    level: float | None = None,
) -> dict[str, Event]:
    """How probable are several events among the failures of one ``estimate``: dict of name ->
    `Event`, all from the same draws, so that events and their complements add up.

    The failing draws are made again and the system run to the end of each: one run a failing draw,
    whatever the number of events, none of those that did not fail. A black box that is judged at
    its end is not called, unless an event looks at the whole episode; one that is looked at after
    each step is.

    Args:
        sim: the simulator of the estimate, the same.
        estimate: of `failure_probability` from 5000 episodes on, `monte_carlo` or `importance`.
        named: name -> function in JAX that returns a bool scalar.
        of: what it is called with: "state", the last one of the episode; "start", the first state;
            "episode", a `jast.Episode` with its states.
        proposal: of an estimate by `importance`, the one that it was given.
        level: of the intervals (default: the estimate's).

    Raises:
        ValueError: for an estimate without draws or without a failure, one of another simulator
            (with another number of random numbers in an episode, or whose failures mostly do not
            fail in this one), an event that is no function or returns no bool, another ``of``, and
            a missing proposal.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), sim, 1000)
        >>> sides = {"above": lambda s: s > 0, "below": lambda s: s < 0}
        >>> found = jast.estimate.events(sim, counted, sides)
        >>> round(found["above"].given_failure + found["below"].given_failure, 6)
        1.0
    """
    name = "events"
    draws, level = draws_and_level(name, estimate, level)
    one_of(name, "of", of, EVENT_ARGUMENTS)
    functions = _check_functions(name, named)
    happened = _evaluate_events(name, sim, draws, functions, of, proposal)
    return {k: _event(estimate, draws, v, level) for k, v in happened.items()}


def given_start(
    key: PRNGKey,
    sim: Simulator,
    estimate: Estimate,
    named: Mapping[str, Callable[[Any], Any]],
    *,
    draws: int = 1_000_000,
    proposal: Proposal | Policy | None = None,
    level: float | None = None,
) -> dict[str, GivenStart]:
    """How probable is a failure given that the episode starts in a set: dict of name ->
    `GivenStart`, P(failure and start in the set) / P(start in the set).

    Args:
        key: consumed.
        sim, estimate, proposal, level: as in `events`.
        named: name -> function in JAX of the first state that returns a bool scalar.
        draws: of the start alone, from the model, for the probability of the set; no step is taken.

    Raises:
        ValueError: as `events`, and for draws below 1.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.pendulum()
        >>> counted = jast.estimate.monte_carlo(key, sim, 3000)
        >>> near = {"tilted": lambda s: abs(s[0]) > 0.1}
        >>> found = jast.estimate.given_start(key, sim, counted, near, draws=1000)
        >>> list(found)
        ['tilted']
    """
    name = "given_start"
    check_random_key(name, key)
    kept, level = draws_and_level(name, estimate, level)
    functions = _check_functions(name, named)
    happened = _evaluate_events(name, sim, kept, functions, "start", proposal)
    n, count = whole_number(name, "draws", draws), dict.fromkeys(functions, 0)
    for i in range(-(-n // BLOCK_STARTS)):
        seen = _evaluate_starts(jax.random.fold_in(key, i), sim, functions)
        for k, v in seen.items():
            count[k] += int(np.asarray(v)[: n - i * BLOCK_STARTS].sum())
    return {
        k: _given_start(kept, v, _event(estimate, kept, v, level), count[k], n)
        for k, v in happened.items()
    }


def _given_start(draws, happened, event, m, n):
    """The `GivenStart` of the failing draws in which the ``event`` ``happened``, where ``m`` of
    ``n`` starts are in the set.
    """
    few, level = m < diagnostics.MIN_ESS, event.level
    p, ends = np.nan, (0.0, 1.0)
    if m and event.failing:
        both = moments_of_weights(draws.log_weight[draws.failure][happened], draws.samples)
        # of a ratio of two independent means, to first order
        relative = float(np.hypot(both.relative, np.sqrt((1 - m / n) / m)))
        log_p = float(both.log_mean) - np.log(m / n)
        p, ends = min(float(np.exp(log_p)), 1.0), log_normal(log_p, relative, level)
    elif m:
        p, ends = 0.0, (0.0, min(event.interval[1] * n / m, 1.0))
    return GivenStart(
        probability=p,
        interval=ends,
        start=m / n,
        start_interval=clopper_pearson(m, n, level),
        together=event,
        reliable=event.reliable and not few,
        warnings=(*event.warnings, *([f"only {m} of {n} starts are in the set"] if few else [])),
        level=level,
    )


def _event(estimate, draws, happened, level):
    """The `Event` of the failing draws in which it ``happened`` [m]."""
    of_failures = draws.log_weight[draws.failure]
    w, total = scaled_weights(of_failures, draws.counted)
    chosen, log_w = w[happened], of_failures[happened]
    k, n = len(chosen), draws.samples
    given, given_ends = share_interval(total, chosen.sum(), (chosen**2).sum(), k, level)
    reasons = [] if estimate.reliable else ["the estimate is UNRELIABLE"]
    if k:
        m = moments_of_weights(log_w, n)
        p, ess = min(float(np.exp(m.log_mean)), 1.0), float(m.ess)
        ends = mean_interval(draws, m, k, level)
        if not draws.counted:
            reasons += diagnostics.warnings_of_weights(log_w, n, ess)
    else:  # above by what is not excluded among the failures
        p = ess = 0.0
        ends = 0.0, given_ends[1] * float(np.exp(moments_of_weights(of_failures, n).log_mean))
        reasons.append("the event happened in no failure")
    return Event(
        probability=p,
        interval=ends,
        given_failure=given,
        given_interval=given_ends,
        ess=ess,
        failing=k,
        reliable=not reasons,
        warnings=tuple(reasons),
        level=level,
    )


def _check_functions(name: str, named: Any) -> dict[str, Callable]:
    good = isinstance(named, Mapping) and named
    if not good or not all(isinstance(k, str) and callable(f) for k, f in named.items()):
        raise ValueError(f"{name}: named must be a dict of name -> function, received {named!r}")
    return {k: as_partial(f) for k, f in named.items()}


def _evaluate_events(name, sim, draws, functions, of, proposal):
    """Name -> [m] bool, in which of the failing draws each event happened."""
    rows, length = draws.row[draws.failure], draws.length[draws.failure]
    if not len(rows):
        raise ValueError(f"{name}: estimate must have seen a failure, received one that saw none")
    if (received := dimension_of(draws.source)) not in (None, dimension(sim)):
        must = f"be the simulator of the estimate, with {received} random numbers in an episode"
        raise wrong(name, "sim", must, f"one with {dimension(sim)}")
    by_policy = draws.source == "policy"
    if by_policy and proposal is None:
        raise ValueError(f"{name}: proposal must be the one that the estimate was made with")
    proposal = as_proposal(name, sim, proposal) if by_policy else None
    key, out, failing = source_key(draws), {k: [] for k in functions}, 0
    for i in np.unique(rows // draws.lanes):
        mine = rows // draws.lanes == i
        lanes, steps = rows[mine] % draws.lanes, length[mine]
        if by_policy:
            made = jax.random.split(jax.random.fold_in(key, i), draws.lanes)
        elif draws.source == "keys":
            made = episode_keys(key, int(i), np.arange(draws.lanes))
        else:
            made = redraw_chunk(key, int(i), sim, draws.source, int(lanes.max()) + 1, draws.lanes)
        for a in range(0, len(lanes), BLOCK_EPISODES):
            part = np.arange(a, a + BLOCK_EPISODES).clip(max=len(lanes) - 1)
            some, until = made[lanes[part]], jnp.asarray(steps[part])
            seen, fails = _evaluate_block(sim, functions, proposal, some, until, of)
            failing += int(np.asarray(fails)[: len(lanes) - a].sum())
            for k, v in seen.items():
                if v.shape != (BLOCK_EPISODES,) or v.dtype != bool:
                    received = f"{v.dtype}{list(v.shape[1:])}"
                    raise ValueError(f"{name}: {k} must return a bool scalar, received {received}")
                out[k].append(np.asarray(v)[: len(lanes) - a])
    if failing < LEAST_FAILING * len(rows):
        must = "be the simulator of the estimate, whose failures fail"
        raise wrong(name, "sim", must, f"one in which {failing} of {len(rows)} do")
    return {k: np.concatenate(v) for k, v in out.items()}


@partial(jax.jit, static_argnums=5)
def _evaluate_block(sim, functions, proposal, made, length, of):
    """Name -> what it returns for each of the draws ``made``, points or keys, of known length; and
    whether each fails at its end, of which a black box is not asked.
    """

    def one(made, length):
        x0, choose = _disturbances(sim, proposal, made)
        first = first_state(sim, x0)

        def step(state, t):
            x = choose(state, t)
            after = select(t < length, next_state(sim, state, x), state)
            return after, zero_where(t >= length, x)

        last, xs = lax.scan(step, first, jnp.arange(sim.horizon, dtype=jnp.int32))
        if of == "episode":
            shown = play_back(sim, rewards.STANDARD, x0, xs, length)
        else:
            shown = last if of == "state" else first
        fails = jnp.asarray(True) if runs_on_host(sim) else sim.evaluate(last)[0]
        return _happens(functions, shown), fails

    return jax.vmap(one)(made, length)


def _happens(functions, shown):
    """Name -> what each function returns of what it is ``shown``."""
    return {k: jnp.asarray(called(f"named: {k}", f, shown)) for k, f in functions.items()}


def _disturbances(sim, proposal, made):
    """(x0, function of a state and the time that gives the next disturbance) of the draw ``made``:
    a key of a ``proposal``, else the key of an episode of the model, else a point.
    """
    if proposal is not None:
        own, for_start, for_steps = choose_component(made, proposal)
        x0 = D.sample(own.start(), for_start)
        return x0, lambda s, t: D.sample(own.disturbance(s, t), jax.random.fold_in(for_steps, t))
    if jax.dtypes.issubdtype(made.dtype, jax.dtypes.prng_key):
        keys = jax.random.split(made, sim.horizon + 1)  # as `jast.rollout` does
        x0 = D.sample(sim.start(), keys[0])
        return x0, lambda s, t: D.sample(sim.disturbance(s), jax.random.clone(keys[t + 1]))
    player = policy_of(sim, made)
    return D.mode(player.start()), lambda s, t: D.mode(player.disturbance(s, t))


@jax.jit
def _evaluate_starts(key, sim, functions):
    """Name -> what it returns for each of `BLOCK_STARTS` first states."""

    def one(key):
        first = first_state(sim, D.sample(sim.start(), key))
        return _happens(functions, first)

    return jax.vmap(one)(jax.random.split(key, BLOCK_STARTS))
