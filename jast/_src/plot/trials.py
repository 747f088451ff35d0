"""Every evaluation of one or several searches: how near to a failure they came as they went on
(figure 3.7 of Moss's thesis), and all in all (figure 3.8).

They read ``result.trials``, which a search keeps with ``record=True``. Left out are episodes that
were invalid, and those that a tree did not simulate as it had come to their end before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from jast._src.plot import style
from jast._src.plot.style import Axes
from jast._src.search.result import SearchResult
from jast._src.util.checks import one_of

__all__ = ["trial_distances", "trials"]

POINTS = 2000  # of a line: more than a picture has pixels
HORIZON = dict(color=style.INK, linewidth=1, linestyle="--", label="event horizon")  # at 0


def trials(
    results: SearchResult | Mapping[str, SearchResult],
    axes: Sequence[Axes] | None = None,
    mode: Literal["default", "thesis"] = "default",
) -> list[Axes]:
    """Over the simulations of a tree: the mean miss distance so far, the least so far, and how many
    failures so far, a panel each.

    Of several trees each tree's running figure is averaged over the trees, with a light band from
    quartile to quartile; drawn from where every tree has a valid episode.

    Args:
        results: a search result, or a dict of name -> result, searched with ``record=True``.
        axes: three; None: a new figure.
        mode: "thesis" is figure 3.7 of Moss's thesis as printed: a logarithmic axis of simulations,
            distances negated, so that a failure lies above the event horizon at 0, and the band
            about the mean is one standard deviation of the episodes so far (of several trees: its
            mean).

    Raises:
        ValueError: for a result without trials, and another mode.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(
        ...     jax.random.key(0), sim, episodes=500, refine=0, record=True
        ... )
        >>> len(jast.plot.trials(found))
        3
    """
    results, printed = _named("trials", results), _printed("trials", mode)
    with style.panels("trials", axes, (7.2, 7.4), 3, "running figure") as axes:
        for i, (name, result) in enumerate(results.items()):
            distance, _, failure, counts = _columns("trials", result)
            n, trees = distance.shape
            figures = _running(distance, failure, counts)
            if printed:
                figures = -figures[0], -figures[1], figures[2]
                deviation = _deviation(distance, counts).mean(1)
            at = np.unique(np.linspace(0, n - 1, min(n, POINTS)).astype(int))
            colour = style.colour(i)
            label = style.named(name, f"mean of {trees} trees") if trees > 1 else name
            for ax, rows in zip(axes, figures, strict=True):
                rows = rows[at]
                mean = rows.mean(1)
                ax.plot(at + 1, mean, color=colour, label=label, zorder=3)
                if printed and ax is axes[0]:
                    ends = mean - deviation[at], mean + deviation[at]
                    style.band(ax, at + 1, *ends, color=colour, zorder=2)
                elif trees > 1 and not printed:
                    ends = np.quantile(rows, (0.25, 0.75), 1)
                    style.band(ax, at + 1, *ends, color=colour, zorder=2)
        names = ("mean miss distance", "least miss distance", "failures")
        if printed:
            names = ("mean -d", "greatest -d", "failures")
            for ax in axes[:2]:
                ax.axhline(0, **HORIZON)
            for ax in axes:
                ax.set_xscale("log")
        for ax, label in zip(axes, names, strict=True):
            ax.set_ylabel(f"{label} so far")
        axes[2].set(xlabel="simulations of a tree", ylim=(0, None))
        style.whole_steps(axes[2].yaxis)
        axes[0].figure.align_ylabels(axes)
        if any(not line.get_label().startswith("_") for line in axes[0].lines):
            style.legend_above(axes[0])
    return axes


def trial_distances(
    results: SearchResult | Mapping[str, SearchResult],
    bins: int = 60,
    axes: Sequence[Axes] | None = None,
    mode: Literal["default", "thesis"] = "default",
) -> list[Axes]:
    """Histograms over all trees: the miss distances of the episodes, and log p of those that
    failed, a panel each.

    log p depends on the units of the disturbances: compare differences, not ratios.

    Args:
        results: as for `trials`.
        bins: the most of a histogram, shared by the searches.
        axes: two; None: a new figure.
        mode: "thesis" is figure 3.8 of Moss's thesis as printed: distances negated, and the event
            horizon at 0.

    Raises:
        ValueError: as `trials`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(
        ...     jax.random.key(0), sim, episodes=500, refine=0, record=True
        ... )
        >>> len(jast.plot.trial_distances(found))
        2
    """
    of, printed = {}, _printed("trial_distances", mode)
    for name, result in _named("trial_distances", results).items():
        distance, log_p, failure, counts = _columns("trial_distances", result)
        failure = failure & counts
        of[name] = (
            -distance[counts] if printed else distance[counts],
            log_p[failure & np.isfinite(log_p)],
            f"{counts.sum():,} episodes, {failure.sum():,} fail",
        )
    with style.panels("trial_distances", axes, (7.2, 6.4), 2, "histogram", sharex=False) as axes:
        whats = ("-d" if printed else "miss distance", "log p of failures")
        for column, (ax, what) in enumerate(zip(axes, whats, strict=True)):
            if printed and not column:
                ax.axvline(0, **HORIZON)
            every = np.concatenate([rows[column] for rows in of.values()])
            most = min(bins, 5 + every.size // 4) if column else bins
            edges = np.histogram_bin_edges(every, most) if every.size else np.linspace(0, 1, 2)
            for i, (name, rows) in enumerate(of.items()):
                these, colour = rows[column], style.colour(i)
                if not these.size:
                    continue
                share = np.histogram(these, edges)[0] / these.size
                words = f"mean {these.mean():,.1f}" if column else rows[2]
                ax.stairs(share, edges, color=colour, fill=True, alpha=0.15)
                label = style.named(name, words)
                ax.stairs(share, edges, color=colour, linewidth=1.6, label=label)
            ax.set(
                xlabel=what,
                ylabel="share of failures" if column else "share of episodes",
                yscale="linear" if column else "log",
            )  # failures may be rare
            if every.size:
                style.legend_above(ax)
            else:
                look = dict(ha="center", color=style.GREY)
                ax.annotate("none", (0.5, 0.5), xycoords="axes fraction", **look)
    return axes


def _printed(caller, mode):
    """Whether the picture is the thesis's; ValueError for another mode."""
    one_of(f"plot.{caller}", "mode", mode, ("default", "thesis"))
    return mode == "thesis"


def _named(caller, results):
    results = style.by_name(results)
    if not results:
        must = "be a search result, or a dict of name -> result"
        raise style.wrong(caller, "results", must, "an empty dict")
    return results


def _columns(caller, result):
    """Distance, log p, failure and whether the episode counts, [n, trees] each."""
    found = getattr(result, "trials", None)
    if found is None:
        must = "be of searches with record=True"
        raise style.wrong(caller, "results", must, f"a {type(result).__name__} without trials")
    distance, log_p = np.asarray(found.distance, float), np.asarray(found.log_prob, float)
    failure = np.asarray(found.failure, bool)
    if distance.ndim != 2 or not distance.size:
        must = "be arrays [n, trees]"
        raise style.wrong(caller, "trials", must, f"distances of shape {distance.shape}")
    return distance, log_p, failure, np.isfinite(distance) & np.asarray(found.ran, bool)


def _running(distance, failure, counts):
    """Running mean, running least (NaN before the first episode that counts) and number of
    failures, [n, trees] each.
    """
    number = np.cumsum(counts, 0)
    total = np.cumsum(np.where(counts, distance, 0), 0)
    least = np.minimum.accumulate(np.where(counts, distance, np.inf), 0)
    mean = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return mean, np.where(number > 0, least, np.nan), np.cumsum(failure & counts, 0)


def _deviation(distance, counts):
    """Running standard deviation of the distances, [n, trees]; NaN before the first."""
    number = np.cumsum(counts, 0)
    safe = np.maximum(number, 1)
    middle = distance[counts].mean() if counts.any() else 0.0
    centred = np.where(counts, distance - middle, 0)
    square = np.cumsum(centred**2, 0) / safe - (np.cumsum(centred, 0) / safe) ** 2
    return np.where(number > 0, np.sqrt(np.maximum(square, 0)), np.nan)
