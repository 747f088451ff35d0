"""The archive of failures: the best distinct ones that a search found, each exactly replayable, in
memory and in one file.
"""

from jast._src.core.failures import (
    Failures,
    collect,
    from_json,
    load,
    merge,
    save,
    to_csv,
    to_numpy,
)
from jast._src.util.doors import dir_function

__all__ = [
    "Failures",
    "collect",
    "from_json",
    "load",
    "merge",
    "save",
    "to_csv",
    "to_numpy",
]
__dir__ = dir_function(__all__)
