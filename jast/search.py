"""Searches for failures; each returns a `SearchResult`."""

from jast._src.search.cem import cem
from jast._src.search.chain import chain
from jast._src.search.falsify import falsify
from jast._src.search.forest import forest
from jast._src.search.go_explore.go_explore import go_explore
from jast._src.search.gradient import gradient
from jast._src.search.mcts import mcts
from jast._src.search.monte_carlo import monte_carlo
from jast._src.search.refine.modes import Mode, Modes, modes
from jast._src.search.refine.refine import Refined, refine
from jast._src.search.result import History, SearchResult, table
from jast._src.util.doors import dir_function

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
