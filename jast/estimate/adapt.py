"""Proposals that are fitted to what they have drawn, by cross-entropy, for as long as they get
better (de Boer, Kroese, Mannor and Rubinstein 2005).
"""

from __future__ import annotations

from jast.estimate.gaussians import effective
from jast.estimate.search_state import Family, State, log_ratios, promise, taken

__all__ = ["adapted", "refitted"]


def adapted(family: Family, state: State, times: int, end: float) -> State:
    """The state after at most ``times`` batches, each of a proposal that is fitted to all before
    it, for as long as they get better and until ``end`` evaluations are spent.
    """
    best, stalls, q = 0.0, 0, state.q
    for _ in range(times):
        if state.spent + family.batch > end:
            break
        batch = family.draw(q)
        if not len(batch.log_weight):
            return taken(family, state, batch).noted(f"{family.name}: no failure", family.batch)
        share, ess = len(batch.log_weight) / batch.size, effective(batch.log_weight)
        state = taken(family, state, batch)
        state, q, name = refitted(family, state)
        state = state.noted(
            f"{family.name}: {share:.1%} fail, ESS {ess:.4g}; of all: log p {state.log_mean:.3f},"
            f" ESS {effective(state.log_weight):.4g}; next: {name}",
            family.batch,
        )
        own = ess / batch.size  # of long episodes a batch keeps some alone
        stalls = 0 if own > family.settings.gain * best else stalls + 1
        enough = own > family.settings.enough
        if stalls and (enough or stalls == family.settings.stalls):
            break
        best = max(own, best)
    return state


def refitted(family: Family, state: State) -> tuple[State, object, str]:
    """The state with the proposal that promises the least variance by the failures of all batches:
    the one that it has, or one of those that the family fits to them; that proposal, and its name.
    """
    choices = {"as it was": state.q, **family.refit(state)}
    promises = {
        name: promise(state, log_ratios(family, q, state.batches)) for name, q in choices.items()
    }
    name = max(promises, key=promises.get)
    return state._replace(q=choices[name]), choices[name], name
