"""Robustness: by how much a trace satisfies a formula, below 0 where it violates it.

Discrete time: a trace is states at 0, dt, .., (T - 1) dt, and a window is the samples in it. The
least and the greatest over them are the quantitative semantics of Fainekos and Pappas (2009) and
Donze and Maler (2010).

At the trace's end windows are clipped: a window that begins within the trace and ends beyond it
has the samples that there are. A window that alone is longer than the trace, or begins after its
end where it is asked for, or has no sample because it is narrower than dt, is an error.
"""

import math
from collections.abc import Iterable
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.contract import first_line
from jast._src.runtime._jax import is_traced
from jast._src.specs import sliding_windows
from jast._src.specs.formulas import (
    Formula,
    Implies,
    Junction,
    Not,
    Predicate,
    Temporal,
    Until,
    checked_formula,
    children,
    predicates,
)
from jast._src.util.checks import number, real_number, wrong

__all__ = ["Values", "fits", "margins", "reach", "robustness", "samples_in", "spacing", "values"]

SLACK = 1e-6
"""By so much of dt, and of itself, a window's end may miss a sample that it is meant to have: dt
may come from float32.
"""


class Values(NamedTuple):
    """The robustness of a formula at every moment, and that of its parts."""

    own: jax.Array
    """[T]"""
    parts: tuple["Values", ...]


def robustness(
    formula: Formula, trace: Any, dt: float, *, temperature: Any = None, goes_on: bool = False
) -> jax.Array:
    """By how much a trace satisfies a formula; below 0, it violates it.

    Differentiable: the gradient is that of the samples that decide, one of the subgradients. Pure
    JAX, for `jax.jit` and `jax.vmap` over traces. O(T log T) for T samples.

    Args:
        formula: `Formula`.
        trace: states, a pytree of arrays [T, ...]: the samples at 0, dt, .., (T - 1) dt seconds.
        dt: seconds between samples, above 0; static.
        temperature: None: exact. Else, in the unit of the margins and above 0: each least and
            greatest of n numbers is smoothed by a logarithm of a sum of exponentials, which is off
            by at most temperature log n, so that the gradient knows all samples that nearly decide.
            Traced.
        goes_on: the trace is the beginning of a longer one: the answer is the greatest robustness
            that it can come to (Deshmukh et al. 2017, Robust online monitoring of signal temporal
            logic): below 0 the violation is certain, infinite where all is open yet.

    Returns:
        Float scalar, of the margins' dtype.

    Raises:
        ValueError: naming the sub-formula, for a window that holds no sample, is longer than the
            trace or begins after its end; for a predicate that raises, or does not return a float
            scalar, or a NaN that matters (not looked at while traced: NaN); for leaves of ``trace``
            of different lengths, another dt or temperature.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import specs
        >>> rule = specs.always(specs.predicate(lambda s: 5.0 - s, "s < 5"))
        >>> trace = jnp.array([1.0, 4.0, 2.0])
        >>> slope = jax.grad(lambda trace: specs.robustness(rule, trace, 1.0))(trace)
        >>> slope.tolist()  # the sample that decides
        [-0.0, -1.0, -0.0]
    """
    checked_formula("robustness", "formula", formula)
    dt, length = spacing("robustness", dt), _length(trace)
    if temperature is not None:
        temperature = real_number(
            "robustness", "temperature", temperature, lambda v: v > 0, "above 0"
        )
    if not goes_on:
        fits("robustness", formula, length, dt)
    found = _robustness(formula, trace, temperature, dt, goes_on)
    if not is_traced(found) and np.isnan(found):
        _refuse_nan(formula, trace, dt)
    return found


@partial(jax.jit, static_argnums=(3, 4))
def _robustness(formula: Formula, trace: Any, temperature: Any, dt: float, goes_on: bool) -> Any:
    given = margins("robustness", formula, trace)
    if temperature is None:
        pair = sliding_windows.exact
    else:
        pair = sliding_windows.soft(temperature.astype(given[0].dtype))
    return values(formula, given, dt, goes_on, pair).own[0]


def values(
    formula: Formula,
    given: Iterable[jax.Array],
    dt: float,
    unknown: Any = False,
    pair: sliding_windows.Pair = sliding_windows.exact,
    sign: int = 1,
) -> Values:
    """The `Values` of ``formula`` and its parts, from the margins [T] of its predicates.

    Args:
        formula: `Formula`.
        given: as `margins` returns them; of an iterator over more it takes the first.
        dt: seconds between samples.
        unknown: bool scalar: the trace goes on beyond its last sample, where everything may happen
            that makes ``sign`` times the formula great. Else windows are clipped.
        pair: how the least and the greatest are taken.
        sign: 1, or -1 below an odd number of negations.
    """
    left = iter(given)

    def of(f: Formula, sign: int) -> Values:
        if isinstance(f, Predicate):
            return Values(next(left), ())
        flipped = isinstance(f, Not | Implies)  # the first of its parts
        signs = [-sign if flipped and i == 0 else sign for i in range(len(children(f)))]
        parts = tuple(of(child, s) for child, s in zip(children(f), signs, strict=True))
        x = [part.own for part in parts]
        if isinstance(f, Not):
            return Values(-x[0], parts)
        if isinstance(f, Implies):
            return Values(pair.most(-x[0], x[1]), parts)
        if isinstance(f, Junction):
            op = pair.least if f.kind == "&" else pair.most
            return Values(reduce(op, x), parts)
        inf = jnp.asarray(jnp.inf, x[0].dtype)
        least = jnp.where(unknown, sign * inf, inf)  # of what is beyond the end, for the least
        most = jnp.where(unknown, sign * inf, -inf)
        first, last = samples_in("specs", f, dt)
        last = len(x[0]) if last is None else last
        if isinstance(f, Until):
            return Values(sliding_windows.until(pair, *x, first, last, (least, most)), parts)
        op, beyond = (pair.least, least) if f.kind == "always" else (pair.most, most)
        return Values(sliding_windows.over(op, x[0], first, last, beyond, pair.overlap), parts)

    return of(formula, sign)


def margins(function: str, formula: Formula, trace: Any) -> tuple[jax.Array, ...]:
    """The margins [T] of the predicates of ``formula``, from left to right, of one dtype.

    Raises:
        ValueError: naming ``function`` and the predicate that raises or returns no float scalar.
    """
    found = [_margin(function, p, trace) for p in predicates(formula)]
    dtype = jnp.result_type(*(m.dtype for m in found))
    return tuple(m.astype(dtype) for m in found)


def fits(function: str, formula: Formula, length: int, dt: float) -> None:
    """ValueError, naming ``function`` and the sub-formula, where a window is longer than a trace of
    ``length`` samples, or begins after its end at a moment at which it is asked for.
    """
    end = length - 1

    def look(f: Formula, latest: int) -> None:
        """``latest``: the last sample at which ``f`` is asked for."""
        if isinstance(f, Temporal | Until):
            first, last = samples_in(function, f, dt)
            if max(first, 0 if last is None else last) > end:
                raise ValueError(
                    f"{function}: {f}: the window is longer than the trace, which ends at"
                    f" {end * dt:g} s ({length} samples, dt = {dt:g})"
                )
            if latest + first > end:
                raise ValueError(
                    f"{function}: {f}: the formula around it asks for it up to {latest * dt:g} s,"
                    f" where its window begins after the trace's end, {end * dt:g} s; let the"
                    f" outer window end at {(end - first) * dt:g} s or before"
                )
            latest = end if last is None else min(latest + last, end)
        for child in children(f):
            look(child, latest)

    look(formula, 0)


def reach(formula: Formula, dt: float) -> int | float:
    """How many samples after the present one the formula's value depends on; inf for a window
    without end.
    """
    ahead = max((reach(child, dt) for child in children(formula)), default=0)
    if not isinstance(formula, Temporal | Until):
        return ahead
    last = samples_in("specs", formula, dt)[1]
    return math.inf if last is None else ahead + last


def samples_in(function: str, f: Temporal | Until, dt: float) -> tuple[int, int | None]:
    """The first and the last sample of the window of ``f``, counted from the present one; None: to
    the trace's end. ValueError where there is none.
    """
    first = math.ceil(f.a / dt - SLACK * max(1, f.a / dt))
    if f.b is None:
        return first, None
    last = math.floor(f.b / dt + SLACK * max(1, f.b / dt))
    if last < first:
        raise ValueError(f"{function}: {f}: the window holds no sample at dt = {dt:g}")
    return first, last


def spacing(function: str, dt: Any) -> float:
    """``dt`` as a Python float."""
    return number(function, "dt", dt, lambda v: 0 < v < math.inf, "of seconds above 0")


def _length(trace: Any) -> int:
    lengths = {jnp.shape(a)[0] if jnp.ndim(a) else -1 for a in jax.tree.leaves(trace)}
    if len(lengths) != 1 or min(lengths) < 1:
        must = "be arrays [T, ...] with one T of at least 1"
        raise wrong("robustness", "trace", must, jax.tree.map(jnp.shape, trace))
    return lengths.pop()


def _margin(function: str, p: Predicate, trace: Any) -> jax.Array:
    one = jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a)[1:], jnp.result_type(a)), trace)
    found = []
    try:
        jax.eval_shape(lambda state: found.append(p.margin(state)), one)
    except Exception as e:
        raised = f"{type(e).__name__}: {first_line(e)}"
        raise ValueError(f"{function}: {p}: the predicate raised {raised}") from e
    (value,) = found
    array = isinstance(value, jax.Array | np.ndarray | np.generic | int | float)
    dtype = jnp.result_type(value) if array else None
    if not array or jnp.shape(value) != () or not jnp.issubdtype(dtype, jnp.floating):
        received = f"{dtype}{list(jnp.shape(value))}" if array else repr(value)
        hint = "; write a > b as a - b" if dtype == jnp.bool_ else ""
        raise ValueError(
            f"{function}: {p}: the predicate must return a float scalar, above 0 where it"
            f" holds{hint}, received {received}"
        )
    return jax.vmap(p.margin)(jax.tree.map(jnp.asarray, trace))


def _refuse_nan(formula: Formula, trace: Any, dt: float) -> None:
    given = jax.device_get(margins("robustness", formula, trace))
    for p, m in zip(predicates(formula), given, strict=True):
        if np.isnan(m).any():
            when = float(np.flatnonzero(np.isnan(m))[0] * dt)
            raise ValueError(
                f"robustness: {p}: the predicate must return a number, received NaN at {when:g} s"
            )
    raise ValueError(
        f"robustness: {formula}: predicates must return finite numbers, received infinite ones of"
        " both signs, which give NaN"
    )
