"""An online monitor: the greatest robustness that a trace can still come to, block by block.

A formula is made of windows that are asked at 0 s. Of each, the monitor keeps one number for the
moments at which what is inside is known for good, and the last samples of the predicates inside, as
many as what is inside looks ahead: after Deshmukh et al. 2017, Robust online monitoring of signal
temporal logic. So the memory has a fixed size, and `always` of a predicate keeps a single number.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.specs.formulas import (
    Formula,
    Implies,
    Junction,
    Not,
    Predicate,
    Temporal,
    Until,
    children,
    predicates,
)
from jast._src.specs.robustness import reach, samples_in, values

__all__ = ["Memory", "begin", "push"]


class Memory(NamedTuple):
    """What is kept of one window, or of a predicate outside of all windows."""

    best: jax.Array
    """Of the moments whose value is known."""
    held: jax.Array
    """The least of what must hold up to the last of these moments; inf but for ``until``."""
    recent: tuple[jax.Array, ...]
    """The last samples of each predicate inside: a tuple of [r]."""


def begin(formula: Formula, dt: float, total: int, dtype: Any) -> tuple[Memory, ...]:
    """The memories before the first sample of a trace of ``total``, from left to right."""
    inf = jnp.asarray(jnp.inf, dtype)
    memories = []
    for f in _windows(formula):
        recent = tuple(jnp.zeros(_ahead(f, dt, total), dtype) for _ in predicates(f))
        memories.append(Memory(-inf, inf, recent))
    return tuple(memories)


def push(
    formula: Formula,
    memories: tuple[Memory, ...],
    given: tuple[jax.Array, ...],
    start: Any,
    unknown: Any,
    dt: float,
    total: int,
) -> tuple[tuple[Memory, ...], jax.Array]:
    """The memories after k more samples, and the bound.

    Args:
        formula: `Formula`.
        memories: those before.
        given: the margins [k] of its predicates, from left to right.
        start: int32: how many samples there were before.
        unknown: bool: more samples follow; else this was the trace's end.
        dt: seconds between samples.
        total: samples of a whole trace.

    Returns:
        (memories, the greatest robustness at 0 s of all traces that begin so).
    """
    left, before, after = iter(given), iter(memories), []

    def window(f: Formula, sign: int) -> jax.Array:
        """The bound of one window, whose next memory is put down. ``always`` is minus the
        ``eventually`` of minus what it is of.
        """
        memory, news = next(before), [next(left) for _ in predicates(f)]
        known, ahead = len(news[0]), _ahead(f, dt, total)
        block = tuple(map(lambda *a: jnp.concatenate(a), memory.recent, news))
        first, last = (0, 0) if isinstance(f, Predicate) else samples_in("specs", f, dt)
        last = total - 1 if last is None else min(last, total - 1)
        at = start - ahead + jnp.arange(ahead + known, dtype=jnp.int32)
        now = start + known - 1

        parts, inside = _parts(f), iter(block)
        of = [values(p, inside, dt, unknown, sign=sign).own for p in parts]
        turn = -1 if isinstance(f, Temporal) and f.kind == "always" else 1
        inf = jnp.asarray(jnp.inf, of[0].dtype)
        right = turn * of[-1]
        held = jnp.where(at >= 0, of[0], inf) if len(parts) == 2 else jnp.full_like(right, jnp.inf)
        held = jnp.minimum(lax.cummin(held), memory.held)
        reached = jnp.minimum(right, held)
        reached = jnp.where((at >= first) & (at <= last), reached, -inf)
        best = jnp.maximum(memory.best, jnp.max(reached[:known]))
        most = jnp.maximum(best, jnp.max(reached[known:], initial=-jnp.inf))
        # moments to come: anything, that is as good for ``sign`` as can be
        if sign * turn > 0:
            most = jnp.where(unknown & (now < last), jnp.maximum(most, held[-1]), most)
        after.append(Memory(best, held[known - 1], tuple(a[known:] for a in block)))
        return turn * most

    def bound(f: Formula, sign: int) -> jax.Array:
        """The greatest that ``sign`` times the robustness of ``f`` can be, times ``sign``."""
        if isinstance(f, Not):
            return -bound(f.of, -sign)
        if isinstance(f, Implies):
            return jnp.maximum(-bound(f.left, -sign), bound(f.right, sign))
        if isinstance(f, Junction):
            op = jnp.minimum if f.kind == "&" else jnp.maximum
            return functools.reduce(op, [bound(part, sign) for part in f.parts])
        return window(f, sign)

    found = bound(formula, 1)
    return tuple(after), found


def _windows(f: Formula) -> list[Formula]:
    """The outermost windows of ``f``, and the predicates outside of all, from left to right."""
    if isinstance(f, Predicate | Temporal | Until):
        return [f]
    return [w for child in children(f) for w in _windows(child)]


def _parts(f: Formula) -> tuple[Formula, ...]:
    return (f,) if isinstance(f, Predicate) else children(f)


def _ahead(f: Formula, dt: float, total: int) -> int:
    """By how many samples what is inside of the window ``f`` looks ahead."""
    return int(min(max(reach(p, dt) for p in _parts(f)), total - 1))
