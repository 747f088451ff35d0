"""States of a validation in files."""

import numpy as np

from jast import archive
from jast.weakness.result import History, State

__all__ = ["load", "save"]

FORMAT, VERSION, KIND = "jast validation", 1, "a validation of jast.weakness"
PLAIN = ("selector", "data", "complete", "finished")


def save(path, state):
    """Write a `State` to the one file ``path``; an older file of that name stays whole until the
    new one is.
    """
    if not isinstance(state, State):
        raise ValueError(
            f"save: state must be the state of a Result, received {type(state).__name__}"
        )
    arrays = {"key": state.key, "order": state.order, "predicted": state.predicted}
    arrays |= {f"memory.{name}": np.asarray(a) for name, a in state.memory.items()} | {
        f"history.{name}": a for name, a in state.history._asdict().items()
    }
    archive.write(path, FORMAT, VERSION, {name: getattr(state, name) for name in PLAIN}, arrays)


def load(path):
    """The `State` of a file of `save`. ValueError for a file that is none, damaged, or of another
    version.
    """
    header, arrays = archive.read(path, FORMAT, VERSION, KIND)
    part = lambda name: {
        k.removeprefix(f"{name}."): a for k, a in arrays.items() if k.startswith(f"{name}.")
    }
    return State(
        memory=part("memory"),
        history=History(**part("history")),
        **{k: arrays[k] for k in ("key", "order", "predicted")},
        **{k: header[k] for k in PLAIN},
    )
