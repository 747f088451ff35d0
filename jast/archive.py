"""Files of arrays: an npz that `numpy.load` opens without pickle, whose entry ``header`` is JSON
with a format, a version and a checksum.

What all of jast's files have in common. All arrays are NumPy's: they keep their dtype whatever the
precision that JAX is set to.
"""

import hashlib
import io
import json
import os
import zipfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["write"]


def write(path, format, version, header, arrays, *, quick=False):
    """Write ``arrays``, a dict of NumPy arrays, and ``header``, a dict that JSON can hold, to the
    file ``path``.

    The write is atomic: an existing file is replaced only once the new one is complete. A ``quick``
    write is not compressed and does not wait for the disk, so it survives the end of the process
    but perhaps not a crash of the machine.
    """
    path = os.fspath(path)
    part = f"{path}.{os.getpid()}.part"
    entries = _entries(format, version, header, arrays)
    try:
        with open(part, "wb") as file:
            (np.savez if quick else np.savez_compressed)(file, **entries)
            file.flush()
            if not quick:
                os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        if os.path.exists(part):
            os.unlink(part)


def packed(format, version, header, arrays):
    """The bytes of a file of `write`."""
    file = io.BytesIO()
    np.savez(file, **_entries(format, version, header, arrays))
    return file.getvalue()


def read(path, format, version, kind):
    """Read a file of `write`: ``(header, arrays)``, with ``package``, the jast that wrote it, in
    the header.

    ValueError says why a file is refused: not ``kind`` (which is of this ``format``), a version
    other than ``version``, or damaged.
    """
    with _opened(path, kind) as file:
        return unpacked(file.read(), path, format, version, kind)


def _opened(path, kind):
    if os.path.isdir(path):
        raise ValueError(f"load: {path} is not {kind} but a folder, such as checkpoint= makes")
    return open(path, "rb")


def unpacked(data, path, format, version, kind):
    """`read` of the bytes of a file; ``path``: what errors call it."""
    if data[:2] != b"PK":
        raise ValueError(f"load: {path} is not {kind}")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as pack:
            arrays = {
                name.removesuffix(".npy"): np.lib.format.read_array(
                    io.BytesIO(pack.read(name)), allow_pickle=False
                )
                for name in pack.namelist()
            }
        header = json.loads(arrays.pop("header").tobytes()) if "header" in arrays else {}
    except Exception as error:  # a damaged zip fails in many ways
        raise ValueError(
            f"load: {path} is damaged or truncated ({type(error).__name__}: {error})"
        ) from None
    if not isinstance(header, dict) or header.get("format") != format:
        raise ValueError(f"load: {path} is not {kind}")
    if header.get("version") != version:
        raise ValueError(
            f"load: {path} has version {header.get('version')!r}, and this jast reads version"
            f" {version}: use the jast that wrote the file, {header.get('package')}"
        )
    dtypes = header.get("dtypes", {})
    if set(dtypes) != set(arrays):
        raise ValueError(
            f"load: {path} is damaged: its list of arrays and the arrays themselves differ in"
            f" {sorted(set(dtypes) ^ set(arrays))}"
        )
    arrays = {
        name: (
            arrays[name].view(jnp.dtype(dtype))
            if arrays[name].dtype.name != dtype
            else arrays[name]
        )
        for name, dtype in dtypes.items()
    }
    if header.pop("sha256", None) != _checksum(header, arrays):
        raise ValueError(f"load: {path} is damaged: its checksum does not match")
    return header, arrays


def format_of(path: str | os.PathLike) -> Any:
    """The format of a file of `write`; ValueError where it is none or damaged."""
    with _opened(path, "a file of jast.save") as file:
        if file.read(2) != b"PK":
            raise ValueError(f"load: {path} is not a file of jast.save")
    try:
        with zipfile.ZipFile(path) as pack:
            array = np.lib.format.read_array(io.BytesIO(pack.read("header.npy")))
            return json.loads(array.tobytes())["format"]
    except Exception as error:  # a damaged zip fails in many ways
        raise ValueError(
            f"load: {path} is damaged, truncated or not a file of jast.save"
            f" ({type(error).__name__}: {error})"
        ) from None


def named(parts):
    """The arrays of a dict of pytrees, by the names "part.0", "part.1" ..."""
    return {
        f"{name}.{i}": np.asarray(leaf)
        for name, part in parts.items()
        for i, leaf in enumerate(jax.tree.leaves(part))
    }


def arrays_of(arrays, name):
    """A list: the arrays of the part ``name`` of `named`."""
    return [arrays[f"{name}.{i}"] for i in range(sum(key.startswith(f"{name}.") for key in arrays))]


def describe(tree):
    """A pytree's structure in JSON: its nodes as [kind, names, children], an array as "array"."""
    if tree is None:
        return ["None", [], []]
    below, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=lambda node: node is not tree)
    if len(below) == 1 and below[0][1] is tree:
        return "array"
    plain = type(tree) in (tuple, list) or (
        type(tree) is dict and all(isinstance(key, str) for key in tree)
    )
    names = (
        sorted(tree)
        if plain and isinstance(tree, dict)
        else []
        if plain
        else [jax.tree_util.keystr(path) for path, _ in below]
    )
    return [
        type(tree).__name__ if plain else f"the class {type(tree).__name__}",
        names,
        [describe(child) for _, child in below],
    ]


def check_structure(path, other, name, structure, like):
    """ValueError unless ``structure``, of `describe`, is that of the pytree ``like``. ``other`` is
    the argument that must fit, ``name`` a part of the file.
    """
    expected = describe(like)
    if structure != expected:
        raise ValueError(
            f"load: {path} does not fit {other}: {name} has the structure {structure}, expected"
            f" {expected}"
        )


def check_array(path, other, name, a, like, axes=0):
    """ValueError unless ``a``, without its first ``axes``, has the shape and the kind of number of
    ``like``; the precision may differ.
    """
    kinds = [
        next(
            (
                k
                for k in (jnp.floating, jnp.signedinteger, jnp.unsignedinteger)
                if jnp.issubdtype(d, k)
            ),
            d,
        )
        for d in (a.dtype, like.dtype)
    ]
    shape = a.shape[axes:]
    if shape != like.shape or kinds[0] != kinds[1]:
        raise ValueError(
            f"load: {path} does not fit {other}: {name} has {a.dtype.name}{list(shape)}, expected"
            f" {like.dtype.name}{list(like.shape)}"
        )


def check_part(
    path: str | os.PathLike,
    name: str,
    structure: Any,
    arrays: list[np.ndarray],
    like: Any,
    rows: tuple[int, ...],
    axes: int = 1,
) -> None:
    """ValueError unless ``arrays``, the leaves of a part of this ``structure``, are those of the
    simulator's value ``like``: after the first ``axes``, ``rows`` and then the shape of a value.
    """
    check_structure(path, "sim", name, structure, like)
    for a, s in zip(arrays, jax.tree.leaves(like), strict=True):
        check_array(path, "sim", name, a, jax.ShapeDtypeStruct((*rows, *s.shape), s.dtype), axes)


def _entries(format, version, header, arrays):
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


def _checksum(header, arrays):
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(
            f"{name} {arrays[name].dtype.name} {arrays[name].shape}".encode()
            + np.ascontiguousarray(arrays[name]).tobytes()
        )
    return digest.hexdigest()
