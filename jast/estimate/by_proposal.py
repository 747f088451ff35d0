"""A failure probability by a proposal that is found within the budget: explore, adapt, audit, draw.

Two families of proposals are tried, mixtures of Gaussians and tilts of each step. They differ in
where they begin, and in how they are fitted; the search is the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jast import limit_state as latent
from jast._jax import was_interrupted
from jast.estimate import diagnostics, sums
from jast.estimate.adapt import adapted
from jast.estimate.audit import audited
from jast.estimate.draws import with_source
from jast.estimate.estimate import Estimate, estimate_from_counts, estimate_from_weights
from jast.estimate.final_draws import estimated
from jast.estimate.gaussian_family import GaussianFamily
from jast.estimate.gaussian_start import explored, looked
from jast.estimate.importance_sampling import Traces, chunks
from jast.estimate.markov_tilts import Tilts, shape
from jast.estimate.plain import simulate_points
from jast.estimate.search_settings import SETTINGS, SearchSettings
from jast.estimate.search_state import Family, State, begun, serves
from jast.estimate.subset import fallback_estimate
from jast.estimate.tilt_family import TiltFamily
from jast.estimate.tilt_start import cooled, given, led_down, with_given
from jast.failures import Failures
from jast.incidents import runs_on_host
from jast.rounding import rounding_problem
from jast.simulator import Simulator
from jast.units import HERE, Placement
from jast.watch import Watch

__all__ = ["by_proposal"]

ASTRAY = "no proposal was found that draws failures in proportion to their probability"


class Asked(NamedTuple):
    """What a call asks for."""

    name: str
    key: jax.Array
    sim: Simulator
    budget: int
    gradients: bool = True
    failures: Failures | None = None
    known: Any = None
    """[m, D] their normal numbers"""
    near: Any = None
    """The proposal of a similar system"""
    level: float = 0.95
    watched: tuple[bool, Any] = (False, None)
    """progress and callback"""
    ways: Placement = HERE
    settings: SearchSettings = SETTINGS


class Search(NamedTuple):
    """A family of proposals, and what its search knows."""

    family: Family
    state: State

    @property
    def worth(self) -> float:
        """Effective draws of a draw; 0 where plain draws or no draws serve better."""
        lost = self.state.missing > self.family.settings.lost
        return 0.0 if lost or not serves(self.state, 0.0) else self.state.promised

    @property
    def enough(self) -> bool:
        """Whether what is left of the budget tells the probability by the proposal."""
        return self.worth * (self.family.budget - self.state.spent) > diagnostics.MIN_ESS


def by_proposal(asked: Asked) -> Estimate:
    """The `Estimate` of a call."""
    chance, coarse = begun(asked.key), rounding_problem(asked.sim)
    against = [] if coarse is None else [coarse]
    try:
        return _drawn(asked, _sought(asked, chance), against)
    except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
        if not was_interrupted(error):
            raise
        if not chance.latest:
            raise KeyboardInterrupt from error
        return _of_the_search(asked, Search(*chance.latest[-1]), against)


def _sought(asked, chance):
    """The `Search` that serves best, audited."""
    best, state = None, State()
    for explore in _ways(asked):
        if asked.budget - state.spent < asked.settings.another * asked.budget:
            break
        search = explore(asked, chance, state.carried())
        state = search.state
        if best is not None:
            best = best._replace(state=best.state.after(state))
        if best is None or (search.worth, search.state.log_p) > (best.worth, best.state.log_p):
            best = search
        if best.enough and serves(best.state, asked.settings.serves):
            best = _audited(best)
            state = best.state
            if best.enough:
                return best
        if math.exp(min(state.log_mean, 0.0)) > asked.settings.serves:
            return best  # plain draws serve
    return _audited(best) if best.enough else best


def _ways(asked):
    """The searches, in the order in which they are tried."""
    if _long(asked):
        return _tilts, _gaussians
    near = (_tilts,) if isinstance(asked.near, Tilts) else ()
    return *near, _gaussians, _more_tilts


def _long(asked):
    """Whether the system has many steps, or choices: tilts are then tried first."""
    about = shape(asked.sim)
    return about.choices or about.choices0 or asked.sim.horizon >= asked.settings.tilts_first


def _gaussians(asked, chance, state):
    """The `Search` for Gaussians."""
    f = GaussianFamily(asked.sim, asked.budget, chance, asked.settings)
    end = state.spent + asked.settings.refits_end * (asked.budget - state.spent)
    state = looked(f, state)
    if isinstance(asked.near, latent.Latent):
        start = state._replace(q=asked.near, anchors=f.centres(asked.near))
        if serves(near := _from_near(f, start), asked.settings.near_fitted):
            return Search(f, near)
        state = near._replace(q=None, anchors=None)
    state = explored(f, state, asked.known, asked.gradients and not runs_on_host(asked.sim))
    if state.q is not None:
        end = max(end, state.spent + 2 * f.batch)  # what was found is drawn, however dear it was
        state = adapted(f, state, asked.settings.refits, end)
    return Search(f, state)


def _tilts(asked, chance, state):
    """The `Search` for tilts."""
    f = TiltFamily(asked.sim, asked.budget, chance, asked.settings)
    if isinstance(asked.near, Tilts):
        state = _with_failures(f, asked, state)
        fitting, q = f.near(asked.near)
        if serves(near := _from_near(fitting, state._replace(q=q)), asked.settings.serves):
            return Search(*with_given(fitting, near, near.spent + _for_given(asked)))
        state = near.carried()._replace(given=state.given)
        if not _long(asked):
            return Search(f, state)
    return _down_to_tilts(f, asked, state, state.spent + asked.settings.tilts_share * asked.budget)


def _more_tilts(asked, chance, state):
    """The `Search` for tilts of several Gaussians, with a part of what is left."""
    f = TiltFamily(asked.sim, asked.budget, chance, asked.settings, asked.settings.gates)
    share = asked.settings.tilts_after * (asked.budget - state.spent)
    return _down_to_tilts(f, asked, state, state.spent + share)


def _down_to_tilts(f, asked, state, end):
    s = asked.settings
    state = led_down(f, _with_failures(f, asked, state), end)
    if state.q is not None:
        state = adapted(f, state, asked.settings.refits, end)
        if f.gates == 1 and f.about.normals and state.promised < s.single_serves:
            f, before = f._replace(gates=s.gates), state.spent
            state = state._replace(q=f.refit(state)["refitted"])
            state = adapted(f, state, asked.settings.refits, before + s.gates_share * asked.budget)
            end += state.spent - before
    return Search(*with_given(f, state, end + _for_given(asked)))


def _with_failures(f, asked, state):
    """The state with the failures that came with the call."""
    if asked.failures is None or state.given is not None:
        return state
    return given(f, state, asked.failures.episodes)


def _for_given(asked):
    """Evaluations that they may cost."""
    return asked.settings.given_share * asked.budget


def _from_near(f, state):
    """The state after a batch of a similar system's proposal, and where it does not serve as it is
    after some refits.
    """
    state = adapted(f, state.noted("proposal of a similar system"), 1, math.inf)
    if not len(state.batches[-1].log_weight) or serves(state, f.settings.near_serves):
        return state
    return adapted(f, state, f.settings.near_refits, math.inf)


def _audited(search):
    """The `Search` after the audits of its proposal."""
    f, state = search
    return Search(f, audited(f, cooled(f, state) if isinstance(f, TiltFamily) else state))


def _drawn(asked, search, against):
    """The `Estimate` of what is left of the budget; ``against``: reasons from outside."""
    f, state = search
    name, key, sim = asked.name, asked.key, asked.sim
    n = max(asked.budget - state.spent, f.batch)  # a search of many parts may have spent all
    about = dict(level=asked.level, history=state.history)
    watch = Watch(name, n, "episode", *asked.watched)
    log_p = state.log_p
    often = math.exp(min(log_p, 0.0)) * n >= asked.settings.plain_failures
    if not search.enough and not often and log_p > -math.inf:
        reasons = [*against, *state.reasons] or [ASTRAY]
        found = fallback_estimate(key, sim, n, log_p, asked.level, reasons)
        if found is not None:
            spent, history = state.spent + found.episodes, (*state.history, *found.history)
            return found._replace(episodes=spent, history=history, plain=state.plain)
    if search.enough or search.worth and not often:
        s = asked.settings
        share = float(
            np.clip(1 - 1 / (s.exact**2 * state.promised * n), s.of_the_model, s.of_the_model_most)
        )
        about |= dict(spent=state.spent, plain=state.plain, drawn=state.plain[2], share=share)
        q = f.with_model(state.q, share)
        reasons = [*against, *state.reasons, *(() if search.enough else (ASTRAY,))]
        found = estimated(key, sim, q, f.batch, watch, asked.ways, reasons=reasons, **about)
        return found._replace(proposal=f.on_device(state.q))
    total, notes, lost = chunks(simulate_points, (key, sim, f.batch, n), f.batch, watch, asked.ways)
    spent, reasons = state.spent + total.samples, [*against, *lost]  # others are about the proposal
    about |= dict(evaluations=spent, proposal=_proposal(search))
    found = estimate_from_counts(name, total, notes=notes, reasons=reasons, **about)
    return found._replace(draws=with_source(found.draws, key, f.batch, "model"))


def _of_the_search(asked, search, against):
    """The `Estimate` of the batches of a search that was interrupted, by the balance heuristic."""
    state, rows = search.state, np.arange(search.state.size)
    failing = rows < len(state.log_weight)
    log_weights = np.full(len(rows), -np.inf)
    log_weights[failing] = state.log_weight
    none = np.zeros(len(rows))
    seen = Traces(log_weights, none[:, None], failing, none.astype(bool), none.astype(int))
    said = (
        f"interrupted after {state.spent} of {asked.budget} evaluations: the estimate uses the same"
        " episodes that chose the proposal"
    )
    return estimate_from_weights(
        asked.name,
        sums.add_traces(sums.empty_sums(len(rows)), seen),
        level=asked.level,
        reasons=[*against, said],
        evaluations=state.spent,
        proposal=_proposal(search),
        history=state.history,
        plain=state.plain,
    )


def _proposal(search):
    """What an `Estimate` keeps of a search."""
    f, state = search
    return None if state.q is None else f.on_device(state.q)
