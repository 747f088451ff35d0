"""A report of `jast.stress` as a picture: one page to print or to attach."""

from __future__ import annotations

import io
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from jast._src.core.episode import Episode, stacked
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.io.codec import name_of
from jast._src.plot import series, style
from jast._src.plot.episodes import disturbance_fields, shade_deviations
from jast._src.plot.series import DISTANCE, Series
from jast._src.plot.style import Figure
from jast._src.plot.traces import draw_traces
from jast._src.runtime.host_errors import runs_on_host
from jast._src.stress_testing import report_words

if TYPE_CHECKING:
    from jast.stress_testing import Report


__all__ = ["pictures", "report"]

WIDTH = 8.27  # inches: of A4
MARGIN = 0.55  # inches
LINE = 0.185  # inches: of a line of words
MODE = 1.62  # inches: of a failure mode
PANEL = 1.02  # inches: of its panels
FAILURES = 12  # of each mode, behind its likeliest
DOTS = 80  # to the inch, in a notebook
COLOURS = 32  # different ones there: a quarter of the bytes of all colours
MOODS = {"good": style.GREEN, "bad": style.VERMILION, "unknown": style.GREY}


def report(
    report: Report,
    sim: Simulator | None = None,
    *,
    nominal: Episode | int | None = None,
    units: dict[str, Any] | None = None,
) -> Figure:
    """A report on one page: what was found, the probability and whether to believe it, the first
    four modes, what was tried. ``figure.savefig("report.pdf")`` makes a file of it.

    Of each mode there are two numbers of the state, those that leave their nominal bands the most
    (as `traces` draws them), and the disturbances of its likeliest failure in standard deviations
    (as `disturbances` draws them). A black box with a state at each step is called once for each
    mode drawn, and once undisturbed.

    Args:
        report: of `jast.stress`.
        sim: plays the failures again; default: the report's own. Without one (a report from
            `jast.load`) there are no traces, and disturbances are as they are.
        nominal: as of `traces`.
        units: name -> unit, for the labels.

    Returns:
        The matplotlib Figure, as wide as A4.

    Raises:
        ValueError: for anything but a report.

    Example:
        >>> import jax, jast
        >>> found = jast.stress(jax.random.key(0), jast.simulators.walk1d(), 1000)
        >>> figure = jast.plot.report(found)
    """
    import matplotlib.pyplot as plt

    if name_of(report) != "Report":
        raise style.wrong("report", "report", "be of jast.stress", f"a {type(report).__name__}")
    sim = report.sim if sim is None else sim
    shown = report_words.shown_failures(report)
    told = report_words.belief(report.probability)
    left = _probability_rows(told)
    right = _wrapped(report_words.fact_rows(report), 43)
    verdict, mood = report_words.headline(report)
    title = textwrap.wrap(verdict, 72)
    tried = report_words.work_rows(report)
    top = 0.35 + 0.27 * len(title) + 0.15
    facts = max(0.7 + LINE * len(left), LINE * len(right)) + 0.25
    table = LINE * (len(tried) + 2) + 0.3
    modes = 0.45 + MODE * len(shown) if shown else 0.0
    height = MARGIN + top + facts + modes + table + 2 * LINE + MARGIN
    with style.styled():
        figure = plt.figure(figsize=(WIDTH, height))
        page = _Page(figure, height)
        _draw_title(page, title, mood)
        page.y = MARGIN + top
        _draw_probability(page, told, left)
        _draw_rows(page, right, MARGIN + 3.75, 1.0)
        page.y = MARGIN + top + facts
        if shown:
            _draw_modes(page, report, sim, shown, nominal, units)
        page.y = MARGIN + top + facts + modes
        _draw_work(page, report, tried)
        page.y += 0.1
        for line in textwrap.wrap(report_words.advice(report), 100):
            page.words(MARGIN, line, color=style.GREY, fontsize=8.5)
            page.y += LINE
    return figure


def pictures(report: Report) -> list[bytes]:
    """The panels of each of the first modes, as `report` draws them: PNG files. Of a black box,
    which would be called again, they have disturbances alone.
    """
    sim = None if report.sim is None or runs_on_host(report.sim) else report.sim
    shown, files = report_words.shown_failures(report), []
    frugal = style.frugal_figure(COLOURS)
    with style.styled():
        owned = _series_of_modes(report, sim, shown, None) if shown else None
        for k, failure in enumerate(shown):
            # not pyplot's, which would keep it
            page = _Page(frugal(figsize=(WIDTH, MODE + 0.35)), MODE + 0.35)
            page.y = 0.45
            _draw_mode(page, sim, owned, failure, k, None, legend=True)
            page.figure.savefig(file := io.BytesIO(), format="png", dpi=DOTS)
            files.append(file.getvalue())
    return files


class _Page:
    """A figure that is filled from the top, in inches."""

    def __init__(self, figure: Any, height: float):
        self.figure, self.height, self.y = figure, height, MARGIN

    def words(self, x: float, text: str, down: float = 0.0, **look: Any) -> None:
        """``text`` with its upper edge at ``y`` + ``down``."""
        place = x / WIDTH, 1 - (self.y + down) / self.height
        self.figure.text(*place, style.plain(text), va="top", **look)

    def axes(self, x: float, width: float, height: float, down: float = 0.0) -> Any:
        below = 1 - (self.y + down + height) / self.height
        return self.figure.add_axes((x / WIDTH, below, width / WIDTH, height / self.height))


def _draw_title(page: _Page, title: list[str], mood: str) -> None:
    page.words(MARGIN, "jast: adaptive stress test", color=style.GREY, fontsize=9)
    for i, line in enumerate(title):
        page.words(MARGIN, line, 0.22 + 0.27 * i, color=MOODS[mood], fontsize=13.5, weight="bold")


def _probability_rows(told: Any) -> list[tuple[str, str]]:
    rows = [("", told.more)] if told.more else []
    rows += [("!", told.badge)] if told.badge else []
    return _wrapped([*rows, *((">", reason) for reason in told.reasons), *told.facts], 44)


def _wrapped(rows: list, width: int) -> list[tuple[str, str]]:
    """Rows of a name and a line; what goes on has no name."""
    out = []
    for name, words in rows:
        room = width + 14 if name in ("", "!", ">") else width - max(0, len(name) - 12)
        first, *rest = textwrap.wrap(str(words), room) or [""]
        out += [(name, first), *((">" if name == ">" else None, line) for line in rest)]
    return out


def _draw_probability(page: _Page, told: Any, rows: list) -> None:
    page.words(MARGIN, "Probability of failure", weight="bold", fontsize=10.5)
    look = dict(fontsize=19 if len(told.value) < 16 else 13, weight="bold")
    if told.doubt:
        look = dict(color=style.GREY, fontsize=13)
    page.words(MARGIN, told.value, 0.23, **look)
    _draw_rows(page, rows, MARGIN, 1.5, 0.66, told.mood)


def _draw_rows(
    page: _Page, rows: list, x: float, indent: float, down: float = 0.0, mood: str = "unknown"
) -> None:
    """Rows of a name and a line: "!" is a line in the colour of the ``mood``, "" and ">" are lines
    without a name.
    """
    for i, (name, words) in enumerate(rows):
        at = down + LINE * i
        if name == "!":
            page.words(x, words, at, fontsize=9, weight="bold", color=MOODS[mood])
        elif name in ("", ">"):
            page.words(x + 0.1 * (name == ">"), words, at, fontsize=8.5)
        else:
            page.words(x, name or "", at, fontsize=8.5, color=style.GREY)
            page.words(x + indent, words, at, fontsize=8.5)


def _draw_modes(page: _Page, report: Any, sim: Any, shown: list, nominal: Any, units: Any) -> None:
    more = len(report.modes) - len(shown)
    words = f"Failure modes{f' ({len(shown)} of {len(report.modes)})' if more > 0 else ''}"
    page.words(MARGIN, words, weight="bold", fontsize=10.5)
    page.y += 0.45
    owned = _series_of_modes(report, sim, shown, nominal)
    for k, failure in enumerate(shown):
        facts = report_words.mode_facts(report, k, failure)
        words = "   ".join(f"{name} {value}" for name, value in facts)
        colour = style.look(k)[0]
        page.words(MARGIN, f"Mode {k + 1}", -0.12, weight="bold", fontsize=9, color=colour)
        page.words(MARGIN + 0.65, words, -0.12, fontsize=7.5)
        _draw_mode(page, sim, owned, failure, k, units, legend=k == 0)
        page.y += MODE


def _series_of_modes(report: Any, sim: Any, shown: list, nominal: Any) -> tuple | None:
    """What the traces of all modes need; None without a simulator."""
    if sim is None:
        return None
    episodes, mode = _failures(report, sim, shown)
    own, behind = series.series_of(sim, episodes), series.nominal_series("report", sim, nominal)
    return mode, own, behind, series.undisturbed_series(sim)


def _draw_mode(
    page: _Page, sim: Any, owned: tuple | None, failure: Any, k: int, units: Any, legend: bool
) -> None:
    """The panels of mode ``k``."""
    if owned:
        _draw_traces(page, owned, k, units, legend)
    x, wide = MARGIN + 0.45 + (5.1 if owned else 0.0), 1.88 if owned else 5.0
    _draw_disturbances(page.axes(x, wide, PANEL, 0.2), sim, failure)


def _failures(report: Any, sim: Any, shown: list) -> tuple[Episode, np.ndarray]:
    """The likeliest failure of each mode ``shown``, then those that the report has, unless each is
    a call of a black box; and the mode of each.
    """
    more = report.failures[: 64 if series.replays_without_calls(sim) else 0]
    others = np.zeros(len(more), int)
    if report.modes and len(more):
        others = series.samples_of("report", more, sim, report.modes, 64).mode
    return stacked((*shown, *more)), np.concatenate([np.arange(len(shown)), others])


def _draw_traces(page: _Page, owned: tuple, k: int, units: Any, legend: bool) -> None:
    """Two panels of mode ``k``."""
    mode, own, behind, quiet = owned
    rows = np.flatnonzero(mode == k)[: FAILURES + 1]
    part = Series({n: a[rows] for n, a in own.columns.items()}, own.length[rows], own.state)
    names = _most_unusual(part, behind)
    axes = [page.axes(MARGIN + 0.45 + 2.55 * i, 1.88, PANEL, 0.2) for i in range(len(names))]
    kinds = [(np.arange(len(rows)), *style.look(k), f"mode {k + 1}")]
    draw_traces(axes, names, kinds, part, behind, quiet, units)
    for ax in axes:
        _shrink_labels(ax)
    if legend:
        look = dict(fontsize=7, ncols=4, loc="lower right", handlelength=1.6, columnspacing=1.2)
        handles, words = axes[0].get_legend_handles_labels()
        keep = [i for i, word in enumerate(words) if not word.startswith("mode")]
        at = ((WIDTH - MARGIN + 0.1) / WIDTH, 1 - (page.y - 0.2) / page.height)
        page.figure.legend(
            [handles[i] for i in keep], [words[i] for i in keep], bbox_to_anchor=at, **look
        )


def _most_unusual(own: Series, behind: Series | None) -> list[str]:
    """Two numbers, those of the first failure that leave the nominal bands the most."""
    names = series.choose_fields("report", None, own, 1000)
    far = {}
    for name in names:
        values = own.columns[name][0]
        usual = values[None] if behind is None else behind.columns[name]
        there = np.isfinite(values) & np.isfinite(usual).any(axis=0)
        low, middle, high = np.nanquantile(usual[:, there], (0.05, 0.5, 0.95), axis=0)
        spread = max(float((high - low).max()), 1e-9 * float(np.abs(values[there]).max()), 1e-300)
        far[name] = float(np.abs(values[there] - middle).max()) / spread
    best = sorted((n for n in names if n != DISTANCE), key=lambda n: -far[n])[:2]
    best += [DISTANCE] * (len(best) < 2)
    return [n for n in names if n in best]


def _draw_disturbances(ax: Any, sim: Any, failure: Any) -> None:
    """The disturbances of a failure over its steps."""
    about = None if sim is None else signature_of(sim)
    normal = about is not None and about.disturbance.quantile and about.start.quantile
    named = [
        (field.name + place, at, field.values[:, i])
        for field, at in disturbance_fields(sim if normal else None, failure)
        for i, place in enumerate(field.entries)
    ]
    if normal:
        shade_deviations(ax)
    few = len(named) <= len(style.COLOURS)
    for i, (name, at, values) in enumerate(named):
        colour, marker = style.look(i) if few else (style.shade(i / (len(named) - 1)), "o")
        size = 2.5 if few or not at else 0
        look = dict(color=colour, marker=marker, markersize=size, linewidth=1.2 if few else 0.8)
        ax.plot(np.arange(at, at + len(values)), values, label=style.plain(name), **look)
    if few and len(named) > 1:
        ax.legend(fontsize=6.5, loc="best", handlelength=1.2, borderpad=0.1, labelspacing=0.2)
    ax.set_ylabel("disturbance" + " (sd)" * bool(normal))
    _shrink_labels(ax)


def _shrink_labels(ax: Any) -> None:
    ax.set_xlabel("step", fontsize=8, labelpad=1)
    ax.yaxis.label.set_size(8)
    ax.yaxis.labelpad = 2
    ax.tick_params(labelsize=7, pad=1, length=0)
    ax.xaxis.get_major_locator().set_params(integer=True, nbins=5)
    ax.yaxis.get_major_locator().set_params(nbins=5)


def _draw_work(page: _Page, report: Any, rows: list) -> None:
    page.words(MARGIN, "What was tried", weight="bold", fontsize=10.5)
    page.y += 0.27
    head = ("", "calls", "evaluations", "failing", "best log p relative to the mode")
    ends = (MARGIN, MARGIN + 2.4, MARGIN + 3.5, MARGIN + 4.4, WIDTH - MARGIN)
    body = [
        (n, f"{c}", f"{e:,}", f"{f:,}", "-" if b == -np.inf else f"{b:.4f}")
        for n, c, e, f, b in rows
    ]
    body.append(("in all", "", f"{report.episodes:,}", "", ""))
    for i, row in enumerate([head, *body]):
        for j, (x, words) in enumerate(zip(ends, row, strict=True)):
            look = dict(color=style.GREY) if i == 0 else {}
            page.words(x, words, fontsize=8.5, ha="right" if j else "left", **look)
        page.y += LINE
