"""What the tests of pictures share; without matplotlib they are skipped."""

import numpy as np
import pytest

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

__all__ = ["drawn", "legend", "matplotlib", "plt", "words"]


def drawn(axes):
    """Draws the axes: a layout that does not fit warns, and a warning is an error here."""
    np.ravel(np.asarray(axes, object))[0].figure.canvas.draw()
    return axes


def words(ax):
    return [text.get_text() for text in ax.texts]


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]
