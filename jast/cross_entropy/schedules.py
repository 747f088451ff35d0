"""Evaluation schedules: how many samples each iteration gets of a budget."""

from jast._src.cross_entropy.schedules import (
    counts,
    geometric,
    manual,
    uniform,
)
from jast._src.util.doors import dir_function

__all__ = [
    "counts",
    "geometric",
    "manual",
    "uniform",
]
__dir__ = dir_function(__all__)
