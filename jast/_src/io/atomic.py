"""Files that are there whole or not at all."""

import contextlib
import os
from collections.abc import Iterator
from typing import IO, Any

from jast._src.core.typing import PathLike

__all__ = ["replacing"]


@contextlib.contextmanager
def replacing(path: PathLike, mode: str = "wb", **how: Any) -> Iterator[IO[Any]]:
    """A context with an open file that takes the place of ``path`` once it is complete, and never
    where an error ends it.

    Raises:
        FileNotFoundError: that names the folder, where there is none.
    """
    path = os.fspath(path)
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise FileNotFoundError(2, "there is no such folder", folder)
    part = f"{path}.{os.getpid()}.part"
    try:
        with open(part, mode, **how) as file:
            yield file
        os.replace(part, path)
    finally:
        if os.path.exists(part):
            os.unlink(part)
