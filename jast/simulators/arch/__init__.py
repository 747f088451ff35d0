"""The falsification benchmarks of ARCH-COMP: models under requirements in temporal logic.

Inputs, and the F-16's attitude at the start, are uniform in their ranges, so that all episodes of a
length are equally likely and only failing counts; with a density of yours, also how likely a
failure is.
"""

from jast._doors import dir_function
from jast.simulators.arch.cars import Cars
from jast.simulators.arch.flights import fly, ground_collision_avoidance
from jast.simulators.arch.gcas import Flight
from jast.simulators.arch.models import automatic_transmission, chasing_cars, simulate
from jast.simulators.arch.specifications import SPECIFICATIONS
from jast.simulators.arch.transmission import Transmission

__all__ = [
    "Cars",
    "Flight",
    "SPECIFICATIONS",
    "Transmission",
    "automatic_transmission",
    "chasing_cars",
    "fly",
    "ground_collision_avoidance",
    "simulate",
]
__dir__ = dir_function(__all__)
