"""Failure probabilities: importance resampling of failure traces and failure policies, and
estimators that find their own proposal.
"""

from jast._doors import dir_function
from jast.estimate.adaptive import adaptive_cross_entropy, failure_probability
from jast.estimate.answers import (
    Exceedance,
    FailureTimes,
    distance_quantile,
    exceedance,
    failure_times,
)
from jast.estimate.diagnostics import pareto_k
from jast.estimate.double_loop import double_loop
from jast.estimate.draws import Draws
from jast.estimate.estimate import Estimate
from jast.estimate.events import Event, GivenStart, events, given_start
from jast.estimate.failure_samples import FailureSamples, failure_samples
from jast.estimate.importance_sampling import Traces, importance, log_weights
from jast.estimate.multilevel import FailureProposal, failure_proposal
from jast.estimate.plain import monte_carlo
from jast.estimate.population import population
from jast.estimate.proposals import Proposal, policy_proposal, trace_proposal
from jast.estimate.sample import Sample
from jast.estimate.subset import subset_simulation
from jast.intervals import chernoff, clopper_pearson, delta_bound, jeffreys, normal

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
    "subset_simulation",
    "trace_proposal",
]

__dir__ = dir_function(__all__)
