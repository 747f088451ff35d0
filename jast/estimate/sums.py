"""What an estimate needs of its weights, added chunk by chunk on the host: constant memory, double
precision, any range.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from jast.estimate import draws

__all__ = ["add", "nothing", "skewness"]


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
    by_component: Any
    """[K] sums by the component that made a trace (its probability)"""
    squares: Any
    """[K] sums of the squares of these parts"""
    tail: Any
    """The greatest log weights, at most ``keep``, falling"""
    keep: int
    draws: Any = None
    """`jast.estimate.draws.Draws` of the traces that have a miss distance"""
    plain: tuple[int, int, int] = (0, 0, 0)
    """(failing, invalid, episodes) of those that are known to be the model's own draws"""


def nothing(samples):
    """The `Sums` before the first of ``samples`` episodes."""
    return Sums(
        0,
        0,
        0,
        0,
        0.0,
        0,
        -np.inf,
        0.0,
        0.0,
        0.0,
        None,
        None,
        np.zeros(0),
        tail_size(samples),
        draws.nothing(),
    )


def tail_size(samples):
    """How many of the greatest weights the Pareto fit looks at: min(n / 5, 3 sqrt(n)) (Vehtari et
    al. 2024).
    """
    return int(np.ceil(min(samples / 5, 3 * np.sqrt(samples)))) + 1


def add(total, traces, plain=None):
    """`Sums` with the `Traces` [n] (NumPy) as well; ``plain`` [n]: which of them are the model's
    own draws, None where that is not known.
    """
    plain = np.zeros(len(traces.failure), bool) if plain is None else plain
    log_w = np.asarray(traces.log_weight, np.float64)
    good = np.asarray(traces.failure) & (log_w < np.inf)
    shares = np.exp(np.asarray(traces.shares, np.float64)[good])
    log_w = log_w[good]
    bad = np.asarray(traces.log_weight, np.float64)[np.asarray(traces.invalid)]
    bad = bad[bad < np.inf]
    top = max(total.top, log_w.max(initial=-np.inf), bad.max(initial=-np.inf))
    rescale = np.exp(total.top - top) if total.top > -np.inf else 0.0
    w = np.exp(log_w - top) if top > -np.inf else np.zeros(0)
    by, squares = (w**i @ shares**i if w.size else np.zeros(shares.shape[1]) for i in (1, 2))
    tail = np.concatenate([total.tail, log_w])
    if len(tail) > total.keep:
        tail = np.partition(tail, -total.keep)[-total.keep :]
    return Sums(
        samples=total.samples + len(traces.failure),
        steps=total.steps + int(np.asarray(traces.length, np.int64).sum()),
        failures=total.failures + int(np.asarray(traces.failure).sum()),
        invalid=total.invalid + int(np.asarray(traces.invalid).sum()),
        invalid_first=total.invalid_first * rescale
        + (np.exp(bad - top).sum() if bad.size and top > -np.inf else 0.0),
        undefined=total.undefined + int(np.asarray(traces.failure).sum()) - len(log_w),
        top=top,
        first=total.first * rescale + w.sum(),
        second=total.second * rescale**2 + (w**2).sum(),
        third=total.third * rescale**3 + (w**3).sum(),
        by_component=by if total.by_component is None else total.by_component * rescale + by,
        squares=squares if total.squares is None else total.squares * rescale**2 + squares,
        tail=np.sort(tail)[::-1],
        keep=total.keep,
        draws=draws.add(total.draws, traces),
        plain=(
            total.plain[0] + int(np.asarray(traces.failure)[plain].sum()),
            total.plain[1] + int(np.asarray(traces.invalid)[plain].sum()),
            total.plain[2] + int(plain.sum()),
        ),
    )


def skewness(sums):
    """Of the mean of the weights, 0 where it is not known."""
    n, m = sums.samples, sums.first / max(sums.samples, 1)
    variance = sums.second / max(n, 1) - m**2
    if n < 2 or not variance > 0:
        return 0.0
    return (sums.third / n - 3 * m * sums.second / n + 2 * m**3) / variance**1.5 / math.sqrt(n)
