"""Episodes of any system: how its numbers went, against what they do by chance, and one number over
another.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.plot import series, style
from jast._src.plot.series import DISTANCE, Series
from jast._src.plot.style import Axes

__all__ = ["draw_traces", "phase", "traces"]

PANELS = 8  # that are drawn where nobody chooses
BANDS = ((0.05, 0.95, 0.15), (0.25, 0.75, 0.35))  # quantiles and opacity


def traces(
    samples: Any,
    sim: Simulator | None = None,
    fields: Sequence[str] | None = None,
    *,
    modes: Any = None,
    nominal: Episode | int | None = None,
    units: dict[str, Any] | None = None,
    most: int = 60,
    axes: Sequence[Axes] | None = None,
) -> list[Axes]:
    """How the numbers of the state went in failures, a panel each, against the ordinary: grey bands
    from the 5 to the 95 % and from the 25 to the 75 % quantile of nominal episodes (of those that
    still run), dashed the undisturbed system. A mark ends each failure; its colour is its mode.

    Args:
        samples: a report of `jast.stress`, its modes, a result of a search, its archive,
            `jast.estimate.FailureSamples`, an `Episode` or a batch of them. Each is replayed.
        sim: their simulator; not needed with a report that holds it.
        fields: names to draw: "speed", "position[0]", or "position" for all its numbers; "miss
            distance"; "disturbance gust". Default: the first seven numbers that go otherwise than
            undisturbed, and the miss distance; of a black box that is judged at its end, its
            disturbances.
        modes: `jast.search.Modes`, by which failures are told apart (by their direction,
            moved in time), or the number of the mode of each, from 0. Default: those of a report.
        nominal: an `Episode` batch, or how many to draw with key 0. Default: 200; of a black box
            none.
        units: name -> unit, for the labels.
        most: failures drawn, evenly taken.
        axes: one for each field, or None for a new figure.

    Raises:
        ValueError: for samples of another kind, and a field that there is not.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.gradient(jax.random.key(0), sim, starts=4, refine=0)
        >>> len(jast.plot.traces(found, sim, nominal=20)) > 0
        True
    """
    caller = "traces"
    g = series.samples_of(caller, samples, sim, modes, most)
    own = series.series_of(g.sim, g.episodes)
    behind, quiet = series.nominal_series(caller, g.sim, nominal), series.undisturbed_series(g.sim)
    names = series.choose_fields(caller, fields, own, PANELS, quiet)
    columns = 1 if len(names) < 4 else 2
    rows = -(-len(names) // columns)
    size = (6.8, 1.1 + 1.9 * rows) if columns == 1 else (9.6, 1.0 + 1.75 * rows)
    new = axes is None
    with style.panels(caller, axes, size, len(names), "field", columns) as axes:
        draw_traces(axes, names, series.by_mode(g), own, behind, quiet, units)
        for ax in axes[-columns:]:
            ax.set_xlabel("step")
            ax.tick_params(labelbottom=True)
        if new:
            what = axes[0].get_legend_handles_labels()
            axes[0].figure.legend(*what, loc="outside upper left", ncols=3, fontsize=9)
        else:
            style.legend_above(axes[0], ncols=3, fontsize=9)
    return axes


def draw_traces(
    axes: list,
    names: list[str],
    kinds: list[tuple],
    own: Series,
    behind: Series | None,
    quiet: Series | None,
    units: dict | None,
) -> None:
    """The panels of `traces`: the ``names`` on ``axes``, without labels of steps and a legend;
    ``kinds``: as of `by_mode`, rows of ``own``.
    """
    last = int(own.length.max())
    for ax, name in zip(axes, names, strict=True):
        if behind is not None and name in behind.columns:
            _bands(ax, behind.columns[name][:, : last + 1], len(behind.length))
        if quiet is not None and name in quiet.columns:
            row = quiet.columns[name][0, : last + 1]
            look = dict(color=style.INK, linewidth=1.3, linestyle=style.DASHED)
            ax.plot(row, label="undisturbed", **look)
        for rows, colour, marker, label in kinds:
            alpha = float(np.clip(14 / len(rows), 0.15, 1.0))
            mark = dict(color=colour, marker=marker, markersize=4.5)
            for i in rows:
                line, n = own.columns[name][i], own.length[i]
                ax.plot(line, color=colour, linewidth=1.4, alpha=alpha, zorder=3)
                ax.plot(n, line[n], alpha=alpha, zorder=4, **mark)
            ax.plot([], [], label=label, linewidth=1.4, **mark)
        if name == DISTANCE:
            ax.axhline(0, color=style.GREY, linewidth=0.8, zorder=1)
        ax.set(ylabel=style.labelled(name, units), xlim=(0, max(last, 1)))
        ax.margins(x=0.02)
        style.whole_steps(ax.xaxis)


def _bands(ax: Any, rows: np.ndarray, n: int) -> None:
    at = np.flatnonzero(np.isfinite(rows).any(axis=0))
    if not len(at):
        return
    for low, high, alpha in BANDS:
        edges = np.nanquantile(rows[:, at], (low, high), axis=0)
        label = f"{high - low:.0%} of {n} nominal episodes"
        style.band(ax, at, *edges, color=style.GREY, alpha=alpha, label=label)


def phase(
    samples: Any,
    sim: Simulator | None = None,
    fields: tuple[str, str] | None = None,
    *,
    modes: Any = None,
    nominal: Episode | int | None = None,
    units: dict[str, Any] | None = None,
    most: int = 60,
    ax: Axes | None = None,
) -> Axes:
    """Phase portrait: one number of the state over another. Failures in the colours of their modes,
    a square where each starts and a mark where it ends; grey nominal episodes, dashed the
    undisturbed one.

    Args:
        samples, sim, modes, nominal, units, most: as of `traces`.
        fields: two names, across and up. Default: the first two numbers that go otherwise than
            undisturbed.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: as `traces`, and where there are not two fields.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.pendulum()
        >>> found = jast.search.gradient(jax.random.key(0), sim, starts=4, refine=0)
        >>> ax = jast.plot.phase(found, sim, nominal=20)
    """
    caller = "phase"
    g = series.samples_of(caller, samples, sim, modes, most)
    own = series.series_of(g.sim, g.episodes)
    behind, quiet = series.nominal_series(caller, g.sim, nominal), series.undisturbed_series(g.sim)
    names = series.choose_fields(caller, fields, own, PANELS, quiet)
    if fields is None:
        names = [k for k in names if k != DISTANCE] + [DISTANCE] * (DISTANCE in names)
        names = names[:2]
    if len(names) != 2:
        raise ValueError(f"plot.{caller}: fields must be two names, received {names}")
    with style.axes(ax, (6.2, 5.2)) as ax:
        if behind is not None:
            across, up = (behind.columns[k] for k in names)
            alpha = float(np.clip(15 / len(across), 0.05, 0.6))
            for i in range(len(across)):
                ax.plot(across[i], up[i], color=style.GREY, linewidth=0.8, alpha=alpha, zorder=1)
            label = f"{len(across)} nominal episodes"
            ax.plot([], [], color=style.GREY, linewidth=1.2, label=label)
        if quiet is not None:
            row = [quiet.columns[k][0] for k in names]
            look = dict(color=style.INK, linewidth=1.3, linestyle=style.DASHED)
            ax.plot(*row, **look, label="undisturbed", zorder=3)
        for rows, colour, marker, label in series.by_mode(g):
            alpha = float(np.clip(14 / len(rows), 0.15, 1.0))
            mark = dict(color=colour, marker=marker, markersize=6)
            for i in rows:
                across, up = (own.columns[k][i] for k in names)
                n = own.length[i]
                first = int(np.argmax(np.isfinite(across) & np.isfinite(up)))
                ax.plot(across, up, color=colour, linewidth=1.4, alpha=alpha, zorder=4)
                start = dict(color=style.INK, marker="s", markersize=4, zorder=5)
                ax.plot(across[first], up[first], **start)
                ax.plot(across[n], up[n], alpha=alpha, zorder=6, **mark)
            ax.plot([], [], label=label, linewidth=1.4, **mark)
        ax.set(xlabel=style.labelled(names[0], units), ylabel=style.labelled(names[1], units))
        style.legend_above(ax, fontsize=9)
    return ax
