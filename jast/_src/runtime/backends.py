"""Where units of work run: threads of this process, devices, or the processes of an executor. Each
backend puts its results into one queue.
"""

import contextlib
import functools
import importlib.util
import pickle
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax

from jast._src.io.fingerprint import describe_differences, versions
from jast._src.runtime.host_errors import Incident, incidents, new_incidents
from jast._src.runtime.jax_settings import current_settings, jax_settings

__all__ = [
    "Backend",
    "ExecutorClosed",
    "Task",
    "UnitContext",
    "UnitResult",
    "VersionMismatch",
    "check_devices",
    "check_executor",
    "open_backend",
]

THREAD_AHEAD = 2  # units under way or waiting to be merged, for each thread of this process
EXECUTOR_AHEAD = 256  # likewise of an executor, which does not say how many processes it has


class UnitContext:
    """What a unit may report and ask while it runs; this one, of another process, does nothing."""

    def more(self, n: int) -> None:
        """``n`` more of what the bar counts are done."""

    def stopped(self) -> bool:
        """Whether it is to end early, with what it has."""
        return False


class Task(NamedTuple):
    """What all units have in common."""

    function: Callable[[Any, int, UnitContext], Any]
    """(shared, number of the unit, `UnitContext`) -> pytree of arrays; a function of a module."""
    shared: Any
    """A pytree of arrays and of whatever else is known before."""
    like: Callable[[], Any]
    """() -> a pytree of the structure of what ``function`` returns."""


class UnitResult(NamedTuple):
    """What came of a unit."""

    number: int
    result: Any = None
    """Pytree of NumPy arrays; their list where it comes from another process."""
    error: BaseException | None = None
    incidents: tuple[Incident, ...] = ()


class Backend(NamedTuple):
    """What runs units."""

    submit: Callable[[int], None]
    """Has the unit of a number run; its `UnitResult` comes into ``news``. `ExecutorClosed` where
    it cannot.
    """
    stop: Callable[[], None]
    """Drops units that have not begun, and waits for those of this process."""
    news: queue.SimpleQueue
    """Of `UnitResult`, and of the numbers that units tell by `UnitContext.more`."""
    ahead: int
    """Units that may be under way or waiting to be merged."""
    elsewhere: bool
    """Whether units run in other processes."""


class ExecutorClosed(Exception):
    """An executor takes no more work."""


class VersionMismatch(Exception):
    """A process of the executor has other versions."""


def check_executor(function: str, executor: Any) -> None:
    """ValueError unless ``executor``, the argument of a call, is None or has ``submit``."""
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise ValueError(
            f"{function}: executor must have submit(function, *args), as those of"
            f" concurrent.futures have, received {executor!r}"
        )


def check_devices(function: str, devices: Any, executor: Any) -> tuple[jax.Device, ...] | None:
    """``devices`` as the argument of a call. ValueError unless they are some of `jax.devices`."""
    if devices is None:
        return None
    if executor is not None:
        raise ValueError(f"{function}: devices must be None where an executor is given")
    one = isinstance(devices, str) or not isinstance(devices, Sequence)
    devices = (devices,) if one else tuple(devices)
    if not devices or not all(isinstance(d, jax.Device) for d in devices):
        raise ValueError(f"{function}: devices must be of jax.devices(), received {devices!r}")
    return devices


@contextlib.contextmanager
def open_backend(
    function: str, task: Task, executor: Any, devices: Sequence[jax.Device] | None, threads: int
) -> Iterator[Backend]:
    """A context with the `Backend` of a call's units, which is stopped at its end."""
    if executor is not None:
        backend = _executor_backend(function, task, executor)
    else:
        backend = _thread_backend(task, devices, threads)
    try:
        yield backend
    finally:
        backend.stop()


def _thread_backend(task: Task, devices: Sequence[jax.Device] | None, threads: int) -> Backend:
    """``threads`` of this process, or one a device, by turns."""
    news, end = queue.SimpleQueue(), threading.Event()
    now = current_settings()
    context = UnitContext()
    context.more, context.stopped = news.put, end.is_set
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
            with jax_settings(values):  # once a task: what a thread sets would outlast its thread
                result = jax.device_get(task.function(shared, number, context))
            news.put(UnitResult(number, result))
        except BaseException as error:  # also a KeyboardInterrupt that met a system
            news.put(UnitResult(number, error=error))

    def submit(number):
        pool, *given = pools[number % len(pools)]
        pool.submit(work, *given, number)

    def stop():
        end.set()
        for pool, *_ in pools:
            pool.shutdown(cancel_futures=True)

    count = threads if devices is None else len(devices)
    return Backend(submit, stop, news, ahead=THREAD_AHEAD * count, elsewhere=False)


def _put(shared: Any, device: jax.Device) -> Any:
    return jax.tree.map(
        lambda a: jax.device_put(a, device) if isinstance(a, jax.Array) else a, shared
    )


def _executor_backend(function: str, task: Task, executor: Any) -> Backend:
    """The processes of ``executor``."""
    news, futures = queue.SimpleQueue(), set()
    pickled = _pickle(function, task)
    surroundings = {k: v for k, v in current_settings().items() if k != "jax_default_device"}
    ours = versions()

    def end(number, future):
        futures.discard(future)
        try:
            news.put(UnitResult(number, *future.result()))
        except BaseException as error:  # a CancelledError, too
            news.put(UnitResult(number, error=error))

    def submit(number):
        try:
            future = executor.submit(_run_unit, pickled, surroundings, ours, number)
        except Exception as error:
            raise ExecutorClosed(f"{type(error).__name__}: {error}") from error
        futures.add(future)
        future.add_done_callback(functools.partial(end, number))

    def stop():
        for future in list(futures):
            future.cancel()

    return Backend(submit, stop, news, ahead=EXECUTOR_AHEAD, elsewhere=True)


def _pickle(function: str, task: Task) -> bytes:
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


def _run_unit(pickled: bytes, surroundings: dict, wanted: dict, number: int) -> tuple:
    """In a process of an executor: the arrays of a unit, None, and new incidents. An error comes
    back as text, so that it can always be sent.
    """
    if unlike := describe_differences(versions(), wanted):
        return None, VersionMismatch(unlike), ()
    function, shared = _unpickle(pickled)
    with jax_settings(surroundings):
        before = incidents(shared)
        arrays = jax.tree.leaves(jax.device_get(function(shared, number, UnitContext())))
        return arrays, None, new_incidents(before, incidents(shared))


@functools.lru_cache(maxsize=4)
def _unpickle(pickled: bytes) -> tuple[Callable, Any]:
    """Once a process, so that its compiled programs serve all units."""
    return pickle.loads(pickled)
