"""Labelled data sets: IDX files, built by hand, whole and damaged; scikit-learn's digits."""

import gzip
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from jast._src.weakness.data import digits, from_idx, idx

MNIST = Path(__file__).resolve().parents[2] / "shared" / "data" / "mnist"
CODES = {
    0x08: ("u1", "B"),
    0x09: ("i1", "b"),
    0x0B: ("i2", "h"),
    0x0C: ("i4", "i"),
    0x0D: ("f4", "f"),
    0x0E: ("f8", "d"),
}


def golden(code, shape, numbers):
    """The bytes of an IDX file, by the struct module alone."""
    letter = CODES[code][1]
    return (
        bytes([0, 0, code, len(shape)])
        + b"".join(struct.pack(">I", n) for n in shape)
        + struct.pack(f">{len(numbers)}{letter}", *numbers)
    )


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("code", CODES)
def test_idx_reads_every_type(tmp_path, code, packed):
    numbers = [0, 1, 100, 127, 5, 6] if code == 0x08 else [0, -1, 100, -128, 5, 6]
    path = tmp_path / ("a.gz" if packed else "a")
    raw = golden(code, (2, 3), numbers)
    path.write_bytes(gzip.compress(raw) if packed else raw)
    array = idx(path)
    assert array.dtype == np.dtype(CODES[code][0])
    assert array.dtype.isnative
    assert array.shape == (2, 3)
    assert array.flags.writeable
    assert array.ravel().tolist() == numbers


def test_idx_reads_bytes_written_out(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes.fromhex("00000b02 00000002 00000001 0102 fffe"))
    np.testing.assert_array_equal(idx(path), np.array([[258], [-2]], np.int16))
    path.write_bytes(bytes.fromhex("00000d01 00000002 3f800000 c0000000"))
    np.testing.assert_array_equal(idx(str(path)), np.array([1, -2], np.float32))
    path.write_bytes(bytes.fromhex("00000801 00000000"))
    assert idx(path).shape == (0,)
    path.write_bytes(bytes.fromhex("00000800 07"))
    assert idx(path) == 7


WHOLE = golden(0x08, (2, 2), [1, 2, 3, 4])
DAMAGED = {
    "nothing": (b"", "starting with two zero bytes"),
    "magic": (b"\1" + WHOLE[1:], "starting with two zero bytes"),
    "text": (b"<html>not found", "starting with two zero bytes"),
    "type": (bytes([0, 0, 0x0A]) + WHOLE[3:], "received 0x0A"),
    "header": (WHOLE[:7], "cut off in its header: 2 dimensions take 12 bytes, received 7"),
    "dimensions": (
        bytes([0, 0, 8, 255]) + WHOLE[4:],
        "255 dimensions take 1024 bytes, received 16",
    ),
    "short": (
        WHOLE[:-1],
        "cut off: uint8 of shape \\(2, 2\\) is 4 bytes after the header, received 3",
    ),
    "long": (
        WHOLE + b"\0",
        "too long: uint8 of shape \\(2, 2\\) is 4 bytes after the header, received 5",
    ),
    "huge": (golden(0x0E, (2**32 - 1,) * 3, [1.0]), "cut off"),
    "gzip cut off": (gzip.compress(WHOLE)[:-9], "whole gzip file"),
    "gzip header": (gzip.compress(WHOLE)[:5], "whole gzip file"),
    "gzip checksum": (gzip.compress(WHOLE)[:-8] + b"\0" * 8, "whole gzip file"),
    "gzip middle": (
        gzip.compress(WHOLE)[:12] + b"\xff" * 6 + gzip.compress(WHOLE)[18:],
        "whole gzip file",
    ),
    "gzip of damaged": (gzip.compress(WHOLE[:-1]), "cut off"),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_idx_says_what_is_wrong(tmp_path, kind):
    raw, why = DAMAGED[kind]
    path = tmp_path / "bad-file"
    path.write_bytes(raw)
    with pytest.raises(ValueError, match=f"(?s)^idx: .*bad-file.*{why}"):
        idx(path)


def test_no_file_is_not_a_damaged_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        idx(tmp_path / "none")


IMAGES = golden(0x08, (2, 1, 3), [0, 255, 51, 1, 2, 3])
LABELS = golden(0x08, (2,), [7, 0])


@pytest.mark.parametrize("joint", "-.")
@pytest.mark.parametrize("packed", [False, True])
def test_from_idx(tmp_path, joint, packed):
    for part, raw in (f"images{joint}idx3", IMAGES), (f"labels{joint}idx1", LABELS):
        (tmp_path / f"some-{part}-ubyte{'.gz' * packed}").write_bytes(
            gzip.compress(raw) if packed else raw
        )
    inputs, labels = from_idx(tmp_path, "some")
    assert inputs.dtype == np.float32
    assert inputs.shape == (2, 1, 3)
    assert labels.dtype == np.int32
    np.testing.assert_array_equal(
        inputs.ravel(), np.array([0, 255, 51, 1, 2, 3], np.float32) / np.float32(255)
    )
    assert labels.tolist() == [7, 0]


def test_from_idx_says_what_is_wrong(tmp_path):
    images, labels = tmp_path / "t10k-images-idx3-ubyte", tmp_path / "t10k-labels-idx1-ubyte"
    with pytest.raises(
        FileNotFoundError, match="from_idx: none of .*t10k-images.idx3-ubyte.gz is in "
    ):
        from_idx(tmp_path)
    images.write_bytes(IMAGES)
    with pytest.raises(FileNotFoundError, match="t10k-labels-idx1-ubyte"):
        from_idx(tmp_path)
    labels.write_bytes(golden(0x08, (3,), [7, 0, 1]))
    with pytest.raises(ValueError, match="from_idx: t10k .*received 2 images and 3 labels"):
        from_idx(tmp_path)
    labels.write_bytes(golden(0x0C, (2,), [7, 0]))
    with pytest.raises(ValueError, match="from_idx: .*labels.* 1 dimensions, received int32"):
        from_idx(tmp_path)
    labels.write_bytes(IMAGES)
    with pytest.raises(
        ValueError, match="from_idx: .*labels.* received uint8 of shape \\(2, 1, 3\\)"
    ):
        from_idx(tmp_path)
    labels.write_bytes(LABELS[:-1])
    with pytest.raises(ValueError, match="idx: .*labels.* cut off"):
        from_idx(tmp_path)


def test_digits():
    inputs, labels = digits()
    assert inputs.dtype == np.float32
    assert inputs.shape == (1797, 8, 8)
    assert labels.dtype == np.int32
    assert labels.shape == (1797,)
    assert inputs.min() == 0
    assert inputs.max() == 1
    assert set(labels.tolist()) == set(range(10))
    assert np.isin(inputs * 16, np.arange(17)).all()


def test_digits_without_scikit_learn(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.datasets", None)
    with pytest.raises(ImportError, match="jast\\[digits\\]"):
        digits()


@pytest.mark.skipif(
    not MNIST.is_dir(), reason="the MNIST test images are not here: ../shared/data/mnist"
)
def test_mnist():
    inputs, labels = from_idx(MNIST)
    assert inputs.shape == (10000, 28, 28)
    assert inputs.min() == 0
    assert inputs.max() == 1
    # as published
    assert np.bincount(labels).tolist() == [980, 1135, 1032, 1010, 982, 892, 958, 1028, 974, 1009]
    weights = np.load(MNIST / "sut_784x32x10.npz")
    predicted = np.argmax(
        np.maximum(inputs.reshape(-1, 784) @ weights["W1"] + weights["b1"], 0) @ weights["W2"]
        + weights["b2"],
        axis=1,
    )
    assert np.sum(predicted != labels) == 677
