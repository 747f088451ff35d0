"""An open stand-in for the trajectory predictor of a flight management system, with an injected
defect: chapter 3 of Moss's thesis.

The predictor of the thesis is proprietary. This one has its interface, its disturbances (eq. 3.5)
and its failure events (eq. 3.3, 3.4, A.1 to A.3), and a defect of our own making of a kind that
real products have had: where two waypoints nearly coincide, turns are not fitted to the leg between
them. No number of the thesis is a number of this system.

Measured (float64, WGS84, defaults): of 400,000 routes 1.29e-3 +- .06e-3 fail, every one because the
defect acted; the miss distance is 407 +- 73 (mean and standard deviation), of failures -844 +- 104,
of the others at least 237. With ``fixed=True`` none of 50,000 fails, with ``database=True`` none of
20,000. Undisturbed: 414.7. log p of a route: -237.05 on average (degrees, nmi, knots).
"""

from jast._src.simulators.fms.database import FIXES, KLAX, KSFO
from jast._src.simulators.fms.events import Misses
from jast._src.simulators.fms.lateral import Path
from jast._src.simulators.fms.system import MEANS, SIGMAS, FmsState, fms, fms_misses, fms_path

__all__ = [
    "FIXES",
    "KLAX",
    "KSFO",
    "MEANS",
    "SIGMAS",
    "FmsState",
    "Misses",
    "Path",
    "fms",
    "fms_misses",
    "fms_path",
]
