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

from jast._jax import is_traced
from jast.archive import children_of

__all__ = ["decode", "encode", "place_of"]

RECORDS = {
    "Episode": "jast.episode:Episode",
    "Incident": "jast.incidents:Incident",
    "Nominal": "jast.crude:Nominal",
    "SearchResult": "jast.search.result:SearchResult",
    "SearchHistory": "jast.search.result:History",
    "Trials": "jast.search.result:Trials",
    "Refined": "jast.search.refinement:Refined",
    "Report": "jast.stress_testing.report:Report",
    "Tried": "jast.stress_testing.report:Tried",
    "Mode": "jast.search.failure_modes:Mode",
    "Modes": "jast.search.failure_modes:Modes",
    "Sweep": "jast.sweeping.table:Sweep",
    "Crossing": "jast.sweeping.table:Crossing",
    "Roots": "jast.search.tree.prune:Roots",
    "Branches": "jast.search.tree.edges:Branches",
    "Lesson": "jast.heads.training:Lesson",
    "Estimate": "jast.estimate.estimate:Estimate",
    "Draws": "jast.estimate.draws:Draws",
    "Event": "jast.estimate.events:Event",
    "Exceedance": "jast.estimate.answers:Exceedance",
    "FailureTimes": "jast.estimate.answers:FailureTimes",
    "GivenStart": "jast.estimate.events:GivenStart",
    "Latent": "jast.limit_state:Latent",
    "Tilts": "jast.estimate.markov_tilts:Tilts",
    "TiltFrame": "jast.estimate.markov_tilts:Frame",
    "TiltBlock": "jast.estimate.markov_tilts:Block",
    "Sample": "jast.estimate.sample:Sample",
    "FailureSamples": "jast.estimate.failure_samples:FailureSamples",
    "FailureProposal": "jast.estimate.multilevel:FailureProposal",
    "Traces": "jast.estimate.importance_sampling:Traces",
    "Steps": "jast.cross_entropy.sequences:Steps",
    "CEResult": "jast.cross_entropy.result:CEResult",
    "CEHistory": "jast.cross_entropy.result:History",
    "Gaussian": "jast.cross_entropy.gaussian:Gaussian",
    "Mixture": "jast.cross_entropy.mixture:Mixture",
    "Validation": "jast.weakness.result:Result",
    "ValidationHistory": "jast.weakness.result:History",
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
    if (name := NAMES.get(place_of(value))) is not None:
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
    from jast.outline import outline

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
