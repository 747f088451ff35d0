"""What a call was about, in words that can be stored and compared: the numbers of a simulator, its
functions by name and code, settings and versions.
"""

import contextlib
import dataclasses
import hashlib
import inspect
import sys
import types
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

from jast._src.runtime.host_errors import Asking
from jast._src.util.pytrees import fields_of

__all__ = ["describe_differences", "fingerprint", "versions"]

OURS = "jast.", "jax."
"""Modules whose versions say what their functions are."""
NAMED = 3  # differences that a message names: more would hide the first


def fingerprint(**parts: Any) -> dict[str, str]:
    """``parts`` as a flat dict "part.field.field" -> words, with the versions that results depend
    on.

    Arrays enter by their type, shape and a hash of their values, functions by their name and code,
    their defaults, what they close over and the floats of what they are bound to, classes by the
    code of their methods, black boxes by their system, other objects by their class alone.
    """
    found = versions() | {
        "python": "{}.{}".format(*sys.version_info),
        "jax_enable_x64": str(jax.config.jax_enable_x64),
    }
    for part, value in parts.items():
        found.update(_describe(part, value, ()))
    return found


def describe_differences(there: dict[str, str], here: dict[str, str]) -> str:
    """In words, where two fingerprints differ; "" where they do not."""
    names = [*here, *(n for n in there if n not in here)]
    unlike = [n for n in names if there.get(n) != here.get(n)]
    said = [
        f"{n} is {there.get(n, 'nothing')} there, {here.get(n, 'nothing')} here"
        for n in unlike[:NAMED]
    ]
    if len(unlike) > NAMED:
        said.append(f"and {len(unlike) - NAMED} more differences")
    return "; ".join(said)


def versions() -> dict[str, str]:
    """What must be alike wherever a part of one result is made."""
    from jast import __version__  # not at import: the package imports this module

    return {
        "jast": __version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "platform": jax.default_backend(),
    }


def _describe(name: str, value: Any, above: tuple) -> Iterator[tuple[str, str]]:
    """(name, words) of ``value`` and what is in it; ``above``: functions that it is part of."""

    def inside(pairs: Iterable[tuple[Any, Any]]) -> Iterator[tuple[str, str]]:
        for key, part in pairs:
            yield from _describe(f"{name}.{key}", part, above)

    if value is None or isinstance(value, bool | int | float | complex | str | bytes):
        yield name, repr(value)
    elif isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        yield name, f"{value.dtype} {np.asarray(jax.random.key_data(value)).tolist()}"
    elif isinstance(value, np.ndarray | np.generic | jax.Array):
        yield name, _of_array(np.asarray(value))
    elif isinstance(value, partial):  # also jax.tree_util.Partial
        yield from _describe(name, value.func, above)
        yield from inside([*enumerate(value.args), *value.keywords.items()])
    elif isinstance(value, dict):
        yield from inside(value.items())
    elif hasattr(value, "_fields"):
        yield from inside((f, getattr(value, f)) for f in value._fields)
    elif isinstance(value, tuple | list):
        yield name, f"{len(value)} parts"
        yield from inside(enumerate(value))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield name, type(value).__qualname__
        yield from inside(fields_of(value).items())
    elif isinstance(value, Asking):
        host = value.host
        yield from _of_function(name, value.function, above)
        yield from inside([("spec", host.spec)])
        yield from _describe(f"{name}.system", host.runner.system, (*above, Asking))
    elif inspect.isroutine(function := inspect.unwrap(value) if callable(value) else value):
        yield from _of_function(name, function, above)
    else:
        kind = value if isinstance(value, type) else type(value)
        words = f"{kind.__module__}.{kind.__qualname__}"
        yield name, words
        if isinstance(value, type) and not words.startswith(OURS):
            methods = {k: m for k, m in vars(kind).items() if inspect.isfunction(m)}
            yield from inside(sorted(methods.items()))


def _of_array(array: np.ndarray) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    value = f"= {array}" if array.size == 1 else f"with hash {digest[:12]}"
    return f"{array.dtype}{list(array.shape)} {value}"


def _of_function(name: str, function: Any, above: tuple) -> Iterator[tuple[str, str]]:
    bound, function = getattr(function, "__self__", None), getattr(function, "__func__", function)
    words = f"{getattr(function, '__module__', '')}.{function.__qualname__}"
    code = getattr(function, "__code__", None)
    known = code is None or function in above
    ours = words.startswith(OURS)  # their versions say what they are
    yield name, words if known or ours else f"{words} with code {_of_code(code).hexdigest()[:12]}"
    if known:
        return
    held = [*enumerate(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).items()]
    held += _floats_of(bound)
    for variable, cell in zip(code.co_freevars, function.__closure__ or ()):
        with contextlib.suppress(ValueError):  # not yet assigned
            held.append((variable, cell.cell_contents))
    for key, part in held:
        # a black box may count its runs, or keep things between them
        if Asking not in above or _is_fixed(part):
            yield from _describe(f"{name}.{key}", part, (*above, function))


def _is_fixed(held: Any) -> bool:
    """Whether this is something that a run does not change: no counter, list or object."""
    kinds = float | str | bytes | np.ndarray | np.generic | jax.Array | type | partial
    return isinstance(held, kinds) or inspect.isroutine(held)


def _floats_of(bound: Any) -> list[tuple[str, Any]]:
    """The attributes of an object that are floats or arrays: others may be counters."""
    if isinstance(bound, type | types.ModuleType) or not hasattr(bound, "__dict__"):
        return []
    kinds = float | np.ndarray | np.generic | jax.Array
    return [(k, v) for k, v in sorted(vars(bound).items()) if isinstance(v, kinds)]


def _of_code(code: types.CodeType) -> Any:
    digest = hashlib.sha256(code.co_code)
    for part in (*code.co_names, *code.co_consts):
        if isinstance(part, frozenset):  # of no fixed order
            part = sorted(map(repr, part))
        inner = isinstance(part, types.CodeType)
        digest.update(_of_code(part).digest() if inner else repr(part).encode())
    return digest
