"""Names that a package's door hands out without importing what is behind them before it is asked.

``__getattr__ = door(__name__, ...)`` at the end of a package's ``__init__``: a module-level
``__getattr__`` (PEP 562) that is called only for names which the package does not have yet.
"""

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

__all__ = ["door", "dir_function"]


def door(
    package: str, lazy: Mapping[str, str] = {}, former: Mapping[str, str] = {}
) -> Callable[[str], Any]:
    """The ``__getattr__`` of ``package``.

    Args:
        package: the package's ``__name__``.
        lazy: name -> where it is, as "module" or "module:attribute"; looked up once, at first use.
        former: a name of an earlier version -> what became of it, as "is now jast.plot.roc".

    Returns:
        A function of a name: the thing of that name.

    Raises:
        AttributeError: from the function, for any other name.
    """

    def getattribute(name: str) -> Any:
        if name in lazy:
            value = _found(lazy[name])
            setattr(sys.modules[package], name, value)
            return value
        became = f": it {former[name]}" if name in former else ""
        raise AttributeError(f"module {package!r} has no attribute {name!r}{became}")

    return getattribute


def dir_function(names: Iterable[str]) -> Callable[[], list[str]]:
    """The ``__dir__`` of a module that shows its public ``names`` only, for tab completion."""
    shown = sorted(names)
    return lambda: shown


def _found(place: str) -> Any:
    module, _, attribute = place.partition(":")
    found = importlib.import_module(module)
    return getattr(found, attribute) if attribute else found
