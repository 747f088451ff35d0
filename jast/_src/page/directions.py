"""The directions of `jast.explain.eigenfailures`, as numbers by step for the page of a report."""

import numpy as np

from jast._src.core.episode import Episode
from jast._src.page.episode_data import short
from jast._src.util.leaf_names import named_numbers
from jast._src.util.pytrees import index_tree
from jast.explain import Eigenfailures

__all__ = ["directions"]

PANELS = 3  # numbers of a disturbance that are drawn for a direction, at most
STEPS = 200  # of each, at most


def directions(found: Eigenfailures) -> list[dict]:
    """For each direction its ``name``, the ``steps`` and ``panels``: the disturbances that it moves
    most, each with its ``columns`` in the replays at -1 and +1, and in the mean one (``quiet``).
    """
    steps = np.arange(1, found.end + 1, -(-found.end // STEPS))
    middle, out = _columns(found.middle, steps), []
    for k, way in enumerate(found.directions):
        order = np.argsort(-np.abs(way), kind="stable")
        moved = dict.fromkeys(found.names[i] for i in order if found.steps[i] > 0)
        both = (index_tree(e, k) for e in (found.minus, found.plus))
        ends = [_columns(e, steps) for e in both]
        panels = [
            {"name": name, "columns": [end[name] for end in ends], "quiet": [middle[name]]}
            for name in list(moved)[:PANELS]
        ]
        about = f"variance {found.variances[k]:.3g}, shift {found.shifts[k]:.3g}"
        words = f"direction {k + 1} ({about})"
        out.append({"name": words, "steps": steps.tolist(), "panels": panels})
    return out


def _columns(e: Episode, steps: np.ndarray) -> dict[str, list[float]]:
    """Name of a number -> its values at ``steps``, NaN behind the end."""
    return {
        name: short(np.where(steps <= e.length, values[steps - 1], np.nan))
        for name, values in named_numbers(e.disturbances, "x")
    }
