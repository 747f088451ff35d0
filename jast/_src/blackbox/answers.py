"""What a black box has answered, by its disturbances: so no run is made twice. NumPy only, never
JAX.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from hashlib import blake2b
from typing import NamedTuple

import numpy as np

from jast._src.blackbox.worker import history

__all__ = ["Answer", "Answers", "Failing", "keys_of"]

HELD = 2**26
"""Bytes that answers may take, those of failures and those of others each; then the oldest goes."""
ENTRY = 350
"""Bytes of one answer in CPython, beside 8 for each observed number."""
FAILURES = 4096
"""Failing runs that are kept with their disturbances; then the oldest goes."""
KEY = 16
"""Bytes that tell histories apart: two of 2^32 have the same ones with a chance of 3e-20."""


class Answer(NamedTuple):
    """The outcome of one row."""

    event: bool
    distance: float
    """NaN where something went wrong."""
    terminal: bool
    log_p: float
    seen: bytes
    """float64: what ``observe`` returned."""


class Failing(NamedTuple):
    """A run that failed."""

    x0: list[np.ndarray]
    xs: list[np.ndarray]
    """[horizon, ...]: the first ``t`` rows; zeros after them."""
    t: int


class Answers:
    """The answers to histories: a bounded memory that loses the oldest first, of failures last."""

    def __init__(self, size: int):
        """``size``: how many numbers are observed."""
        self.size, self.most = size, max(HELD // (ENTRY + 8 * size), 1)
        self.failing: dict[bytes, Answer] = {}
        self.others: dict[bytes, Answer] = {}
        self.failures: deque[Failing] = deque(maxlen=FAILURES)

    def get(self, key: bytes) -> Answer | None:
        return self.failing.get(key) or self.others.get(key)

    def put(self, key: bytes, answer: Answer) -> None:
        kept = self.failing if answer.event else self.others
        if len(kept) >= self.most:
            del kept[next(iter(kept))]
        kept[key] = answer


def keys_of(x0: list[np.ndarray], xs: list[np.ndarray], t: np.ndarray) -> list[bytes]:
    """What stands for the history of each row: ``t`` [n] disturbances; leaves of x0 [n, ...] and
    [n, >= t, ...].
    """
    return [_key(history([a[i] for a in x0], [a[i] for a in xs], int(t[i]))) for i in range(len(t))]


def _key(parts: Iterable) -> bytes:
    count, *leaves = parts
    digest = blake2b(str(count).encode(), digest_size=KEY)
    for leaf in leaves:  # whose sizes are those of their shapes: none runs into the next
        digest.update(leaf)
    return digest.digest()
