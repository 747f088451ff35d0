"""Which part of a formula broke, and when: every sub-formula asked at the moment that decides."""

from textwrap import wrap
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.specs.formulas import Formula, Temporal, Until, children
from jast._src.specs.robustness import Values, margins, robustness, samples_in, spacing, values
from jast._src.util import display

__all__ = ["Part", "Parts", "parts"]


class Part(NamedTuple):
    """A sub-formula, at the moment at which the whole formula's robustness depends on it.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> found = specs.parts(specs.always(low), jnp.array([1.0, 6.0, 2.0]), 1.0)
        >>> part = found.rows[1]  # s < 5, inside of always
        >>> part.time, part.value, part.held
        (1.0, -1.0, False)
    """

    formula: Formula
    depth: int
    """How many formulas contain it."""
    time: float
    """Seconds; NaN where nothing was decided within the trace."""
    value: float
    """Its robustness then."""
    held: bool
    """Whether ``value`` is at least 0."""
    decides: bool
    """Whether its robustness is that of the whole formula, or minus that (below ``~``,
    ``implies``)."""
    values: np.ndarray
    """[T] its robustness at each moment, windows clipped at the trace's end."""


@display.printable()
class Parts(NamedTuple):
    """What `parts` found: prints as a table, a long formula on several lines.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> found = specs.parts(specs.always(low), jnp.array([1.0, 6.0, 2.0]), 1.0)
        >>> [str(part.formula) for part in found.rows if part.decides]
        ['always (s < 5)', 's < 5']
    """

    rows: tuple[Part, ...]
    """The formula itself first, each formula before its parts."""
    dt: float

    def __str__(self) -> str:
        width = max(2 * p.depth + len(str(p.formula)) for p in self.rows)
        width = max(min(width, 70), 10)
        lines = [f"{'':<{width}}  {'at s':>8}  {'robustness':>11}"]
        for p in self.rows:
            margin = "  " * p.depth
            room = max(width, len(margin) + 20)
            first, *rest = wrap(
                str(p.formula), room, initial_indent=margin, subsequent_indent=margin + "    "
            )
            when = "-" if np.isnan(p.time) else f"{p.time:g}"
            said = "-" if np.isnan(p.value) else "holds" if p.held else "does not"
            said += ", decides" if p.decides else ""
            lines += [f"{first:<{width}}  {when:>8}  {p.value:11.5g}  {said}", *rest]
        return "\n".join(lines)


def parts(formula: Formula, trace: Any, dt: float, *, goes_on: bool = False) -> Parts:
    """Which part of a formula broke, and when; or, where it holds, what came nearest.

    The formula is asked at 0 s. What is inside of a window is asked at the moment of it that
    decides: the worst for ``always``, the best for ``eventually`` and ``until``. As `under`
    does, it takes a trace that ended before a window began: ``always`` holds there, ``eventually``
    does not, and what is inside has no moment.

    Args:
        formula: `Formula`.
        trace: a pytree of arrays [T, ...], as for `robustness`.
        dt: seconds between samples.
        goes_on: as for `robustness`: for the trace of an episode that ended where the violation
            was certain (`jast.specs.goes_on` says whether it did).

    Returns:
        `Parts`: a row for each sub-formula, with its trace of robustness. On the host.

    Raises:
        ValueError: as `robustness`, but for a trace that is shorter than a window.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> found = specs.parts(specs.always(low), jnp.array([1.0, 6.0, 2.0]), 1.0)
        >>> "s < 5" in str(found)
        True
    """
    dt = spacing("parts", dt)
    robustness(formula, trace, dt, goes_on=True)  # its checks, but for those of windows
    given = margins("parts", formula, trace)
    found = jax.device_get(values(formula, given, dt, goes_on))
    total, rows = found.own[0], []

    def look(f: Formula, v: Values, at: int | None, depth: int) -> None:
        value, time = (np.nan, np.nan) if at is None else (float(v.own[at]), at * dt)
        decides = abs(value) == abs(float(total)) and np.isfinite(value)
        rows.append(
            Part(
                formula=f,
                depth=depth,
                time=time,
                value=value,
                held=value >= 0,
                decides=decides,
                values=v.own,
            )
        )
        moments = _moments(f, v, at, dt)
        for child, part, when in zip(children(f), v.parts, moments, strict=True):
            look(child, part, when, depth + 1)

    look(formula, found, 0, 0)
    return Parts(tuple(rows), dt)


def _moments(f: Formula, v: Values, at: int | None, dt: float) -> list[int | None]:
    """When the parts of ``f`` are asked, which is itself asked ``at``."""
    if at is None or not isinstance(f, Temporal | Until):
        return [at] * len(v.parts)
    if not np.isfinite(v.own[at]):  # open yet
        return [None] * len(v.parts)
    first, last = samples_in("parts", f, dt)
    window = slice(first, None if last is None else last + 1)
    later = [part.own[at:] for part in v.parts]
    if isinstance(f, Until):
        left, right = later
        reached = np.minimum(right, np.minimum.accumulate(left))[window]
        if not (reached >= v.own[at]).any():  # the right part is open yet: the left one decides
            return [at + int(np.argmin(left)), None]
        then = first + int(np.argmax(reached))
        return [at + int(np.argmin(left[: then + 1])), at + then]
    pick = np.argmin if f.kind == "always" else np.argmax
    return [at + first + int(pick(later[0][window]))]
