"""Decision trees: how large they grow, and the rules that they hold."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jast._src.explain.held_out import hold_out, share_of
from jast._src.util import display

__all__ = ["Rule", "grow_tree", "read_rules"]

FOLDS = 3  # parts of the episodes by which the size of a tree is chosen


@display.printable()
class Rule(NamedTuple):
    """One way through the tree.

    Example:
        >>> from jast.explain import Rule
        >>> height = ("height at step 5", "number", float("-inf"), 2.0)
        >>> print(Rule("fails", (height,), 0.9, (0.8, 1.0), 0.5, (0.4, 0.6)))
        height at step 5 <= 2 -> fails
    """

    label: str
    """What it says of an episode: "fails", or the kind of failure."""
    conditions: tuple[Any, ...]
    """(what, kind, low, high) of each: ``low < what <= high``. What holds or not is 1 or 0."""
    precision: float
    """Of the held-out episodes that it fits, the share that is of this label."""
    precision_interval: tuple[Any, ...]
    recall: float
    """Of the held-out episodes of this label, the share that it fits."""
    recall_interval: tuple[Any, ...]

    def __str__(self) -> str:
        text = " and ".join(map(_condition, self.conditions)) or "always"
        return f"{text} -> {self.label}"


def grow_tree(trees, rng, x, owner, group, most):
    """The tree of fewest ways that does as well as the best, up to one standard error (Breiman et
    al. 1984, section 3.4.3) of its accuracy on the parts left out: what fails counts as much as
    what does not, and all kinds of failures alike.
    """
    least = max(2, len(owner) // 200)
    kinds, kind, count = np.unique(owner, return_inverse=True, return_counts=True)
    weight = (np.where(kinds > 0, 1 / max(np.sum(kinds > 0), 1), 1.0) / count)[kind]

    def grow(ways, rows):
        tree = trees.DecisionTreeClassifier(
            max_leaf_nodes=ways, min_samples_leaf=least, random_state=0
        )
        return tree.fit(x[rows], owner[rows], sample_weight=weight[rows])

    sizes = range(2, most + 1)
    score = np.zeros((FOLDS, len(sizes)))
    for i in range(FOLDS):
        out = hold_out(rng, owner, group, 1 / FOLDS)
        for j, ways in enumerate(sizes):
            right = grow(ways, ~out).predict(x[out]) == owner[out]
            score[i, j] = np.average(right, weights=weight[out])
    mean = score.mean(axis=0)
    best = int(np.argmax(mean))
    tested = len(owner) / FOLDS
    error = np.sqrt(mean[best] * (1 - mean[best]) / tested)
    chosen = int(np.flatnonzero(mean >= mean[best] - error)[0])
    return grow(sizes[chosen], np.ones(len(owner), bool))


def read_rules(tree, features, names, leaf, truth, level) -> tuple:
    """`Rule` of each leaf that says of an episode that it fails."""
    t, found = tree.tree_, []

    def walk(node: int, bounds: dict) -> None:
        if t.children_left[node] < 0:
            k = int(tree.classes_[np.argmax(t.value[node][0])])
            if k:
                here, own = leaf == node, truth == k
                hits = int(np.sum(here & own))
                precision = share_of(hits, int(here.sum()), level)
                recall = share_of(hits, int(own.sum()), level)
                conditions = tuple(
                    (features[i].name, features[i].kind, low, high)
                    for i, (low, high) in bounds.items()
                )
                found.append(Rule(names[k], conditions, *precision, *recall))
            return
        i, cut = int(t.feature[node]), float(t.threshold[node])
        low, high = bounds.get(i, (-np.inf, np.inf))
        walk(t.children_left[node], bounds | {i: (low, min(high, cut))})
        walk(t.children_right[node], bounds | {i: (max(low, cut), high)})

    walk(0, {})
    return tuple(sorted(found, key=lambda r: (names.index(r.label), -r.recall)))


def _condition(condition: tuple) -> str:
    """ "gust at step 12 > 3.1" """
    what, kind, low, high = condition
    if kind == "truth":
        return what if low > -np.inf else f"not {what}"
    if kind == "count":
        low, high = np.floor(low) + 1, np.floor(high)
        if low == high:
            return f"{what} = {low:.0f}"
        above, below, digits = ">=", "<=", ".0f"
    else:
        above, below, digits = ">", "<", ".3g"
    if not np.isfinite(low):
        return f"{what} <= {high:{digits}}"
    if not np.isfinite(high):
        return f"{what} {above} {low:{digits}}"
    return f"{low:{digits}} {below} {what} <= {high:{digits}}"
