"""sweep: one function on many systems."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from typing import Any

import jax
import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, Executor, PathLike, PRNGKey
from jast._src.runtime.backends import check_executor
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.progress_bar import Watch, terminable
from jast._src.sweeping.curve import join_rows
from jast._src.sweeping.rows import Rows, options_of, run_here, run_in_executor
from jast._src.sweeping.simulators import count_kinds, make_simulators
from jast._src.sweeping.table import Sweep
from jast._src.util.checks import check_random_key, wrong
from jast._src.util.display import call_settings
from jast.estimate import failure_probability

__all__ = ["sweep"]


def sweep(
    key: PRNGKey,
    simulators: Callable[..., Simulator] | Sequence[Simulator],
    values: Mapping[str, Iterable[Any]],
    function: Callable[..., Any] = failure_probability,
    *,
    follow: bool | None = None,
    executor: Executor | None = None,
    checkpoint: PathLike | None = None,
    progress: bool = False,
    callback: Callback | None = None,
    **options: Any,
) -> Sweep:
    """How does a result depend on a setting? ``function`` on a system for each of N values::

        def make(gain):
            ...
            return jast.Simulator(...)

        table = jast.sweep(jax.random.key(0), make, {"gain": np.linspace(0.2, 0.4, 50)})
        print(table)
        print(table.crossing(1e-6))  # the gain at which the probability of failure is 1e-6
        table.plot().figure.savefig("gains.png")

    Where ``make`` can be traced by `jax.jit` it is called inside of the compiled programs, with its
    settings as arguments: they are compiled once for all values, also where ``make`` builds new
    functions at each call. Where it cannot (it branches on a setting, or a setting is no number, or
    changes a shape or the horizon), each value compiles its own; ``settings["programs"]`` says how
    many kinds there are.

    Cheap systems of one kind, which `jast.estimate.failure_probability` answers by populations, are
    then joined: the failures of each row are simulated under its neighbours, which tells the ratio
    of both probabilities. ``table.probability``, its intervals and crossings are those of the
    joined curve, ``table.ratios`` those of neighbours, and ``table.results`` stay as they are. So
    put values in order, and near enough that many failures are common to neighbours.

    Args:
        key: consumed; row i has ``jax.random.fold_in(key, i)``.
        simulators: a pure function of the settings by keyword that returns a `jast.Simulator`; or N
            simulators.
        values: name of a setting -> its N values. Names and numbers only label the rows where
            simulators are given.
        function: ``function(key, simulator, **options)`` returns an `Estimate`, the result of
            `jast.nominal`, a `SearchResult`, a `Report`, or anything else, which is kept.
        follow: whether each row starts from the one before: ``function`` is also given ``near``,
            the last result. `jast.estimate.failure_probability` then looks for no proposal of its
            own where that of the neighbour serves; its draws are new. So put values in order.
            Default: with this function, where rows run one after the other.
        executor: where rows run, anything with ``submit(function, *args)`` as of
            `concurrent.futures` (docs/scale.md); default: one after the other, here. So values
            that share no program run side by side. Processes need a ``make`` and a ``function``
            that can be sent: those of a module. A row whose process dies is tried again twice.
        checkpoint: a folder that keeps the rows that are done; the same call goes on where it was
            ended, by whatever, to the same result. Rows that raised are tried again. Where rows run
            here, and ``function`` takes a ``checkpoint``, each row has one of its own in it.
            Results are then as `jast.load` gives them.
        progress: whether there is a bar.
        callback: called as ``callback(done, N, None)`` after each row.
        **options: settings of ``function``, such as ``budget``.

    Returns:
        `Sweep`, a table with a row for each value. A value for which ``simulators`` or ``function``
        raises has the error in its row. A KeyboardInterrupt or SIGTERM ends it with the rows that
        are done, and is raised where there is none.

    Raises:
        ValueError: for no values, values of unequal numbers, a number of simulators that is not
            theirs, ``follow`` with an executor, what is no function, and a checkpoint of another
            call; and what the first row raised where all raise.

    Example:
        >>> import jax, jast
        >>> make = lambda threshold: jast.simulators.walk1d(threshold=threshold)
        >>> table = jast.sweep(
        ...     jax.random.key(0), make, {"threshold": [8.0, 12.0]}, jast.nominal, episodes=500
        ... )
        >>> table.results[0].failing > table.results[1].failing
        True
    """
    check_random_key("sweep", key)
    columns, settings_of = _rows(values)
    if not callable(function):
        raise ValueError(f"sweep: function must be callable, received {function!r}")
    check_executor("sweep", executor)
    if follow is None:
        follow = function is failure_probability and executor is None
    if follow and executor is not None:
        raise ValueError(
            "sweep: follow must be False with an executor, since its rows do not wait for each"
            " other"
        )
    if callable(simulators):
        _check_arguments("simulators", simulators, (), settings_of[0])
    n = len(settings_of)
    made = make_simulators(_checked(simulators, n), settings_of)
    keys = [jax.random.fold_in(key, i) for i in range(n)]
    about = dict(row=function, follow=bool(follow), values=columns, simulators=made)
    with (
        open_checkpoint("sweep", checkpoint, key, **about, options=options) as store,
        Watch("sweep", n, "value", progress, callback) as watch,
        terminable(),
    ):
        own = options_of(function, options, None if executor else checkpoint, n)
        near = dict(near=None) if follow else {}
        _check_arguments("function", function, ("key", "simulator"), {**own[0], **near})
        rows = Rows(function, keys, made, own, store is not None)
        if executor is None:
            found, ended = run_here(rows, follow, store, watch), ""
        else:
            found, ended = run_in_executor(rows, executor, store, watch)
        curve, ratios, said = _join(function, rows, found)
    outcomes, errors = zip(*found, strict=True)
    if all(e is not None for e in errors) and len(found) == n:
        raise errors[0]
    settings = call_settings(
        "sweep", key, function=_name(function), follow=bool(follow), programs=count_kinds(made)
    )
    if len(found) < n:
        settings["interrupted"] = f"after {len(found)} of {n} values{ended}"
    return Sweep(
        values={k: v[: len(found)] for k, v in columns.items()},
        results=outcomes,
        errors=tuple(None if e is None else f"{type(e).__name__}: {e}" for e in errors),
        simulators=tuple(None if isinstance(s, Exception) else s for s in made[: len(found)]),
        settings=settings | said,
        curve=curve,
        ratios=ratios,
    )


def _check_arguments(name, called, args, named):
    """ValueError where the signature of what is ``called`` does not take these arguments, of which
    ``args`` has the names.
    """
    try:
        signature = inspect.signature(called)
    except (TypeError, ValueError):  # one that says nothing of itself
        return
    try:
        signature.bind(*args, **named)
    except TypeError as error:
        what = ", ".join([*args, *map(repr, named)])
        raise wrong("sweep", name, f"take {what}", f"{_name(called)}: {error}") from error


def _join(function, rows, found):
    """`join_rows` of those that are done, where they are one kind of cheap systems."""
    if function is not failure_probability or count_kinds(rows.made) > 1:
        return None, None, {}
    try:
        return join_rows(rows.keys, rows.made, [result for result, _ in found])
    except KeyboardInterrupt:  # the rows stand for themselves
        return None, None, {}


def _rows(values):
    """(name -> tuple of N values, N dicts of name -> value), of Python's own numbers."""
    if not isinstance(values, Mapping) or not values:
        must = 'be a dict of name -> values, such as {"gain": [0.1, 0.2]}'
        raise wrong("sweep", "values", must, f"{values!r:.80}")
    columns = {}
    for name, given in values.items():
        if not isinstance(name, str):
            raise ValueError(f"sweep: names of values must be texts, received {name!r}")
        single = isinstance(given, str | Mapping | Set) or not hasattr(given, "__len__")
        if single or getattr(given, "ndim", 1) == 0:
            raise ValueError(f"sweep: {name} must be a sequence of values, received {given!r}")
        columns[name] = tuple(v.item() if _scalar(v) else v for v in given)
    sizes = {name: len(column) for name, column in columns.items()}
    if len(set(sizes.values())) > 1 or not all(sizes.values()):
        raise wrong("sweep", "values", "be equally many for each setting, at least 1", sizes)
    return columns, [dict(zip(columns, row)) for row in zip(*columns.values(), strict=True)]


def _scalar(value):
    return isinstance(value, np.generic | jax.Array | np.ndarray) and np.ndim(value) == 0


def _checked(simulators, n):
    if callable(simulators):
        return simulators
    if isinstance(simulators, Simulator) or not isinstance(simulators, Sequence):
        must = "be a function of the settings that returns a jast.Simulator, or one for each value"
        raise wrong("sweep", "simulators", must, type(simulators).__name__)
    if len(simulators) != n:
        raise wrong("sweep", "simulators", f"be {n}, one for each value", len(simulators))
    return simulators


def _name(function):
    return getattr(function, "__name__", type(function).__name__)
