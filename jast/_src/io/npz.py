"""Files of arrays: an npz that `numpy.load` opens without pickle, whose entry ``header`` is JSON
with a format, a version and a checksum.

What all of jast's files have in common. All arrays are NumPy's: they keep their dtype whatever the
precision that JAX is set to.
"""

import hashlib
import io
import json
import os
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import PathLike
from jast._src.io.atomic import replacing
from jast._src.util.checks import check_path

__all__ = ["misfit", "pack", "read", "unknown", "unpack", "write"]

Header = dict[str, Any]
Arrays = dict[str, np.ndarray]


def write(
    path: PathLike,
    format: str,
    version: int,
    header: Header,
    arrays: Arrays,
    *,
    quick: bool = False,
) -> None:
    """Write ``arrays`` and ``header``, a dict that JSON can hold, to the file ``path``.

    The write is atomic: an existing file is replaced only once the new one is complete. A ``quick``
    write is not compressed and does not wait for the disk, so it survives the end of the process
    but perhaps not a crash of the machine.
    """
    entries = _entries(format, version, header, arrays)
    with replacing(path) as file:
        (np.savez if quick else np.savez_compressed)(file, **entries)
        file.flush()
        if not quick:
            os.fsync(file.fileno())


def pack(format: str, version: int, header: Header, arrays: Arrays) -> bytes:
    """The bytes of a file of `write`."""
    file = io.BytesIO()
    np.savez(file, **_entries(format, version, header, arrays))
    return file.getvalue()


def read(path: PathLike, formats: Mapping[str, int], kind: str) -> tuple[Header, Arrays]:
    """Read a file of `write`: ``(header, arrays)``, with ``package``, the jast that wrote it, in
    the header.

    ValueError says why a file is refused: not ``kind``, which is of one of these ``formats``;
    another version than that of its format; or damaged.
    """
    check_path("load", path)
    if os.path.isdir(path):
        raise refusal(path, f"is not {kind} but a folder, such as checkpoint= makes")
    with open(path, "rb") as file:
        return unpack(file.read(), path, formats, kind)


def unpack(
    data: bytes, path: PathLike, formats: Mapping[str, int], kind: str
) -> tuple[Header, Arrays]:
    """`read` of the bytes of a file; ``path``: what errors call it."""
    if data[:2] != b"PK":
        raise refusal(path, f"is not {kind}")
    try:
        with np.lib.npyio.NpzFile(io.BytesIO(data)) as pack:  # which takes no pickle
            arrays = {name.removesuffix(".npy"): pack[name] for name in pack.zip.namelist()}
        if odd := [name for name, a in arrays.items() if not isinstance(a, np.ndarray)]:
            raise ValueError(f"{odd} hold no arrays")
        header = json.loads(arrays.pop("header").tobytes()) if "header" in arrays else {}
    except Exception as error:  # a damaged zip fails in many ways
        words = f"is damaged or truncated ({type(error).__name__}: {error})"
        raise refusal(path, words) from None
    format = header.get("format") if isinstance(header, dict) else None
    if format not in formats:
        raise refusal(path, f"is not {kind}: its format is {format!r}")
    if header.get("version") != formats[format]:
        words = f"has version {header.get('version')!r}, and this jast reads version"
        words += f" {formats[format]}: use the jast that wrote the file, {header.get('package')}"
        raise refusal(path, words)
    dtypes = header.get("dtypes", {})
    if set(dtypes) != set(arrays):
        unlike = sorted(set(dtypes) ^ set(arrays))
        words = f"is damaged: its list of arrays and the arrays themselves differ in {unlike}"
        raise refusal(path, words)
    for name, dtype in dtypes.items():
        if arrays[name].dtype.name != dtype:
            arrays[name] = arrays[name].view(jnp.dtype(dtype))
    if header.pop("sha256", None) != _checksum(header, arrays):
        raise refusal(path, "is damaged: its checksum does not match")
    return header, arrays


def refusal(path: Any, words: str) -> ValueError:
    """The error of a file that is not taken."""
    return ValueError(f"load: {path} {words}")


def misfit(path: Any, other: str, words: str) -> ValueError:
    """The error where a file does not fit what was given with it."""
    return refusal(path, f"does not fit {other}: {words}")


def unknown(path: Any, what: str) -> ValueError:
    """The error where a file holds what only a later version writes."""
    words = "which this jast does not know: use the jast that wrote the file"
    return refusal(path, f"{what}, {words}")


def _entries(format: str, version: int, header: Header, arrays: Arrays) -> Arrays:
    """What `numpy.savez` is to write."""
    from jast import __version__  # not at import: the package imports this module

    header = dict(format=format, version=version, package=__version__) | header
    header["dtypes"] = {name: a.dtype.name for name, a in arrays.items()}
    header["sha256"] = _checksum(header, arrays)
    # extended floats have no NumPy name in a file, so they are stored as bits
    bits = {
        name: a.view(f"u{a.dtype.itemsize}") if a.dtype.kind == "V" else a
        for name, a in arrays.items()
    }
    return dict(header=np.frombuffer(json.dumps(header).encode(), np.uint8), **bits)


def _checksum(header: Header, arrays: Arrays) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        a = arrays[name]
        digest.update(f"{name} {a.dtype.name} {a.shape}".encode())
        digest.update(np.ascontiguousarray(a).tobytes())
    return digest.hexdigest()
