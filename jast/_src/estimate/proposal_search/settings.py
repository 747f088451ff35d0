"""The numbers of the search for a proposal, each with its reason. What halving or doubling one does
on problems that are drawn by seed: ``python -m benchmarks.search_settings``.
"""

from typing import NamedTuple

from jast._src.estimate import diagnostics

__all__ = ["FEW_RUNS", "SETTINGS", "SearchSettings"]


class SearchSettings(NamedTuple):
    """Shares are of the budget where nothing else is said."""

    # which family is tried
    moments_budget: int = 10_000
    """Evaluations up to which half-spaces of the moments of an episode are tried first: with twice
    as many the other searches answer the lane of the README, within 3 %."""
    moments_alone_budget: int = 5000
    """Evaluations left below which only populations are tried then: the other searches spend as
    much as 10 % more than so few."""
    moments_numbers: int = 21
    """Numbers of an episode from which they do: with fewer a surrogate serves."""
    tilts_first_horizon: int = 30
    """Steps from which tilts are tried before Gaussians: Gaussians of many steps are dear, and miss
    what happens at any of them."""
    tilts_share: float = 0.35
    """What the search for tilts may spend where they come first."""
    tilts_share_after: float = 0.3
    """The same of what is left, where Gaussians come first."""
    components_each: int = 3
    """Gaussians in the mixture that a tilt draws a normal number from: the model's, one above and
    one below."""
    components_share: float = 0.25
    """What the search for these mixtures may spend where a single Gaussian is not enough."""
    single_efficiency: float = 0.1
    """Effective draws of a draw with which a single one is enough."""
    family_efficiency: float = 0.02
    """Effective draws of a draw with which no other family is tried."""
    next_family_share: float = 0.2
    """What must be left for another family to be tried."""
    near_efficiency: float = 0.2
    """Effective draws of a draw with which a neighbour's proposal is taken as it is."""
    near_fitted_efficiency: float = 0.05
    """The same once it is fitted."""
    near_refits: int = 2
    """Batches that a neighbour's proposal is fitted to."""
    given_share: float = 0.175
    """What failures that came with the call may cost the search for tilts more."""

    # the first Gaussians
    evaluations_per_descent: int = 2000
    """Evaluations of a budget for each descent by gradients."""
    descents_most: int = 48
    """Descents of a round at most, and directions that sixty modes still need."""
    descents_least: int = 4
    """Descents of a round at the least."""
    descents_first: int = 12
    """Descents after which no others are tried where these led nowhere."""
    wide_draws_first: int = 4
    """Draws of wider noise for each descent that begins at a failure, in the first round."""
    wide_draws: int = 12
    """The same in later rounds, where fewer are unexplained."""
    exploration_end: float = 0.2
    """Evaluations at which descents end, and cooling."""
    cooling_end: float = 0.3
    """Evaluations at which cooling ends once it has `cooled_least` failures."""
    cooled_least: int = 36
    """Failures that wide noise is cooled to at the least: they show a direction that one in ten of
    them has."""
    evaluations_per_chain: int = 800
    """Evaluations of a budget for each chain of cooled noise."""
    chains_least: int = 8
    """Chains at the least."""
    chains_most: int = 128
    """Chains at most, and directions of a proposal."""
    chains_most_of_tilts: int = 24
    """The same of tilts, which find most modes by themselves."""
    reduction_tries: int = 18
    """Times that a failure is tried without some of its numbers."""
    singleton_share: float = 0.03
    """Share of failures that are the only one of their direction, with which the search for
    directions ends: the part of what chains lead to that is still to be found (Good 1953)."""
    singleton_count: int = 3
    """The same as a number."""
    singleton_share_most: float = 0.5
    """Share above which it ends too, as more chains would not change it."""
    unexplained_ratio: float = 0.85
    """Factor by which a round of descents must reduce the share of unexplained failures."""
    new_point_share: float = 0.25
    """Share of its descents that must come to new points."""
    anchor_weight_least: float = 0.05
    """Weight of a design point far beyond the nearest, which may lead to more."""

    # fits
    gain: float = 1.15
    """Factor of effective draws by which a batch must gain on the best before it, to count as
    better: two batches of one proposal differ by less."""
    refit_efficiency: float = 0.1
    """Effective draws of a draw with which one batch without gain ends the refits."""
    stalls: int = 2
    """Batches without gain that end the refits of an inefficient proposal."""
    refits: int = 8
    """Batches of a search at most: twice what most systems need."""
    refits_end: float = 0.6
    """What the refits of Gaussians may spend of what was left when their search began."""
    failures_kept: int = 1200
    """Failures that a batch of tilts keeps: the densities of whole traces are the dear part."""
    model_share: float = 0.1
    """Share of the model in a proposal where failures are not rare, and among tilts."""
    defensive_share: float = 0.2
    """Share of wide components, under which no weight is without variance."""
    defensive_scale: float = 0.75
    """Factor on the coefficients of a tilt in its defensive copy."""
    kept_choices: float = 0.5
    """Choices of an episode, in the mean, that a tilt leaves as the model has them, so that one odd
    choice costs no weight of hundreds. Root mean square errors without and with it, by ``python -m
    benchmarks.probability --only cases --cases "coin and run" components ruin --seeds 10 --budget
    20000``: 2.57, 1.16 %; 1.00, 0.88 %; 0.71, 0.61 %. A whole choice costs a sum of dice, all of
    which matter, 40 % of its standard error; a half 15 %."""
    kept_share_most: float = 0.2
    """Of each choice, at most."""
    rare_probability: float = 1e-4
    """Probability below which a proposal of Gaussians needs no share of the model."""
    variance_least: float = 0.3
    """Least variance, the model's being 1, of what an audit takes in."""
    direction_share_least: float = 0.05
    """Least share of a direction, and the part of an even share from which a component counts as
    one: few failures mostly underestimate a share."""
    directions_share_least: float = 0.2
    """Share of all directions together at the least."""
    group_share_least: float = 0.1
    """Share of a group of tilts at the least."""
    direction_failures: int = 20
    """Failures from which a direction has a fit of its own."""
    dense_directions: int = 16
    """Directions above which each has too few failures for a covariance of all numbers."""
    sparse_numbers: int = 4
    """Numbers, at most, that a direction is fitted in where there are many."""
    variance_prior: float = 3.0
    """Failures that the model's variance counts for in such a fit."""
    share_prior: float = 5.0
    """Failures that each direction counts for in its share."""
    tempered_size: int = 200
    """Effective failures of a fit, to which weights are tempered: a fit to a few great ones
    would be a fit to their noise."""

    # tilts
    elite_share: float = 0.1
    """Share of a batch that reaches the next level."""
    elite_least: int = 10
    """Episodes below the last level, of fewer than which no level is made."""
    level_failures: int = 50
    """Failures of a batch from which tilts are fitted to failures alone."""
    raised_choices: float = 2.0
    """Rare choices an episode that the first batch has."""
    raised_probability_most: float = 0.25
    """Probability of a rare choice there at most."""
    given_replay_share: float = 0.05
    """How many of the failures that came with the call are replayed."""
    given_tilts: int = 2
    """How many of those that the tilts hardly draw get a tilt of their own."""

    # the audit
    audits: int = 3
    """Audits at most; all but the last may absorb what is missing."""
    audit_refits: int = 2
    """What an audit found is weighted by the first batch, and fitted to by the second."""
    tolerated_mass: float = 0.01
    """Part of the probability that may be missing: about the standard error of the estimate."""
    coverage_factor: float = 50.0
    """Factor on the mean weight up to which a failure is covered."""
    uncovered_share: float = 0.06
    """Part of the probability, by the batches, that may be uncovered."""
    coverage_draws: int = 20
    """Draws that a part of that share must have met to count as covered."""
    uncovered_ess: int = 10
    """Effective draws of the batches with which an uncovered part is known well enough."""
    promise_ess: int = 8
    """Effective draws of the batches with which an efficiency is. On ``energy`` with 2000 and 5000
    evaluations (`benchmarks.few_calls`, 12 calls each), where half-spaces promise ten to a hundred
    effective draws of what is left and keep one to nine, batches had 6 at most; on the plane of 100
    numbers with 300, where they keep what they promise, 11 to 16."""
    audit_share: float = 0.15
    """What a population of an audit is to cost."""
    wide_audit: int = 0
    """Draws of wide noise before half-spaces are fitted, and in place of a population that the
    budget does not afford: of 40 one fails with a chance of .94 in a mode that has a tenth of a
    probability of 2e-4, .97 of 1e-8."""
    walk_share: float = 0.08
    """Share of the budget that is walks from wide noise to failures where a system has fewer than
    `moments_numbers`. Of 30 keys of ``islands`` (`benchmarks.probability`, 10,000 evaluations) 2 of
    22 believed answers are then more than 4 standard errors off; with .04 and 25 moves 4 of 23,
    with .04 and no moves 7 of 21."""
    walks_most: int = 100
    """Such walks at most: of 30 keys with 40,000 evaluations, which are 78, none is missed."""
    walk_moves: int = 40
    """Moves of such a walk."""
    audit_overrun: float = 1.5
    """Factor on that, as levels fall more slowly where miss distances take few values."""
    audit_population_least: int = 40
    """Points of a population of an audit at the least: ten of them reach the next level."""
    search_end: float = 0.85
    """Evaluations at which the search ends, audits included."""
    burn_in_share: float = 0.06
    """What the burn-in of failures that wide noise led to may cost."""
    burn_in_moves: int = 25
    """Markov moves after which a failure of great norm lies among those of its mode, or on the way
    (walks of `benchmarks.limit_states`: 10 were too few)."""
    stray_share: float = 0.025
    """Share of these failures that may be uncovered by chance."""
    stray_count: int = 2
    """The same as a number."""
    absorbed_share_least: float = 0.15
    """Share of the proposal for what an audit found, at the least, until batches weigh it."""
    missing_most: float = 2.0
    """Missing probability, as a multiple of what was found, above which a proposal is given up."""

    # the last draws
    min_ess: int = diagnostics.MIN_ESS
    """Effective draws that an estimate must have."""
    plain_failures: int = 100
    """Failures of the model from which plain draws tell a probability where no proposal does."""
    exact_error: float = 0.01
    """Relative standard error that the proposal's draws are to reach; others are the model's."""
    model_draws_least: float = 0.1
    """Share of the last draws that are the model's own, at the least."""
    model_draws_most: float = 0.4
    """The same at most."""


SETTINGS = SearchSettings()
FEW_RUNS = SETTINGS._replace(
    exploration_end=0.35,
    audits=2,
    audit_share=0.45,
    audit_population_least=20,
    wide_audit=40,
    burn_in_share=0.25,
    stray_count=0,
    tolerated_mass=0.1,
    min_ess=diagnostics.MIN_MODE_ESS,
    plain_failures=20,
)
"""Where half-spaces of moments are the proposal: a population that few runs afford finds modes that
matter, and none of a hundredth of the probability. So few effective draws are a standard error of
18 %: with 5000 evaluations and more `flag_imprecise` asks for 5 %. Of 20 expected failures of plain
draws fewer come than are believed, `estimate.MIN_COUNTED_FAILURES`, once in 200 times."""
