"""What a black box has answered, by its disturbances: so no run is made twice. NumPy only, never
JAX.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from hashlib import blake2b
from typing import NamedTuple

import numpy as np

from jast._src.blackbox.rows import Reply, history

__all__ = ["Answer", "Answers", "answer_of", "keys_of", "part_of"]

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


def answer_of(outcomes: Sequence[np.ndarray], i: int) -> Answer:
    """The `Answer` of row ``i`` of the first five fields of a `Reply`."""
    event, distance, terminal, log_p, seen = (a[i] for a in outcomes)
    return Answer(bool(event), float(distance), bool(terminal), float(log_p), seen.tobytes())


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

    def add(self, others: Answers) -> None:
        """Those of ``others``, too."""
        for key, answer in (*others.others.items(), *others.failing.items()):
            self.put(key, answer)
        self.failures.extend(others.failures)

    def put_part(self, part: list[np.ndarray], starts: int) -> None:
        """The answers and failures of a part of a checkpoint (`part_of`)."""
        for i, key in enumerate(part[0]):
            self.put(key.tobytes(), answer_of(part[1:6], i))
        self.put_failing(part, starts)

    def put_failing(self, part: list[np.ndarray], starts: int) -> None:
        """Those of a part that failed, with their disturbances; ``starts``: leaves of x0."""
        t, *leaves = part[6:]
        for i in range(len(t)):
            rows = [a[i] for a in leaves]
            self.failures.append(Failing(rows[:starts], rows[starts:], int(t[i])))


def part_of(
    keys: list[bytes],
    rows: list[int],
    reply: Reply,
    t: np.ndarray,
    x0: list[np.ndarray],
    xs: list[np.ndarray],
) -> list[np.ndarray]:
    """What a checkpoint keeps of the ``rows`` [n] of a reply: their ``keys`` and answers, and of
    those that failed how many disturbances they had and the leaves of x0 and of these.
    """
    answers = [a[rows] for a in (reply.event, reply.distance, reply.terminal, reply.log_p)]
    failing = np.array(rows)[reply.event[rows]]
    behind = np.arange(xs[0].shape[1]) >= t[failing, None]
    kept = [a[failing] for a in xs]  # copies
    for a in kept:
        a[behind] = 0
    names = np.frombuffer(b"".join(keys), np.uint8).reshape(len(keys), KEY)
    return [names, *answers, reply.seen[rows], t[failing], *(a[failing] for a in x0), *kept]


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
