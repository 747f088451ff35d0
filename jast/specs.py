"""Specifications: requirements as signal temporal logic, their robustness on a trace, which part
broke and when, and simulators whose failure is the violation.
"""

from jast._src.specs.formulas import Formula, always, eventually, implies, predicate, until
from jast._src.specs.parts import Part, Parts, parts
from jast._src.specs.robustness import robustness
from jast._src.specs.simulator import Monitored, goes_on, trace_of, under
from jast._src.util.doors import dir_function

__all__ = [
    "Formula",
    "Monitored",
    "Part",
    "Parts",
    "always",
    "eventually",
    "goes_on",
    "implies",
    "parts",
    "predicate",
    "robustness",
    "trace_of",
    "under",
    "until",
]
__dir__ = dir_function(__all__)
