"""Proposals that are mixtures of the model and a few tilts of each step's own disturbance.

Tilts are fitted by cross-entropy to the failures of all batches, and stand in the mixture beside
their halves, so that no weight is without variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size, tempering_power
from jast._src.estimate.proposal_search.search_state import Batch, SearchContext, SearchState
from jast._src.estimate.proposal_search.settings import SETTINGS, SearchSettings
from jast._src.estimate.tilts.fit import (
    Tilt,
    as_tilts,
    fit_tilt,
    frame_of,
    log_ratios,
    model_tilt,
    of_tilts,
    scale_tilt,
    steps_of,
    unseen_frame,
)
from jast._src.estimate.tilts.tilts import (
    Frame,
    Shape,
    Tilts,
    Trace,
    shape,
    simulate_points,
    simulate_tilts,
    step_numbers,
)
from jast._src.normal_space.transform import normal_numbers
from jast._src.util.pytrees import index_tree, join_rows

__all__ = ["Mixture", "Points", "TiltFamily", "at_level"]

COMPONENTS = (3, 5, 9)  # sizes that mixtures are padded to, so that programs are compiled once
HELD = 2e7  # numbers of a batch that memory holds
LEAST_BATCH = 100  # episodes, however long
BATCHES = 50  # of a budget
BATCHES_OF_SMALL = 20  # of a small one, whose batches have no more than
SMALL_BATCH = 2000  # episodes
TEMPERED_PART = 0.3  # of the failures of a group, that weights are tempered to at most
LEAST_LOG_WEIGHT = 500  # nats below the greatest one, where a failure is of another group


class Points(NamedTuple):
    """Episodes by what tilts need of them."""

    trace: Trace
    """[m]"""
    length: np.ndarray
    """[m] steps"""


class Mixture(NamedTuple):
    """The model and some tilts, on the host."""

    tilts: list[Tilt]
    weights: list[float]
    frame: Frame


class Play(NamedTuple):
    """Episodes that a mixture has drawn, failing or not. On the host."""

    points: Points
    score: np.ndarray
    """[n] miss distance; -inf for a failure"""
    log_weight: np.ndarray
    """[n] log p - log q"""


class TiltFamily(NamedTuple):
    """Mixtures of the model and a few tilts: a `Family`, which says what
    its methods do.
    """

    sim: Simulator
    budget: int
    context: SearchContext
    settings: SearchSettings = SETTINGS
    components_each: int = 1
    """Gaussians in the mixture that a normal number is drawn from"""
    name: str = "tilts"

    @property
    def about(self) -> Shape:
        """What the system's steps are made of."""
        return shape(self.sim)

    @property
    def batch(self) -> int:
        """Episodes of a batch: fewer where they are so long that memory would not hold them."""
        small = min(self.budget // BATCHES_OF_SMALL, SMALL_BATCH)
        return min(max(self.budget // BATCHES, small), self.most)

    @property
    def most(self) -> int:
        """Episodes that memory holds."""
        normals, choices, categories, _ = self.about.steps
        a_step = self.about.seen + normals + choices * (1 + categories)
        return int(HELD / (a_step * self.sim.horizon) + LEAST_BATCH)

    @property
    def kept(self) -> float:
        """The part of each choice that a tilt leaves as the model has it."""
        first, steps, _ = self.about
        n = max(first.choices + self.sim.horizon * steps.choices, 1)
        return min(self.settings.kept_choices / n, self.settings.kept_share_most)

    @property
    def model(self) -> Tilt:
        """The model as a tilt."""
        return model_tilt(self.about, self.components_each)

    def untilted(self) -> Mixture:
        """The model alone."""
        return Mixture([self.model], [1.0], unseen_frame(self.about))

    def near(self, q: Tilts) -> tuple[TiltFamily, Mixture]:
        """The proposal of a similar system, and the family that it is of."""
        tilts, weights, frame = of_tilts(q)
        weights = weights * (1 - self.settings.model_share) / weights[1:].sum()
        weights[0] = self.settings.model_share
        family = self._replace(components_each=q.steps.means.shape[-1])
        return family, Mixture(tilts, list(weights), frame)

    def on_device(self, q: Mixture) -> Tilts:
        size = next(c for c in COMPONENTS if c >= len(q.tilts))
        return as_tilts(*q, size, normal_numbers(self.sim))

    def with_model(self, q: Mixture, share: float) -> Tilts:
        weights = np.asarray(q.weights) * (1 - share) / (1 - q.weights[0])
        weights[0] = share
        return self.on_device(q._replace(weights=list(weights)))

    def play(self, q: Mixture) -> Play:
        """A batch of ``q``."""
        n, a, rng = self.batch, self.about, self.context.rng
        draw = partial(step_numbers, rng, normal_numbers(self.sim), precision=np.float32)
        first, noise = draw(a.first, n), draw(a.steps, self.sim.horizon, n)
        u = rng.random(n).astype(normal_numbers(self.sim))
        tilts = self.on_device(q)
        o, ratio, trace = simulate_tilts(self.sim, tilts, u, first, noise)
        joint = ratio.astype(np.float64) + np.asarray(tilts.log_weights, np.float64)[None]
        log_w, points = -np.logaddexp.reduce(joint, axis=1), Points(trace, np.asarray(o.length))
        return Play(points, np.asarray(o.score), log_w)

    def draw(self, q: Mixture) -> Batch:
        return at_level(self, q, self.play(q), -np.inf)

    def log_ratio(self, q: Mixture, points: Points) -> np.ndarray:
        return np.logaddexp.reduce(self._joint(q, points), axis=1)

    def play_again(self, z: Any) -> tuple[np.ndarray, Points]:
        """Episodes of the model by their random numbers ``z`` [n, D]: which of them fail, and their
        `Points`.
        """
        z = np.asarray(z, normal_numbers(self.sim))
        o, _, trace = simulate_points(self.sim, self.on_device(self.untilted()), z)
        return o.score == -np.inf, Points(trace, np.asarray(o.length))

    def as_points(self, state: SearchState, z: Any, used: Any) -> tuple[SearchState, Points]:
        """`Points` of the failing episodes of ``z`` [m, D], which are played again for it."""
        failing, points = self.play_again(z)
        return state._replace(spent=state.spent + len(z)), index_tree(points, failing)

    def exclusion(self, q: Mixture, threshold: float) -> tuple[Tilts, float]:
        return self.on_device(q), threshold

    def refit(self, state: SearchState) -> dict[str, Mixture]:
        """The mixture that is fitted to the failures of all batches."""
        points = join_rows(*(b.points for b in state.batches))
        return {"refitted": self.fit(points, state.log_weight, self.groups(state.q, points))}

    def absorb(self, state: SearchState, found: Sequence[tuple[Points, float]]) -> SearchState:
        """The proposal with tilts of their own for the points of each of ``found``, whose
        probability is a share, as great, times what it found; as many as there is room for.
        """
        found = found[: (COMPONENTS[-1] - len(state.q.tilts)) // 2]
        points = join_rows(*(b.points for b in state.batches))
        log_w = state.log_weight - np.logaddexp.reduce(state.log_weight)
        of = self.groups(state.q, points)
        for more, share in found:
            n = len(more.length)
            own = np.repeat([[0.0], [1.0]], [len(log_w), n], axis=0)
            of = np.concatenate([np.pad(of, ((0, n), (0, 0))), own], axis=1)
            log_w = np.concatenate([log_w, np.full(n, math.log(share / n))])
            points = join_rows(points, more)
        return state._replace(q=self.fit(points, log_w, of)) if found else state

    def groups(self, q: Mixture, points: Points) -> np.ndarray:
        """Which part [m, M] of each of the ``points`` belongs to each group of the tilts of ``q``:
        all where there is one.
        """
        if len(q.tilts) <= 3:
            return np.ones((len(points.length), 1))
        joint = self._joint(q, points)[:, 1:]
        r = np.exp(joint - joint.max(axis=1, keepdims=True))
        r = r.reshape(len(r), -1, 2).sum(axis=2)
        return r / r.sum(axis=1, keepdims=True)

    def _joint(self, q, points):
        # as the program that draws them: half the time of double precision, or less
        rows = steps_of(self.about, q.frame, *points, normal_numbers(self.sim))
        with np.errstate(divide="ignore"):
            return log_ratios(q.tilts, rows, len(points.length)) + np.log(q.weights)[None]

    def fit(self, points: Points, log_w: np.ndarray, of: np.ndarray | None = None) -> Mixture:
        """The mixture of the model and a tilt for each group of weighted ``points``; ``of`` [m, M]:
        what part of each of them belongs to each group.
        """
        of = np.ones((len(log_w), 1)) if of is None else of
        w, model = np.exp(log_w - log_w.max()), self.model
        frame = frame_of(self.about, *points, np.sqrt(w))
        rows = steps_of(self.about, frame, *points)
        s, wide = self.settings, self.settings.defensive_share
        masses = np.maximum(w @ of / w.sum(), s.group_share_least)
        tilts, weights = [model], [s.model_share]
        for part, mass in zip(of.T, masses / masses.sum(), strict=True):
            with np.errstate(divide="ignore"):
                own = np.maximum(log_w + np.log(part), log_w.max() - LEAST_LOG_WEIGHT)
            power = tempering_power(own, min(s.tempered_size, TEMPERED_PART * part.sum()))
            v = np.exp(power * (own - own.max()))
            one = fit_tilt(rows, v, effective_sample_size(power * own), model)
            one = one._replace(kept=self.kept)
            tilts += [one, scale_tilt(one, s.defensive_scale)]
            weights += [mass * (1 - s.model_share - wide), mass * wide]
        return Mixture(tilts, weights, frame)


def at_level(family: TiltFamily, q: Mixture, p: Play, level: float) -> Batch:
    """Those of the episodes of a `Play` of ``q`` that come to ``level``, as a `Batch`: at most
    `failures_kept`, evenly counted.
    """
    near = np.flatnonzero(p.score <= level)
    rows = near[: family.settings.failures_kept]
    size = len(p.score) * len(rows) // len(near) if len(near) else len(p.score)
    return Batch(q, index_tree(p.points, rows), p.log_weight[rows], size)
