"""States of a validation in files."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jast._src.io import save_load
from jast._src.weakness.result import History, State

if TYPE_CHECKING:
    from jast._src.core.typing import PathLike

__all__ = ["load", "parts", "save", "whole"]

PLAIN = ("selector", "data", "complete", "finished")


def save(path: PathLike, state: State) -> None:
    """Write the state of a validation to a file. Deprecated: use `jast.save`; this function goes
    with the next version.

    Args:
        path: of the file.
        state: what to write.

    Example:
        >>> import os, tempfile, jax, jast
        >>> inputs, labels = (a[:50] for a in jast.weakness.digits())
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), lambda x: labels[: len(x)], inputs, labels, selector="random"
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     jast.weakness.save(os.path.join(folder, "state.npz"), found.state)
    """
    save_load.store(path, "jast validation", state)


def load(path: PathLike) -> State:
    """The state of a validation from a file. Deprecated: use `jast.load`; this function goes with
    the next version.

    Args:
        path: of the file.

    Example:
        >>> import os, tempfile, jax, jast
        >>> inputs, labels = (a[:50] for a in jast.weakness.digits())
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), lambda x: labels[: len(x)], inputs, labels, selector="random"
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "state.npz")
        ...     jast.weakness.save(path, found.state)
        ...     jast.weakness.load(path).selector == found.state.selector
        True
    """
    return save_load.restore(path, "jast validation", None)[0]


def parts(state: State) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays of a state's file."""
    if not isinstance(state, State):
        raise ValueError(
            f"save: state must be the state of a Result, received {type(state).__name__}"
        )
    arrays = {"key": state.key, "order": state.order, "predicted": state.predicted}
    arrays |= {f"memory.{name}": np.asarray(a) for name, a in state.memory.items()} | {
        f"history.{name}": a for name, a in state.history._asdict().items()
    }
    return {name: getattr(state, name) for name in PLAIN}, arrays


def whole(path: str | os.PathLike, header: dict, arrays: dict[str, np.ndarray], _: Any) -> State:
    """The state of `parts`."""

    def part(name):
        prefix = f"{name}."
        return {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}

    return State(
        memory=part("memory"),
        history=History(**part("history")),
        **{k: arrays[k] for k in ("key", "order", "predicted")},
        **{k: header[k] for k in PLAIN},
    )
