"""Pictures of `jast.estimate`: probabilities and their intervals, and whether the weights can be
trusted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jast._src.estimate.estimate import guaranteed_words, is_doubtful
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast.estimate import Estimate, Traces, pareto_k

__all__ = ["probability", "weights"]


def probability(
    estimates: Estimate | Mapping[str, Any], truth: float | None = None, ax: Axes | None = None
) -> Axes:
    """Failure probabilities with their intervals on a logarithmic axis, a row each; an UNRELIABLE
    one is a dashed line and a cross, and named so. Where no failure was seen an arrow points down
    from the upper bound.

    Args:
        estimates: an `Estimate`, or a dict of name -> `Estimate` or list of them, which share a row
            (several seeds).
        truth: the known probability, a vertical line.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for anything else, a truth outside (0, 1], and estimates below the least double.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> ax = jast.plot.probability({"counting": counted})
    """
    caller = "probability"
    words = "an Estimate or a dict of name -> Estimate or list of them"
    rows, found = style.rows_by_name(caller, "estimates", estimates, Estimate, words)
    if any(e.mean == 0 for e in found):
        least = min(e.log10_mean for e in found if e.mean == 0)
        must = "be above the smallest float64"
        raise style.wrong(caller, "estimates", must, f"log10 {least:.4g}")
    if truth is not None and not 0 < truth <= 1:
        raise ValueError(f"plot.{caller}: truth must be above 0 and at most 1, received {truth!r}")
    with style.axes(ax, (7.2, 1.3 + 0.46 * len(rows))) as ax:
        levels = sorted({e.level for e in found})
        interval = f"{levels[0]:.4g} interval" if len(levels) == 1 else "interval"
        if truth is not None:
            look = dict(color=style.INK, linewidth=1.2, linestyle=style.DOTTED)
            ax.axvline(float(truth), label=f"truth {float(truth):.4g}", **look)
        beside = dict(transform=ax.get_yaxis_transform(), va="center", fontsize=9)
        for y, row in enumerate(rows.values()):
            offsets = np.linspace(-0.3, 0.3, len(row)) if len(row) > 1 else np.zeros(1)
            for offset, e in zip(offsets, row, strict=True):
                _row(ax, e, y + offset, interval)
            ax.text(1.02, y, _words(row), **beside)
        ax.set(xscale="log", xlabel="failure probability")
        ax.set(yticks=range(len(rows)), ylim=(len(rows) - 0.5, -0.5))
        ax.set_yticklabels([e.method if name == "" else name for name, (e, *_) in rows.items()])
        ax.tick_params(axis="y", length=0)
        ax.grid(False, axis="y")
        handles, labels = ax.get_legend_handles_labels()
        if handles:
            once = dict(zip(labels, handles, strict=True))
            style.legend_above(ax, once.values(), once, ncols=3, fontsize=9)
    return ax


def weights(traces: Traces, ax: Axes | None = None) -> Axes:
    """The greatest weights of an estimate: the share of the episodes whose weight is above a
    multiple of the mean weight, both axes logarithmic.

    Black over the tail: the Pareto distribution of the shape k-hat (`jast.estimate.pareto_k`)
    through the tail's median. Its slope falls to -1/k-hat: the flatter, the fewer episodes decide;
    above 0.7 no standard error is to be trusted. A failure mode that is missing does not show.

    Args:
        traces: the `Traces` of `jast.estimate.log_weights`, or a dict of name -> `Traces`.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for anything else, and with fewer than 2 failures.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing()
        >>> proposal = jast.estimate.failure_proposal(key, sim, samples=200).policy
        >>> ax = jast.plot.weights(jast.estimate.log_weights(key, sim, proposal, 1000))
    """
    from matplotlib.ticker import LogLocator

    traces = style.by_name(traces)
    with style.axes(ax, (6.8, 3.8)) as ax:
        for i, (name, t) in enumerate(traces.items()):
            if not isinstance(t, Traces) or np.ndim(t.log_weight) != 1:
                must = "be Traces with one leading axis or a dict of them"
                raise style.wrong("weights", "traces", must, type(t).__name__)
            log_w, n = np.asarray(t.log_weight, float)[np.asarray(t.failure)], len(t.failure)
            log_w = np.sort(log_w[np.isfinite(log_w)])[::-1]
            if len(log_w) < 2:
                received = f"{len(log_w)}{f' for {name!r}' if name else ''}"
                raise style.wrong("weights", "traces", "hold at least 2 failures", received)
            k = pareto_k(log_w, n)
            w = np.exp(log_w - log_w[0])
            w, share = w * n / w.sum(), np.arange(1, len(w) + 1) / n
            words = f"k-hat {k:.2f}" + (" UNRELIABLE" if not k <= 0.7 else "")
            # the tail that pareto_k looks at
            m = min(int(np.ceil(min(n / 5, 3 * np.sqrt(n)))), len(w) - 1)
            # evenly along the axis
            few = np.unique(np.geomspace(1, min(4 * m, len(w)), 200).astype(int)) - 1
            look = dict(color=style.colour(i), marker=style.marker(i), linestyle="", markersize=4)
            ax.plot(w[few], share[few], label=style.named(name, words), zorder=3, **look)
            if np.isfinite(k) and w[0] > w[m]:
                x = np.geomspace(w[m], w[0], 100)
                k = k if abs(k) > 1e-6 else 1e-6
                scale = k * (np.median(w[:m]) - w[m]) / (2**k - 1)
                above = np.maximum(1 + k * (x - w[m]) / scale, 0)
                tail = m / n * np.where(above > 0, above, np.nan) ** (-1 / k)
                tail = np.where(tail >= 0.3 / n, tail, np.nan)
                ax.plot(x, tail, color=style.INK, linewidth=1.2, zorder=4)
        words = "weight over the mean weight", "share of episodes above it"
        ax.set(xscale="log", yscale="log", xlabel=words[0], ylabel=words[1])
        ax.yaxis.set_major_locator(LogLocator(numticks=8))
        style.legend_above(ax, fontsize=9)
    return ax


def _row(ax, e, y, interval):
    """One estimate at the height ``y``."""
    low, high = e.interval
    if np.isnan(e.mean):  # an upper bound is all that is known
        if high < 1:
            look = dict(color=style.PURPLE, linestyle="", marker=8, markersize=9, zorder=3)
            ax.plot(high, y, label="no failure seen: upper bound", **look)
        return
    look = dict(color=style.VERMILION, linestyle=(0, (2, 1.5)))
    marker, label = "X", "UNRELIABLE"
    if e.reliable:
        look = dict(color=style.BLUE, linestyle="-")
        marker, label = "o", f"estimate, {interval}"
    ends = [max(low, np.finfo(float).tiny), high]
    # with caps that stand out of the dot, which is wider than a good interval
    ax.plot(ends, [y, y], **look, linewidth=1.6, marker="|", markersize=11, zorder=3)
    look |= dict(marker=marker, markersize=6, markeredgecolor="white", markeredgewidth=0.7)
    ax.plot(e.mean, y, **look, label=label, zorder=4)


def _words(row):
    """What stands beside a row."""
    bad = sum(not e.reliable for e in row if not np.isnan(e.mean))
    if len(row) > 1:
        return f"{bad} of {len(row)} UNRELIABLE" if bad else f"{len(row)} runs"
    [e] = row
    if (known := guaranteed_words(e)) is not None:
        doubt = "" if np.isnan(e.mean) else f"{e.mean:.3g}  " * is_doubtful(e) + "UNRELIABLE"
        return "\n".join(filter(None, (known[0], doubt)))
    if np.isnan(e.mean):
        return f"below {e.interval[1]:.3g}" if e.interval[1] < 1 else "no failure seen"
    return f"{e.mean:.3g}  " + ("UNRELIABLE" if bad else f"SE {100 * e.relative_error:.2g} %")
