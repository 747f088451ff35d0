"""Rewards: what a search maximises, step by step; an episode's reward is the sum over s0..sT."""

from jast._src.core.rewards import (
    Episodic,
    Lexicographic,
    LogLikelihood,
    Shaped,
    Standard,
    as_pytree,
    density_of,
    episodic,
    lexicographic,
    likelihood,
    log_likelihood,
    once,
    shaped,
    standard,
)
from jast._src.util.doors import dir_function

__all__ = [
    "Episodic",
    "Lexicographic",
    "LogLikelihood",
    "Shaped",
    "Standard",
    "as_pytree",
    "density_of",
    "episodic",
    "lexicographic",
    "likelihood",
    "log_likelihood",
    "once",
    "shaped",
    "standard",
]
__dir__ = dir_function(__all__)
