"""Searches for failures; each returns a `SearchResult`."""

from jast.search.forest import forest
from jast.search.mcts import mcts
from jast.search.result import History, SearchResult, table

__all__ = ["History", "SearchResult", "forest", "mcts", "table"]
