"""The double-loop estimate (Lipkis and Agogino, section 5): many starts, and from each of them many
traces.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp

from jast._src.core.contract import contract
from jast._src.core.policy import Policy
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, PRNGKey
from jast._src.estimate.estimate import Estimate, estimate_from_weights
from jast._src.estimate.importance_sampling import Traces, chunks, one_trace
from jast._src.estimate.proposals import Proposal, as_proposal
from jast._src.runtime.progress_bar import Watch
from jast._src.util.checks import check_random_key, whole_number, wrong
from jast._src.util.display import call_settings
from jast._src.util.intervals import checked_level

__all__ = ["double_loop"]

MAX_LANES = 16384
"""Traces of a chunk, side by side."""


def double_loop(
    key: PRNGKey,
    sim: Simulator,
    proposal: Proposal | Policy,
    starts: int = 1000,
    samples: int = 100,
    *,
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
) -> Estimate:
    """Estimate the failure probability of ``sim`` as a mean over starts of the probability given
    each: `Estimate`.

    The outer loop draws ``starts`` times an x0, the inner one ``samples`` traces from each, whose
    weights are averaged. An inner mean is unbiased for the start's weight times the failure
    probability given it, so the mean of all is unbiased; the standard error is that of the outer
    mean. `importance` draws a start for each trace, so it sees more starts at equal cost: with a
    good policy, where what is left of the variance comes from the start, this one is worse.

    Args:
        key: random key, consumed.
        sim: `jast.Simulator`.
        proposal: a `Proposal` of one component (of one trace, or of `policy_proposal` with
            ``mixing="step"``), or a `jast.Policy` with densities.
        starts: outer draws, at least 2; the ``samples`` of the `Estimate`.
        samples: inner draws from each start, at most 16384.
        level: of the interval, in (0, 1).
        progress: show a bar.
        callback: ``callback(done, total, None)`` after each chunk of starts.

    Returns:
        `Estimate`, whose ``evaluations`` are ``starts`` x ``samples``. A start counts as failing
        where one of its traces fails.

    Raises:
        ValueError: for counts out of range, a level outside (0, 1), a proposal of several
            components or without a density, and where the simulator's functions do not fit.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.pendulum()
        >>> model = jast.Policy(sim.start, lambda state, t: sim.disturbance(state))
        >>> counted = jast.estimate.double_loop(jax.random.key(0), sim, model, 100, 5)
        >>> int(counted.evaluations)
        500
    """
    name = "double_loop"
    check_random_key(name, key)
    starts = whole_number(name, "starts", starts, 2)
    samples = whole_number(name, "samples", samples)
    if samples > MAX_LANES:
        raise ValueError(f"{name}: samples must be at most {MAX_LANES}, received {samples!r}")
    level = checked_level(name, level)
    contract(name, sim)
    proposal = as_proposal(name, sim, proposal)
    if len(proposal.log_weights) > 1:
        must = "have one component, since its traces share their start"
        raise wrong(name, "proposal", must, len(proposal.log_weights))
    settings = call_settings(name, key, starts=starts, samples=samples, level=level)
    lanes = max(1, min(starts, MAX_LANES // samples))
    watch = Watch(name, starts, "start", progress, callback)
    shared = key, sim, proposal, lanes, samples
    total, notes, reasons = chunks(_simulate_chunk, shared, lanes, watch)
    about = dict(level=level, reasons=reasons, notes=notes)
    found = estimate_from_weights(name, total, evaluations=total.samples * samples, **about)
    return found._replace(settings=settings)


def _simulate_chunk(shared, i, context):
    key, *about = shared
    return _simulate_starts(jax.random.fold_in(key, i), *about)


@partial(jax.jit, static_argnames=("lanes", "samples"))
def _simulate_starts(key, sim, proposal, lanes, samples):
    """`Traces` [lanes], a row a start: its weight is the mean over its traces."""

    def one(key):
        for_start, for_traces = jax.random.split(key)
        keys = jax.random.split(for_traces, samples)
        rows = jax.vmap(lambda k: one_trace(k, sim, proposal, start_key=for_start))(keys)
        fails = jnp.any(rows.failure)
        failing = logsumexp(jnp.where(rows.failure, rows.log_weight, -jnp.inf))
        log_weight = jnp.where(fails, failing, logsumexp(rows.log_weight)) - jnp.log(samples)
        return Traces(
            log_weight=log_weight,
            shares=rows.shares[0],
            failure=fails,
            invalid=jnp.any(rows.invalid),
            length=jnp.sum(rows.length),
        )

    return jax.vmap(one)(jax.random.split(key, lanes))
