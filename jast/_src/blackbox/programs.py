"""An external program as a system: one process an episode, JSON in and out. Goes to the workers by
value: the standard library and NumPy only.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.blackbox.worker import NAME, WrongAnswer, end_group
from jast._src.core.typing import PathLike

__all__ = ["program"]

POLL = 0.05  # seconds between two looks whether a program has ended that keeps its outputs open
PIPE = 2**20  # bytes that a pipe holds at most


class Program(NamedTuple):
    """``(disturbances, x0=None) -> (event, distance)`` by running a command."""

    command: tuple
    folder: str | None

    def __call__(self, disturbances, x0=None):
        given = {"x0": x0, "disturbances": disturbances}
        task = json.dumps(given, default=lambda a: np.asarray(a).tolist())
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        running = getattr(sys.modules.get(NAME), "running", set())
        # a session of its own, so that what the program has started can be ended with it
        with subprocess.Popen(
            self.command, **pipes, cwd=self.folder, start_new_session=True
        ) as process:
            running.add(process)
            try:
                written = _written(process, task.encode())
            except BaseException:  # the time limit
                end_group(process)
                raise
            finally:
                running.discard(process)
        out, errors = (text.decode("utf-8", "replace") for text in written)
        if process.returncode:
            last = (errors.strip() or "no message on standard error").splitlines()[-1]
            raise RuntimeError(f"{self.command[0]}: exit status {process.returncode}: {last}")
        last = (out.strip() or " ").splitlines()[-1]
        try:
            answer = json.loads(last)
            return answer["event"], answer["distance"]
        except (ValueError, TypeError, KeyError):
            raise WrongAnswer(
                'the last line of standard output must be {"event": true or false, "distance":'
                f" number}}, received {last[:80]!r}"
            ) from None


def program(command: str | Sequence[str], *, folder: PathLike | None = None) -> Callable[..., Any]:
    """A system for `from_python` that runs an external program, once for each episode.

    The program reads one JSON object from standard input, ``{"x0": ..., "disturbances": [...]}``
    (one row a step; of a `Joint` of a and b an object of such lists, ``{"a": [...], "b": [...]}``;
    x0 is null with one start). It
    prints ``{"event": false, "distance": 1.5}`` as the last line of its standard output. Another
    exit status than 0, another last line, and no answer within a time limit are incidents, not
    errors.

    Args:
        command: the program and its arguments, a list or one string (split as by a POSIX shell,
            without one).
        folder: where it runs.

    Raises:
        ValueError: for an empty command, and a program that is not found or is no executable file.

    Example:
        >>> import sys, jax, jast
        >>> from jast import distributions as D
        >>> code = '''
        ... import json, sys
        ... total = sum(json.load(sys.stdin)["disturbances"])
        ... print(json.dumps({"event": total > 3.0, "distance": max(3.0 - total, 0.0)}))
        ... '''
        >>> run = jast.blackbox.program([sys.executable, "-c", code])
        >>> sim = jast.blackbox.from_python(run, horizon=3, disturbance=D.Normal(0.0, 1.0))
        >>> bool(jast.rollout(jax.random.key(0), sim).distance >= 0.0)
        True
    """
    try:
        given = shlex.split(command) if isinstance(command, str) else map(os.fspath, command)
        parts = tuple(map(os.fsdecode, given))
    except (TypeError, ValueError):
        parts = ()
    if not parts or "\0" in "".join(parts):
        raise ValueError(
            "program: command must name a program, as a text that a shell could split or a sequence"
            f" of texts, received {command!r}"
        )
    if folder is not None and not (isinstance(folder, str | os.PathLike) and os.path.isdir(folder)):
        raise ValueError(f"program: folder must be a directory, received {folder!r}")
    # a relative path with a folder in it is looked up from where the program runs
    near = folder is not None and os.path.dirname(parts[0])
    if shutil.which(os.path.join(folder, parts[0]) if near else parts[0]) is None:
        raise ValueError(
            f"program: command must name an executable program, and {parts[0]!r} was not found or"
            " is not executable"
        )
    return Program(parts, None if folder is None else os.fspath(folder))


def _written(process, task):
    """What the program has written to its two outputs by its end: a child that it leaves may hold
    them for longer.
    """
    while True:
        ended = process.poll() is not None and os.name == "posix"
        try:
            return process.communicate(task, timeout=POLL)
        except subprocess.TimeoutExpired as late:
            if ended:
                pipes = (process.stdout, late.output), (process.stderr, late.stderr)
                return [(known or b"") + _waiting(pipe) for pipe, known in pipes]
            task = None


def _waiting(pipe):
    """What can be read from ``pipe`` at once."""
    if pipe.closed:
        return b""
    os.set_blocking(pipe.fileno(), False)
    return pipe.read(PIPE) or b""
