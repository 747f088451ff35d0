"""A checkpoint: a folder that holds the finished parts of a long call, so that the same call
continues where it was ended, by whatever.

The folder has three files. ``parts.log`` is a file of records that only grows; each record has
checksums, so it is complete or is not there, and an incomplete last one is cut off. ``state.jast``
is where a chain of steps stands, each of which replaces the last. ``about.jast`` says of which call
the folder is. None of them uses pickle.

SQLite would not be simpler: without waiting for the disk at each part (4 ms in place of 0.02) it
needs shared memory, which network file systems do not have, or a lock that keeps readers out; and
checksums, parts above 1 GB and the comparison of calls would be ours all the same.
"""

import contextlib
import contextvars
import hashlib
import itertools
import json
import math
import os
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TextIO

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import Array
from jast._src.io import npz, save_load
from jast._src.io.fingerprint import describe_differences, fingerprint
from jast._src.runtime.host_errors import hosts_of
from jast._src.util.pytrees import index_tree

__all__ = ["Checkpoint", "answer_once", "keep_answers", "open_checkpoint", "step_once"]

PARTS = "parts.log"
ABOUT = "jast checkpoint"
STATE = "jast checkpoint state"
VERSION = 1  # of the formats `ABOUT` and `STATE`
MARK = b"jast"
HEAD = struct.Struct("<4sIQ32s")
"""Of a record: the mark, bytes of its header and of its data, and a checksum of the header."""

_answers = contextvars.ContextVar("answers", default=None)
"""(`Checkpoint`, numbers of the next questions) of the call under way: what asks a system is many
calls below the one that the user made."""


class Record(NamedTuple):
    """Where a record is."""

    header: dict[str, Any]
    """As JSON has it, with the ``name`` and the ``sha256`` of the data."""
    begin: int
    """Of its data, in the file."""
    end: int


class RecordFile(contextlib.AbstractContextManager):
    """The records of a file by their names, the last one of a name. Only one process may have it
    open. A part is a record and not a file, as making a file costs ten times as much.
    """

    def __init__(self, path: str | os.PathLike):
        """OSError where ``path`` cannot be read and written; it is made where there is none."""
        self._file, self._lock = open(path, "a+b", buffering=0), threading.Lock()
        self._records = {r.header["name"]: r for r in read_records(path)}
        self._file.truncate(max((r.end for r in self._records.values()), default=0))

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def get(self, name: str) -> tuple[dict[str, Any], bytes] | None:
        """Header and data of a record; None where there is none, or where it is damaged."""
        if name not in self._records:
            return None
        header, begin, end = self._records[name]
        with self._lock:
            self._file.seek(begin)
            data = self._file.read(end - begin)
        return (header, data) if hashlib.sha256(data).hexdigest() == header["sha256"] else None

    def put(self, name: str, header: dict[str, Any], data: bytes) -> None:
        """Add a record. OSError where it cannot be written; then the file stays as it was."""
        header = header | dict(name=name, sha256=hashlib.sha256(data).hexdigest())
        text = json.dumps(header).encode()
        head = HEAD.pack(MARK, len(text), len(data), hashlib.sha256(text).digest())
        with self._lock:
            start = self._file.seek(0, os.SEEK_END)
            try:
                left = memoryview(head + text + data)
                while left:
                    left = left[self._file.write(left) :]
            except BaseException:  # a full disk, or Ctrl-C
                self._file.truncate(start)
                raise
            begin = start + len(head) + len(text)
            self._records[name] = Record(header, begin, begin + len(data))


def read_records(path: str | os.PathLike) -> Iterator[Record]:
    """The records of a file in order, up to the first that is not whole; also while it grows."""
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        while (record := _read_record(file, size)) is not None:
            yield record
            file.seek(record.end)


def _read_record(file: BinaryIO, size: int) -> Record | None:
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    mark, header_bytes, data_bytes, digest = HEAD.unpack(head)
    text = file.read(header_bytes) if mark == MARK else b""
    begin = file.tell()
    if hashlib.sha256(text).digest() != digest or begin + data_bytes > size:
        return None
    return Record(json.loads(text), begin, begin + data_bytes)


class Checkpoint:
    """What is kept of one call in its folder; made by `open_checkpoint`."""

    def __init__(self, function: str, folder: Path, parts: RecordFile):
        self._function, self._folder, self._parts = function, folder, parts

    def get(self, number: int, name: str) -> list[np.ndarray] | None:
        """The arrays of a part; None where there is no whole one."""
        found = self._parts.get(f"{name}-{number}")
        if found is None:
            return None
        header, data = found
        arrays, begin = [], 0
        for dtype, shape in header["arrays"]:
            flat = np.frombuffer(data, jnp.dtype(dtype), math.prod(shape), begin)
            # a copy: the bytes of an array within others' may lie across what its dtype wants
            arrays.append(flat.copy().reshape(shape))
            begin += flat.nbytes
        return arrays

    def put(self, number: int, arrays: list[Array], name: str) -> None:
        """Keep the arrays of a part. OSError where they cannot be written."""
        arrays = [np.asarray(a) for a in arrays]
        header = dict(arrays=[[a.dtype.name, a.shape] for a in arrays])
        with self._writing():
            self._parts.put(f"{name}-{number}", header, b"".join(a.tobytes() for a in arrays))

    def state(self) -> Any:
        """Where a chain of steps stands; None where there is no whole one."""
        try:
            found = npz.read(self._state, {STATE: VERSION}, "the state of a checkpoint")
        except (FileNotFoundError, ValueError):  # not there, or damaged with the machine
            return None
        return save_load.whole(self._state, *found)

    def replace(self, state: Any) -> None:
        """Keep the next `state`, of which `jast.save` could make a file. The write is atomic: the
        last one is replaced only once the new one is complete. OSError where it cannot be written.
        """
        with self._writing():
            npz.write(self._state, STATE, VERSION, *save_load.parts(state), quick=True)

    def choose_once(self, choose: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """``choose()``, a dict that JSON can hold, as the first call chose: what depends on the
        machine's state, such as free memory, stays as it was.
        """
        if (found := self._parts.get("choice")) is not None:
            return found[0]["choice"]
        choice = choose()
        with self._writing():
            self._parts.put("choice", dict(choice=choice), b"")
        return choice

    @property
    def _state(self) -> Path:
        return self._folder / "state.jast"

    def _writing(self) -> contextlib.AbstractContextManager:
        return _name_errors(self._function, self._folder)


@contextlib.contextmanager
def open_checkpoint(
    function: str, folder: str | os.PathLike | None, key: jax.Array, **about: Any
) -> Iterator[Checkpoint | None]:
    """A context with the `Checkpoint` of a call, which no other process may use meanwhile; None
    where ``folder`` is None. It keeps every finished run of a black box, by its disturbances, and
    hands it those that it holds: none is made twice.

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
        _require_own(function, folder)
        with _name_errors(function, folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context(open(folder / "lock", "a+"))
        _lock(function, folder, lock)
        for part in folder.glob("*.jast.*.part"):  # of a process that was killed while it wrote
            part.unlink()
        _require_same_call(function, folder, fingerprint(function=function, key=key, **about))
        with _name_errors(function, folder):
            parts = stack.enter_context(RecordFile(folder / PARTS))
        checkpoint = Checkpoint(function, folder, parts)
        for i, host in enumerate(hosts_of(about.get("sim"))):
            stack.enter_context(host.keep_runs(checkpoint, f"runs {i}"))
        yield checkpoint


def _require_own(function: str, folder: Path) -> None:
    """ValueError for a folder of other files, in which nothing is changed."""
    if not folder.exists() or (folder / "about.jast").exists():
        return
    names = [p.name for p in folder.iterdir() if p.name != "lock"]
    if others := [n for n in names if not (n.startswith("about.jast.") and n.endswith(".part"))]:
        raise ValueError(
            f"{function}: checkpoint {folder} holds other files, such as {min(others)}:"
            " give another folder"
        )


def _require_same_call(function: str, folder: Path, about: dict[str, str]) -> None:
    """ValueError unless the folder is new or its call was ``about`` the same."""
    path = folder / "about.jast"
    if not path.exists():
        with _name_errors(function, folder):
            return npz.write(path, ABOUT, VERSION, dict(about=about), {})
    header, _ = npz.read(path, {ABOUT: VERSION}, "a checkpoint")
    if unlike := describe_differences(header["about"], about):
        raise ValueError(
            f"{function}: checkpoint {folder} belongs to another call: {unlike}; give another"
            " folder, or remove this one to start again"
        )


@contextlib.contextmanager
def _name_errors(function: str, folder: Path) -> Iterator[None]:
    """A context in which an OSError names the call and the folder."""
    try:
        yield
    except OSError as error:
        text = f"{function}: checkpoint {folder} cannot be written: {error.strerror}"
        raise type(error)(error.errno, f"{text}; what it holds already stays") from error


def _lock(function: str, folder: Path, file: TextIO) -> None:
    """Lock the open file until it is closed, or its process ends. ValueError where another has."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        raise ValueError(
            f"{function}: checkpoint {folder} is in use by another call (process"
            f" {file.read().strip() or 'unknown'}); wait for its end or give another folder"
        ) from None
    file.truncate(0)
    file.write(str(os.getpid()))
    file.flush()


@contextlib.contextmanager
def keep_answers(checkpoint: Checkpoint | None) -> Iterator[None]:
    """A context in which ``checkpoint`` keeps what a system answers, in the order of the questions:
    so a method whose next step depends on the last ones is run again from its beginning, and the
    system is asked only what it was not asked before. Where it is None, that of the call around it
    keeps them, if any.
    """
    if checkpoint is None:
        yield
        return
    before = _answers.set((checkpoint, itertools.count()))
    try:
        yield
    finally:
        _answers.reset(before)


def answer_once(function: Callable[..., Any], *asked: Any, rows: int | None = None) -> Any:
    """``function(*asked)``, a pytree, on the host; of its arrays the first ``rows``, None for all.
    It is from the checkpoint, where that holds the answer to this question: to its number, with
    the arrays in ``asked``.
    """

    def answer() -> Any:
        return index_tree(jax.device_get(function(*asked)), np.s_[:rows])

    return step_once(answer, *asked, like=lambda: function(*asked))


def step_once(step: Callable[[], Any], *asked: Any, like: Callable[[], Any]) -> Any:
    """``step()``, likewise, of a method whose steps depend on the arrays in ``asked``; without a
    checkpoint it is left where it is. ``like``: traced for the structure of what ``step`` returns.
    """
    if _answers.get() is None:
        return step()
    checkpoint, numbers = _answers.get()
    number, question = next(numbers), _hash_arrays(asked)
    kept = checkpoint.get(number, "answer")
    if kept is not None and (kept[0] == question).all():
        return jax.tree.structure(jax.eval_shape(like)).unflatten(kept[1:])
    before = _answers.set(None)  # what it asks within is not asked where this is kept
    try:
        answer = jax.device_get(step())
    finally:
        _answers.reset(before)
    checkpoint.put(number, [question, *jax.tree.leaves(answer)], "answer")
    return answer


def _hash_arrays(tree: Any) -> np.ndarray:
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
