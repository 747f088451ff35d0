"""What went wrong inside a system that runs on the host: kept with an example and counted, never
raised, so that a search goes on.
"""

from jast._src.blackbox.incidents import incidents
from jast._src.runtime.host_errors import KINDS, Incident
from jast._src.util.doors import dir_function

__all__ = [
    "KINDS",
    "Incident",
    "incidents",
]
__dir__ = dir_function(__all__)
