"""Objects that are saved and resumed: an episode branches without its beginning being run again."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.blackbox.readings import said
from jast._src.blackbox.rows import fill
from jast._src.blackbox.worker import Runner

__all__ = ["BranchingRunner", "Look", "Saved"]


class Look(NamedTuple):
    """What an object says at a state."""

    event: bool
    distance: float
    """NaN where something went wrong, which ends the episode"""
    terminal: bool
    log_p: float
    seen: np.ndarray
    """[k] what ``observe`` returned"""

    def same(self, other: Look) -> bool:
        """Whether the other says the same to the bit."""
        return self[:4] == other[:4] and np.array_equal(self.seen, other.seen)


class Saved(NamedTuple):
    """An object's state."""

    value: Any
    copied: bool
    """It is a copy of the object, not its ``snapshot()``"""


class BranchingRunner(Runner):
    """The objects of a black box, in this process: begun, moved on, saved and resumed. What it does
    is counted where `jast.blackbox.calls` looks, and what goes wrong is an incident.
    """

    def __init__(self, host):
        if not isinstance(host.runner, Runner):
            raise ValueError(
                "splitting: sim must be a black box with workers=0, whose objects are in this"
                " process; for several processes give executor="
            )
        super().__init__(host.runner.system, host.spec, host.x, host.size)
        self.host = host

    def begin(self, x0: Sequence[np.ndarray]) -> tuple[Any, Look]:
        """An object at the start that the leaves ``x0`` lead to; None where something went
        wrong.
        """

        def start():
            thing = self._fresh()
            return thing, 0.0, self._initialize(thing, x0)

        return self._asked(start, x0, [], episodes=1)

    def move(
        self, thing: Any, x0: Sequence[np.ndarray], xs: Sequence[np.ndarray]
    ) -> tuple[Any, Look]:
        """The object, moved on by the last of the disturbances so far, ``xs``: leaves [t, ...]."""

        def step():
            return thing, *self._move(thing, fill(self.x, [np.array(a[-1]) for a in xs]))

        return self._asked(step, x0, xs, transitions=1)

    def save(self, thing: Any) -> Saved:
        """What brings the object back to its state, as often as it is resumed."""
        if hasattr(thing, "snapshot"):
            return Saved(thing.snapshot(), copied=False)
        return Saved(copy.deepcopy(thing), copied=True)

    def resume(self, saved: Saved, x0: Sequence[np.ndarray]) -> Any:
        """An object at a saved state; ``x0``: with which one is begun where none is left over; None
        where something went wrong with that.
        """
        if saved.copied:
            return copy.deepcopy(saved.value)
        thing = self.spare.pop() if self.spare else self.begin(x0)[0]
        if thing is not None:
            thing.restore(saved.value)
        return thing

    def release(self, thing: Any) -> None:
        """The episode of an object is over: it serves another one."""
        self.spare.append(thing)

    def _asked(self, ask, x0, xs, **counts):
        """The object and its `Look`, counted."""
        host, begun = self.host, time.perf_counter()
        try:
            thing, log_p, answer = ask()
            *outcome, seen = self._look(thing, log_p, answer)
            look = Look(*outcome, np.asarray(seen))
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit too: the system's, not ours
            thing, look = None, Look(False, np.nan, True, 0.0, np.zeros(self.size))

            def example():
                return fill(self.spec.x0, list(x0)), fill(self.x, list(xs)) if xs else ()

            host.log.add(*said(error), example)
        with host.lock:
            host.count(calls=1, rows=1, seconds=time.perf_counter() - begun, **counts)
        return thing, look
