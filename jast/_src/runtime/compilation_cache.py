"""Compiled programs on disk, for the next process."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

import jax

from jast._src.core.typing import PathLike
from jast._src.runtime._jax import reset_cache
from jast._src.util.checks import whole_number

__all__ = ["cache"]

LIMIT = 2**30
"""Bytes: the programs of `stress` for the ferry take 1.6 MB, so hundreds of systems fit."""


def cache(folder: PathLike | None = None, *, limit: int = LIMIT) -> Path:
    """Keep compiled programs on disk: the next process that needs one reads it instead of
    compiling it again, which is most of what a first call takes.

    It sets JAX's persistent compilation cache for this process: its folder, and that programs of
    any compile time and size are kept (by JAX's own default those that took less than a second are
    not, which is nearly all of them). A program is known by its code, the version of JAX, the
    options of the compiler and the features of the CPU: one of another machine is not read.

    Args:
        folder: of the programs, which may be shared by processes. Default: the folder that JAX is
            configured with already, else ``jast`` among the caches of this user
            (``$XDG_CACHE_HOME`` or ``~/.cache``; macOS: ``~/Library/Caches``; Windows:
            ``%LOCALAPPDATA%``).
        limit: bytes. Where the folder has more, the oldest programs go, now: it may grow beyond
            before the next call.

    Returns:
        The folder.

    Raises:
        ValueError: where the folder cannot be made, or for a limit below 0.

    Example:
        >>> import jast, tempfile
        >>> jast.cache(tempfile.mkdtemp()).is_dir()
        True
    """
    limit = whole_number("cache", "limit", limit, 0)
    try:
        path = Path(folder or jax.config.jax_compilation_cache_dir or _of_user()).expanduser()
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, TypeError) as e:
        raise ValueError(
            f"cache: folder must be one that can be made, received {folder!r}: {e}"
        ) from e
    _forget(path, limit)
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    reset_cache()
    return path


def _of_user() -> Path:
    """The folder of this user's caches, by the custom of the platform."""
    home = Path.home()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")) / "jast" / "cache"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "jast"
    return Path(os.environ.get("XDG_CACHE_HOME", home / ".cache")) / "jast"


def _forget(folder: Path, limit: int) -> None:
    """Delete the oldest programs in ``folder`` until those left have at most ``limit`` bytes."""
    kept = []
    for file in folder.glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):  # another process may be at it, too
            about = file.stat()
            kept.append((about.st_mtime, about.st_size, file))
    size = sum(bytes for _, bytes, _ in kept)
    for _, bytes, file in sorted(kept):
        if size <= limit:
            return
        file.unlink(missing_ok=True)
        size -= bytes
