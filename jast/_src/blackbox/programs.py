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
import tempfile
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.blackbox.readings import WrongAnswer
from jast._src.blackbox.worker import NAME, end_group
from jast._src.core.typing import PathLike
from jast._src.util.checks import wrong

__all__ = ["program"]


class Program(NamedTuple):
    """``(disturbances, x0=None) -> (event, distance)`` by running a command."""

    command: tuple
    folder: str | None

    def __call__(self, disturbances, x0=None):
        given = {"x0": x0, "disturbances": disturbances}
        task = json.dumps(given, default=lambda a: np.asarray(a).tolist())
        running = getattr(sys.modules.get(NAME), "running", set())
        # files: a pipe is open for as long as a child that the program leaves behind holds it
        with (
            tempfile.TemporaryFile() as asked,
            tempfile.TemporaryFile() as told,
            tempfile.TemporaryFile() as errors,
        ):
            asked.write(task.encode())
            asked.seek(0)
            # a session of its own, so that what the program has started can be ended with it
            with subprocess.Popen(
                self.command,
                stdin=asked,
                stdout=told,
                stderr=errors,
                cwd=self.folder,
                start_new_session=True,
            ) as process:
                running.add(process)
                try:
                    process.wait()
                except BaseException:  # the time limit
                    end_group(process)
                    raise
                finally:
                    running.discard(process)
            out, errors = map(_text, (told, errors))
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
        must = "name a program, as a text that a shell could split or a sequence of texts"
        raise wrong("program", "command", must, f"{command!r}")
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


def _text(file):
    file.seek(0)
    return file.read().decode("utf-8", "replace")
