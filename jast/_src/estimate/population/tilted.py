"""Tilts of each step, fitted to the failures of populations and then to what they draw themselves:
for systems of many steps, whose failures no Gaussians of all numbers draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jast._src.estimate.population.failure_sample import sample_from
from jast._src.estimate.population.search import Kind, PopulationSearch
from jast._src.estimate.proposal_search.adapt import adapt_proposal
from jast._src.estimate.proposal_search.audit import absorb_missing, missing_among
from jast._src.estimate.proposal_search.search_state import SearchState, search_context
from jast._src.estimate.proposal_search.settings import SETTINGS
from jast._src.estimate.tilts.family import Points, TiltFamily
from jast._src.estimate.tilts.recorded import failing_points
from jast._src.estimate.tilts.tilts import Tilts, shape
from jast._src.runtime.device import on_cpu
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.pytrees import join_rows

__all__ = ["FittedTilts", "fit_tilts"]

FIT_SHARE = 0.5
"""Share of the draws, at most, that tilts are fitted to."""
MIN_POINTS = 500
"""Failures of each way at least, where it has as many: of a hundred a single one that is not
covered would be a part that matters."""
REFITS = 4
"""Batches of a fit at most: the first tilts, fitted to failures of populations, are good ones."""
MAX_MISSING = 0.2
"""Share of the failures of a population that are not covered, above which tilts are given up: of
those of the ship and the cart-pole of `benchmarks.closed_loops` .3 to .7 are not, and taking them
in changes that little; of those of the oven .1."""


class FittedTilts(NamedTuple):
    """Tilts, and what their batches say of them."""

    q: Tilts
    efficiency: float
    """Effective draws of a draw"""
    most: int
    """Draws that memory holds at a time"""


def fit_tilts(search: PopulationSearch, kinds: Sequence[Kind], draws: int) -> FittedTilts | None:
    """Tilts that cover the failures of ``kinds``, fitted within so many ``draws``. None where these
    stay uncovered; of a system of few steps without choices, whose failures Gaussians draw; and
    where evaluations are dear, or an accelerator makes them.
    """
    sim, about = search.sim, shape(search.sim)
    many = about.has_choices or sim.horizon >= SETTINGS.tilts_first_horizon
    if not many or runs_on_host(sim) or not on_cpu():
        return None
    each = SETTINGS.components_each if about.steps.normals else 1
    f = TiltFamily(sim, draws, search_context(search.key), components_each=each)
    errors = [search.answer(kind).relative for kind in kinds]
    if not all(errors):
        return None
    found = [_failures(f, search, kind) for kind in kinds]
    if not all(sizes := [len(points.length) for points in found]):
        return None
    # a kind counts as its variance says, and each of its failures alike
    log_w = np.repeat(-2 * np.log(errors) - np.log(sizes), sizes)
    try:
        state, missing = _cover(f, SearchState(q=f.fit(join_rows(*found), log_w)), found)
    except KeyboardInterrupt:
        search.spent += sum(state.spent for _, state in f.context.latest)
        raise
    search.spent += state.spent
    search.history += state.history
    if missing:
        search.history.append("tilts: which hardly draw some failures of populations")
    if missing or not len(state.log_weight):
        return None
    return FittedTilts(f.with_model(state.q, SETTINGS.model_share), state.efficiency, f.most)


def _cover(f, state, found):
    """The state after batches of tilts that took in, once, what of the failures ``found`` they did
    not cover; and whether there is still some of it.
    """
    end = FIT_SHARE * f.budget
    state, lost = _fit_and_look(f, state, found, REFITS, end)
    if lost and max(m.share for m in lost) <= MAX_MISSING and state.spent + f.batch <= end:
        state = absorb_missing(f, state, lost)
        state, lost = _fit_and_look(f, state, found, f.settings.audit_refits, end)
    return state, bool(lost)


def _fit_and_look(f, state, found, refits, end):
    """The state after so many batches at most, and what is `Missing` of the failures ``found``."""
    state, missing = adapt_proposal(f, state, refits, end), []
    for points in found if len(state.log_weight) else ():
        state, lost = missing_among(f, state, points, 1.0)
        missing += lost
    return state, missing


def _failures(f: TiltFamily, search: PopulationSearch, kind: Kind) -> Points:
    """Failures of a kind of populations, as many as a batch has at most, and `MIN_POINTS`."""
    points = sample_from(search.runs[kind]).points
    most = min(max(f.batch, MIN_POINTS), f.most)
    rows = np.linspace(0, len(points) - 1, min(len(points), most)).astype(int)
    search.spent += len(rows)
    return failing_points(search.sim, points[rows])
