"""Formulas of signal temporal logic: small pytrees, built with Python, that print as they read.

``predicate(lambda s: s.gap - 7.5, "gap > 7.5")`` is a formula; ``always``, ``eventually``,
``until``, ``implies`` and the operators ``&``, ``|``, ``~`` make larger ones. The syntax is that of
Maler and Nickovic (2004), Monitoring temporal properties of continuous signals; a window [a, b] is
in seconds from the moment at which the formula is asked, and both ends belong to it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import jax

from jast._src.util.checks import wrong
from jast._src.util.pytrees import as_partial

__all__ = [
    "Formula",
    "Implies",
    "Junction",
    "Not",
    "Predicate",
    "Temporal",
    "Until",
    "always",
    "checked_formula",
    "children",
    "eventually",
    "implies",
    "predicate",
    "predicates",
    "until",
]

_static = dict(metadata=dict(static=True))


class Formula:
    """What all formulas have in common.

    Example:
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> high = specs.predicate(lambda s: s - 1.0, "s > 1")
        >>> print(specs.always(low & high))
        always ((s < 5) & (s > 1))
    """

    def __and__(self, other: "Formula") -> "Formula":
        return _junction("&", self, other)

    def __or__(self, other: "Formula") -> "Formula":
        return _junction("|", self, other)

    def __invert__(self) -> "Formula":
        return Not(self)

    def __bool__(self) -> bool:
        raise ValueError(
            f"specs: {self} is a formula: combine formulas by the operators &, | and ~, not by the"
            " words and, or and not"
        )

    def __repr__(self) -> str:
        return str(self)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Predicate(Formula):
    """See `predicate`."""

    margin: Callable[[Any], Any]
    name: str = field(**_static)

    def __str__(self) -> str:
        return self.name


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Not(Formula):
    """``~of``."""

    of: Formula

    def __str__(self) -> str:
        return f"~{_in_brackets(self.of)}"


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Junction(Formula):
    """All of ``parts`` ("&"), or any of them ("|")."""

    parts: tuple[Formula, ...]
    kind: str = field(**_static)

    def __str__(self) -> str:
        return f" {self.kind} ".join(map(_in_brackets, self.parts))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Implies(Formula):
    """See `implies`."""

    left: Formula
    right: Formula

    def __str__(self) -> str:
        return f"{_in_brackets(self.left)} implies {_in_brackets(self.right)}"


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Temporal(Formula):
    """See `always` and `eventually`, which ``kind`` names."""

    of: Formula
    kind: str = field(**_static)
    a: float = field(**_static)
    b: float | None = field(**_static)

    def __str__(self) -> str:
        return f"{self.kind}{window(self)} {_in_brackets(self.of)}"


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Until(Formula):
    """See `until`."""

    left: Formula
    right: Formula
    a: float = field(**_static)
    b: float | None = field(**_static)

    def __str__(self) -> str:
        return f"{_in_brackets(self.left)} until{window(self)} {_in_brackets(self.right)}"


def predicate(fn: Callable[[Any], Any], name: str | None = None) -> Formula:
    """A formula about one moment.

    Args:
        fn: state -> margin, a float scalar: above 0 where it holds, and the farther from 0 the
            clearer; 0 is no violation. In JAX. What a `jax.tree_util.Partial` binds is traced.
        name: how it prints and is named in errors, as "gap > 7.5"; by default the function's name.

    Returns:
        `Formula`.

    Raises:
        ValueError: where ``fn`` is no function or ``name`` no text. What ``fn`` returns is looked
            at where the formula is used.

    Example:
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> print(~low)
        ~(s < 5)
    """
    if not callable(fn):
        raise ValueError(f"predicate: fn must be a function of the state, received {fn!r}")
    if name is None:
        own = getattr(getattr(fn, "func", fn), "__name__", "")
        name = own if own.isidentifier() else "predicate"
    if not isinstance(name, str) or not name:
        raise ValueError(f"predicate: name must be a text, received {name!r}")
    return Predicate(as_partial(fn), name)


def always(f: Formula, a: float = 0.0, b: float | None = None) -> Formula:
    """``f`` holds at every moment of the window.

    Args:
        f: `Formula`.
        a, b: the window in seconds, 0 <= a <= b; without ``b`` it goes on to the trace's end.

    Returns:
        `Formula`. Its robustness is the least of ``f`` in the window.

    Raises:
        ValueError: for what is no formula, and for a window that is negative or reversed.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> print(float(specs.robustness(specs.always(low), jnp.array([1.0, 4.0, 2.0]), 1.0)))
        1.0
    """
    return _temporal("always", f, a, b)


def eventually(f: Formula, a: float = 0.0, b: float | None = None) -> Formula:
    """``f`` holds at some moment of the window.

    Args:
        f: `Formula`.
        a, b: the window in seconds, 0 <= a <= b; without ``b`` it goes on to the trace's end.

    Returns:
        `Formula`. Its robustness is the greatest of ``f`` in the window.

    Raises:
        ValueError: for what is no formula, and for a window that is negative or reversed.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> late = specs.eventually(low, 1.0, 2.0)  # from 1 to 2 seconds on
        >>> print(float(specs.robustness(late, jnp.array([1.0, 4.0, 2.0]), 1.0)))
        3.0
    """
    return _temporal("eventually", f, a, b)


def until(f: Formula, g: Formula, a: float = 0.0, b: float | None = None) -> Formula:
    """``g`` holds at some moment of the window, and ``f`` at every moment from now up to then, that
    one included.

    Args:
        f, g: `Formula`.
        a, b: the window in seconds, 0 <= a <= b; without ``b`` it goes on to the trace's end.

    Returns:
        `Formula`. Its robustness at t is the greatest over t' in [t + a, t + b] of the least of
        g(t') and of f over [t, t'] (Donze and Maler 2010, Robust satisfaction of temporal logic
        over real-valued signals).

    Raises:
        ValueError: for what is no formula, and for a window that is negative or reversed.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> over = specs.predicate(lambda s: s - 3.0, "s > 3")
        >>> rule = specs.until(low, over)
        >>> print(float(specs.robustness(rule, jnp.array([1.0, 4.0, 2.0]), 1.0)))
        1.0
    """
    f, g = checked_formula("until", "f", f), checked_formula("until", "g", g)
    return Until(f, g, *_checked_window("until", g, a, b))


def implies(f: Formula, g: Formula) -> Formula:
    """Where ``f`` holds, ``g`` does: the same as ``~f | g``.

    Args:
        f, g: `Formula`.

    Returns:
        `Formula`. Its robustness is the greater of that of ``g`` and minus that of ``f``.

    Raises:
        ValueError: for what is no formula.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import specs
        >>> fast = specs.predicate(lambda s: s - 3.0, "s > 3")
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> rule = specs.always(specs.implies(fast, low))
        >>> print(float(specs.robustness(rule, jnp.array([1.0, 4.0, 2.0]), 1.0)))
        1.0
    """
    return Implies(checked_formula("implies", "f", f), checked_formula("implies", "g", g))


def children(f: Formula) -> tuple[Formula, ...]:
    """The formulas that ``f`` is made of."""
    if isinstance(f, Predicate):
        return ()
    if isinstance(f, Junction):
        return f.parts
    return (f.of,) if isinstance(f, Not | Temporal) else (f.left, f.right)


def predicates(f: Formula) -> Iterator[Predicate]:
    """The predicates of ``f`` as they read, from left to right."""
    if isinstance(f, Predicate):
        yield f
    for child in children(f):
        yield from predicates(child)


def window(f: Temporal | Until) -> str:
    """The window of ``f`` as it prints: "[0, 30]"; "" for the whole trace."""
    if f.b is None:
        return f"[{f.a:g}, end]" if f.a else ""
    return f"[{f.a:g}, {f.b:g}]"


def _temporal(kind: str, f: Formula, a: Any, b: Any) -> Formula:
    return Temporal(checked_formula(kind, "f", f), kind, *_checked_window(kind, f, a, b))


def _junction(kind: str, *parts: Formula) -> Formula:
    for part in parts:
        checked_formula(kind, "each side", part)
    flat = [p.parts if isinstance(p, Junction) and p.kind == kind else (p,) for p in parts]
    return Junction(sum(flat, ()), kind)


def _in_brackets(f: Formula) -> str:
    text = str(f)
    alone = isinstance(f, Not) or (isinstance(f, Predicate) and text.isidentifier())
    return text if alone else f"({text})"


def checked_formula(function: str, name: str, f: Any) -> Formula:
    """``f``. ValueError unless it is a formula."""
    if not isinstance(f, Formula):
        must = "be a formula, as jast.specs.predicate(function) makes it"
        raise wrong(function, name, must, f"{f!r}")
    return f


def _checked_window(function: str, f: Formula, a: Any, b: Any) -> tuple[float, float | None]:
    ends = [a] if b is None else [a, b]
    numbers = all(isinstance(v, Real) and not isinstance(v, bool) for v in ends)
    if not (numbers and all(map(math.isfinite, ends)) and 0 <= a <= ends[-1]):
        must = "be two numbers of seconds, 0 <= a <= b (b may be left out: to the trace's end)"
        raise wrong(f"{function} {_in_brackets(f)}", "the window", must, f"a={a!r}, b={b!r}")
    return float(a), None if b is None else float(b)
