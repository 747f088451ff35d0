"""Worker processes that run a system: the death or hang of one leaves the others alone."""

import re
import time
import weakref
from collections import deque
from concurrent.futures import FIRST_COMPLETED, wait
from multiprocessing.util import Finalize
from typing import NamedTuple

import numpy as np

from jast._src.blackbox.rows import FAILED, Reply, blank
from jast._src.blackbox.worker_process import AGAIN, JUDGE, PROBE, START, Worker

__all__ = ["Pool"]

GRACE = 1.0  # seconds that a worker has beyond the time limit of what it runs before it is killed
TRIES = 3  # at a piece that a worker does not begin, until its first row is at fault
PIECE = 0.01  # seconds of work in a piece, at least, where that leaves no worker idle


class Unloadable(RuntimeError):
    """A worker process cannot load the system: nothing can be run."""


def _close(workers):
    for each in workers:
        each.kill()


class _Piece(NamedTuple):
    """Rows that a worker runs."""

    worker: Worker
    queue: deque
    """Where the rows come from."""
    rows: np.ndarray
    given: float
    """When it was given to the worker, by `time.monotonic`."""


class Pool:
    """A `worker.Runner` whose rows are shared out over processes.

    Episodes go in pieces to whoever is free; the rows of a system of kept objects stay with their
    worker. A worker that dies is replaced, and the row that ran is the culprit. So is one of which
    a part runs for longer than the time limit and `GRACE`; it costs these and a start of a process.
    What the worker had answered by then is kept, and the rest of its piece runs in another one.
    """

    def __init__(self, payload, workers, spec, x=0, size=0, system=None):
        """``system``: what the payload holds, for the fingerprint of a call."""
        self.payload, self.spec, self.system = payload, spec, system
        self.workers = [Worker(payload) for _ in range(workers)]
        self.configure(x, size)
        self.pace: float | None = None  # seconds a row
        weakref.finalize(self, _close, self.workers)
        # at the end of a process of an executor no finalizer of weakref runs
        Finalize(None, _close, (self.workers,), exitpriority=100)

    def __reduce__(self):  # another process has workers of its own
        return Pool, (self.payload, len(self.workers), self.spec, self.x, self.size)

    def configure(self, x, size):
        """As `worker.Runner.configure`, for all workers."""
        self.x, self.size = x, size
        for w in self.workers:
            if w.executor is not None:
                w.configure(x, size)

    def probe(self, x0):
        """As `worker.Runner.probe`, in the first worker."""
        try:
            self._start(self.workers[:1])
            return self.workers[0].executor.submit(PROBE, x0).result(timeout=START)
        except BaseException as error:
            self.workers[0].kill()
            return _cause(_failure(error))

    def judge(self, x0, xs):
        """As `worker.Runner.judge`, in the first worker; neither of all episodes where it gives no
        answer within their time limits.
        """
        n = len(xs[0])
        limit = None if self.spec.limit is None else n * self.spec.limit + GRACE
        found = self._first(limit, JUDGE, x0, xs)
        return np.zeros((n, 2), bool) if found is None else found

    def again(self, x0, xs):
        """As `worker.Runner.again`, in the first worker."""
        parts = 4 * (2 * self.spec.horizon + 1)
        limit = None if self.spec.limit is None else parts * self.spec.limit + START
        return self._first(limit, AGAIN, x0, xs) or (None, 0, 0)

    def _first(self, limit, task, *args):
        """What the first worker answers within ``limit`` seconds; None where it does not."""
        self._start(self.workers[:1])
        try:
            return self.workers[0].executor.submit(task, *args).result(timeout=limit)
        except BaseException as error:
            self.workers[0].kill()
            _failure(error)

    def __call__(self, t, x0, xs, lanes):
        """As `worker.Runner`: the `Reply` for n rows; ``lanes`` [n]: their places in the
        batch, which a search keeps from step to step.
        """
        n = len(t)
        reply = Reply(*blank(n, self.size), problems=[])
        queues = self._pieces(lanes)
        free, busy = set(self.workers), {}
        try:
            while busy or any(queues):
                tasks = [
                    (w, queue, queue.popleft())
                    for w, queue in zip(self.workers, queues)
                    if w in free and queue
                ]
                self._start([w for w, _, _ in tasks])
                for w, queue, rows in tasks:
                    longest = t[rows].max()
                    leaves = [a[rows] for a in x0], [a[rows, :longest] for a in xs]
                    given = time.monotonic()  # before it may begin
                    try:
                        task = w.serve(t[rows], *leaves)
                    except Exception:  # it died while it had nothing to do
                        w.kill()
                        self._start([w])
                        task = w.serve(t[rows], *leaves)
                    busy[task] = _Piece(w, queue, rows, given)
                    free.remove(w)
                first = min(self._running(piece)[1] for piece in busy.values())
                patience = None if first == np.inf else max(0.0, first - time.monotonic())
                done = wait(busy, patience, FIRST_COMPLETED).done
                late = {}  # task -> the row that runs too long
                for task in set(busy) - done:
                    row, due = self._running(busy[task])
                    if time.monotonic() > due:
                        late[task] = row
                for task in [*done, *late]:
                    piece = busy.pop(task)
                    free.add(piece.worker)
                    limit = f"{self.spec.limit or 0:g} s"
                    problem = "timed out", f"no answer within {limit}, and could not be interrupted"
                    if task in done:
                        try:
                            reply = _merge(reply, piece.rows, Reply(*task.result()))
                            piece.worker.unbegun = 0
                            continue
                        except Exception as error:
                            problem = "died", _cause(error)
                    row = late[task] if task in late else self._running(piece)[0]
                    reply = self._salvage(reply, piece, row, problem)
        except BaseException:  # an interruption: what still runs must not answer the next call
            _close(self.workers)
            raise
        if n:
            self.pace = reply.seconds / n
        return reply

    def _salvage(self, reply, piece, row, problem):
        """``reply`` with what a worker had answered of its piece before the row at this place ended
        it, which had this ``problem``; None: before any began. The others go back to their queue.
        """
        finished = [] if row is None else piece.worker.finished()
        piece.worker.kill()
        piece.worker.unbegun = piece.worker.unbegun + 1 if row is None else 0
        if 0 < piece.worker.unbegun < TRIES:  # it died while it had nothing to do
            piece.queue.appendleft(piece.rows)
            return reply
        places, row = [f[0] for f in finished], row or 0
        for place, found, problems, *_ in finished:
            _put(reply, int(piece.rows[place]), found, problems)
        counts = finished[-1][-2:] if finished else (0, 0)
        if row not in places:  # else it ended the process when it had its answer
            places.append(row)
            _put(reply, int(piece.rows[row]), FAILED, [problem])
            counts = counts[0] + self.spec.episodic, counts[1]
        if len(left := np.delete(piece.rows, places)):
            piece.queue.appendleft(left)
        return _add(reply, *counts, time.monotonic() - piece.given)

    def _pieces(self, lanes):
        """A queue of row numbers for each worker; that of episodes is one for all."""
        count, n = len(self.workers), len(lanes)
        if not self.spec.episodic:
            mine = [np.flatnonzero(lanes % count == i) for i in range(count)]
            return [deque([rows] if len(rows) else []) for rows in mine]
        rows = np.arange(n)
        fair = -(-n // count)
        most = fair if count == 1 or not self.pace else max(1, min(fair, int(PIECE / self.pace)))
        size = max(1, most, -(-n // (4 * count)) if count > 1 else 0)
        return [deque(rows[i : i + size] for i in range(0, n, size))] * count

    def _running(self, piece):
        """Which of its rows runs, None before the first, and when what runs of it must be done."""
        row, began = None, piece.given
        if piece.worker.at[0] > 0:
            began, row = piece.worker.at.tolist()
            row = int(row)
        return row, began + (self.spec.limit or np.inf) + GRACE

    def _start(self, workers):
        starting = [(w, task) for w in workers if (task := w.start()) is not None]
        try:
            for w, task in starting:
                task.result(timeout=START)
                w.configure(self.x, self.size)
        except Exception as error:
            _close(self.workers)
            raise Unloadable(
                f"a worker process could not load the system: {_cause(error)}"
            ) from error


def _merge(all, rows, part):
    for name in ("event", "distance", "terminal", "log_p", "seen"):
        getattr(all, name)[rows] = getattr(part, name)
    all.problems.extend((int(rows[i]), kind, message) for i, kind, message in part.problems)
    return _add(all, part.episodes, part.transitions, part.seconds)


def _put(reply, row, found, problems):
    for array, value in zip(reply, found):
        array[row] = value
    reply.problems.extend((row, *problem) for problem in problems)


def _add(reply, episodes, transitions, seconds):
    return reply._replace(
        episodes=reply.episodes + episodes,
        transitions=reply.transitions + transitions,
        seconds=reply.seconds + seconds,
    )


def _failure(error):
    """``error``, raised again where it is an interruption."""
    if not isinstance(error, Exception):
        raise error
    return error


def _cause(error):
    """Why a worker gave no answer, in one line."""
    if isinstance(error, Unloadable):
        return str(error)
    codes = re.search(r"exit codes? of the workers are \{(.*?)\}", str(error))
    if codes:
        return f"the process ended: {codes[1]}"
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
