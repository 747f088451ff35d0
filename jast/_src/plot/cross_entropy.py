"""Runs of `jast.cross_entropy`: how the proposal moves over the objective, where its surrogate
looked, and how fast several runs converge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import Objective
from jast._src.cross_entropy.result import standard_error
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast.cross_entropy import CEResult, Mixture, scores

__all__ = ["convergence", "proposal_contours", "surrogate_samples"]

GRID = 121  # points of a side
LEVELS = 12  # shades of the objective
EDGE = dict(linestyle="", markeredgecolor=style.INK, markeredgewidth=0.7)
EVALUATED = EDGE | dict(marker="o", markersize=5, color="white", markeredgewidth=1.0, zorder=5)
ELITES = EDGE | dict(marker="D", markersize=5.5, color=style.ORANGE, zorder=6)
JUDGED = EDGE | dict(marker=".", markersize=6, color=style.ORANGE, markeredgewidth=0.5, zorder=4)
BEST = EDGE | dict(marker="*", markersize=13, color=style.VERMILION, zorder=7)
"""Marks, and the edge of all: the fewer there are of a kind, the higher it lies. A convention."""
DEVIATIONS = {1: "-", 2: style.DASHED}  # lines of the ellipses
SHADES = ("#2F70A6", "#7FAFD3", "#BFD7E9", "#EDF2F6")


def proposal_contours(
    result: CEResult,
    objective: Objective,
    axes: Sequence[Axes] | None = None,
    iterations: Sequence[int] | None = None,
    bounds: Any = None,
    elites: int = 5,
) -> list[Axes]:
    """How the proposal of one run moved over an objective of two numbers, a panel an iteration
    (figure 2.2 of the thesis).

    In a panel: the objective (the darker the lower), the 1 and 2 standard deviation ellipses of the
    proposal that the iteration drew from (of a `Mixture`, those of each component, fainter where
    its weight is small), the points evaluated in it, and of all evaluated so far the best ones and
    the very best.

    Args:
        result: a `CEResult` without leading axes.
        objective: x [2] -> number, in JAX or not, or None to leave it out.
        axes: one for each iteration; None: a new figure.
        iterations: which ones, counted from 1 as ``print(result)`` does. Default: four of those
            that were run.
        bounds: ((low, high), (low, high)) of all panels, which then say how many points lie
            outside. Default: each panel holds its points, and has at least a twentieth of the
            widest one's side.
        elites: how many of the best points so far are marked.

    Raises:
        ValueError: for many runs, dimensions other than 2, iterations that were not run, bounds
            that are none, elites below 1, and too few axes.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from jast import cross_entropy as ce
        >>> found = ce.ce_method(jax.random.key(0), ce.paraboloid, ce.normal(jnp.ones(2), 4.0))
        >>> len(jast.plot.proposal_contours(found, ce.paraboloid, iterations=[1, 5]))
        2
    """
    caller = "proposal_contours"
    log = _log(caller, result)
    if isinstance(elites, bool) or not isinstance(elites, int) or elites < 1:
        raise ValueError(f"plot.{caller}: elites must be an int of at least 1, received {elites!r}")
    run = _iterations(log)
    evenly = np.geomspace(1, run, min(4, run))
    chosen = style.checked_iterations(caller, iterations, evenly, run)
    drawn = [(log.x[log.iteration == k - 1], _best(log, k, elites)) for k in chosen]
    boxes = _boxes(caller, bounds, [np.concatenate(points) for points in drawn])
    count = len(chosen)
    columns = count if count <= 4 else -(-count // 2)
    size = (2.75 * columns + 2.0, 2.75 * -(-count // columns) + 0.3)
    settings = dict(sharex=False, layout="compressed")
    with style.panels(caller, axes, size, count, "iteration", columns, **settings) as panels:
        for i, (ax, k, box) in enumerate(zip(panels, chosen, boxes, strict=True)):
            _ground(ax, objective, box, log.x.dtype)
            _proposal(ax, result, k - 1)
            now, best = drawn[i]
            ax.plot(*now.T, label="evaluated in\nthe iteration", **EVALUATED)
            ax.plot(*best.T, label=f"the {elites} best so far", **ELITES)
            ax.plot(*log.best_x[k - 1], label="best so far", **BEST)
            _outside(ax, now, box)
            ax.set_title(f"iteration {k}")
            if i % columns == 0:
                ax.set_ylabel("$x_2$")
            if i + columns >= count:
                ax.set_xlabel("$x_1$")
        _legend(panels[columns - 1], objective)
    return panels


def surrogate_samples(
    result: CEResult,
    objective: Objective,
    iteration: int,
    axes: Sequence[Axes] | None = None,
    bounds: Any = None,
) -> list[Axes]:
    """One iteration of a run with a surrogate, for an objective of two numbers (figure 2.4 of the
    thesis).

    Left: the points that were truly evaluated, and the proposal. Right: those that only the
    surrogate judged, and the next proposal.

    Args:
        result, objective: as for `proposal_contours`.
        iteration: which one, counted from 1.
        axes: two; None: a new figure.
        bounds: as for `proposal_contours`, but the default leaves out the farthest points.

    Raises:
        ValueError: as `proposal_contours`, and for a run without a surrogate.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from jast import cross_entropy as ce
        >>> wide = ce.normal(jnp.ones(2), 4.0)
        >>> found = ce.ce_surrogate(jax.random.key(0), ce.paraboloid, wide, iterations=3)
        >>> len(jast.plot.surrogate_samples(found, ce.paraboloid, 2))
        2
    """
    caller = "surrogate_samples"
    log = _log(caller, result)
    k = style.checked_iteration(caller, "iteration", iteration, _iterations(log))
    judged = np.asarray(result.history.model_x, float)[k - 1]
    judged = judged[np.isfinite(judged).all(1)]
    if not len(judged):
        must = "be of a method with a surrogate"
        raise style.wrong(caller, "result", must, "one whose history.model_x is empty")
    now = log.x[log.iteration == k - 1]
    low, high = np.quantile(judged, [0.01, 0.99], axis=0)
    near = np.clip(np.concatenate([judged, now]), low, high)
    [box] = _boxes(caller, bounds, [np.concatenate([near, log.best_x[k - 1 : k]])])
    settings = dict(sharey=True, layout="compressed")
    with style.panels(caller, axes, (8.6, 3.5), 2, "kind of sample", 2, **settings) as panels:
        left, right = panels
        for ax, which, points, label, look, title in (
            (left, k - 1, now, "truly evaluated", EVALUATED, "truly evaluated"),
            (right, k, judged, "judged by\nthe surrogate", JUDGED, "judged; next proposal"),
        ):
            _ground(ax, objective, box, log.x.dtype)
            _proposal(ax, result, which)
            ax.plot(*points.T, label=label, **look)
            ax.plot(*log.best_x[k - 1], label="best so far", **BEST)
            _outside(ax, points, box)
            ax.set_xlabel("$x_1$")
            ax.set_title(f"{len(points)} {title}")
        left.set_ylabel("$x_2$")
        _legend(right, objective, left)
    return panels


def convergence(
    results: CEResult | Mapping[str, CEResult],
    optimum: float | None = None,
    axes: Sequence[Axes] | None = None,
) -> list[Axes]:
    """Best value so far by true evaluations: the mean over runs and its 95 % band, 1.96 standard
    errors (figure 2.3 of the thesis).

    Means are those of `jast.cross_entropy.scores`; nothing is drawn while a run has no finite
    value.

    Args:
        results: a batch of runs, a `CEResult` with a leading axis as `jax.vmap` makes it, or a dict
            of name -> batch.
        optimum: [d]: where the objective is least. With it, a second panel has the mean distance of
            the best point to it, on a logarithmic axis.
        axes: one or two; None: a new figure.

    Raises:
        ValueError: for what is no batch of runs, an optimum of another dimension, and too few axes.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from jast import cross_entropy as ce
        >>> run = lambda key: ce.ce_method(key, ce.paraboloid, ce.normal(jnp.ones(2), 4.0))
        >>> runs = jax.vmap(run)(jax.random.split(jax.random.key(0), 5))
        >>> len(jast.plot.convergence(runs, jnp.zeros(2)))
        2
    """
    caller = "convergence"
    results = style.by_name(results)
    if not results:
        raise style.wrong("convergence", "results", "hold at least one batch of runs", "none")
    for name, result in results.items():
        if not isinstance(result, CEResult) or np.ndim(result.best_value) != 1:
            received = type(result).__name__
            if isinstance(result, CEResult):
                received = f"leading axes {np.shape(result.best_value)}"
            received += f" for {name!r}" if name else ""
            raise style.wrong(caller, "results", "be CEResults with one leading axis", received)
    count = 1 if optimum is None else 2
    with style.panels(caller, axes, (5.2 * count, 3.8), count, "quantity", count) as panels:
        for i, (name, result) in enumerate(results.items()):
            runs, d = np.shape(result.best_x)
            history = result.history
            value = np.asarray(history.best_value, float)
            value = np.where(np.isfinite(value), value, np.nan)
            known = result._replace(history=history._replace(best_value=value))
            score = scores(known, np.zeros(d) if optimum is None else optimum)
            evaluations = np.cumsum(np.bincount(np.asarray(history.iteration)[0]))
            quantities = [(score.best_value, score.standard_error)]
            if optimum is not None:
                away = np.asarray(history.best_x, float) - np.asarray(optimum, float)
                error = standard_error(np.linalg.norm(away, axis=2))
                quantities.append((score.mean_distance, error))
            look = dict(color=style.colour(i), marker=style.marker(i), markersize=4.5)
            look |= dict(label=name or f"mean of {runs} runs")
            for ax, (mean, error) in zip(panels, quantities, strict=True):
                there = np.isfinite(mean)
                at, mean, half = evaluations[there], mean[there], 1.96 * error[there]
                ax.plot(at, mean, zorder=3, **look)
                if there.any() and runs > 1:
                    style.band(ax, at, mean - half, mean + half, color=look["color"])
        titles = "mean best value", "mean distance to the optimum"
        for ax, title in zip(panels, titles, strict=False):
            ax.set(xlabel="true evaluations", xlim=(0, None))
            ax.set_title(title)
        if optimum is not None:
            panels[1].set_yscale("log")
            _plain(panels[1])
        panels[0].legend(loc="best")
    return panels


def _log(caller, result):
    """The history of one run in the plane, as NumPy arrays and without the evaluations that were
    not made; or a ValueError.
    """
    style.checked_kind(caller, "result", result, CEResult, "a CEResult")
    if np.ndim(result.best_value):
        raise style.wrong(
            caller, "result", "be one run", f"one with leading axes {np.shape(result.best_value)}"
        )
    if np.size(result.best_x) != 2:
        must = "be of an objective of 2 numbers"
        raise style.wrong(caller, "result", must, np.size(result.best_x))
    log = jax.tree.map(np.asarray, result.history)
    told = np.isfinite(log.x).all(1)
    if not told.any():
        raise ValueError(f"plot.{caller}: result must have evaluations, received none")
    return log._replace(x=log.x[told], value=log.value[told], iteration=log.iteration[told])


def _iterations(log):
    """How many were run."""
    return int(log.iteration.max()) + 1


def _best(log, k, count):
    """[at most count, 2]: the best points of the first ``k`` iterations."""
    known = (log.iteration < k) & np.isfinite(log.value)
    return log.x[known][np.argsort(log.value[known], kind="stable")[:count]]


def _boxes(caller, bounds, panels):
    """[panels, 2, (low, high)]: the bounds given, or for each panel's points [n, 2] a square that
    holds them, with a margin.
    """
    if bounds is not None:
        box = np.asarray(bounds, float)
        if box.shape != (2, 2) or not np.isfinite(box).all() or not (box[:, 0] < box[:, 1]).all():
            raise style.wrong(caller, "bounds", "be ((low, high), (low, high))", f"{bounds!r}")
        return [box] * len(panels)
    panels = [x[np.isfinite(x).all(1)] for x in panels]
    sides = np.array([np.max(np.ptp(x, axis=0)) for x in panels])
    least = max(sides.max() / 20, 1e-6 * max(1.0, *(np.abs(x).max() for x in panels)))
    sides = 1.25 * np.maximum(sides, least)
    return [
        ((x.min(0) + x.max(0)) / 2)[:, None] + np.array([-0.5, 0.5]) * side
        for x, side in zip(panels, sides, strict=True)
    ]


def _ground(ax, objective, box, dtype):
    """The objective in shades of blue, and the limits of the panel."""
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.ticker import MaxNLocator

    if objective is not None:
        x, y = (np.linspace(*side, GRID) for side in box)
        plane = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(dtype)
        values = np.ma.masked_invalid(_values(objective, plane).reshape(GRID, GRID))
        low, high = 0, 0
        if values.count():  # a few great values must not flatten the rest
            low, high = values.min(), np.quantile(values.compressed(), 0.98)
        if high > low:
            levels = np.linspace(low, high, LEVELS + 1)
            blues = LinearSegmentedColormap.from_list("", SHADES)
            ax.contourf(x, y, values, levels, cmap=blues, extend="max", zorder=0)
    ax.grid(False)
    ax.set(xlim=box[0], ylim=box[1], aspect="equal")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(4))


def _values(objective, x):
    """[n] of the objective at ``x`` [n, 2]."""
    try:
        return np.asarray(jax.vmap(objective)(jnp.asarray(x)), float)
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError):  # not in JAX
        return np.array([float(objective(row)) for row in x])


def _proposal(ax, result, k):
    """1 and 2 standard deviation ellipses of the k-th proposal, from 0."""
    from matplotlib.patches import Ellipse

    proposal = type(result.proposal)(*(np.asarray(a)[k] for a in result.history.proposals))
    if isinstance(proposal, Mixture):
        weights, means, covariances = proposal
        strengths, width = 0.25 + 0.75 * weights / max(weights.max(), np.finfo(float).tiny), 1.1
    else:
        means, covariances = proposal.mean[None], proposal.covariance[None]
        strengths, width = np.ones(1), 1.6
    for strength, mean, covariance in zip(strengths, means, covariances, strict=True):
        values, vectors = np.linalg.eigh(covariance)
        sides, angle = 2 * np.sqrt(np.maximum(values, 0)), np.degrees(np.arctan2(*vectors[::-1, 0]))
        for deviations, line in DEVIATIONS.items():
            look = dict(fill=False, edgecolor=style.VERMILION, linewidth=width, linestyle=line)
            look |= dict(alpha=float(strength), zorder=3)
            ax.add_patch(Ellipse(mean, *deviations * sides, angle=angle, **look))


def _outside(ax, x, box):
    """Says how many points the panel does not show."""
    if count := int(((x < box[:, 0]) | (x > box[:, 1])).any(1).sum()):
        look = dict(transform=ax.transAxes, fontsize=8.5, zorder=8, path_effects=style.halo())
        ax.text(0.03, 0.03, f"{count} of {len(x)} outside", **look)


def _legend(ax, objective, *others):
    """What the marks mean, to the right of ``ax``."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = {
        label: handle
        for other in (*others, ax)
        for handle, label in zip(*other.get_legend_handles_labels(), strict=True)
    }
    for deviations, line in DEVIATIONS.items():
        look = dict(color=style.VERMILION, linewidth=1.6, linestyle=line)
        handles[f"proposal, {deviations} sd"] = Line2D([], [], **look)
    if objective is not None:
        handles["objective:\ndarker is lower"] = Patch(facecolor=SHADES[1])
    look = dict(loc="upper left", bbox_to_anchor=(1.02, 1.02), fontsize=9, labelspacing=0.7)
    ax.legend(handles.values(), handles, **look)


def _plain(ax):
    """Numbers as they are on a logarithmic axis, few of them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
