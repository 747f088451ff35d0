"""What all results of the package have in common: one vocabulary, how they print, and how a former
name of a field goes on working.

Every result of a search, an estimate, a method or a validation has the names of `VOCABULARY`; one
that means nothing there is None.
"""

import html
import warnings
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from textwrap import shorten
from typing import Any, TypeVar

import jax
import numpy as np
from jax.tree_util import Partial

from jast._src.runtime._jax import is_traced
from jast._src.util.pytrees import fields_of

__all__ = ["Former", "call_settings", "html_table", "renamed", "result_class", "printable"]

VOCABULARY = {
    "episodes": "runs of the system, each counted once",
    "steps": "calls of the simulator's step",
    "failures": "the failures themselves: an archive, a batch, or their numbers in a data set",
    "failing": "how many of the episodes failed",
    "invalid": "how many episodes gave a number that is not finite; they count as not failing",
    "incidents": "what went wrong on the host of a black box, or ended the work early",
    "history": "how it went",
    "settings": "what was asked for, as JSON can hold it",
}
LINES = 10  # of a repr at most
COLUMNS = 100  # likewise

C = TypeVar("C", bound=type)


def printable(scalar: str | None = None, batches: bool = False) -> Callable[[C], C]:
    """A class decorator: objects print, and a repr is short whatever they hold.

    Where the class has a ``__str__`` of its own, the repr is its first lines; else it names the
    fields. ``_repr_html_``, for notebooks, is the class's own, else a table of the fields. Objects
    that went through a transformation of JAX (traced, batched by `jax.vmap`, or with other leaves)
    print their fields and the shape of the batch.

    Args:
        scalar: the name of a field that is one number in a single object, which tells a batch; with
            None the class's own ``__str__`` is not guarded.
        batches: the class's own ``__str__`` knows what to say of a batch.
    """

    def decorate(cls: C) -> C:
        own, own_html = (cls.__dict__.get(name) for name in ("__str__", "_repr_html_"))

        def text(self: Any) -> str:
            if own is None:
                return _by_fields(self)
            tells = None if scalar is None else getattr(self, scalar, None)
            concrete = _number(tells) and not is_traced(tells)
            if scalar is None or (concrete and (batches or np.ndim(tells) == 0)):
                return own(self)
            return _by_fields(self, _of_many(tells))

        def short(self: Any) -> str:
            try:
                lines = text(self).splitlines()
            except Exception:  # JAX's messages show pytrees with any leaves: no second error there
                lines = _by_fields(self).splitlines()
            more = len(lines) - LINES
            if more > 0:
                hidden = f"... and {more + 1} more lines: print it to see them"
                lines = [*lines[: LINES - 1], hidden]
            return "\n".join(lines)

        def page(self: Any) -> str:
            try:
                return own_html(self)
            except Exception:  # as in a repr
                return _html(self)

        cls.__str__, cls.__repr__, cls._repr_html_ = text, short, page if own_html else _html
        return cls

    return decorate


def result_class(scalar: str, batches: bool = False) -> Callable[[C], C]:
    """A class decorator of results: `printable`, and a name of `VOCABULARY` that the class lacks is
    None.
    """

    def decorate(cls: C) -> C:
        for name, meaning in VOCABULARY.items():
            if not hasattr(cls, name):
                missing = property(lambda self: None, doc=f"None here; elsewhere {meaning}.")
                setattr(cls, name, missing)
        return printable(scalar, batches)(cls)

    return decorate


def call_settings(method: str, key: jax.Array, **given: Any) -> dict[str, Any]:
    """The ``settings`` of a result, as JSON can hold them.

    Args:
        method: the call's name.
        key: the one that it was given.
        **given: numbers and texts that it was asked for.

    Returns:
        ``method``, these, and ``seed``, the words of the key.
    """

    def plain(value: Any) -> Any:
        return value if isinstance(value, str | int) else np.asarray(value).tolist()

    seed = plain(jax.random.key_data(key))
    return dict(method=method, **jax.tree.map(plain, given), seed=seed)


class Former(property):
    """A decorator as `property`, for a name of an earlier version, which tables leave out."""


def renamed(result: Any, old: str, new: str) -> Any:
    """The field ``new`` of ``result``, which was ``old`` in an earlier version: each use warns
    (DeprecationWarning). The old name goes with the next version.
    """
    text = f"{type(result).__name__}.{old} is {new} now; the old name goes with the next version"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    return getattr(result, new)


def batch_shape(value: Any) -> tuple[int, ...] | None:
    """The leading axes of what is one number in a single object; None where it has no shape."""
    return tuple(np.shape(value)) if _number(value) or hasattr(value, "shape") else None


def _of_many(value: Any) -> str:
    shape = batch_shape(value)
    words = ["traced" if is_traced(value) else "", f"a batch of shape {shape}" if shape else ""]
    return ", ".join(filter(None, words))


def _number(value: Any) -> bool:
    return isinstance(value, int | float | np.ndarray | np.generic | jax.Array)


def _by_fields(value: Any, note: str = "") -> str:
    """ "Name(field=..., ...)", wrapped, each field in few words."""
    name = type(value).__name__
    parts = [f"{field}={_words(v)}" for field, v in fields_of(value).items()]
    lines = [f"{name} ({note}): " if note else f"{name}("]
    for i, part in enumerate(parts):
        part += "" if i == len(parts) - 1 else ", "
        if len(lines[-1]) + len(part) > COLUMNS:
            lines.append("    ")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines) + ("" if note else ")")


def _words(value: Any) -> str:
    """A value in few words."""
    if value is None or isinstance(value, bool | int):
        return repr(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str):
        return repr(shorten(value, 60, placeholder=" ...")) if len(value) > 60 else repr(value)
    if hasattr(value, "dtype") and is_traced(value):
        return f"traced {value.dtype}{list(value.shape)}"
    if _number(value):
        if jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended):
            return f"{value.dtype}{list(value.shape)}"
        if value.ndim == 0:
            return f"{value.item():.6g}" if value.dtype.kind == "f" else str(value.item())
        return f"{value.dtype.name}{list(value.shape)}"
    if isinstance(value, Partial):
        bound = "(...)" if value.args or value.keywords else ""
        return f"{getattr(value.func, '__name__', type(value.func).__name__)}{bound}"
    if _is_record(value):
        return f"{type(value).__name__}(...)"
    if isinstance(value, tuple | list | dict):
        return _container(value)
    if callable(value) and hasattr(value, "__name__"):
        return value.__name__
    return type(value).__name__


def _container(value: tuple | list | dict) -> str:
    if isinstance(value, dict):
        begin, end = "{}"
        words = [f"{k!r}: {_words(v)}" for k, v in list(value.items())[:3]]
    else:
        begin, end = "[]" if isinstance(value, list) else "()"
        words = [_words(v) for v in value[:3]]
    text = begin + ", ".join(words) + ", ..." * (len(value) > 3)
    text += "," * (len(value) == 1 and isinstance(value, tuple))
    return f"{type(value).__name__} of {len(value)}" if len(text) > 70 else text + end


def _is_record(value: Any) -> bool:
    named_tuple = isinstance(value, tuple) and hasattr(value, "_fields")
    return named_tuple or (is_dataclass(value) and not isinstance(value, type))


def _html(self: Any) -> str:
    """A table of the fields; the names of `VOCABULARY` that are no fields of it come after them."""
    rows = fields_of(self)
    for name in VOCABULARY:
        if name in rows or isinstance(getattr(type(self), name, None), Former):
            continue
        if (value := getattr(self, name, None)) is not None:
            rows[name] = value
    return html_table(type(self).__name__, {k: _words(v) for k, v in rows.items()})


def html_table(title: str, rows: Mapping[str, str]) -> str:
    """An HTML table of two columns, without styles of its own."""
    body = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>"
        for name, text in rows.items()
    )
    return f"<table><caption>{html.escape(title)}</caption><tbody>{body}</tbody></table>"
