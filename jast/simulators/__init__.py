"""Simulated systems with a source and a known truth, one file (or folder) each; `draw` is
a picture of a state of some of them."""

from jast._src.simulators.autoregression import autoregression
from jast._src.simulators.bluesky import bluesky, bluesky_flight
from jast._src.simulators.ferry import ferry
from jast._src.simulators.landing import landing, landing_probability
from jast._src.simulators.limit_state import limit_state
from jast._src.simulators.pendulum import pendulum
from jast._src.simulators.ruin import ruin, ruin_probability
from jast._src.simulators.svg_states import draw
from jast._src.simulators.walk import walk1d
from jast.simulators import arch
from jast.simulators.colav import colav
from jast.simulators.fms import fms, fms_misses, fms_path

__all__ = [
    "arch",
    "autoregression",
    "bluesky",
    "bluesky_flight",
    "colav",
    "draw",
    "ferry",
    "fms",
    "fms_misses",
    "fms_path",
    "landing",
    "landing_probability",
    "limit_state",
    "pendulum",
    "ruin",
    "ruin_probability",
    "walk1d",
]
