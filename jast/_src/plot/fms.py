"""Routes of `jast.simulators.fms`: the path on a map, and the turn that is furthest from what the
predictor says of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast._src.simulators.fms.database import FIXES, KLAX, KSFO
from jast._src.simulators.fms.events import EVENTS, FOOT, extent
from jast._src.simulators.fms.geodesic import direct, inverse
from jast._src.simulators.fms.lateral import NMI
from jast._src.simulators.fms.system import fms_path

__all__ = ["fms"]

POINTS = 181  # on an arc
LEGS = dict(color=style.GREY, linewidth=0.9, linestyle=style.DASHED, zorder=2)  # below the path
QUESTIONED = dict(color=style.VERMILION, linewidth=2.6)  # the arc in question
UNITS = {"arc length": "", "kink": " rad", "disconnection": " ft", "course": " rad"}


def fms(episode: Episode, sim: Simulator, axes: Sequence[Axes] | None = None) -> list[Axes]:
    """One `Episode` of an fms simulator: the route on a map (left; degrees), and the turn with the
    largest error of its arc, enlarged (right; nmi from its waypoint). Where the defect acted, it is
    the second of the turns that overlap.

    The path is blue, the arc in question vermilion: from the direction of its start s around its
    centre c to its end e, as its packet says; dashed, the turn as it was built. Grey: the legs, and
    on the map the beacons of `jast.simulators.fms.FIXES` for orientation. Needs float64, as the
    simulator does.

    Args:
        episode: one.
        sim: its simulator.
        axes: two; None: a new figure.

    Raises:
        ValueError: for another system's simulator, for many episodes, and for fewer than two axes.

    Example:
        >>> import jax, jast
        >>> with jax.enable_x64(True):
        ...     sim = jast.simulators.fms(waypoints=4)
        ...     len(jast.plot.fms(jast.rollout(jax.random.key(0), sim), sim))
        2
    """
    style.one_episode("fms", episode)
    path = fms_path(sim, episode)
    model = sim.init.args[0]
    drawn = *_arcs(model.build.earth, path, model.event), path
    arcs, built, error, event, path = jax.device_get(drawn)
    path = jax.tree.map(lambda a: a[: _count(path, a)], path)
    n = len(path.waypoints) - 2
    size = (11.5, 6.3)
    with style.panels("fms", axes, size, 2, "the map and the turn", 2, sharex=False) as axes:
        worst = None
        if n:
            acted = path.skipped[:n] | ((np.arange(n) == n - 1) & path.skipped[n])
            worst = int(np.argmax(np.where(acted | ~acted.any(), error[:n], -1)))
        _map(axes[0], path, arcs, worst)
        if worst is not None:
            _turn(axes[1], path, arcs, built, worst, error[worst] / FOOT)
        words = f"\n{model.event}: miss distance {float(event):,.5g}{UNITS[model.event]}"
        axes[0].set_title(style.headline("Predicted path", episode, words))
    return axes


def _count(path, a):
    """How many rows of a leaf of the path belong to the waypoints that were placed: the destination
    follows the last one.
    """
    placed = int(np.flatnonzero(path.legs > 0)[-1]) if (path.legs > 0).any() else 0
    return placed + len(a) - len(path.turn)


@partial(jax.jit, static_argnums=2)
def _arcs(earth, path, event):
    """Points on the arcs as their packets say and as they were built, both [T, POINTS, 2]; errors
    of their stated lengths [T] (m); the miss distance.
    """
    angle, radius = extent(earth, path), jnp.abs(path.radius)
    _, at_start, _ = inverse(earth, path.centre, path.start)
    _, at_end, _ = inverse(earth, path.centre, path.end)
    share = jnp.linspace(0.0, 1.0, POINTS)[None]
    sense, centres = jnp.sign(path.radius)[:, None], jnp.repeat(path.centre[:, None], POINTS, 1)

    def around(azimuth):
        return direct(earth, centres, azimuth, jnp.broadcast_to(radius[:, None], azimuth.shape))[0]

    flown = around(at_start[:, None] + sense * angle[:, None] * share)
    built = around(at_end[:, None] - sense * jnp.abs(path.turn)[:, None] * (1 - share))
    error = jnp.where(path.arc, jnp.abs(path.beta - angle * radius), 0)
    return flown, built, error, EVENTS[event](earth, path)


def _line(path, arcs):
    """The whole path as points (latitude, longitude), from KSFO to KLAX."""
    parts = [path.waypoints[:1]]
    for i, arc in enumerate(arcs[: len(path.turn)]):
        end = path.end[i : i + 1]
        parts += [path.start[i : i + 1], arc if path.arc[i] else end, end]
    return np.concatenate([*parts, path.waypoints[-1:]])


def _map(ax, path, arcs, worst):
    places = path.waypoints
    low, high = places.min(0) - 0.5, places.max(0) + 0.5
    for name, (latitude, longitude) in FIXES.items():
        ax.plot(longitude, latitude, "^", color="#C8C8C8", markersize=4, zorder=1)
        look = dict(color="#B4B4B4", fontsize=6.5, zorder=1, annotation_clip=True)
        style.note(ax, name, (longitude, latitude), (3, 3), **look)
    ax.plot(*places.T[::-1], label="legs", **LEGS)
    ax.plot(*_line(path, arcs).T[::-1], color=style.BLUE, label="predicted path", zorder=3)
    ax.plot(*places[1:-1].T[::-1], "o", color=style.INK, markersize=3.5, zorder=4)
    if worst is not None:
        label = "arc with the largest error"
        ax.plot(*arcs[worst].T[::-1], label=label, zorder=5, **QUESTIONED)
    above = dict(path_effects=style.halo(), zorder=7)
    for group in _groups(places[1:-1]):
        numbers = ", ".join(str(i + 1) for i in group)
        style.note(ax, numbers, places[group[0] + 1][::-1], (6, 5), fontsize=8, **above)
    for name, (latitude, longitude) in (("KSFO", KSFO), ("KLAX", KLAX)):
        ax.plot(longitude, latitude, "s", color=style.GREEN, markersize=8, zorder=6)
        look = dict(color=style.GREEN, weight="bold", **above)
        style.note(ax, name, (longitude, latitude), (9, 5), **look)
    ax.set(xlabel="longitude (degrees)", ylabel="latitude (degrees)")
    _frame(ax, low[::-1], high[::-1], np.cos(np.radians((low[0] + high[0]) / 2)))
    ax.legend(loc="best", fontsize=9)


def _groups(points):
    """Indices of the points, those within .12 degrees of a first one together: their numbers share
    a label.
    """
    groups = []
    for i, point in enumerate(points):
        near = [group for group in groups if np.hypot(*(points[group[0]] - point)) < 0.12]
        near[0].append(i) if near else groups.append([i])
    return groups


def _frame(ax, low, high, narrow=1.0):
    """A square frame around (x, y) from ``low`` to ``high``, in which a unit of x is ``narrow`` as
    long as one of y.
    """
    scale = np.array([narrow, 1.0])
    middle, half = (low + high) / 2, max((high - low) * scale) / 2 / scale
    ends = np.stack([middle - half, middle + half])
    ax.set(xlim=ends[:, 0], ylim=ends[:, 1], aspect=1 / narrow)


def _turn(ax, path, arcs, built, i, error):
    origin = path.waypoints[i + 1]
    narrow = [np.cos(np.radians(origin[0])), 1]

    def plane(points):
        """(east, north) in nmi"""
        return ((np.asarray(points) - origin) * 60)[..., ::-1] * narrow

    ax.plot(*plane(path.waypoints).T, **LEGS)
    ax.plot(*plane(_line(path, arcs)).T, color=style.BLUE, zorder=3)
    look = dict(color=style.GREEN, linestyle=(0, (3, 1.5)), linewidth=1.6)
    ax.plot(*plane(built[i]).T, label="as it was built", zorder=5, **look)
    ax.plot(*plane(arcs[i]).T, label="as its packet says", zorder=4, **QUESTIONED)
    centre = plane(path.centre[i])
    away = plane(path.start[i]) - centre
    # s is named outside of the circle, e inside, so that the names stay apart where s and e are
    # near
    away = 13 * away / max(np.hypot(*away), 1e-9)
    red = dict(color=style.VERMILION)
    for name, point, offset in (
        ("s", path.start[i], away),
        ("e", path.end[i], -away),
        ("c", path.centre[i], -away),
    ):
        here = plane(point)
        if name != "c":
            ax.plot(*np.stack([centre, here]).T, linewidth=0.8, linestyle=":", zorder=3, **red)
        ax.plot(*here, "o" if name != "c" else "+", markersize=7, zorder=6, **red)
        look = dict(ha="center", va="center", weight="bold", path_effects=style.halo())
        style.note(ax, name, here, offset, zorder=8, **look, **red)
    ax.plot(*plane(path.waypoints[1:-1]).T, "o", color=style.INK, markersize=4.5, zorder=7)
    turns = range(max(i - 1, 0) if path.skipped[i] else i, i + 1)
    corners = plane([path.start[i], path.end[i], path.centre[i], origin])
    shown = np.concatenate([*(plane(arcs[j]) for j in turns), plane(built[i]), corners])
    low, high = shown.min(0), shown.max(0)
    margin = 0.15 * max(*(high - low), 0.1)
    apart = path.legs[i] / FOOT
    gap = f"{path.legs[i] / NMI:,.1f} nmi"
    if apart < 3000:
        gap = f"{apart:,.{0 if apart > 10 else 1}f} ft"
    stated = f"stated {path.beta[i] / NMI:.2f} nmi, error {error:,.0f} ft"
    if error < 1e3:
        stated = f"stated length {path.beta[i] / NMI:.3f} nmi, error {error:,.2f} ft"
    title = f"Turn at waypoint {i + 1}, {gap} behind {i if i else 'KSFO'}\n{stated}"
    ax.set_title(title + "\nthe leg between was not fitted" * bool(path.skipped[i]))
    ax.set(xlabel="east (nmi)", ylabel="north (nmi)")
    _frame(ax, low - margin, high + margin)
    ax.legend(loc="best", fontsize=9, title="the arc")
