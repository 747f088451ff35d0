"""How networks and neighbourhoods see the inputs: numbers of order 1, and few of them."""

from typing import NamedTuple

import numpy as np

from jast._src.runtime.memory import require

__all__ = [
    "principal_components",
    "centre",
    "difficulty_of_neighbours",
    "reduce_inputs",
    "require_memory",
    "scale_inputs",
    "squared_distances",
    "make_views",
]

WIDE = 2048  # numbers of an input, above which networks see its principal components: time
KEPT = 512  # so many of them
SPREAD = 0.4  # deviation of centred inputs; a convention
NEIGHBOURS = 15  # that vote on the difficulty of an input; a convention
REFERENCE = 20_000  # inputs among which neighbours are sought: time
ROWS = 1024  # inputs whose neighbours are sought at once: memory


class Views(NamedTuple):
    """Of n inputs, float32."""

    scaled: np.ndarray
    """[n, d]: images: from 0 to 1, over the least and the greatest shade of all; tables: ranks
    within each column, from -0.7 to 0.7; components of wide inputs: by their largest
    """
    centred: np.ndarray
    """[n, d]: mean 0, a deviation of 0.4: of all shades, or of each column"""


def require_memory(data):
    """`runtime.memory.require` for the two copies of the inputs that `make_views` needs."""
    needed = 2 * 4 * data.inputs.size
    require("validate", needed, f"{data.size} inputs as the selector sees them", "use fewer")


def make_views(data, reduced):
    """The `Views` of a `Data`, or of its components ``reduced`` where `reduce_inputs` gave any."""
    if reduced.shape[1]:
        return Views(
            reduced / np.float32(max(np.abs(reduced).max(), 1e-6)),
            reduced * np.float32(SPREAD / max(reduced.std(), 1e-6)),
        )
    x = scale_inputs(data)
    return Views(x if data.image else _column_ranks(data.inputs), centre(x, data.image))


def reduce_inputs(rng, data):
    """[n, 512]: the first principal components of inputs of more than 2048 numbers; [n, 0] of
    others.
    """
    if data.inputs[0].size <= WIDE:
        return np.zeros((data.size, 0), np.float32)
    return principal_components(rng, centre(scale_inputs(data), data.image), KEPT)


def scale_inputs(data):
    """[n, d] float32: the inputs as rows, from 0 to 1 over the least and the greatest number of all
    images, or of each column of a table, where what lies further out than a column's first and last
    hundredth, by more than these are apart, is brought in.
    """
    # small differences may lie on a large mean
    wide = data.inputs.dtype.itemsize > 4 or not data.image
    x = data.inputs.reshape(data.size, -1).astype(np.float64 if wide else np.float32)
    over = None if data.image else 0
    if not data.image:  # a few values far out must not press the others together
        low, high = np.quantile(x, (0.01, 0.99), axis=0)
        x = np.where(high > low, np.clip(x, low - (high - low), high + (high - low)), x)
    low, high = x.min(over), x.max(over)
    return ((x - low) / np.where(high > low, high - low, 1)).astype(np.float32)


def _column_ranks(x):
    """[n, d]: a table's numbers by their place in their column, equal ones by their middle."""
    from scipy.stats import rankdata  # here: slow to import

    return (1.4 * ((rankdata(x, axis=0) - 0.5) / len(x) - 0.5)).astype(np.float32)


def centre(x, image):
    """Rows ``x`` [n, d] with mean 0 and a deviation of 0.4: of all numbers of an image together, or
    of each column of a table.
    """
    x = x - x.mean(0)
    deviation = np.sqrt(np.mean(x**2, axis=None if image else 0))
    # a column that is the same for nearly all inputs must not stand above the others where it is
    # not
    x = np.clip(x / np.where(deviation > 0, deviation, 1), -8, 8)
    return x.astype(np.float32) * np.float32(SPREAD)


def principal_components(rng, x, k):
    """[n, k]: the first k principal components; of wide inputs, those of a random subspace that two
    power iterations turn towards them (Halko, Martinsson and Tropp, 2011).
    """
    k = min(k, x.shape[1])
    if x.shape[1] > WIDE:
        basis = np.linalg.qr(rng.standard_normal((x.shape[1], k + 10), np.float32))[0]
        for _ in range(2):
            basis = np.linalg.qr(x.T @ (x @ basis))[0]
        x = x @ basis
    vectors = np.linalg.eigh((x.T @ x).astype(np.float64))[1]
    return (x @ vectors[:, ::-1][:, :k].astype(np.float32)).astype(np.float32)


def difficulty_of_neighbours(rng, close, labels, classes):
    """[n]: the log odds against each input's label by its 15 nearest others, weighted by their
    inverse squared distances.
    """
    n = len(close)
    reference = np.arange(n) if n <= REFERENCE else np.sort(rng.choice(n, REFERENCE, replace=False))
    k = min(NEIGHBOURS, len(reference) - 1)
    if k < 1:
        return np.zeros(n)
    right = np.zeros(n)
    for at in range(0, n, ROWS):
        rows = np.arange(at, min(at + ROWS, n))
        d2 = squared_distances(close[rows], close[reference])
        d2[rows[:, None] == reference] = np.inf  # not itself
        near = np.argpartition(d2, k - 1, axis=1)[:, :k]
        weight = 1 / (np.take_along_axis(d2, near, 1) + 1e-3)
        same = labels[reference[near]] == labels[rows][:, None]
        right[rows] = np.sum(weight * same, axis=1) / np.sum(weight, axis=1)
    right = (right * k + 1 / classes) / (k + 1)  # one more, that knows nothing
    return np.log1p(-right) - np.log(right)


def squared_distances(a, b):
    """[len(a), len(b)]"""
    return np.maximum(np.sum(a**2, 1)[:, None] + np.sum(b**2, 1) - 2 * a @ b.T, 0)
