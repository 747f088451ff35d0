"""The rows of a sweep: where they run, and what a checkpoint keeps of them."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Executor
from jast._src.io import save_load
from jast._src.runtime import work
from jast._src.runtime._jax import was_interrupted
from jast._src.runtime.backends import Task, UnitContext
from jast._src.runtime.checkpoints import Checkpoint
from jast._src.runtime.progress_bar import Watch

__all__ = ["Rows", "options_of", "run_here", "run_in_executor"]

ROW = "row"
Outcome = tuple[Any, Exception | None]
"""What the function returned, or what was raised."""


class Rows(NamedTuple):
    """What is to be done, row by row."""

    function: Callable[..., Any]
    keys: Sequence[jax.Array]
    made: Sequence[Simulator | Exception]
    options: Sequence[Mapping[str, Any]]
    keeps: bool
    """Whether results are to be kept, and so made into bytes."""


def options_of(
    function: Callable[..., Any], options: Mapping[str, Any], folder: Any, n: int
) -> list[Mapping[str, Any]]:
    """The options of each of ``n`` rows: where ``function`` takes a ``checkpoint``, it has one of
    its own in ``folder``.
    """
    if folder is None or not _takes_checkpoint(function):
        return [options] * n
    return [{**options, "checkpoint": Path(folder) / f"row-{i}"} for i in range(n)]


def run_here(rows: Rows, follow: bool, store: Checkpoint | None, watch: Watch) -> list[Outcome]:
    """The rows that are done, from the first on: one after the other in this thread; ``follow``:
    each is given the result before it. KeyboardInterrupt where one meets the first row.
    """
    found, near = [], {}
    try:
        for i, sim in enumerate(rows.made):
            kept = None if store is None else store.get(i, ROW)
            outcome = _run_row(rows, i, UnitContext(), near) if kept is None else kept[0]
            if kept is None and store is not None and _is_kept(outcome):
                store.put(i, [outcome], ROW)
            result, error = _unpack(outcome, sim)
            found.append((result, error))
            if follow and error is None:
                near = {"near": result}
            watch.more(1)
            if _ended_early(result):
                break
    except KeyboardInterrupt:
        if not found:
            raise
    return found


def run_in_executor(
    rows: Rows, executor: Executor, store: Checkpoint | None, watch: Watch
) -> tuple[list[Outcome], str]:
    """The rows that are done, each a unit of `runtime.work` in the processes of ``executor``: one
    whose process dies is tried again twice, and then has an error. And words of what ended the rows
    early, where it was no interruption.
    """

    def fold(done, i, outcome):
        return {**done, i: _unpack(outcome, rows.made[i])}

    where = work.Placement(executor, None, store, ROW, _is_kept)
    ran = work.run(Task(_run_row, rows, lambda: 0), len(rows.made), fold, {}, watch, where)
    lost = "left out, since its process failed in every attempt"
    found = [ran.state.get(i, (None, RuntimeError(lost))) for i in range(ran.done)]
    cut = next((i for i, (result, _) in enumerate(found, 1) if _ended_early(result)), len(found))
    return found[:cut], ran.ended or ""


def _run_row(
    rows: Rows, i: int, context: UnitContext, near: Mapping[str, Any] | None = None
) -> np.ndarray[Any, Any]:
    """Row ``i``: the bytes of its result where that is to be kept, else an array [] that holds its
    `Outcome`.
    """
    try:
        if isinstance(rows.made[i], Exception):
            raise rows.made[i]
        result = rows.function(rows.keys[i], rows.made[i], **rows.options[i], **(near or {}))
        if rows.keeps and not _ended_early(result):
            return np.frombuffer(save_load.to_bytes(result), np.uint8)
        outcome = result, None
    except Exception as error:
        if was_interrupted(error):
            raise KeyboardInterrupt from error
        outcome = None, error
    held = np.empty((), object)
    held[()] = outcome
    return held


def _is_kept(outcome: np.ndarray[Any, Any]) -> bool:
    """Whether a checkpoint holds it: a result that is whole. An error may be another one, or none,
    the next time.
    """
    return outcome.dtype == np.uint8


def _unpack(outcome: np.ndarray[Any, Any], sim: Any) -> Outcome:
    if _is_kept(outcome):
        return save_load.from_bytes(outcome.tobytes(), "sweep: a row of the checkpoint", sim), None
    return outcome[()]


def _ended_early(result: Any) -> bool:
    """Whether a KeyboardInterrupt ended a row, which returned what it had by then."""
    settings = getattr(result, "settings", None) or {}
    notes = getattr(result, "warnings", None) or ()
    return "interrupted" in settings or any(str(n).startswith("interrupted") for n in notes)


def _takes_checkpoint(function: Callable[..., Any]) -> bool:
    try:
        return "checkpoint" in inspect.signature(function).parameters
    except (TypeError, ValueError):  # a builtin that does not say
        return False
