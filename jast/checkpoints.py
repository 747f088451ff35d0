"""A checkpoint: a folder that holds the finished parts of a long call, so that the same call goes
on where it was ended, whatever ended it.

Each part is a file of `jast.archive`: whole or not there, with a checksum, without pickle.
"""

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast import archive
from jast.fingerprint import differences, fingerprint

__all__ = ["Store", "stored"]

ABOUT, PART, VERSION = "jast checkpoint", "jast checkpoint part", 1
REFUSED = "give another folder, or remove this one to begin anew"


class Store:
    """The parts of one call in its folder; made by `stored`."""

    def __init__(self, function: str, folder: Path):
        self._function, self._folder = function, folder

    def get(self, number: int, name: str) -> list[np.ndarray] | None:
        """The arrays of a part; None where there is no whole one."""
        try:
            path = self._path(number, name)
            header, arrays = archive.read(path, PART, VERSION, "a part of a checkpoint")
        except (FileNotFoundError, ValueError):  # not there, or damaged with the machine
            return None
        out, at = [], 0
        for name, shape in header["arrays"]:
            dtype = jnp.dtype(name)
            end = at + math.prod(shape) * dtype.itemsize
            out.append(arrays["data"][at:end].view(dtype).reshape(shape))
            at = end
        return out

    def put(self, number: int, arrays: list[Any], name: str) -> None:
        """Keep the arrays of a part. OSError where they cannot be written."""
        arrays = [np.asarray(a) for a in arrays]
        header = dict(arrays=[[a.dtype.name, a.shape] for a in arrays])
        # as one, since each array of a file takes time of its own
        data = np.frombuffer(b"".join(a.tobytes() for a in arrays), np.uint8)
        self._write(self._path(number, name), PART, header, dict(data=data))

    def settled(self, choose: Any) -> dict[str, Any]:
        """``choose()``, a dict that JSON can hold, as the first call chose: what depends on the
        machine's state, such as free memory, stays as it was.
        """
        path = self._folder / "settled.jast"
        if path.exists():
            return archive.read(path, ABOUT, VERSION, "of a checkpoint")[0]["settled"]
        chosen = choose()
        self._write(path, ABOUT, dict(settled=chosen), {})
        return chosen

    def agree(self, about: dict[str, str]) -> None:
        """ValueError unless the folder is new or its call was ``about`` the same."""
        path = self._folder / "about.jast"
        if not path.exists():
            others = [p.name for p in self._folder.iterdir() if p.name != "lock"]
            if others:
                raise ValueError(
                    f"{self._function}: checkpoint {self._folder} is a folder with other files in"
                    f" it, such as {sorted(others)[0]}: {REFUSED.partition(',')[0]}"
                )
            return self._write(path, ABOUT, dict(about=about), {})
        header, _ = archive.read(path, ABOUT, VERSION, "a checkpoint")
        if unlike := differences(header["about"], about):
            raise ValueError(
                f"{self._function}: checkpoint {self._folder} is of another call: {unlike};"
                f" {REFUSED}"
            )

    def _path(self, number: int, name: str) -> Path:
        return self._folder / f"{name}-{number:06d}.jast"

    def _write(self, path: Path, kind: str, header: dict, arrays: dict) -> None:
        try:
            archive.write(path, kind, VERSION, header, arrays, quick=kind == PART)
        except OSError as error:
            raise _unwritten(self._function, self._folder, error) from error


@contextlib.contextmanager
def stored(
    function: str, folder: str | os.PathLike | None, key: jax.Array, **about: Any
) -> Iterator[Store | None]:
    """A context with the `Store` of a call, which no other process may use meanwhile; None where
    ``folder`` is None.

    Args:
        function: the call's name.
        folder: where the parts are kept; made where there is none.
        key: of the call.
        **about: what its result depends on: the simulator, settings.

    Raises:
        ValueError: for a folder that another process uses, one of another call, with the
            difference, and one that holds other things.
        OSError: where it cannot be written.
    """
    if folder is None:
        yield None
        return
    try:
        folder = Path(folder)
    except TypeError:
        raise ValueError(
            f"{function}: checkpoint must be the path of a folder, received {folder!r}"
        ) from None
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{function}: checkpoint must be a folder, received the file {folder}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = open(folder / "lock", "a+")
    except OSError as error:
        raise _unwritten(function, folder, error) from error
    with lock:
        _locked(function, folder, lock)
        for part in folder.glob("*.part"):  # of a process that was killed while it wrote
            part.unlink()
        store = Store(function, folder)
        store.agree(fingerprint(function=function, key=key, **about))
        yield store


def _unwritten(function: str, folder: Path, error: OSError) -> OSError:
    text = f"{function}: checkpoint {folder} cannot be written: {error.strerror}"
    return type(error)(error.errno, f"{text}; what it holds already stays")


def _locked(function: str, folder: Path, lock: Any) -> None:
    """Lock the open file until it is closed, or its process ends. ValueError where another has."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        raise ValueError(
            f"{function}: checkpoint {folder} is in use by another call (process"
            f" {lock.read().strip() or 'unknown'}); wait for its end or give another folder"
        ) from None
    lock.truncate(0)
    lock.write(str(os.getpid()))
    lock.flush()
