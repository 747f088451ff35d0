"""What the pictures share: colours, settings of matplotlib, panels, and what is drawn in many."""

from contextlib import contextmanager
from io import BytesIO
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any, NewType

import numpy as np

from jast._src.core.episode import Episode, replay
from jast._src.util import checks

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:  # they are imported when something is drawn
    Axes, Figure, FuncAnimation = (
        NewType(name, object) for name in ("Axes", "Figure", "FuncAnimation")
    )

__all__ = [
    "Axes",
    "BLUE",
    "COLOURS",
    "DASHED",
    "DOTTED",
    "Figure",
    "FuncAnimation",
    "GREEN",
    "GREY",
    "INK",
    "MARKERS",
    "ORANGE",
    "PURPLE",
    "STYLE",
    "VERMILION",
    "WRITERS",
    "axes",
    "band",
    "by_name",
    "checked_iteration",
    "checked_iterations",
    "checked_kind",
    "checked_kinds",
    "checked_writable",
    "colour",
    "count_of",
    "frugal_figure",
    "halo",
    "headline",
    "labelled",
    "legend_above",
    "look",
    "marker",
    "named",
    "note",
    "one_episode",
    "panels",
    "plain",
    "rows_by_name",
    "shade",
    "states_of",
    "styled",
    "unframed",
    "whole_steps",
    "wrong",
]

BLUE, VERMILION, GREEN, PURPLE, ORANGE, _ = COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
)
INK, GREY = "#222222", "#8A8A8A"
DASHED, DOTTED = (0, (4, 2)), (0, (1, 1.5))
MARKERS = ("o", "s", "^", "D", "v", "P")
STYLE: dict[str, Any] = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.titlepad": 10,
    "axes.labelcolor": INK,
    "text.color": INK,
    "axes.edgecolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.8,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "figure.dpi": 110,
}
# an animation's suffix: what writes it
WRITERS = {".mp4": "ffmpeg", ".gif": "pillow", ".html": "html"}


@contextmanager
def axes(given, size, rows=1, columns=1, **settings):
    """The given axes, or those of a new figure with ``settings`` of `matplotlib.pyplot.subplots`;
    the style of these pictures while drawing.
    """
    import matplotlib.pyplot as plt

    with styled():
        if given is None:
            settings = dict(sharex=True, layout="constrained") | settings
            given = plt.subplots(rows, columns, figsize=size, **settings)[1]
        for each in np.ravel(np.asarray(given, object)):
            if not callable(getattr(each, "get_xlim", None)):
                raise ValueError(f"plot: ax must be Axes of matplotlib, received {each!r:.80}")
        yield given


@contextmanager
def panels(caller, given, size, count, each, columns=1, **settings):
    """The first ``count`` of the given axes, one for ``each``, or of a new figure's with so many
    ``columns``, as a list; ValueError where fewer are given. ``settings``: of `axes`.
    """
    with axes(given, size, -(-count // columns), columns, **settings) as drawn:
        drawn = np.atleast_1d(np.asarray(drawn, object)).ravel().tolist()
        if len(drawn) < count:
            raise wrong(caller, "axes", f"be at least {count}, one for each {each}", len(drawn))
        for spare in drawn[count:] if given is None else ():
            spare.set_axis_off()
        yield drawn[:count]


@contextmanager
def styled():
    """The style of these pictures. Only what it sets is put back: `rc_context` would also undo what
    a notebook sets when it makes its first figure.
    """
    from matplotlib import rcParams

    before = {name: rcParams[name] for name in STYLE}
    rcParams.update(STYLE)
    try:
        yield
    finally:
        rcParams.update(before)


def halo():
    """A white rim, so that a word stays legible on a line."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=3, foreground="white")]


def headline(what, episode, more=""):
    """What happened, and the numbers that identify the episode."""
    outcome = "failure at step" if episode.failure else "no failure, steps:"
    return (
        f"{what}: {outcome} {int(episode.length)}\nreward {float(episode.reward):.3f},  log p"
        f" {float(episode.log_prob):.3f}{more}"
    )


def one_episode(caller, episode):
    """``episode``, or a ValueError where it is not one `Episode`."""
    if not isinstance(episode, Episode) or np.ndim(episode.length):
        received = type(episode).__name__ + (
            f" with leading axes {np.shape(episode.length)}" if isinstance(episode, Episode) else ""
        )
        raise ValueError(f"plot.{caller}: episode must be one Episode, received {received}")
    return episode


def states_of(caller, episode, sim, system, kind):
    """The states of one episode of the ``system`` of `jast.simulators`, replayed on ``sim`` where
    it has none; a ValueError where they are not of the ``kind`` of that system.
    """
    states = one_episode(caller, episode).states
    states = replay(sim, episode).states if states is None else states
    if not isinstance(states, kind):
        must = f"be of jast.simulators.{system}"
        raise wrong(caller, "episode", must, f"states of {type(states).__name__}")
    return states


def wrong(caller, name, must, received):
    """The ValueError of `plot.caller` whose argument ``name`` must be something else."""
    return checks.wrong(f"plot.{caller}", name, must, received)


def checked_kind(caller, name, value, kind, words):
    """``value``, the argument ``name``, or a ValueError where it is no ``kind``; ``words`` say what
    it must be.
    """
    return checks.instance(f"plot.{caller}", name, value, kind, words)


def checked_kinds(caller, name, values, kind, words):
    """ValueError, as of `checked_kind`, unless there are ``values`` and all are of the ``kind``."""
    values = list(values)
    if not values or not all(isinstance(v, kind) for v in values):
        received = sorted({type(v).__name__ for v in values if not isinstance(v, kind)}) or "none"
        raise ValueError(f"plot.{caller}: {name} must be {words}, received {received}")


def checked_iteration(caller, name, k, run):
    """``k``, the argument ``name``, as an int, or a ValueError where that iteration of ``run`` was
    not run.
    """
    try:
        number = index(k)
    except TypeError:
        number = 0
    if isinstance(k, bool) or not 1 <= number <= run:
        raise ValueError(f"plot.{caller}: {name} must be in 1 .. {run}, received {k!r}")
    return number


def checked_iterations(caller, given, default, run):
    """The iterations ``given``, or ``default`` where None, as a list of ints of 1 .. ``run``."""
    wanted = np.unique(default.round().astype(int)) if given is None else given
    wanted = np.atleast_1d(np.asarray(wanted, object))
    chosen = [checked_iteration(caller, "iterations", k, run) for k in wanted]
    if not chosen:
        raise ValueError(f"plot.{caller}: iterations must name at least one, received none")
    return chosen


def plain(text):
    """A user's words, in which no "$" begins a formula."""
    return str(text).replace("$", r"\$")


def labelled(name, units):
    """A label: the name of a number with its unit, that of its array where it has none."""
    array = name.partition("[")[0]
    unit = (units or {}).get(name, (units or {}).get(array))
    return plain(f"{name} ({unit})" if unit else name)


def look(i):
    """The colour and the marker of the kind number ``i``; grey from the seventh on."""
    return (COLOURS[i], MARKERS[i]) if i < len(COLOURS) else (GREY, "x")


def colour(i):
    """The colour of the result number ``i``, of which there may be more than colours."""
    return COLOURS[i % len(COLOURS)]


def marker(i):
    """Its marker."""
    return MARKERS[i % len(MARKERS)]


def by_name(results):
    """A dict of name -> result; one result has the name ""."""
    return results if isinstance(results, dict) else {"": results}


def rows_by_name(caller, name, results, kind, words):
    """The argument ``name``, one result, a list of them or a dict of name -> either, as a dict of
    name -> list, and all in it; ValueError as of `checked_kinds`. A result may be a tuple, so a
    tuple is no list here.
    """
    rows = by_name(results)
    rows = {key: row if isinstance(row, list) else [row] for key, row in rows.items()}
    every = [result for row in rows.values() for result in row]
    checked_kinds(caller, name, every if all(rows.values()) else (), kind, words)
    return rows, every


def named(name, words):
    """``words`` behind the name of their result, if it has one."""
    return f"{name}: {words}" if name else words


def count_of(number, noun):
    """ "1 episode", "2,000 episodes"."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def band(ax, x, low, high, **look):
    """What lies between two lines, in the light colour of the line that it belongs to."""
    ax.fill_between(x, low, high, **dict(alpha=0.2, linewidth=0) | look)


def legend_above(ax, *what, ncols=2, **look):
    """A legend above the axes, from their left."""
    ax.legend(*what, loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=ncols, **look)


def whole_steps(*axes):
    """Ticks at whole numbers of these axes, such as ``ax.xaxis``."""
    for axis in axes:
        axis.get_major_locator().set_params(integer=True)


def note(ax, text, place, offset, **look):
    """``text`` so many points from a place of the data."""
    ax.annotate(text, place, offset, textcoords="offset points", **look)


def unframed(ax):
    """The axes of an image: no ticks and no grid."""
    ax.set(xticks=[], yticks=[])
    ax.grid(False)


def frugal_figure(colours=256):
    """A `Figure` whose PNGs have so many colours: 256 are all that one needs, and a third of the
    bytes in an animation's HTML.
    """
    from matplotlib.figure import Figure
    from PIL import Image

    class Frugal(Figure):
        def savefig(self, fname, **settings):
            if settings.get("format") != "png":
                return super().savefig(fname, **settings)
            super().savefig(whole := BytesIO(), **settings)
            Image.open(whole).convert("RGB").quantize(colours).save(fname, "png", optimize=True)

    return Frugal


def shade(u):
    """A colour for u in [0, 1]."""
    import matplotlib

    return matplotlib.colormaps["cividis"](u)


def checked_writable(caller, path):
    """``path`` as a `Path`, or a ValueError where nothing here can write it."""
    from matplotlib.animation import writers

    able = [suffix for suffix, writer in WRITERS.items() if writers.is_available(writer)]
    if path is not None and Path(path).suffix.lower() not in able:
        must = f"end in one of {able}, which can be written here"
        raise wrong(caller, "path", must, f"{str(path)!r}")
    return None if path is None else Path(path)
