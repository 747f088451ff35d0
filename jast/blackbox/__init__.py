"""Systems that are not written in JAX, behind the one contract of `jast.Simulator`: Python and
NumPy, external programs, Gymnasium environments.
"""

from jast.blackbox.environment import Moment, gymnasium_system
from jast.blackbox.host import Calls
from jast.blackbox.programs import program
from jast.blackbox.simulator import Record, Standing, calls, from_python

__all__ = [
    "Calls",
    "Moment",
    "Record",
    "Standing",
    "calls",
    "from_python",
    "gymnasium_system",
    "program",
]
