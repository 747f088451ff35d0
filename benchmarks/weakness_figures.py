"""Figures 4.3 to 4.6 of R. J. Moss's thesis as printed: what its adversary tells apart, the inputs
that it finds most suspect, and what it has learned of each pixel.

``python -m benchmarks.weakness --figures FOLDER`` draws them. Each function draws into the ``ax``
that it is given, or into a new figure. ``result`` is a `jast.weakness.Result` and ``networks`` the
`jast.weakness.encoded` of it; ``failed`` [n] says which of all inputs fail.
"""

from pathlib import Path

import numpy as np

from jast._src.plot import style
from jast._src.plot.weakness import checked_result
from jast._src.util.checks import number, one_of, whole_number
from jast._src.weakness.encoded import Encoded
from jast._src.weakness.measures import checked_truth, precision_recall

__all__ = ["confusion", "draw", "likely_failures", "pixel_likelihood", "threshold_sweep"]

BRIGHT = 10.0  # of the one number of a code that is decoded alone, as in the published notebook
KINDS = ("true positives", "false negatives", "likely failures")


def confusion(result, failed, threshold=0.5, ax=None):
    """Figure 4.3b: how many inputs a score of at least ``threshold`` calls failures, against the
    truth.
    """
    scores, failed = _scores("confusion", result, failed)
    threshold = number("confusion", "threshold", threshold, lambda v: 0 <= v <= 1, "in 0 .. 1")
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


def threshold_sweep(result, failed, thresholds=21, ax=None):
    """Figure 4.4b: precision and recall against the threshold from which an input is called a
    failure, of which there are so many, evenly from 0 to 1.
    """
    scores, failed = _scores("threshold_sweep", result, failed)
    at = np.linspace(0, 1, whole_number("threshold_sweep", "thresholds", thresholds, 2))
    precision, recall = np.array([precision_recall(scores >= t, failed) for t in at]).T
    with style.axes(ax, (5.4, 3.6)) as ax:
        ax.plot(at, precision, color=style.BLUE, marker="o", markersize=4, label="precision")
        ax.plot(at, recall, color=style.VERMILION, marker="s", markersize=4, label="recall")
        ax.axvline(0.5, color=style.GREY, linewidth=1, linestyle=":")
        ax.set(xlabel="threshold of the score", ylim=(-0.01, 1.05), xlim=(0, 1))
        ax.legend(loc="best")
    return ax


def likely_failures(networks, inputs, failed, kind="true positives", count=10, axes=None):
    """Figure 4.5: at most ``count`` images, ranked by the adversary's score. A column has the
    image, what the decoder makes of the strongest number of its code alone, and its reconstruction.
    Returns the Axes, row by row.

    ``kind``: "true positives", the failures of the greatest scores of at least one half (figure
    4.5a); "false negatives", those of the least scores below one half (figure 4.5b); "likely
    failures", the greatest scores, whatever they are.
    """
    caller = "likely_failures"
    inputs, n = np.asarray(inputs), len(_encoded(caller, networks).scores)
    if inputs.shape != (n, *networks.shape) or inputs.ndim != 3:
        must = f"be the images of the validation, {[n, *networks.shape]}"
        raise style.wrong(caller, "inputs", must, f"shape {inputs.shape}")
    failed = checked_truth(caller, failed, n)
    one_of(caller, "kind", kind, KINDS)
    suspect = networks.scores >= 0.5
    of_kind = {"true positives": failed & suspect, "false negatives": failed & ~suspect}
    there = of_kind.get(kind, np.ones(n, bool))
    order = np.argsort(networks.scores if kind == "false negatives" else -networks.scores)
    chosen = order[there[order]][: whole_number(caller, "count", count)]
    if not len(chosen):
        raise ValueError(f"{caller}: there are no {kind} among the inputs")
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


def pixel_likelihood(networks, ax=None):
    """Figure 4.6: A(E(x)) of images that are dark but for one pixel, which is 1: how suspect each
    pixel alone makes an image.
    """
    shape = _encoded("pixel_likelihood", networks).shape
    if len(shape) != 2:
        must = "be of images [height, width]"
        raise style.wrong("pixel_likelihood", "networks", must, f"inputs of shape {shape}")
    scores = networks.score(np.eye(int(np.prod(shape)))).reshape(shape)
    with style.axes(ax, (4.9, 4.1)) as ax:
        shown = ax.imshow(scores, cmap="cividis", interpolation="nearest")
        ax.grid(False)
        ax.set(xlabel="pixel, from the left", ylabel="pixel, from the top")
        ax.set_title("Score of one bright pixel")
        ax.figure.colorbar(shown, ax=ax, fraction=0.05, pad=0.03)
    return ax


def draw(folder, result, networks, inputs, failed):
    """All of them, as PNG files in a folder."""
    figures = {
        "4.3b": confusion(result, failed),
        "4.4b": threshold_sweep(result, failed),
        "4.5": likely_failures(networks, inputs, failed, "likely failures")[0],
        "4.6": pixel_likelihood(networks),
    }
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, ax in figures.items():
        ax.figure.savefig(Path(folder) / f"figure_{name}.png", dpi=150)


def _scores(caller, result, failed):
    """The last scores, and what of the inputs fails."""
    scores = np.asarray(checked_result(caller, result).scores)
    return scores, checked_truth(caller, failed, len(scores))


def _encoded(caller, networks):
    words = "jast.weakness.encoded of a result"
    return style.checked_kind(caller, "networks", networks, Encoded, words)
