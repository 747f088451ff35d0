"""Cross-entropy methods: minimise a function of a vector with few evaluations, by sampling; with
surrogates and mixtures.
"""

from jast._src.cross_entropy import schedules
from jast._src.cross_entropy.gaussian import Gaussian, normal
from jast._src.cross_entropy.methods import (
    Search,
    ask,
    ce_method,
    ce_mixture,
    ce_surrogate,
    finish,
    start,
    tell,
)
from jast._src.cross_entropy.mixture import Mixture
from jast._src.cross_entropy.objectives import ackley, branin, paraboloid, sierra
from jast._src.cross_entropy.result import CEResult, History, Scores, scores
from jast._src.cross_entropy.simulator_objective import Stress, over
from jast._src.util.doors import dir_function

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
