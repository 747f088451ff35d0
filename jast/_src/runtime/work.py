"""Long work as independent units, merged in the order of their numbers: in threads, on several
devices, or in the processes of an executor, with a checkpoint or without. No bit of a result
depends on where its units ran.

An executor is whatever has ``submit(function, *args)`` and whose futures have ``result()`` and
``add_done_callback``: those of `concurrent.futures`, loky, mpi4py, ipyparallel and Dask. A unit
that raises there, or whose process dies, is tried again twice, and then left out and reported.
"""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax

from jast._src.core.typing import Executor
from jast._src.runtime._jax import was_interrupted
from jast._src.runtime.backends import (
    Backend,
    ExecutorClosed,
    Task,
    UnitResult,
    VersionMismatch,
    check_devices,
    check_executor,
    open_backend,
)
from jast._src.runtime.checkpoints import Checkpoint
from jast._src.runtime.host_errors import Incident, merge_incidents
from jast._src.runtime.progress_bar import Watch, terminable

__all__ = [
    "HERE",
    "Placement",
    "UnitsRun",
    "concatenate",
    "describe_missing",
    "placement",
    "require_untraced",
    "run",
]

State = TypeVar("State")
TRIES = 3  # of a unit in an executor: one process may die by chance, three hardly


class Placement(NamedTuple):
    """Where the units of a call run, and where finished ones are kept."""

    executor: Executor | None = None
    devices: Sequence[jax.Device] | None = None
    store: Checkpoint | None = None
    name: str = "unit"
    """Of the parts in the store."""
    keeps: Callable[[Any], bool] = lambda result: True
    """Whether the store is to hold a result."""


HERE = Placement()


class UnitsRun(NamedTuple):
    """What came of the units."""

    state: Any
    done: int
    """Units up to which all are merged or left out."""
    left_out: tuple[int, ...] = ()
    """Numbers of those that failed again and again."""
    incidents: tuple[Incident, ...] = ()
    """Of units that were left out, and of black boxes in other processes."""
    ended: str | None = None
    """What ended it early, "" for Ctrl-C; None where nothing did."""


class _Merged(NamedTuple):
    state: Any
    done: int = 0
    count: int = 0
    """Of units that are merged, and not left out."""


def placement(
    function: str, executor: Any, devices: Any, store: Checkpoint | None = None
) -> Placement:
    """The `Placement` of a call by its arguments; ValueError where these cannot be."""
    check_executor(function, executor)
    return Placement(executor, check_devices(function, devices, executor), store)


def require_untraced(function: str, **given: Any) -> None:
    """ValueError where one of these arguments is given inside of a transformation of JAX."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(
                f"{function}: {name} must be None inside of jax.jit and jax.vmap, received"
                f" {value!r}"
            )


def run(
    task: Task,
    n: int,
    fold: Callable[[State, int, Any], State],
    state: State,
    watch: Watch,
    where: Placement = HERE,
    *,
    size: Callable[[int], int] = lambda done: done,
    words: Callable[[State], dict[str, Any]] = lambda state: {},
    threads: int = 1,
    cut: bool = False,
) -> UnitsRun:
    """Run the units 0 to n - 1 and merge what they return, in the order of their numbers.

    Args:
        task: the units.
        n: how many.
        fold: (state, number, result) -> the next state. It changes nothing else, as it may be
            interrupted.
        state: the first one.
        watch: is told after each merge.
        where: units run, and finished ones are kept.
        size: of the first so many units, in units of ``watch``.
        words: of a state, for the bar.
        threads: that units run in, where there is neither an executor nor devices.
        cut: whether a unit that an interruption ends early counts with what it has.

    Returns:
        `UnitsRun`. Ctrl-C, SIGTERM and an executor that takes no more work end it with what is
        merged by then.

    Raises:
        KeyboardInterrupt: where it was interrupted before anything was merged.
        RuntimeError: where an executor did no unit at all.
        ValueError: where a unit cannot be sent to an executor, or its processes have other
            versions.
    """
    with open_backend(watch.name, task, where.executor, where.devices, threads) as backend:
        scheduler = _Scheduler(task, backend, where, watch)
        merged = _Merged(state)
        sent, ended = 0, None
        try:
            with terminable():
                while merged.done < n:
                    while sent < min(n, merged.done + backend.ahead):
                        scheduler.begin(sent)
                        sent += 1
                    if merged.done not in scheduler.ready:
                        if scheduler.interruption is not None:
                            raise scheduler.interruption
                        scheduler.listen()
                        continue
                    # at once: an interruption finds all of a unit or nothing
                    merged = _merge(merged, fold, merged.done, scheduler.ready[merged.done])
                    del scheduler.ready[merged.done - 1]
                    watch.reach(max(watch.done, size(merged.done)), **words(merged.state))
                    watch.tell()
        except BaseException as error:
            closed = isinstance(error, ExecutorClosed)
            if not (closed or was_interrupted(error)):
                raise
            backend.stop()
            ended = f": the executor takes no more work ({error})" if closed else ""
            if cut:
                for number, result in scheduler.rest(merged.done):
                    merged = _merge(merged, fold, number, result)
            if not merged.count:
                cause = RuntimeError(f"{watch.name}{ended}") if closed else KeyboardInterrupt()
                raise cause from error
        if n and not merged.count:
            scheduler.give_up()
        left_out = tuple(sorted(scheduler.left_out))
        return UnitsRun(merged.state, merged.done, left_out, scheduler.incidents, ended)


def concatenate(first: UnitsRun, second: UnitsRun) -> UnitsRun:
    """Two `UnitsRun` in a row, whose states are tuples."""
    return UnitsRun(
        state=first.state + second.state,
        done=first.done + second.done,
        left_out=(*first.left_out, *(first.done + i for i in second.left_out)),
        incidents=merge_incidents(first.incidents, second.incidents),
        ended=second.ended,
    )


def describe_missing(what: str, ran: UnitsRun, done: int, total: int) -> str | None:
    """In words, that ``ran`` has only ``done`` of ``total`` ``what``; None where it has all."""
    said = "" if ran.ended is None else f"after {done} of {total} {what}{ran.ended}"
    if ran.left_out:
        units = ", ".join(map(str, ran.left_out[:5])) + ", ..." * (len(ran.left_out) > 5)
        lost = f"units {units} are left out, since every attempt failed"
        said = f"{said}; {lost}" if said else f"{done} of {total} {what}: {lost}"
    return said or None


def _merge(merged: _Merged, fold: Callable, number: int, result: Any) -> _Merged:
    if result is None:  # left out
        return merged._replace(done=merged.done + 1)
    return _Merged(fold(merged.state, number, result), merged.done + 1, merged.count + 1)


class _Scheduler:
    """Sends units off and takes their results: ``ready`` has results by number, None for a unit
    that is left out.
    """

    def __init__(self, task: Task, backend: Backend, where: Placement, watch: Watch):
        self._backend, self._where, self._watch = backend, where, watch
        self._structure = functools.cache(lambda: jax.tree.structure(task.like()))
        self._tries = Counter()
        self._error: BaseException | None = None
        self._any_result = False
        self.ready: dict[int, Any] = {}
        self.left_out: list[int] = []
        self.incidents: tuple[Incident, ...] = ()
        self.interruption: BaseException | None = None

    def begin(self, number: int) -> None:
        """Have a unit run, or take what a checkpoint holds of it."""
        store = self._where.store
        arrays = None if store is None else store.get(number, self._where.name)
        if arrays is None:
            self._backend.submit(number)
        else:
            self.ready[number] = self._structure().unflatten(arrays)

    def listen(self) -> None:
        """Wait for news, and take all that there are by then."""
        reported = 0
        while True:
            item = self._backend.news.get()
            if isinstance(item, UnitResult):
                self._take(item)
            else:
                reported += item
            if self._backend.news.empty():
                break
        if reported:
            self._watch.more(reported)

    def rest(self, done: int) -> list[tuple[int, Any]]:
        """What units that were stopped still returned, in order."""
        while not self._backend.news.empty():
            item = self._backend.news.get()
            good = isinstance(item, UnitResult) and item.error is None
            if good and not self._backend.elsewhere:
                self.ready[item.number] = item.result
        return sorted((i, r) for i, r in self.ready.items() if i >= done and r is not None)

    def give_up(self) -> None:
        """RuntimeError: a unit that fails in every process does not fail by chance."""
        raise RuntimeError(
            f"{self._watch.name}: every unit of work failed in the executor, {TRIES} times each;"
            f" the last error: {_words(self._error)}"
        ) from self._error

    def _take(self, item: UnitResult) -> None:
        error, result = item.error, item.result
        if isinstance(error, VersionMismatch):
            raise ValueError(
                f"{self._watch.name}: a process of the executor runs other versions, so its"
                f" results would differ: {error}"
            )
        if error is not None:
            if was_interrupted(error):  # what came before it is merged first
                self.interruption = error
                return
            if not self._backend.elsewhere:
                raise error
            return self._try_again(item.number, error)
        if self._backend.elsewhere:
            result = self._structure().unflatten(result)
        if self._where.store is not None and self._where.keeps(result):
            self._where.store.put(item.number, jax.tree.leaves(result), self._where.name)
        self._any_result = True
        self.incidents = merge_incidents(self.incidents, item.incidents)
        self.ready[item.number] = result

    def _try_again(self, number: int, error: BaseException) -> None:
        self._tries[number] += 1
        self._error = error
        if self._tries[number] < TRIES:
            return self._backend.submit(number)
        self.ready[number] = None
        self.left_out.append(number)
        lost = Incident("unit left out", f"unit left out: {_words(error)}", 1, None, None)
        self.incidents = merge_incidents(self.incidents, (lost,))
        if len(self.left_out) == TRIES and not self._any_result:
            self.give_up()


def _words(error: BaseException | None) -> str:
    return f"{type(error).__name__}: {error}"[:200]
