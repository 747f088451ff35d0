"""The simulators of a sweep, so that they share compiled programs wherever that is possible."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.tree_util import Partial

from jast._src.core.contract import contract
from jast._src.core.simulator import Simulator
from jast._src.runtime.host_errors import runs_on_host

__all__ = ["count_kinds", "make_simulators"]

Made = list[Simulator | Exception]
"""Simulators, or what their making raised."""


class Part(NamedTuple):
    """One function of the simulator that ``make`` makes of traced settings. Equal for the same
    ``make``, so that a second sweep of it compiles nothing.
    """

    make: Callable[..., Simulator]
    name: str

    def __call__(self, settings: Mapping[str, Any], *args: Any) -> Any:
        return getattr(self.make(**settings), self.name)(*args)


def make_simulators(
    make: Callable[..., Simulator] | Sequence, rows: Sequence[Mapping[str, Any]]
) -> Made:
    """A `Simulator` for each of ``rows``, or what its making raised.

    Args:
        make: settings by keyword -> `Simulator`, or the simulators themselves.
        rows: the settings.

    Returns:
        They share one program where they are of one kind as ``make`` makes them, or where it can
        be traced: then it is called inside of the programs, with its settings as arguments.
    """
    made = [_make_one(make, row, i) for i, row in enumerate(rows)]
    if callable(make) and count_kinds(made) > 1 and not any(map(runs_on_host, _simulators(made))):
        traced = [
            s if isinstance(s, Exception) else _with_settings(make, s, r)
            for s, r in zip(made, rows)
        ]
        if count_kinds(traced) == 1 and _can_be_traced(_simulators(traced)[0]):
            return traced
    return made


def count_kinds(made: Made) -> int:
    """How many kinds of simulators there are, each of which compiles its own programs."""
    return len({_kind(s) for s in _simulators(made)})


def _kind(sim):
    leaves, structure = jax.tree.flatten(sim)
    return structure, tuple((np.shape(a), getattr(a, "dtype", type(a))) for a in leaves)


def _simulators(made: Made) -> list[Simulator]:
    return [s for s in made if not isinstance(s, Exception)]


def _make_one(make, row, i):
    try:
        sim = make(**row) if callable(make) else make[i]
        if isinstance(sim, Simulator):
            return sim
        raise ValueError(f"sweep: expected a jast.Simulator, received {type(sim).__name__}")
    except Exception as error:  # of the user's: a value without a system is a row without a result
        return error


def _with_settings(make, sim, row):
    """``sim`` with its settings as arguments of its functions."""
    static = {f.name for f in fields(sim) if f.metadata.get("static")}
    functions = {
        f.name: Partial(Part(make, f.name), dict(row)) for f in fields(sim) if f.name not in static
    }
    return Simulator(**functions, **{name: getattr(sim, name) for name in static})


def _can_be_traced(sim):
    """Whether the functions of ``sim`` can be traced with its settings as arguments."""
    try:
        jax.eval_shape(partial(contract, "sweep"), sim)
    except Exception:  # such as `if gain > 1:`, or an array of `n` numbers
        return False
    return True
