"""Evaluation schedules: how many samples each iteration gets of a budget.

A schedule is a function ``(budget, iterations) -> counts``, a tuple of ``iterations`` whole numbers
that sum to ``budget``; a user's own may be given as well. Sizes are static: they are worked out on
the host.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Literal

from jast._src.core.typing import Schedule
from jast._src.util.checks import number, one_of, whole_number, wrong

__all__ = ["counts", "geometric", "manual", "uniform"]


def uniform() -> Schedule:
    """The same in every iteration; what is left over goes to the first ones, one each.

    Example:
        >>> from jast.cross_entropy import schedules
        >>> schedules.uniform()(10, 3)
        (4, 3, 3)
    """

    def schedule(budget, iterations):
        each, left = divmod(budget, iterations)
        return tuple(each + (k < left) for k in range(iterations))

    return schedule


def geometric(p: float = 0.1, normaliser: Literal["before", "after"] = "before") -> Schedule:
    """Most samples in the first iteration, and ever fewer: floor(budget pmf(k)) in iteration k = 1
    .. K - 1, the rest in the last (Algorithm 6 of R. J. Moss's thesis).

    pmf(k) is proportional to p (1 - p)^k. It is a truncated geometric distribution.

    Args:
        p: between 0 and 1.
        normaliser: pmf sums to one over 1 .. K ("before"), or over 0 .. K ("after"), as in
            Distributions.jl before and after 2021-08-27. "after" leaves the share of k = 0 to the
            last iteration, which then gets most of all.

    Raises:
        ValueError: for a p that is not between 0 and 1, and an unknown normaliser.

    Example:
        >>> from jast.cross_entropy import schedules
        >>> schedules.geometric(0.5)(100, 3)
        (57, 28, 15)
    """
    p = number("geometric", "p", p, lambda v: 0 < v < 1, "between 0 and 1")
    one_of("geometric", "normaliser", normaliser, ("before", "after"))

    def schedule(budget, iterations):
        mass = [p * (1 - p) ** k for k in range(iterations + 1)]
        total = math.fsum(mass[1:] if normaliser == "before" else mass)
        # A share that is a whole number may come out just below it. The source gives the last
        # iteration min(N - the others, N - its own floor), which is the rest, save for one
        # iteration alone, where it would be less
        first = [math.floor(budget * share / total + 1e-9) for share in mass[1:iterations]]
        return (*first, budget - sum(first))

    return schedule


def manual(counts: Sequence[int]) -> Schedule:
    """These very counts. That of the source is 20, 15, 9, 8 x 7.

    Args:
        counts: of each iteration.

    Raises:
        ValueError: when they are not as many as the iterations, or do not sum to the budget.

    Example:
        >>> from jast.cross_entropy import schedules
        >>> schedules.manual([20, 10])(30, 2)
        (20, 10)
    """
    sizes = _whole(counts)

    return lambda budget, iterations: _summing_to(budget, iterations, sizes)


def counts(schedule: Schedule, samples: int, iterations: int) -> tuple[int, ...]:
    """How many samples each iteration gets, by what a user gives as ``schedule``.

    Args:
        schedule: None or "uniform": ``samples`` in each of ``iterations``. A function, such as
            `geometric` returns: what it makes of ``samples * iterations`` and ``iterations``, which
            must sum to that budget. A sequence of counts: these, whatever ``samples`` and
            ``iterations`` are. A count may be 0, but not all of them.
        samples: in an iteration, on the average.
        iterations: how many.

    Returns:
        A tuple of ints.

    Raises:
        ValueError: that names ``samples``, ``iterations`` or ``schedule``.

    Example:
        >>> from jast.cross_entropy import schedules
        >>> schedules.counts("uniform", 10, 3)
        (10, 10, 10)
    """
    if not callable(schedule) and not isinstance(schedule, str) and schedule is not None:
        return _whole(schedule)
    samples = whole_number("schedule", "samples", samples)
    iterations = whole_number("schedule", "iterations", iterations)
    if schedule is None or schedule == "uniform":
        return (samples,) * iterations
    if isinstance(schedule, str):
        raise ValueError(
            'schedule: expected None, "uniform", a function (budget, iterations) -> counts, or a'
            f" sequence of counts, received {schedule!r}"
        )
    budget = samples * iterations
    try:
        sizes = schedule(budget, iterations)
    except TypeError as error:
        raise ValueError(
            f"schedule: expected a function (budget, iterations) -> counts, received {schedule!r},"
            f" which raised: {error}"
        ) from error
    return _summing_to(budget, iterations, _whole(sizes))


def _summing_to(budget, iterations, sizes):
    """``sizes``, or a ValueError unless they are one for each iteration and sum to the budget."""
    if (len(sizes), sum(sizes)) != (iterations, budget):
        raise ValueError(
            f"schedule: expected {iterations} counts that sum to the budget {budget}, received"
            f" {len(sizes)} that sum to {sum(sizes)}: {sizes}"
        )
    return sizes


def _whole(values):
    """A tuple of ints, none negative, not all 0."""
    try:
        values = tuple(values)
        sizes = tuple(operator.index(v) for v in values)
        good = (
            not any(isinstance(v, bool) for v in values)
            and min(sizes, default=-1) >= 0
            and sum(sizes) > 0
        )
    except TypeError:
        good = False
    if not good:
        must = "be whole numbers of at least 0, and not all 0"
        raise wrong("schedule", "counts", must, f"{values!r}")
    return sizes
