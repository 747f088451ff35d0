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

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.estimate.proposal_search.settings import SearchSettings

__all__ = [
    "Batch",
    "Family",
    "Scored",
    "SearchContext",
    "SearchState",
    "add_batch",
    "efficiency",
    "failure_log_ratios",
    "is_efficient",
    "pooled_log_ratio",
    "search_context",
]

NO_BETTER = 1.01  # times as efficient as the model: a batch of the model is so by chance


class Batch(NamedTuple):
    """Episodes that one proposal has drawn; of these, the failing ones."""

    q: Any
    """The proposal, of its `Family`"""
    points: Any
    """[m] of its `Family`"""
    log_weight: np.ndarray
    """[m] log p - log q"""
    size: int
    """Episodes, failing or not"""
    invalid: int = 0


class Scored(NamedTuple):
    """A proposal, and what it makes of the failures of all batches."""

    q: Any
    log_ratio: np.ndarray
    """[N] log q - log p"""


class SearchState(NamedTuple):
    """What a search knows."""

    q: Any = None
    """The best proposal so far, of its `Family`; None before any failure"""
    batches: tuple[Batch, ...] = ()
    scored: tuple[Scored, ...] = ()
    """The proposals that have drawn the batches, each once, and the one that was fitted last"""
    log_weight: np.ndarray = np.zeros(0)
    """Of the failing points of all batches, by the balance heuristic"""
    log_mean: float = -math.inf
    """Log of the probability by these"""
    efficiency: float = 0.0
    """Of ``q``: effective draws of a draw"""
    anchors: np.ndarray | None = None
    """[m, D] design points that the proposal began with"""
    planes: Any = None
    """Half-spaces of failure that it began with: `estimate.gaussians.half_spaces.Planes`"""
    cooled: np.ndarray | None = None
    """[m, D] failures that wide noise led to"""
    given: Any = None
    """Failures that came with the call: `estimate.tilts.exploration.Given`"""
    populations: tuple[Any, ...] = ()
    """Those that the search began with: `estimate.host_populations.Explored`"""
    missing: float = 0.0
    """Probability that the proposal has missed, as a multiple of what it found"""
    spent: int = 0
    """Evaluations"""
    history: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    """Against the proposal"""
    plain: tuple[int, int, int] = (0, 0, 0)
    """(failing, invalid, episodes) of draws of the model"""

    @property
    def size(self) -> int:
        """Episodes of all batches."""
        return sum(b.size for b in self.batches)

    @property
    def log_p(self) -> float:
        """Log of the probability, as far as anything tells; -inf where no failure was seen. A
        single failure of the model may be chance.
        """
        failing, _, drawn = self.plain
        plain = math.log(failing / drawn) if failing > 1 else -math.inf
        return max(self.log_mean, *(p.log_mean for p in self.populations), plain)

    def note(self, text: str, evaluations: int = 0) -> SearchState:
        """The state with a line of history, and what it cost."""
        text = f"{text}, {evaluations} evaluations" if evaluations else text
        return self._replace(spent=self.spent + evaluations, history=(*self.history, text))

    def for_next_family(self) -> SearchState:
        """The state that a search of another family begins with."""
        return SearchState(spent=self.spent, history=self.history, plain=self.plain)

    def with_costs_of(self, other: SearchState) -> SearchState:
        """The state after ``other``, a search that began where this one ended."""
        return self._replace(spent=other.spent, history=other.history, plain=other.plain)

    def with_reason(self, reason: str) -> SearchState:
        """The state with a reason against the proposal."""
        return self._replace(reasons=(*self.reasons, reason))


class SearchContext(NamedTuple):
    """The random numbers of a search, and where it stands."""

    root: np.random.Generator
    rng: np.random.Generator
    latest: list[tuple[Family, SearchState]]
    """The family and the state after the last batch, for an interruption"""

    def keep(self, family: Family, state: SearchState) -> None:
        """The search stands here."""
        self.latest[:] = [(family, state)]

    def next_key(self) -> jax.Array:
        """A key for a population."""
        words = self.root.integers(2**32, size=2, dtype=np.uint32)
        return jax.random.wrap_key_data(words, impl="threefry2x32")


def search_context(key: jax.Array) -> SearchContext:
    """The `SearchContext` of a call."""
    root = numpy_generator(key, 1)
    return SearchContext(root, numpy_generator(SearchContext(root, root, []).next_key()), [])


class Family(Protocol):
    """A kind of proposals over the episodes of one system. Points are pytrees that only their
    family looks into.
    """

    name: str
    sim: Simulator
    budget: int
    batch: int
    """Episodes of a batch"""
    context: SearchContext
    settings: SearchSettings

    def draw(self, q: Any) -> Batch:
        """A `Batch` of the proposal ``q``."""

    def log_ratio(self, q: Any, points: Any) -> np.ndarray:
        """log q - log p [m] of the ``points`` [m]."""

    def refit(self, state: SearchState) -> dict[str, Any]:
        """Proposals that are fitted to the failures of all batches, by what they are called."""

    def absorb(self, state: SearchState, found: Sequence[tuple[Any, float]]) -> SearchState:
        """The proposal with components for each (points, share) of ``found``, whose probability is
        ``share`` times what it found.
        """

    def as_points(
        self, state: SearchState, z: np.ndarray, used: np.ndarray
    ) -> tuple[SearchState, Any]:
        """The points of failures that a population found, ``z`` [m, D] of which they ``used`` so
        many numbers; and the state, with what this costs.
        """

    def on_device(self, q: Any) -> Any:
        """``q`` as an `Estimate` has it."""

    def with_model(self, q: Any, share: float) -> Any:
        """``q`` on the device, with so great a ``share`` of the model."""

    def exclusion(self, q: Any, threshold: float) -> Any:
        """What keeps populations out of where log q - log p is above the ``threshold``."""


def add_batch(family: Family, state: SearchState, batch: Batch) -> SearchState:
    """The state with one more `Batch`: the weights of all failures, the probability by them, and
    of the proposals that have drawn the most efficient one.
    """
    batches = (*state.batches, batch)
    scored = []
    for q in _distinct(batches):
        here = -batch.log_weight if q is batch.q else family.log_ratio(q, batch.points)
        scored.append(Scored(q, np.concatenate([failure_log_ratios(family, state, q), here])))
    new = state._replace(batches=batches, scored=tuple(scored))
    over = np.stack([s.log_ratio for s in scored]) + _log_shares(new)[:, None]
    log_w = -np.logaddexp.reduce(over, axis=0)
    if len(log_w):
        log_mean = float(np.logaddexp.reduce(log_w) - math.log(new.size))
        new = new._replace(log_weight=log_w, log_mean=log_mean)
        each = [efficiency(new, s.log_ratio) for s in scored]
        best = int(np.argmax(each))
        new = new._replace(q=scored[best].q, efficiency=each[best])
    family.context.keep(family, new._replace(spent=state.spent + family.batch))
    return new


def efficiency(state: SearchState, log_ratio: np.ndarray) -> float:
    """Effective draws of a draw of a proposal that has this log q - log p [N] on the failures of
    all batches: P^2 / E_q[w^2], by these.
    """
    second = np.logaddexp.reduce(state.log_weight - log_ratio) - math.log(state.size)
    return math.exp(min(2 * state.log_mean - second, 0.0))


def failure_log_ratios(family: Family, state: SearchState, q: Any) -> np.ndarray:
    """log q - log p [N] of the failing points of all batches; computed once where the state holds
    ``q``.
    """
    for s in state.scored:
        if s.q is q:
            return s.log_ratio
    each = [-b.log_weight if b.q is q else family.log_ratio(q, b.points) for b in state.batches]
    return np.concatenate([*each, np.zeros(0)])


def pooled_log_ratio(family: Family, state: SearchState, points: Any) -> np.ndarray:
    """log q - log p [m] of ``points``, q being the mixture of the proposals of all batches."""
    each = [family.log_ratio(q, points) for q in _distinct(state.batches)]
    return np.logaddexp.reduce(np.stack(each) + _log_shares(state)[:, None])


def _distinct(batches):
    """The proposals of the batches, each once."""
    return tuple({id(b.q): b.q for b in batches}.values())


def _log_shares(state):
    """Logs of the shares of all episodes that each of the `_distinct` proposals has drawn."""
    sizes = [sum(b.size for b in state.batches if b.q is q) for q in _distinct(state.batches)]
    return np.log(sizes) - math.log(state.size)


def is_efficient(state: SearchState, least: float) -> bool:
    """Whether the efficiency of the proposal is above ``least``, and above that of the model."""
    plain = math.exp(min(state.log_mean, 0.0))
    return state.q is not None and state.efficiency > max(least, NO_BETTER * plain)
