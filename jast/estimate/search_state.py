"""What a search for a proposal knows: the batches of the proposals so far, and the weights of their
failures by all of them.

Every failing point that a batch draws is weighted by the balance heuristic over all batches (Veach
and Guibas 1995). None of these points serves the estimate, which is drawn with the proposal as it
stands at the end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from jast.counter import numpy_generator
from jast.estimate.search_settings import SearchSettings
from jast.simulator import Simulator

__all__ = [
    "Batch",
    "Chance",
    "Family",
    "State",
    "begun",
    "log_ratios",
    "mixed_ratio",
    "promise",
    "serves",
    "taken",
]


class Batch(NamedTuple):
    """Episodes that one proposal has drawn; of these, the failing ones."""

    q: Any
    """The proposal"""
    points: Any
    """[m] of its `Family`"""
    log_weight: np.ndarray
    """[m] log p - log q"""
    size: int
    """Episodes, failing or not"""
    invalid: int = 0


class State(NamedTuple):
    """What a search knows."""

    q: Any = None
    """The proposal that is best so far; None before any failure"""
    batches: tuple[Batch, ...] = ()
    ratios: tuple[np.ndarray, ...] = ()
    """Of batch j: log q_i - log p [i, m] of its failing points by the proposal of each batch i"""
    log_weight: np.ndarray = np.zeros(0)
    """Of the failing points of all batches, by the balance heuristic"""
    log_mean: float = -math.inf
    """Log of the probability by these"""
    promised: float = 0.0
    """Effective draws of a draw of ``q``"""
    anchors: Any = None
    """[m, D] design points that the proposal began with"""
    cooled: Any = None
    """[m, D] failures that wide noise led to"""
    given: Any = None
    """Failures that came with the call"""
    populations: tuple[Any, ...] = ()
    """Those that the search began with: `jast.estimate.populations.Explored`"""
    missing: float = 0.0
    """What the proposal has lost, as a multiple of what it found"""
    spent: int = 0
    """Evaluations"""
    history: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    """That speak against the proposal"""
    plain: tuple[int, int, int] = (0, 0, 0)
    """(failing, invalid, episodes) of draws of the model"""

    @property
    def size(self) -> int:
        """Episodes of all batches."""
        return sum(b.size for b in self.batches)

    @property
    def log_p(self) -> float:
        """Of the probability, as far as anything tells; -inf where no failure was seen."""
        return max(self.log_mean, *(p.log_mean for p in self.populations), -math.inf)

    def noted(self, text: str, evaluations: int = 0) -> State:
        """The same with a line of history, and what it cost."""
        text = f"{text}, {evaluations} evaluations" if evaluations else text
        return self._replace(spent=self.spent + evaluations, history=(*self.history, text))

    def carried(self) -> State:
        """What a search of another family begins with."""
        return State(spent=self.spent, history=self.history, plain=self.plain)

    def after(self, other: State) -> State:
        """The same, after a search that went on from it."""
        return self._replace(spent=other.spent, history=other.history, plain=other.plain)

    def against(self, reason: str) -> State:
        """The same with a reason against the proposal."""
        return self._replace(reasons=(*self.reasons, reason))


class Chance(NamedTuple):
    """Where a search takes its random numbers from."""

    root: np.random.Generator
    rng: np.random.Generator
    latest: list[tuple[Family, State]]
    """The family and the state after the last batch, for an interruption"""

    def next_key(self) -> jax.Array:
        """A key for a population."""
        words = self.root.integers(2**32, size=2, dtype=np.uint32)
        return jax.random.wrap_key_data(words, impl="threefry2x32")


def begun(key: jax.Array) -> Chance:
    """The `Chance` of a call."""
    root = numpy_generator(key, 1)
    return Chance(root, numpy_generator(Chance(root, root, []).next_key()), [])


class Family(Protocol):
    """A kind of proposals over the episodes of one system. Points are pytrees that only their
    family looks into.
    """

    name: str
    sim: Simulator
    budget: int
    batch: int
    """Episodes of a batch"""
    chance: Chance
    settings: SearchSettings

    def draw(self, q: Any) -> Batch:
        """A `Batch` of the proposal ``q``."""

    def log_ratio(self, q: Any, points: Any) -> np.ndarray:
        """log q - log p [m] of the ``points`` [m]."""

    def refit(self, state: State) -> dict[str, Any]:
        """Proposals that are fitted to the failures of all batches, by what they are called."""

    def absorbed(self, state: State, points: Any, share: float) -> State:
        """The proposal with ``points`` taken in, which carry ``share`` of what it found."""

    def points_of(self, state: State, z: np.ndarray, used: np.ndarray) -> tuple[State, Any]:
        """The points of failures that a population found, ``z`` [m, D] of which they ``used`` so
        many numbers; and what this costs.
        """

    def rows(self, points: Any, rows: np.ndarray) -> Any:
        """Some of the ``points``."""

    def on_device(self, q: Any) -> Any:
        """``q`` as an `Estimate` has it."""

    def with_model(self, q: Any, share: float) -> Any:
        """The same, of which the model has so great a ``share``."""

    def left_out(self, q: Any, threshold: float) -> Any:
        """What keeps populations out of where log q - log p is above the ``threshold``."""


def taken(family: Family, state: State, batch: Batch) -> State:
    """The state with one more `Batch`: the weights of all failures, the probability by them, and
    of the proposals that have drawn the one that promises the least variance.
    """
    old = zip(state.ratios, state.batches, strict=True)
    ratios = [np.vstack([r, family.log_ratio(batch.q, b.points)]) for r, b in old]
    before = [family.log_ratio(b.q, batch.points) for b in state.batches]
    ratios.append(np.vstack([*before, -batch.log_weight]))
    batches = (*state.batches, batch)
    over = np.concatenate(ratios, axis=1)  # [I, N]
    total = sum(b.size for b in batches)
    share = np.log([b.size / total for b in batches])
    log_w = -np.logaddexp.reduce(over + share[:, None], axis=0)
    new = state._replace(batches=batches, ratios=tuple(ratios))
    if len(log_w):
        log_mean = float(np.logaddexp.reduce(log_w) - math.log(total))
        new = new._replace(log_weight=log_w, log_mean=log_mean)
        promised = [promise(new, r) for r in over]
        best = int(np.argmax(promised))
        new = new._replace(q=batches[best].q, promised=promised[best])
    family.chance.latest[:] = [(family, new._replace(spent=state.spent + family.batch))]
    return new


def promise(state: State, log_ratio: np.ndarray) -> float:
    """Effective draws of a draw of a proposal that has this log q - log p [N] on the failures of
    all batches: P^2 / E_q[w^2], by these.
    """
    second = np.logaddexp.reduce(state.log_weight - log_ratio) - math.log(state.size)
    return math.exp(min(2 * state.log_mean - second, 0.0))


def log_ratios(family: Family, q: Any, batches: Sequence[Batch]) -> np.ndarray:
    """log q - log p of the failing points of all ``batches``."""
    of = lambda b: -b.log_weight if b.q is q else family.log_ratio(q, b.points)
    return np.concatenate([of(b) for b in batches])


def mixed_ratio(family: Family, state: State, points: Any) -> np.ndarray:
    """log q - log p [m] of ``points``, q being all batches together."""
    each = [family.log_ratio(b.q, points) + math.log(b.size / state.size) for b in state.batches]
    return np.logaddexp.reduce(each)


def serves(state: State, least: float) -> bool:
    """Whether a draw of the proposal has more effective ones than ``least``, and than one of the
    model has.
    """
    plain = math.exp(min(state.log_mean, 0.0))
    # the batch of the model itself promises as much as it has
    return state.q is not None and state.promised > max(least, 1.01 * plain)
