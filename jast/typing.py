"""Names for what users pass to jast: the functions of a system, rewards, choices of actions,
callbacks and executors.
"""

from jast._src.core.typing import (
    Actions,
    Callback,
    Density,
    DistributionLike,
    Disturbance,
    Evaluate,
    Executor,
    Init,
    IsTerminal,
    Objective,
    Observe,
    PathLike,
    Predict,
    Reward,
    Schedule,
    Start,
    Step,
)
from jast._src.util.doors import dir_function

__all__ = [
    "Actions",
    "Callback",
    "Density",
    "DistributionLike",
    "Disturbance",
    "Evaluate",
    "Executor",
    "Init",
    "IsTerminal",
    "Objective",
    "Observe",
    "PathLike",
    "Predict",
    "Reward",
    "Schedule",
    "Start",
    "Step",
]
__dir__ = dir_function(__all__)
