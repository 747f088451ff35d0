"""Why did it fail? Pure calls of a simulator and an episode, for black boxes, too."""

from jast._src.explain.attribution import Attribution, attribution
from jast._src.explain.cards import cards
from jast._src.explain.criticality import Criticality, criticality
from jast._src.explain.decision_tree import Rule
from jast._src.explain.differential import differential, regression
from jast._src.explain.eigenfailures import Eigenfailures, eigenfailures
from jast._src.explain.indices import Index, Indices, indices
from jast._src.explain.minimal import Minimal, minimal
from jast._src.explain.monitor import Monitor, monitor
from jast._src.explain.rules import Rules, rules
from jast._src.explain.sensitivity import Sensitivity, sensitivity
from jast._src.util.doors import dir_function

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
