"""One tree of a search: who is whose child, the best path, and a page whose nodes open, the most
visited child first (thesis section 5).
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.page.document import document, rows, write
from jast._src.page.episode_data import groups, short
from jast._src.util.checks import wrong
from jast._src.util.pytrees import index_tree

__all__ = ["nodes_of", "write_tree"]

BYTES = 2_400_000  # of a page, about
NODE = 60  # bytes of a node beside its action, about
NUMBER = 12  # bytes of a number of an action, about
ENTRIES = 8  # numbers of one array of an action that are shown


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
        must = "be of jast.search.mcts or forest with keep_trees=True"
        raise wrong(caller, "result", must, f"a {type(result).__name__} without trees")
    found = jax.tree.map(np.asarray, found)
    made, trees = found.visits > 0, found.visits.shape[1]
    value = np.where(made & np.isfinite(found.reward), found.reward, -np.inf)
    failed = (made & found.failure).any(0)
    rank = np.where(failed, np.where(found.failure, value, -np.inf), value)
    if tree is None:
        tree = int(np.lexsort((rank.max(0), failed))[-1])
    if isinstance(tree, bool) or not isinstance(tree, int | np.integer) or not 0 <= tree < trees:
        raise ValueError(f"{caller}: tree must be in 0 .. {trees - 1}, received {tree!r}")
    return _one(found, int(tree), value[:, tree], int(rank[:, tree].argmax()))


def _one(found: Any, tree: int, value: np.ndarray, target: int) -> Nodes:
    own = index_tree(found, np.s_[:, tree])
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


def write_tree(path: Any, result: Any, tree: int | None) -> None:
    """Write the page of a tree of ``result`` to the one file ``path``; arguments and errors as for
    `nodes_of`.
    """
    nodes = nodes_of("plot.tree_page", result, tree)
    trees = jax.tree.map(lambda a: np.asarray(a)[:, nodes.tree], result.trees)
    width = sum(min(ENTRIES, a[0].size) for a in jax.tree.leaves((trees.x, trees.start)) if len(a))
    shown = _shown(nodes, BYTES // (NODE + NUMBER * width))
    data = _data(nodes, trees, shown)
    settings = result.settings or {}
    facts = [
        (name, settings[name])
        for name in ("method", "mode", "reward", "actions", "simulations", "prunes", "exploration")
        if name in settings
    ]
    total, failing = len(nodes.visits), int(nodes.failing[0])
    counts = [
        ("tree", f"{nodes.tree} (of 0 .. {result.trees.visits.shape[1] - 1})"),
        ("nodes", f"{total:,}" + (f", of which {len(shown):,} shown" * (len(shown) < total))),
        ("failing episodes", f"{failing:,}"),
        ("best reward", f"{nodes.best[0]:.6g}"),
    ]
    body = (
        '<header><p class="kind">jast: search tree</p><h1>The tree of a search, opened along the'
        " path to its best episode</h1></header>\n<main>"
        f"<section>{rows([*counts, *facts], 'facts wide')}"
        "<p class=note>A node is a state; N: how often it was visited, Q: the mean reward from its"
        " parent on, best: the best reward of an episode through it. The most visited child comes"
        " first. The bar compares visits among"
        " siblings.</p><p><button id=best>Open the best path</button>"
        " <button id=close>Close all</button></p></section>"
        '<section id="tree"></section></main>'
    )
    write(path, document(f"jast: search tree {nodes.tree}", body, data, "tree.js"))


def _shown(nodes: Nodes, most: int) -> np.ndarray:
    """The most visited nodes, with the best path; each with all that lie above it."""
    order = np.lexsort((np.arange(len(nodes.visits)), -nodes.visits))
    return np.union1d(order[: max(most, 1)], nodes.path)


def _data(nodes: Nodes, trees: Any, shown: np.ndarray) -> dict:
    """Columns over the nodes ``shown``."""
    at = np.full(len(nodes.visits), -1)
    at[shown] = np.arange(len(shown))
    under = np.bincount(nodes.parent[1:], minlength=len(at))
    kept = np.bincount(nodes.parent[shown[1:]], minlength=len(at))
    parent = np.where(shown > 0, at[nodes.parent[shown]], -1)
    first = parent == 0
    steps = nodes.row[shown].tolist()
    return {
        "parent": parent,
        "visits": nodes.visits[shown],
        "q": short(nodes.q[shown]),
        "best": short(nodes.best[shown]),
        "failing": nodes.failing[shown],
        "end": nodes.end[shown].astype(int),
        "distance": short(nodes.distance[shown]),
        "more": (under - kept)[shown],
        "path": at[nodes.path],
        "x": _actions(trees.x, steps, "x", np.full(len(shown), True)),
        # at the first root of a random start x0 is chosen
        "start": _actions(trees.start, steps, "x0", first),
    }


def _actions(tree: Any, steps: list[int], name: str, wanted: np.ndarray) -> list[dict]:
    found = groups(tree, steps, name, most=ENTRIES) if len(steps) > 1 else []
    for group in found:
        group["columns"] = [
            [v if there else None for v, there in zip(column, wanted, strict=True)]
            for column in group["columns"]
        ]
    return found
