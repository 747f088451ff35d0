"""The table of families: what is known of each class of distribution, one row a class.

A row is found by the class of a distribution or the nearest of its bases that has one, and a class
that defines a method ``quantile``, ``cdf``, ``mode``, ``from_normal``, ... has a row made
of these. So a user's family is a class with methods, or a class and one `register`.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

__all__ = ["register", "register_both", "row"]


class Row(NamedTuple):
    """What one family knows of itself: functions whose first argument is the distribution."""

    quantile: Callable[..., Any] | None = None
    """(d, u): the value at the quantile u."""
    cdf: Callable[..., Any] | None = None
    """(d, x): the u whose quantile is x; of a whole number the middle of its interval."""
    from_normal: Callable[..., Any] | None = None
    """(d, z): the value that has the probability Phi(z) below it, exact in both tails."""
    to_normal: Callable[..., Any] | None = None
    """(d, x): the z of x."""
    log_tails: Callable[..., Any] | None = None
    """(d, x): (log P(X <= x), log P(X > x)), each to the precision of its own size."""
    mode: Callable[..., Any] | None = None
    """(d): the likeliest value."""
    log_mode: Callable[..., Any] | None = None
    """(d): the log density of the mode."""
    log_prob_from_mode: Callable[..., Any] | None = None
    """(d, x): the log density of x less that of the mode."""
    tilt: Callable[..., Any] | None = None
    """(d, mean, deviation): the distribution of the value at z ~ N(mean, deviation^2)."""
    exact: Callable[..., bool] | None = None
    """(d): whether ``from_normal`` is exact in both tails; None: where there is one, it is."""


_ROWS: dict[Any, Row] = {}
_NOTHING = Row()


def register(family: Any, **functions: Any) -> Any:
    """Tell jast what a family of distributions knows of itself.

    What was registered before under the names given is replaced, the rest is kept.

    Args:
        family: a class; or "package:Class", for a class that need not be imported yet (of any
            module of that package).
        functions: by the names of `Row`: each a function whose first argument is the distribution,
            vectorised like its ``log_prob``. With ``quantile`` and ``cdf`` a search can place its
            samples and a proposal can move them. With ``from_normal`` and ``to_normal`` both are
            also exact where Phi(z) rounds to 0 or 1.

    Returns:
        ``family``.

    Raises:
        ValueError: for a name that no row has, and a value that is not a function.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> class Shifted(D.Normal):
        ...     pass
        >>> Shifted = D.register(Shifted, from_normal=lambda d, z: d.loc + d.scale * z)
        >>> float(D.from_normal(Shifted(1.0, 2.0), jnp.array(0.5)))
        2.0
    """
    for name, function in functions.items():
        if name not in Row._fields:
            names = ", ".join(Row._fields)
            raise ValueError(f"register: {name!r} is no function of a row: expected one of {names}")
        if function is not None and not callable(function):
            raise ValueError(f"register: {name}: expected a function, received {function!r}")
    if not isinstance(family, (type, str)) or (isinstance(family, str) and ":" not in family):
        raise ValueError(f'register: expected a class or "package:Class", received {family!r}')
    _ROWS[family] = _ROWS.get(family, Row())._replace(**functions)
    _found.cache_clear()
    return family


def register_both(kind: type, **functions: Callable[..., Any]) -> None:
    """One row for jast's class ``kind`` and for distrax's of the same name."""
    register(kind, **functions)
    register(f"distrax:{kind.__name__}", **functions)


def row(d: Any, *names: str) -> Row:
    """The row of the class of ``d``, or of the nearest of its bases, that knows one of ``names``;
    an empty one where none does.
    """
    found = _found(type(d), names)
    if found is _NOTHING:  # what an object has, and its class does not define as a method
        return Row(**{n: _method(n) for n in _METHODS if callable(getattr(d, n, None))})
    return found


@lru_cache(maxsize=1024)
def _found(kind: type, names: tuple[str, ...]) -> Row:
    for base in kind.__mro__:
        known = _of(base)
        if any(getattr(known, name) is not None for name in names):
            return known
    return _NOTHING


def _of(base: type) -> Row:
    """The row registered for the class, else one of the methods that it defines itself."""
    known = _ROWS.get(base) or _ROWS.get(f"{base.__module__.partition('.')[0]}:{base.__name__}")
    methods = {
        name: _method(name)
        for name in _METHODS
        if callable(vars(base).get(name)) and getattr(known, name, None) is None
    }
    if known is None:
        return Row(**methods)
    # distrax's method cdf need not invert what the row has as the quantile; the others add to it
    return known._replace(**{k: f for k, f in methods.items() if "mode" in k})


_METHODS = ("quantile", "cdf", "from_normal", "to_normal", "mode", "log_prob_from_mode")


def _method(name: str) -> Callable[..., Any]:
    return lambda d, *rest: getattr(d, name)(*rest)
