"""What `jast.sweep` returns: one row for each value, as a table and as a picture."""

from __future__ import annotations

import math
from textwrap import shorten
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.nominal import Nominal
from jast._src.estimate.estimate import guaranteed_words, is_doubtful
from jast._src.io.data_frames import dataframe
from jast._src.sweeping.crossing import Crossing, crossing
from jast._src.util import display
from jast._src.util.checks import wrong
from jast._src.util.intervals import checked_level
from jast.estimate import Estimate
from jast.search import SearchResult
from jast.stress_testing import Report

__all__ = ["Answer", "Sweep", "answer"]

NOTE = "note"  # the name of a table's last column
CELL = 60  # characters of a cell at most


class Answer(NamedTuple):
    """The probability of failure that a result speaks of; NaN where no failure was seen."""

    probability: float = math.nan
    low: float = math.nan
    high: float = math.nan
    reliable: bool = False


@display.result_class("episodes")
class Sweep(NamedTuple):
    """A table: what a function said of each of N systems. Row i is ``function(key_i,
    simulators[i])`` with ``key_i = jax.random.fold_in(key, i)``; where ``settings["follow"]``
    holds, with ``near``, the result of the last row before it that has one.

    Example:
        >>> import jax, jast
        >>> make = lambda threshold: jast.simulators.walk1d(threshold=threshold)
        >>> table = jast.sweep(
        ...     jax.random.key(0), make, {"threshold": [8.0, 12.0]}, jast.nominal, episodes=500
        ... )
        >>> table.values, table.probability.shape, bool(table.reliable.all())
        ({'threshold': (8.0, 12.0)}, (2,), True)
    """

    values: dict[str, tuple[Any, ...]]
    """The settings: name -> N values."""
    results: tuple[Any, ...]
    """[N] what the function returned; None where it raised."""
    errors: tuple[str | None, ...]
    """[N] texts of what was raised; None where nothing was."""
    simulators: tuple[Any, ...]
    """[N] `jast.Simulator`; None where it could not be made."""
    settings: dict[str, Any]
    """What was asked for; ``programs``: how many kinds of systems there were, which compile apart;
    ``interrupted`` where the last rows are missing; where rows are joined, ``judged``: episodes
    that it took, and ``apart``: rows that contradict what failures say of the ratio to the next
    one, of which one may miss a failure mode
    """
    curve: np.ndarray | None = None
    """[N, 3] probabilities and the ends of their intervals that rows have when they are joined with
    their neighbours; NaN where a row's own result stands; None where all do
    """
    ratios: np.ndarray | None = None
    """[N - 1, 3] probability of the next row over that of a row, and the ends of its interval,
    where rows are joined; NaN where one of the two takes no part
    """

    @property
    def answers(self) -> tuple[Any, ...]:
        """[N] `Answer` of each row; as it is joined with its neighbours, where it is."""
        alone = tuple(map(answer, self.results))
        if self.curve is None:
            return alone
        return tuple(
            a if np.isnan(c[0]) else Answer(*c.tolist(), a.reliable)
            for a, c in zip(alone, self.curve, strict=True)
        )

    @property
    def probability(self) -> np.ndarray:
        """[N] probabilities of failure; NaN where a row has none, or saw no failure."""
        return np.array([a.probability for a in self.answers])

    @property
    def interval(self) -> np.ndarray:
        """[N, 2] their intervals, at the level of each result."""
        return np.array([(a.low, a.high) for a in self.answers])

    @property
    def reliable(self) -> np.ndarray:
        """[N] bool: there is a probability, and nothing is known against it."""
        return np.array([a.reliable for a in self.answers])

    @property
    def episodes(self) -> int:
        """Episodes simulated in all."""
        alone = sum(getattr(r, "episodes", None) or 0 for r in self.results)
        return alone + self.settings.get("judged", 0)

    def crossing(
        self, level: float = 1e-6, against: str | None = None, unreliable: bool = False
    ) -> Crossing:
        """Where the probability of failure crosses ``level``, as a setting varies: between two
        rows, the normal score of p is a straight line, as it is where what is compared with the
        setting is normal.

        Args:
            level: probability, above 0 and below 1.
            against: the setting, of numbers; default: the only one that varies.
            unreliable: whether rows that are UNRELIABLE serve as well.

        Returns:
            `Crossing`. Its interval has all places where the rows' own intervals hold ``level`` by
            straight lines of the score or of log p, and those where the lines of the neighbouring
            rows meet it, drawn on: a curve that bends one way lies between.

        Raises:
            ValueError: where the rows do not cross it, or cross it in several places which their
                intervals tell apart; for a level outside (0, 1), and without a setting of numbers.
        """
        level = checked_level("crossing", level)
        name, x = self.axis("crossing", against)
        rows = np.column_stack([self.probability, self.interval])
        return crossing(name, x, rows, self.reliable | unreliable, level)

    def to_dataframe(self) -> Any:
        """The table as one of pandas (the extra ``tables``), a row for each system: the settings,
        then ``probability``, ``interval_low``, ``interval_high``, ``reliable``, ``best_log_prob``
        (that of the likeliest failure found, or of a search's best episode), ``episodes`` and
        ``error``.

        Returns:
            The ``pandas.DataFrame``; its index is the number of the row, from 0.

        Raises:
            ImportError: where pandas is not installed.
        """
        best = [_best(r) for r in self.results]
        low, high = self.interval.T
        columns = dict(
            probability=self.probability,
            interval_low=low,
            interval_high=high,
            reliable=self.reliable,
            best_log_prob=[math.nan if b is None else float(b.log_prob) for b in best],
            episodes=[getattr(r, "episodes", None) or 0 for r in self.results],
            error=self.errors,
        )
        return dataframe([*self.values.items(), *columns.items()], [])

    def plot(self, **how: Any) -> Any:
        """`jast.plot.sweep` of this: the probability of failure against the setting."""
        from jast.plot import sweep

        return sweep(self, **how)

    def axis(self, caller: str, against: str | None = None) -> tuple[str, np.ndarray]:
        """(name, values [N]) of a setting that is a number in each row; ``caller``: of messages.

        Raises:
            ValueError: where ``against`` is none, or not given and not the only one that varies.
        """
        numeric = {k: np.array(v, float) for k, v in self.values.items() if all(map(_number, v))}
        varying = [k for k, v in numeric.items() if len(set(v)) > 1]
        name = varying[0] if against is None and len(varying) == 1 else against
        if name not in numeric:
            must = f"name a setting of numbers, one of {list(numeric)}"
            raise wrong(caller, "against", must, f"{against!r}")
        return name, numeric[name]

    def __str__(self) -> str:
        rows = [_row(*each) for each in zip(self.results, self.errors, self.answers)]
        columns = [[k, *map(_text, values)] for k, values in self.values.items()]
        names = dict.fromkeys(k for row in rows for k in row if k != NOTE)
        columns += [[k, *(row.get(k, "") for row in rows)] for k in names]
        columns = [[cell.rjust(max(map(len, column))) for cell in column] for column in columns]
        notes = [row.get(NOTE, "") for row in rows]
        columns.append([NOTE if any(notes) else "", *notes])
        lines = ["  ".join(cells).rstrip() for cells in zip(*columns, strict=True)]
        if "interrupted" in self.settings:
            lines.append(f"interrupted {self.settings['interrupted']}")
        for i in self.settings.get("apart", ()):
            lines.append(f"rows {i} and {i + 1}: their failures say another ratio")
        return "\n".join(lines)


def answer(result: Any) -> Answer:
    """The `Answer` of a result; one of NaN where it speaks of no probability."""
    result = _estimate_of(result)
    if isinstance(result, Estimate):
        return Answer(result.mean, *result.interval, result.reliable)
    if isinstance(result, Nominal):
        seen = result.failing > 0
        return Answer(result.rate if seen else math.nan, *result.interval, seen)
    return Answer()


def _estimate_of(result):
    return result.probability if isinstance(result, Report) else result


def _row(result, error, a):
    """The cells of a row: name of the column -> text."""
    if error is not None:
        return {NOTE: shorten(error, CELL, placeholder=" ...")}
    cells = {}
    estimate = _estimate_of(result)
    if not math.isnan(a.high):
        seen = not math.isnan(a.probability)
        cells["probability"] = f"{a.probability:.4g}" if seen else "not seen"
        cells["interval"] = f"[{a.low:.4g}, {a.high:.4g}]"
    if isinstance(estimate, Estimate) and guaranteed_words(estimate) is not None:
        if is_doubtful(estimate):
            cells["doubtful"] = cells["probability"]
        low, high = estimate.guaranteed
        cells["probability"] = f"{estimate.plain[0]} of {estimate.plain[-1]} fail"
        cells["interval"] = f"[{low:.4g}, {high:.4g}]"
    if (best := _best(result)) is not None:
        cells["best log p"] = f"{float(best.log_prob):.6g}"
        cells["fails"] = "yes" if best.failure else "no"
    if (episodes := getattr(result, "episodes", None)) is not None:
        cells["episodes"] = f"{episodes}"
    elif not cells:
        cells["result"] = shorten(str(result), CELL, placeholder=" ...")
    if none_valid := _invalid(result):
        cells[NOTE] = f"all {none_valid} episodes are invalid: nothing is known"
    elif "probability" in cells and not a.reliable:
        cells[NOTE] = _first_warning(result)
    return cells


def _best(result):
    """The best episode of a search or of a report; None of other results."""
    found = result.failures if isinstance(result, Report) else None
    return result.best if isinstance(result, SearchResult) else found.best if found else None


def _invalid(result):
    """How many episodes a result is of, where all of them are invalid; else 0."""
    estimate = _estimate_of(result)
    if isinstance(estimate, Estimate) and estimate.plain is not None:
        _, invalid, n = estimate.plain
        return estimate.invalid * (invalid == n and math.isnan(estimate.mean))
    searched = isinstance(result, SearchResult) and not np.isfinite(result.best.reward)
    counted = isinstance(result, Nominal) and result.invalid == result.episodes
    return result.invalid if searched or counted else 0


def _first_warning(result):
    """The first reason not to believe a result."""
    reasons = getattr(_estimate_of(result), "warnings", ())
    return shorten(": ".join(["UNRELIABLE", *reasons[:1]]), CELL, placeholder=" ...")


def _number(value):
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _text(value):
    return f"{value:.6g}" if _number(value) else shorten(str(value), 24, placeholder=" ...")
