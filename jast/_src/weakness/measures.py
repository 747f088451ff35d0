"""How well scores tell failures from the rest: ROC curves, the area under them, precision and
recall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jast._src.core.typing import Array
from jast._src.util import display
from jast._src.util.checks import instance, number, whole_number, wrong
from jast._src.weakness.result import Result

__all__ = ["Judgement", "Roc", "auc", "checked_truth", "judge", "precision_recall", "roc"]


@display.printable()
class Roc(NamedTuple):
    """A receiver operating characteristic, from (0, 0) to (1, 1).

    Example:
        >>> import numpy as np, jast
        >>> curve = jast.weakness.roc(np.array([0.9, 0.2, 0.4]), np.array([True, False, True]))
        >>> curve.area
        1.0
    """

    false_positive: np.ndarray
    """[m]: share of the inputs that pass whose score is at least the threshold"""
    true_positive: np.ndarray
    """[m]: share of the failures"""
    threshold: np.ndarray
    """[m]: falling, from infinity"""

    @property
    def area(self) -> float:
        """Under the curve; NaN where all inputs fail or none."""
        return float(np.trapezoid(self.true_positive, self.false_positive))


@display.printable()
class Judgement(NamedTuple):
    """How good the scores of each iteration are on the whole data set; R iterations.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> told = jast.weakness.judge(found, wrong(inputs) != labels, top=20)
        >>> bool((told.precision <= 1.0).all())
        True
    """

    auc: np.ndarray
    """[R]: area under the ROC curve; NaN where all inputs fail or none"""
    precision: np.ndarray
    """[R]: share of failures among the candidates; NaN without candidates"""
    recall: np.ndarray
    """[R]: share of all failures that are candidates; NaN without failures"""
    candidates: np.ndarray
    """[R] int: inputs with a score of at least the threshold, or the ``top``"""


def roc(scores: Array, failed: Array) -> Roc:
    """The receiver operating characteristic of scores; equal scores are one point.

    Args:
        scores: [n]: how suspect each input is.
        failed: [n] bool: which fail.

    Returns:
        `Roc`; its shares are NaN where all inputs fail or none.

    Raises:
        ValueError: for arrays of other lengths, and scores that are NaN.

    Example:
        >>> import numpy as np, jast
        >>> curve = jast.weakness.roc(np.array([0.9, 0.2, 0.4]), np.array([True, False, True]))
        >>> curve.true_positive.tolist()
        [0.0, 0.5, 1.0, 1.0]
    """
    return _roc("roc", scores, failed)


def _roc(function, scores, failed):
    scores, failed = _check_scores(function, scores, failed)
    order = np.argsort(-scores, kind="stable")
    last = np.flatnonzero(np.append(np.diff(scores[order]) != 0, True)[: len(scores)])
    hits, count = np.cumsum(failed[order])[last], last + 1

    def share(part, whole):
        return np.append(0.0, part / whole if whole else np.full(len(part), np.nan))

    return Roc(
        false_positive=share(count - hits, np.sum(~failed)),
        true_positive=share(hits, np.sum(failed)),
        threshold=np.append(np.inf, scores[order][last]),
    )


def auc(scores: Array, failed: Array) -> float:
    """Area under the ROC curve: the chance that a failure has the higher score of a random pair;
    equal scores count half.

    Args:
        scores: [n]: how suspect each input is.
        failed: [n] bool: which fail.

    Returns:
        A float; NaN where all inputs fail or none.

    Raises:
        ValueError: as `roc`.

    Example:
        >>> import numpy as np, jast
        >>> jast.weakness.auc(np.array([0.9, 0.2, 0.4]), np.array([True, False, True]))
        1.0
    """
    return _roc("auc", scores, failed).area


def judge(
    result: Result, failed: Array, *, threshold: float = 0.5, top: int | None = None
) -> Judgement:
    """How good the scores of each iteration are, by the truth on all inputs.

    Candidates are the inputs with a score of at least ``threshold``. The scores of inputs that were
    run are those of models that have not seen their outcomes (the thesis's adversary has: as
    published).

    Args:
        result: of `validate`.
        failed: [n] bool, which only a study knows that has run the system on all inputs.
        threshold: of a candidate's score.
        top: with it, the candidates are this many inputs with the highest scores.

    Returns:
        `Judgement`.

    Raises:
        ValueError: for what is no result, a ``failed`` of another shape or type, and a threshold
            that is no number.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> told = jast.weakness.judge(found, wrong(inputs) != labels, top=20)
        >>> told.candidates.tolist() == [20] * len(told.auc)
        True
    """
    instance("judge", "result", result, Result, "a Result")
    threshold = number(
        "judge", "threshold", threshold, lambda v: not np.isnan(v), "to compare scores with"
    )
    every = np.asarray(result.history.scores)
    n = every.shape[1]
    failed = checked_truth("judge", failed, n)
    if not failed[result.failures].all():
        raise ValueError(
            "judge: failed must agree with the result, whose failures are not all among them"
        )
    if top is not None and whole_number("judge", "top", top) > n:
        raise ValueError(f"judge: top must be at most {n}, the inputs there are, received {top!r}")
    rows = []
    for scores in every:
        if top is None:
            chosen = scores >= threshold
        else:
            chosen = np.isin(np.arange(n), np.argsort(-scores, kind="stable")[:top])
        rows.append((auc(scores, failed), *precision_recall(chosen, failed), int(np.sum(chosen))))
    columns = zip(*rows, strict=True) if rows else np.zeros((4, 0))
    return Judgement(*map(np.asarray, columns))


def checked_truth(function, failed, n):
    """``failed`` as an array, or a ValueError unless it is bool [n]."""
    truth = _array(failed)
    if truth.shape != (n,) or truth.dtype != bool:
        raise wrong(function, "failed", f"be bool [{n}]", f"{truth.dtype} of shape {truth.shape}")
    return truth


def precision_recall(chosen, failed):
    """Share of failures among the ``chosen`` [n] bool, and share of the failures that are chosen;
    NaN where there are none to share.
    """
    hits, k, every = (int(np.sum(a)) for a in (failed & chosen, chosen, failed))
    return hits / k if k else np.nan, hits / every if every else np.nan


def _check_scores(function, scores, failed):
    scores, failed = _array(scores), _array(failed)
    fits = scores.ndim == 1 and scores.shape == failed.shape
    if not fits or scores.dtype.kind not in "biuf" or failed.dtype != bool:
        received = " and ".join(f"{a.dtype} of shape {a.shape}" for a in (scores, failed))
        raise wrong(function, "scores and failed", "be [n], failed bool", received)
    scores = scores.astype(float)
    if np.isnan(scores).any():
        raise ValueError(f"{function}: scores must not be NaN, {int(np.isnan(scores).sum())} are")
    return scores, failed


def _array(values):
    """``values`` as an array; of objects where they are none."""
    try:
        return np.asarray(values)
    except ValueError:  # of several shapes
        return np.asarray(None)
