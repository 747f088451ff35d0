"""Failure probabilities: importance resampling of failure traces and failure policies, and
estimators that find their own proposal.
"""

from jast.estimate.adaptive import (
    adaptive_cross_entropy,
    failure_probability,
    monte_carlo,
    subset_simulation,
)
from jast.estimate.diagnostics import pareto_k
from jast.estimate.estimate import Estimate
from jast.estimate.failures import FailureSamples, failure_samples
from jast.estimate.importance import Traces, importance, log_weights
from jast.estimate.intervals import chernoff, clopper_pearson, jeffreys
from jast.estimate.proposals import Proposal, policy_proposal, trace_proposal

__all__ = [
    "Estimate",
    "FailureSamples",
    "Proposal",
    "Traces",
    "adaptive_cross_entropy",
    "chernoff",
    "clopper_pearson",
    "failure_probability",
    "failure_samples",
    "importance",
    "jeffreys",
    "log_weights",
    "monte_carlo",
    "pareto_k",
    "policy_proposal",
    "subset_simulation",
    "trace_proposal",
]
