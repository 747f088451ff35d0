"""Results as JSON and arrays: a tree of plain values, arrays and jast's own records, and back, to
the bit.

The JSON holds what is a number, a text, True, False or None as it is; everything else as an object
of one key that says what it is. Arrays are named, and stand beside it.
"""

import importlib
import pkgutil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.io import former_files
from jast._src.io.npz import misfit, unknown
from jast._src.runtime._jax import is_traced
from jast._src.util.pytrees import fields_of

__all__ = ["Given", "check_episodes", "check_fits", "decode", "encode", "name_of", "place_of"]

RECORDS = {
    "Episode": "jast._src.core.episode:Episode",
    "Failures": "jast._src.core.failures:Failures",
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
    "Crossing": "jast._src.sweeping.crossing:Crossing",
    "Roots": "jast._src.search.tree.prune:Roots",
    "Branches": "jast._src.search.tree.edges:Branches",
    "Heads": "jast._src.heads.heads:Heads",
    "Moments": "jast._src.heads.heads:Moments",
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
    "FailurePolicy": "jast._src.policies.failure_policy:FailurePolicy",
    "Learned": "jast._src.policies.failure_policy:Learned",
    "Learning": "jast._src.policies.failure_policy:History",
    "Normalisation": "jast._src.policies.actor:Normalisation",
    "StartTilt": "jast._src.policies.start_fit:Tilt",
    "Validation": "jast._src.weakness.result:Result",
    "ValidationHistory": "jast._src.weakness.result:History",
    "ValidationState": "jast._src.weakness.result:State",
}
"""Records by their names in files, which stay when a class moves."""
FORMER = {"FailureSamples": {"episodes": "failures"}}
"""Record -> fields by their names in files of an earlier version -> their names now."""
NAMES = {place: name for name, place in RECORDS.items()}
WITH_FUNCTIONS = {"Heads": "jast._src.heads.storage", "FailurePolicy": "jast._src.policies.storage"}
"""Record that holds functions -> module whose ``parts(value)`` are the fields that a file has, and
whose ``whole(path, fields, given)`` is the value again.
"""
FUNCTIONS = (
    "jast._src.core.policy:Policy",
    "jast._src.estimate.proposals:Proposal",
    "jast._src.core.simulator:Simulator",
)
"""Made of functions, which are in no file."""


class Given(NamedTuple):
    """What a user gives for that which no file holds."""

    sim: Any = None
    """The simulator, whose states, x0 and x may hold classes of its own."""
    heads: Any = None
    """`jast.heads.Heads`, whose functions are taken."""


def encode(value: Any, arrays: dict[str, np.ndarray], at: str = "result") -> Any:
    """``value`` as JSON has it; its arrays go into ``arrays``.

    Args:
        value: what is to be kept.
        arrays: by their places in ``value``.
        at: the place of ``value``.

    Raises:
        ValueError: that names the place of what cannot be kept.
    """

    def below(child: Any, name: Any) -> Any:
        return encode(child, arrays, f"{at}.{name}")

    if value is None or type(value) in (bool, int, float, str):  # no NumPy number, which stays one
        return value
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _array(value, arrays, at)
    if place_of(value) in FUNCTIONS:
        return {"left out": place_of(value)}
    if (name := name_of(value)) is not None:
        return {"record": [name, {k: below(v, k) for k, v in _fields(name, value).items()}]}
    if type(value) in (tuple, list):
        return {type(value).__name__: [below(v, i) for i, v in enumerate(value)]}
    if type(value) is dict and all(isinstance(k, str) for k in value):
        return {"dict": {k: below(v, k) for k, v in value.items()}}
    if type(value) is dict:
        raise ValueError(f"save: the keys of {at} must be texts, received {list(value)!r:.80}")
    names, children = _children_of(value)
    if children is None:
        raise ValueError(f"save: {at} must be an array, a number or a text, received {value!r}")
    parts = [below(v, i) for i, v in enumerate(children)]
    return {"class": [type(value).__name__, names, parts]}


def decode(node: Any, path: Any, arrays: dict[str, np.ndarray], given: Given) -> Any:
    """What `encode` was given, with NumPy arrays.

    Args:
        node: JSON of `encode`.
        path: of the file, for messages.
        arrays: of `encode`.
        given: what the file does not hold.

    Raises:
        ValueError: for what does not fit ``given``, or needs what was not given.
    """

    def below(child: Any) -> Any:
        return decode(child, path, arrays, given)

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
        return _record(path, name, {now.get(k, k): below(v) for k, v in fields.items()}, given)
    if kind == "class":
        name, names, children = about
        return _own(path, given, name, names).unflatten(map(below, children))
    if kind == "left out":
        return None
    if kind == "kind":
        return below(former_files.node_of(*about))
    raise unknown(path, f"holds {kind!r}")


def check_episodes(path: Any, sim: Any, *values: Any) -> None:
    """ValueError unless those of ``values`` that are episodes are of ``sim``."""
    from jast._src.core.signature import signature_of

    like = signature_of(sim)
    for e in values:
        if name_of(e) == "Episode":
            axes = np.ndim(e.length)
            check_fits(path, "sim", "x0", e.x0, like.x0, axes)
            check_fits(path, "sim", "disturbances", e.disturbances, like.x, axes, (sim.horizon,))


def check_fits(
    path: Any,
    other: str,
    name: str,
    value: Any,
    like: Any,
    axes: int = 0,
    rows: tuple[int, ...] = (),
) -> None:
    """ValueError unless the arrays of ``value`` are those of ``like``: in structure, kinds of
    number and shapes, which follow on the first ``axes`` and ``rows``. The precision may differ.

    ``other`` is the argument that must fit, ``name`` a part of the file.
    """
    structure, expected = jax.tree.structure(value), jax.tree.structure(like)
    if structure != expected:
        raise misfit(path, other, f"{name} has the structure {structure}, expected {expected}")
    pairs = jax.tree_util.tree_leaves_with_path(like)
    for a, (at, s) in zip(jax.tree.leaves(value), pairs, strict=True):
        shape, wanted = np.shape(a)[axes:], (*rows, *np.shape(s))
        dtype, kind = jnp.result_type(a), jnp.result_type(s)
        if shape != wanted or _kind_of_number(dtype) != _kind_of_number(kind):
            has = f"{dtype.name}{list(shape)}, expected {kind.name}{list(wanted)}"
            raise misfit(path, other, f"{name}{jax.tree_util.keystr(at)} has {has}")


def name_of(value: Any) -> str | None:
    """The name of a result's class in files, such as "Report"; None of anything else. For those who
    take a result and are called by its methods, and so cannot import its class.
    """
    return NAMES.get(place_of(value))


def place_of(value: Any) -> str:
    """ "module:Class" of a value."""
    return f"{type(value).__module__}:{type(value).__qualname__}"


def _kind_of_number(dtype: Any) -> Any:
    kinds = jnp.floating, jnp.signedinteger, jnp.unsignedinteger
    return next((kind for kind in kinds if jnp.issubdtype(dtype, kind)), dtype)


def _array(value: Any, arrays: dict[str, np.ndarray], at: str) -> dict[str, str]:
    if is_traced(value):
        raise ValueError(f"save: {at} must have a value, received a traced array")
    if jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        raise ValueError(f"save: {at} must be numbers, received a key: keep its key_data")
    if value.dtype.kind in "OSU":
        raise ValueError(f"save: {at} must be an array of numbers, received {value.dtype}")
    while at in arrays:  # a name with a point in it may look like a path
        at += "'"
    arrays[at] = np.asarray(value)
    return {"number" if isinstance(value, np.generic) else "array": at}


def _fields(name: str, value: Any) -> dict[str, Any]:
    if name in WITH_FUNCTIONS:
        return importlib.import_module(WITH_FUNCTIONS[name]).parts(value)
    return fields_of(value)


def _record(path: Any, name: str, fields: dict[str, Any], given: Given) -> Any:
    if name not in RECORDS:
        raise unknown(path, f"holds a {name}")
    if name in WITH_FUNCTIONS:
        return importlib.import_module(WITH_FUNCTIONS[name]).whole(path, fields, given)
    if name == "Failures" and given.sim is not None:
        check_episodes(path, given.sim, fields["episodes"])
    return pkgutil.resolve_name(RECORDS[name])(**fields)


def _children_of(node: Any) -> tuple[list[str], list | None]:
    """Names and children of a node of a pytree; None in place of the children of a leaf."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(node, is_leaf=lambda child: child is not node)
    if len(pairs) == 1 and pairs[0][1] is node:
        return [], None
    return [jax.tree_util.keystr(path) for path, _ in pairs], [child for _, child in pairs]


def _own(path: Any, given: Given, name: str, names: list[str]) -> Any:
    """The structure of one node of a class of the simulator's, or of the heads'."""
    from jast._src.core.signature import signature_of

    if given.sim is None and given.heads is None:
        raise ValueError(
            f"load: {path} holds values of the class {name}, which only its simulator can restore:"
            " load(path, sim); of heads, load(path, heads=heads)"
        )
    left = [] if given.sim is None else [signature_of(given.sim)]
    left += [] if given.heads is None else [given.heads]
    while left:
        node = left.pop()
        own, children = _children_of(node)
        if children is None:
            continue
        if type(node).__name__ == name and own == names:
            return jax.tree.structure(node, is_leaf=lambda child, own=node: child is not own)
        left += children
    other = "heads" if given.sim is None else "sim"
    words = f"it holds values of the class {name}, which {other} does not have"
    raise misfit(path, other, words)
