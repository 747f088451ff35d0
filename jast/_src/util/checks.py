"""Checks of settings, each with a ValueError that names the function and the setting, what was
expected and what came.
"""

import importlib
import operator
import os
from collections.abc import Collection
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.runtime._jax import is_traced

__all__ = [
    "check_numbers",
    "check_path",
    "check_random_key",
    "import_library",
    "instance",
    "number",
    "one_of",
    "real_number",
    "truth_value",
    "whole_number",
    "wrong",
]


Kind = TypeVar("Kind")


def wrong(function: str, name: str, must: str, received: object) -> ValueError:
    """The error of a ``function`` whose setting ``name`` must be, hold or do something else."""
    return ValueError(f"{function}: {name} must {must}, received {received}")


def one_of(function: str, name: str, value: Any, allowed: Collection[Any]) -> None:
    """ValueError unless ``value`` is one of those ``allowed``."""
    if value not in list(allowed):
        raise wrong(function, name, f"be one of {list(allowed)}", f"{value!r}")


def truth_value(function: str, **named: Any) -> None:
    """ValueError unless each is True or False."""
    for name, value in named.items():
        if not isinstance(value, bool):
            raise wrong(function, name, "be True or False", f"{value!r}")


def instance(function: str, name: str, value: Any, kind: type[Kind], words: str) -> Kind:
    """``value``, or a ValueError where it is no ``kind``; ``words`` say what it must be."""
    if not isinstance(value, kind):
        raise wrong(function, name, f"be {words}", type(value).__name__)
    return value


def import_library(function: str, module: str, extra: str) -> Any:
    """The ``module`` of an ``extra`` of pyproject.toml; ImportError where that is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise ImportError(f"{function} needs {name}: pip install 'jast[{extra}]'") from error


def check_random_key(function: str, key: Any) -> None:
    """ValueError unless ``key`` is one key of `jax.random`."""
    dtype, shape = getattr(key, "dtype", None), getattr(key, "shape", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    raw = dtype == np.uint32 and len(shape) == 1  # of jax.random.PRNGKey
    if not (typed or raw):
        received = f"{type(key).__name__} {key!r}" if dtype is None else f"{dtype}{list(shape)}"
        hint = f": jax.random.key({key})" if type(key) is int else ""
        raise wrong(function, "key", f"be a jax.random.key{hint}", received[:80])


def check_numbers(function: str, **named: Any) -> None:
    """ValueError unless these are numbers, arrays of them or traced, and none is NaN."""
    for name, value in named.items():
        if not is_traced(value):
            array = np.asarray(value)
            real = any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.integer, jnp.floating))
            if not real or np.isnan(array).any():
                raise ValueError(f"{function}: {name} must be a number, received {value!r}")


def check_path(function: str, path: Any) -> None:
    """ValueError unless ``path`` is a place of a file."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"{function}: path must be that of a file, received {path!r:.80}")


def whole_number(function, name, value, least=1, bits=None):
    """``value`` as an int of at least ``least``, and below 2^bits where ``bits`` are given."""
    try:
        number = least - 1 if isinstance(value, bool) else operator.index(value)
    except (TypeError, jax.errors.JAXTypeError):
        number = least - 1
    if number < least or (bits is not None and number >= 2**bits):
        allowed = f"of at least {least}" if bits is None else f"from {least} to 2^{bits} - 1"
        raise ValueError(f"{function}: {name} must be a whole number {allowed}, received {value!r}")
    return number


def number(function, name, value, holds, expected):
    """``value`` as a Python float, the same whatever the precision that JAX is set to, of a number
    for which ``holds``.
    """
    _check_number(function, name, value, holds, expected)
    return float(value)


def real_number(function, name, value, holds, expected):
    """``value`` as a float array []; one that is not traced must be a number for which
    ``holds``.
    """
    if not is_traced(value):
        _check_number(function, name, value, holds, expected)
    value = jnp.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.zeros(()).dtype)


def _check_number(function, name, value, holds, expected):
    try:
        one = not isinstance(value, str | bool) and np.shape(value) == ()
        good = one and bool(holds(float(value)))
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(f"{function}: {name} must be a number {expected}, received {value!r}")
