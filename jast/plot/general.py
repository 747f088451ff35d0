"""Pictures that any system has: how a search went, what disturbed an episode, how close many
came.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jast import limit_state as latent
from jast.distributions.spread import spread
from jast.episode import Episode, replay
from jast.fields import fields
from jast.plot import style
from jast.simulator import Simulator

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jast.search.result import SearchResult


__all__ = ["disturbances", "distances", "history", "spreads"]


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

    Returns:
        The Axes.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.cem(jax.random.key(0), sim, samples=50, elites=5, iterations=4)
        >>> ax = jast.plot.history({"cross-entropy": found})
    """
    from matplotlib.ticker import EngFormatter

    results = results if isinstance(results, dict) else {"": results}
    with style.axes(ax, (6.8, 4.2)) as ax:
        means, bests = [], []
        for i, (name, result) in enumerate(results.items()):
            episodes, best = (
                np.asarray(result.history.simulations),
                np.asarray(result.history.best_reward, float),
            )
            best = np.where(np.isfinite(best), best, np.nan)  # no valid episode yet: not drawn
            if best.ndim != 2 or episodes.shape != best.shape[:1]:
                raise ValueError(
                    "plot.history: history must have simulations [C] and best_reward [C, trees],"
                    f" received {episodes.shape} and {best.shape}"
                )
            colour, trees = style.COLOURS[i % len(style.COLOURS)], best.shape[1]
            if total:
                episodes, best, trees = episodes * trees, np.fmax.reduce(best, 1, keepdims=True), 1
            mean = best.mean(1)
            label = (
                name
                if total
                else f"{name + ': ' if name else ''}mean of {trees} tree{'s' * (trees > 1)}"
            )
            means += ax.plot(episodes, mean, color=colour, label=label, zorder=3)
            if trees > 1:
                half = 1.96 * best.std(1, ddof=1) / np.sqrt(trees)
                ax.fill_between(
                    episodes, mean - half, mean + half, color=colour, alpha=0.2, linewidth=0
                )
                bests += ax.plot(
                    episodes,
                    best.max(1),
                    color=colour,
                    linestyle=(0, (4, 2)),
                    linewidth=1.3,
                    label="best of them",
                )
        ax.set(xlabel="episodes" if total else "episodes a tree", ylabel="best reward so far")
        if total:
            ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax.legend(
            [*means, *bests],
            [line.get_label() for line in (*means, *bests)],
            loc="lower left",
            bbox_to_anchor=(-0.02, 1.0),
            ncols=2,
        )
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

    Returns:
        The list of Axes.

    Raises:
        ValueError: for no or many episodes, too few axes, and a simulator with a distribution that
            has no quantile function.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> len(jast.plot.disturbances(jast.rollout(jax.random.key(0), sim)))
        1
    """
    style.one("disturbances", episode)
    n = int(episode.length)
    if sim is None:
        first, steps = (), episode.disturbances
    else:
        latent.check("plot.disturbances", sim)
        first, steps = spreads(sim, episode)
    panels = [
        (f._replace(name=f.name if f.name.startswith("x0") else f"x0 {f.name}"), 0)
        for f in fields(first, "x0", lead=0)
    ]
    panels += [(f, 1) for f in fields(steps, "x")]
    count = max(len(panels), 1)
    with style.axes(axes, (6.8, 1.4 + 2.0 * count), count) as axes:
        axes = style.panels("disturbances", axes, len(panels), "array of x")
        for ax, ((name, places, values), begin) in zip(axes, panels, strict=False):
            rows = values[:n] if begin else values[None]
            few = rows.shape[1] <= len(style.COLOURS)
            if sim is not None:
                for reach, alpha in ((2, 0.1), (1, 0.12)):
                    ax.axhspan(-reach, reach, color=style.GREY, alpha=alpha, linewidth=0, zorder=0)
            for i, row in enumerate(rows.T):
                colour = style.COLOURS[i] if few else style.shade(i / (rows.shape[1] - 1))
                ax.plot(
                    np.arange(begin, begin + len(row)),
                    row,
                    color=colour,
                    marker=style.MARKERS[i] if few else "o",
                    markersize=3.5 if few or not begin else 0,
                    label=places[i],
                    linewidth=1.6 if few else 0.9,
                )
            if few and 1 < rows.shape[1] and rows.size:
                ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="entry")
            ax.set(
                ylabel=style.labelled(name, units if sim is None else None),
                xlim=(-0.5 if panels and not panels[0][1] else 0.5, max(n, 1) + 0.5),
            )
            ax.xaxis.get_major_locator().set_params(integer=True)
        axes[len(panels) - 1].set_xlabel("step")
        what = "Disturbances" if sim is None else "Disturbances in standard deviations"
        axes[0].set_title(style.headline(what, episode))
    return axes


def spreads(sim: Simulator, episode: Episode) -> tuple[Any, Any]:
    """How far out x0 (``()`` where the start is fixed) and each disturbance [T, ...] of an episode
    are, in standard deviations. On the host.
    """
    return jax.device_get(_spreads(sim, episode._replace(states=None)))


@jax.jit
def _spreads(sim: Simulator, episode: Episode) -> tuple[Any, Any]:
    states = jax.tree.map(lambda a: a[:-1], replay(sim, episode).states)
    rows = jax.tree.leaves(episode.disturbances)[0].shape[0]
    states = jax.tree.map(lambda a: a[:rows], states)
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

    Returns:
        The Axes.

    Raises:
        ValueError: where no episode or no label fits.

    Example:
        >>> import jax, jast
        >>> keys = jax.random.split(jax.random.key(0), 50)
        >>> many = jax.vmap(jast.rollout, (0, None))(keys, jast.simulators.walk1d())
        >>> ax = jast.plot.distances(many, labels=["nominal"])
    """
    if not episodes or not all(isinstance(e, Episode) for e in episodes):
        raise ValueError(
            "plot.distances: episodes must be one or more Episodes, received"
            f" {[type(e).__name__ for e in episodes]}"
        )
    labels = [f"batch {i + 1}" for i in range(len(episodes))] if labels is None else list(labels)
    if len(labels) != len(episodes):
        raise ValueError(
            f"plot.distances: labels must be {len(episodes)} names, received {len(labels)}"
        )
    batches = [
        (np.ravel(e.distance).astype(float), np.ravel(e.failure).astype(bool)) for e in episodes
    ]
    finite = np.concatenate([d[np.isfinite(d)] for d, _ in batches])
    edges = np.histogram_bin_edges(finite, bins) if finite.size else np.linspace(0, 1, 2)
    with style.axes(ax, (6.8, 3.8)) as ax:
        for i, (label, (d, failure)) in enumerate(zip(labels, batches, strict=True)):
            colour = style.COLOURS[i % len(style.COLOURS)]
            share = np.histogram(d[np.isfinite(d)], edges)[0] / max(len(d), 1)
            name = f"{label}: {len(d)} episode{'s' * (len(d) != 1)}, {int(failure.sum())} fail"
            ax.stairs(share, edges, color=colour, fill=True, alpha=0.2)
            ax.stairs(
                share,
                edges,
                color=colour,
                linewidth=1.6,
                label=(
                    name
                    if len(episodes) > 1 or labels[0] != "batch 1"
                    else name.removeprefix("batch 1: ")
                ),
            )
            hits = d[failure & np.isfinite(d)]
            ax.plot(
                hits,
                np.full(len(hits), -0.02 - 0.03 * i),
                "|",
                color=colour,
                markersize=8,
                transform=ax.get_xaxis_transform(),
                clip_on=False,
            )
        ax.set(xlabel="miss distance", ylabel="share of episodes", ylim=(0, None))
        ax.tick_params(axis="x", pad=6 + 6 * len(episodes), length=0)
        ax.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0))
    return ax
