"""Systems that are not written in JAX, behind the one contract of `jast.Simulator`: Python and
NumPy, external programs, Gymnasium environments.
"""

from jast._src.blackbox.environment import Moment, gymnasium_system
from jast._src.blackbox.host_calls import Calls
from jast._src.blackbox.programs import program
from jast._src.blackbox.simulator import calls, from_python
from jast._src.blackbox.states import Record, Standing

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
