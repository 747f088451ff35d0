"""How probable is a failure? `failure_probability` chooses a method by what an episode costs; the
others are single methods, and what more can be asked of an estimate.
"""

from jast._src.estimate.diagnostics import pareto_k
from jast._src.estimate.double_loop import double_loop
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.events import Event, GivenStart, events, given_start
from jast._src.estimate.exceedance_and_times import (
    Exceedance,
    FailureTimes,
    distance_quantile,
    exceedance,
    failure_times,
)
from jast._src.estimate.failure_probability import adaptive_cross_entropy, failure_probability
from jast._src.estimate.failure_samples import FailureSamples, failure_samples
from jast._src.estimate.importance_sampling import Traces, importance, log_weights
from jast._src.estimate.monte_carlo import monte_carlo
from jast._src.estimate.multilevel import FailureProposal, failure_proposal
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.population.population import population
from jast._src.estimate.proposals import Proposal, policy_proposal, trace_proposal
from jast._src.estimate.splitting.splitting import splitting
from jast._src.estimate.subset_simulation import subset_simulation
from jast._src.estimate.weighted_draws import Draws
from jast._src.util.doors import dir_function
from jast._src.util.intervals import chernoff, clopper_pearson, delta_bound, jeffreys, normal

__all__ = [
    "Draws",
    "Estimate",
    "Event",
    "Exceedance",
    "FailureProposal",
    "FailureSamples",
    "FailureTimes",
    "GivenStart",
    "Proposal",
    "Sample",
    "Traces",
    "adaptive_cross_entropy",
    "chernoff",
    "clopper_pearson",
    "delta_bound",
    "distance_quantile",
    "double_loop",
    "events",
    "exceedance",
    "failure_probability",
    "failure_proposal",
    "failure_samples",
    "failure_times",
    "given_start",
    "importance",
    "jeffreys",
    "log_weights",
    "monte_carlo",
    "normal",
    "pareto_k",
    "policy_proposal",
    "population",
    "splitting",
    "subset_simulation",
    "trace_proposal",
]

__dir__ = dir_function(__all__)
