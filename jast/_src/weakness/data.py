"""Labelled data sets: arrays, checked once for everything that works on them, and where they come
from.
"""

from __future__ import annotations

import gzip
import hashlib
import math
import os
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jast._src.core.typing import PathLike
from jast._src.util.checks import check_path, import_library, instance, whole_number, wrong
from jast._src.weakness.result import Result

__all__ = [
    "Data",
    "are_indices",
    "check_data",
    "data_of_result",
    "digits",
    "fingerprint",
    "from_idx",
    "idx",
]

# of IDX files, which are big-endian
TYPES = {0x08: "u1", 0x09: "i1", 0x0B: "i2", 0x0C: "i4", 0x0D: "f4", 0x0E: "f8"}


LARGEST = 1e30  # among the inputs: squares of larger ones overflow float32 networks
MOST_CLASSES = 65_536  # the committee has an output for each


class Data(NamedTuple):
    """A labelled validation set, on the host.

    Example:
        >>> import numpy as np
        >>> from jast.weakness import Data
        >>> Data(np.zeros((3, 8, 8)), np.array([0, 1, 1]), 2).image
        True
    """

    inputs: np.ndarray
    """[n, ...]: n inputs of one shape, as the user's ``predict`` takes them"""
    labels: np.ndarray
    """[n] int32: the true class of each, in 0 ... classes - 1"""
    classes: int

    @property
    def size(self) -> int:
        return len(self.labels)

    @property
    def image(self) -> bool:
        """Whether the inputs are images or other grids, whose numbers have one unit; else they are
        rows of a table, whose columns each have their own.
        """
        return self.inputs.ndim > 2


def check_data(function, inputs, labels, classes=None):
    """A `Data` of ``inputs`` [n, ...] and ``labels`` [n]. ``classes``: how many there are; default:
    the largest label and 1.

    ValueError, in the name of ``function``, for arrays of other shapes or lengths, numbers that are
    not finite, labels that are not whole or out of range.
    """
    inputs, labels = np.asarray(inputs), np.asarray(labels)
    if inputs.ndim < 2 or inputs.dtype.kind not in "fiub" or inputs.size == 0:
        must = "be numbers [n, ...], n inputs of one shape"
        raise wrong(function, "inputs", must, f"{inputs.dtype} of shape {inputs.shape}")
    if inputs.dtype.kind == "f":
        bad = np.flatnonzero(~np.isfinite(inputs).reshape(len(inputs), -1).all(1))
        if len(bad):
            raise ValueError(
                f"{function}: inputs must be finite; {len(bad)} of {len(inputs)} hold NaN or"
                f" infinity, the first is number {bad[0]}"
            )
    if max(abs(float(inputs.max())), abs(float(inputs.min()))) > LARGEST:
        must = f"lie within {LARGEST:g} of 0"
        raise wrong(function, "inputs", must, f"{inputs.min()} to {inputs.max()}")
    if labels.shape != (len(inputs),) or labels.dtype.kind not in "iub":
        hint = ""
        if labels.dtype.kind not in "iub":
            hint = "; np.unique(labels, return_inverse=True)[1] makes such numbers"
        must = f"be whole numbers [{len(inputs)}], one for each input"
        raise wrong(function, "labels", must, f"{labels.dtype} of shape {labels.shape}{hint}")
    classes = max(int(labels.max()) + 1, 2) if classes is None else classes
    classes = whole_number(function, "classes", classes, 2)
    if classes > MOST_CLASSES:
        raise ValueError(
            f"{function}: there may be {MOST_CLASSES} classes, received {classes};"
            " np.unique(labels, return_inverse=True)[1] leaves no gaps"
        )
    bad = np.flatnonzero((labels < 0) | (labels >= classes))
    if len(bad):
        raise ValueError(
            f"{function}: labels must lie in 0 ... {classes - 1}; {len(bad)} do not, the first is"
            f" number {bad[0]}: {labels[bad[0]]}"
        )
    return Data(inputs, labels.astype(np.int32), classes)


def are_indices(at, n):
    """Whether all of the array ``at`` are numbers of inputs, 0 ... ``n`` - 1."""
    return not at.size or bool(at.dtype.kind in "iu" and at.min() >= 0 and at.max() < n)


def data_of_result(function, result, inputs, labels, classes):
    """The `Data` of a ``result``; ValueError for other inputs or labels than its own."""
    instance(function, "result", result, Result, "a Result")
    if classes is None and np.size(labels) and np.asarray(labels).dtype.kind in "iub":
        classes = max(2, int(np.max(result.predicted)) + 1, int(np.max(labels)) + 1)
    data = check_data(function, inputs, labels, classes)
    if fingerprint(data) != result.state.data:
        raise ValueError(f"{function}: inputs and labels are not those of the result")
    return data


def fingerprint(data):
    """A short text that differs for other inputs or labels."""
    digest = hashlib.sha256(f"{data.inputs.dtype} {data.inputs.shape}".encode())
    for array in (data.inputs, data.labels):
        digest.update(np.ascontiguousarray(array).view(np.uint8).data)
    return digest.hexdigest()[:16]


def idx(path: PathLike) -> np.ndarray:
    """The array of one IDX file, the format of MNIST, EMNIST and Fashion-MNIST, compressed with
    gzip or not; in the machine's byte order.

    Y. LeCun, C. Cortes, C. Burges, "The MNIST database of handwritten digits": two zero bytes, a
    code of the type, the number of dimensions, each dimension as a big-endian 32-bit number, then
    the numbers row by row.

    Args:
        path: of the file.

    Raises:
        ValueError: for a file that is damaged or of another format.

    Example:
        >>> import pathlib, tempfile, jast
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder, "labels")
        ...     done = path.write_bytes(bytes([0, 0, 8, 1, 0, 0, 0, 2, 7, 9]))
        ...     jast.weakness.idx(path).tolist()
        [7, 9]
    """
    check_path("idx", path)
    raw = _content(path)
    if len(raw) < 4 or raw[:2] != b"\0\0":
        raise ValueError(
            f"idx: {path} must be an IDX file, starting with two zero bytes, a type and a number of"
            f" dimensions; it starts with {raw[:4]!r}"
        )
    if raw[2] not in TYPES:
        must = f"have a type of {', '.join(f'0x{t:02X}' for t in TYPES)}"
        raise wrong("idx", path, must, f"0x{raw[2]:02X}")
    start = 4 + 4 * raw[3]
    if len(raw) < start:
        raise ValueError(
            f"idx: {path} is cut off in its header: {raw[3]} dimensions take {start} bytes,"
            f" received {len(raw)}"
        )
    kind = np.dtype(f">{TYPES[raw[2]]}")
    shape = tuple(int.from_bytes(raw[at : at + 4], "big") for at in range(4, start, 4))
    size = math.prod(shape) * kind.itemsize
    if len(raw) != start + size:
        state = "cut off" if len(raw) < start + size else "too long"
        raise ValueError(
            f"idx: {path} is {state}: {kind} of shape {shape} is {size} bytes after the header,"
            f" received {len(raw) - start}"
        )
    return np.frombuffer(raw, kind, offset=start).reshape(shape).astype(kind.newbyteorder("="))


def from_idx(folder: PathLike, name: str = "t10k") -> tuple[np.ndarray, np.ndarray]:
    """A labelled set of images from a folder of IDX files: MNIST's, by default its test images.

    The files are ``<name>-images-idx3-ubyte`` and ``<name>-labels-idx1-ubyte``, or with a dot
    before ``idx``, and ``.gz`` after it or not.

    Args:
        folder: of the files.
        name: how both begin.

    Returns:
        ``(inputs [n, height, width] float32 in [0, 1], labels [n] int32)``.

    Raises:
        FileNotFoundError: where there are none.
        ValueError: where they are damaged, or hold something else than n images and n labels of
            unsigned bytes.

    Example:
        >>> import pathlib, tempfile, jast
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     images = pathlib.Path(folder, "t10k-images-idx3-ubyte")
        ...     labels = pathlib.Path(folder, "t10k-labels-idx1-ubyte")
        ...     sizes = lambda *n: b"".join(size.to_bytes(4, "big") for size in n)
        ...     done = images.write_bytes(bytes([0, 0, 8, 3]) + sizes(1, 2, 2) + bytes(4))
        ...     done = labels.write_bytes(bytes([0, 0, 8, 1]) + sizes(1) + bytes([7]))
        ...     [part.shape for part in jast.weakness.from_idx(folder)]
        [(1, 2, 2), (1,)]
    """
    if not isinstance(folder, str | os.PathLike):
        raise ValueError(f"from_idx: folder must be that of the files, received {folder!r:.80}")
    images, labels = (
        _named(folder, f"{name}-{part}", f"idx{dims}-ubyte", dims)
        for part, dims in (("images", 3), ("labels", 1))
    )
    if len(images) != len(labels):
        received = f"{len(images)} images and {len(labels)} labels"
        raise wrong("from_idx", f"{name} in {folder}", "have a label for each image", received)
    return images.astype(np.float32) / np.float32(255), labels.astype(np.int32)


def digits() -> tuple[np.ndarray, np.ndarray]:
    """The handwritten digits that come with scikit-learn, of E. Alpaydin and C. Kaynak.

    Returns:
        ``(inputs [1797, 8, 8] float32 in [0, 1], labels [1797] int32)``.

    Example:
        >>> import jast
        >>> inputs, labels = jast.weakness.digits()
        >>> inputs.shape, labels.shape
        ((1797, 8, 8), (1797,))
    """
    bunch = import_library("digits", "sklearn.datasets", "digits").load_digits()
    return (bunch.images / 16).astype(np.float32), bunch.target.astype(np.int32)


def _content(path):
    raw = Path(path).read_bytes()
    if raw[:2] != b"\x1f\x8b":  # by content: a browser may have unpacked what is still called .gz
        return raw
    try:
        return gzip.decompress(raw)
    except (OSError, EOFError, zlib.error) as error:
        raise wrong("idx", path, "be a whole gzip file", f"one that is damaged: {error}") from error


def _named(folder, stem, ending, dims):
    paths = [
        Path(folder) / f"{stem}{joint}{ending}{packed}" for joint in "-." for packed in ("", ".gz")
    ]
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        raise FileNotFoundError(
            f"from_idx: none of {', '.join(path.name for path in paths)} is in {folder}"
        )
    array = idx(found)
    if array.dtype != np.uint8 or array.ndim != dims:
        must = f"hold unsigned bytes in {dims} dimensions"
        raise wrong("from_idx", found, must, f"{array.dtype} of shape {array.shape}")
    return array
