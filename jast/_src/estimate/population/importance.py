"""Importance sampling after populations: Gaussians or tilts that are fitted to their failures draw
the last part, where they promise more than further populations.

Where failures lie in a curved set of many numbers no Gaussians serve, and their weights would not
say so; the failures of populations do (`benchmarks.closed_loops`: crossing, cart-pole).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.estimate.diagnostics import tail_size
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.gaussians.family import defensive_parts
from jast._src.estimate.gaussians.mixture_fit import as_latent, fit_mixture
from jast._src.estimate.importance_sampling import chunk_size
from jast._src.estimate.population.failure_sample import sample_from
from jast._src.estimate.population.search import Answer, Kind, PopulationSearch, pool_answers
from jast._src.estimate.population.tilted import fit_tilts
from jast._src.estimate.proposal_search.final_draws import draw_estimate
from jast._src.estimate.proposal_search.mixture_draws import log_ratio
from jast._src.estimate.tilts.tilts import Tilts
from jast._src.normal_space.transform import Latent, dimension, normal_numbers, smooth_numbers
from jast._src.runtime.device import BLOCK
from jast._src.runtime.progress_bar import Watch

__all__ = ["gaussians_promise_more", "importance_estimate"]

TARGET_ERROR = 0.005
"""Relative standard error at which it ends: no population checks a smaller one."""
TILTS_TARGET_ERROR = 0.01
"""The same of tilts, which are not tried where Gaussians promise it: their draws are dear."""
EVALUATIONS_A_DRAW = 14
"""Evaluations of populations that take as long as a draw of tilts, in the mean: 7 to 24 on sixteen
loops, by ``python -m benchmarks.rates --tilts``."""
MIN_TILTED_DRAWS = 4000
"""Draws that tilts have at least: with fewer a batch is of less than two hundred."""
MAX_CHECK_ERROR = 0.15
"""Relative standard error of the populations above which they check no importance sampling where
some of the disturbances are choices or counts: to what of these was not met no Gaussian is near. Of
coins beside normal numbers, counts and a Markov chain with 50,000 and 100,000 evaluations, whose
populations are mostly above it, 6 of 86 reliable answers were more than 3 standard errors too low,
by a tenth; with 300,000, where they are mostly below, 1 of 70."""
MAX_PRODUCTS = 5e10
"""Products that the densities of a proposal may cost: some five seconds of a core."""
MAX_COMPONENTS = 16
"""Gaussians at most."""
PLANNED_DRAWS = 100_000
"""Draws that `MAX_PRODUCTS` are to pay: of long episodes there are fewer Gaussians."""
PILOT_DIVISOR = 8
"""Share of the draws, as its denominator, that is drawn first."""
MAX_SHAPE = 0.5
"""Pareto shape of weights above which they have no variance (Vehtari and others 2024)."""
SHAPE_ERRORS = 2.0
"""Standard errors that the shape of a pilot is above `MAX_SHAPE` where its weights are rejected. Of
sums of ten numbers, which Gaussians serve, pilots say .51 to .60 by chance, one error above; of the
follower in `benchmarks.time_to_answer`, which they do not, .6 to .75, two to five."""


class FittedProposal(NamedTuple):
    """A proposal, and what is expected of it."""

    q: Latent | Tilts
    draws: int
    """As many as serve"""
    relative: float
    """Relative standard error of these"""
    most: int | None = None
    """As many as memory holds at a time; None: any number"""


def importance_estimate(
    search: PopulationSearch, name: str, kinds: Sequence[Kind], level: float
) -> Estimate | None:
    """The `Estimate` by Gaussians or tilts fitted to the failures of ``kinds``; None where
    populations promise as much with what is left of the budget, and where the weights speak against
    them.
    """
    left = _affordable(search)
    if left < BLOCK or not _is_checked(search, kinds):
        return None
    proposals = [_best_proposal(search, kinds, left)]
    if proposals[0].relative > TILTS_TARGET_ERROR:
        try:
            proposals += _tilts(search, kinds, left // EVALUATIONS_A_DRAW)
        except KeyboardInterrupt:
            search.note_interruption()
            return None
    by_populations = search.answer(kinds[0]).relative
    for proposal in sorted(proposals, key=lambda proposal: proposal.relative):
        left = _affordable(search)
        promised = by_populations / math.sqrt(1 + left / search.evaluations(kinds[0]))
        draws = min(proposal.draws, left)  # what was fitted or drawn after it was planned is spent
        if search.interrupted or draws < BLOCK:
            break
        relative = proposal.relative * math.sqrt(proposal.draws / draws)
        if relative > promised:
            continue
        planned = proposal._replace(draws=draws, relative=relative)
        if (found := _draw_checked(search, name, planned, level)) is not None:
            return found
    return None


def _affordable(search):
    """Draws that the rest of the budget affords, after a pilot of a part of them."""
    return (search.budget - search.spent) * PILOT_DIVISOR // (PILOT_DIVISOR + 1)


def _tilts(search, kinds, draws):
    """[`FittedProposal`] of tilts, of so many ``draws`` in all; [] where these do not serve."""
    spent = search.spent
    fitted = fit_tilts(search, kinds, draws) if draws >= MIN_TILTED_DRAWS else None
    if fitted is None:
        return []
    wanted = 1 / (fitted.efficiency * TILTS_TARGET_ERROR**2)
    draws = max(int(min(wanted, draws - (search.spent - spent))), BLOCK)
    relative = 1 / math.sqrt(fitted.efficiency * draws)
    return [FittedProposal(fitted.q, draws, relative, fitted.most)]


def _draw_checked(search, name, proposal, level):
    """The `Estimate` of the draws of a `FittedProposal`, a pilot before them; None where their
    weights speak against it, or it was interrupted before them.
    """
    for_pilot, for_draws = jax.random.split(search.key)
    pilot = proposal._replace(draws=max(proposal.draws // PILOT_DIVISOR, BLOCK))
    found = _draw_estimate(search, name, "a pilot of importance sampling", for_pilot, pilot, level)
    if found is None or search.interrupted:
        return None
    # the standard error of a shape by so long a tail (Smith 1987)
    error = (1 + MAX_SHAPE) / math.sqrt(tail_size(found.samples) + 1)
    if found.k_hat > MAX_SHAPE + SHAPE_ERRORS * error:
        reason = f"Pareto k-hat above {MAX_SHAPE}: the weights have no variance"
    else:
        found = _draw_estimate(search, name, "importance sampling", for_draws, proposal, level)
        if found is None or found.reliable:
            return found
        reason = "; ".join(found.warnings)
    search.history.append(f"which is not used: {reason}")
    return None


def _is_checked(search, kinds):
    """Whether the populations of ``kinds`` would see what a proposal leaves out."""
    if smooth_numbers(search.sim).all():
        return True
    return pool_answers([search.answer(k) for k in kinds]).relative <= MAX_CHECK_ERROR


def gaussians_promise_more(search: PopulationSearch) -> bool:
    """Whether Gaussians fitted to the failures so far promise more than plain draws of what is left
    of the budget.
    """
    best = _best_proposal(search, search.reached(), search.budget - search.spent)
    return best.relative < search.plain_error()


def _best_proposal(search, kinds, left):
    """The `FittedProposal` of one or of several Gaussians that promises more."""
    copies = 2  # of each component there is a wide copy
    affordable = MAX_PRODUCTS / (copies * PLANNED_DRAWS * dimension(search.sim) ** 2)
    several = max(int(min(affordable, MAX_COMPONENTS)), 1)
    samples = [sample_from(search.runs[k]) for k in kinds]
    log_mean = pool_answers([search.answer(k) for k in kinds]).log_mean
    fitted = [_fit_proposal(search, samples, log_mean, left, k) for k in sorted({1, several})]
    return min(fitted, key=lambda proposal: proposal.relative)


def _fit_proposal(search, samples, log_mean, left, components):
    """The `FittedProposal` of so many Gaussians at most, fitted to the first `Sample`. The second
    moment of their weights, E[p / q | failure] / P, is the greatest one that a `Sample` tells.
    """
    points, log_w = samples[0].points.astype(np.float64), samples[0].log_weight
    weights = np.exp(log_w - np.logaddexp.reduce(log_w))
    g = fit_mixture(numpy_generator(search.key, 7), points, weights, len(points), limit=components)
    q = as_latent(defensive_parts(g, 0.0, True), normal_numbers(search.sim))
    log_moment = max(
        np.logaddexp.reduce(a.log_weight - log_ratio(q, a.points, a.used))
        - np.logaddexp.reduce(a.log_weight)
        for a in samples
    )
    moment = math.exp(min(log_moment - log_mean, 700.0))  # e^700: no Gaussians serve
    products = len(q.means) * points.shape[1] ** 2
    wanted = min(moment / TARGET_ERROR**2, MAX_PRODUCTS / products, left)
    draws = max(int(wanted), BLOCK)
    return FittedProposal(q, draws, math.sqrt(moment / draws))


def _draw_estimate(search, name, said, key, proposal, level):
    """The `Estimate` of the draws of a `FittedProposal`, which are ``said`` to be so; None where an
    interruption left none.
    """
    said += " by tilts" if isinstance(proposal.q, Tilts) else " by Gaussians"
    watch = Watch(name, proposal.draws, "episode", False, None)
    lanes = chunk_size(proposal.draws)
    # each has a checkpoint of its own
    placement = search.placement._replace(name=said.replace(" ", "-"))
    try:
        found = draw_estimate(
            key,
            search.sim,
            proposal.q,
            min(lanes, proposal.most or lanes),
            watch,
            placement,
            spent=search.spent,
            reasons=(),
            drawn=int(search.plain[2]),
            level=level,
        )
    except KeyboardInterrupt:
        search.note_interruption()
        return None
    search.spent += found.samples
    search.invalid += found.invalid
    if found.samples < proposal.draws:
        search.note_interruption()
    answer = Answer(found.log_mean, found.relative_error)
    search.history.append(f"{said}: {answer}, {found.samples} draws, k-hat {found.k_hat:.2f}")
    return found
