"""The audit of a proposal: failures that it hardly draws are looked for by populations that it was
not fitted to. It absorbs what they find, or that becomes a reason against the estimate.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.host_populations import (
    FINAL_MOVES,
    LEVEL_SHARE,
    draw_wide,
    equilibrate,
    explore,
    wide_enough,
)
from jast._src.estimate.proposal_search.adapt import adapt_proposal
from jast._src.estimate.proposal_search.search_state import (
    Family,
    SearchState,
    failure_log_ratios,
    pooled_log_ratio,
)
from jast._src.normal_space.transform import dimension
from jast._src.util.pytrees import index_tree

__all__ = ["Missing", "absorb_missing", "audit_proposal", "missing_among", "uncovered"]

FORGOTTEN = "the proposal hardly draws some failures that wide noise led to"
UNFINISHED = "the budget ran out before the search for lost failure modes was over"
LEAST_BATCHES = 2  # that must be affordable for what was found to be absorbed and weighed
MORE_LEVELS = 4  # that an audit must have room for, beyond those to the tolerated probability
POPULATION_PART = 200  # of a budget, of which a population's points are one part at most


class Missing(NamedTuple):
    """Failures that the proposal hardly draws."""

    share: float
    """Their probability, as a multiple of what the proposal found; nan where nobody knows"""
    points: Any
    """[m] of its `Family`"""
    by_chance: bool = False
    """So few failures that a proposal may be right without them: they are absorbed, while there
    is room, but are no reason against it"""


def audit_proposal(family: Family, state: SearchState) -> SearchState:
    """The state after the audits. The proposal absorbs what they find, is fitted anew and audited
    again; what the last one finds becomes a reason against the estimate.
    """
    settings = family.settings
    state, cooled = _equilibrate_cooled(family, _add_walked_failures(family, state))
    end, explored = settings.search_end * family.budget, False
    for left in reversed(range(settings.audits)):
        state = state._replace(reasons=())  # what is still wrong is said again
        size = _population_size(family, state)
        wide = _affords_wide_noise(family, state) and not size
        if wide:
            state = _draw_widely(family, state, settings.wide_audit)
            state, cooled = _equilibrate_cooled(family, state)
        # a population that found nothing looked at less than the proposal now draws
        state, missing = _missing(family, state, cooled, wide or (explored and not size))
        explored = UNFINISHED not in state.reasons and all(math.isnan(m.share) for m in missing)
        last = wide or not left or state.spent + LEAST_BATCHES * family.batch > end
        if not (missing := [m for m in missing if not (last and m.by_chance)]):
            break
        if last:
            return _check_given(family, _report(state, missing))
        state = absorb_missing(family, state, missing)
        state = adapt_proposal(family, state, settings.audit_refits, end)
    return _check_given(family, _check_uncovered_share(family, state))


def absorb_missing(family: Family, state: SearchState, missing: Sequence[Missing]) -> SearchState:
    """The state whose proposal takes in all of ``missing``: of each the part that those before it
    do not cover, as one lost mode may have been found twice.
    """
    found, least = [], family.settings.absorbed_share_least
    after = state
    for m in missing:
        if (rows := uncovered(family, after, m.points)).any():
            share = least if math.isnan(m.share) else m.share
            found.append((index_tree(m.points, rows), share))
            after = family.absorb(state, found)
    return after


def uncovered(family: Family, state: SearchState, points: Any) -> np.ndarray:
    """Which of the ``points`` the proposal does not cover [m]."""
    return family.log_ratio(state.q, points) < _coverage_threshold(family, state)


def _unseen(family, state, points):
    """Which of the ``points`` neither the proposal nor the batches, all together, cover [m]."""
    pooled = pooled_log_ratio(family, state, points)
    return uncovered(family, state, points) & (pooled < _coverage_threshold(family, state))


def _coverage_threshold(family, state):
    """The log of q / p below which a failure is not covered: where its weight is more than
    `coverage_factor` times the mean one, and where the draws that are left would be too few for a
    part of the probability that matters (`uncovered_share`).
    """
    settings = family.settings
    left = family.budget - state.spent
    draws = settings.uncovered_share * left / settings.coverage_draws
    return -state.log_mean - math.log(max(settings.coverage_factor, draws))


def _equilibrate_cooled(family, state):
    """The failures that wide noise led to as the model has them, after Markov moves; None where
    there are none.
    """
    moves = family.settings.burn_in_moves
    most = int(family.settings.burn_in_share * family.budget)
    z = None if state.cooled is None else state.cooled[: max(most // moves, 1)]
    if z is None or not len(z):
        return state, None
    key, everywhere = family.context.next_key(), family.exclusion(state.q, math.inf)
    population, sampler = equilibrate(
        key, family.sim, z, moves, covered=everywhere, max_evaluations=most
    )
    rows = population.score == -np.inf
    state = state.note(f"audit: {len(z)} failures of wide noise moved", sampler.evaluations)
    return family.as_points(state, population.z[rows], population.used[rows])


def _affords_wide_noise(family, state):
    """Whether an audit has room for draws of wide noise, and for the burn-in of a failure."""
    s = family.settings
    return bool(s.wide_audit) and _room(family, state) > s.wide_audit + s.burn_in_moves


def _draw_widely(family, state, n, moves=0):
    """The state with the uncovered failures that ``n`` draws of wide noise are, or walk to by so
    many ``moves`` each.
    """
    outside = family.exclusion(state.q, _coverage_threshold(family, state))
    width = wide_enough(state.log_mean)
    failures = draw_wide(family.context.rng, family.sim, n, width, moves=moves, covered=outside)
    wide = f"{width:.2f} times wider noise"
    said = f"walks from {wide} end uncovered" if moves else f"draws of {wide} not covered"
    state = state.note(f"audit: {len(failures.z)} of {n} {said}", n * (1 + moves))
    return state._replace(cooled=failures.z)


def _has_few_numbers(family):
    """Whether walks from wide noise come to islands of failures, and moves lead from there to where
    the model has them.
    """
    return dimension(family.sim) < family.settings.moments_numbers


def _add_walked_failures(family, state):
    """The state of a system of few numbers, with the uncovered failures that points of wide noise
    walk to before those that it knows: a population passes by an island of failures. Any other
    state as it is.
    """
    s, known = family.settings, state.cooled
    n = min(int(s.walk_share * family.budget / (1 + s.walk_moves)), s.walks_most)
    if not n or not _has_few_numbers(family):
        return state
    state = _draw_widely(family, state, n, s.walk_moves)
    return state if known is None else state._replace(cooled=np.concatenate([state.cooled, known]))


def _missing(family, state, cooled, explored):
    """[`Missing`, ...] by populations, those of the search too, and by the ``cooled`` failures;
    where all is ``explored`` no further population is needed.
    """
    settings = family.settings
    state, found = (state, []) if explored else _explore_uncovered(family, state)
    missing = []
    for share, p in [*found, *((1.0, p) for p in state.populations)]:
        state, points = family.as_points(state, p.points, p.used)
        state, lost = missing_among(family, state, points, share)
        missing += lost
    if cooled is not None:
        rows = _unseen(family, state, cooled)
        state = state.note(f"audit: {rows.sum()} of {len(rows)} failures moved not covered")
        by_chance = rows.sum() <= max(settings.stray_share * len(rows), settings.stray_count)
        if not by_chance or (rows.any() and _has_few_numbers(family)):
            missing.append(Missing(math.nan, index_tree(cooled, rows), by_chance))
    return state, missing


def missing_among(
    family: Family, state: SearchState, points: Any, share: float
) -> tuple[SearchState, list[Missing]]:
    """What is `Missing` of ``points`` [m], whose probability is a ``share``, as great, times what
    the proposal found; nothing where that is little, or batches have drawn it.
    """
    rows = uncovered(family, state, points)
    part = rows.sum() / max(len(rows), 1)
    state = state.note(f"audit: {share:.2%} of the probability, {part:.0%} not covered")
    missing = Missing(share * part, index_tree(points, rows))
    unseen = _unseen_mass(family, state, missing)
    return state, [missing] if unseen > family.settings.tolerated_mass else []


def _explore_uncovered(family, state):
    """A population down the levels of the miss distance that is kept out of what the proposal
    covers: [(its probability as a multiple of what the proposal found, `Explored`)], or [].
    """
    if not (size := _population_size(family, state)):
        return state.with_reason(UNFINISHED), []
    outside = family.exclusion(state.q, _coverage_threshold(family, state))
    p = explore(
        family.context.next_key(),
        family.sim,
        size,
        covered=outside,
        min_log_probability=_least_log_probability(family, state),
        max_evaluations=int(family.settings.audit_overrun * _room(family, state)),
    )
    state = state.note(f"audit: a population of {size}", p.evaluations)
    if not p.complete:
        state = state.with_reason(UNFINISHED)
    return state, [(math.exp(min(p.log_mean - state.log_mean, 50)), p)] if p.reached else []


def _population_size(family, state):
    """As many points as can afford the levels down to what is tolerated; 0 for too few."""
    levels = _least_log_probability(family, state) / math.log(LEVEL_SHARE)
    fewest = family.settings.audit_population_least
    size = int(_room(family, state) / (levels + FINAL_MOVES + MORE_LEVELS))
    return min(size, max(family.budget // POPULATION_PART, fewest)) if size >= fewest else 0


def _room(family, state):
    """Evaluations that an audit may take."""
    s = family.settings
    return min(s.audit_share * family.budget, s.search_end * family.budget - state.spent)


def _least_log_probability(family, state):
    """Of what an audit looks for."""
    return state.log_mean + math.log(family.settings.tolerated_mass / 2)


def _unseen_mass(family, state, missing):
    """What part of the probability no draw of any batch has come to: by chance, were all of the
    missing share like each of its points (Poisson's law). Where batches have drawn such points,
    they know them better than a population does.
    """
    if not missing.share:
        return 0.0
    ratio = pooled_log_ratio(family, state, missing.points)
    expected = missing.share * state.size * np.exp(ratio + state.log_mean)
    return missing.share * np.exp(-expected).mean()


def _report(state, missing):
    """The state with what is ``missing`` as a reason."""
    shares = [m.share for m in missing if not math.isnan(m.share)]
    if not shares:
        return state.with_reason(FORGOTTEN)
    size = _in_words(max(shares))
    return state.with_reason(
        f"failures that the proposal hardly draws may have {size} the probability that it found"
    )._replace(missing=max(shares))


def _check_uncovered_share(family, state):
    """The state with a reason where much of the probability lies, by the batches, where the
    proposal hardly draws, and few draws tell of it.
    """
    rows = failure_log_ratios(family, state, state.q) < _coverage_threshold(family, state)
    w = np.exp(state.log_weight - state.log_weight.max())
    share = w[rows].sum() / w.sum()
    settings = family.settings
    if share <= settings.uncovered_share:
        return state
    if effective_sample_size(state.log_weight[rows]) >= settings.uncovered_ess:
        return state
    return state.with_reason(
        f"{share:.0%} of the probability found lies where the proposal hardly draws"
    )


def _check_given(family, state):
    """The state with a reason where failures that came with the call are hardly drawn."""
    if state.given is None:
        return state
    missed = int(_unseen(family, state, state.given.points).sum())
    if not missed:
        return state
    number = len(state.given.z)
    return state.with_reason(f"the proposal hardly draws near {missed} of {number} failures given")


def _in_words(share):
    """``share`` of a whole: of large ones the size is not known, only that they are."""
    if share < 1:
        return f"{share:.0%} of"
    return f"{share:.2g} times" if share < 100 else "far more than"
