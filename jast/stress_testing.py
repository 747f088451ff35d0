"""The front door: one call that looks for the likeliest failure with all that jast has."""

from jast._src.stress_testing.report import Report, Tried
from jast._src.stress_testing.stress import stress
from jast._src.util.doors import dir_function

__all__ = ["Report", "Tried", "stress"]

__dir__ = dir_function(__all__)
