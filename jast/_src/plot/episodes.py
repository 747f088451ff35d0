"""Pictures that any system has: how a search went, what disturbed an episode, how close many
came.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jast._src.core.episode import Episode, replay
from jast._src.core.simulator import Simulator
from jast._src.distributions.standardised import spread
from jast._src.normal_space import transform
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast._src.search.result import SearchResult
from jast._src.util.leaf_names import Field, named_fields
from jast._src.util.pytrees import index_tree

__all__ = ["disturbances", "distances", "disturbance_fields", "history", "shade_deviations"]


def history(
    results: SearchResult | Mapping[str, SearchResult], ax: Axes | None = None, total: bool = False
) -> Axes:
    """How the best reward grew with the episodes of a tree: the mean over trees with its 95 % band,
    and (dashed) the best over trees.

    Args:
        results: a search result, or a dict of name -> result, whose ``history`` has ``simulations``
            [C] and ``best_reward`` [C, trees].
        ax: Axes to draw in; None: a new figure.
        total: draw the best over trees with the episodes of all trees, by which searches of
            different numbers of trees compare.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.cem(jax.random.key(0), sim, samples=50, elites=5, iterations=4)
        >>> ax = jast.plot.history({"cross-entropy": found})
    """
    from matplotlib.ticker import EngFormatter

    with style.axes(ax, (6.8, 4.2)) as ax:
        means, bests = [], []
        for i, (name, result) in enumerate(style.by_name(results).items()):
            if not hasattr(getattr(result, "history", None), "best_reward"):
                must = "be a jast.SearchResult, or a dict of name -> result"
                raise style.wrong("history", "results", must, type(result).__name__)
            episodes = np.asarray(result.history.simulations)
            best = np.asarray(result.history.best_reward, float)
            best = np.where(np.isfinite(best), best, np.nan)  # no valid episode yet: not drawn
            if best.ndim != 2 or episodes.shape != best.shape[:1]:
                must = "have simulations [C] and best_reward [C, trees]"
                raise style.wrong("history", "history", must, f"{episodes.shape} and {best.shape}")
            colour, trees = style.colour(i), best.shape[1]
            if total:
                episodes, best, trees = episodes * trees, np.fmax.reduce(best, 1, keepdims=True), 1
            mean = best.mean(1)
            label = name if total else style.named(name, f"mean of {style.count_of(trees, 'tree')}")
            means += ax.plot(episodes, mean, color=colour, label=label, zorder=3)
            if trees > 1:
                half = 1.96 * best.std(1, ddof=1) / np.sqrt(trees)
                style.band(ax, episodes, mean - half, mean + half, color=colour)
                look = dict(color=colour, linestyle=style.DASHED, linewidth=1.3)
                bests += ax.plot(episodes, best.max(1), label="best of them", **look)
        ax.set(xlabel="episodes" if total else "episodes a tree", ylabel="best reward so far")
        if total:
            ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        lines = [*means, *bests]
        style.legend_above(ax, lines, [line.get_label() for line in lines])
    return ax


def disturbances(
    episode: Episode,
    axes: Sequence[Axes] | None = None,
    *,
    sim: Simulator | None = None,
    units: dict[str, Any] | None = None,
) -> list[Axes]:
    """The disturbances of one `Episode` over its steps, a panel for each array of x, a line for
    each of its numbers.

    Args:
        episode: one.
        axes: one for each array, or None for a new figure.
        sim: its simulator: then each number is drawn by how far out it is, so that numbers of
            all kinds compare. 0 is the mode; 1 is as far as one standard deviation of a normal
            number. Numbers go by the quantile map of their distribution. A choice has no order: it
            stands at sqrt(2 (log p of the likeliest - log p)), which for a normal number is the
            same distance. Panels of x0, at step 0, come first. Grey: up to 1 and up to 2.
        units: name -> unit, for the labels; not where ``sim`` is given.

    Raises:
        ValueError: for no or many episodes, too few axes, and a simulator with a distribution that
            has no quantile function.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> len(jast.plot.disturbances(jast.rollout(jax.random.key(0), sim)))
        1
    """
    style.one_episode("disturbances", episode)
    n = int(episode.length)
    if sim is not None:
        transform.check("plot.disturbances", sim)
    arrays = disturbance_fields(sim, episode)
    earliest = min((begin for _, begin in arrays), default=1)
    count = max(len(arrays), 1)
    size = (6.8, 1.4 + 2.0 * count)
    with style.panels("disturbances", axes, size, count, "array of x") as axes:
        for ax, ((name, places, rows), begin) in zip(axes, arrays, strict=False):
            few = rows.shape[1] <= len(style.COLOURS)
            if sim is not None:
                shade_deviations(ax)
            for i, row in enumerate(rows.T):
                colour = style.COLOURS[i] if few else style.shade(i / (rows.shape[1] - 1))
                look = dict(color=colour, linewidth=1.6 if few else 0.9, label=places[i])
                look |= dict(marker=style.MARKERS[i] if few else "o")
                look |= dict(markersize=3.5 if few or not begin else 0)
                ax.plot(np.arange(begin, begin + len(row)), row, **look)
            if few and 1 < rows.shape[1] and rows.size:
                ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="entry")
            ax.set(
                ylabel=style.labelled(name, units if sim is None else None),
                xlim=(earliest - 0.5, max(n, 1) + 0.5),
            )
            style.whole_steps(ax.xaxis)
        axes[-1].set_xlabel("step")
        what = "Disturbances" if sim is None else "Disturbances in standard deviations"
        axes[0].set_title(style.headline(what, episode))
    return axes


def shade_deviations(ax: Axes) -> None:
    """Grey: up to 1 and up to 2 standard deviations."""
    for reach, alpha in ((2, 0.1), (1, 0.12)):
        ax.axhspan(-reach, reach, color=style.GREY, alpha=alpha, linewidth=0, zorder=0)


def disturbance_fields(sim: Simulator | None, episode: Episode) -> list[tuple[Field, int]]:
    """The disturbances of an episode by step, and the first step of each array. With ``sim`` those
    of x0, at step 0, come first, and all are in standard deviations.
    """
    first, steps = (), episode.disturbances
    if sim is not None:
        first, steps = jax.device_get(_spreads(sim, episode._replace(states=None)))
    found = []
    for field in named_fields(first, "x0", lead=0):
        name = field.name if field.name.startswith("x0") else f"x0 {field.name}"
        found.append((field._replace(name=name, values=field.values[None]), 0))
    for field in named_fields(steps, "x"):
        found.append((field._replace(values=field.values[: int(episode.length)]), 1))
    return found


@jax.jit
def _spreads(sim: Simulator, episode: Episode) -> tuple[Any, Any]:
    """How far out x0 (``()`` where the start is fixed) and each disturbance [T, ...] are."""
    rows = jax.tree.leaves(episode.disturbances)[0].shape[0]
    states = index_tree(replay(sim, episode).states, np.s_[:rows])
    steps = jax.vmap(lambda s, x: spread(sim.disturbance(s), x))(states, episode.disturbances)
    return spread(sim.start(), episode.x0) if jax.tree.leaves(episode.x0) else (), steps


def distances(
    *episodes: Episode | Sequence[Episode],
    labels: Sequence[str] | None = None,
    bins: int = 40,
    ax: Axes | None = None,
) -> Axes:
    """Histogram of the miss distances of one or several batches of episodes; failures are ticks on
    the axis. Episodes whose distance is not finite are left out.

    Args:
        episodes: one or several batches, each an `Episode` with leading axes.
        labels: one name for each batch.
        bins: of the histogram.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: where no episode or no label fits.

    Example:
        >>> import jax, jast
        >>> keys = jax.random.split(jax.random.key(0), 50)
        >>> many = jax.vmap(jast.rollout, (0, None))(keys, jast.simulators.walk1d())
        >>> ax = jast.plot.distances(many, labels=["nominal"])
    """
    if not episodes or not all(isinstance(e, Episode) for e in episodes):
        must = "be one or more Episodes"
        raise style.wrong("distances", "episodes", must, [type(e).__name__ for e in episodes])
    labels = [f"batch {i + 1}" for i in range(len(episodes))] if labels is None else list(labels)
    if len(labels) != len(episodes):
        raise style.wrong("distances", "labels", f"be {len(episodes)} names", len(labels))
    batches = [
        (np.ravel(e.distance).astype(float), np.ravel(e.failure).astype(bool)) for e in episodes
    ]
    finite = np.concatenate([d[np.isfinite(d)] for d, _ in batches])
    edges = np.histogram_bin_edges(finite, bins) if finite.size else np.linspace(0, 1, 2)
    with style.axes(ax, (6.8, 3.8)) as ax:
        for i, (label, (d, failure)) in enumerate(zip(labels, batches, strict=True)):
            colour = style.colour(i)
            share = np.histogram(d[np.isfinite(d)], edges)[0] / max(len(d), 1)
            words = f"{style.count_of(len(d), 'episode')}, {int(failure.sum())} fail"
            unnamed = len(episodes) == 1 and label == "batch 1"
            ax.stairs(share, edges, color=colour, fill=True, alpha=0.2)
            words = style.named("" if unnamed else label, words)
            ax.stairs(share, edges, color=colour, linewidth=1.6, label=words)
            hits = d[failure & np.isfinite(d)]
            at = np.full(len(hits), -0.02 - 0.03 * i), ax.get_xaxis_transform()
            ax.plot(hits, at[0], "|", color=colour, markersize=8, transform=at[1], clip_on=False)
        ax.set(xlabel="miss distance", ylabel="share of episodes", ylim=(0, None))
        ax.tick_params(axis="x", pad=6 + 6 * len(episodes), length=0)
        style.legend_above(ax, ncols=1)
    return ax
