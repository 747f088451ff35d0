"""The view of S1 in figures 2 and 3 of Lytskjold and Mengshoel, of `jast.simulators.colav`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.plot import style
from jast._src.plot.colav import draw_moments
from jast._src.plot.colav_log import zone_outline
from jast._src.plot.style import Axes
from jast._src.simulators.colav.planner import ZONES
from jast._src.simulators.colav.tracker import PERIOD

__all__ = ["colav_published"]

RED, BROWN, YELLOW = style.VERMILION, "#8C564B", "#F0E442"  # yellow is Okabe and Ito's, too
# of `ZONES`, the innermost first: the paper names the colours, which zone has which is our reading
ZONE_EDGES = ((RED, "-"), (style.GREEN, "--"), (style.BLUE, ":"))
HEADING = 15.0  # m: length of the line for the perceived heading; a convention


def colav_published(
    episode: Episode,
    sim: Simulator | None = None,
    moments: int | Sequence[int] = 3,
    axes: Sequence[Axes] | None = None,
) -> list[Axes]:
    """One colav `Episode` in the view of figures 2 and 3 of Lytskjold and Mengshoel: a panel a
    moment, x east (m), y north (m). ``moments=1`` of an encounter is figure 2; three moments of the
    likeliest failure under delays are figure 3.

    The ferry is a red circle with its path as a tail, over the dashed blue line of its desired
    path. The adversary's path is brown, a square where it is. The brown circle is where the ferry
    perceives it, with a yellow line for the perceived heading and the three safety zones, in red,
    green and blue from the innermost, around it. `colav` shows the same with ships and orders.

    Args:
        episode: with its states, or to be replayed on ``sim``.
        sim: its simulator.
        moments: step numbers, or how many, as for `colav`.
        axes: one for each moment, whose figure gets the title; None: a new figure.

    Returns:
        The list of Axes.

    Raises:
        ValueError: as `colav`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.colav("sharp turn", substeps=5)
        >>> episode = jast.rollout(jax.random.key(0), sim)
        >>> len(jast.plot.colav_published(episode, moments=1))  # figure 2
        1
    """
    return draw_moments("colav_published", episode, sim, moments, axes, _draw_panel)


def _draw_panel(ax, log, low, high, t):
    """Everything of a panel at step ``t``: both paths, and what is perceived."""
    east, north, course = log.believed[t]
    ahead = HEADING * np.array([np.sin(course), np.cos(course)])
    at_end = dict(markevery=[-1], markersize=9)
    circle = dict(marker="o", markeredgecolor=style.INK, markersize=9, linestyle="none")
    ax.plot([0, 0], [0, 100], color=style.BLUE, linestyle="--", label="the ferry's desired path")
    for rows, name, colour, marker in (
        (log.ferry, "ferry, its path", RED, "o"),
        (log.adversary, "adversary, its path", BROWN, "s"),
    ):
        ax.plot(*rows[: t + 1, :2].T, color=colour, marker=marker, label=name, **at_end)
    heading = ([east, east + ahead[0]], [north, north + ahead[1]])
    ax.plot(*heading, color=YELLOW, linewidth=3, label="perceived heading")
    ax.plot(east, north, color=BROWN, label="perceived position", **circle)
    for zone, (colour, line) in zip(ZONES, ZONE_EDGES, strict=True):
        outline = zone_outline(zone, north, east, course).T
        ax.fill(*outline, facecolor="none", edgecolor=colour, linestyle=line, label=zone.name)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.set_title(f"t = {t * PERIOD:.0f} s", loc="left")
