"""What an estimate needs of its weights, added chunk by chunk on the host: constant memory, double
precision, any range.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.estimate.diagnostics import tail_size
from jast._src.estimate.weighted_draws import (
    Draws,
    Moments,
    add_draws,
    empty_draws,
    moments_of_sums,
)

__all__ = ["Sums", "add_traces", "empty_sums", "mode_shares", "moments"]


class Sums(NamedTuple):
    """Weights w = p / q of failing episodes, all over exp(top)."""

    samples: int
    """Episodes counted"""
    steps: int
    failures: int
    """Failing episodes"""
    invalid: int
    """Episodes in which the simulator or the model's density returned NaN"""
    invalid_first: float
    """Sum of the weights of the invalid ones, over exp(top)"""
    undefined: int
    """Failing episodes whose weight is NaN or infinite; they count for nothing"""
    top: float
    """Greatest log weight; -inf before any"""
    first: float
    """Sum of w / exp(top)"""
    second: float
    """Sum of the squares"""
    third: float
    """Sum of the cubes"""
    by_component: np.ndarray | None
    """[K] sums by the component that made a trace (its probability)"""
    squares: np.ndarray | None
    """[K] sums of the squares of these parts"""
    tail: np.ndarray
    """The greatest log weights, at most ``keep``, falling"""
    keep: int
    draws: Draws | None = None
    """`estimate.weighted_draws.Draws` of the traces that have a miss distance"""
    plain: tuple[int, int, int] = (0, 0, 0)
    """(failing, invalid, episodes) of those that are known to be the model's own draws"""


def empty_sums(samples: int) -> Sums:
    """The `Sums` before the first of ``samples`` episodes."""
    return Sums(
        samples=0,
        steps=0,
        failures=0,
        invalid=0,
        invalid_first=0.0,
        undefined=0,
        top=-np.inf,
        first=0.0,
        second=0.0,
        third=0.0,
        by_component=None,
        squares=None,
        tail=np.zeros(0),
        keep=tail_size(samples) + 1,
        draws=empty_draws(),
    )


def add_traces(total: Sums, traces: Any, plain: np.ndarray | None = None) -> Sums:
    """`Sums` with the `Traces` [n] (NumPy) as well; ``plain`` [n]: which of them are the model's
    own draws, None where that is not known.
    """
    failure, invalid = np.asarray(traces.failure), np.asarray(traces.invalid)
    plain = np.zeros(len(failure), bool) if plain is None else plain
    log_w = np.asarray(traces.log_weight, np.float64)
    good, bad = failure & (log_w < np.inf), log_w[invalid]
    shares = np.exp(np.asarray(traces.shares, np.float64)[good])
    log_w, bad = log_w[good], bad[bad < np.inf]
    top = max(total.top, log_w.max(initial=-np.inf), bad.max(initial=-np.inf))
    rescale = np.exp(total.top - top) if total.top > -np.inf else 0.0
    w = np.exp(log_w - top) if top > -np.inf else np.zeros(0)
    by, squares = (w**i @ shares**i if w.size else np.zeros(shares.shape[1]) for i in (1, 2))
    tail = np.concatenate([total.tail, log_w])
    if len(tail) > total.keep:
        tail = np.partition(tail, -total.keep)[-total.keep :]
    added = int(failure[plain].sum()), int(invalid[plain].sum()), int(plain.sum())
    return Sums(
        samples=total.samples + len(failure),
        steps=total.steps + int(np.asarray(traces.length, np.int64).sum()),
        failures=total.failures + int(failure.sum()),
        invalid=total.invalid + int(invalid.sum()),
        invalid_first=total.invalid_first * rescale
        + (np.exp(bad - top).sum() if top > -np.inf else 0.0),
        undefined=total.undefined + int(failure.sum()) - len(log_w),
        top=top,
        first=total.first * rescale + w.sum(),
        second=total.second * rescale**2 + (w**2).sum(),
        third=total.third * rescale**3 + (w**3).sum(),
        by_component=by if total.by_component is None else total.by_component * rescale + by,
        squares=squares if total.squares is None else total.squares * rescale**2 + squares,
        tail=np.sort(tail)[::-1],
        keep=total.keep,
        draws=add_draws(total.draws, traces),
        plain=tuple(a + b for a, b in zip(total.plain, added, strict=True)),
    )


def moments(sums: Sums) -> Moments:
    """`Moments` of the weights, where a failure was seen."""
    with np.errstate(divide="ignore"):  # far below the greatest weight of an invalid one: 0
        log_sums = np.log([sums.first, sums.second, sums.third]).tolist()
    m = moments_of_sums(log_sums, sums.samples)
    return m._replace(log_mean=m.log_mean + sums.top)


def mode_shares(sums: Sums, groups: Sequence[Sequence[int]]) -> tuple[np.ndarray, np.ndarray]:
    """(share of the estimate, effective sample size) of groups of components, greatest share first:
    [m], [m].
    """
    first = np.array([sums.by_component[g].sum() for g in groups])
    second = np.array([sums.squares[g].sum() for g in groups])
    order = np.argsort(-first, kind="stable")
    sizes = np.divide(first**2, second, out=np.zeros(len(first)), where=second > 0)
    return first[order] / sums.first, sizes[order]
