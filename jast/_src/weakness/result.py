"""What a validation returns."""

from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np

from jast._src.util import display

__all__ = ["History", "Result", "State"]


ROUGH = " (a guide only, far too low where a kind of failure was not met)"
LEVEL = 0.95  # of confidence; a convention
TILT = 1.5
"""By which the random calls that failed are tilted in a bound: with none to five of them the bound
is 22 to 29 % above that of as many independent draws."""


@display.printable()
class History(NamedTuple):
    """R iterations, each of a batch of calls and what was learned from it.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> int(found.history.calls[-1]), int(found.history.found[-1]) == found.failing
        (50, True)
    """

    calls: np.ndarray
    """[R] int: calls after each iteration"""
    found: np.ndarray
    """[R] int: failures found by then"""
    precision: np.ndarray
    """[R]: share of failures among the iteration's candidates, all of which were run; NaN where
    there were none
    """
    recall: np.ndarray
    """[R]: failures found, as a share of these and ``expected``, and so no better than that
    guess"""
    auc: np.ndarray
    """[R]: area under the ROC curve of the iteration's scores on the inputs run so far, which were
    chosen (`judge`: on all); NaN where all failed or none
    """
    expected: np.ndarray
    """[R]: how many failures the selector expects among the inputs not yet run: rough, unless all
    inputs were run at random
    """
    scores: np.ndarray
    """[R, n] float32: the scores after each iteration"""


@display.printable()
class State(NamedTuple):
    """All that `validate` needs to go on; for `save` and `load`.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> more = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=80, selector="random",
        ...     state=found.state,
        ... )
        >>> more.calls
        80
    """

    selector: str
    """The selector's name and settings, as JSON"""
    data: str
    """Fingerprint of the inputs and labels"""
    key: np.ndarray
    """The key's numbers"""
    memory: dict[str, np.ndarray]
    """What the selector has learned: arrays by name"""
    order: np.ndarray
    """[calls] int: the inputs that were run"""
    predicted: np.ndarray
    """[n] int32: the answers"""
    complete: int
    """How many of ``order`` belong to whole iterations"""
    history: History
    finished: bool
    """The selector has made all its iterations"""


@display.result_class("calls")
class Result(NamedTuple):
    """The outcome of a validation of n inputs. NumPy arrays.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> found.calls, bool((found.predicted[found.failures] != labels[found.failures]).all())
        (50, True)
        >>> len(found.ranked)  # inputs that were not run
        150
    """

    failures: np.ndarray
    """[found] int: the inputs that the system gets wrong, in the order found"""
    calls: int
    """Inputs that the system was run on, each once"""
    order: np.ndarray
    """[calls] int: those inputs, in order"""
    predicted: np.ndarray
    """[n] int32: the system's answers, -1 where it was not run"""
    scores: np.ndarray
    """[n] float32: how suspect each input is now, in [0, 1]; default selector: the probability that
    it fails, without its own outcome
    """
    ranked: np.ndarray
    """[n - calls] int: the inputs not yet run, the most suspect first"""
    expected: float
    """How many failures the selector expects among these; NaN before and within an iteration"""
    history: History
    incidents: tuple[str, ...]
    """Texts: why it ended before its budget was spent, empty if it did not"""
    state: State
    """Give it to `validate` again to go on"""

    @property
    def episodes(self) -> int:
        """The same as ``calls``."""
        return self.calls

    @property
    def failing(self) -> int:
        """How many of the inputs that were run the system gets wrong."""
        return len(self.failures)

    @property
    def settings(self) -> dict[str, str]:
        """The ``selector`` with its settings, as text."""
        return {"selector": self.state.selector}

    @property
    def at_most(self) -> float:
        """A bound of the failures among the inputs not yet run that holds in 95 % of validations,
        whatever the system gets wrong: by the calls of the default selector that were drawn at
        random. NaN without such calls.

        Of a batch of r calls drawn from R inputs K of which fail, k fail with E exp(-t k) at most
        exp((exp(-t) - 1) r K / R), whatever was chosen before (Hoeffding 1963, section 6). So by
        Markov's inequality the sum over batches of r K / R is at most (t sum k - log .05) / (1 -
        exp(-t)) in 95 %, also where what was drawn decides what is run next and how much is drawn
        (Ville 1939). K is all failures less those known to lie elsewhere.
        """
        share, known, failed = self.state.memory.get("shares", np.zeros(3))
        if share == 0:
            return np.nan
        most = (TILT * failed - np.log1p(-LEVEL)) / -np.expm1(-TILT)
        return float(np.clip((most + known) / share - self.failing, 0, len(self.ranked)))

    def __str__(self) -> str:
        h, n = self.history, len(self.scores)
        rows = zip(h.calls, h.found, h.precision, h.recall, h.auc, h.expected, strict=True)
        table = "\n".join(
            f"{i:9d} {c:7d} {f:8d} {_number(p):>10} {_number(r):>9} {_number(a):>7} {e:9.0f}"
            for i, (c, f, p, r, a, e) in enumerate(rows, 1)
        )
        left = ""
        if not np.isnan(self.expected):
            left = f"; roughly {self.expected:.0f} expected among the {n - self.calls} not run"
            left += ROUGH * (json.loads(self.state.selector)[0] == "default")
            if self.at_most < n - self.calls:  # else the bound says nothing
                left += f", by its random calls at most {self.at_most:.0f} in 95 % of validations"
        head = f"{len(self.failures)} failures in {self.calls} calls ({n} inputs){left}"
        names = (
            "iteration   calls failures  precision   ~recall AUC run ~expected\n" if table else ""
        )
        return "\n".join([head, names + table, *(f"stopped: {i}" for i in self.incidents)]).strip()


def _number(value):
    return "-" if np.isnan(value) else f"{value:.2f}"
