"""Results in files: `save` and `load`, one pair for all kinds.

A file is an npz that `numpy.load` opens without pickle; its entry ``header`` is JSON with a format,
a version and a checksum (`io.npz`). Archives of failures, heads, failure policies and states
of validations have formats of their own, which version 0.1.0 reads and wrote; all other results are
records (`io.codec`), in which those stand as parts.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jast._src.core.signature import outline
from jast._src.io import npz
from jast._src.io.codec import decode, encode, place_of

if TYPE_CHECKING:
    from jast._src.core.typing import PathLike

__all__ = ["from_bytes", "load", "parts", "restore", "save", "store", "to_bytes"]


class Kind(NamedTuple):
    """A format: ``module.parts(value) -> (header, arrays)``, and back ``module.whole(path, header,
    arrays, sim)`` (of heads: ``heads`` in place of ``sim``).
    """

    version: int
    words: str
    """What a file of it is called."""
    place: str
    """ "module:Class" of what it holds."""
    module: str


KINDS = {
    "jast failures": Kind(
        1,
        "a jast archive of failures",
        "jast._src.core.failures:Failures",
        "jast._src.core.failures",
    ),
    "jast heads": Kind(
        1, "a file of jast heads", "jast._src.heads.heads:Heads", "jast._src.heads.storage"
    ),
    "jast policy": Kind(
        1,
        "a file of a jast failure policy",
        "jast._src.policies.failure_policy:FailurePolicy",
        "jast._src.policies.storage",
    ),
    "jast validation": Kind(
        1,
        "a validation of jast.weakness",
        "jast._src.weakness.result:State",
        "jast._src.weakness.storage",
    ),
    "jast result": Kind(1, "a result of jast", "", "jast._src.io.save_load"),
}
RESULT = "jast result"
FORMATS = {kind.place: format for format, kind in KINDS.items() if kind.place}
FUNCTIONS = (
    "jast._src.core.policy:Policy",
    "jast._src.estimate.proposals:Proposal",
    "jast._src.core.simulator:Simulator",
)
"""Made of functions, which are in no file."""


def save(path: PathLike, result: Any) -> None:
    """Write a result to a file. The write is atomic: an existing file is replaced only once the new
    one is complete.

    Args:
        path: of the file, by any name.
        result: of a search, an estimate, a cross-entropy method, `jast.nominal` or a validation; an
            archive of failures, an `jast.Episode`, `jast.heads.Heads`, a failure policy, or the
            state of a validation; also a batch of them, from `jax.vmap`. A proposal that is made of
            functions and the simulator of a report are left out, and are None after `load`.

    Raises:
        ValueError: that names what a file cannot hold.

    Example:
        >>> import os, tempfile, jax, jast
        >>> episode = jast.rollout(jax.random.key(0), jast.simulators.walk1d())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "episode.npz")
        ...     jast.save(path, episode)
        ...     bool(jast.load(path).distance == episode.distance)
        True
    """
    store(path, FORMATS.get(place_of(result), RESULT), result)


def load(path: PathLike, sim: Any = None, *, heads: Any = None) -> Any:
    """What `save` wrote, equal to the bit; its arrays are NumPy's and keep their dtypes.

    Args:
        path: of the file. Files of version 0.1.0 can be read too.
        sim: the simulator of the result, which must fit it (horizon, structure, shapes, kinds of
            number; the float precision may differ). A failure policy needs it, and so do x0, x and
            states that hold classes of their own.
        heads: `jast.heads.Heads` with functions of your own, for a file that holds such heads.

    Raises:
        ValueError: that says why the file is refused: it is not one of jast, its version is
            unknown, it is damaged, or it does not fit ``sim`` or ``heads``.

    Example:
        >>> import os, tempfile, jax, jast
        >>> found = jast.nominal(jax.random.key(0), jast.simulators.walk1d(), 100)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "nominal.npz")
        ...     jast.save(path, found)
        ...     jast.load(path).episodes
        100
    """
    header, arrays = npz.read(
        path, {format: kind.version for format, kind in KINDS.items()}, "a file of jast.save"
    )
    return _whole(path, header["format"], header, arrays, sim, heads)


def store(path: Any, format: str, value: Any, **more: Any) -> None:
    """Write ``value`` in this format, with ``more`` in the header."""
    header, arrays = _module(format).parts(value)
    npz.write(path, format, KINDS[format].version, header | more, arrays)


def restore(path: Any, format: str, sim: Any = None, heads: Any = None) -> tuple[Any, dict]:
    """``(value, header)`` of a file of this format."""
    kind = KINDS[format]
    header, arrays = npz.read(path, {format: kind.version}, kind.words)
    return _whole(path, format, header, arrays, sim, heads), header


def to_bytes(result: Any) -> bytes:
    """What `save` writes, as bytes, of a result of any kind."""
    return npz.pack(RESULT, KINDS[RESULT].version, *parts(result))


def from_bytes(data: bytes, path: str, sim: Any = None) -> Any:
    """What `to_bytes` was given, as `load` gives it; ``path``: what errors call it."""
    kind = KINDS[RESULT]
    header, arrays = npz.unpack(data, path, {RESULT: kind.version}, kind.words)
    return _result(path, header, arrays, sim, None)


def parts(value: Any) -> tuple[dict, dict[str, np.ndarray]]:
    """Of a result that is a record: ``(header, arrays)``."""
    arrays = {}

    def special(part: Any) -> dict | None:
        place = place_of(part)
        if place in FUNCTIONS:
            return {"left out": place}
        if (format := FORMATS.get(place)) is None:
            return None
        name = f"part{len(arrays)}"
        header, own = _module(format).parts(part)
        arrays.update({f"{name}/{k}": a for k, a in own.items()})
        return {"kind": [format, KINDS[format].version, name, sorted(own), header]}

    return {"result": encode(value, arrays, special)}, arrays


def _whole(path: Any, format: str, header: dict, arrays: dict, sim: Any, heads: Any) -> Any:
    if format == RESULT:
        return _result(path, header, arrays, sim, heads)
    given = heads if format == "jast heads" else sim
    return _module(format).whole(path, header, arrays, given)


def _result(path: Any, header: dict, arrays: dict[str, np.ndarray], sim: Any, heads: Any) -> Any:
    """The result of `parts`."""

    def special(node: dict) -> Any:
        ((what, about),) = node.items()
        if what == "left out":
            return None
        if what != "kind":
            raise ValueError(
                f"load: {path} holds {what!r}, which this jast does not know: use the jast that"
                " wrote the file"
            )
        format, version, name, names, own = about
        if format not in KINDS or version != KINDS[format].version:
            raise ValueError(
                f"load: {path} holds {format!r} of version {version}, which this jast does not"
                f" know: use the jast that wrote the file, {header.get('package')}"
            )
        these = {k: arrays[f"{name}/{k}"] for k in names}
        return _whole(path, format, own, these, sim, heads)

    result = decode(header["result"], path, arrays, special, sim)
    if sim is not None:
        _check(path, result, sim)
        if place_of(result) == "jast._src.stress_testing.report:Report":
            result = result._replace(sim=sim)
        if place_of(result) == "jast._src.estimate.multilevel:FailureProposal":
            proposing = importlib.import_module("jast._src.estimate.multilevel").proposing
            result = result._replace(policy=proposing(sim, result.start, result.steps))
    return result


def _check(path: Any, result: Any, sim: Any) -> None:
    """ValueError unless the episodes of ``result`` are of ``sim``."""
    from jast._src.core.episode import Episode

    like = outline(sim)
    parts = ("x0", like.x0, ()), ("disturbances", like.x, (sim.horizon,))
    for e in [result, *(result if isinstance(result, tuple) else ())]:
        if not isinstance(e, Episode):
            continue
        for name, own, rows in parts:
            value, axes = getattr(e, name), np.ndim(e.length)
            leaves = jax.tree.leaves(value)
            npz.check_part(path, name, npz.describe(value), leaves, own, rows, axes)


def _module(format: str) -> Any:
    return importlib.import_module(KINDS[format].module)
