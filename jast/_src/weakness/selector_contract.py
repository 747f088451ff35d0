"""What stands between the validation loop and a way of choosing inputs: what it is given, and what
it answers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Seen", "Selector", "Step"]


class Seen(NamedTuple):
    """What the system under test has been asked so far.

    Example:
        >>> import numpy as np
        >>> from jast.weakness import Seen
        >>> seen = Seen(np.array([2, 0]), np.array([1, -1, 3]), np.array([1, 2, 2]))
        >>> seen.tried.tolist(), seen.failed.tolist()
        ([True, False, True], [False, False, True])
    """

    order: np.ndarray
    """[calls] int: the inputs it was run on, in order"""
    predicted: np.ndarray
    """[n] int32: its answers, -1 where it was not run"""
    labels: np.ndarray
    """[n] int32: the true classes"""

    @property
    def tried(self) -> np.ndarray:
        """[n] bool"""
        return self.predicted >= 0

    @property
    def failed(self) -> np.ndarray:
        """[n] bool: run, and wrong"""
        return self.tried & (self.predicted != self.labels)


class Step(NamedTuple):
    """What one iteration of a selector comes to.

    Example:
        >>> import numpy as np
        >>> from jast.weakness import Step
        >>> done = Step({}, np.array([0.9, 0.1, 0.5]), np.array([0]), 0.6)
        >>> int(done.scores.argmax())  # the most suspect input
        0
    """

    memory: dict[str, np.ndarray]
    """Arrays by name: what the next iteration needs of this one"""
    scores: np.ndarray
    """[n] in [0, 1]: how suspect each input is"""
    candidates: np.ndarray
    """[k] int: the inputs that it ran because it held them for failures; their share of failures is
    the iteration's precision
    """
    expected: float
    """Failures that it expects among the inputs not yet run"""


class Selector(NamedTuple):
    """A way of choosing inputs: `default`, `thesis`, `random`, or your own.

    Example:
        >>> import numpy as np, jast
        >>> from jast.weakness import Selector, Step
        >>> def step(key, data, memory, seen, ask):  # in the order of the file
        ...     chosen = np.flatnonzero(~seen.tried)[:10]
        ...     ask(chosen)
        ...     return Step(memory, np.full(data.size, 0.5), chosen, 0.0)
        >>> mine = Selector("in order", {}, lambda key, data: {}, step)
        >>> mine.name
        'in order'
    """

    name: str
    settings: dict[str, Any]
    """Plain numbers and texts: a state of other settings is refused"""
    start: Callable[..., dict[str, np.ndarray]]
    """``start(key, data) -> memory``, before any call"""
    step: Callable[..., Step | None]
    """``step(key, data, memory, seen, ask) -> Step``, or None when there is nothing left to do.
    ``ask(indices)`` runs the system on those of ``indices`` that were not run yet, as far as the
    budget goes, and returns the new `Seen`.
    """
