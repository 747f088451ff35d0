"""Pictures of `jast.weakness`: which inputs fail, and which of their features mark the weakness."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jast._src.core.typing import Array
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast._src.plot.weakness import checked_result
from jast._src.util.checks import whole_number
from jast._src.weakness.data import check_data
from jast._src.weakness.result import Result

__all__ = ["contributions", "first_failures"]

HEAT = ("#E69F0000", "#E69F00B0", "#D55E00", "#5A1A00")  # from nothing, which shows what is beneath
BARS = 15  # features of a table
PIXELS = dict(interpolation="nearest")
EFFECTS = {1: ("raises", style.VERMILION), -1: ("lowers", style.BLUE), 0: ("neither", style.GREY)}


def first_failures(
    result: Result,
    inputs: Array,
    labels: Array,
    count: int = 20,
    names: Sequence[str] | None = None,
    axes: Sequence[Axes] | None = None,
) -> list[Axes]:
    """The first failures found, a tile each: what the system said, what it is, and the input's
    number.

    Args:
        result: a `jast.weakness.Result`.
        inputs, labels: [n]: those of the validation; images [n, height, width], or [n, height,
            width, channels] of 1, 3 or 4 channels. Numbers of colours are shares of 1, or of 255
            where they are whole.
        count: tiles, at most.
        names: of the classes.
        axes: one for each tile; None: a new figure.

    Returns:
        The list of Axes, one for each tile; a single one that says so where no failure was found.

    Raises:
        ValueError: for what is no `jast.weakness.Result`, other numbers of inputs or labels, rows
            of a table, labels by which its failures are none, too few names, and too few axes.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> len(jast.plot.first_failures(found, inputs, labels, count=6))
        6
    """
    caller = "first_failures"
    failures, n = np.asarray(checked_result(caller, result).failures), len(result.scores)
    count = whole_number(f"plot.{caller}", "count", count)
    inputs, labels, _ = check_data(f"plot.{caller}", inputs, labels)
    if len(inputs) != n:
        raise style.wrong(caller, "inputs", f"be those of the result, {n}", len(inputs))
    if inputs.ndim not in (3, 4) or inputs.ndim == 4 and inputs.shape[3] not in (1, 3, 4):
        received = f"shape {inputs.shape}"
        if inputs.ndim == 2:
            received = f"rows of a table, {received}: reshape them if they are images"
        must = "be images [n, height, width] or [n, height, width, 1, 3 or 4 channels]"
        raise style.wrong(caller, "inputs", must, received)
    said, true = np.asarray(result.predicted)[failures], labels[failures]
    if (same := int(np.sum(said == true))) > 0:
        received = f"labels that agree with its answer in {same} of its {len(failures)} failures"
        raise style.wrong(caller, "labels", "be those of the result", received)
    words = _words(caller, names, max([*said, *true], default=-1))
    tiles = failures[:count]
    count = max(len(tiles), 1)
    columns = min(5, count)
    lines = -(-count // columns)
    tall = 1.45 * np.clip(inputs.shape[1] / inputs.shape[2], 0.4, 2.5)
    answers = zip(said[:count], true[:count], strict=True)
    titles = [(f"said {words(a)}", f"is {words(b)}") for a, b in answers]
    joint = ", " if max((len("".join(pair)) for pair in titles), default=0) <= 12 else "\n"
    size = max(1.55 * columns + 0.3, 3.2), (tall + 0.5 + 0.18 * ("\n" in joint)) * lines + 0.4
    own = axes is None
    with style.panels(caller, axes, size, count, "failure", columns, sharex=False) as axes:
        if not len(tiles):
            _say(axes[0], "no failure found")
        for ax, i, title in zip(axes, tiles, titles, strict=False):
            _image(ax, inputs[i], inputs)
            ax.set_title(joint.join(title), loc="left", fontsize=10, pad=4)
            ax.set_xlabel(f"input {i}", loc="left", fontsize=8, color=style.GREY, labelpad=3)
        if own and len(tiles):
            found = f"{style.count_of(len(failures), 'failure')} found"
            if len(tiles) < len(failures):
                found = f"The first {f'{len(tiles)} ' * (len(tiles) > 1)}of {found}"
            axes[0].figure.get_layout_engine().set(h_pad=0.07)
            axes[0].figure.suptitle(found, x=0.01, ha="left", fontsize=11)
    return axes


def contributions(
    values: Array,
    names: Sequence[str] | None = None,
    background: Array | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Which features mark the weakness: the mean magnitude of their contributions to the log odds
    of failure.

    Images are drawn as a map, whose magnitudes are summed over the channels. Of rows of a table the
    15 columns of the greatest mean magnitude are drawn, with the mean of the signed contributions,
    which raises the odds of failure or lowers them. With k = 0, as a result without failures gives,
    the axes say so.

    Args:
        values: [k, ...]: the signed contributions of each feature, for k inputs
            (`jast.weakness.influence`): images [k, height, width] or [k, height, width, channels],
            or rows [k, columns].
        names: of the columns of a table.
        background: of images, in grey, [height, width(, channels)]: for example the mean image.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for values of another shape or that are not finite, and names or a background
            that do not fit or are for the other kind of inputs.

    Example:
        >>> import numpy as np, jast
        >>> ax = jast.plot.contributions(np.array([[0.1, -2.0], [0.3, 1.0]]), ["speed", "gap"])
    """
    caller = "contributions"
    values = _numbers(values)
    if values is None or values.ndim not in (2, 3, 4) or 0 in values.shape[1:]:
        received = "no such array" if values is None else f"shape {values.shape}"
        must = "be [k, columns], [k, height, width] or [k, height, width, channels]"
        raise style.wrong(caller, "values", must, received)
    if not np.isfinite(values).all():
        raise ValueError(
            f"plot.{caller}: values must be finite, {int(np.sum(~np.isfinite(values)))} are not"
        )
    if not len(values):
        with style.axes(ax, (3.2, 1.6)) as ax:
            _say(ax, "no inputs to explain")
        return ax
    return (_bars if values.ndim == 2 else _map)(caller, values, names, background, ax)


def _bars(caller, values, names, background, ax):
    """`contributions` of the columns of a table."""
    k, d = values.shape
    if background is not None:
        must = "be None for rows of a table"
        raise style.wrong(caller, "background", must, type(background).__name__)
    names = [f"column {i}" for i in range(d)] if names is None else [str(name) for name in names]
    if len(names) != d:
        raise style.wrong(caller, "names", f"be {d}, one for each column", len(names))
    size, mean = np.abs(values).mean(0), values.mean(0)
    chosen = np.argsort(-size, kind="stable")[:BARS]
    with style.axes(ax, (6.8, 1.2 + 0.3 * len(chosen))) as ax:
        for y, i in enumerate(chosen):
            word, colour = EFFECTS[int(np.sign(mean[i]))]
            ax.barh(y, size[i], height=0.66, color=colour, alpha=0.9, zorder=2)
            text = f"{word}, mean {mean[i]:+.2g}" if mean[i] else word
            style.note(ax, text, (size[i], y), (5, 0), va="center", fontsize=9, color=colour)
        words = "mean magnitude of the contribution to the log odds of failure"
        ax.set(
            xlabel=f"{words}, {style.count_of(k, 'input')}",
            ylim=(len(chosen) - 0.4, -0.6),
            yticks=range(len(chosen)),
        )
        ax.set_yticklabels([names[i] for i in chosen])
        ax.set_xlim(0, 1.3 * size.max() or 1.0)  # room for the words
        ax.tick_params(axis="y", length=0)
        ax.grid(False, axis="y")
        most = f": the {BARS} greatest of {d:,}" if d > BARS else ""
        ax.set_title(f"Which columns mark the failures{most}")
    return ax


def _map(caller, values, names, background, ax):
    """`contributions` of the pixels of images."""
    from matplotlib.colors import LinearSegmentedColormap

    if names is not None:
        raise style.wrong(caller, "names", "be None for images", type(names).__name__)
    size = np.abs(values).mean(0)
    size = size.sum(2) if size.ndim == 3 else size
    if background is not None:
        given = _numbers(background)
        finite = given is not None and np.isfinite(given).all()
        if not finite or given.ndim not in (2, 3) or given.shape[:2] != size.shape:
            received = "no such array"
            if given is not None:
                received = f"shape {given.shape}{'' if finite else ' with numbers that are not'}"
            must = f"be finite {list(size.shape)} or with channels"
            raise style.wrong(caller, "background", must, received)
        background = given.mean(2) if given.ndim == 3 else given
    tall = float(np.clip(size.shape[0] / size.shape[1], 0.3, 2.0))
    with style.axes(ax, (5.0, max(3.75 * tall + 0.5, 3.2)), layout="compressed") as ax:
        if background is not None:
            low, high = background.min(), background.max()
            most = low + 3 * (high - low) if high > low else low + 1
            ax.imshow(background, cmap="gray_r", vmin=low, vmax=most, zorder=1, **PIXELS)
        heat = LinearSegmentedColormap.from_list("", HEAT)
        most = size.max() or 1
        drawn = ax.imshow(size, cmap=heat, vmin=0, vmax=most, zorder=2, **PIXELS)
        style.unframed(ax)
        ax.spines[:].set_visible(True)
        ax.set_title("Which pixels mark the failures")
        bar = ax.figure.colorbar(drawn, ax=ax, fraction=0.05, pad=0.03)
        words = "mean magnitude of the contribution\nto the log odds of failure"
        bar.set_label(f"{words}, {style.count_of(len(values), 'input')}", fontsize=9)
        bar.ax.grid(False)
        bar.outline.set_edgecolor(style.GREY)
    return ax


def _words(caller, names, largest):
    """Class -> its name, or a ValueError where ``names`` do not reach ``largest``."""
    if names is None:
        return str
    listed = isinstance(names, list | tuple | np.ndarray)
    if not listed or len(names) <= largest:
        must = f"be a list of one for each class, at least {largest + 1}"
        raise style.wrong(caller, "names", must, len(names) if listed else type(names).__name__)
    return lambda label: str(names[label])


def _image(ax, image, every):
    """One image; grey from the least to the greatest number of ``every``."""
    if image.ndim == 3 and image.shape[2] > 1:
        full = 255 if every.dtype.kind in "iu" else 1
        low, high = min(every.min(), 0), max(every.max(), full)
        ax.imshow((image.astype(float) - low) / (float(high) - low), **PIXELS)
    else:
        grey = image.reshape(image.shape[:2]).astype(float)
        ends = dict(vmin=float(every.min()), vmax=float(every.max()))
        ax.imshow(grey, cmap="gray", **ends, **PIXELS)
    style.unframed(ax)
    ax.spines[:].set_visible(False)


def _say(ax, words):
    """Nothing but ``words``."""
    ax.set_axis_off()
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color=style.GREY)


def _numbers(values):
    """An array of floats, or None."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        return None
