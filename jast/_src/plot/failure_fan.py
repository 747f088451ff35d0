"""How a number of the state runs to failure, over many failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jast._src.core.episode import Episode, replay
from jast._src.core.simulator import Simulator
from jast._src.plot import series, style
from jast._src.plot.series import DISTANCE, Samples
from jast._src.plot.style import Axes

__all__ = ["failure_fan"]


def failure_fan(
    samples: Any,
    sim: Simulator | None = None,
    value: Callable[[Any], Any] | str | None = None,
    nominal: Episode | None = None,
    ax: Axes | None = None,
    most: int = 200,
    label: str | None = None,
    *,
    modes: Any = None,
    units: dict[str, Any] | None = None,
) -> Axes:
    """How a number of the state runs to failure, a line an episode with a mark where it fails: a
    colour and a mark for each failure mode, or, without modes, two colours where some end above 0
    and others below.

    Args:
        samples: a report of `jast.stress`, its modes, a result of a search, its archive,
            `jast.estimate.FailureSamples`, an `Episode` or a batch of them; each is replayed.
        sim: their simulator; not needed with a report that holds it.
        value: state -> number, or the name of a field, as "position[0]" (default: the miss
            distance).
        nominal: a batch of other episodes, grey and behind.
        most: of a batch are drawn, evenly taken.
        label: of the axis (default: the name of ``value``).
        modes: `jast.search.Modes`, by which failures are told apart (by their direction,
            moved in time), or the number of the mode of each, from 0. Default: those of a report.
        units: name -> unit, for the label of a field.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for samples of another kind, a value that is not one number or no field, and
            ``most`` below 1.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0)
        >>> ax = jast.plot.failure_fan(found, sim)
    """
    caller = "failure_fan"
    g = series.samples_of(caller, samples, sim, modes, most)
    rows = _rows(caller, g.sim, g.episodes, value)
    behind = []
    if nominal is not None:
        some = series.samples_of(caller, nominal, g.sim, None, most).episodes
        behind = _rows(caller, g.sim, some, value)
    with style.axes(ax, (6.8, 3.8)) as ax:
        for i, line in enumerate(behind):
            words = "_" if i else f"{len(behind)} nominal episodes"
            ax.plot(line, color=style.GREY, linewidth=0.6, alpha=0.5, zorder=2, label=words)
        for own, colour, marker, name in _groups(g, np.array([line[-1] for line in rows])):
            alpha = float(np.clip(12 / len(own), 0.12, 0.8))
            for i in own:
                ax.plot(rows[i], color=colour, linewidth=0.8, alpha=alpha, zorder=3)
            ends = [len(rows[i]) - 1 for i in own], [rows[i][-1] for i in own]
            look = dict(color=colour, marker=marker)
            ax.plot(*ends, linestyle="", markersize=3.5, alpha=min(2 * alpha, 1), zorder=4, **look)
            ax.plot([], [], markersize=4, linewidth=1.2, label=name, **look)
        ax.set(xlabel="step", ylabel=label or _name(value, units), xlim=(0, None))
        style.whole_steps(ax.xaxis)
        style.legend_above(ax, fontsize=9)
    return ax


def _groups(g: Samples, ends: np.ndarray) -> list[tuple[np.ndarray, str, str, str]]:
    """(which episodes, colour, mark, words) of each kind of failure."""
    if g.mode is not None:
        return series.by_mode(g)
    n = len(ends)
    if not ((ends > 0).any() and (ends < 0).any()):
        return [(np.arange(n), style.BLUE, "o", f"{n} failures")]
    up, down = np.flatnonzero(ends > 0), np.flatnonzero(~(ends > 0))
    return [
        (up, style.BLUE, "^", f"{len(up)} of {n} failures above 0"),
        (down, style.VERMILION, "v", f"{len(down)} of {n} failures below 0"),
    ]


def _rows(caller: str, sim: Simulator, episodes: Episode, value: Any) -> list[np.ndarray]:
    """[steps + 1] of the value for each episode."""
    if isinstance(value, str):
        played = series.series_of(sim, episodes)
        names = series.choose_fields(caller, value, played, 1)
        if len(names) > 1:
            must = f"name one number of {names}"
            raise style.wrong(caller, "value", must, f"{value!r}, which names them all")
        out = played.columns[names[0]]
    else:

        def numbers(e: Episode) -> jax.Array:
            states = (replay(sim, e) if e.states is None else e).states
            return jax.vmap(lambda s: sim.evaluate(s)[1] if value is None else value(s))(states)

        out = np.asarray(jax.jit(jax.vmap(numbers))(episodes), float)
    if out.ndim != 2:
        raise style.wrong(caller, "value", "return one number", f"shape {out.shape[2:]}")
    return [row[: int(n) + 1] for row, n in zip(out, episodes.length, strict=True)]


def _name(value: Any, units: dict | None) -> str:
    """What a picture calls a number of the state."""
    if value is None or isinstance(value, str):
        return style.labelled(value or DISTANCE, units)
    name = getattr(value, "__name__", "<lambda>")
    return "number of the state" if name == "<lambda>" else name.replace("_", " ")
