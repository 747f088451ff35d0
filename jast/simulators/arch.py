"""The falsification benchmarks of ARCH-COMP: models under requirements in temporal logic.

Inputs, and the F-16's attitude at the start, are uniform in their ranges, so that all episodes of a
length are equally likely and only failing counts; with a density of yours, also how likely a
failure is.
"""

from jast._src.simulators.arch.cars import Cars
from jast._src.simulators.arch.flights import fly, ground_collision_avoidance
from jast._src.simulators.arch.gcas import Flight
from jast._src.simulators.arch.models import automatic_transmission, chasing_cars, simulate
from jast._src.simulators.arch.specifications import SPECIFICATIONS
from jast._src.simulators.arch.transmission import Transmission
from jast._src.util.doors import dir_function

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
