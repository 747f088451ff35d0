"""Where units of work run: threads of this process, devices, or the processes of an executor. Each
place puts its answers into one queue.
"""

import contextlib
import functools
import importlib.util
import itertools
import pickle
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax

from jast._threads import settings, under
from jast.fingerprint import differences, versions
from jast.incidents import incidents, since

__all__ = ["Answer", "Gone", "Place", "Post", "Task", "devices_of", "executor_of", "opened"]

AHEAD, FAR = 2, 256
"""Units under way or waiting to be merged: for each thread of this process, and for an executor,
which does not say how many processes it has.
"""


class Post:
    """What a unit may tell and ask while it runs; this one is of another process."""

    def more(self, n: int) -> None:
        """``n`` more of what the bar counts are done."""

    def stopped(self) -> bool:
        """Whether it is to end early, with what it has."""
        return False


class Task(NamedTuple):
    """What all units have in common."""

    function: Callable[[Any, int, Post], Any]
    """(shared, number of the unit, `Post`) -> pytree of arrays; a function of a module"""
    shared: Any
    """A pytree of arrays and of whatever else is known before"""
    like: Callable[[], Any]
    """() -> a pytree of the structure of what ``function`` returns"""


class Answer(NamedTuple):
    """What came of a unit."""

    number: int
    result: Any = None
    """Pytree of NumPy arrays; their list where it comes from another process"""
    error: BaseException | None = None
    incidents: tuple = ()


class Place(NamedTuple):
    """Where units run."""

    submit: Callable[[int], None]
    """Has the unit of a number run; its `Answer` comes into ``news``. `Gone` where it cannot."""
    stop: Callable[[], None]
    """Lets units that have not begun be, and waits for those of this process."""
    news: queue.SimpleQueue
    """Of `Answer`, and of the numbers that units tell by `Post.more`"""
    ahead: int
    elsewhere: bool


class Gone(Exception):
    """An executor takes no more work."""


class Differs(Exception):
    """A process of the executor has other versions."""


def executor_of(function: str, executor: Any) -> Any:
    """``executor`` as the argument of a call. ValueError unless it has ``submit``."""
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise ValueError(
            f"{function}: executor must have submit(function, *args), as those of"
            f" concurrent.futures have, received {executor!r}"
        )
    return executor


def devices_of(function: str, devices: Any, executor: Any) -> tuple[jax.Device, ...] | None:
    """``devices`` as the argument of a call. ValueError unless they are some of `jax.devices`."""
    if devices is None:
        return None
    if executor is not None:
        raise ValueError(f"{function}: devices must be None where an executor is given")
    devices = tuple(devices) if isinstance(devices, Sequence) else (devices,)
    if not devices or not all(isinstance(d, jax.Device) for d in devices):
        raise ValueError(f"{function}: devices must be of jax.devices(), received {devices!r}")
    return devices


@contextlib.contextmanager
def opened(
    function: str, task: Task, executor: Any, devices: Sequence[jax.Device] | None, threads: int
) -> Iterator[Place]:
    """A context with the `Place` of a call's units, which is stopped at its end."""
    if executor is not None:
        place = _elsewhere(function, task, executor)
    else:
        place = _here(task, devices, threads)
    try:
        yield place
    finally:
        place.stop()


def _here(task: Task, devices: Sequence[jax.Device] | None, threads: int) -> Place:
    """``threads`` of this process, or one a device, by turns."""
    news, end, now = queue.SimpleQueue(), threading.Event(), settings()
    post = Post()
    post.more, post.stopped = news.put, end.is_set
    if devices is None:
        pools = [(ThreadPoolExecutor(threads), now, task.shared)]
    else:
        pools = [
            (ThreadPoolExecutor(1), now | dict(jax_default_device=d), _put(task.shared, d))
            for d in devices
        ]

    def work(values, shared, number):
        if end.is_set():
            return
        try:
            with under(values):  # not once a thread: whoever frees it last would leave it
                answer = Answer(number, jax.device_get(task.function(shared, number, post)))
        except BaseException as error:  # also a KeyboardInterrupt that met a system
            answer = Answer(number, error=error)
        news.put(answer)

    def submit(number):
        pool, *given = pools[number % len(pools)]
        pool.submit(work, *given, number)

    def stop():
        end.set()
        for pool, *_ in pools:
            pool.shutdown(cancel_futures=True)

    count = threads if devices is None else len(devices)
    return Place(submit, stop, news, AHEAD * count, False)


def _put(shared: Any, device: jax.Device) -> Any:
    arrays = lambda a: jax.device_put(a, device) if isinstance(a, jax.Array) else a
    return jax.tree.map(arrays, shared)


def _elsewhere(function: str, task: Task, executor: Any) -> Place:
    """The processes of ``executor``."""
    news, flying, tickets = queue.SimpleQueue(), {}, itertools.count()
    parcel = _packed(function, task)
    surroundings = {k: v for k, v in settings().items() if k != "jax_default_device"}
    ours = versions()

    def ended(number, ticket, future):
        flying.pop(ticket, None)
        try:
            answer = Answer(number, *future.result())
        except BaseException as error:  # a CancelledError, too
            answer = Answer(number, error=error)
        news.put(answer)

    def submit(number):
        ticket = next(tickets)
        try:
            future = executor.submit(_unit, parcel, surroundings, ours, number)
        except Exception as error:
            raise Gone(f"{type(error).__name__}: {error}") from error
        flying[ticket] = future
        future.add_done_callback(functools.partial(ended, number, ticket))

    def stop():
        for future in list(flying.values()):
            future.cancel()

    return Place(submit, stop, news, FAR, True)


def _packed(function: str, task: Task) -> bytes:
    """What a process needs of ``task``. ValueError where it cannot be sent."""
    by_value = importlib.util.find_spec("cloudpickle") is not None
    if by_value:  # also of functions that are in no module
        import cloudpickle as pickler
    else:
        pickler = pickle
    try:
        return pickler.dumps((task.function, task.shared))
    except Exception as error:  # of many kinds
        hint = "" if by_value else ", or install cloudpickle, which also sends lambdas"
        raise ValueError(
            f"{function}: what the executor is to run cannot be sent to its processes:"
            f" {type(error).__name__}: {error}; define the simulator's functions in a module, and"
            f" open files and locks inside of them{hint}"
        ) from error


def _unit(parcel: bytes, surroundings: dict, wanted: dict, number: int) -> tuple:
    """In a process of an executor: the arrays of a unit, None, and new incidents. An error comes
    back as text, so that it can always be sent.
    """
    if unlike := differences(versions(), wanted):
        return None, Differs(unlike), ()
    function, shared = _unpacked(parcel)
    with under(surroundings):
        before = incidents(shared)
        arrays = jax.tree.leaves(jax.device_get(function(shared, number, Post())))
        return arrays, None, since(before, incidents(shared))


@functools.lru_cache(maxsize=4)
def _unpacked(parcel: bytes) -> tuple:
    """Once a process, so that its compiled programs serve all units."""
    return pickle.loads(parcel)
