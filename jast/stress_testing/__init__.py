"""The front door: one call that looks for the likeliest failure with all that jast has."""

from jast._doors import dir_function
from jast.stress_testing.portfolio import stress
from jast.stress_testing.report import Report, Tried

__all__ = ["Report", "Tried", "stress"]

__dir__ = dir_function(__all__)
