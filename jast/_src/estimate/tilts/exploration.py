"""The first tilts of a search: batches go down the levels of the miss distance, and the episodes
nearest to failure, weighted back to the model, are what the next tilts are fitted to (the
multi-level cross-entropy method: de Boer, Kroese, Mannor and Rubinstein 2005). Where choices are
rare, nothing may lead to a failure: half of the first batch is of a model whose rare categories are
raised (failure biasing, Shahabuddin 1994). Failures that came with the call are taken in.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri

from jast._src.core.episode import Episode, play_back
from jast._src.core.failures import Failures
from jast._src.core.rewards import log_likelihood
from jast._src.core.simulator import Simulator
from jast._src.distributions.independent_parts import Parts, parts
from jast._src.estimate.gaussians.design_points import distinct
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.host_populations import cool, equilibrate
from jast._src.estimate.proposal_search.adapt import adapt_proposal, refit
from jast._src.estimate.proposal_search.audit import uncovered
from jast._src.estimate.proposal_search.search_state import SearchState, add_batch
from jast._src.estimate.tilts.family import Mixture, Points, TiltFamily, at_level
from jast._src.estimate.tilts.tilts import interval_starts, stack_choices
from jast._src.normal_space.transform import normal_numbers, side_by_side
from jast._src.runtime._jax import quick
from jast._src.util.pytrees import index_tree

__all__ = ["FAR", "absorb_given", "cool_failures", "descend_levels", "replay_given"]

FAR = 37.0  # the normal number of a value at the end of a support, whose own is infinite


class Given(NamedTuple):
    """Failures that came with the call."""

    z: np.ndarray
    """[m, D] their random numbers"""
    points: Points


def descend_levels(f: TiltFamily, state: SearchState, end: float) -> SearchState:
    """The state after the search down the levels, for which at most ``end`` evaluations are spent
    in all; without a proposal where it reached no failure.
    """
    q, level, s = f.untilted(), math.inf, f.settings
    if f.about.has_choices:
        floor = math.log(min(s.raised_choices / f.sim.horizon, s.raised_probability_most))
        q = Mixture([f.model, f.model._replace(floor=floor)], [0.5, 0.5], q.frame)
    while state.spent + f.batch <= end:
        play = f.play(q)
        state = state._replace(spent=state.spent + f.batch)
        below = _next_level(s, play.score, level)
        if below is None:
            return state.note(f"tilts: no episode below {level:.3g}")
        level = min(below, level)
        batch = at_level(f, q, play, level)
        if level == -np.inf:
            state = state.note(f"tilts: {np.mean(play.score == -np.inf):.1%} fail")
            return refit(f, add_batch(f, state, batch))[0]
        points = _truncate(f, batch.points, level)
        if not points.length.any():
            state = state.note(f"tilts: every start is as near as {level:.3g}")
            continue
        log_w = -f.log_ratio(q, points)
        ess = f"ESS {effective_sample_size(log_w):.4g} of {len(log_w)}"
        share = np.mean(play.score == -np.inf)
        state = state.note(f"tilts: level {level:.4g}, {share:.1%} fail, {ess}")
        q = f.fit(points, log_w)
    return state


def _next_level(settings, score, last):
    """The next level; None where there is none below the ``last``."""
    ranked, elites = np.sort(score), int(settings.elite_share * len(score))
    level = ranked[max(elites - 1, 0)]
    failing = int((score == -np.inf).sum())
    enough = failing >= settings.level_failures and failing > settings.elite_share / 2 * len(score)
    if last > -np.inf and enough:
        return -np.inf
    if level < last or last == -np.inf:
        return level
    below = ranked[ranked < last]  # no further by the quantile: what is nearest
    return None if len(below) < settings.elite_least else below[min(len(below) - 1, elites)]


def _truncate(f, points, level):
    """The episodes up to where they first reach ``level``: what comes after has no part in that."""
    if f.sim.episodic:
        return points
    reached = points.trace.seen[:, :, 0] <= level
    at = np.where(reached.any(axis=1), reached.argmax(axis=1), f.sim.horizon)
    return points._replace(length=np.minimum(points.length, at))


def cool_failures(f: TiltFamily, state: SearchState) -> SearchState:
    """The state with failures that wide noise leads to: the levels of the miss distance may all
    have been on the way to one failure mode.
    """
    everywhere = f.exclusion(f.untilted(), math.inf)
    cold = cool(f.context.next_key(), f.sim, _chains(f), covered=everywhere)
    state = state.note(f"cooling: {len(cold.points)} points", cold.evaluations)
    return state._replace(cooled=np.asarray(cold.points))


def _chains(f):
    """Markov chains that the budget affords."""
    s = f.settings
    return int(np.clip(f.budget // s.evaluations_per_chain, s.chains_least, s.chains_most_of_tilts))


def replay_given(f: TiltFamily, state: SearchState, failures: Failures | None) -> SearchState:
    """The state with the ``failures`` that came with the call, as far as they fail again."""
    if failures is None or state.given is not None or not (n := len(failures.episodes.length)):
        return state
    most = int(f.settings.given_replay_share * f.budget)
    rows = np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))
    z = numbers_of_episodes(f.sim, index_tree(failures.episodes, rows))
    state, found = _failing(f, state, z)
    state = state.note(f"failures given: {len(found.z)} of {len(z)} fail again")
    return state._replace(given=found) if len(found.z) else state


def absorb_given(f: TiltFamily, state: SearchState, end: float) -> SearchState:
    """The state after it absorbed the failures that came with the call, until ``end`` evaluations
    are spent; where it found none, it begins anew from the likeliest of them.
    """
    s = f.settings
    if state.given is None:
        return state
    if state.q is None:
        state, found = _equilibrate(f, state, distinct(state.given.z, 1), s.chains_least)
        q = f.fit(found.points, np.zeros(len(found.z)))
        state = adapt_proposal(f, state._replace(q=q), s.refits, end)
        if state.log_mean == -math.inf:
            return state._replace(q=None)
    if not (rows := uncovered(f, state, state.given.points)).any():
        return state
    state, found = _equilibrate(f, state, distinct(state.given.z[rows], _chains(f)))
    state, done = state._replace(given=found), []
    for _ in range(s.given_tilts):
        rows = np.setdiff1d(np.flatnonzero(uncovered(f, state, state.given.points)), done)
        if not len(rows) or end - state.spent < f.batch:
            break
        done.append(rows[0])
        state = state.note(f"failures given: {len(rows)} of {len(state.given.z)} not covered")
        state, lead = _equilibrate(f, state, state.given.z[rows[:1]], s.chains_least)
        state = f.absorb(state, [(lead.points, 1.0)])
        state = adapt_proposal(f, state, s.audit_refits, end)
    return state


def _equilibrate(f, state, z, chains=1):
    """The state, and `Given` of failures that Markov moves lead to from ``z`` [m, D], failures too,
    as the model has them: by so many ``chains`` from each.
    """
    key, everywhere = f.context.next_key(), f.exclusion(f.untilted(), math.inf)
    starts, moves = np.repeat(z, chains, axis=0), f.settings.burn_in_moves
    population, sampler = equilibrate(key, f.sim, starts, moves, covered=everywhere)
    places = len(np.unique(z, axis=0))
    state = state.note(f"failures given: around {places} of them", sampler.evaluations)
    return _failing(f, state, population.z)


def _failing(f, state, z):
    """The state, and `Given` of those of the points ``z`` that fail."""
    failing, points = f.play_again(z)
    state = state._replace(spent=state.spent + len(z))
    return state, Given(np.asarray(z)[failing], index_tree(points, failing))


def numbers_of_episodes(sim: Simulator, given: Episode) -> np.ndarray:
    """The points [n, `tilts.dimension`] by which `simulate_points` plays the episodes ``given`` [n]
    again; numbers that decided nothing are 0. On the host.

    A choice has a normal number here too: that of the middle of the interval of uniform numbers
    that `choose_categories` gives to its category. As rare categories lie near 0, floats tell all
    apart.
    """
    about = given.x0, given.disturbances, given.length
    return side_by_side(sim, partial(_numbers, sim), *about).astype(normal_numbers(sim))


@quick
def _numbers(sim, x0, disturbances, length):
    def one(x0, x, length):
        e = play_back(sim, log_likelihood, x0, x, length)
        states = index_tree(e.states, np.s_[:-1])
        first = _numbers_of_value(parts(sim.start()), e.x0)
        of_steps = jax.vmap(lambda s, x: _numbers_of_value(parts(sim.disturbance(s)), x))
        z = of_steps(states, e.disturbances)
        live = jnp.arange(sim.horizon, dtype=jnp.int32) < e.length
        z = jnp.concatenate([first, jnp.where(live[:, None], z, 0).ravel()])
        return jnp.nan_to_num(z, posinf=FAR, neginf=-FAR)

    return jax.vmap(one)(x0, disturbances, length)


def _numbers_of_value(p: Parts, x: Any) -> jax.Array:
    """The normal numbers of the value ``x``, then those of its choices."""
    z, choices = p.inverse(x)
    if not choices:
        return z
    odds = jnp.exp(jax.nn.log_softmax(stack_choices(p), axis=-1))
    at = jnp.concatenate(choices)[:, None]
    begin, width = (jnp.take_along_axis(a, at, axis=1)[:, 0] for a in (interval_starts(odds), odds))
    return jnp.concatenate([z, ndtri(begin + width / 2)])
