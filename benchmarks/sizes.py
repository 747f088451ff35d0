"""What the benchmarks share: options, how much is measured, printing, clocks and fresh processes.

Each measures all, less with ``--quick``, or with ``--smoke`` the least that enters whatever is
measured: figures of the least mean nothing.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import jax

__all__ = [
    "NO_CACHE",
    "ONE_THREAD",
    "in_fresh_process",
    "in_this_process",
    "installed",
    "options",
    "percent",
    "printer",
    "processors",
    "print_report",
    "size",
    "add_choices",
    "timed",
]

T = TypeVar("T")
ONE_THREAD = {"PJRT_NPROC": "1"}
"""Of XLA: with more it cuts kernels over threads, which wait for each other at the cost of CPU."""
NO_CACHE = {"JAX_ENABLE_COMPILATION_CACHE": "false"}


def options(doc: str | None, quick: str) -> argparse.ArgumentParser:
    """A parser with ``--json``, ``--quick`` (``quick``: what it leaves out) and ``--smoke``."""
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{Path(sys.argv[0]).stem}",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, nothing else")
    least = parser.add_mutually_exclusive_group()
    least.add_argument("--quick", action="store_true", help=quick)
    least.add_argument(
        "--smoke", action="store_true", help="the least of everything, in seconds: does it run?"
    )
    return parser


def size(args: argparse.Namespace, full: T, quick: T, smoke: T) -> T:
    """What the options of a command line ask for."""
    return smoke if args.smoke else quick if args.quick else full


def printer(args: argparse.Namespace) -> Callable[..., None]:
    """`print`, flushed; with ``--json`` it prints nothing."""

    def say(*words: Any) -> None:
        if not args.json:
            print(*words, flush=True)

    return say


def print_report(args: argparse.Namespace, report: Any, text: str = "") -> None:
    """Print the report: as JSON, or its text."""
    if args.json or text:
        print(json.dumps(report) if args.json else text)


def timed(function: Callable[[], T]) -> tuple[T, float, float]:
    """What a function returns, once it is computed, its CPU and its wall seconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = jax.block_until_ready(function())
    return result, time.process_time() - cpu, time.perf_counter() - wall


def processors() -> int | None:
    """How many of them this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count()


def in_fresh_process(
    name: str, *arguments: Any, module: str, settings: dict[str, str] = ONE_THREAD
) -> Any:
    """What a function of a benchmark returns, as JSON has it, in a process of its own with these
    environment variables.
    """
    call = f"{module}.{name}(*{arguments!r})"
    code = f"import json; from benchmarks import {module}; print(json.dumps({call}))"
    env = os.environ | settings | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-W", "ignore", "-c", code]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=env).stdout
    return json.loads(said.splitlines()[-1])


def in_this_process(name: str, *arguments: Any, module: str, **_: Any) -> Any:
    """The same in this process: compiled programs are shared, figures mean less."""
    return getattr(importlib.import_module(f"benchmarks.{module}"), name)(*arguments)


def add_choices(
    parser: argparse.ArgumentParser, name: str, choices: Iterable[str], default: str = "all"
) -> None:
    """Add an option ``name`` that takes some of ``choices``."""
    names = list(choices)
    text = f"default: {default}; of {', '.join(names)}".replace("%", "%%")
    parser.add_argument(name, nargs="+", choices=names, metavar="NAME", help=text)


def installed(package: str) -> bool:
    """Whether a package, or a part of one by a dotted name, is there."""
    top = package.partition(".")[0]  # what is absent has no parts to look for
    return all(importlib.util.find_spec(name) is not None for name in (top, package))


def percent(share: float | None) -> str:
    """A share as text; "-" where there is none."""
    return "-" if share is None else f"{100 * share:.1f} %"
