"""The exceedance curve of an estimate: how probable it is that an episode comes so near."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jast._src.plot import style
from jast._src.plot.style import Axes
from jast.estimate import Estimate, Exceedance
from jast.estimate import exceedance as curve_of

__all__ = ["exceedance"]


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
    caller = "plot.exceedance"
    named = curves if isinstance(curves, dict) else {None: curves}
    if not named or not all(isinstance(c, Exceedance | Estimate) for c in named.values()):
        received = sorted({type(c).__name__ for c in named.values()}) or "none"
        raise ValueError(
            f"{caller}: curves must be an Exceedance, an Estimate or a dict of name -> either,"
            f" received {received}"
        )
    named = {k: curve_of(c) if isinstance(c, Estimate) else c for k, c in named.items()}
    if not all(np.isfinite(c.probability).any() for c in named.values()):
        raise ValueError(f"{caller}: curves must hold at least one probability, received only NaN")
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
