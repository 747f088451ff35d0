"""One function on many systems that differ in a setting: `jast.sweep`."""

from jast._doors import dir_function
from jast.sweeping.run import sweep
from jast.sweeping.table import Crossing, Sweep

__all__ = ["Crossing", "Sweep", "sweep"]

__dir__ = dir_function(__all__)
