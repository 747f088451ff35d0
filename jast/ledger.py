"""A file of records that only grows. Each record has checksums: whatever ended
the process that wrote it, a record is complete or is not there. An incomplete last one is cut off.

Making a file costs ten times as much as adding a record. A checkpoint may have a hundred thousand
parts, so they are records of one file.
"""

import hashlib
import json
import os
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

__all__ = ["Ledger", "records"]

MARK = b"jast"
HEAD = struct.Struct("<4sIQ32s")
"""The mark, bytes of the header and of the data, and a checksum of the header"""


class Record(NamedTuple):
    """Where a record is."""

    header: dict
    """As JSON has it, with the ``name`` and the ``sha256`` of the data"""
    begin: int
    """Of its data, in the file"""
    end: int


class Ledger:
    """The records of a file by their names, the last one of a name; a context manager. Only one
    process may have it open.
    """

    def __init__(self, path: str | os.PathLike):
        """OSError where ``path`` cannot be read and written; it is made where there is none."""
        self._file = open(path, "a+b", buffering=0)
        self._known = {r.header["name"]: r for r in records(path)}
        self._file.truncate(max((r.end for r in self._known.values()), default=0))

    def __enter__(self) -> "Ledger":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def get(self, name: str) -> tuple[dict, bytes] | None:
        """Header and data of a record; None where there is none, or where it is damaged."""
        if name not in self._known:
            return None
        header, begin, end = self._known[name]
        self._file.seek(begin)
        data = self._file.read(end - begin)
        return (header, data) if _checksum(data) == header["sha256"] else None

    def put(self, name: str, header: dict, data: bytes) -> None:
        """Add a record. OSError where it cannot be written; then the file stays as it was."""
        header = header | dict(name=name, sha256=_checksum(data))
        text = json.dumps(header).encode()
        head = HEAD.pack(MARK, len(text), len(data), hashlib.sha256(text).digest())
        start = self._file.seek(0, os.SEEK_END)
        try:
            left = memoryview(head + text + data)
            while left:
                left = left[self._file.write(left) :]
        except BaseException:  # a full disk, or Ctrl-C
            self._file.truncate(start)
            raise
        begin = start + len(head) + len(text)
        self._known[name] = Record(header, begin, begin + len(data))


def records(path: str | os.PathLike) -> Iterator[Record]:
    """The records of a file in order, up to the first that is not whole; also while it grows."""
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        while (record := _next(file, size)) is not None:
            yield record
            file.seek(record.end)


def _next(file: Any, size: int) -> Record | None:
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    mark, of_header, of_data, digest = HEAD.unpack(head)
    text = file.read(of_header) if mark == MARK else b""
    begin = file.tell()
    if hashlib.sha256(text).digest() != digest or begin + of_data > size:
        return None
    return Record(json.loads(text), begin, begin + of_data)


def _checksum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
