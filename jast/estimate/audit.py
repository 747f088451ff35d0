"""The audit of a proposal: failures that it hardly draws are looked for by populations that it was
not fitted to. What they find is taken in, or becomes a reason against the estimate.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jast.estimate.adapt import adapted
from jast.estimate.gaussians import effective
from jast.estimate.populations import FINAL_MOVES, LEVEL_SHARE, equilibrate, explore
from jast.estimate.search_state import Family, State, log_ratios, mixed_ratio

__all__ = ["audited", "uncovered"]

FORGOTTEN = "the proposal hardly draws some failures that wide noise led to"
UNFINISHED = "the budget ran out before the search for lost failure modes was over"


class Missing(NamedTuple):
    """Failures that the proposal hardly draws."""

    share: float
    """Their probability, as a multiple of what the proposal found; nan where nobody knows"""
    points: Any
    """[m] of its `Family`"""


def audited(family: Family, state: State) -> State:
    """The state after the audits. What they find is taken into the proposal, which is fitted anew
    and audited again; what the last one finds becomes a reason against the estimate.
    """
    state, cooled = _settled(family, state)
    end = family.settings.search_ends * family.budget
    for left in reversed(range(family.settings.audits)):
        state = state._replace(reasons=())  # what is still wrong is said again
        state, missing = _missing(family, state, cooled)
        if not missing:
            break
        if not left or state.spent + 2 * family.batch > end:
            return _given(family, _reported(state, missing))
        for m in missing:
            share = family.settings.unknown if math.isnan(m.share) else m.share
            state = family.absorbed(state, m.points, share)
        state = adapted(family, state, family.settings.refits_of_audit, end)
    return _given(family, _thin(family, state))


def uncovered(family: Family, state: State, points: Any) -> np.ndarray:
    """Which of the ``points`` the proposal does not cover [m]."""
    return family.log_ratio(state.q, points) < _least(family, state)


def _met(family, state, points):
    """Which of the ``points`` the batches of the search, all together, cover [m]."""
    return mixed_ratio(family, state, points) >= _least(family, state)


def _least(family, state):
    """The log of q / p below which a failure is not covered: where its weight is more than
    `covered` times the mean one, and where the draws that are left would meet too few of a part of
    the probability that matters (`thin`).
    """
    draws = family.settings.thin * (family.budget - state.spent) / family.settings.met
    return -state.log_mean - math.log(max(family.settings.covered, draws))


def _settled(family, state):
    """The failures that wide noise led to as the model has them, after Markov moves; None where
    there are none.
    """
    most = int(family.settings.settling * family.budget)
    z = None if state.cooled is None else state.cooled[: max(most // family.settings.moves, 1)]
    if z is None or not len(z):
        return state, None
    key, everywhere = family.chance.next_key(), family.left_out(state.q, math.inf)
    people, chain = equilibrate(
        key, family.sim, z, family.settings.moves, covered=everywhere, max_evaluations=most
    )
    rows = people.score == -np.inf
    state = state.noted(f"audit: {len(z)} failures of wide noise moved", chain.evaluations)
    return family.points_of(state, people.z[rows], people.used[rows])


def _missing(family, state, cooled):
    """[`Missing`, ...] by populations, those of the search too, and by the settled failures."""
    state, found = _elsewhere(family, state)
    candidates = [] if found is None else [found]
    candidates += [(1.0, p) for p in state.populations]
    missing = []
    for share, p in candidates:
        state, points = family.points_of(state, p.points, p.used)
        rows = uncovered(family, state, points)
        part = rows.sum() / max(len(rows), 1)
        missing.append(Missing(share * part, family.rows(points, rows)))
        state = state.noted(f"audit: {share:.2%} of the probability, {part:.0%} not covered")
    missing = [m for m in missing if _unmet(family, state, m) > family.settings.tolerated]
    if cooled is not None:
        rows = uncovered(family, state, cooled) & ~_met(family, state, cooled)
        state = state.noted(f"audit: {rows.sum()} of {len(rows)} failures moved not covered")
        if rows.sum() > max(family.settings.stray * len(rows), family.settings.stray_least):
            missing.append(Missing(math.nan, family.rows(cooled, rows)))
    return state, missing


def _elsewhere(family, state):
    """A population down the levels of the miss distance that is kept out of what the proposal
    covers: (its probability as a multiple of what the proposal found, `Explored`), or None.
    """
    least = state.log_mean + math.log(family.settings.tolerated / 2)
    room = family.settings.search_ends * family.budget - state.spent
    room = min(family.settings.audit_share * family.budget, room)
    # as many points as can afford the levels down to there
    size = int(room / (least / math.log(LEVEL_SHARE) + FINAL_MOVES + 4))
    size = min(size, max(family.budget // 200, family.settings.fewest))
    if size < family.settings.fewest:
        return state.against(UNFINISHED), None
    key, outside = family.chance.next_key(), family.left_out(state.q, _least(family, state))
    most = int(family.settings.ties * room)
    p = explore(
        key,
        family.sim,
        size,
        covered=outside,
        min_log_probability=least,
        max_evaluations=most,
    )
    state = state.noted(f"audit: a population of {size}", p.evaluations)
    if not p.complete:
        state = state.against(UNFINISHED)
    return state, (math.exp(min(p.log_mean - state.log_mean, 50)), p) if p.reached else None


def _unmet(family, state, missing):
    """What part of the probability no draw of any batch has met: by chance, were all of the
    missing share like each of its points (Poisson's law). Where batches have met such points, they
    know them better than a population does.
    """
    if not missing.share:
        return 0.0
    ratio = mixed_ratio(family, state, missing.points)
    expected = missing.share * state.size * np.exp(ratio + state.log_mean)
    return missing.share * np.exp(-expected).mean()


def _reported(state, missing):
    """The state with what is ``missing`` as a reason."""
    known = [m.share for m in missing if not math.isnan(m.share)]
    if not known:
        return state.against(FORGOTTEN)
    said = (
        f"failures that the proposal hardly draws may have {_in_words(max(known))} the probability"
    )
    return state.against(f"{said} that it found")._replace(missing=max(known))


def _thin(family, state):
    """The state with a reason where much of the probability lies, by the batches, where the
    proposal hardly draws, and few draws tell of it.
    """
    rows = log_ratios(family, state.q, state.batches) < _least(family, state)
    w = np.exp(state.log_weight - state.log_weight.max())
    share = w[rows].sum() / w.sum()
    if share <= family.settings.thin or effective(state.log_weight[rows]) >= family.settings.known:
        return state
    return state.against(
        f"{share:.0%} of the probability found lies where the proposal hardly draws"
    )


def _given(family, state):
    """The state with a reason where failures that came with the call are hardly drawn."""
    if state.given is None:
        return state
    points = state.given.points
    missed = int((uncovered(family, state, points) & ~_met(family, state, points)).sum())
    if not missed:
        return state
    number = len(state.given.z)
    return state.against(f"the proposal hardly draws near {missed} of {number} failures given")


def _in_words(share):
    """``share`` of a whole: of large ones the size is not known, only that they are."""
    if share < 1:
        return f"{share:.0%} of"
    return f"{share:.2g} times" if share < 100 else "far more than"
