"""Cross-entropy methods: minimise a function of a vector with few evaluations, by sampling; with
surrogates and mixtures.
"""

from jast._doors import dir_function
from jast.cross_entropy import schedules
from jast.cross_entropy.gaussian import Gaussian, normal
from jast.cross_entropy.methods import (
    Search,
    ask,
    ce_method,
    ce_mixture,
    ce_surrogate,
    finish,
    start,
    tell,
)
from jast.cross_entropy.mixture import Mixture
from jast.cross_entropy.objectives import ackley, branin, paraboloid, sierra
from jast.cross_entropy.result import CEResult, History, Scores, scores
from jast.cross_entropy.stress import Stress, over

__all__ = [
    "CEResult",
    "Gaussian",
    "History",
    "Mixture",
    "Scores",
    "Search",
    "Stress",
    "ackley",
    "ask",
    "branin",
    "ce_method",
    "ce_mixture",
    "ce_surrogate",
    "finish",
    "normal",
    "over",
    "paraboloid",
    "schedules",
    "scores",
    "sierra",
    "start",
    "tell",
]

__dir__ = dir_function(__all__)
