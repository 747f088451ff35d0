"""Searches for failures; each returns a `SearchResult`."""

from jast._doors import listed
from jast.search.cem import cem
from jast.search.forest import forest
from jast.search.mcts import mcts
from jast.search.monte_carlo import monte_carlo
from jast.search.result import History, SearchResult, table

__all__ = ["History", "SearchResult", "cem", "forest", "mcts", "monte_carlo", "table"]

__dir__ = listed(__all__)
