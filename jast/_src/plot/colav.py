"""The encounters of `jast.simulators.colav`: where both vessels are, where the ferry believes the
other to be, and what it orders on that.

Positions are in metres, times in seconds from the start; a step is 3 s. Ships are drawn 8 m long,
to be seen: a collision is 1 m between the centres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PathLike
from jast._src.plot import colav_log, style
from jast._src.plot.style import Axes, FuncAnimation
from jast._src.simulators.colav.planner import ZONES
from jast._src.simulators.colav.system import COLLISION
from jast._src.simulators.colav.tracker import PERIOD
from jast._src.simulators.svg_states import HULL, placed
from jast._src.util.checks import number, whole_number

__all__ = ["colav", "colav_animation", "colav_story", "draw_moments"]

BELIEF, ZONE, DASHED = style.GREEN, style.ORANGE, (0, (3, 1.2))
SHADES = ((0.30, "-"), (0.16, "--"), (0.07, ":"))  # of `ZONES`: opacity, edge


def colav(
    episode: Episode,
    sim: Simulator | None = None,
    moments: int | Sequence[int] = 3,
    axes: Sequence[Axes] | None = None,
) -> list[Axes]:
    """One colav `Episode` as the planner saw it, at some moments: a panel each, x east (m), y north
    (m).

    In a panel: the paths so far, the track that the ferry believes (dashed, a thin line from it to
    the truth), the safety zones around the believed adversary, and, in the title, the time and the
    speed that the ferry orders on that picture (at the episode's end: the last order). Ships are
    drawn 8 m long, not to the scale of a collision (1 m).

    Args:
        episode: with its states, or to be replayed on ``sim``.
        sim: its simulator.
        moments: step numbers, or how many: then the last is the closest approach (or the end, where
            that comes too soon for so many), the others are spread evenly before it.
        axes: one for each moment, whose figure gets the title; None: a new figure.

    Raises:
        ValueError: for many episodes, states that are missing or another system's, moments outside
            the episode, and too few axes.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.colav("head-on", substeps=5)
        >>> len(jast.plot.colav(jast.rollout(jax.random.key(0), sim), moments=2))
        2
    """
    return draw_moments("colav", episode, sim, moments, axes, _draw_panel)


def colav_story(
    episode: Episode, sim: Simulator | None = None, axes: Sequence[Axes] | None = None
) -> list[Axes]:
    """One colav `Episode` over time (s): a panel for each kind of disturbance, then the distances
    (m), then the ferry's speed (m/s).

    Steering is the turn (rad/s) on top of the route; noise is the size of its errors in position
    (m) and velocity (m/s).

    Args:
        episode: as for `colav`.
        sim: its simulator. With it the delay is in seconds, else it is a share of the longest.
        axes: one for each panel; None: a new figure.

    Raises:
        ValueError: as `colav`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.colav("head-on", substeps=5)
        >>> len(jast.plot.colav_story(jast.rollout(jax.random.key(0), sim), sim))
        3
    """
    states = colav_log.states_of("colav_story", episode, sim)
    kinds, log = colav_log.by_kind(episode, states, sim), colav_log.log_of(states)
    edges = PERIOD * np.arange(len(states.step))
    count, size = len(kinds) + 2, (7.4, 1.15 + 1.45 * (len(kinds) + 2))
    each = "kind of disturbance, the distances and the speed"
    with style.panels("colav_story", axes, size, count, each) as axes:
        *first, apart, speed = axes
        looks = (
            dict(color=style.INK, linestyle="-"),
            dict(color=style.PURPLE, linestyle=(0, (3, 1))),
        )
        over = dict(baseline=None, linewidth=1.8)
        for ax, (label, rows) in zip(first, kinds.items(), strict=True):
            for (name, values), look in zip(rows.items(), looks, strict=False):
                ax.stairs(values, edges, label=name, zorder=3, clip_on=False, **look, **over)
            ax.axhline(0, color=style.GREY, linewidth=1, zorder=1)
            signed = any((values < 0).any() for values in rows.values())
            ax.set(ylabel=label, ylim=(None if signed else 0, None))
        true, told = (
            np.hypot(*(log.ferry - rows)[:, :2].T) for rows in (log.adversary, log.believed)
        )
        red = dict(color=style.VERMILION, marker="o", markersize=3)
        apart.plot(edges, true, label="to the adversary", **red)
        apart.plot(edges, told, color=BELIEF, linestyle=DASHED, label="to where it is believed")
        look = dict(color=style.INK, linewidth=1, linestyle=":")
        apart.axhline(COLLISION, label=f"collision: {COLLISION:g} m", **look)
        apart.set(ylabel="distance (m)", ylim=(0, None))
        speed.stairs(log.order[:-1], edges, color=style.INK, label="ordered", **over)
        blue = dict(color=style.BLUE, linestyle=DASHED)
        speed.plot(edges, states.velocity.u, label="actual (surge)", **blue)
        speed.set(ylabel="speed (m/s)", xlabel="time (s)")
        for ax in axes:
            ax.set_xlim(0, max(edges[-1], PERIOD))
            if ax.get_legend_handles_labels()[0]:
                ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        axes[0].figure.align_ylabels(axes)
        axes[0].set_title(colav_log.headline(episode, states))
    return axes


def colav_animation(
    episode: Episode,
    sim: Simulator | None = None,
    fps: int = 8,
    path: PathLike | None = None,
    smooth: int = 3,
) -> FuncAnimation:
    """A panel of `colav` that moves. In a notebook: ``HTML(animation.to_jshtml())``.

    Args:
        episode, sim: as for `colav`.
        fps: frames a second.
        path: save it too, as .html, .gif or .mp4.
        smooth: frames a step, between states by straight lines.

    Returns:
        The matplotlib FuncAnimation.

    Raises:
        ValueError: as `colav`, for a path that nothing here can write, and for ``fps`` and
            ``smooth`` that are not positive.

    Example:
        >>> import os, tempfile, jax, jast
        >>> sim = jast.simulators.colav("head-on", substeps=5)
        >>> episode = jast.rollout(jax.random.key(0), sim)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "meeting.gif")
        ...     movie = jast.plot.colav_animation(episode, path=path, smooth=1)
        ...     os.path.exists(path)
        True
    """
    from matplotlib.animation import FuncAnimation
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    states = colav_log.states_of("colav_animation", episode, sim)
    path = style.checked_writable("colav_animation", path)
    number("plot.colav_animation", "fps", fps, lambda v: 0 < v < math.inf, "above 0")
    smooth = whole_number("plot.colav_animation", "smooth", smooth)
    log = colav_log.log_of(states)
    steps = len(states.step) - 1
    low, high = colav_log.limits(log, range(steps + 1))
    with style.styled():
        # an even number of pixels, as films must have
        height = round(40 * (np.clip(4.1 * (high - low)[1] / (high - low)[0], 2.6, 5.0) + 0.9)) / 40
        # not pyplot's: a notebook would show it a second time
        figure = style.frugal_figure()(figsize=(6.6, height), dpi=80, layout="compressed")
        FigureCanvasAgg(figure)
        ax = figure.subplots()
        panel = _Panel(ax, log, low, high)
        panel.show(0)
        ax.set(xlabel="east (m)", ylabel="north (m)")
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # the axes stand still from here on
        times = np.arange(steps * smooth + 1) / smooth
        animation = FuncAnimation(figure, panel.show, times, interval=1000 / fps, blit=False)
        if path is not None and path.suffix.lower() == ".html":
            path.write_text(animation.to_jshtml(fps=fps, default_mode="once"))
        elif path is not None:
            animation.save(path, writer=style.WRITERS[path.suffix.lower()], fps=fps)
    return animation


def draw_moments(caller, episode, sim, moments, axes, draw_panel):
    """The Axes of a panel a moment, each filled by ``draw_panel(ax, log, low, high, t)``: the
    episode's `EncounterLog`, the corners that all panels share, and the step number.
    """
    states = colav_log.states_of(caller, episode, sim)
    log, moments = colav_log.log_of(states), colav_log.checked_moments(caller, moments, states)
    low, high = colav_log.limits(log, moments)
    height = np.clip(3.7 * (high - low)[1] / (high - low)[0], 2.6, 7.0)
    count = len(moments)
    size = (0.7 + 3.7 * count + 2.2, height + 1.45)
    settings = dict(sharey=True, layout="compressed")
    with style.panels(caller, axes, size, count, "moment", count, **settings) as axes:
        for ax, t in zip(axes, moments, strict=True):
            draw_panel(ax, log, low, high, t)
            ax.set_xlabel("east (m)")
        axes[0].set_ylabel("north (m)")
        axes[-1].legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
        axes[0].figure.suptitle(
            colav_log.headline(episode, states) + "\n", x=0.01, ha="left", fontsize=11
        )
    return axes


def _draw_panel(ax, log, low, high, t):
    _Panel(ax, log, low, high).show(t)


class _Panel:
    """A panel of `colav`: its lines and shapes, which `show` puts where they are at a time."""

    def __init__(self, ax, log, low, high):
        self.log, self.title = log, ax.set_title(" ", loc="left")
        look = dict(color=style.GREY, linewidth=1, zorder=1)
        ax.plot([0, 0], [0, 100], label="the ferry's route", **look)

        def line(label, **look):
            return ax.plot([], [], label=label, **look)[0]

        dots = dict(marker="o", markersize=3)
        self.ferry = line("ferry", color=style.BLUE, linewidth=2.4, zorder=4)
        red = dict(color=style.VERMILION, linewidth=1.2, zorder=4)
        self.adversary = line("adversary (a dot a step)", **red, **dots)
        self.believed = line("adversary as believed", color=BELIEF, linestyle=DASHED, zorder=5)
        look = dict(color=style.INK, linewidth=0.8, zorder=7)
        self.error = line("from belief to truth", **look, **dots | dict(markersize=2.5))
        edge = dict(edgecolor=style.INK, linewidth=0.9, zorder=2)
        self.zones = [
            ax.fill([], [], facecolor=(ZONE, opacity), linestyle=line, label=zone.name, **edge)[0]
            for zone, (opacity, line) in zip(ZONES, SHADES, strict=True)
        ]
        ink = dict(linestyle="-", edgecolor=style.INK, linewidth=1)
        looks = (
            dict(facecolor=style.BLUE, **ink),
            dict(facecolor=style.VERMILION, **ink),
            dict(facecolor="none", linestyle=DASHED, edgecolor=BELIEF, linewidth=1.8),
        )
        self.hulls = [ax.fill([], [], zorder=6, **look)[0] for look in looks]
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")

    def show(self, t):
        """The panel ``t`` steps after the start, which need not be whole."""
        now = [colav_log.row_at(rows, t) for rows in self.log[:3]]
        lines = self.ferry, self.adversary, self.believed
        for line, rows, here in zip(lines, self.log[:3], now, strict=True):
            line.set_data(*np.concatenate([rows[: math.ceil(t)], here[None]])[:, :2].T)
        self.error.set_data(*np.stack(now[1:])[:, :2].T)
        for patch, zone in zip(self.zones, ZONES, strict=True):
            east, north, course = now[2]
            patch.set_xy(colav_log.zone_outline(zone, north, east, course))
        for patch, here in zip(self.hulls, now, strict=True):
            patch.set_xy(placed(*HULL.T, *here))
        order = self.log.order[math.floor(t)]
        self.title.set_text(f"t = {t * PERIOD:.0f} s, ordered {order:.2f} m/s")
