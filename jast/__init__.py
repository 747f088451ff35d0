"""jast: find the likeliest failures of a simulated system, explain them, and put an honest
probability on them.
"""

from jast._doors import dir_function, door
from jast.contract import check
from jast.crude import nominal
from jast.episode import Episode, replay, rollout
from jast.files import load, save
from jast.policy import Policy
from jast.simulator import Simulator

__version__ = "0.2.0"

__all__ = [
    "Episode",
    "Policy",
    "Simulator",
    "actions",
    "adapters",
    "blackbox",
    "cache",
    "check",
    "cross_entropy",
    "distributions",
    "estimate",
    "explain",
    "failures",
    "heads",
    "incidents",
    "load",
    "nominal",
    "plot",
    "policies",
    "replay",
    "rewards",
    "rollout",
    "save",
    "search",
    "simulators",
    "specs",
    "stress",
    "sweep",
    "typing",
    "weakness",
]

# a room is loaded when it is first entered: importing jast costs little more than importing jax
_ROOMS = [name for name in __all__ if name not in globals()]
_CALLS = {
    "cache": "jast.compilation_cache:cache",
    "stress": "jast.stress_testing:stress",
    "sweep": "jast.sweeping:sweep",
}
__getattr__ = door(__name__, lazy={room: f"jast.{room}" for room in _ROOMS} | _CALLS)
__dir__ = dir_function(__all__)
