"""A search tree: what the search knew along the path to its best episode, as a picture and as a
page whose nodes open.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jast._src.core.typing import PathLike
from jast._src.page.tree import nodes_of, write_tree
from jast._src.plot import style
from jast._src.plot.style import Axes

__all__ = ["tree", "tree_page"]


def tree(
    result: Any, axes: Sequence[Axes] | None = None, *, tree: int | None = None, levels: int = 40
) -> list[Axes]:
    """Q and visits of the nodes on the path to a tree's best episode, a panel each, and of the
    other children of each node on it: the tree, opened along that path. A dot is a child.

    Args:
        result: of `jast.search.mcts` or `jast.search.forest` with ``keep_trees=True``.
        axes: two, or None for a new figure.
        tree: which of its trees; default: that of the best episode.
        levels: how far down the picture goes.

    Raises:
        ValueError: for a result that holds no trees, and a number that it does not have.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.mcts(jax.random.key(0), sim, simulations=500, keep_trees=True)
        >>> len(jast.plot.tree(found))
        2
    """
    nodes = nodes_of("plot.tree", result, tree)
    path = nodes.path[: levels + 1]
    with style.panels("tree", axes, (7.2, 5.6), 2, "number of a node") as axes:
        labels = ("Q(s, a)", "visits N(s, a)")
        for ax, values, label in zip(axes, (nodes.q, nodes.visits), labels, strict=True):
            for level, node in enumerate(path):
                below = nodes.children(node)
                if level == levels or not len(below):
                    continue
                ends = np.stack([np.full(len(below), values[node]), values[below]])
                ax.plot([level, level + 1], ends, color=style.GREY, linewidth=0.5, alpha=0.5)
                size = 4 + 60 * nodes.visits[below] / nodes.visits[below].max()
                at = np.full(len(below), level + 1)
                ax.scatter(at, values[below], s=size, color=style.BLUE, alpha=0.6, linewidth=0)
            look = dict(color=style.VERMILION, marker="o", markersize=4, zorder=4)
            ax.plot(np.arange(len(path)), values[path], label="path to the best episode", **look)
            ax.set(ylabel=label, xlim=(-0.5, len(path) + 0.5))
        axes[1].set(yscale="log", xlabel="level of the tree")
        style.whole_steps(axes[1].xaxis)
        style.legend_above(axes[0], ncols=1)
        title = f"tree {nodes.tree}: {len(nodes.visits):,} nodes, best {nodes.best[0]:.4g}"
        axes[0].set_title(title, loc="right")
    return axes


def tree_page(result: Any, path: PathLike, *, tree: int | None = None) -> None:
    """Write a tree as one HTML file that needs no network and no Python: nodes that open, with
    visits, Q, the best reward below and the action; the most visited child first; opened along the
    path to the best episode. Of a large tree the most visited nodes, so that the file stays below
    3 MB.

    Args:
        result: of `jast.search.mcts` or `jast.search.forest` with ``keep_trees=True``.
        path: of the file.
        tree: which of its trees; default: that of the best episode.

    Raises:
        ValueError: for a result that holds no trees, and a number that it does not have.

    Example:
        >>> import os, tempfile, jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.mcts(jax.random.key(0), sim, simulations=500, keep_trees=True)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "tree.html")
        ...     jast.plot.tree_page(found, path)
        ...     os.path.exists(path)
        True
    """
    write_tree(path, result, tree)
