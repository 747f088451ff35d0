"""jast: find the likeliest failures of a simulated system, explain them, and put an honest
probability on them.
"""

from typing import TYPE_CHECKING

from jast._src.util.doors import dir_function, door

if TYPE_CHECKING:  # what `__getattr__` hands out, for editors and type checkers
    from jast import (
        actions,
        adapters,
        blackbox,
        cross_entropy,
        distributions,
        estimate,
        explain,
        failures,
        heads,
        incidents,
        plot,
        policies,
        rewards,
        search,
        simulators,
        specs,
        typing,
        weakness,
    )
    from jast._src.core.check import check
    from jast._src.core.episode import Episode, replay, rollout
    from jast._src.core.nominal import nominal
    from jast._src.core.policy import Policy
    from jast._src.core.simulator import Simulator
    from jast._src.io.save_load import load, save
    from jast._src.runtime.compilation_cache import cache
    from jast._src.stress_testing.stress import stress
    from jast._src.sweeping.sweep import sweep

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

# nothing is loaded before it is first asked for: importing jast alone does not import jax
_THINGS = {
    "Episode": "core.episode",
    "Policy": "core.policy",
    "Simulator": "core.simulator",
    "cache": "runtime.compilation_cache",
    "check": "core.check",
    "load": "io.save_load",
    "nominal": "core.nominal",
    "replay": "core.episode",
    "rollout": "core.episode",
    "save": "io.save_load",
    "stress": "stress_testing.stress",
    "sweep": "sweeping.sweep",
}
_PLACES = {name: f"jast._src.{module}:{name}" for name, module in _THINGS.items()}
_ROOMS = {name: f"jast.{name}" for name in __all__ if name not in _THINGS}
__getattr__ = door(__name__, lazy=_PLACES | _ROOMS)
__dir__ = dir_function(__all__)
