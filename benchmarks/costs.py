"""What a search costs by how slow its simulator is, from results and their measured times: figures
4 and 5 of Lytskjold and Mengshoel.

The episodes of a search do not depend on how long a step takes, so a search that took so many
seconds would take its steps times c longer with a simulator whose step takes c seconds more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from jast._src.plot import style
from jast._src.search.result import SearchResult
from jast._src.util.intervals import clopper_pearson

COSTS = np.geomspace(1e-8, 1.0, 33)
"""Seconds."""


def failing_trees(results, seconds, *, costs=COSTS, ax=None):
    """Trees that find a failure in a second, by how long a step of the simulator takes, on
    logarithmic axes: figure 4 of Lytskjold and Mengshoel, measured where theirs is computed from
    constants. Returns the Axes.

    The band is that of the 95 % Clopper-Pearson interval of the share of trees, which leaves out
    that trees which share heads are not independent. A search without a failing tree has its upper
    end alone, dashed.

    Args:
        results: a result of a search, or a dict of name -> result.
        seconds: what the call took, above 0, CPU or wall, without compilation; a dict of the same
            names where ``results`` is one.
        costs: [n] seconds, above 0, by which a step takes longer than it did.
        ax: the Axes to draw into; default: those of a new figure.
    """
    rows, costs = _checked("failing_trees", results, seconds, costs)
    with style.axes(ax, (6.8, 4.2)) as ax:
        for i, (name, result, took) in enumerate(rows):
            colour, _ = style.look(i)
            failing = np.asarray(result.failing_per_tree)
            a_second = failing.size / (took + result.steps * costs)
            low, high = clopper_pearson(int(failing.sum()), failing.size)
            if failing.any():
                ax.plot(costs, failing.mean() * a_second, color=colour, label=name)
                style.band(ax, costs, low * a_second, high * a_second, color=colour)
            else:
                look = dict(color=colour, linestyle=style.DASHED)
                ax.plot(costs, high * a_second, label=style.named(name, "none, at most"), **look)
        _labelled(ax, "failing trees in a second", len(rows))
    return ax


def simulation_times(results, seconds, *, costs=COSTS, ax=None):
    """The mean time of a simulation by how long a step of the simulator takes, on logarithmic axes:
    figure 5 of Lytskjold and Mengshoel. Searches that keep states (``memoize`` of
    `jast.search.forest`) take fewer steps a simulation, which pays the more the slower a step is.
    Arguments are those of `failing_trees`; returns the Axes.
    """
    rows, costs = _checked("simulation_times", results, seconds, costs)
    with style.axes(ax, (6.8, 4.2)) as ax:
        for i, (name, result, took) in enumerate(rows):
            colour, marker = style.look(i)
            label = style.named(name, f"{result.steps / result.episodes:.1f} steps")
            time = (took + result.steps * costs) / result.episodes
            ax.plot(costs, time, color=colour, marker=marker, markevery=4, label=label)
        _labelled(ax, "a simulation (s)", len(rows))
    return ax


def _checked(caller, results, seconds, costs):
    """Name, result and seconds of each search, and the costs as an array."""
    several = isinstance(results, Mapping)
    results = dict(results) if several else {"": results}
    if not results or not all(isinstance(r, SearchResult) for r in results.values()):
        kinds = [type(r).__name__ for r in results.values()]
        raise ValueError(
            f"{caller}: results must be results of a search, received {kinds or 'none'}"
        )
    if several != isinstance(seconds, Mapping):
        expected = (
            "a dict of the same names as results" if several else "a number, as of one result"
        )
        raise ValueError(f"{caller}: seconds must be {expected}, received {seconds!r}")
    seconds = dict(seconds) if several else {"": seconds}
    if set(seconds) != set(results):
        raise ValueError(
            f"{caller}: seconds must have the names {[*results]}, received {[*seconds]}"
        )
    for name, value in seconds.items():
        if isinstance(value, bool | str) or np.ndim(value) or not 0 < float(value) < math.inf:
            raise ValueError(
                f"{caller}: seconds must be above 0, received {value!r}"
                + (f" for {name!r}" if several else "")
            )
    costs = np.asarray(costs, float)
    if costs.ndim != 1 or not costs.size or not np.all((costs > 0) & np.isfinite(costs)):
        raise ValueError(f"{caller}: costs must be seconds above 0, [n], received {costs.tolist()}")
    return [(name, r, float(seconds[name])) for name, r in results.items()], costs


def _labelled(ax, quantity, n):
    ax.set(
        xscale="log", yscale="log", xlabel="added to a step of the simulator (s)", ylabel=quantity
    )
    if any(ax.get_legend_handles_labels()[1]):
        style.legend_above(ax, ncols=min(n, 2), fontsize=9)
