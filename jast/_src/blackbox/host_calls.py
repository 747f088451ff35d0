"""The host's side of a black box: batches of rows in, outcomes out, with counts, incidents and a
memory of past outcomes. NumPy only, never JAX.
"""

from __future__ import annotations

import threading
import time
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from jast._src.blackbox.worker import fill, history
from jast._src.runtime.host_errors import Log

__all__ = ["Calls", "Host"]

REMEMBERED = 1 << 16  # outcomes kept to be compared with, of failures and of others each: some MB


class Calls(NamedTuple):
    """What a black box has done so far. Python numbers.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> run = lambda x: (bool(x.sum() > 5.0), float(max(5.0 - x.sum(), 0.0)))
        >>> sim = jast.blackbox.from_python(run, horizon=10, disturbance=D.Normal(0.0, 1.0))
        >>> before = jast.blackbox.calls(sim).transitions
        >>> episode = jast.replay(sim, jnp.ones(10))
        >>> jast.blackbox.calls(sim).transitions - before
        10
    """

    calls: int
    """Host calls, each for a batch"""
    rows: int
    """Outcomes asked for: episodes, or states of a system that is not episodic"""
    episodes: int
    """Starts of the system"""
    transitions: int
    """Disturbances applied, those of repeated histories included"""
    seconds: float
    """Wall time of the host calls"""

    def __str__(self) -> str:
        each = self.seconds / max(self.rows, 1) * 1e3
        return (
            f"{self.episodes} episodes and {self.transitions} transitions in {self.calls} calls,"
            f" {self.seconds:.3g} s: {each:.3g} ms an outcome"
        )


class Host:
    """Answers the callbacks of one simulator, one at a time."""

    def __init__(self, runner, spec, x, starts):
        """``x``: the structure of a disturbance; ``starts``: how many leaves x0 has."""
        self.runner, self.spec, self.x, self.starts = runner, spec, x, starts
        self.log = Log()
        self.done = Calls(0, 0, 0, 0, 0.0)
        self.failing, self.others = {}, {}
        self.lock = threading.Lock()
        # one callable for each kind of answer, as it is part of what a compiled program is known by
        self.callback = cache(lambda dtype, size: partial(self, dtype, size))

    def __reduce__(self):  # another process counts for itself
        return Host, (self.runner, self.spec, self.x, self.starts)

    def incidents(self):
        return self.log.all()

    def calls(self):
        return self.done

    def __call__(self, dtype, size, live, t, *leaves):
        """Outcomes (event, distance, terminal, log p, seen [..., size]) with the leading axes of
        ``live``, a bool a row; zeros where it is False.

        ``t``: disturbances so far; ``leaves``: those of x0, then those of the disturbances. The
        leading axes of each may be 1 where those of another are not.
        """
        n = live.ndim
        batch = np.broadcast_shapes(live.shape, t.shape, *(a.shape[:n] for a in leaves))

        def flat(a):
            return np.broadcast_to(a, (*batch, *a.shape[n:])).reshape((-1, *a.shape[n:]))

        live = flat(live)
        rows = np.flatnonzero(live)
        out = (
            np.zeros(len(live), bool),
            np.zeros(len(live), dtype),
            np.zeros(len(live), bool),
            np.zeros(len(live), dtype),
            np.zeros((len(live), size), dtype),
        )
        if len(rows):
            t, *leaves = (flat(a)[rows] for a in (t, *leaves))
            with self.lock:
                begin = time.perf_counter()
                found = self._answer(rows, t, leaves[: self.starts], leaves[self.starts :], dtype)
                self.done = self.done._replace(
                    calls=self.done.calls + 1,
                    seconds=self.done.seconds + time.perf_counter() - begin,
                )
            for whole, part in zip(out, found):
                whole[rows] = part
        return tuple(a.reshape((*batch, *a.shape[1:])) for a in out)

    def lost(self, x0, xs):
        """How many episodes of objects fail on the way and no longer at the end; ``x0``, ``xs``:
        leaves [n, ...] and [n, horizon, ...].
        """
        rows = [[np.asarray(a) for a in leaves] for leaves in (x0, xs)]
        with self.lock:
            on_the_way, at_the_end = self.runner.judge(*rows).T
            n = len(on_the_way)
            self.done = self.done._replace(
                episodes=self.done.episodes + n,
                transitions=self.done.transitions + n * self.spec.horizon,
            )
        return int(np.sum(on_the_way & ~at_the_end))

    def _answer(self, lanes, t, x0, xs, dtype):
        reply = self.runner(t, x0, xs, lanes)
        count = self.done
        self.done = count._replace(
            rows=count.rows + len(t),
            episodes=count.episodes + reply.episodes,
            transitions=count.transitions + reply.transitions,
        )

        def example(i):
            return (
                fill(self.spec.x0, [a[i] for a in x0]),
                fill(self.x, [a[i, : t[i]] for a in xs]),
            )

        wrong = np.zeros(len(t), bool)
        for i, kind, message in reply.problems:
            wrong[i] = True
            self.log.add(kind, message, partial(example, i))
        with np.errstate(over="ignore"):
            distance = reply.distance.astype(dtype)
            log_p = reply.log_p.astype(dtype)
            seen = reply.seen.astype(dtype)
        for i in np.flatnonzero(~np.isfinite(distance) & ~wrong):
            wrong[i] = True
            said = f"distance is {reply.distance[i]:g}, too large for {np.dtype(dtype).name}"
            self.log.add("NaN", said, partial(example, i))
        event, terminal = reply.event & ~wrong, reply.terminal | wrong
        distance[wrong], log_p[wrong] = np.nan, 0
        for i in np.flatnonzero(~wrong):
            key = hash(history([a[i] for a in x0], [a[i] for a in xs], int(t[i])))
            outcome = bool(event[i]), float(reply.distance[i]), float(reply.log_p[i])
            self._compare(key, outcome, partial(example, i))
        return event, distance, terminal, log_p, seen

    def _compare(self, key, outcome, example):
        """Remember an outcome (event, distance, log p); an incident where the same input had
        another one before.
        """
        before = self.failing.get(key) or self.others.get(key)
        if before is None:
            outcomes = self.failing if outcome[0] else self.others
            if len(outcomes) >= REMEMBERED:
                del outcomes[next(iter(outcomes))]
            outcomes[key] = outcome
        elif before != outcome:
            names = "a failure and no failure", "two distances", "two values of log p"
            what = next(name for name, a, b in zip(names, before, outcome) if a != b)
            self.log.add("not deterministic", f"the same disturbances gave {what}", example)
