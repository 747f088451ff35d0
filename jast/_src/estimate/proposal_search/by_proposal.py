"""A failure probability by a proposal that is found within the budget: explore, adapt, audit, draw.

Two families of proposals are tried, mixtures of Gaussians and tilts of each step. They differ in
where they begin, and in how they are fitted; the search is the same.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.failures import Failures
from jast._src.core.float_resolution import rounding_problem
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback
from jast._src.estimate import weight_sums
from jast._src.estimate.estimate import Estimate, estimate_from_counts, estimate_from_weights
from jast._src.estimate.gaussians.exploration import draw_model, explore_failures
from jast._src.estimate.gaussians.family import GaussianFamily
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.gaussians.moments import explore_moments
from jast._src.estimate.importance_sampling import chunks
from jast._src.estimate.monte_carlo import plain_traces, simulate_points
from jast._src.estimate.proposal_search.adapt import adapt_proposal
from jast._src.estimate.proposal_search.audit import audit_proposal
from jast._src.estimate.proposal_search.final_draws import draw_estimate
from jast._src.estimate.proposal_search.final_lines import add_lines, draw_half_by_lines
from jast._src.estimate.proposal_search.search_state import (
    Family,
    SearchState,
    is_efficient,
    search_context,
)
from jast._src.estimate.proposal_search.settings import FEW_RUNS, SETTINGS, SearchSettings
from jast._src.estimate.subset_simulation import fallback_estimate
from jast._src.estimate.tilts.exploration import (
    absorb_given,
    cool_failures,
    descend_levels,
    replay_given,
)
from jast._src.estimate.tilts.family import TiltFamily
from jast._src.estimate.tilts.tilts import Tilts, shape
from jast._src.estimate.weighted_draws import with_source
from jast._src.normal_space import transform
from jast._src.runtime._jax import was_interrupted
from jast._src.runtime.host_errors import runs_on_host
from jast._src.runtime.progress_bar import Watch
from jast._src.runtime.work import HERE, Placement

__all__ = ["Request", "estimate_by_proposal"]

UNUSABLE = "no proposal was found that draws failures in proportion to their probability"
LEAST_BATCHES = 2  # that are drawn of the first Gaussians, whatever it cost to find them


class Request(NamedTuple):
    """What a call asks for."""

    name: str
    key: jax.Array
    sim: Simulator
    budget: int
    gradients: bool = True
    failures: Failures | None = None
    failure_points: np.ndarray | None = None
    """[m, D] their normal numbers"""
    near: transform.Latent | Tilts | None = None
    """The proposal of a similar system"""
    level: float = 0.95
    watched: tuple[bool, Callback | None] = (False, None)
    """progress and callback"""
    placement: Placement = HERE
    settings: SearchSettings = SETTINGS
    otherwise: Callable[[int], Estimate] | None = None
    """What answers with so many evaluations, in the place of Gaussians, where a system has many
    steps and tilts do not serve. In the 400 numbers of a cart-pole Gaussians took seven tenths of
    the time, and had an effective draw or two of 4000."""

    @property
    def differentiable(self) -> bool:
        """Whether gradients of the miss distance are wanted, and there are any."""
        return self.gradients and not runs_on_host(self.sim)


class Search(NamedTuple):
    """A family of proposals, and what its search knows."""

    family: Family
    state: SearchState

    @property
    def efficiency(self) -> float:
        """Effective draws of a draw; 0 where plain draws or no draws serve better."""
        usable = self.state.missing <= self.family.settings.missing_most
        return self.state.efficiency if usable and is_efficient(self.state, 0.0) else 0.0

    @property
    def suffices(self) -> bool:
        """Whether what is left of the budget tells the probability by the proposal, as far as
        batches of more than a few effective draws say.
        """
        s, left = self.family.settings, self.family.budget - self.state.spent
        if not self.efficiency * left > s.min_ess:
            return False
        return effective_sample_size(self.state.log_weight) >= s.promise_ess

    @property
    def proposal(self) -> Any:
        """What an `Estimate` keeps of it."""
        return None if self.state.q is None else self.family.on_device(self.state.q)


def estimate_by_proposal(request: Request) -> Estimate:
    """The `Estimate` of a call."""
    context, coarse = search_context(request.key), rounding_problem(request.sim)
    reasons = [] if coarse is None else [coarse]
    try:
        return _answer(request, context, reasons)
    except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
        if not was_interrupted(error):
            raise
        if not context.latest:
            raise KeyboardInterrupt from error
        return _estimate_by_batches(request, Search(*context.latest[-1]), reasons)


def _answer(request, context, reasons):
    """The `Estimate`: with few runs of many numbers by the moments of an episode, where these
    serve; else by the most efficient search, with what they left.
    """
    s = request.settings
    many = transform.dimension(request.sim) >= s.moments_numbers
    if not many or request.budget > s.moments_budget or request.near is not None:
        return _draw(request, _search(request, context), reasons)
    first = _search_moments(request, context)
    serves = first.suffices and is_efficient(first.state, s.family_efficiency)
    state, rest = first.state, request._replace(budget=request.budget - first.state.spent)
    if serves:
        return _draw_moments(request, _audit(first), reasons)
    if rest.budget < s.moments_alone_budget:
        return _draw_few(request, first, reasons)
    return _after(state, _draw(rest, _search(rest, context), reasons))


def _draw_few(request, search, reasons):
    """The `Estimate` of the runs that moments left, where these do not serve. Where no failure was
    seen, populations take half of them, and plain draws the others, which bound what these miss.
    """
    state = search.state
    if search.suffices or state.log_p > -math.inf:
        return _draw(request, search, reasons)
    n = max((request.budget - state.spent) // 2, 1)
    found, state = _draw_populations(request, search, n, -math.log(n), reasons)
    plain = _draw_plainly(request, search._replace(state=state), reasons)
    if found is None or plain.reliable or not math.isfinite(found.relative_error):
        return plain
    counts = tuple(a + b for a, b in zip(found.plain, plain.plain, strict=True))
    return found._replace(
        episodes=plain.episodes,
        invalid=found.invalid + plain.invalid,
        warnings=(*found.warnings, *plain.warnings),
        history=plain.history,
        plain=counts,
    )


def _draw_populations(request, search, n, log_mean, reasons):
    """(The `Estimate` of a few populations with ``n`` evaluations, the state after them): None
    where they are too few, or the populations reach no failure.
    """
    state = search.state
    found = fallback_estimate(
        request.key,
        request.sim,
        n,
        log_mean,
        request.level,
        reasons=[*reasons, *state.reasons] or [UNUSABLE],
        plain_failures=search.family.settings.plain_failures,
    )
    if found is None:
        return None, state
    found = _after(state, found)
    state = state._replace(spent=found.episodes, history=found.history, plain=found.plain)
    return None if math.isnan(found.log_mean) else found, state


def _after(state, found):
    """The `Estimate` that was ``found`` with what a search had left, which came to ``state``."""
    return found._replace(
        episodes=state.spent + found.episodes,
        history=(*state.history, *found.history),
        plain=tuple(a + b for a, b in zip(state.plain, found.plain or (0, 0, 0), strict=True)),
    )


def _search(request, context):
    """The most efficient `Search`, audited."""
    best, state, settings = None, SearchState(), request.settings
    for search_family in _families(request):
        if request.budget - state.spent < settings.next_family_share * request.budget:
            break
        search = search_family(request, context, state.for_next_family())
        state = search.state
        if best is not None:
            best = best._replace(state=best.state.with_costs_of(state))
        if best is None or (search.efficiency, state.log_p) > (best.efficiency, best.state.log_p):
            best = search
        if best.suffices and is_efficient(best.state, settings.family_efficiency):
            best = _audit(best)
            state = best.state
            if best.suffices:
                return best
        if math.exp(min(state.log_mean, 0.0)) > settings.family_efficiency:
            return best  # plain draws serve
    return _audit(best) if best.suffices else best


def _families(request):
    """The searches, in the order in which they are tried."""
    if _has_many_steps(request):
        return (_search_tilts, _search_gaussians)[: 1 if request.otherwise else 2]
    near = (_search_tilts,) if isinstance(request.near, Tilts) else ()
    return *near, _search_gaussians, _search_mixed_tilts


def _has_many_steps(request):
    """Whether the system has many steps, or choices: tilts are then tried first."""
    about, horizon = shape(request.sim), request.sim.horizon
    return about.has_choices or horizon >= request.settings.tilts_first_horizon


def _search_moments(request, context):
    """The `Search` for Gaussians beyond the boundary of each moment, from few runs."""
    f = GaussianFamily(request.sim, request.budget, context, FEW_RUNS, "moments")
    return Search(f, explore_moments(f, request.failure_points, request.differentiable))


def _search_gaussians(request, context, state):
    """The `Search` for Gaussians."""
    settings = request.settings
    f = GaussianFamily(request.sim, request.budget, context, settings)
    end = state.spent + settings.refits_end * (request.budget - state.spent)
    state = draw_model(f, state)
    if isinstance(request.near, transform.Latent):
        start = state._replace(q=request.near, anchors=f.centres(request.near))
        near = _adapt_near(f, start)
        if is_efficient(near, settings.near_fitted_efficiency):
            return Search(f, near)
        state = near._replace(q=None, anchors=None)
    state = explore_failures(f, state, request.failure_points, request.differentiable)
    if state.q is not None:
        end = max(end, state.spent + LEAST_BATCHES * f.batch)
        state = adapt_proposal(f, state, settings.refits, end)
    return Search(f, state)


def _search_tilts(request, context, state):
    """The `Search` for tilts."""
    settings = request.settings
    f = TiltFamily(request.sim, request.budget, context, settings)
    if isinstance(request.near, Tilts):
        state = replay_given(f, state, request.failures)
        fitting, q = f.near(request.near)
        near = _adapt_near(fitting, state._replace(q=q))
        if is_efficient(near, settings.family_efficiency):
            end = near.spent + settings.given_share * request.budget
            return Search(fitting, absorb_given(fitting, near, end))
        state = near.for_next_family()._replace(given=state.given)
        if not _has_many_steps(request):
            return Search(f, state)
    return _descend_to_tilts(f, request, state, settings.tilts_share * request.budget)


def _search_mixed_tilts(request, context, state):
    """The `Search` for tilts of several Gaussians, with a part of what is left."""
    settings = request.settings
    f = TiltFamily(request.sim, request.budget, context, settings, settings.components_each)
    room = settings.tilts_share_after * (request.budget - state.spent)
    return _descend_to_tilts(f, request, state, room)


def _descend_to_tilts(f, request, state, room):
    """The `Search` for tilts down the levels of the miss distance, for ``room`` evaluations."""
    settings, end = request.settings, state.spent + room
    state = descend_levels(f, replay_given(f, state, request.failures), end)
    if state.q is not None:
        state = adapt_proposal(f, state, settings.refits, end)
        single = f.components_each == 1 and f.about.steps.normals
        if single and state.efficiency < settings.single_efficiency:
            f, before = f._replace(components_each=settings.components_each), state.spent
            state = state._replace(q=f.refit(state)["refitted"])
            last = before + settings.components_share * request.budget
            state = adapt_proposal(f, state, settings.refits, last)
            end += state.spent - before
    end += settings.given_share * request.budget
    return Search(f, absorb_given(f, state, end))


def _adapt_near(f, state):
    """The state after a batch of a similar system's proposal, and where it is not efficient as it
    is after some refits.
    """
    state = adapt_proposal(f, state.note("proposal of a similar system"), 1, math.inf)
    failed = len(state.batches[-1].log_weight)
    if not failed or is_efficient(state, f.settings.near_efficiency):
        return state
    return adapt_proposal(f, state, f.settings.near_refits, math.inf)


def _audit(search):
    """The `Search` after the audits of its proposal."""
    f, state = search
    state = cool_failures(f, state) if isinstance(f, TiltFamily) else state
    state = audit_proposal(f, state)
    f.context.keep(f, state)
    return Search(f, state)


def _draw_moments(request, search, reasons):
    """The `Estimate` of what is left of the budget, where half-spaces are the proposal."""
    state, lines = draw_half_by_lines(*search) if search.suffices else (search.state, None)
    search = search._replace(state=state)
    if lines is None:
        return _draw(request, search, reasons)
    watch = Watch(request.name, request.budget - state.spent, "episode", *request.watched)
    min_ess = None if lines.alike else search.family.settings.min_ess
    found = _draw_proposal(request, search, watch, [*reasons, *state.reasons], min_ess)
    return add_lines(found, lines)


def _draw(request, search, reasons):
    """The `Estimate` of what is left of the budget; ``reasons``: against it, whatever the search
    found: by the proposal, by a few populations or by plain draws.
    """
    f, state = search
    n = max(request.budget - state.spent, 1)  # a search of many parts may have spent all
    enough = f.settings.plain_failures
    often = math.exp(min(state.log_p, 0.0)) * n >= enough
    if not (search.suffices or often) and request.otherwise and _has_many_steps(request):
        return _after(state, request.otherwise(n))
    if not (search.suffices or often) and state.log_p > -math.inf:
        found, state = _draw_populations(request, search, n, state.log_p, reasons)
        search, n = search._replace(state=state), max(request.budget - state.spent, 1)
        often = found is not None and math.exp(found.log_mean) * n >= enough
        if not (found is None or often):
            return found
    if search.suffices or (search.efficiency and not often):
        watch = Watch(request.name, n, "episode", *request.watched)
        unusable = [] if search.suffices else [UNUSABLE]
        against = [*reasons, *state.reasons, *unusable]
        return _draw_proposal(request, search, watch, against, f.settings.min_ess)
    return _draw_plainly(request, search, reasons)


def _draw_plainly(request, search, reasons):
    """The `Estimate` of what is left of the budget by draws of the model."""
    (f, state), key = search, request.key
    n = max(request.budget - state.spent, 1)
    watch = Watch(request.name, n, "episode", *request.watched)
    shared = key, request.sim, f.batch, n
    total, notes, lost = chunks(simulate_points, shared, f.batch, watch, request.placement)
    found = estimate_from_counts(
        request.name,
        total,
        notes=notes,
        reasons=[*reasons, *lost],
        level=request.level,
        history=state.history,
        evaluations=state.spent + total.samples,
        proposal=search.proposal,
    )
    return found._replace(draws=with_source(found.draws, key, f.batch, "model"))


def _draw_proposal(request, search, watch, reasons, min_ess):
    """The `Estimate` by draws of the proposal, some of which are the model's own."""
    (f, state), s = search, request.settings
    surplus = 1 - 1 / (s.exact_error**2 * state.efficiency * watch.total)
    share = np.clip(surplus, s.model_draws_least, s.model_draws_most)
    found = draw_estimate(
        request.key,
        request.sim,
        f.with_model(state.q, float(share)),
        f.batch,
        watch,
        request.placement,
        spent=state.spent,
        reasons=reasons,
        share=float(share),
        drawn=state.plain[2],
        plain=state.plain,
        level=request.level,
        history=state.history,
        min_ess=min_ess,
    )
    return found._replace(proposal=search.proposal)


def _estimate_by_batches(request, search, reasons):
    """The `Estimate` of the batches of a search that was interrupted, by the balance heuristic."""
    state, n = search.state, len(search.state.log_weight)
    failures = plain_traces(np.ones(n, bool), np.zeros(n, bool), np.zeros(n, int))
    failures = failures._replace(log_weight=state.log_weight)
    total = weight_sums.add_traces(weight_sums.empty_sums(state.size), failures)
    total = total._replace(samples=state.size)
    said = (
        f"interrupted after {state.spent} of {request.budget} evaluations: the estimate uses the"
        " same episodes that chose the proposal"
    )
    return estimate_from_weights(
        request.name,
        total,
        level=request.level,
        reasons=[*reasons, said],
        evaluations=state.spent,
        proposal=search.proposal,
        history=state.history,
        plain=state.plain,
    )
