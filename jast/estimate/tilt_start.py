"""The first tilts of a search: batches go down the levels of the miss distance, and the episodes
nearest to failure, weighted back to the model, are what the next tilts are fitted to (the
multi-level cross-entropy method: de Boer, Kroese, Mannor and Rubinstein 2005). Where choices are
rare, nothing may lead to a failure: half of the first batch is of a model whose rare categories are
raised (failure biasing, Shahabuddin 1994). Failures that came with the call are taken in.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jast.estimate.adapt import adapted, refitted
from jast.estimate.audit import uncovered
from jast.estimate.design_points import distinct
from jast.estimate.gaussians import effective
from jast.estimate.populations import cool, equilibrate
from jast.estimate.recorded_tilts import recorded
from jast.estimate.search_state import State, taken
from jast.estimate.tilt_family import Mixture, Points, TiltFamily, of_level

__all__ = ["cooled", "given", "led_down", "with_given"]


class Given(NamedTuple):
    """Failures that came with the call."""

    z: np.ndarray
    """[m, D] numbers of chance"""
    points: Points


def led_down(f: TiltFamily, state: State, end: float) -> State:
    """The state after the search down the levels, for which at most ``end`` evaluations are spent
    in all; without a proposal where it reached no failure.
    """
    q, level = f.untilted(), math.inf
    if f.about.choices or f.about.choices0:
        floor = math.log(min(f.settings.raised / f.sim.horizon, f.settings.raised_most))
        q = Mixture([f.model, f.model._replace(floor=floor)], [0.5, 0.5], q.frame)
    while state.spent + f.batch <= end:
        play = f.play(q)
        state = state._replace(spent=state.spent + f.batch)
        below = _next(f.settings, play.score, level)
        if below is None:
            return state.noted(f"tilts: no episode below {level:.3g}")
        level = min(below, level)
        batch = of_level(f, q, play, level)
        if level == -np.inf:
            state = state.noted(f"tilts: {np.mean(play.score == -np.inf):.1%} fail")
            return refitted(f, taken(f, state, batch))[0]
        points = _until(f, batch.points, level)
        if not points.length.any():
            state = state.noted(f"tilts: every start is as near as {level:.3g}")
            continue
        log_w = -f.log_ratio(q, points)
        ess = f"ESS {effective(log_w):.4g} of {len(log_w)}"
        share = np.mean(play.score == -np.inf)
        state = state.noted(f"tilts: level {level:.4g}, {share:.1%} fail, {ess}")
        q = f.fitted(points, log_w)
    return state


def _next(s, score, last):
    """The next level; None where there is none below the ``last``."""
    ranked = np.sort(score)
    new = ranked[max(int(s.elite * len(score)) - 1, 0)]
    failing = int((score == -np.inf).sum())
    if failing >= s.failures and last > -np.inf and failing > s.elite / 2 * len(score):
        return -np.inf
    if new >= last and last > -np.inf:  # no further by the quantile: what is nearest
        below = ranked[ranked < last]
        return (
            None
            if len(below) < s.elite_least
            else below[min(len(below) - 1, int(s.elite * len(score)))]
        )
    return new


def _until(f, points, level):
    """The episodes up to where they first reach ``level``: what comes after has no part in that."""
    if f.sim.episodic:
        return points
    reached = points.trace.seen[:, :, 0] <= level
    at = np.where(reached.any(axis=0), reached.argmax(axis=0), f.sim.horizon)
    return points._replace(length=np.minimum(points.length, at))


def cooled(f: TiltFamily, state: State) -> State:
    """The state with failures that wide noise leads to: the levels of the miss distance may all
    have been on the way to one failure mode.
    """
    everywhere = f.left_out(f.untilted(), math.inf)
    cold = cool(f.chance.next_key(), f.sim, _chains(f), covered=everywhere)
    state = state.noted(f"cooling: {len(cold.points)} points", cold.evaluations)
    return state._replace(cooled=np.asarray(cold.points))


def _chains(f):
    """Markov chains that the budget affords."""
    s = f.settings
    return int(np.clip(f.budget // s.chain_of, s.chains_least, s.chains_of_tilts))


def given(f: TiltFamily, state: State, episodes: Any) -> State:
    """The state with the failures that came with the call, as far as they fail again."""
    if episodes is None or not (n := len(episodes.length)):
        return state
    rows = np.unique(np.linspace(0, n - 1, min(n, int(f.settings.given * f.budget))).astype(int))
    z = recorded(f.sim, jax.tree.map(lambda a: a[rows], episodes))
    state, found = _failing(f, state, z)
    state = state.noted(f"failures given: {len(found.z)} of {len(z)} fail again")
    return state._replace(given=found) if len(found.z) else state


def with_given(f: TiltFamily, state: State, end: float) -> tuple[TiltFamily, State]:
    """The search after it took in the failures that came with the call, until ``end`` evaluations
    are spent; where it met none, it begins anew from the likeliest of them.
    """
    if state.given is None:
        return f, state
    if state.q is None:
        state, found = _around(
            f, state, np.repeat(distinct(state.given.z, 1), f.settings.chains_least, axis=0)
        )
        q = f.fitted(found.points, np.zeros(len(found.z)))
        state = adapted(f, state._replace(q=q), f.settings.refits, end)
        if state.log_mean == -math.inf:
            return f, state._replace(q=None)
    if not (rows := uncovered(f, state, state.given.points)).any():
        return f, state
    state, found = _around(f, state, distinct(state.given.z[rows], _chains(f)))
    state, done = state._replace(given=found), []
    for _ in range(f.settings.places):
        rows = np.setdiff1d(np.flatnonzero(uncovered(f, state, state.given.points)), done)
        if not len(rows) or end - state.spent < f.batch:
            break
        done.append(rows[0])
        state = state.noted(f"failures given: {len(rows)} of {len(state.given.z)} not covered")
        state, lead = _around(
            f, state, np.repeat(state.given.z[rows[:1]], f.settings.chains_least, axis=0)
        )
        f = f._replace(widest=f.widest + 2)
        state = f.absorbed(state, lead.points, 1.0)
        state = adapted(f, state, f.settings.refits_of_audit, end)
    return f, state


def _around(f, state, z):
    """The state, and `Given` of failures that Markov moves lead to from ``z``, failures too, as the
    model has them.
    """
    everywhere = f.left_out(f.untilted(), math.inf)
    people, chain = equilibrate(f.chance.next_key(), f.sim, z, f.settings.moves, covered=everywhere)
    places = len(np.unique(z, axis=0))
    state = state.noted(f"failures given: around {places} of them", chain.evaluations)
    return _failing(f, state, people.z)


def _failing(f, state, z):
    """The state, and `Given` of those of the points ``z`` that fail."""
    failing, points = f.play_again(z)
    state = state._replace(spent=state.spent + len(z))
    return state, Given(np.asarray(z)[failing], f.rows(points, failing))
