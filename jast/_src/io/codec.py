"""Results as JSON and arrays: a tree of plain values, arrays and jast's own records, and back, to
the bit.

The JSON holds what is a number, a text, True, False or None as it is; everything else as an object
of one key that says what it is. Arrays are named, and stand beside it.
"""

import importlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jast._src.io.npz import children_of
from jast._src.runtime._jax import is_traced

__all__ = ["decode", "encode", "name_of", "place_of"]

RECORDS = {
    "Episode": "jast._src.core.episode:Episode",
    "Incident": "jast._src.runtime.host_errors:Incident",
    "Nominal": "jast._src.core.nominal:Nominal",
    "SearchResult": "jast._src.search.result:SearchResult",
    "SearchHistory": "jast._src.search.result:History",
    "Trials": "jast._src.search.result:Trials",
    "Refined": "jast._src.search.refine.refine:Refined",
    "Report": "jast._src.stress_testing.report:Report",
    "Tried": "jast._src.stress_testing.report:Tried",
    "Mode": "jast._src.search.refine.modes:Mode",
    "Modes": "jast._src.search.refine.modes:Modes",
    "Sweep": "jast._src.sweeping.table:Sweep",
    "Crossing": "jast._src.sweeping.table:Crossing",
    "Roots": "jast._src.search.tree.prune:Roots",
    "Branches": "jast._src.search.tree.edges:Branches",
    "Lesson": "jast._src.heads.train_head:Lesson",
    "Estimate": "jast._src.estimate.estimate:Estimate",
    "Draws": "jast._src.estimate.weighted_draws:Draws",
    "Event": "jast._src.estimate.events:Event",
    "Exceedance": "jast._src.estimate.exceedance_and_times:Exceedance",
    "FailureTimes": "jast._src.estimate.exceedance_and_times:FailureTimes",
    "GivenStart": "jast._src.estimate.events:GivenStart",
    "Latent": "jast._src.normal_space.transform:Latent",
    "Tilts": "jast._src.estimate.tilts.tilts:Tilts",
    "TiltFrame": "jast._src.estimate.tilts.tilts:Frame",
    "TiltBlock": "jast._src.estimate.tilts.tilts:Block",
    "Sample": "jast._src.estimate.population.failure_sample:Sample",
    "FailureSamples": "jast._src.estimate.failure_samples:FailureSamples",
    "FailureProposal": "jast._src.estimate.multilevel:FailureProposal",
    "Traces": "jast._src.estimate.importance_sampling:Traces",
    "Steps": "jast._src.normal_space.sequences:Steps",
    "CEResult": "jast._src.cross_entropy.result:CEResult",
    "CEHistory": "jast._src.cross_entropy.result:History",
    "Gaussian": "jast._src.cross_entropy.gaussian:Gaussian",
    "Mixture": "jast._src.cross_entropy.mixture:Mixture",
    "Validation": "jast._src.weakness.result:Result",
    "ValidationHistory": "jast._src.weakness.result:History",
}
"""Records by their names in files, which stay when a class moves."""
FORMER = {"FailureSamples": {"episodes": "failures"}}
"""Record -> fields by their names in files of an earlier version -> their names now."""
NAMES = {place: name for name, place in RECORDS.items()}

Special = Callable[[Any], Any]


def encode(value: Any, arrays: dict[str, np.ndarray], special: Special, at: str = "result") -> Any:
    """``value`` as JSON has it; its arrays go into ``arrays``.

    Args:
        value: what is to be kept.
        arrays: by their places in ``value``.
        special: value -> the JSON object of what is kept in another way, or None.
        at: the place of ``value``.

    Raises:
        ValueError: that names the place of what cannot be kept.
    """

    def below(child: Any, name: Any) -> Any:
        return encode(child, arrays, special, f"{at}.{name}")

    if value is None or type(value) in (bool, int, float, str):  # no NumPy number, which stays one
        return value
    if (found := special(value)) is not None:
        return found
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _array(value, arrays, at)
    if (name := name_of(value)) is not None:
        return {"record": [name, {k: below(v, k) for k, v in value._asdict().items()}]}
    if type(value) in (tuple, list):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [below(v, i) for i, v in enumerate(value)]}
    if type(value) is dict and all(isinstance(k, str) for k in value):
        return {"dict": {k: below(v, k) for k, v in value.items()}}
    names, children = children_of(value)
    if children is None:
        raise ValueError(f"save: {at} must be an array, a number or a text, received {value!r}")
    parts = [below(v, i) for i, v in enumerate(children)]
    return {"class": [type(value).__name__, names, parts]}


def decode(node: Any, path: str, arrays: dict[str, np.ndarray], special: Special, sim: Any) -> Any:
    """What `encode` was given, with NumPy arrays.

    Args:
        node: JSON of `encode`.
        path: of the file, for messages.
        arrays: of `encode`.
        special: JSON object -> value, of what was kept in another way.
        sim: the simulator whose states, x0 and x may hold classes of its own, or None.

    Raises:
        ValueError: for classes that only a simulator can restore, where there is none or another.
    """

    def below(child: Any) -> Any:
        return decode(child, path, arrays, special, sim)

    if not isinstance(node, dict):
        return node
    ((kind, about),) = node.items()
    if kind == "array":
        return arrays[about]
    if kind == "number":
        return arrays[about][()]
    if kind in ("tuple", "list"):
        return (tuple if kind == "tuple" else list)(map(below, about))
    if kind == "dict":
        return {k: below(v) for k, v in about.items()}
    if kind == "record":
        name, fields = about
        now = FORMER.get(name, {})
        return _record(path, name)(**{now.get(k, k): below(v) for k, v in fields.items()})
    if kind == "class":
        name, names, children = about
        return _own(path, sim, name, names).unflatten(map(below, children))
    return special(node)


def name_of(value: Any) -> str | None:
    """The name of a result's class in files, such as "Report"; None of anything else. For those who
    take a result and are called by its methods, and so cannot import its class.
    """
    return NAMES.get(place_of(value))


def place_of(value: Any) -> str:
    """ "module:Class" of a value."""
    return f"{type(value).__module__}:{type(value).__qualname__}"


def _array(value: Any, arrays: dict[str, np.ndarray], at: str) -> dict[str, str]:
    if is_traced(value):
        raise ValueError(f"save: {at} must have a value, received a traced array")
    if jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        raise ValueError(f"save: {at} must be numbers, received a key: keep its key_data")
    if value.dtype.kind in "OSU":
        raise ValueError(f"save: {at} must be an array of numbers, received {value.dtype}")
    arrays[at] = np.asarray(value)
    return {"number" if isinstance(value, np.generic) else "array": at}


def _record(path: str, name: str) -> type:
    if name not in RECORDS:
        raise ValueError(
            f"load: {path} holds a {name}, which this jast does not know: use the jast that wrote"
            " the file"
        )
    module, _, attribute = RECORDS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def _own(path: str, sim: Any, name: str, names: list[str]) -> Any:
    """The structure of one node of a class of the simulator's."""
    if sim is None:
        raise ValueError(
            f"load: {path} holds values of the class {name}, which only its simulator can restore:"
            " load(path, sim)"
        )
    from jast._src.core.signature import outline

    known = outline(sim)
    left = [known.x0, known.x, known.state]
    while left:
        node = left.pop()
        own, children = children_of(node)
        if children is None:
            continue
        if type(node).__name__ == name and own == names:
            return jax.tree.structure(node, is_leaf=lambda child, own=node: child is not own)
        left += children
    raise ValueError(
        f"load: {path} does not fit sim: it holds values of the class {name}, which sim does not"
        " have"
    )
