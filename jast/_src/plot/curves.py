"""The probability of failure as a curve: against a threshold of the miss distance, and against a
setting that a sweep varies.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from jast._src.io.codec import name_of
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast.estimate import Estimate, Exceedance
from jast.estimate import exceedance as curve_of

if TYPE_CHECKING:
    from jast.sweeping import Sweep


__all__ = ["exceedance", "sweep"]


def exceedance(
    curves: Any, truth: Callable[[Any], Any] | None = None, ax: Axes | None = None
) -> Axes:
    """The probability that an episode comes as near to a failure as a threshold of the miss
    distance, with its band, on a logarithmic axis; dashed where it must not be believed, a gap
    where it is not known, a vertical line at the failure.

    Args:
        curves: a `jast.estimate.Exceedance`, an `Estimate` that holds draws, or a dict of name ->
            either.
        truth: threshold -> probability, of an array, where it is known: dots.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for anything else, an estimate without draws, and where nothing is known.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> ax = jast.plot.exceedance({"counting": counted})
    """
    caller = "exceedance"
    named = style.by_name(curves)
    words = "an Exceedance, an Estimate or a dict of name -> either"
    style.checked_kinds(caller, "curves", named.values(), Exceedance | Estimate, words)
    named = {k: curve_of(c) if isinstance(c, Estimate) else c for k, c in named.items()}
    if not all(np.isfinite(c.probability).any() for c in named.values()):
        raise style.wrong(caller, "curves", "hold at least one probability", "only NaN")
    with style.axes(ax, (6.8, 3.8)) as ax:
        ax.axvline(0.0, color=style.INK, linewidth=1.0, linestyle=style.DOTTED, label="failure")
        for i, (name, c) in enumerate(named.items()):
            colour, low = style.colour(i), np.maximum(c.low, np.finfo(float).tiny)
            style.band(ax, c.thresholds, low, c.high, color=colour)
            label = f"{name or c.method}, {c.level:.4g} interval"
            good = np.where(c.reliable, c.probability, np.nan)
            ax.plot(c.thresholds, good, color=colour, label=label)
            if (~c.reliable & np.isfinite(c.probability)).any():
                doubted = np.where(c.reliable, np.nan, c.probability)
                look = dict(color=style.VERMILION, linestyle=(0, (2, 1.5)), zorder=3)
                ax.plot(c.thresholds, doubted, label="UNRELIABLE", **look)
        if truth is not None:
            u = np.unique(np.concatenate([c.thresholds for c in named.values()]))
            u = u[:: max(len(u) // 16, 1)]
            look = dict(color=style.INK, linestyle="", marker="o", markersize=3, zorder=4)
            ax.plot(u, np.asarray(truth(u), float), label="truth", **look)
        words = "threshold of the miss distance", "probability of coming so near"
        ax.set(yscale="log", xlabel=words[0], ylabel=words[1])
        style.legend_above(ax, ncols=3, fontsize=9)
    return ax


def sweep(
    table: Sweep,
    against: str | None = None,
    *,
    level: float | None = None,
    truth: Callable[..., Any] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The probability of failure against a setting, on a logarithmic axis: a line with the band of
    its intervals through the rows that are reliable, the others as crosses; a triangle at the
    upper end of the interval where no failure was seen.

    Args:
        table: of `jast.sweep`.
        against: the setting, of numbers; default: the only one that varies.
        level: a probability whose crossing is drawn: where the line crosses it, and the interval.
        truth: value of the setting -> probability, of an array, where it is known: dots.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for anything but a `Sweep`, one without a probability, and as
            `Sweep.crossing`.

    Example:
        >>> import jax, jast
        >>> make = lambda threshold: jast.simulators.walk1d(threshold=threshold)
        >>> table = jast.sweep(
        ...     jax.random.key(0), make, {"threshold": [8.0, 12.0]}, jast.nominal, episodes=500
        ... )
        >>> ax = jast.plot.sweep(table)
    """
    caller = "plot.sweep"
    if name_of(table) != "Sweep":
        raise ValueError(f"{caller}: table must be a Sweep, received {type(table).__name__}")
    name, x = table.axis(caller, against)
    order = np.argsort(x, kind="stable")
    x, p, reliable = x[order], table.probability[order], table.reliable[order]
    low, high = table.interval[order].T
    if not np.isfinite(high).any():
        raise ValueError(f"{caller}: table must hold at least one probability, received only NaN")
    seen, blue = p > 0, style.BLUE
    with style.axes(ax, (6.8, 3.8)) as ax:
        good = seen & reliable
        floor = np.maximum(low, np.nanmin(np.where(seen, p, np.inf), initial=1.0) / 10)
        style.band(ax, x[good], floor[good], high[good], color=blue)
        ax.plot(x[good], p[good], color=blue, marker="o", markersize=3, label="probability")
        doubted, unseen = seen & ~reliable, ~seen & np.isfinite(high)
        if doubted.any():
            spread = np.abs(np.stack([floor, high]) - p)[:, doubted]
            look = dict(color=style.VERMILION, linestyle="", marker="x", elinewidth=1)
            ax.errorbar(x[doubted], p[doubted], spread, label="UNRELIABLE", **look)
        if unseen.any():
            look = dict(color=style.GREY, linestyle="", marker="v")
            ax.plot(x[unseen], high[unseen], label="no failure seen: below", **look)
        if truth is not None:
            look = dict(color=style.INK, linestyle="", marker=".", markersize=4, zorder=4)
            ax.plot(x, np.asarray(truth(x), float), label="truth", **look)
        if level is not None:
            found = table.crossing(level, against)
            ax.axhline(found.level, color=style.INK, linewidth=1.0, linestyle=style.DOTTED)
            ax.axvspan(*np.clip(found.interval, x[0], x[-1]), color=style.INK, alpha=0.12)
            ax.axvline(found.value, color=style.INK, linewidth=1.0, label=style.plain(found))
        ax.set(yscale="log", xlabel=style.plain(name), ylabel="probability of failure")
        style.legend_above(ax, fontsize=9)
    return ax
