"""Files of version 0.2.0 and before, in which failures, heads, policies and validations had formats
of their own, as nodes of `io.codec`.
"""

import itertools
from typing import Any, NamedTuple

__all__ = ["FORMATS", "node_of", "translate"]

FORMATS = {"jast failures": 1, "jast heads": 1, "jast policy": 1, "jast validation": 1}
"""Format -> version that can be read."""
EPISODE = "log_prob distance failure length reward".split()
MOMENTS = "count mean deviation".split()
LEARNING = "episodes steps mean_return failing_share log_p alpha critic_loss scale invalid".split()
DENSE = ["dict", ["bias", "kernel"], ["array", "array"]]
"""The structure of a layer."""


def translate(header: dict[str, Any]) -> dict[str, Any]:
    """The header of a file of any format as `save_load` writes it now."""
    if header["format"] not in FORMATS:
        return {"beside": {}} | header
    node = node_of(header["format"], 1, "", list(header["dtypes"]), header)
    return {"result": node, "beside": {"settings": _plain(header.get("settings", {}))}}


def node_of(format: str, _: int, place: str, names: list[str], header: dict[str, Any]) -> Any:
    """The node of what a file, or the part of one at this ``place``, holds in a ``format``, with
    the ``names`` of its arrays and its ``header``.
    """
    make = {
        "jast failures": _failures,
        "jast heads": _heads,
        "jast policy": _policy,
        "jast validation": _validation,
    }[format]
    return make(_Arrays(place and f"{place}/", names), header)


class _Arrays(NamedTuple):
    """The arrays of a part."""

    prefix: str
    """Of their names in the file."""
    names: list[str]

    def one(self, name: str) -> Any:
        return {"array": self.prefix + name}

    def some(self, *names: str) -> dict[str, Any]:
        return {name: self.one(f"{name}.0") for name in names}

    def record(self, kind: str, part: str, fields: list[str]) -> Any:
        """A record whose ``fields`` are the arrays "part.0", "part.1" ..."""
        return _record(kind, **{field: self.one(f"{part}.{i}") for i, field in enumerate(fields)})

    def tree(self, part: str, structure: Any) -> Any:
        """A pytree of a ``structure``, [kind, names, children] or "array", of those arrays."""
        return _tree(structure, (self.one(f"{part}.{i}") for i in itertools.count()))


def _failures(arrays: _Arrays, header: dict[str, Any]) -> Any:
    trees = {part: arrays.tree(part, s) for part, s in header["structure"].items()}
    episodes = _record("Episode", **trees, **arrays.some(*EPISODE))
    about = {k: header[k] for k in ("seen", "dropped")}
    return _record(
        "Failures", episodes=episodes, **arrays.some("counts", "tree", "simulation"), **about
    )


def _heads(arrays: _Arrays, header: dict[str, Any]) -> Any:
    fields = {
        name: arrays.record("Moments", name, MOMENTS)
        for name in ("inputs", "returns")
        if f"{name}.0" in arrays.names
    }
    for name, head in header["heads"].items():
        params = arrays.tree(name, head["structure"])
        fields[name] = {"dict": {"network": _plain(head["network"]), "params": params}}
    return _record("Heads", levels=header["levels"], **fields)


def _policy(arrays: _Arrays, header: dict[str, Any]) -> Any:
    layers = sorted(f"Dense_{i}" for i in range(len(header["hidden"]) + 1))
    network = ["dict", ["params"], [["dict", layers, [DENSE] * len(layers)]]]
    tilt = arrays.record("StartTilt", "tilt", ["weights", "means", "deviations"])
    moments = arrays.record("Moments", "net", MOMENTS)
    learned = _record(
        "Learned",
        actor=arrays.tree("actor", network),
        critic=arrays.tree("critic", network),
        net=_record("Normalisation", inputs=moments, unit=arrays.one("net.3")),
        tilt=tilt if header["tilted"] else {"tuple": []},
        **arrays.some("alpha", "scale"),
    )
    history = arrays.record("Learning", "history", LEARNING)
    about = {k: header[k] for k in ("horizon", "dense")}
    return _record("FailurePolicy", learned=learned, history=history, **about)


def _validation(arrays: _Arrays, header: dict[str, Any]) -> Any:
    memory, history = (
        {n.removeprefix(part): arrays.one(n) for n in arrays.names if n.startswith(part)}
        for part in ("memory.", "history.")
    )
    fields = {k: header[k] for k in ("selector", "data", "complete", "finished")}
    fields |= {k: arrays.one(k) for k in ("key", "order", "predicted")}
    fields |= dict(memory={"dict": memory}, history=_record("ValidationHistory", **history))
    return _record("ValidationState", **fields)


def _record(name: str, **fields: Any) -> Any:
    return {"record": [name, fields]}


def _plain(value: Any) -> Any:
    """What JSON holds."""
    if isinstance(value, dict):
        return {"dict": {k: _plain(v) for k, v in value.items()}}
    return {"list": list(map(_plain, value))} if isinstance(value, list) else value


def _tree(structure: Any, leaves: Any) -> Any:
    if structure == "array":
        return next(leaves)
    kind, names, below = structure
    below = [_tree(child, leaves) for child in below]
    if kind == "None":
        return None
    if kind in ("tuple", "list"):
        return {kind: below}
    if kind == "dict":
        return {"dict": dict(zip(names, below, strict=True))}
    return {"class": [kind.removeprefix("the class "), names, below]}
