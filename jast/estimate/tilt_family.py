"""Proposals that are mixtures of the model and a few tilts of each step's own disturbance.

Tilts are fitted by cross-entropy to the failures of all batches, and stand in the mixture beside
their halves, so that no weight is without variance.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jast.estimate.gaussians import effective, tempered
from jast.estimate.markov_tilts import Shape, Tilts, Trace, features, of_the_model, played, shape
from jast.estimate.search_settings import SETTINGS, SearchSettings
from jast.estimate.search_state import Batch, Chance, State
from jast.estimate.tilt_fit import (
    Tilt,
    as_tilts,
    fit,
    frame_of,
    nothing,
    of_tilts,
    ratios,
    scaled,
    steps_of,
    unseen,
)
from jast.limit_state import normal_numbers
from jast.simulator import Simulator

__all__ = ["Mixture", "Play", "Points", "TiltFamily", "of_level"]

COMPONENTS = (3, 5, 9)
"""How many a mixture is made up to, so that programs are compiled once."""
HELD = 2e7
"""Numbers of a batch that are held."""


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
    frame: Any


class Play(NamedTuple):
    """Episodes that a mixture has drawn, failing or not. On the host."""

    points: Points
    score: np.ndarray
    """[n] miss distance; -inf for a failure"""
    log_weight: np.ndarray
    """[n] log p - log q"""
    invalid: int


class TiltFamily(NamedTuple):
    """Mixtures of the model and a few tilts: a `Family`."""

    sim: Simulator
    budget: int
    chance: Chance
    settings: SearchSettings = SETTINGS
    gates: int = 1
    """Gaussians that a normal number is drawn from one of"""
    widest: int = COMPONENTS[1]
    """Components, beyond which no tilt is added"""
    name: str = "tilts"

    @property
    def about(self) -> Shape:
        """What the system's steps are made of."""
        return shape(self.sim)

    @property
    def batch(self) -> int:
        """Episodes of a batch: fewer where they are so long that memory would not hold them."""
        a = self.about
        a_step = a.seen + a.normals + a.choices * (1 + a.categories)
        most = HELD / (a_step * self.sim.horizon) + 100
        return int(min(max(self.budget // 50, min(self.budget // 20, 2000)), most))

    @property
    def model(self) -> Tilt:
        """The model as a tilt."""
        frame, seen = unseen(self.about, self.sim.horizon), np.zeros((1, self.about.seen))
        return nothing(self.about, features(frame, seen, 0.0, np).shape[1], self.gates)

    def untilted(self) -> Mixture:
        """The model alone."""
        return Mixture([self.model], [1.0], unseen(self.about, self.sim.horizon))

    def near(self, q: Tilts) -> tuple[TiltFamily, Mixture]:
        """The proposal of a similar system, and the family that it is of."""
        tilts, weights, frame = of_tilts(q)
        weights = weights * (1 - self.settings.model) / weights[1:].sum()
        weights[0] = self.settings.model
        return self._replace(gates=q.steps.means.shape[-1]), Mixture(tilts, list(weights), frame)

    def on_device(self, q: Mixture) -> Tilts:
        """``q`` as programs and an `Estimate` have it."""
        size = next(c for c in COMPONENTS if c >= len(q.tilts))
        return as_tilts(*q, size, normal_numbers(self.sim))

    def with_model(self, q: Mixture, share: float) -> Tilts:
        """The same, of which the model has so great a ``share``."""
        weights = np.asarray(q.weights) * (1 - share) / (1 - q.weights[0])
        weights[0] = share
        return self.on_device(q._replace(weights=list(weights)))

    def play(self, q: Mixture) -> Play:
        """A batch of ``q``."""
        n, a, dtype = self.batch, self.about, normal_numbers(self.sim)
        of, rng = lambda v: np.asarray(v, dtype), self.chance.rng
        chance = lambda a, b, *size: (
            of(rng.standard_normal((*size, a), np.float32)),
            of(rng.random((*size, a), np.float32)),
            of(rng.random((*size, b))),
        )
        first = chance(a.normals0, a.choices0, n)
        noise = chance(a.normals, a.choices, self.sim.horizon, n)
        tilts = self.on_device(q)
        o, ratio, trace = played(self.sim, tilts, of(rng.random(n)), first, noise)
        joint = ratio.astype(np.float64) + np.asarray(tilts.log_weights, np.float64)[None]
        log_w, points = -np.logaddexp.reduce(joint, axis=1), Points(trace, np.asarray(o.length))
        return Play(points, np.asarray(o.score), log_w, int(np.sum(o.invalid)))

    def draw(self, q: Mixture) -> Batch:
        """A `Batch` of ``q``."""
        return of_level(self, q, self.play(q), -np.inf)

    def log_ratio(self, q: Mixture, points: Points) -> np.ndarray:
        """log q - log p [m]."""
        return np.logaddexp.reduce(self._joint(q, points), axis=1)

    def play_again(self, z: Any) -> tuple[np.ndarray, Points]:
        """Episodes of the model by their numbers of chance ``z`` [n, D]: which of them fail, and
        their `Points`.
        """
        z = np.asarray(z, normal_numbers(self.sim))
        o, _, trace = of_the_model(self.sim, self.on_device(self.untilted()), z)
        return o.score == -np.inf, Points(trace, np.asarray(o.length))

    def points_of(self, state: State, z: Any, used: Any) -> tuple[State, Points]:
        """`Points` of the failing episodes of ``z`` [m, D], which are played again for it."""
        failing, points = self.play_again(z)
        return state._replace(spent=state.spent + len(z)), self.rows(points, failing)

    def rows(self, points: Points, rows: np.ndarray) -> Points:
        """Some of the ``points``."""
        return Points(only(points.trace, rows), points.length[rows])

    def left_out(self, q: Mixture, threshold: float) -> tuple[Tilts, float]:
        """What keeps populations out of where log q - log p is above the ``threshold``."""
        return self.on_device(q), threshold

    def refit(self, state: State) -> dict[str, Mixture]:
        """The mixture that is fitted to the failures of all batches."""
        points = joined([b.points for b in state.batches])
        return {"refitted": self.fitted(points, state.log_weight, self.groups(state.q, points))}

    def absorbed(self, state: State, points: Points, share: float) -> State:
        """The proposal with a tilt of their own for ``points``, which carry ``share`` of what it
        found.
        """
        if len(state.q.tilts) >= self.widest:
            return state
        n, before = len(points.length), joined([b.points for b in state.batches])
        log_w = state.log_weight - np.logaddexp.reduce(state.log_weight)
        groups = self.groups(state.q, before)
        groups = np.ones((len(log_w), 1)) if groups is None else groups
        own = np.repeat([[0.0], [1.0]], [len(log_w), n], axis=0)
        of = np.concatenate([np.pad(groups, ((0, n), (0, 0))), own], axis=1)
        log_w = np.concatenate([log_w, np.full(n, math.log(share / n))])
        return state._replace(q=self.fitted(joined([before, points]), log_w, of))

    def groups(self, q: Mixture, points: Points) -> np.ndarray | None:
        """Which part [m, M] of each of the ``points`` belongs to each group of the tilts of ``q``;
        None where there is one.
        """
        if len(q.tilts) <= 3:
            return None
        joint = self._joint(q, points)[:, 1:]
        r = np.exp(joint - joint.max(axis=1, keepdims=True))
        r = r.reshape(len(r), -1, 2).sum(axis=2)
        return r / r.sum(axis=1, keepdims=True)

    def _joint(self, q, points):
        rows = steps_of(self.about, q.frame, *points)
        with np.errstate(divide="ignore"):
            return ratios(q.tilts, rows, len(points.length)) + np.log(q.weights)[None]

    def fitted(self, points: Points, log_w: np.ndarray, of: np.ndarray | None = None) -> Mixture:
        """The mixture of the model and a tilt for each group of weighted ``points``; ``of`` [m, M]:
        what part of each of them belongs to each group.
        """
        of = np.ones((len(log_w), 1)) if of is None else of
        w, model = np.exp(log_w - log_w.max()), self.model
        frame = frame_of(self.about, *points, np.sqrt(w))
        rows = steps_of(self.about, frame, *points)
        s = self.settings
        masses = np.maximum(w @ of / w.sum(), s.group_least)
        tilts, weights = [model], [s.model]
        for part, mass in zip(of.T, masses / masses.sum(), strict=True):
            with np.errstate(divide="ignore"):
                own = np.maximum(log_w + np.log(part), log_w.max() - 500)
            power = tempered(own, min(s.tempered, 0.3 * part.sum()))
            v = np.exp(power * (own - own.max()))
            one = fit(rows, v, effective(power * own), model)
            tilts += [one, scaled(one, s.halfway)]
            weights += [mass * (1 - s.model - s.defensive), mass * s.defensive]
        return Mixture(tilts, weights, frame)


def of_level(family: TiltFamily, q: Mixture, p: Play, level: float) -> Batch:
    """Those of the episodes of a `Play` of ``q`` that come to ``level``, as a `Batch`: at most
    `kept`, evenly counted.
    """
    near = np.flatnonzero(p.score <= level)
    rows = near[: family.settings.kept]
    size = len(p.score) * len(rows) // len(near) if len(near) else len(p.score)
    return Batch(q, family.rows(p.points, rows), p.log_weight[rows], size, p.invalid)


def only(trace: Trace, rows: np.ndarray) -> Trace:
    """The traces of ``rows``."""
    return Trace(*(a[rows] for a in trace[:3]), *(a[:, rows] for a in trace[3:]))


def joined(points: list[Points]) -> Points:
    """All ``points``."""
    each = list(zip(*(p.trace for p in points), strict=True))
    first, steps = (
        [np.concatenate(a, axis=i) for a in part] for i, part in enumerate((each[:3], each[3:]))
    )
    return Points(Trace(*first, *steps), np.concatenate([p.length for p in points]))
