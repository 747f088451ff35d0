"""Failure probabilities: importance resampling of failure traces and failure policies, and estimators that find their own proposal."""

from jast.estimate.diagnostics import pareto_k
from jast.estimate.estimate import Estimate
from jast.estimate.importance import Traces, importance, log_weights
from jast.estimate.intervals import chernoff, clopper_pearson, jeffreys
from jast.estimate.proposals import Proposal, policy_proposal, trace_proposal

__all__ = [
    "Estimate", "Proposal", "Traces", "chernoff", "clopper_pearson", "importance", "jeffreys", "log_weights", "pareto_k", "policy_proposal", "trace_proposal",
]  # fmt: skip
