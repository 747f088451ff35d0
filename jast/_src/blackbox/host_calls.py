"""The host's side of a black box: batches of rows in, outcomes out, with counts, incidents and a
memory of past outcomes. NumPy only, never JAX.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from jast._src.blackbox.answers import Answers, answer_of, keys_of, part_of
from jast._src.blackbox.rows import fill
from jast._src.runtime.host_errors import Log

__all__ = ["Calls", "Host"]

KEPT_SECONDS = 0.1
"""A checkpoint gets the runs of so many seconds at a time, so a kill loses these. It gets at least
one run, and of several workers four each, so that few wait for the slowest."""


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
    known: int = 0
    """Of the rows, those that were answered before: nothing was run for them"""

    def __str__(self) -> str:
        each = self.seconds / max(self.rows, 1) * 1e3
        return (
            f"{self.episodes} episodes and {self.transitions} transitions in {self.calls} calls,"
            f" {self.seconds:.3g} s: {each:.3g} ms an outcome"
        )


class Host:
    """Answers the callbacks of one simulator, one at a time."""

    def __init__(self, runner, starts):
        """``runner``: configured; ``starts``: how many leaves x0 has."""
        self.runner, self.starts = runner, starts
        self.spec, self.x, self.size = runner.spec, runner.x, runner.size
        self.log = Log()
        self.done = Calls(0, 0, 0, 0, 0.0)
        self.answers = Answers(self.size)
        self.asked_twice: set[bool] = set()  # whether a failure was, and another one
        self.store: Callable[[list], None] | None = None  # of a checkpoint
        self.told: Callable[[int], None] | None = None
        self.differs = False  # the system answered the same history in two ways
        self.last, self.pace = 0, np.inf  # how many runs were made last, and seconds for each
        self.lock = threading.Lock()
        # one callable for each kind of answer, as it is part of what a compiled program is known by
        self.callback = cache(lambda dtype, size: partial(self, dtype, size))

    def __reduce__(self):  # another process counts for itself
        return Host, (self.runner, self.starts)

    def count(self, **more):
        """Add to what has been done so far."""
        now = {name: getattr(self.done, name) + number for name, number in more.items()}
        self.done = self.done._replace(**now)

    @contextlib.contextmanager
    def keep_runs(self, store, name):
        """A context in which the checkpoint ``store`` keeps each run that had an answer, as the
        parts of that ``name``; those that it holds already are known from here on.
        """
        number = 0
        while (part := store.get(number, name)) is not None:
            with self.lock:
                self.answers.put_part(part, self.starts)
            number += 1
        before, numbers = self.store, itertools.count(number)
        self.store = lambda part: store.put(next(numbers), part, name)
        try:
            yield
        finally:
            self.store = before

    @contextlib.contextmanager
    def runs_apart(self):
        """A context that knows no answer from before it; after it both are known."""
        before, self.answers = self.answers, Answers(self.size)
        try:
            yield
        finally:
            with self.lock:
                before.add(self.answers)
                self.answers = before

    @contextlib.contextmanager
    def tell_runs(self, told):
        """A context in which ``told(failing)`` is called after each batch of runs, with the number
        of failing ones in it.
        """
        before, self.told = self.told, told
        try:
            yield
        finally:
            self.told = before

    def failing(self):
        """The `Failing` runs so far, each once; of very many the last ones."""
        with self.lock:
            return list(self.answers.failures)

    def workers(self):
        """How many runs are made at a time."""
        return len(getattr(self.runner, "workers", (None,)))

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
        out = [np.zeros(len(live), kind) for kind in (bool, dtype, bool, dtype)]
        out.append(np.zeros((len(live), size), dtype))
        if len(rows):
            t, *leaves = (flat(a)[rows] for a in (t, *leaves))
            with self.lock:
                begin = time.perf_counter()
                found = self._answer(rows, t, leaves[: self.starts], leaves[self.starts :], dtype)
                self.count(calls=1, seconds=time.perf_counter() - begin)
            for whole, part in zip(out, found):
                whole[rows] = part
        return tuple(a.reshape((*batch, *a.shape[1:])) for a in out)

    def lost(self, x0, xs):
        """How many episodes of objects fail on the way and no longer at the end; ``x0``, ``xs``:
        leaves [n, ...] and [n, horizon, ...].
        """
        with self.lock:
            on_the_way, at_the_end = self.runner.judge(x0, xs).T
            n = len(on_the_way)
            self.count(episodes=n, transitions=n * self.spec.horizon)
        return int(np.sum(on_the_way & ~at_the_end))

    def again(self, x0, xs):
        """What objects say on the way as `worker.Runner.again` has it; ``x0``, ``xs``: leaves
        [2, ...] and [2, horizon, ...].
        """
        with self.lock:
            found, episodes, transitions = self.runner.again(x0, xs)
            self.count(episodes=episodes, transitions=transitions)
        return found

    def _answer(self, lanes, t, x0, xs, dtype):
        """Outcomes of rows: of those that were not answered before, and of a few others
        (`_in_doubt`), the system is asked, once each.
        """
        keys = keys_of(x0, xs, t)
        known = [self.answers.get(key) for key in keys]
        rows, answers = self._to_run(keys, known, t), {}
        self.count(rows=len(t), known=len(t) - len(rows))
        while len(rows):
            n = len(rows) if self.store is None else self._kept_at_once()
            answers |= self._run(keys, rows[:n], lanes, t, x0, xs, dtype)
            rows = rows[n:]
        found = [answers.get(i) or answers.get(keys[i]) or a for i, a in enumerate(known)]
        event, distance, terminal, log_p, seen = zip(*found, strict=True)
        event, terminal = np.array(event, bool), np.array(terminal, bool)
        with np.errstate(over="ignore"):
            distance, log_p = (np.array(a).astype(dtype) for a in (distance, log_p))
        seen = np.frombuffer(b"".join(seen), np.float64).reshape(len(t), self.size).astype(dtype)
        wrong = ~np.isfinite(distance)  # too large for the dtype, too
        distance[wrong], log_p[wrong] = np.nan, 0
        return event & ~wrong, distance, terminal | wrong, log_p, seen

    def _to_run(self, keys, known, t):
        """The rows [m] of which the system is asked."""
        if self.differs:
            return np.arange(len(keys))
        first, twice = {}, []
        for i, before in enumerate(known):
            if before is None:
                first.setdefault(keys[i], i)
            elif self._in_doubt(before, t[i]):
                self.asked_twice.add(before.event)
                twice.append(i)
        return np.array(sorted([*first.values(), *twice]), int)

    def _kept_at_once(self):
        """After how many runs a checkpoint has them."""
        workers = self.workers()
        least = 1 if workers == 1 else 4 * workers
        # one that ended early, as by an error, does not say how long the next ones take
        return max(least, min(2 * self.last, int(KEPT_SECONDS / self.pace)))

    def _in_doubt(self, before, t):
        """Whether a row with this answer is run once more, to see whether it is answered the same:
        the first failure that is asked for again is, and the first other one.
        """
        return t > 0 and before.event not in self.asked_twice and np.isfinite(before.distance)

    def _run(self, keys, rows, lanes, t, x0, xs, dtype):
        """The `Answer` of each of ``rows`` by its number and its key, which are kept."""
        t, lanes = t[rows], lanes[rows]
        x0, xs = [a[rows] for a in x0], [a[rows] for a in xs]
        begin = time.perf_counter()
        reply = self.runner(t, x0, xs, lanes)
        self.last, self.pace = len(t), max(time.perf_counter() - begin, 1e-9) / len(t)
        self.count(episodes=reply.episodes, transitions=reply.transitions)

        def example(i):
            start = fill(self.spec.x0, [a[i] for a in x0])
            return start, fill(self.x, [a[i, : t[i]] for a in xs])

        problems = _problems(reply, dtype)
        for i, (kind, message) in sorted(problems.items()):
            self.log.add(kind, message, partial(example, i))
        found, new = {}, []
        for i, row in enumerate(rows.tolist()):
            key, answer = keys[row], answer_of(reply[:5], i)
            found[row] = found[key] = answer
            if (before := self.answers.get(key)) is None:
                new.append(i)
                self.answers.put(key, answer)
            elif i not in problems:
                self._compare(before, answer, partial(example, i))
        valid = [i for i in new if i not in problems]
        if valid:
            part = part_of([keys[i] for i in rows[valid]], valid, reply, t, x0, xs)
            self.answers.put_failing(part, self.starts)
            if self.store is not None:
                self.store(part)
        if self.told is not None:
            self.told(int(reply.event[valid].sum()))
        return found

    def _compare(self, before, now, example):
        """An incident where the same input had another answer before; from then on nothing is
        answered from memory.
        """
        names = dict(
            event="a failure and no failure", distance="two distances", log_p="two values of log p"
        )
        for field, what in names.items():
            if getattr(before, field) != getattr(now, field):
                self.differs = True
                self.log.add("not deterministic", f"the same disturbances gave {what}", example)
                return


def _problems(reply, dtype):
    """What went wrong in a reply: {its row: (kind, message)}."""
    problems = {i: (kind, message) for i, kind, message in reply.problems}
    with np.errstate(over="ignore"):
        large = ~np.isfinite(reply.distance.astype(dtype))
    for i in np.flatnonzero(large):
        said = f"distance is {reply.distance[i]:g}, too large for {np.dtype(dtype).name}"
        problems.setdefault(i, ("NaN", said))
    return problems
