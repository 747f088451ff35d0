"""Files of a training that goes on: everything that the rest of it depends on."""

import json
import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast.archive import arrays_of, check_array, check_structure, describe, named, read, write
from jast.simulator import Simulator

__all__ = ["Book"]

VERSION = 2


class Book(NamedTuple):
    """Where a training is kept: in the one file ``path``, or nowhere."""

    function: str
    """That teaches, in words of the file and of errors."""
    path: str | os.PathLike | None
    sim: Simulator
    settings: dict
    """All that a training depends on beside ``sim``, as JSON has it."""

    @property
    def format(self) -> str:
        return f"jast {self.function} checkpoint"

    def keep(self, training: Any, rows: np.ndarray) -> None:
        """Write where a training stands; the older file stays whole until the new one is."""
        if self.path is not None:
            header = dict(settings=self.settings, training=describe(training))
            arrays = named(dict(training=training, rows=rows, sim=self.sim))
            write(self.path, self.format, VERSION, header, arrays)

    def resume(self, like: Any) -> tuple[Any, np.ndarray] | None:
        """``(Training, rows)`` of the file, None where there is none; ``like``: a training's
        shapes. ValueError for a file of another simulator or of other settings.
        """
        path, other = self.path, f"{self.function}: checkpoint {self.path} is of another training"
        if path is None or not os.path.exists(path):
            return None
        kind = f"a checkpoint of jast.policies.{self.function}"
        header, arrays = read(path, self.format, VERSION, kind)
        theirs, own = header["settings"], json.loads(json.dumps(self.settings))
        if different := [name for name in own if theirs.get(name) != own[name]]:
            name = different[0]
            raise ValueError(f"{other}: {name} was {theirs.get(name)}, expected {own[name]}")
        check_structure(path, "sim", "training", header["training"], like)
        leaves = arrays_of(arrays, "training")
        for a, (at, s) in zip(leaves, jax.tree_util.tree_leaves_with_path(like), strict=True):
            check_array(path, "sim", f"training{jax.tree_util.keystr(at)}", a, s)
        theirs, own = arrays_of(arrays, "sim"), [np.asarray(a) for a in jax.tree.leaves(self.sim)]
        if len(theirs) != len(own) or not all(
            np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
            for a, b in zip(theirs, own, strict=True)
        ):
            raise ValueError(
                f"{other}: sim has other parameters, expected {theirs}, received {own}"
            )
        (rows,) = arrays_of(arrays, "rows")
        return jax.tree.structure(like).unflatten(map(jnp.asarray, leaves)), rows
