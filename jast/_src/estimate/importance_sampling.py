"""Importance resampling: episodes drawn from a proposal, each weighted by how much likelier the
model makes it (the paper's eq. 6-8).

Weights are kept as logarithms and summed step by step as log p - log q, so that neither density
overflows. Episodes are simulated in chunks of constant size; a chunk's log weights go to the host,
where they are summed in double precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp

from jast import distributions as D
from jast._src.core.contract import contract
from jast._src.core.episode import rollout
from jast._src.core.policy import Policy, nominal_policy
from jast._src.core.rewards import log_likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.transition import advance, begin, conclude
from jast._src.core.typing import Array, Callback, Executor, PathLike, PRNGKey
from jast._src.estimate import weight_sums
from jast._src.estimate.estimate import Estimate, estimate_from_weights
from jast._src.estimate.proposals import Proposal, as_proposal
from jast._src.estimate.weighted_draws import with_source
from jast._src.runtime import work
from jast._src.runtime._jax import jit
from jast._src.runtime.backends import Task
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.memory import require_episodes
from jast._src.runtime.progress_bar import Watch
from jast._src.util import display
from jast._src.util.checks import check_random_key, one_of, whole_number
from jast._src.util.display import call_settings
from jast._src.util.intervals import checked_level
from jast._src.util.pytrees import index_tree, join_rows

__all__ = [
    "Traces",
    "choose_component",
    "chunk_size",
    "chunks",
    "draw_episodes",
    "importance",
    "log_weights",
    "one_trace",
]

LANES = 16384  # episodes of a chunk, at most
TOGETHER = 8  # chunks that are added to the sums at a time, as these copy the rows that they keep
PROBES = 256  # of the model's own episodes, which a proposal that may not cover it is tried on


@display.printable()
class Traces(NamedTuple):
    """Simulated episodes of a proposal, one a row of the leading axis [n].

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> model = jast.Policy(sim.start, lambda state, t: sim.disturbance(state))
        >>> traces = jast.estimate.log_weights(jax.random.key(0), sim, model, 100)
        >>> traces.failure.shape, bool((traces.length <= 30).all())
        ((100,), True)
    """

    log_weight: Array
    """log p - log q to the end of the episode, also of those that do not fail"""
    shares: Array
    """[n, K] log of the probability that component k made the trace"""
    failure: Array
    """bool"""
    invalid: Array
    """bool: the simulator or a density returned NaN; no failure then"""
    length: Array
    """int32: steps taken"""
    distance: Array | None = None
    """Miss distance; inf where invalid"""


def log_weights(
    key: PRNGKey,
    sim: Simulator,
    proposal: Proposal | Policy,
    samples: int,
    *,
    mode: Literal["default", "paper"] = "default",
) -> Traces:
    """Episodes drawn from a proposal, with their weights, for estimates of your own.

    A trace's component is drawn once, and it is weighted by the full mixture (eq. 20 of Lipkis and
    Agogino): w = p(x) / sum_k a_k q_k(x). Pure, for `jax.jit` and `jax.vmap`; all in memory.

    Args:
        key: consumed.
        sim: the simulator.
        proposal: a `Proposal`, or a `jast.Policy` with densities.
        samples: episodes n.
        mode: "default" weighs x0 and the steps to the end of the episode, as what comes after
            decides nothing; "paper" goes on to the horizon, as the paper does. Both are unbiased.

    Returns:
        `Traces`, with a leading axis [n].

    Raises:
        ValueError: for another mode or proposal.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> model = jast.Policy(sim.start, lambda state, t: sim.disturbance(state))
        >>> traces = jast.estimate.log_weights(jax.random.key(0), sim, model, 100)
        >>> bool(jnp.allclose(traces.log_weight, 0.0, atol=1e-4))
        True
    """
    check_random_key("log_weights", key)
    to_horizon = _goes_to_horizon("log_weights", mode)
    q = as_proposal("log_weights", sim, proposal)
    samples = whole_number("log_weights", "samples", samples)
    require_episodes("log_weights", sim, samples)
    return traces(key, sim, q, samples, to_horizon)


def _goes_to_horizon(function, mode):
    one_of(function, "mode", mode, ("default", "paper"))
    return mode == "paper"


def importance(
    key: PRNGKey,
    sim: Simulator,
    proposal: Proposal | Policy,
    samples: int = 100_000,
    *,
    mode: Literal["default", "paper"] = "default",
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Estimate:
    """Estimate the failure probability of a system with episodes of a proposal.

    Unbiased where the proposal can draw all that the model can; one that holds no share of the
    model is tried on a few of the model's own episodes. It says nothing of failures that it hardly
    draws: see `Estimate` on how to know. Memory does not grow with ``samples``; chunk i is drawn
    with ``jax.random.fold_in(key, i)``. A KeyboardInterrupt ends it with the estimate of the whole
    chunks, and a word in ``warnings``. Host loop: for `jax.jit` and `jax.vmap` see `log_weights`.

    Args:
        key: consumed.
        sim: the simulator.
        proposal: of `trace_proposal` or `policy_proposal`, or any `jast.Policy` with densities.
        samples: episodes, at least 2.
        mode: as for `log_weights`.
        level: of the interval, in (0, 1).
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after each chunk.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Estimate`.

    Raises:
        ValueError: for fewer than 2 samples, another mode, a level outside (0, 1), a proposal
            without a density, and where the simulator's functions do not fit together.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing()
        >>> proposal = jast.estimate.failure_proposal(key, sim, samples=200).policy
        >>> found = jast.estimate.importance(jax.random.key(1), sim, proposal, 2000)
        >>> bool(found.failing > 100)
        True
    """
    name = "importance"
    check_random_key(name, key)
    samples = whole_number(name, "samples", samples, 2)
    to_horizon = _goes_to_horizon(name, mode)
    level = checked_level(name, level)
    contract(name, sim)
    proposal = as_proposal(name, sim, proposal)
    settings = call_settings(name, key, samples=samples, mode=mode, level=level)
    whole_key = key
    key, for_probes = jax.random.split(key)
    placement = work.placement(name, executor, devices)
    about = dict(sim=sim, proposal=proposal, samples=samples, mode=mode)
    reasons = [] if proposal.covers else _uncovered(for_probes, sim, proposal)
    lanes = chunk_size(samples)
    with open_checkpoint(name, checkpoint, whole_key, **about) as store:
        shared = key, sim, proposal, lanes, to_horizon
        watch = Watch(name, samples, "episode", progress, callback)
        placement = placement._replace(store=store)
        total, notes, lost = chunks(of_policies, shared, lanes, watch, placement)
    reasons += lost
    found = estimate_from_weights(name, total, level=level, reasons=reasons, notes=notes)
    draws = with_source(found.draws, key, lanes, "policy")
    return found._replace(settings=settings, draws=draws)


def chunk_size(samples: int) -> int:
    """Episodes of a chunk, at most ``LANES``, such that the last one is as full as the others."""
    return -(-samples // -(-samples // LANES))


def chunks(simulate, shared, lanes, watch, placement=work.HERE, plain=None):
    """(`Sums`, notes, reasons against them) of all episodes of ``watch``, ``lanes`` at a time, as
    units of work.

    ``simulate(shared, i, context)``: `Traces` of chunk i, a function of a module; of the last chunk
    the first rows count. ``plain(i)``: which of its rows are the model's own draws.
    """
    samples = watch.total

    def fold(kept, i, rows):
        total, done, waiting = kept
        rows = index_tree(rows, np.s_[: samples - i * lanes])
        n = len(rows.failure)
        waiting = (*waiting, (rows, np.zeros(n, bool) if plain is None else plain(i)[:n]))
        kept = total, done + n, waiting
        return added(kept) if len(waiting) == TOGETHER else kept

    def added(kept):
        total, done, waiting = kept
        return (weight_sums.add_traces(total, *join_rows(*waiting)) if waiting else total), done, ()

    task = Task(simulate, shared, lambda: Traces(*Traces._fields))

    def size(done):
        return min(done * lanes, samples)

    start = weight_sums.empty_sums(samples), 0, ()
    with watch:
        ran = work.run(task, -(-samples // lanes), fold, start, watch, placement, size=size)
    total, done, _ = added(ran.state)
    short = work.describe_missing("episodes", ran, done, samples)
    if ran.left_out:
        return total, (), (short, *map(str, ran.incidents))
    return total, () if short is None else (f"interrupted {short}",), ()


def of_policies(shared, i, context):
    """`Traces` of chunk ``i``, of (key, simulator, proposal, its size, whether to the horizon)."""
    key, *about = shared
    return traces(jax.random.fold_in(key, i), *about)


@partial(jit, static_argnames=("n", "to_horizon"))
def traces(key, sim, proposal, n, to_horizon=False, drawn=None):
    """`log_weights` without its checks; ``drawn`` as of `one_trace`."""
    keys = jax.random.split(key, n)
    return jax.vmap(lambda k: one_trace(k, sim, proposal, to_horizon, drawn))(keys)


def one_trace(key, sim, proposal, to_horizon=False, drawn=None, start_key=None):
    """One `Traces` row; ``drawn``: another policy that draws it; ``start_key``: of its x0."""
    own, for_start, for_steps = choose_component(key, proposal)
    for_start = for_start if start_key is None else start_key
    own = own if drawn is None else drawn
    dtype, (components,) = signature_of(sim).dtype, proposal.log_weights.shape

    def weigh(ratio, p, distribution_of, x):
        """The log q_k - log p [K] so far, and whether p is 0."""
        ratios, impossible = ratio
        log_of = jax.vmap(lambda policy: distribution_of(policy).log_prob(x), axis_size=components)
        log_q, log_p = log_of(proposal.policies), p.log_prob(x)
        ratios = ratios + (log_q.astype(dtype) - log_p.astype(dtype))
        return ratios, impossible | (log_p == -jnp.inf)

    x0 = D.sample(own.start(), for_start)
    first = begin(sim, log_likelihood, x0)
    none = jnp.zeros(proposal.log_weights.shape, dtype), jnp.zeros((), bool)
    ratio = weigh(none, sim.start(), lambda policy: policy.start(), x0)

    def body(carry):
        progress, ratio, t, length = carry
        state = progress.state
        x = D.sample(own.disturbance(state, t), jax.random.fold_in(for_steps, t))
        p = sim.disturbance(state)
        ratio = weigh(ratio, p, lambda policy: policy.disturbance(state, t), x)
        after = advance(sim, log_likelihood, progress, x, t + 1 >= sim.horizon)
        if to_horizon:  # the state of an ended episode stays, while drawing and weighing go on
            after = jax.tree.map(lambda a, b: jnp.where(progress.done, a, b), progress, after)
        return after, ratio, t + 1, length + jnp.where(progress.done, 0, 1)

    goes_on = (lambda c: c[2] < sim.horizon) if to_horizon else (lambda c: ~c[0].done)
    zero = jnp.zeros((), jnp.int32)
    last, (ratios, impossible), _, length = lax.while_loop(
        goes_on, body, (first, ratio, zero, zero)
    )
    last, prior = conclude(sim, log_likelihood, last), proposal.log_weights.astype(dtype)
    log_q = logsumexp(prior + ratios)
    return Traces(
        log_weight=jnp.where(impossible, -jnp.inf, -log_q),
        shares=jnp.where(impossible, prior, prior + ratios - log_q),
        failure=last.failure,
        invalid=last.invalid,
        length=length,
        distance=last.distance,
    )


def choose_component(key, proposal):
    """The policy that draws the trace of ``key``, and the keys of its start and of its steps."""
    for_component, for_start, for_steps = jax.random.split(key, 3)
    one = len(proposal.log_weights) == 1
    k = 0 if one else jax.random.categorical(for_component, proposal.log_weights)
    return index_tree(proposal.policies, k), for_start, for_steps


@partial(jit, static_argnames="n")
def draw_episodes(key, sim, proposal, n):
    """``n`` episodes drawn from ``proposal``, with their disturbances but without states, and their
    log weights to the end of each.
    """

    def one(key):
        for_component, for_episode = jax.random.split(key)
        k = jax.random.categorical(for_component, proposal.log_weights)
        own = index_tree(proposal.policies, k)
        e = rollout(for_episode, sim, own, log_likelihood)
        states = index_tree(e.states, np.s_[:-1])
        t = jnp.arange(sim.horizon, dtype=jnp.int32)

        def log_q(policy):
            log_of = jax.vmap(lambda s, t, x: policy.disturbance(s, t).log_prob(x))
            steps = jnp.where(t < e.length, log_of(states, t, e.disturbances), 0)
            return jnp.sum(steps) + policy.start().log_prob(e.x0)

        logs = jax.vmap(log_q, axis_size=len(proposal.log_weights))(proposal.policies)
        total = logsumexp(proposal.log_weights.astype(logs.dtype) + logs)
        return e._replace(states=None), e.log_prob - total.astype(e.log_prob.dtype)

    return jax.vmap(one)(jax.random.split(key, n))


def _uncovered(key, sim, proposal):
    """Why the proposal cannot be right, tried on episodes of the model."""
    seen = jax.device_get(traces(key, sim, proposal, PROBES, drawn=nominal_policy(sim)))
    missing = int((~seen.invalid & ~(seen.log_weight < np.inf)).sum())
    said = (
        f"the proposal has density 0 on {missing} of {PROBES} of the model's own episodes: failures"
        " that it cannot draw are missing from the estimate"
    )
    return [said] if missing else []
