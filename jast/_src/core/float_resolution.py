"""Whether the floats of a state are fine enough for what a disturbance does to it.

A position of 4.6e6 m in float32 moves in steps of half a metre: what pushes it by five is rounded,
at every step, and so is the probability of where it ends.
"""

import numpy as np

from jast._src.core.probe import Resolution, probe
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.runtime.host_errors import runs_on_host

__all__ = ["describe", "rounding_problem"]

COARSE_UNITS = 32.0  # of the last place: a disturbance that moves a number by fewer is rounded
COARSE_SHARE = 0.02  # of what the disturbances do to the miss distance: rounding of more matters
# A random walk whose steps have a standard deviation of 10 units is off by 1 % at 4.5 of them.


def rounding_problem(sim: Simulator) -> str | None:
    """A text that says so where the dtype of the state rounds what the disturbances do; None where
    it does not, and for a system on the host. Runs 81 episodes at most.
    """
    if runs_on_host(sim):
        return None
    return describe(sim, probe(sim).resolution)


def describe(sim: Simulator, found: Resolution) -> str | None:
    """`rounding_problem` by what a `probe` found."""
    if all(found.unmoved):
        if signature_of(sim).random_start or not found.differ:
            return None  # a system whose random start decides everything is as it is meant
        return (
            "no disturbance changes a number of the state: step does not use its second argument,"
            " or the state is too coarse for it; take large offsets out of the state, or use"
            " float64"
        )
    least = min((np.nanmin(a, initial=np.inf) for a in found.units), default=np.inf)
    if not least < COARSE_UNITS or not found.rounding > COARSE_SHARE * found.spread:
        return None
    return (
        "the state is too coarse: a disturbance changes one of its numbers by only"
        f" {least:.2g} units in the last place, and rounding changes the miss distance by"
        f" {found.rounding / found.spread:.0%} as much as the disturbances do; take large offsets"
        " out of the state, or use float64"
    )
