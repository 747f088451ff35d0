"""Actions: what a search chooses at a step. An action becomes a disturbance before ``step``; only
disturbances are stored.
"""

from jast._src.core.actions import (
    Quantiles,
    Samples,
    UniformBox,
    Wide,
    quantiles,
    samples,
    uniform,
    wide,
)
from jast._src.util.doors import dir_function

__all__ = [
    "Quantiles",
    "Samples",
    "UniformBox",
    "Wide",
    "quantiles",
    "samples",
    "uniform",
    "wide",
]
__dir__ = dir_function(__all__)
