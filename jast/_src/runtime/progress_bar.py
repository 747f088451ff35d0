"""Long work piece by piece, so that it can be watched and interrupted: its bar and its callback."""

import contextlib
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

__all__ = ["Watch", "in_pieces", "terminable"]

State = TypeVar("State")
COMPILING = "compiling"  # what a bar says before anything is done: most of that time goes there


class Watch(contextlib.AbstractContextManager):
    """A bar of tqdm and the user's callback; a context manager, which closes the bar."""

    def __init__(
        self,
        name: str,
        total: int,
        unit: str,
        progress: bool,
        callback: Callable[[int, int, Any], Any] | None,
        *,
        done: int = 0,
    ):
        """
        Args:
            name: of the function that works, before the bar and in errors.
            total: units of all the work.
            unit: their name.
            progress: whether there is a bar.
            callback: the user's, called as ``callback(done, total, result)`` with the result so
                far or None.
            done: units that are done already.

        Raises:
            ValueError: for a callback that cannot be called.
        """
        if callback is not None and not callable(callback):
            raise ValueError(
                f"{name}: callback must be callable, (done, total, result so far or None),"
                f" received {callback!r}"
            )
        self.name = name
        self.done = done
        self.total = total
        self._callback = callback
        self._bar = None
        if progress:
            self._bar = _bar_of_tqdm()(
                total=total,
                initial=done,
                unit=unit,
                unit_scale=total >= 1000,
                desc=f"{name}: {COMPILING}",
            )

    def reach(self, done: int, **words: Any) -> None:
        """``done`` units are done; ``words``: numbers beside the bar."""
        self.done = done
        if self._bar is not None:
            if self._bar.desc.startswith(f"{self.name}: {COMPILING}"):
                self._bar.set_description(self.name, refresh=False)
            if words:
                self._bar.set_postfix(**words, refresh=False)
            self._bar.update(done - self._bar.n)

    def doing(self, what: str) -> None:
        """The bar says what the work is at."""
        if self._bar is not None:
            self._bar.set_description(f"{self.name}: {what}")

    def tell(self, result: Callable[[], Any] | None = None) -> None:
        """Call the callback; ``result()``, the result so far, is only made where there is one."""
        if self._callback is not None:
            self._callback(self.done, self.total, None if result is None else result())

    def more(self, n: int) -> None:
        """``n`` more units are done: the bar and the callback."""
        self.reach(self.done + n)
        self.tell()

    def close(self) -> None:
        """Close the bar."""
        if self._bar is not None:
            self._bar.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def in_pieces(
    work: Callable[[State, int, int], State],
    state: State,
    ends: Iterable[int],
    watch: Watch,
    units: Callable[[int], int] = lambda end: end,
    words: Callable[[State], dict[str, Any]] = lambda state: {},
) -> tuple[State, int]:
    """Do ``state = work(state, begin, end)`` for each stretch up to the next of ``ends``: the one
    driver of all that draws episodes chunk by chunk.

    Args:
        work: returns the next state. It changes nothing else, as it may be interrupted.
        state: the first one.
        ends: rising; a generator may look at the clock between two of them.
        watch: is told after each piece, and closed.
        units: of ``watch``, that are done at an end.
        words: of a state, for the bar.

    Returns:
        The last state and its end. A KeyboardInterrupt, or SIGTERM, ends the work after the last
        whole piece, and is raised again where there is none.
    """
    kept = state, 0
    try:
        with terminable():
            for end in ends:
                state, done = kept
                # at once: an interruption finds all of a piece or nothing
                kept = work(state, done, end), end
                watch.reach(units(end), **words(kept[0]))
                watch.tell()
    except KeyboardInterrupt:
        if not kept[1]:
            raise
    finally:
        watch.close()
    return kept


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """A context in which SIGTERM does what Ctrl-C does, unless the user has it do something."""
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def interrupt(number, frame):
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _bar_of_tqdm() -> Any:
    """The bar of a terminal, or of a notebook where it can be drawn there."""
    from tqdm import TqdmWarning  # slow to import

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TqdmWarning)  # of a notebook without ipywidgets
        from tqdm.auto import tqdm
    return tqdm
