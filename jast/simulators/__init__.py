"""Simulated systems with a source and a known truth, one file (or folder) each; `draw` is
a picture of a state of some of them."""

from jast.simulators import arch
from jast.simulators.autoregression import autoregression
from jast.simulators.bluesky import bluesky, bluesky_flight
from jast.simulators.colav import colav
from jast.simulators.drawings import draw
from jast.simulators.ferry import ferry
from jast.simulators.fms import fms, fms_misses, fms_path
from jast.simulators.landing import landing, landing_probability
from jast.simulators.limit_state import limit_state
from jast.simulators.pendulum import pendulum
from jast.simulators.ruin import ruin, ruin_probability
from jast.simulators.walk import walk1d

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
