"""Pictures of episodes and searches, with matplotlib (the extra ``jast[plot]``), which is imported only when something is drawn.

Every function draws into the ``ax`` it is given, or into a new figure, and returns the axes. The colours are Okabe and Ito's, told apart by colour-blind
readers; what matters is told by shape or words as well.
"""

from contextlib import contextmanager

import jax
import numpy as np

from jast.episode import Episode, replay
from jast.simulators.ferry import COLLISION, FerryState
from jast.simulators.ferry import ferry as ferry_simulator

__all__ = ["disturbances", "distances", "ferry", "history"]

BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, GREY = "#222222", "#8A8A8A"
STYLE = {
    "font.size": 10, "axes.titlesize": 11, "axes.titlelocation": "left", "axes.titlepad": 10, "axes.labelcolor": INK, "text.color": INK, "axes.edgecolor": GREY,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True, "grid.color": "#E6E6E6", "grid.linewidth": 0.8,
    "xtick.color": GREY, "ytick.color": GREY, "xtick.labelcolor": INK, "ytick.labelcolor": INK, "legend.frameon": False, "lines.linewidth": 1.8,
    "figure.dpi": 110,
}  # fmt: skip


def ferry(episode, sim=None, ax=None):
    """Both vessels of one ferry `Episode`: their paths with a dot a step and a number every fifth, and the closest approach.

    The states are those of the episode, or of its replay on ``sim`` (default: `jast.simulators.ferry` S0). Returns the Axes. ValueError for an episode of
    another system or for many episodes.
    """
    states = _one("ferry", episode).states
    if states is None:
        states = replay(ferry_simulator() if sim is None else sim, episode).states
    if not isinstance(states, FerryState):
        raise ValueError(f"plot.ferry: episode must be of jast.simulators.ferry, received states of {type(states).__name__}")
    n = int(episode.length)
    paths = [np.stack([x, y], -1)[: n + 1] for x, y in ((states.ferry_x, states.ferry_y), (states.x, states.y))]
    gaps = np.linalg.norm(paths[0] - paths[1], axis=-1)
    nearest = int(np.argmin(gaps))

    low, high = np.min([p.min(0) for p in paths], 0) - 9, np.max([p.max(0) for p in paths], 0) + 9
    height = np.clip(6.2 * (high - low)[1] / (high - low)[0], 3.0, 8.0) + 0.8

    with _axes(ax, (6.2, height)) as ax:
        for path, name, colour, offset in ((paths[0], "ferry", BLUE, (-4, 9)), (paths[1], "adversary", VERMILION, (10, -4))):
            ax.plot(*path.T, color=colour, marker="o", markersize=3, zorder=3)
            ax.plot(*path[0], color=colour, marker="s", markersize=8, zorder=4)
            ax.annotate(name, path[0], offset, textcoords="offset points", color=colour, weight="bold", path_effects=_halo(), zorder=6)
            for t in range(5, n + 1, 5):
                if abs(t - nearest) < 3:  # room for the closest approach
                    continue
                along = path[t] - path[t - 1]
                side = np.array([along[1], -along[0]]) / max(np.linalg.norm(along), 1e-9)  # to the right of the way
                place = dict(textcoords="offset points", ha="center", va="center")
                ax.annotate(str(t), path[t], side * 11, **place, color=colour, fontsize=8, path_effects=_halo(), zorder=6)
        meet = np.stack([paths[0][nearest], paths[1][nearest]])
        ax.add_patch(_circle(meet[0], COLLISION))
        ax.plot(*meet.T, color=INK, linewidth=1.4, marker="o", markersize=4, zorder=5)
        wide = gaps[nearest] > 3 * COLLISION  # then the number stands on the line, else above the circle
        at = meet.mean(0) if wide else meet[0] + [0, COLLISION + 2.5]
        ax.annotate(f"{gaps[nearest]:.2f}", at, ha="center", va="center", weight="bold", path_effects=_halo(), zorder=7)
        _title(ax, "Ferry", episode, f"\nclosest approach {gaps[nearest]:.2f} at step {nearest} (circle: radius {COLLISION:g})")
        ax.set(xlabel="x", ylabel="y", xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    return ax


def history(results, ax=None, total=False):
    """How the best reward grew with the episodes of a tree: the mean over trees with its 95 % band, and (dashed) the best over trees.

    ``total=True``: the best over trees with the episodes of all trees, by which searches of different numbers of trees compare.

    ``results``: a search result, or a dict of name -> result, whose ``history`` has ``simulations`` [C] and ``best_reward`` [C, trees]. Returns the Axes.
    """
    from matplotlib.ticker import EngFormatter

    results = results if isinstance(results, dict) else {"": results}
    with _axes(ax, (6.8, 4.2)) as ax:
        means, bests = [], []
        for i, (name, result) in enumerate(results.items()):
            episodes, best = np.asarray(result.history.simulations), np.asarray(result.history.best_reward, float)
            best = np.where(np.isfinite(best), best, np.nan)  # no valid episode yet: not drawn
            if best.ndim != 2 or episodes.shape != best.shape[:1]:
                raise ValueError(f"plot.history: history must have simulations [C] and best_reward [C, trees], received {episodes.shape} and {best.shape}")
            colour, trees = COLOURS[i % len(COLOURS)], best.shape[1]
            if total:
                episodes, best, trees = episodes * trees, np.fmax.reduce(best, 1, keepdims=True), 1
            mean = best.mean(1)
            label = name if total else f"{name + ': ' if name else ''}mean of {trees} tree{'s' * (trees > 1)}"
            means += ax.plot(episodes, mean, color=colour, label=label, zorder=3)
            if trees > 1:
                half = 1.96 * best.std(1, ddof=1) / np.sqrt(trees)
                ax.fill_between(episodes, mean - half, mean + half, color=colour, alpha=0.2, linewidth=0)
                bests += ax.plot(episodes, best.max(1), color=colour, linestyle=(0, (4, 2)), linewidth=1.3, label="best of them")
        ax.set(xlabel="episodes" if total else "episodes a tree", ylabel="best reward so far")
        if total:
            ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax.legend([*means, *bests], [line.get_label() for line in (*means, *bests)], loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=2)
    return ax


def disturbances(episode, axes=None):
    """The disturbances of one `Episode` over its steps, a panel for each array of x, a line for each of its numbers. Returns the list of Axes."""
    _one("disturbances", episode)
    n = int(episode.length)
    panels = [(jax.tree_util.keystr(path) or "x", np.asarray(a)) for path, a in jax.tree_util.tree_leaves_with_path(episode.disturbances)]
    with _axes(axes, (6.8, 1.4 + 2.0 * max(len(panels), 1)), max(len(panels), 1)) as axes:
        axes = np.atleast_1d(np.asarray(axes, object)).ravel().tolist()
        if len(axes) < len(panels):
            raise ValueError(f"plot.disturbances: axes must be at least {len(panels)}, one for each array of x, received {len(axes)}")
        for ax, (name, a) in zip(axes, panels, strict=False):
            rows = a[:n].reshape(n, -1) if n else np.zeros((0, int(np.prod(a.shape[1:]))))
            few = rows.shape[1] <= len(COLOURS)
            for i, row in enumerate(rows.T):
                colour = COLOURS[i] if few else _shade(i / (rows.shape[1] - 1))
                ax.plot(np.arange(1, n + 1), row, color=colour, marker="o", markersize=3.5 if few else 0, label=f"{i}", linewidth=1.6 if few else 0.9)
            if few and 1 < rows.shape[1] and n:
                ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="entry")
            ax.set(ylabel=f"x{name}" if name != "x" else "x", xlim=(0.5, max(n, 1) + 0.5))
            ax.xaxis.get_major_locator().set_params(integer=True)
        axes[len(panels) - 1].set_xlabel("step")
        _title(axes[0], "Disturbances", episode)
    return axes


def distances(*episodes, labels=None, bins=40, ax=None):
    """Histogram of the miss distances of one or several batches of episodes (each an `Episode` with leading axes); failures are ticks on the axis.

    ``labels``: one name a batch. Episodes whose distance is not finite are left out. Returns the Axes. ValueError where no episode or no label fits.
    """
    if not episodes or not all(isinstance(e, Episode) for e in episodes):
        raise ValueError(f"plot.distances: episodes must be one or more Episodes, received {[type(e).__name__ for e in episodes]}")
    labels = [f"batch {i + 1}" for i in range(len(episodes))] if labels is None else list(labels)
    if len(labels) != len(episodes):
        raise ValueError(f"plot.distances: labels must be {len(episodes)} names, received {len(labels)}")
    batches = [(np.ravel(e.distance).astype(float), np.ravel(e.failure).astype(bool)) for e in episodes]
    finite = np.concatenate([d[np.isfinite(d)] for d, _ in batches])
    edges = np.histogram_bin_edges(finite, bins) if finite.size else np.linspace(0, 1, 2)
    with _axes(ax, (6.8, 3.8)) as ax:
        for i, (label, (d, failure)) in enumerate(zip(labels, batches, strict=True)):
            colour = COLOURS[i % len(COLOURS)]
            share = np.histogram(d[np.isfinite(d)], edges)[0] / max(len(d), 1)
            name = f"{label}: {len(d)} episode{'s' * (len(d) != 1)}, {int(failure.sum())} fail"
            ax.stairs(share, edges, color=colour, fill=True, alpha=0.2)
            ax.stairs(share, edges, color=colour, linewidth=1.6, label=name if len(episodes) > 1 or labels[0] != "batch 1" else name.removeprefix("batch 1: "))
            hits = d[failure & np.isfinite(d)]
            ax.plot(hits, np.full(len(hits), -0.02 - 0.03 * i), "|", color=colour, markersize=8, transform=ax.get_xaxis_transform(), clip_on=False)
        ax.set(xlabel="miss distance", ylabel="share of episodes", ylim=(0, None))
        ax.tick_params(axis="x", pad=6 + 6 * len(episodes), length=0)
        ax.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0))
    return ax


@contextmanager
def _axes(ax, size, rows=1):
    """The given axes, or those of a new figure; the style of this module while drawing."""
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        yield ax if ax is not None else plt.subplots(rows, 1, figsize=size, sharex=True, layout="constrained")[1]


def _circle(centre, radius):
    from matplotlib.patches import Circle

    return Circle(tuple(centre), radius, facecolor=BLUE, alpha=0.15, edgecolor=BLUE, linewidth=1.0, zorder=2)


def _halo():
    """A white rim, so that a word stays legible on a line."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=3, foreground="white")]


def _shade(u):
    import matplotlib

    return matplotlib.colormaps["cividis"](u)


def _one(caller, episode):
    if not isinstance(episode, Episode) or np.ndim(episode.length):
        received = type(episode).__name__ + (f" with leading axes {np.shape(episode.length)}" if isinstance(episode, Episode) else "")
        raise ValueError(f"plot.{caller}: episode must be one Episode, received {received}")
    return episode


def _title(ax, what, episode, more=""):
    """What happened, and the numbers that identify the episode."""
    outcome = f"{'failure at step' if episode.failure else 'no failure, steps:'} {int(episode.length)}"
    ax.set_title(f"{what}: {outcome}\nreward {float(episode.reward):.3f},  log p {float(episode.log_prob):.3f}{more}")
