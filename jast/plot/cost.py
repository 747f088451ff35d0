"""What a search costs by how slow its simulator is, from results and their measured times: figures
4 and 5 of Lytskjold and Mengshoel.

The episodes of a search do not depend on how long a step takes, so a search that took so many
seconds would take its steps times c longer with a simulator whose step takes c seconds more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from jast.intervals import clopper_pearson
from jast.plot import style
from jast.search.result import SearchResult

if TYPE_CHECKING:
    import chex
    from matplotlib.axes import Axes

__all__ = ["failing_trees", "simulation_times"]

COSTS = np.geomspace(1e-8, 1.0, 33)
"""Seconds."""


def failing_trees(
    results: SearchResult | Mapping[str, SearchResult],
    seconds: float | Mapping[str, float],
    *,
    costs: chex.ArrayLike = COSTS,
    ax: Axes | None = None,
) -> Axes:
    """Trees that find a failure in a second, by how long a step of the simulator takes, on
    logarithmic axes: figure 4 of Lytskjold and Mengshoel, measured where theirs is computed from
    constants.

    The band is that of the 95 % Clopper-Pearson interval of the share of trees, which leaves out
    that trees which share heads are not independent. A search without a failing tree has its upper
    end alone, dashed.

    Args:
        results: a result of a search, or a dict of name -> result.
        seconds: what the call took, above 0, CPU or wall, without compilation; a dict of the same
            names where ``results`` is one.
        costs: [n] seconds, above 0, by which a step takes longer than it did.
        ax: the Axes to draw into; default: those of a new figure.

    Returns:
        The Axes.

    Raises:
        ValueError: for anything but results of searches, names that differ, and numbers that are
            not above 0.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0)
        >>> ax = jast.plot.failing_trees({"chance": found}, {"chance": 2.0})
    """
    rows, costs = _checked("failing_trees", results, seconds, costs)
    with style.axes(ax, (6.8, 4.2)) as ax:
        for i, (name, result, took) in enumerate(rows):
            colour, marker = style.look(i)
            failing = np.asarray(result.failing_per_tree)
            time = took + result.steps * costs
            low, high = clopper_pearson(int(failing.sum()), failing.size)
            if failing.any():
                ax.plot(costs, failing.sum() / time, color=colour, label=name)
                ax.fill_between(
                    *(costs, low * failing.size / time, high * failing.size / time),
                    color=colour,
                    alpha=0.2,
                    linewidth=0,
                )
            else:
                label = f"{name}: none, at most".removeprefix(": ")
                ax.plot(
                    *(costs, high * failing.size / time),
                    color=colour,
                    linestyle=(0, (4, 2)),
                    label=label,
                )
        _labelled(ax, "failing trees in a second", len(rows))
    return ax


def simulation_times(
    results: SearchResult | Mapping[str, SearchResult],
    seconds: float | Mapping[str, float],
    *,
    costs: chex.ArrayLike = COSTS,
    ax: Axes | None = None,
) -> Axes:
    """The mean time of a simulation by how long a step of the simulator takes, on logarithmic axes:
    figure 5 of Lytskjold and Mengshoel. Searches that keep states (``memoize`` of
    `jast.search.forest`) take fewer steps a simulation, which pays the more the slower a step is.

    Args:
        results, seconds, costs, ax: as for `failing_trees`.

    Returns:
        The Axes.

    Raises:
        ValueError: as `failing_trees`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0)
        >>> ax = jast.plot.simulation_times({"chance": found}, {"chance": 2.0})
    """
    rows, costs = _checked("simulation_times", results, seconds, costs)
    with style.axes(ax, (6.8, 4.2)) as ax:
        for i, (name, result, took) in enumerate(rows):
            colour, marker = style.look(i)
            label = f"{name}: {result.steps / result.episodes:.1f} steps".removeprefix(": ")
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
            f"plot.{caller}: results must be results of a search, received {kinds or 'none'}"
        )
    if several != isinstance(seconds, Mapping):
        expected = (
            "a dict of the same names as results" if several else "a number, as of one result"
        )
        raise ValueError(f"plot.{caller}: seconds must be {expected}, received {seconds!r}")
    seconds = dict(seconds) if several else {"": seconds}
    if set(seconds) != set(results):
        raise ValueError(
            f"plot.{caller}: seconds must have the names {[*results]}, received {[*seconds]}"
        )
    for name, value in seconds.items():
        if isinstance(value, bool | str) or np.ndim(value) or not 0 < float(value) < math.inf:
            raise ValueError(
                f"plot.{caller}: seconds must be above 0, received {value!r}"
                + (f" for {name!r}" if several else "")
            )
    costs = np.asarray(costs, float)
    if costs.ndim != 1 or not costs.size or not np.all((costs > 0) & np.isfinite(costs)):
        raise ValueError(
            f"plot.{caller}: costs must be seconds above 0, [n], received {costs.tolist()}"
        )
    return [(name, r, float(seconds[name])) for name, r in results.items()], costs


def _labelled(ax, quantity, n):
    ax.set(
        xscale="log", yscale="log", xlabel="added to a step of the simulator (s)", ylabel=quantity
    )
    if any(ax.get_legend_handles_labels()[1]):
        ax.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=min(n, 2), fontsize=9)
