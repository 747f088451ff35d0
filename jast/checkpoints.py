"""A checkpoint: a folder that holds the finished parts of a long call, so that the same call
continues where it was ended.

Parts are records of a `jast.ledger`; the state of a chain of steps, each of which replaces the
last, is a file of `jast.archive`. Both have checksums, so each is complete or is not there. Neither
uses pickle.
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
from jast.ledger import Ledger

__all__ = ["PARTS", "Store", "stored"]

ABOUT, STATE, VERSION = "jast checkpoint", "jast checkpoint state", 1
PARTS = "parts.log"
REFUSED = "give another folder, or remove this one to start again"


class Store:
    """What is kept of one call in its folder; made by `stored`."""

    def __init__(self, function: str, folder: Path, ledger: Ledger):
        self._function, self._folder, self._ledger = function, folder, ledger

    def get(self, number: int, name: str) -> list[np.ndarray] | None:
        """The arrays of a part; None where there is no whole one."""
        found = self._ledger.get(f"{name}-{number}")
        if found is None:
            return None
        header, data = found
        out, at, buffer = [], 0, np.frombuffer(data, np.uint8)
        for dtype, shape in header["arrays"]:
            end = at + math.prod(shape) * jnp.dtype(dtype).itemsize
            # a copy: the bytes of an array within others' may lie across what its dtype wants
            out.append(buffer[at:end].copy().view(jnp.dtype(dtype)).reshape(shape))
            at = end
        return out

    def put(self, number: int, arrays: list[Any], name: str) -> None:
        """Keep the arrays of a part. OSError where they cannot be written."""
        arrays = [np.asarray(a) for a in arrays]
        header = dict(arrays=[[a.dtype.name, a.shape] for a in arrays])
        data = b"".join(a.tobytes() for a in arrays)
        with self._told():
            self._ledger.put(f"{name}-{number}", header, data)

    def state(self) -> tuple[dict, dict[str, np.ndarray]] | None:
        """``(header, arrays)`` of where a chain of steps stands; None where there is no whole
        one.
        """
        try:
            return archive.read(self._state, STATE, VERSION, "the state of a checkpoint")
        except (FileNotFoundError, ValueError):  # not there, or damaged with the machine
            return None

    def replace(self, header: dict, arrays: dict[str, np.ndarray]) -> None:
        """Keep the next `state`. The write is atomic: the last one is replaced only once the new
        one is complete. OSError where it cannot be written.
        """
        with self._told():
            archive.write(self._state, STATE, VERSION, header, arrays, quick=True)

    def settled(self, choose: Any) -> dict[str, Any]:
        """``choose()``, a dict that JSON can hold, as the first call chose: what depends on the
        machine's state, such as free memory, stays as it was.
        """
        path = self._folder / "settled.jast"
        if path.exists():
            return archive.read(path, ABOUT, VERSION, "of a checkpoint")[0]["settled"]
        chosen = choose()
        with self._told():
            archive.write(path, ABOUT, VERSION, dict(settled=chosen), {})
        return chosen

    @property
    def _state(self) -> Path:
        return self._folder / "state.jast"

    def _told(self) -> contextlib.AbstractContextManager:
        return _writing(self._function, self._folder)


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
    with contextlib.ExitStack() as stack:
        with _writing(function, folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context(open(folder / "lock", "a+"))
        _locked(function, folder, lock)
        for part in folder.glob("*.part"):  # of a process that was killed while it wrote
            part.unlink()
        _agree(function, folder, fingerprint(function=function, key=key, **about))
        with _writing(function, folder):
            ledger = stack.enter_context(Ledger(folder / PARTS))
        yield Store(function, folder, ledger)


def _agree(function: str, folder: Path, about: dict[str, str]) -> None:
    """ValueError unless the folder is new or its call was ``about`` the same."""
    path = folder / "about.jast"
    if not path.exists():
        others = [p.name for p in folder.iterdir() if p.name != "lock"]
        if others:
            raise ValueError(
                f"{function}: checkpoint {folder} holds other files, such as {sorted(others)[0]}:"
                f" {REFUSED.partition(',')[0]}"
            )
        with _writing(function, folder):
            return archive.write(path, ABOUT, VERSION, dict(about=about), {})
    header, _ = archive.read(path, ABOUT, VERSION, "a checkpoint")
    if unlike := differences(header["about"], about):
        raise ValueError(
            f"{function}: checkpoint {folder} belongs to another call: {unlike}; {REFUSED}"
        )


@contextlib.contextmanager
def _writing(function: str, folder: Path) -> Iterator[None]:
    """A context in which an OSError names the call and the folder."""
    try:
        yield
    except OSError as error:
        text = f"{function}: checkpoint {folder} cannot be written: {error.strerror}"
        raise type(error)(error.errno, f"{text}; what it holds already stays") from error


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
