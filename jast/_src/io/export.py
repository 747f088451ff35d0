"""Failures as plain numbers: for a simulator of the user's own, which may not be in Python; and
back from the page of a report.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jast._src.core.episode import Episode, replay
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PathLike
from jast._src.util.checks import check_path, wrong
from jast._src.util.leaf_names import path_name

__all__ = ["by_step", "from_json", "to_csv", "to_numpy"]

OF_EPISODE = ("length", "log_prob", "distance", "reward")


def to_numpy(failures: Any) -> dict[str, np.ndarray]:
    """Failures as a dict of arrays, by falling reward.

    Args:
        failures: n of them, a `jast.failures.Failures`.

    Returns:
        ``length`` [n], how many steps each has; ``log_prob``, ``distance`` and ``reward`` [n];
        ``x`` [n, horizon, ...], the disturbances, of which the rows from ``length`` on mean
        nothing; with a random start ``x0`` [n, ...]. Where a disturbance is a structure, each of
        its arrays has its own entry, as "x.gust" or "x.0".

    Raises:
        ValueError: for what is no such archive.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0).failures
        >>> jast.failures.to_numpy(found)["x"].shape == (len(found), 30)
        True
    """
    if not isinstance(getattr(failures, "episodes", None), Episode):  # a report counts its own
        raise ValueError(
            "failures must be an archive of jast.failures, as report.failures, received"
            f" {type(failures).__name__}"
        )
    e = jax.tree.map(np.asarray, failures.episodes)
    out = {name: getattr(e, name) for name in OF_EPISODE}
    for root, part in (("x0", e.x0), ("x", e.disturbances)):
        for path, leaf in jax.tree_util.tree_flatten_with_path(part)[0]:
            name = path_name(path)
            out[f"{root}.{name}" if name else root] = leaf
    return out


def to_csv(path: PathLike, failures: Any) -> None:
    """Write failures to a table (comma-separated values), one row for each step.

    The columns are ``failure`` (from 1, the best first), ``step`` (from 1; 0 is the start) and the
    numbers of the disturbance, named as by `to_numpy`, those of an array with their place, as
    "x[2]". With a random start row 0 has the numbers of x0. All digits are kept: read back as
    doubles they are the same numbers. Failure 3 in a simulator of your own, whose disturbance is
    ``x``::

        import csv

        with open("failures.csv", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["failure"] == "3"]
        mine = MySimulator()
        for row in rows:
            mine.step(float(row["x"]))
        print(mine.failed())

    Args:
        path: of the file; an older one of that name is replaced.
        failures: a `jast.failures.Failures`.

    Raises:
        ValueError: for what is no such archive.

    Example:
        >>> import os, tempfile, jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0).failures
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "failures.csv")
        ...     jast.failures.to_csv(path, found)
        ...     with open(path) as file:
        ...         print(file.readline().strip())
        failure,step,x
    """
    check_path("to_csv", path)
    columns = by_step(failures)
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(zip(*columns.values(), strict=True))


def by_step(failures: Any) -> dict[str, list]:
    """The columns of `to_csv`: Python's numbers, None where a row has none."""
    arrays = to_numpy(failures)
    x0 = list(_columns(arrays, "x0", 1))
    first, last = 0 if x0 else 1, arrays["length"]
    at = [(i, t) for i in range(len(last)) for t in range(first, int(last[i]) + 1)]
    columns: dict[str, list] = {"failure": [i + 1 for i, _ in at], "step": [t for _, t in at]}
    for name, values in x0:
        columns[name] = [None if t else values[i].item() for i, t in at]
    for name, values in _columns(arrays, "x", 2):
        columns[name] = [values[i, t - 1].item() if t else None for i, t in at]
    return columns


def from_json(path: PathLike, sim: Simulator) -> Episode:
    """A failure that the page of a report gave as a file (`jast.stress_testing.Report.html`),
    played again to the bit.

    Args:
        path: of the file.
        sim: the simulator that it is of.

    Returns:
        The `jast.Episode`, with its states.

    Raises:
        ValueError: for a file that holds no failure, or one of another simulator.

    Example:
        >>> import json, os, tempfile, jast
        >>> steps = {"name": "", "values": [2.0] * 6, "dtype": "float32"}  # as the page writes it
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "failure-1.json")
        ...     with open(path, "w") as file:
        ...         json.dump({"x0": [], "disturbances": [steps]}, file)
        ...     bool(jast.failures.from_json(path, jast.simulators.walk1d()).failure)
        True
    """
    try:
        check_path("from_json", path)
        given = json.loads(Path(path).read_text(encoding="utf-8"))
        parts = [{a["name"]: a for a in given[name]} for name in ("x0", "disturbances")]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        must = "be a file from the page of a report"
        received = f"{str(path)!r}, which is not one: {error!r}"
        raise wrong("from_json", "path", must, received) from None
    like, wholes = signature_of(sim), []
    for name, part in zip(("x0", "x"), parts, strict=True):
        pairs, treedef = jax.tree_util.tree_flatten_with_path(getattr(like, name))
        names = [path_name(at) for at, _ in pairs]
        if set(names) != set(part):
            must = f"be the simulator of the failure, whose {name} has the fields {sorted(part)}"
            raise wrong("from_json", "sim", must, f"one with {sorted(names)}")
        arrays = [np.array(part[name]["values"], part[name]["dtype"]) for name in names]
        if name == "x":  # of no step there is no shape
            arrays = [
                a if len(a) else np.zeros((0, *shape.shape), a.dtype)
                for a, (_, shape) in zip(arrays, pairs, strict=True)
            ]
        wholes.append(treedef.unflatten(arrays))
    x0, x = wholes
    return replay(sim, x, x0)


def _columns(
    arrays: dict[str, np.ndarray], root: str, lead: int
) -> Iterator[tuple[str, np.ndarray]]:
    """What each number of the arrays of ``root`` is called, and its values [...] over the ``lead``
    first axes.
    """
    for name, values in arrays.items():
        if name == root or name.startswith(f"{root}."):
            for at in np.ndindex(values.shape[lead:]):
                yield f"{name}[{','.join(map(str, at))}]" if at else name, values[(..., *at)]
