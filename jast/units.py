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

from jast._jax import was_interrupted
from jast.checkpoints import Store
from jast.incidents import Incident, merged
from jast.places import Answer, Differs, Gone, Place, Task, devices_of, executor_of, opened
from jast.watch import Watch, terminable

__all__ = ["Ran", "Ways", "joined", "not_traced", "note", "run", "ways"]

State = TypeVar("State")
TRIES = 3


class Ways(NamedTuple):
    """How the units of a call are run."""

    executor: Any = None
    devices: Sequence[jax.Device] | None = None
    store: Store | None = None
    name: str = "unit"
    """Of the parts in the store."""
    keeps: Callable[[Any], bool] = lambda result: True
    """Whether the store is to hold a result."""


HERE = Ways()


class Ran(NamedTuple):
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


class _Kept(NamedTuple):
    state: Any
    done: int = 0
    merged: int = 0


def ways(function: str, executor: Any, devices: Any, store: Store | None = None) -> Ways:
    """The `Ways` of a call by its arguments; ValueError where these cannot be."""
    return Ways(executor_of(function, executor), devices_of(function, devices, executor), store)


def not_traced(function: str, **given: Any) -> None:
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
    ways: Ways = HERE,
    *,
    size: Callable[[int], int] = lambda done: done,
    words: Callable[[State], dict[str, Any]] = lambda state: {},
    threads: int = 1,
    cut: bool = False,
) -> Ran:
    """Run the units 0 to n - 1 and merge what they return, in the order of their numbers.

    Args:
        task: the units.
        n: how many.
        fold: (state, number, result) -> the next state. It changes nothing else, as it may be
            interrupted.
        state: the first one.
        watch: is told after each merge.
        ways: where units run, and where finished ones are kept.
        size: of the first so many units, in units of ``watch``.
        words: of a state, for the bar.
        threads: that units run in, where there is neither an executor nor devices.
        cut: whether a unit that an interruption ends early counts with what it has.

    Returns:
        `Ran`. Ctrl-C, SIGTERM and an executor that takes no more work end it with what is merged
        by then.

    Raises:
        KeyboardInterrupt: where it was interrupted before anything was merged.
        RuntimeError: where an executor did no unit at all.
        ValueError: where a unit cannot be sent to an executor, or its processes have other
            versions.
    """
    with opened(watch.name, task, ways.executor, ways.devices, threads) as place:
        desk = _Desk(task, place, ways, watch)
        kept, sent, ended = _Kept(state), 0, None
        try:
            with terminable():
                while kept.done < n:
                    while sent < min(n, kept.done + place.ahead):
                        desk.begin(sent)
                        sent += 1
                    if kept.done not in desk.ready:
                        if desk.interruption is not None:
                            raise desk.interruption
                        desk.listen()
                        continue
                    # at once: an interruption finds all of a unit or nothing
                    kept = _merged(kept, fold, kept.done, desk.ready[kept.done])
                    del desk.ready[kept.done - 1]
                    watch.reach(max(watch.done, size(kept.done)), **words(kept.state))
                    watch.tell()
        except BaseException as error:
            if not was_interrupted(error) and not isinstance(error, Gone):
                raise
            place.stop()
            ended = f": the executor takes no more work ({error})" * isinstance(error, Gone)
            if cut:
                for number, result in desk.rest(kept.done):
                    kept = _merged(kept, fold, number, result)
            if not kept.merged:
                cause = RuntimeError(f"{watch.name}{ended}") if ended else KeyboardInterrupt()
                raise cause from error
        if n and not kept.merged:
            desk.give_up()
        return Ran(kept.state, kept.done, tuple(sorted(desk.lost)), desk.incidents, ended)


def joined(some: Ran, more: Ran) -> Ran:
    """Two `Ran` in a row, whose states are tuples."""
    left_out = (*some.left_out, *(some.done + i for i in more.left_out))
    incidents = merged(some.incidents, more.incidents)
    return Ran(some.state + more.state, some.done + more.done, left_out, incidents, more.ended)


def note(what: str, ran: Ran, done: int, total: int) -> str | None:
    """In words, that ``ran`` has only ``done`` of ``total`` ``what``; None where it has all."""
    said = "" if ran.ended is None else f"after {done} of {total} {what}{ran.ended}"
    if ran.left_out:
        units = ", ".join(map(str, ran.left_out[:5])) + ", ..." * (len(ran.left_out) > 5)
        lost = f"units {units} are left out, since every attempt failed"
        said = f"{said}; {lost}" if said else f"{done} of {total} {what}: {lost}"
    return said or None


def _merged(kept: _Kept, fold: Callable, number: int, result: Any) -> _Kept:
    if result is None:  # left out
        return kept._replace(done=kept.done + 1)
    return _Kept(fold(kept.state, number, result), kept.done + 1, kept.merged + 1)


class _Desk:
    """Sends units off and takes their answers: ``ready`` has results by number, None for a unit
    that is left out.
    """

    def __init__(self, task: Task, place: Place, ways: Ways, watch: Watch):
        self._place, self._ways, self._store, self._watch = place, ways, ways.store, watch
        self._structure = functools.cache(lambda: jax.tree.structure(task.like()))
        self._tries, self._error, self._any = Counter(), None, False
        self.ready, self.lost, self.incidents, self.interruption = {}, [], (), None

    def begin(self, number: int) -> None:
        """Have a unit run, or take what a checkpoint holds of it."""
        arrays = None if self._store is None else self._store.get(number, self._ways.name)
        if arrays is None:
            self._place.submit(number)
        else:
            self.ready[number] = self._structure().unflatten(arrays)

    def listen(self) -> None:
        """Wait for news, and take all that there are by then."""
        more = 0
        while True:
            item = self._place.news.get()
            if isinstance(item, Answer):
                self._take(item)
            else:
                more += item
            if self._place.news.empty():
                break
        if more:
            self._watch.more(more)

    def rest(self, done: int) -> list[tuple[int, Any]]:
        """What units that were stopped still answered, in order."""
        while not self._place.news.empty():
            item = self._place.news.get()
            if isinstance(item, Answer) and item.error is None and not self._place.elsewhere:
                self.ready[item.number] = item.result
        return sorted((i, r) for i, r in self.ready.items() if i >= done and r is not None)

    def give_up(self) -> None:
        """RuntimeError: a unit that fails in every process does not fail by chance."""
        raise RuntimeError(
            f"{self._watch.name}: every unit of work failed in the executor, {TRIES} times each;"
            f" the last error: {_words(self._error)}"
        ) from self._error

    def _take(self, answer: Answer) -> None:
        number, result, error, incidents = answer
        if isinstance(error, Differs):
            raise ValueError(
                f"{self._watch.name}: a process of the executor runs other versions, so its"
                f" results would differ: {error}"
            )
        if error is not None:
            if was_interrupted(error):  # what came before it is merged first
                self.interruption = error
                return
            if not self._place.elsewhere:
                raise error
            return self._again(number, error)
        if self._place.elsewhere:
            result = self._structure().unflatten(result)
        if self._store is not None and self._ways.keeps(result):
            self._store.put(number, jax.tree.leaves(result), self._ways.name)
        self._any = True
        self.incidents = merged(self.incidents, incidents)
        self.ready[number] = result

    def _again(self, number: int, error: BaseException) -> None:
        self._tries[number] += 1
        self._error = error
        if self._tries[number] < TRIES:
            return self._place.submit(number)
        self.ready[number] = None
        self.lost.append(number)
        lost = Incident("unit left out", f"unit left out: {_words(error)}", 1, None, None)
        self.incidents = merged(self.incidents, (lost,))
        if len(self.lost) == TRIES and not self._any:
            self.give_up()


def _words(error: BaseException | None) -> str:
    return f"{type(error).__name__}: {error}"[:200]
