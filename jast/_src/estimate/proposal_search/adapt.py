"""Proposals that are fitted to what they have drawn, by cross-entropy, for as long as they get
better (de Boer, Kroese, Mannor and Rubinstein 2005).
"""

from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.proposal_search.search_state import (
    Family,
    Scored,
    SearchState,
    add_batch,
    efficiency,
    failure_log_ratios,
)

__all__ = ["adapt_proposal", "refit"]


def adapt_proposal(family: Family, state: SearchState, times: int, end: float) -> SearchState:
    """The state after at most ``times`` batches, each of a proposal that is fitted to all before
    it, for as long as they get better and until ``end`` evaluations are spent.
    """
    best, stalls = 0.0, 0
    for _ in range(times):
        if state.spent + family.batch > end:
            break
        batch = family.draw(state.q)
        state = add_batch(family, state, batch)
        if not len(batch.log_weight):
            return state.note(f"{family.name}: no failure", family.batch)
        ess = effective_sample_size(batch.log_weight)
        state, name = refit(family, state)
        state = state.note(
            f"{family.name}: {len(batch.log_weight) / batch.size:.1%} fail, ESS {ess:.4g}; of all:"
            f" log p {state.log_mean:.3f}, ESS {effective_sample_size(state.log_weight):.4g};"
            f" next: {name}",
            family.batch,
        )
        own = ess / batch.size
        stalls = 0 if own > family.settings.gain * best else stalls + 1
        efficient = own > family.settings.refit_efficiency
        if stalls and (efficient or stalls == family.settings.stalls):
            break
        best = max(own, best)
    return state


def refit(family: Family, state: SearchState) -> tuple[SearchState, str]:
    """The state with the most efficient proposal by the failures of all batches: the one that it
    has, or one of those that the family fits to them; and the name of that proposal.
    """
    choices = {"as it was": state.q, **family.refit(state)}
    scored = {name: Scored(q, failure_log_ratios(family, state, q)) for name, q in choices.items()}
    name = max(scored, key=lambda name: efficiency(state, scored[name].log_ratio))
    return state._replace(q=choices[name], scored=(*state.scored, scored[name])), name
