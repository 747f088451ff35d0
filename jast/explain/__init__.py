"""Why did it fail? Pure calls of a simulator and an episode, for black boxes, too."""

from jast._doors import dir_function
from jast.explain.attribution import Attribution, attribution
from jast.explain.cards import cards
from jast.explain.criticality import Criticality, criticality
from jast.explain.differential import differential, regression
from jast.explain.eigenfailures import Eigenfailures, eigenfailures
from jast.explain.indices import Index, Indices, indices
from jast.explain.minimal import Minimal, minimal
from jast.explain.monitor import Monitor, monitor
from jast.explain.rules import Rules, rules
from jast.explain.sensitivity import Sensitivity, sensitivity
from jast.explain.trees import Rule

__all__ = [
    "Attribution",
    "Criticality",
    "Eigenfailures",
    "Index",
    "Indices",
    "Minimal",
    "Monitor",
    "Rule",
    "Rules",
    "Sensitivity",
    "attribution",
    "cards",
    "criticality",
    "differential",
    "eigenfailures",
    "indices",
    "minimal",
    "monitor",
    "regression",
    "rules",
    "sensitivity",
]
__dir__ = dir_function(__all__)
