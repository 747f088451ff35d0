"""One function on many systems that differ in a setting: `jast.sweep`."""

from jast._doors import listed
from jast.sweeping.run import sweep
from jast.sweeping.table import Crossing, Sweep

__all__ = ["Crossing", "Sweep", "sweep"]

__dir__ = listed(__all__)
