"""Failures as plain numbers: for a simulator of the user's own, which may not be in Python."""

import csv
import os
from typing import Any

import jax
import numpy as np

__all__ = ["to_csv", "to_numpy"]

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
    """
    e = jax.tree.map(np.asarray, failures.episodes)
    out = {name: getattr(e, name) for name in OF_EPISODE}
    for root, part in (("x0", e.x0), ("x", e.disturbances)):
        for path, leaf in jax.tree_util.tree_flatten_with_path(part)[0]:
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            out[f"{root}.{name}" if name else root] = leaf
    return out


def to_csv(path: str | os.PathLike, failures: Any) -> None:
    """Write failures to a table (comma-separated values), one row for each step.

    The columns are ``failure`` (from 1, the best first), ``step`` (from 1; 0 is the start) and the
    numbers of the disturbance, named as by `to_numpy`, those of an array with their place, as
    "x[2]". With a random start row 0 has the numbers of x0. All digits are kept: read back as
    doubles they are the same numbers.

    Args:
        path: of the file; an older one of that name is replaced.
        failures: a `jast.failures.Failures`.
    """
    arrays = to_numpy(failures)
    of_start = {k: v for k, v in arrays.items() if k == "x0" or k.startswith("x0.")}
    of_steps = {k: v for k, v in arrays.items() if k == "x" or k.startswith("x.")}
    columns = [_names(k, v.shape[1:]) for k, v in of_start.items()]
    columns += [_names(k, v.shape[2:]) for k, v in of_steps.items()]
    names = [name for each in columns for name in each]
    blank = [""] * sum(len(_names(k, v.shape[2:])) for k, v in of_steps.items())
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["failure", "step", *names])
        for i in range(len(failures)):
            first = [n for v in of_start.values() for n in _numbers(v[i])]
            if first:
                table.writerow([i + 1, 0, *first, *blank])
            for t in range(int(arrays["length"][i])):
                row = [n for v in of_steps.values() for n in _numbers(v[i, t])]
                table.writerow([i + 1, t + 1, *[""] * len(first), *row])


def _names(name: str, shape: tuple) -> list[str]:
    places = (",".join(map(str, at)) for at in np.ndindex(shape))
    return [f"{name}[{at}]" for at in places] if shape else [name]


def _numbers(values: np.ndarray) -> list:
    return np.asarray(values).reshape(-1).tolist()  # Python's: shortest text with all digits
