"""One function on many systems that differ in a setting: `jast.sweep`."""

from jast._src.sweeping.crossing import Crossing
from jast._src.sweeping.sweep import sweep
from jast._src.sweeping.table import Sweep
from jast._src.util.doors import dir_function

__all__ = ["Crossing", "Sweep", "sweep"]

__dir__ = dir_function(__all__)
