"""Searches for failures; each returns a `SearchResult`."""

from jast._doors import dir_function
from jast.search.cem import cem
from jast.search.chain import chain
from jast.search.failure_modes import Mode, Modes, modes
from jast.search.falsify import falsify
from jast.search.forest import forest
from jast.search.go_explore import go_explore
from jast.search.gradient import gradient
from jast.search.mcts import mcts
from jast.search.monte_carlo import monte_carlo
from jast.search.refinement import Refined, refine
from jast.search.result import History, SearchResult, table

__all__ = [
    "History",
    "Mode",
    "Modes",
    "Refined",
    "SearchResult",
    "cem",
    "chain",
    "falsify",
    "forest",
    "go_explore",
    "gradient",
    "mcts",
    "modes",
    "monte_carlo",
    "refine",
    "table",
]

__dir__ = dir_function(__all__)
