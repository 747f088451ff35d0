"""The ferry of `jast.simulators.ferry` and its adversary."""

from __future__ import annotations

import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast._src.simulators.ferry import COLLISION, FerryState
from jast._src.simulators.ferry import ferry as ferry_simulator

__all__ = ["ferry"]


def ferry(episode: Episode, sim: Simulator | None = None, ax: Axes | None = None) -> Axes:
    """Both vessels of one ferry `Episode`: their paths with a dot for each step and a number at
    every fifth, and the closest approach.

    Args:
        episode: with its states, or to be replayed on ``sim``.
        sim: its simulator. Default: `jast.simulators.ferry` S0.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for an episode of another system, or for many episodes.

    Example:
        >>> import jax, jast
        >>> ax = jast.plot.ferry(jast.rollout(jax.random.key(0), jast.simulators.ferry()))
    """
    from matplotlib.patches import Circle

    sim = ferry_simulator() if sim is None else sim
    states = style.states_of("ferry", episode, sim, "ferry", FerryState)
    n = int(episode.length)
    paths = [
        np.stack([x, y], -1)[: n + 1]
        for x, y in ((states.ferry_x, states.ferry_y), (states.x, states.y))
    ]
    gaps = np.linalg.norm(paths[0] - paths[1], axis=-1)
    nearest = int(np.argmin(gaps))

    low, high = np.min([p.min(0) for p in paths], 0) - 9, np.max([p.max(0) for p in paths], 0) + 9
    height = np.clip(6.2 * (high - low)[1] / (high - low)[0], 3.0, 8.0) + 0.8

    halo = dict(path_effects=style.halo(), ha="center", va="center")
    with style.axes(ax, (6.2, height)) as ax:
        for path, name, colour, offset in (
            (paths[0], "ferry", style.BLUE, (-4, 9)),
            (paths[1], "adversary", style.VERMILION, (10, -4)),
        ):
            ax.plot(*path.T, color=colour, marker="o", markersize=3, zorder=3)
            ax.plot(*path[0], color=colour, marker="s", markersize=8, zorder=4)
            look = dict(color=colour, path_effects=style.halo(), zorder=6)
            style.note(ax, name, path[0], offset, weight="bold", **look)
            look |= dict(ha="center", va="center")
            for t in range(5, n + 1, 5):
                if abs(t - nearest) < 3:  # room for the closest approach
                    continue
                along = path[t] - path[t - 1]
                # to the right of the way
                side = np.array([along[1], -along[0]]) / max(np.linalg.norm(along), 1e-9)
                style.note(ax, str(t), path[t], side * 11, fontsize=8, **look)
        meet = np.stack([paths[0][nearest], paths[1][nearest]])
        circle = dict(facecolor=style.BLUE, edgecolor=style.BLUE, alpha=0.15, linewidth=1.0)
        ax.add_patch(Circle(tuple(meet[0]), COLLISION, zorder=2, **circle))
        ax.plot(*meet.T, color=style.INK, linewidth=1.4, marker="o", markersize=4, zorder=5)
        # then the number stands on the line, else above the circle
        wide = gaps[nearest] > 3 * COLLISION
        at = meet.mean(0) if wide else meet[0] + [0, COLLISION + 2.5]
        ax.annotate(f"{gaps[nearest]:.2f}", at, weight="bold", zorder=7, **halo)
        gap = f"\nclosest approach {gaps[nearest]:.2f} at step {nearest}"
        words = f"{gap} (circle: radius {COLLISION:g})"
        ax.set_title(style.headline("Ferry", episode, words))
        limits = dict(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ax.set(xlabel="x", ylabel="y", aspect="equal", **limits)
    return ax
