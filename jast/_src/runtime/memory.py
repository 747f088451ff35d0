"""What a process may hold: memory for arrays, and compiled programs.

A long call says before it starts when its arrays will not fit (`require`). JAX keeps every program
that it compiled, and with it the functions of a simulator, whether or not anybody else still has
them; `release` lets them go where there are many.
"""

import os
from pathlib import Path
from typing import Any

import jax

from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.runtime._jax import is_tracing

__all__ = ["available", "readable", "release", "require", "require_episodes", "size"]

MAPS = 16_000
"""Mappings of memory from which programs are released, some 2 GB: a process of Linux may have
65,530 by default (vm.max_map_count), beyond which the compiler dies. A system that `jast.stress`
runs takes some 2300.
"""
USABLE = 0.8  # of what is free: the rest is for what a call does not count
_MAPS = Path("/proc/self/maps")
_FREE = Path("/proc/meminfo")
_GROUP = Path("/sys/fs/cgroup")


def available() -> int | None:
    """Bytes that are free now: of the default accelerator, or of the machine (or the container)
    where that is a CPU; None where the system does not tell.
    """
    device = jax.devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        limit = stats.get("bytes_limit")
        return None if limit is None else limit - stats.get("bytes_in_use", 0)
    told = [n for n in (_free_in_machine(), _free_in_container()) if n is not None]
    return min(told, default=None)


def require(function: str, needed: int, what: str, advice: str) -> None:
    """ValueError where ``needed`` bytes are more than four fifths of those that are free, with the
    numbers. To be asked before the work begins.

    Args:
        function: that needs them, for the message.
        needed: bytes, at least.
        what: takes them, as in "the records of 1000 episodes".
        advice: what to do, as in "use fewer episodes".
    """
    free = available()
    if free is not None and needed > USABLE * free:
        raise ValueError(
            f"{function}: {what} need at least {readable(needed)}, and {readable(free)} are free;"
            f" {advice}"
        )


def require_episodes(function: str, sim: Simulator, samples: int) -> None:
    """`require` for the disturbances of ``samples`` episodes, which ``function`` holds at once,
    drawn and as they are used.
    """
    signature = signature_of(sim)
    one = size(signature.x0) + sim.horizon * size(signature.x)
    require(function, 2 * samples * one, f"{samples} episodes at once", "use fewer samples")


def size(tree: Any) -> int:
    """Bytes of the arrays of ``tree``, or of what has their shapes and dtypes."""
    return sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(tree))


def readable(n: float) -> str:
    """``n`` bytes for people."""
    for unit in ("B", "kB", "MB", "GB"):
        if n < 1000:
            return f"{n:.3g} {unit}"
        n /= 1000
    return f"{n:.3g} TB"


def release() -> None:
    """`jax.clear_caches` where the process has more than `MAPS` mappings of memory. What is still
    used compiles once more when it is next called. Only Linux tells; does nothing while JAX traces.
    """
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > MAPS and not is_tracing():
        jax.clear_caches()


def _free_in_machine() -> int | None:
    try:
        for line in _FREE.read_text().splitlines():
            if line.startswith("MemAvailable"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def _free_in_container() -> int | None:
    """What the limit of a control group (version 2) leaves, as seen from inside of it; None where
    there is none. What it holds for files alone can be taken.
    """
    try:
        limit = int((_GROUP / "memory.max").read_text())
        used = int((_GROUP / "memory.current").read_text())
        rows = dict(line.split() for line in (_GROUP / "memory.stat").read_text().splitlines())
        return max(0, limit - used + int(rows["inactive_file"]))
    except (OSError, ValueError, KeyError):
        return None
