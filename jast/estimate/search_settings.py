"""The numbers of the search for a proposal, with their reasons. ``python -m benchmarks.probability
--only coverage`` is what judges them.
"""

from typing import NamedTuple

__all__ = ["SETTINGS", "SearchSettings"]


class SearchSettings(NamedTuple):
    """Shares are of the budget where nothing else is said."""

    # batches
    gain: float = 1.15
    """Factor of effective draws by which a batch must gain on the best before it, to count as
    better: two batches of one proposal differ by less."""
    enough: float = 0.1
    """Effective draws of a draw with which one batch without gain ends the refits."""
    stalls: int = 2
    """Batches without gain that end the refits of a poor proposal, too."""
    refits: int = 8
    """Batches of a search at most: twice what most systems need."""
    refits_end: float = 0.6
    """Where the refits of Gaussians end, as a share of what their search began with."""
    batches_after_audit: int = 2
    """What an audit found is weighted by the first of them, and fitted to by the second."""
    kept: int = 1200
    """Failures that a batch keeps of long episodes, whose densities are the dear part."""

    # when a proposal serves
    serves: float = 0.02
    """Effective draws of a draw with which no other family is tried."""
    near_serves: float = 0.2
    """The same for one batch of a neighbour's proposal, which is then taken as it is."""
    near_fitted: float = 0.05
    """The same once it is fitted."""
    near_refits: int = 2
    """Batches that a neighbour's proposal is fitted to."""
    lost: float = 2.0
    """What a proposal has lost, as a multiple of what it found, from which it is given up."""

    # the audit
    audits: int = 3
    """Of them all but the last may take in what is missing; a third one hardly ever finds more."""
    tolerated: float = 0.01
    """Part of the probability that may be missing: about the standard error of the estimate."""
    covered: float = 50.0
    """Factor of its mean weight up to which a failure is covered."""
    thin: float = 0.06
    """Part of the probability, by the batches, that may lie where it is not covered."""
    met: int = 20
    """Draws that are to meet so great a part, wherever it is covered."""
    known: int = 10
    """Effective draws in the batches that know such a part well enough."""
    audit_share: float = 0.15
    """What a population of an audit is to cost."""
    ties: float = 1.5
    """Factor of that, as levels fall more slowly where miss distances are few."""
    fewest: int = 40
    """Points of a population of an audit: ten of them go on to the next level."""
    search_ends: float = 0.85
    """Where the search ends, audits included."""
    settling: float = 0.06
    """What the moves of failures that wide noise led to may cost."""
    moves: int = 25
    """Markov moves after which a failure of great norm lies among those of its mode, or on the way
    (walks of `benchmarks.limit_states`: 10 were too few)."""
    stray: float = 0.025
    """Part of these failures that may lie outside by chance."""
    few: int = 2
    """The same as a number."""
    unknown: float = 0.15
    """Share of a proposal for failures of unknown probability, until batches weigh them."""


SETTINGS = SearchSettings()
