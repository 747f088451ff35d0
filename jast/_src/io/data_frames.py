"""Results as tables of pandas and data sets of xarray, which are imported when one is made."""

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np

from jast._src.util.checks import import_library
from jast._src.util.leaf_names import named_fields

__all__ = ["dataframe", "dataset"]

OF_EPISODE = ("log_prob", "distance", "reward", "failure", "length")


def dataframe(columns: Iterable[tuple[str, Any]], index: Sequence[str]) -> Any:
    """A pandas DataFrame.

    Args:
        columns: (name, values) of each; two may have one name, as a user's settings are among them.
        index: names of the first columns, which are the index.
    """
    names, values = zip(*columns, strict=True)
    table = import_library("to_dataframe", "pandas", "tables").DataFrame(dict(enumerate(values)))
    table = table.set_index(list(range(len(index)))) if index else table
    table.index.names = list(index) or [None]
    table.columns = list(names[len(index) :])
    return table


def dataset(e: Any, **attributes: Any) -> Any:
    """The xarray Dataset of `jast.Episode.to_xarray`, with ``attributes``."""
    xarray = import_library("to_xarray", "xarray", "tables")
    shape = np.shape(e.length)
    if len(shape) > 1:
        raise ValueError(
            f"to_xarray: expected one episode or a batch with one leading axis, received {shape}"
        )
    if not shape:
        e = jax.tree.map(lambda a: np.asarray(a)[None], e)
    length = np.asarray(e.length)
    steps = np.arange(jax.tree.leaves(e.disturbances)[0].shape[1] + 1)
    blank = (steps > length[:, None])[..., None]
    found = {name: (("chain", "draw"), np.asarray(getattr(e, name))[None]) for name in OF_EPISODE}
    places = {"step": steps}
    for root, tree, late in (("x0", e.x0, None), ("x", e.disturbances, 1), ("state", e.states, 0)):
        for f in named_fields(tree, root, lead=1 if late is None else 2):
            own = f.name == root or f.name.startswith(f"{root}.")
            name = f.name if own else f"{root}.{f.name}"
            values, dims = f.values, ("chain", "draw")
            if late is not None:
                values = np.pad(values, ((0, 0), (late, 0), (0, 0)), constant_values=np.nan)
                values, dims = np.where(blank, np.nan, values), (*dims, "step")
            if f.entries == [""]:
                found[name] = dims, values[None, ..., 0]
            else:
                places[f"{name}_place"] = f.entries
                found[name] = (*dims, f"{name}_place"), values[None]
    return xarray.Dataset(found, coords=places, attrs=attributes)
