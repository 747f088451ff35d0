"""Results in files: `save` and `load`, one pair for all kinds.

A file is an npz that `numpy.load` opens without pickle; its entry ``header`` is JSON with a format,
a version and a checksum (`io.npz`), and the result itself as `io.codec` has it.
"""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import numpy as np

from jast._src.core.typing import PathLike
from jast._src.io import former_files, npz
from jast._src.io.codec import Given, check_episodes, decode, encode, name_of, place_of
from jast._src.runtime._jax import is_traced, is_tracing
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.checks import check_path

__all__ = [
    "check_kind",
    "from_bytes",
    "load",
    "parts",
    "restore",
    "save",
    "store",
    "to_bytes",
    "whole",
]

FORMAT = "jast result"
VERSION = 1  # of `FORMAT`; a file of another one is refused
FORMATS = {FORMAT: VERSION} | former_files.FORMATS
KIND = "a file of jast.save"


def save(path: PathLike, result: Any) -> None:
    """Write a result to a file. The write is atomic: an existing file is replaced only once the new
    one is complete.

    Args:
        path: of the file, by any name.
        result: of a search, an estimate, a cross-entropy method, `jast.nominal` or a validation; an
            archive of failures, an `jast.Episode`, `jast.heads.Heads`, a failure policy, or the
            state of a validation; also a batch of them, from `jax.vmap`. A proposal that is made of
            functions and the simulator of a report are left out, and are None after `load`. Of
            heads, a function of your own is left out: `load` asks for it.

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
    store(path, result)


def load(path: PathLike, sim: Any = None, *, heads: Any = None) -> Any:
    """What `save` wrote, equal to the bit; its arrays are NumPy's and keep their dtypes.

    Args:
        path: of the file. Files of version 0.1.0 can be read too.
        sim: the simulator of the result, which must fit it (horizon, structure, shapes, kinds of
            number; the float precision may differ). A failure policy needs it, and so do x0, x and
            states that hold classes of their own. Its best failure is played again (not of a black
            box): a warning says where it is another episode than it was.
        heads: `jast.heads.Heads` with functions of your own, for a file that holds such heads. Its
            functions are taken, and the file's parameters must be like its own.

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
    return restore(path, sim, heads)[0]


def store(path: Any, value: Any, **beside: Any) -> None:
    """Write ``value``, and what is ``beside`` it, which `load` leaves out."""
    check_path("save", path)
    npz.write(path, FORMAT, VERSION, *parts(value, **beside))


def restore(path: Any, sim: Any = None, heads: Any = None) -> tuple[Any, dict[str, Any]]:
    """The value of a file and what is beside it."""
    header, arrays = npz.read(path, FORMATS, KIND)
    header = former_files.translate(header)
    beside = {k: decode(v, path, arrays, Given()) for k, v in header["beside"].items()}
    result = whole(path, header, arrays, sim, heads)
    if sim is not None:
        _warn_of_another(path, sim, result)
    return result, beside


def _warn_of_another(path: Any, sim: Any, result: Any) -> None:
    """Warn where the best failure in a result is not the same episode with ``sim``. A system on the
    host is not run.
    """
    from jast._src.core.episode import replay  # whose module uses what files use

    held = result.failures if "failures" in getattr(result, "_fields", ()) else result
    if name_of(held) == "Failures" and np.ndim(held.episodes.length) == 1:
        held = held.best
    if name_of(held) != "Episode" or np.ndim(held.length) or not held.failure:
        return
    if runs_on_host(sim) or is_traced(sim) or is_tracing():
        return
    again = replay(sim, held)
    there, here = held.log_prob.item(), again.log_prob.item()
    if not again.failure:
        said = "no longer fails"
    elif again.length != held.length:
        said = f"fails after {again.length} steps, not {held.length},"
    elif not (np.isnan(there) or np.isclose(there, here, 1e-3, 1e-3)):
        said = f"has log p {here:.6g}, not {there:.6g},"
    else:
        return
    warnings.warn(
        f"load: the best failure in {path} {said} with this simulator, which has other"
        " parameters or functions than the one it was found with (or floats of another precision)",
        UserWarning,
        stacklevel=4,
    )


def check_kind(path: Any, value: Any, kind: type) -> None:
    """ValueError unless a file held a value of this kind."""
    if not isinstance(value, kind):
        raise ValueError(
            f"load: {path} holds {type(value).__name__}, expected {kind.__name__}: jast.load reads"
            " results of every kind"
        )


def to_bytes(result: Any) -> bytes:
    """What `save` writes, as bytes, of a result of any kind."""
    return npz.pack(FORMAT, VERSION, *parts(result))


def from_bytes(data: bytes, path: str, sim: Any = None) -> Any:
    """What `to_bytes` was given, as `load` gives it; ``path``: what errors call it."""
    return whole(path, *npz.unpack(data, path, FORMATS, KIND), sim)


def parts(value: Any, **beside: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """``(header, arrays)`` of a file with ``value``, and what is ``beside`` it."""
    arrays = {}
    nodes = {name: encode(each, arrays, name) for name, each in beside.items()}
    return {"result": encode(value, arrays), "beside": nodes}, arrays


def whole(
    path: Any, header: dict, arrays: dict[str, np.ndarray], sim: Any = None, heads: Any = None
) -> Any:
    """The value of `parts`."""
    result = decode(header["result"], path, arrays, Given(sim, heads))
    if sim is not None:
        check_episodes(path, sim, result, *(result if isinstance(result, tuple) else ()))
        if place_of(result) == "jast._src.stress_testing.report:Report":
            result = result._replace(sim=sim)
        if place_of(result) == "jast._src.estimate.multilevel:FailureProposal":
            proposing = importlib.import_module("jast._src.estimate.multilevel").proposing
            result = result._replace(policy=proposing(sim, result.start, result.steps))
    return result
