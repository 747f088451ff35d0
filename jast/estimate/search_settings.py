"""The numbers of the search for a proposal, each with its reason. What halving or doubling one does
on problems that are drawn by seed: ``python -m benchmarks.search_settings``.
"""

from typing import NamedTuple

__all__ = ["SETTINGS", "SearchSettings"]


class SearchSettings(NamedTuple):
    """Shares are of the budget where nothing else is said."""

    # which family is tried
    tilts_first: int = 30
    """Steps from which tilts are tried before Gaussians: Gaussians of many steps are dear, and miss
    what happens at any of them."""
    tilts_share: float = 0.35
    """What the search for tilts has where they come first."""
    tilts_after: float = 0.3
    """What it has of what is left where Gaussians come first."""
    gates: int = 3
    """Gaussians that a normal number is drawn from one of: nothing happens, or it comes from above
    or below."""
    gates_share: float = 0.25
    """What the search for them has where a single one does not serve."""
    single_serves: float = 0.1
    """Effective draws of a draw with which a single one serves."""
    serves: float = 0.02
    """Effective draws of a draw with which no other family is tried."""
    another: float = 0.2
    """What must be left where another family is tried."""
    near_serves: float = 0.2
    """The same for one batch of a neighbour's proposal, which is then taken as it is."""
    near_fitted: float = 0.05
    """The same once it is fitted."""
    near_refits: int = 2
    """Batches that a neighbour's proposal is fitted to."""
    given_share: float = 0.175
    """What failures that came with the call may cost the search for tilts more."""

    # the first Gaussians
    descent_of: int = 2000
    """Evaluations of a budget for each descent by gradients."""
    descents: int = 48
    """Descents of a round at most, and directions that sixty modes still need."""
    descents_least: int = 4
    """Descents of a round at the least."""
    descents_tried: int = 12
    """Descents after which no others are tried where these led nowhere."""
    wide_first: int = 4
    """Draws of wider noise for each descent that begins at a failure, in the first round."""
    wide: int = 12
    """The same in later rounds, where fewer are unexplained."""
    cooled_share: float = 0.2
    """Where descents end, and cooling."""
    cooled_late: float = 0.3
    """Where cooling looks for no more than `cooled_least` failures."""
    cooled_least: int = 36
    """Failures that wide noise is cooled to at the least: one direction in ten is then met."""
    chain_of: int = 800
    """Evaluations of a budget for each chain of cooled noise."""
    chains_least: int = 8
    """Chains at the least."""
    chains: int = 128
    """Chains at most, and directions of a proposal."""
    chains_of_tilts: int = 24
    """The same of tilts, which lead to most modes by themselves."""
    rests: int = 18
    """Times that a failure is tried without some of its numbers."""
    alone: float = 0.03
    """Part of the failures alone in a direction with which the search for directions ends."""
    alone_met: int = 3
    """The same as a number."""
    endless: float = 0.5
    """Part of them above which it ends too, as more chains would not change it."""
    slow: float = 0.85
    """What a round of descents may leave unexplained of what was before it."""
    new: float = 0.25
    """Part of its descents that come to new points."""
    anchor_least: float = 0.05
    """Weight of a design point far beyond the nearest, which may lead to more."""

    # fits
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
    kept: int = 1200
    """Failures that a batch of tilts keeps: the densities of whole traces are the dear part."""
    model: float = 0.1
    """Share of the model in a proposal where failures are not rare, and among tilts."""
    defensive: float = 0.2
    """Share of wide components, under which no weight is without variance."""
    halfway: float = 0.75
    """Of the way of a tilt, how far its defensive copy goes."""
    rare: float = 1e-4
    """Probability below which a proposal of Gaussians needs no share of the model."""
    narrowest: float = 0.3
    """Of the model's, the least variance of what an audit takes in."""
    direction_least: float = 0.05
    """Share of a direction at the least, and the part of an even share from which a component is
    one: what few failures tell of a mass is mostly too little."""
    directions_least: float = 0.2
    """Share of all directions together at the least."""
    group_least: float = 0.1
    """Share of a group of tilts at the least."""
    direction_failures: int = 20
    """Failures from which a direction is fitted by itself."""
    dense: int = 16
    """Directions above which each has too few failures for a covariance of all numbers."""
    sparse: int = 4
    """Numbers, at most, that a direction of many is fitted in."""
    prior: float = 3.0
    """Failures that the model's variance counts for in such a fit."""
    prior_share: float = 5.0
    """Failures that each direction counts for in its share."""
    tempered: int = 200
    """Effective failures of a fit, to which weights are tempered: a few great ones would fit their
    own noise."""

    # tilts
    elite: float = 0.1
    """Share of a batch that comes to the next level."""
    elite_least: int = 10
    """Episodes below the last level, of fewer than which no level is made."""
    failures: int = 50
    """Failures of a batch from which tilts are fitted to failures alone."""
    raised: float = 2.0
    """Rare choices an episode that the first batch has."""
    raised_most: float = 0.25
    """Probability of a rare choice there at most."""
    given: float = 0.05
    """How many of the failures that came with the call are looked at."""
    places: int = 2
    """How many of those that the tilts hardly draw get a tilt of their own."""

    # the audit
    audits: int = 3
    """Of them all but the last may take in what is missing."""
    refits_of_audit: int = 2
    """What an audit found is weighted by the first batch, and fitted to by the second."""
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
    stray_least: int = 2
    """The same as a number."""
    unknown: float = 0.15
    """Share of a proposal for what an audit found, at the least, until batches weigh it."""
    lost: float = 2.0
    """What a proposal has lost, as a multiple of what it found, from which it is given up."""

    # the last draws
    plain_failures: int = 100
    """Failures of the model from which plain draws tell a probability where no proposal does."""
    exact: float = 0.01
    """Relative standard error beyond which draws serve better as the model's own."""
    of_the_model: float = 0.1
    """Share of the last draws that are the model's own, at the least."""
    of_the_model_most: float = 0.4
    """The same at most."""


SETTINGS = SearchSettings()
