"""Files of a training that goes on: everything that the rest of it depends on."""

import json

import jax
import jax.numpy as jnp
import numpy as np

from jast.archive import arrays_of, check_array, check_structure, describe, named, read, write

FORMAT, VERSION, KIND = "jast sac checkpoint", 2, "a checkpoint of jast.policies.sac"


def keep(path, sim, settings, training, rows):
    """Write where a training stands to the one file ``path``; the older one stays whole until the
    new one is.
    """
    header = dict(settings=settings, training=describe(training))
    write(path, FORMAT, VERSION, header, named(dict(training=training, rows=rows, sim=sim)))


def resume(path, sim, settings, like):
    """``(Training, rows)`` of a file of `keep`; ``like``: a training's shapes. ValueError where it
    is one of another simulator or of other settings.
    """
    header, arrays = read(path, FORMAT, VERSION, KIND)
    settings = json.loads(json.dumps(settings))  # as the file has them
    if different := [name for name in settings if header["settings"].get(name) != settings[name]]:
        name = different[0]
        raise ValueError(
            f"sac: checkpoint {path} is of another training: {name} was"
            f" {header['settings'].get(name)}, expected {settings[name]}"
        )
    check_structure(path, "sim", "training", header["training"], like)
    leaves = arrays_of(arrays, "training")
    for a, (at, s) in zip(leaves, jax.tree_util.tree_leaves_with_path(like), strict=True):
        check_array(path, "sim", f"training{jax.tree_util.keystr(at)}", a, s)
    theirs, own = arrays_of(arrays, "sim"), [np.asarray(a) for a in jax.tree.leaves(sim)]
    if len(theirs) != len(own) or not all(
        np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        for a, b in zip(theirs, own, strict=True)
    ):
        raise ValueError(
            f"sac: checkpoint {path} is of another training: sim has other parameters, expected"
            f" {theirs}, received {own}"
        )
    (rows,) = arrays_of(arrays, "rows")
    return jax.tree.structure(like).unflatten(map(jnp.asarray, leaves)), rows
