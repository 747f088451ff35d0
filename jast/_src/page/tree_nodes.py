"""One tree of a search, as its pictures show it: who is whose child, and the best path."""

from typing import Any, NamedTuple

import jax
import numpy as np

__all__ = ["Nodes", "nodes_of"]


class Nodes(NamedTuple):
    """A tree of n nodes beside its first root, which is node 0; arrays [n + 1]."""

    tree: int
    """Which of the search."""
    row: np.ndarray
    """int: of the node in the search's `Branches`, -1 for the root."""
    parent: np.ndarray
    """int: the node that it is a child of, -1 for the root."""
    visits: np.ndarray
    q: np.ndarray
    """Mean reward from the parent on; of the root, the mean of its children."""
    end: np.ndarray
    """bool: an episode ends there."""
    distance: np.ndarray
    best: np.ndarray
    """The best reward of an episode through it."""
    failing: np.ndarray
    """int: failing episodes among those that made it and the nodes below it."""
    path: np.ndarray
    """int: nodes from the root to that of the best episode: the failure of the highest reward, else
    the episode of the highest reward."""

    def children(self, node: int) -> np.ndarray:
        """Of ``node``, the most visited first."""
        found = np.flatnonzero(self.parent == node)
        return found[np.argsort(-self.visits[found], kind="stable")]


def nodes_of(caller: str, result: Any, tree: int | None = None) -> Nodes:
    """The `Nodes` of a tree of ``result``.

    Args:
        caller: for messages.
        result: a `SearchResult` of a search with ``keep_trees=True``.
        tree: its number; default: that of the best episode.

    Raises:
        ValueError: for a result that holds no trees, and a number that it does not have.
    """
    found = getattr(result, "trees", None)
    if found is None:
        raise ValueError(
            f"{caller}: result must be of jast.search.mcts or forest with keep_trees=True, received"
            f" a {type(result).__name__} without trees"
        )
    found = jax.tree.map(np.asarray, found)
    made, trees = found.visits > 0, found.visits.shape[1]
    value = np.where(made & np.isfinite(found.reward), found.reward, -np.inf)
    rank = np.where((made & found.failure).any(0), np.where(found.failure, value, -np.inf), value)
    if tree is None:
        failed = (made & found.failure).any(0)
        tree = int(np.lexsort((rank.max(0), failed))[-1])
    if isinstance(tree, bool) or not isinstance(tree, int | np.integer) or not 0 <= tree < trees:
        raise ValueError(f"{caller}: tree must be in 0 .. {trees - 1}, received {tree!r}")
    return _one(found, int(tree), value[:, tree], int(rank[:, tree].argmax()))


def _one(found: Any, tree: int, value: np.ndarray, target: int) -> Nodes:
    own = jax.tree.map(lambda a: a[:, tree], found)
    row = np.flatnonzero(own.visits > 0)

    def below(root: Any, a: np.ndarray) -> np.ndarray:
        """``a`` of the nodes, that of the root first."""
        return np.concatenate([[root], a[row]])

    number = np.zeros(len(value) + 1, int)  # of a node by the search's own number
    number[row + 1] = np.arange(1, len(row) + 1)
    parent = np.concatenate([[-1], number[own.parent[row]]])
    visits, q = below(0, own.visits), below(0.0, own.q.astype(float))
    first = parent == 0
    visits[0] = visits[first].sum() + 1
    q[0] = np.average(q[first], weights=visits[first]) if first.any() else np.nan
    best, failing = below(-np.inf, value.astype(float)), below(0, own.failure.astype(int))
    for node in range(len(row), 0, -1):  # a child is made after its parent
        best[parent[node]] = max(best[parent[node]], best[node])
        failing[parent[node]] += failing[node]
    path = [int(number[target + 1])]
    while path[-1] > 0:
        path.append(int(parent[path[-1]]))
    return Nodes(
        tree=tree,
        row=np.concatenate([[-1], row]),
        parent=parent,
        visits=visits,
        q=q,
        end=below(False, own.end),
        distance=below(np.nan, own.distance),
        best=best,
        failing=failing,
        path=np.array(path[::-1]),
    )
