"""Figures 4.3 to 4.6 of Moss's thesis as printed: what the thesis's adversary tells apart, the
inputs that it finds most suspect, and what it has learned of each pixel.

R. J. Moss, "Algorithms for Efficient Validation of Black-Box Systems", Stanford, 2021, chapter 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from jast._src.core.typing import Array
from jast._src.plot import style
from jast._src.plot.style import Axes
from jast._src.plot.weakness import checked_result
from jast._src.util.checks import number, one_of, whole_number
from jast._src.weakness.encoded import Encoded
from jast._src.weakness.measures import checked_truth, precision_recall
from jast._src.weakness.result import Result

__all__ = ["confusion", "likely_failures", "pixel_likelihood", "threshold_sweep"]

BRIGHT = 10.0  # of the one number of a code that is decoded alone, as in the published notebook
KINDS = ("true positives", "false negatives", "likely failures")


def confusion(
    result: Result, failed: Array, threshold: float = 0.5, ax: Axes | None = None
) -> Axes:
    """How many inputs a score of at least ``threshold`` calls failures, against the truth: the
    confusion matrix of the adversary (figure 4.3b of the thesis).

    Args:
        result: a `jast.weakness.Result`, whose last scores are judged.
        failed: [n] bool, which of all n inputs fail, as only an exhaustive study knows.
        threshold: in 0 .. 1.
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for what is no result, a ``failed`` of another shape or type, and a threshold
            that is no number in 0 .. 1.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> ax = jast.plot.confusion(found, wrong(inputs) != labels)
    """
    caller = "confusion"
    scores = np.asarray(checked_result(caller, result).scores)
    failed = checked_truth(f"plot.{caller}", failed, len(scores))
    threshold = number(f"plot.{caller}", "threshold", threshold, lambda v: 0 <= v <= 1, "in 0 .. 1")
    chosen = scores >= threshold
    counts = np.array([[np.sum((failed == t) & (chosen == c)) for c in (0, 1)] for t in (0, 1)])
    precision, recall = precision_recall(chosen, failed)
    names = ("no failure", "failure")
    with style.axes(ax, (4.2, 3.9)) as ax:
        ax.imshow(np.log1p(counts), cmap="Blues", vmin=0, vmax=1.6 * np.log1p(counts.max()))
        for (row, column), count in np.ndenumerate(counts):
            ax.text(column, row, f"{count:,}", ha="center", va="center", fontsize=13)
        ax.set(xticks=(0, 1), yticks=(0, 1), xlabel="predicted", ylabel="true")
        ax.set_xticklabels(names)
        ax.set_yticklabels(names, rotation=90, va="center")
        ax.grid(False)
        measured = f"precision {precision:.3f}, recall {recall:.3f}"
        ax.set_title(f"Score at least {threshold:g}:\n{measured}")
    return ax


def threshold_sweep(
    result: Result,
    failed: Array,
    thresholds: int | Sequence[float] = 21,
    ax: Axes | None = None,
) -> Axes:
    """Precision and recall of the scores against the threshold from which an input is called a
    failure (figure 4.4b of the thesis).

    Args:
        result, failed, ax: as for `confusion`.
        thresholds: how many, evenly from 0 to 1; at least 2. The thesis has 21.

    Raises:
        ValueError: as `confusion`, and for fewer thresholds.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> ax = jast.plot.threshold_sweep(found, wrong(inputs) != labels)
    """
    caller = "threshold_sweep"
    scores = np.asarray(checked_result(caller, result).scores)
    failed = checked_truth(f"plot.{caller}", failed, len(scores))
    at = np.linspace(0, 1, whole_number(f"plot.{caller}", "thresholds", thresholds, 2))
    precision, recall = np.array([precision_recall(scores >= t, failed) for t in at]).T
    with style.axes(ax, (5.4, 3.6)) as ax:
        ax.plot(at, precision, color=style.BLUE, marker="o", markersize=4, label="precision")
        ax.plot(at, recall, color=style.VERMILION, marker="s", markersize=4, label="recall")
        ax.axvline(0.5, color=style.GREY, linewidth=1, linestyle=":")
        ax.set(xlabel="threshold of the score", ylim=(-0.01, 1.05), xlim=(0, 1))
        ax.legend(loc="best")
    return ax


def likely_failures(
    networks: Encoded,
    inputs: Array,
    failed: Array,
    kind: Literal["true positives", "false negatives", "likely failures"] = "true positives",
    count: int = 10,
    axes: Sequence[Axes] | None = None,
) -> list[Axes]:
    """Images ranked by the adversary's score, a column each: the image, what the decoder makes of
    the strongest number of its code alone, and its reconstruction (figure 4.5 of the thesis).
    Returns the list of Axes, row by row.

    Args:
        networks: `jast.weakness.encoded` of a result.
        inputs: images [n, height, width] of the validation.
        failed: [n] bool: which fail.
        kind: "true positives", the failures of the greatest scores of at least one half (figure
            4.5a); "false negatives", those of the least scores below one half (figure 4.5b);
            "likely failures", the greatest scores, whatever they are.
        count: how many columns, at most.
        axes: at least 3 x that many Axes; None: a new figure.

    Raises:
        ValueError: for what is no `Encoded`, inputs that are no such images, a ``failed`` of
            another shape or type, another kind, a count below 1, no such input, and too few axes.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> small = jast.weakness.thesis(iterations=1, sample=50, hidden=(8,), encoder_epochs=1)
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(jax.random.key(0), wrong, inputs, labels, selector=small)
        >>> networks = jast.weakness.encoded(found, inputs, labels)
        >>> kind, failed = "likely failures", wrong(inputs) != labels
        >>> len(jast.plot.likely_failures(networks, inputs, failed, kind, count=3))
        9
    """
    caller = "likely_failures"
    networks = _networks(caller, networks)
    inputs, n = np.asarray(inputs), len(networks.scores)
    if inputs.shape != (n, *networks.shape) or inputs.ndim != 3:
        must = f"be the images of the validation, {[n, *networks.shape]}"
        raise style.wrong(caller, "inputs", must, f"shape {inputs.shape}")
    failed = checked_truth(f"plot.{caller}", failed, n)
    one_of(f"plot.{caller}", "kind", kind, KINDS)
    suspect = networks.scores >= 0.5
    of_kind = {"true positives": failed & suspect, "false negatives": failed & ~suspect}
    there = of_kind.get(kind, np.ones(n, bool))
    order = np.argsort(networks.scores if kind == "false negatives" else -networks.scores)
    chosen = order[there[order]][: whole_number(f"plot.{caller}", "count", count)]
    if not len(chosen):
        raise ValueError(f"plot.{caller}: there are no {kind} among the inputs")
    codes = networks.codes[chosen]
    strongest = BRIGHT * np.eye(codes.shape[1], dtype=np.float32)[np.argmax(codes, 1)]
    rows = {
        "image": inputs[chosen],
        "strongest\nfeature": networks.decode(strongest),
        "recon-\nstruction": networks.decode(codes),
    }
    columns, size = len(chosen), (1.05 * len(chosen) + 0.8, 3.9)
    count = len(rows) * columns
    with style.panels(caller, axes, size, count, "image of three rows", columns) as axes:
        for i, (name, images) in enumerate(rows.items()):
            for j, image in enumerate(images):
                ax = axes[i * columns + j]
                ax.imshow(image, cmap="gray", vmin=0 if i else None)
                style.unframed(ax)
                if not j:
                    ax.set_ylabel(name)
                if not i:
                    word = "fails" if failed[chosen[j]] else "does not"
                    ax.set_title(f"{networks.scores[chosen[j]]:.3f}\n{word}", fontsize=9)
    return axes


def pixel_likelihood(networks: Encoded, ax: Axes | None = None) -> Axes:
    """A(E(x)) of images that are dark but for one pixel, which is 1: how suspect each pixel alone
    makes an image (figure 4.6 of the thesis).

    Args:
        networks: `jast.weakness.encoded` of a result on images [n, height, width].
        ax: Axes to draw in; None: a new figure.

    Raises:
        ValueError: for what is no `Encoded`, and one of other inputs than images.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> small = jast.weakness.thesis(iterations=1, sample=50, hidden=(8,), encoder_epochs=1)
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(jax.random.key(0), wrong, inputs, labels, selector=small)
        >>> ax = jast.plot.pixel_likelihood(jast.weakness.encoded(found, inputs, labels))
    """
    networks = _networks("pixel_likelihood", networks)
    if len(networks.shape) != 2:
        must = "be of images [height, width]"
        raise style.wrong("pixel_likelihood", "networks", must, f"inputs of shape {networks.shape}")
    scores = networks.score(np.eye(int(np.prod(networks.shape)))).reshape(networks.shape)
    with style.axes(ax, (4.9, 4.1)) as ax:
        shown = ax.imshow(scores, cmap="cividis", interpolation="nearest")
        ax.grid(False)
        ax.set(xlabel="pixel, from the left", ylabel="pixel, from the top")
        ax.set_title("Score of one bright pixel")
        ax.figure.colorbar(shown, ax=ax, fraction=0.05, pad=0.03)
    return ax


def _networks(caller, networks):
    words = "jast.weakness.encoded of a result"
    return style.checked_kind(caller, "networks", networks, Encoded, words)
