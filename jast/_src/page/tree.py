"""The page of a search tree: nodes that open, the most visited child first (thesis section 5)."""

from typing import Any

import jax
import numpy as np

from jast._src.page.document import document, rows, write
from jast._src.page.episode_data import groups, short
from jast._src.page.tree_nodes import Nodes, nodes_of

__all__ = ["write_tree"]

BYTES = 2_400_000  # of a page, about
NODE = 60  # bytes of a node beside its action, about
NUMBER = 12  # bytes of a number of an action, about
ENTRIES = 8  # numbers of one array of an action that are shown


def write_tree(caller: str, path: Any, result: Any, tree: int | None = None) -> None:
    """Write the page of a tree of ``result`` to the one file ``path``; arguments and errors as for
    `page.tree_nodes.nodes_of`.
    """
    nodes = nodes_of(caller, result, tree)
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
    found = groups(tree, steps, name) if len(steps) > 1 else []
    for group in found:
        group["more"] += max(0, len(group["entries"]) - ENTRIES)
        group["entries"] = group["entries"][:ENTRIES]
        columns = group["columns"][:ENTRIES]
        group["columns"] = [
            [v if there else None for v, there in zip(column, wanted, strict=True)]
            for column in columns
        ]
    return found
