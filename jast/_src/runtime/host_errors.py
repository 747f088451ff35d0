"""What went wrong inside a system that runs on the host: kept with an example and counted, never
raised, so that a search goes on.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator

__all__ = [
    "Asking",
    "Incident",
    "KINDS",
    "Log",
    "failing_runs",
    "hosts_of",
    "in_full_batches",
    "incidents",
    "merge_incidents",
    "new_incidents",
    "runs_apart",
    "runs_made",
    "runs_on_host",
    "seconds_of_runs",
    "showing_runs",
    "telling_runs",
]

NUMBERS = re.compile(r"-?\d+\.\d+(e[-+]?\d+)?|-?\d+e[-+]?\d+")  # those that are not whole
GROUPS = 100  # different messages that a `Log` keeps apart at most: each has an example
KINDS = {
    "raised": "run the system on the example's disturbances to see it again",
    "timed out": (
        "increase time_limit if the system is only slow; otherwise the example's disturbances"
        " make it hang"
    ),
    "died": (
        "the process of the system ended: run the system on the example's disturbances in a"
        " process of its own"
    ),
    "wrong answer": "return (event, distance): a bool and one number",
    "NaN": (
        "return a finite number for every input; an episode without one does not count as a"
        " failure and has reward -inf"
    ),
    "not deterministic": (
        "seed every random number generator at the start of a run, or make its draws part of the"
        " disturbance"
    ),
    "unit left out": (
        "a part of the work failed three times in the processes of the executor, and its results"
        " are missing; fix the error it names, then make the same call again"
    ),
    "other": "fix those listed first: their examples show how",
}
"""The kinds of incidents, and what to do."""


class Incident(NamedTuple):
    """One kind of thing that went wrong, and its first example. NumPy and Python values.

    Example:
        >>> import jax, jast
        >>> from jast import distributions as D
        >>> broken = lambda x: 1 / 0
        >>> sim = jast.blackbox.from_python(broken, horizon=2, disturbance=D.Normal(0.0, 1.0))
        >>> invalid = jast.rollout(jax.random.key(0), sim)
        >>> incident = jast.incidents.incidents(sim)[0]
        >>> incident.kind, "ZeroDivisionError" in incident.message, incident.disturbances.shape
        ('raised', True, (2,))
    """

    kind: str
    """One of `KINDS`."""
    message: str
    """E.g. "raised ZeroDivisionError: division by zero (system.py:12)" """
    count: int
    """How often, the example included."""
    x0: Any
    """Initial disturbance of the example, ``()`` where the start is fixed; None where there is no
    example
    """
    disturbances: Any
    """[t, ...]: the disturbances of the example up to there, a pytree where a disturbance is one;
    ``()`` where an object of `jast.estimate.splitting` did not begin
    """

    def __str__(self) -> str:
        named = self.message.startswith(self.kind)
        said = self.message if named else f"{self.kind}: {self.message}"
        return f"{self.count} x {said}; {KINDS[self.kind]}"


def _group(kind: str, message: str) -> tuple[str, str]:
    """What incidents have in common that are counted as one: wrong answers whatever was received,
    and messages that differ in numbers with a fraction.
    """
    if kind == "wrong answer":
        return kind, message.partition(", received ")[0]
    return kind, NUMBERS.sub("#", message)


class Log:
    """Counts incidents by kind and message (`_group`); may be shared by threads."""

    def __init__(self):
        self._groups, self._lock = {}, threading.Lock()

    def add(self, kind, message, example):
        """Count one more; ``example``: () -> (x0, disturbances), called for the first of a group
        only.
        """
        with self._lock:
            group = _group(kind, message)
            if group not in self._groups and len(self._groups) >= GROUPS:
                latest = f"more than {GROUPS} different messages; the latest: {kind}: {message}"
                kind, message = "other", latest[:200]
                group = "other", ""
            incident = self._groups.get(group) or Incident(kind, message, 0, *example())
            self._groups[group] = incident._replace(count=incident.count + 1)

    def all(self):
        """tuple of `Incident`, in the order of their first examples."""
        with self._lock:
            return tuple(self._groups.values())


class Asking:
    """A function of a simulator that asks its ``host``, a `blackbox.host_calls.Host`."""

    def __init__(self, host, function):
        self.host, self.function = host, function

    def __call__(self, *args):
        return self.function(self.host, *args)


def hosts_of(sim) -> Iterator[Any]:
    """The hosts that the functions of a simulator ask, each once; also those that a function asks
    which is bound by another one's arguments. The object keeps them.
    """
    kept = vars(sim) if isinstance(sim, Simulator) else {}
    if "_hosts" not in kept:
        kept["_hosts"] = tuple(_hosts_of(sim))
    return iter(kept["_hosts"])


def _hosts_of(sim):
    seen, left = set(), [sim]
    while left:
        for part in jax.tree.leaves(left.pop(), is_leaf=lambda p: isinstance(p, Partial)):
            if isinstance(part, Partial):
                left.append((part.args, part.keywords))
                if isinstance(part.func, Asking) and id(part.func.host) not in seen:
                    seen.add(id(part.func.host))
                    yield part.func.host


def runs_on_host(sim):
    """Whether the simulator runs on the host: a black box, slow and without gradients."""
    return any(True for _ in hosts_of(sim))


def runs_made(sim):
    """How often the host code behind a simulator has started to run so far: 0 of one in JAX."""
    return sum(host.done.episodes for host in hosts_of(sim))


def seconds_of_runs(sim):
    """How long this host code has taken so far, without the compilation of what calls it."""
    return sum(host.done.seconds for host in hosts_of(sim))


def failing_runs(sim):
    """The runs of a black box that failed so far, each once, as its workplace keeps them."""
    return [run for host in hosts_of(sim) for run in host.failing()]


def runs_apart(sim):
    """A context in which a black box does not know the answers from before; after it, it knows
    both.
    """
    return _all_of(host.runs_apart() for host in hosts_of(sim))


def telling_runs(sim, told):
    """A context in which ``told(failing)`` is called after each batch of runs of a black box, with
    the number of failing ones in it.
    """
    return _all_of(host.tell_runs(told) for host in hosts_of(sim))


@contextlib.contextmanager
def showing_runs(sim, watch):
    """A context in which the bar of ``watch`` moves with every batch of runs of a black box, with
    how many of them failed.
    """
    made, failures = runs_made(sim), 0

    def tell(failing):
        nonlocal failures
        failures += failing
        watch.reach(min(runs_made(sim) - made, watch.total), failures=failures)

    with telling_runs(sim, tell):
        yield


@contextlib.contextmanager
def _all_of(contexts):
    with contextlib.ExitStack() as stack:
        for context in contexts:
            stack.enter_context(context)
        yield


def in_full_batches(sim, least):
    """The least number of runs, ``least`` or more, that keeps all workers of a simulator busy."""
    workers = max((host.workers() for host in hosts_of(sim)), default=1)
    return -(-least // workers) * workers


def incidents(sim):
    """What has gone wrong so far, `Incident`, in the host code of a simulator, or of what holds
    one.
    """
    return tuple(i for host in hosts_of(sim) for i in host.log.all())


def merge_incidents(first, second):
    """All incidents as one tuple, in which those of one kind and message are counted together."""
    groups = {}
    for i in (*first, *second):
        group = _group(i.kind, i.message)
        known = groups.setdefault(group, i._replace(count=0))
        groups[group] = known._replace(count=known.count + i.count)
    return tuple(groups.values())


def new_incidents(before, after):
    """What is new in ``after`` (tuples of `Incident`): with the counts since ``before``."""
    known = {(i.kind, i.message): i.count for i in before}
    new = (i._replace(count=i.count - known.get((i.kind, i.message), 0)) for i in after)
    return tuple(i for i in new if i.count > 0)
