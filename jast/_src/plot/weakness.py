"""Pictures of `jast.weakness`: failures found against calls, and how well the scores tell them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jast._src.core.typing import Array
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast._src.weakness import measures
from jast._src.weakness.result import Result

__all__ = ["checked_result", "failures_found", "roc"]

LIGHT, DARK = "#A9CCE6", "#06263D"  # of the first and the last iteration


def failures_found(
    results: Result | Sequence[Result] | Mapping[str, Any],
    failed: Array | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Failures found against calls of the system, call by call, and beside them the most that can
    be found: each call a failure.

    Args:
        results: a `jast.weakness.Result`, a list of them (several seeds: their mean, and a band
            from the least to the greatest, as far as all of them go), or a dict of name -> either.
        failed: [n] bool: which of all n inputs fail, as only an exhaustive study knows. With it,
            the number of all failures is drawn, and a random choice: its mean, and 2 standard
            deviations (hypergeometric) to both sides.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for what is no result, for results of different n, and for a ``failed`` of
            another shape or type, or that contradicts what the calls found.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> ax = jast.plot.failures_found(found, wrong(inputs) != labels)
    """
    caller = "failures_found"
    words = "a jast.weakness.Result, a list of them or a dict of name -> either"
    rows, every = style.rows_by_name(caller, "results", results, Result, words)
    n, *others = sorted({len(result.scores) for result in every})
    if others:
        received = f"results of {', '.join(map(str, (n, *others)))} inputs"
        raise style.wrong(caller, "results", "be of the same inputs", received)
    truth = None if failed is None else measures.checked_truth(f"plot.{caller}", failed, n)
    for result in () if truth is None else every:
        wrong = int(np.sum(truth[result.order] != _hits(result)))
        if wrong:
            received = f"one that contradicts {wrong} of the {result.calls} calls of one"
            raise style.wrong(caller, "failed", "agree with the results", received)
    counts = {
        name: [np.append(0, np.cumsum(_hits(result))) for result in row]
        for name, row in rows.items()
    }
    width, most = max(1, *(result.calls for result in every)), max(r.failing for r in every)
    total = None if truth is None else int(truth.sum())
    height = 1.12 * max(total or 0, most) or 1.0
    with style.axes(ax, (7.4, 4.2)) as ax:
        labels = []
        if truth is not None:
            labels.append(_chance(ax, total, n, width))
        for i, (name, row) in enumerate(counts.items()):
            labels.append(_found(ax, name, row, i, len(counts) > 1, total))
        _bounds(ax, total, width, height)
        ax.set(xlabel="calls of the system", xlim=(0, width))
        ax.set(ylabel="failures found", ylim=(0, height))
        style.whole_steps(ax.xaxis, ax.yaxis)
        labels.sort(key=lambda label: label[0])
        gap = (0.115 if any("\n" in text for _, text, _ in labels) else 0.065) * height
        places = _apart([at for (at, _), _, _ in labels], gap, 0, height)
        beside = dict(transform=ax.get_yaxis_transform())
        for (_, text, look), y in zip(labels, places, strict=True):
            if "marker" in look:
                key = dict(clip_on=False, linestyle="", markersize=5, label="_key")
                ax.plot([1.025], [y], **beside, **key, **look)
            ax.text(1.045, y, text, color=look["color"], va="center", fontsize=9, **beside)
    return ax


def roc(
    result: Result,
    failed: Array,
    iterations: Sequence[int] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """ROC curves of the scores after several iterations, the darker and thicker the later, each
    with the area under it (figure 4.4 of the thesis).

    R. J. Moss, "Algorithms for Efficient Validation of Black-Box Systems", Stanford, 2021, chapter
    4. Where all inputs fail or none there is no curve, and the area is "-".

    Args:
        result: a `jast.weakness.Result`.
        failed: [n] bool: which of all n inputs fail, which only an exhaustive study knows.
        iterations: which ones, counted from 1 as ``print(result)`` does. Default: up to four,
            evenly, the last one included.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for what is no `jast.weakness.Result`, one without iterations, iterations that
            were not made, and a ``failed`` of another shape or type.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> ax = jast.plot.roc(found, wrong(inputs) != labels)
    """
    caller = "roc"
    made = len(checked_result(caller, result).history.scores)
    truth = measures.checked_truth(f"plot.{caller}", failed, len(result.scores))
    if not made:
        raise ValueError(f"plot.{caller}: result must have iterations, received none")
    evenly = np.linspace(1, made, min(4, made))
    chosen = style.checked_iterations(caller, iterations, evenly, made)
    with style.axes(ax, (4.9, 4.7)) as ax:
        from matplotlib.colors import LinearSegmentedColormap

        shades = LinearSegmentedColormap.from_list("", (LIGHT, style.BLUE, DARK))
        grey = dict(color=style.GREY, ha="center", path_effects=style.halo())
        look = dict(color=style.GREY, linewidth=1.2, linestyle=style.DOTTED, zorder=2)
        ax.plot([0, 1], [0, 1], label="_chance", **look)
        along = dict(rotation=45, rotation_mode="anchor", transform_rotates_text=True)
        ax.text(0.22, 0.205, "chance", va="top", fontsize=9, **along, **grey)
        areas, (first, last) = [], (min(chosen), max(chosen))
        for k in chosen:
            late = (k - first) / (last - first) if last > first else 0.5
            curve = measures.roc(result.history.scores[k - 1], truth)
            areas.append(curve.area)
            label = f"iteration {k}:  AUC {'-' if np.isnan(areas[-1]) else f'{areas[-1]:.3f}'}"
            look = dict(color=shades(late), linewidth=1.2 + 1.2 * late, zorder=3 + late)
            ax.plot(curve.false_positive, curve.true_positive, label=label, **look)
        if truth.all() or not truth.any():
            words = "all inputs fail" if truth.all() else "no input fails"
            ax.text(0.5, 0.55, words, **grey)
        ax.set(xlabel="share of passing inputs flagged (false positives)")
        ax.set(ylabel="share of failures flagged (true positives)")
        ax.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01), aspect="equal")
        place = "upper left" if max(areas) < 0.5 else "lower right"  # beyond the diagonal
        ax.legend(loc=place, fontsize=9, frameon=True, framealpha=0.85, edgecolor="none")
    return ax


def checked_result(caller, result):
    """``result``, or a ValueError where it is none."""
    return style.checked_kind(caller, "result", result, Result, "a jast.weakness.Result")


def _hits(result):
    """[calls] bool: which calls found a failure."""
    return np.isin(result.order, result.failures)


def _found(ax, name, row, i, marked, total):
    """The curve of one result or the mean of several, and its label: ((height at its end, mean
    height), text, look).
    """
    look = dict(color=style.colour(i))
    look |= dict(marker=style.marker(i)) if marked else {}
    counts = np.stack([count[: min(map(len, row))] for count in row])
    calls, last = np.arange(counts.shape[1]), counts[:, -1].mean()
    mean, every = counts.mean(0), (0.03 + 0.03 * i, 0.17) if marked else None
    curve = dict(label=name or "found", linewidth=2, markersize=5, markevery=every, zorder=4)
    ax.plot(calls, mean, **curve, **look)
    if len(row) > 1:
        style.band(ax, calls, counts.min(0), counts.max(0), color=look["color"], zorder=3)
    share = f" ({100 * last / total:.1f} %)" if total else ""
    number = f"{last:,.{1 if len(row) > 1 else 0}f}"
    text = f"{name}: {number}{share}" if name else f"{number} found{share}"
    return (last, mean.mean()), text + (f"\nmean of {len(row)} runs" if len(row) > 1 else ""), look


def _chance(ax, total, n, width):
    """A random choice without repetition, and its label as `_found` gives it."""
    calls = np.unique(np.append(np.linspace(0, n, 400).round(), min(width, n))).astype(int)
    mean = calls * total / n
    half = 2 * np.sqrt(mean * (1 - total / n) * (n - calls) / max(n - 1, 1))
    ends = np.maximum(mean - half, 0), np.minimum(mean + half, total)
    style.band(ax, calls, *ends, color=style.GREY, alpha=0.22, zorder=1.5)
    look = dict(color=style.GREY, linewidth=1.4, linestyle=style.DASHED, zorder=2)
    ax.plot(calls, mean, label="random choice", **look)
    return (width * total / n, -1.0), "random choice, ± 2 sd", dict(color="#6B6B6B")


def _bounds(ax, total, width, height):
    """All failures, where they are known, and a perfect choice."""
    top = height if total is None else total
    look = dict(color=style.INK, linewidth=1.2, linestyle=style.DOTTED, zorder=2.5)
    ax.plot([0, top], [0, top], label="perfect choice", **look)
    small = dict(fontsize=9, color=style.INK, path_effects=style.halo(), zorder=5)
    above = dict(ha="right", va="bottom")
    if total is not None:
        ax.axhline(total, color=style.INK, linewidth=1.0, label="all failures", zorder=2)
        words = {0: "no input fails", 1: "the only failure"}.get(total, f"all {total:,} failures")
        right = ax.get_yaxis_transform()
        style.note(ax, words, (1, total), (0, 3), xycoords=right, **above, **small)
    if total == 0:
        return
    reach = min(top, width)
    if reach > 0.4 * width:  # beside the line, where nothing can be
        place, offset, side = (0.62 * reach, 0.62 * reach), (-6, 2), above
    elif total is None:
        place, offset, side = (reach, height), (6, -2), dict(ha="left", va="top")
    else:
        place, offset, side = (reach, total), (0, 3), dict(ha="left", va="bottom")
    style.note(ax, "perfect choice", place, offset, **side, **small)


def _apart(heights, gap, low, high):
    """Rising heights moved as little as it takes to be at least ``gap`` apart, in low ... high
    where they fit.
    """
    from scipy.optimize import isotonic_regression  # here: slow to import

    apart = gap * np.arange(len(heights))
    level = isotonic_regression(np.asarray(heights, float) - apart).x
    return np.clip(level, low, max(high - apart.max(initial=0), low)) + apart
