"""Proposals that are mixtures of Gaussians over the normal numbers of an episode.

They are fitted by cross-entropy to the failures of all batches: one mixture for all, one with parts
for each mode, or Gaussians that differ from the model in a few numbers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jast import limit_state as latent
from jast.estimate.batches import drawn, log_ratio, numbers
from jast.estimate.design_points import distinct
from jast.estimate.gaussians import (
    Gaussians,
    as_latent,
    effective,
    fit,
    held,
    nearest,
    tempered,
    to_anchors,
    together,
    unit,
)
from jast.estimate.search_settings import SETTINGS, SearchSettings
from jast.estimate.search_state import Batch, Chance, State

__all__ = ["GaussianFamily", "Points", "defended"]


NOTHING = 1e-6
"""Mass of a mode that is rounding alone."""


class Points(NamedTuple):
    """Points of normal numbers."""

    z: np.ndarray
    """[m, D]"""
    used: np.ndarray
    """[m] how many of the numbers decided the episode"""


class GaussianFamily(NamedTuple):
    """Mixtures of Gaussians over the normal numbers of an episode: a `Family`."""

    sim: Any
    budget: int
    chance: Chance
    settings: SearchSettings = SETTINGS
    name: str = "Gaussians"

    @property
    def batch(self) -> int:
        """Episodes of a batch."""
        return self.budget // 25

    @property
    def dimension(self) -> int:
        """D."""
        return latent.dimension(self.sim)

    @property
    def dtype(self) -> Any:
        """Of the normal numbers."""
        return latent.normal_numbers(self.sim)

    @property
    def chains(self) -> int:
        """Markov chains that the budget affords."""
        s = self.settings
        return int(np.clip(self.budget // s.chain_of, s.chains_least, s.chains))

    @property
    def directions(self) -> int:
        """That a proposal can hold, each by two components, beside the model."""
        return max(min(self.chains, (held(self.dimension) - 1) // 2), self.settings.dense)

    def model(self) -> latent.Latent:
        """The model itself as a proposal."""
        return as_latent([(1.0, unit(np.zeros((1, self.dimension))))], self.dtype)

    def draw(self, q: latent.Latent) -> Batch:
        """A `Batch` of ``q``."""
        chance = numbers(self.chance.rng, self.batch, self.dimension, self.dtype)
        z, o, log_w, _ = drawn(self.sim, q, *chance)
        points = Points(z[o.failure], np.asarray(o.used)[o.failure])
        return Batch(q, points, log_w[o.failure], self.batch, int(np.sum(o.invalid)))

    def log_ratio(self, q: latent.Latent, points: Points) -> np.ndarray:
        """log q - log p [m]."""
        return log_ratio(q, points.z, points.used)

    def points_of(self, state: State, z: Any, used: Any) -> tuple[State, Points]:
        """`Points` of failing ones."""
        return state, Points(np.asarray(z), np.asarray(used))

    def rows(self, points: Points, rows: np.ndarray) -> Points:
        """Some of the ``points``."""
        return Points(points.z[rows], points.used[rows])

    def on_device(self, q: latent.Latent) -> latent.Latent:
        """``q`` as an `Estimate` has it."""
        return q

    def with_model(self, q: latent.Latent, share: float) -> latent.Latent:
        """The same, of which the model has so great a ``share``."""
        return together(q, self.model(), share)

    def left_out(self, q: latent.Latent, threshold: float) -> tuple[latent.Latent, float] | None:
        """What keeps populations out of where log q - log p is above the ``threshold``; None, which
        costs no densities, for one that is infinite.
        """
        return None if threshold == math.inf else (q, threshold)

    def absorbed(self, state: State, points: Points, share: float) -> State:
        """The proposal with a mixture fitted to ``points``, which carry ``share`` of what it
        found.
        """
        g, least = self.of_population(points), self.settings.unknown
        return self.added(
            state, g, min(max(share / (1 + share), least), 1 - least), rare(self, state)
        )

    def added(self, state: State, g: Gaussians, share: float | None, rare: bool) -> State:
        """The proposal with the `Gaussians` ``g`` for ``share`` of it; None: in place of it."""
        new = as_latent(defended(g, self.settings.narrowest, rare, self.settings), self.dtype)
        return state._replace(q=new if share is None else together(state.q, new, share))

    def of_population(self, points: Points) -> Gaussians:
        """`Gaussians` of a population, whose members are not independent: so they count for a fifth
        in all, and for a twentieth as to covariances.
        """
        n = len(points.z)
        weights = np.full(n, 1 / n)
        return fit(self.chance.rng, self.filled(points), weights, n / 5, n / 20)

    def filled(self, points: Points) -> np.ndarray:
        """The points with the numbers that decided nothing drawn anew from the model, which is what
        they are given the failure.
        """
        z = points.z.astype(np.float64)
        decided = np.arange(self.dimension)[None] < points.used[:, None]
        return np.where(decided, z, self.chance.rng.standard_normal(z.shape))

    def centres(self, q: latent.Latent) -> np.ndarray:
        """The distinct means of a proposal [m, D]."""
        heavy = np.asarray(q.log_weights) > math.log(
            self.settings.direction_least / self.directions
        )
        return distinct(np.asarray(q.means, np.float64)[heavy], self.directions)

    def refit(self, state: State) -> dict[str, latent.Latent]:
        """Mixtures fitted to the failures of all batches, by name."""
        log_w, centres = state.log_weight, self.centres(state.q)
        points = self.filled(Points(*map(np.concatenate, zip(*(b.points for b in state.batches)))))
        owner = nearest(points, centres)
        many = np.bincount(owner, minlength=len(centres)) >= self.settings.direction_failures
        owner = nearest(points, centres[many]) if many.any() else np.zeros_like(owner)
        choices = {}
        few = self.settings.direction_failures
        dense = len(centres) <= self.settings.dense
        if dense or effective(log_w) > few * self.dimension * len(centres):
            choices["modes"] = _by_owner(self, state, points, owner)
        if len(centres) > self.settings.dense:
            choices["sparse"] = _sparse(self, state, points, centres)
        if "modes" not in choices or owner.any():
            choices["one"] = _by_owner(self, state, points, np.zeros_like(owner))
        return choices


def rare(family: GaussianFamily, state: State) -> bool:
    """Whether failures are, as far as anything tells."""
    return state.log_p < math.log(family.settings.rare)


def _by_owner(f, state, points, owner):
    """A `Latent`: Gaussians fitted to the points of each owner apart."""
    log_w, owners = state.log_weight, np.unique(owner)
    parts, w = [], np.exp(log_w - log_w.max())
    s = f.settings
    least = min(s.direction_least, s.directions_least / len(owners))
    for i in owners:
        rows = np.flatnonzero(owner == i)
        mass = w[rows].sum() / w.sum()
        if mass < NOTHING:
            continue
        # few great weights would make a mixture fit their own noise: a power below 1 of them leads
        # the same way, in more batches
        power = tempered(log_w[rows], min(max(s.tempered, 5 * f.dimension), 0.5 * len(rows)))
        v = np.exp(power * (log_w[rows] - log_w[rows].max()))
        g = fit(
            f.chance.rng,
            points[rows],
            v / v.sum(),
            v.sum() ** 2 / (v**2).sum(),
            limit=max(s.dense // len(owners), 2),
            anchors=state.anchors,
        )
        parts.append(g._replace(weights=g.weights * max(mass, least)))
    return as_latent(
        defended(
            Gaussians(*(np.concatenate(each) for each in zip(*parts, strict=True))),
            0.0,
            rare(f, state),
            f.settings,
        ),
        f.dtype,
    )


def _sparse(f, state, points, centres):
    """A `Latent`: a Gaussian for each of ``centres`` [m, D] that differs from the model in a few
    directions alone, which few points tell: those numbers that the centre's anchor needs, or where
    these are many the direction of the mean.
    """
    log_w, owner = state.log_weight, nearest(points, centres)
    means, masses = centres.copy(), np.zeros(len(centres))
    values, vectors = np.ones_like(centres), np.repeat(np.eye(f.dimension)[None], len(centres), 0)
    anchors = state.anchors if len(state.anchors) else centres
    of = nearest(centres, anchors)
    for i in np.unique(owner):
        own, z = log_w[owner == i], points[owner == i]
        masses[i] = np.exp(own - log_w.max()).sum()
        v, n = np.exp(own - own.max()), effective(own)
        v /= v.sum()
        on = anchors[of[i]] != 0
        if 0 < on.sum() <= f.settings.sparse:
            means[i] = 0.0
            means[i, on] = to_anchors(v @ z[:, on], n, anchors[of[i], on][None])
            spread = v @ (z[:, on] - means[i, on]) ** 2
        else:
            means[i] = to_anchors(v @ z, n, anchors)
            vectors[i] = np.linalg.qr(means[i][:, None], mode="complete").Q
            on = np.arange(f.dimension) == 0
            spread = v @ ((z - means[i]) @ vectors[i, :, on].T) ** 2
        prior = f.settings.prior
        values[i, on] = (n * spread + prior) / (n + prior)
    g = Gaussians(_masses(masses, effective(log_w), f.settings.prior_share), means, values, vectors)
    return as_latent(defended(g, 0.0, rare(f, state), f.settings), f.dtype)


def _masses(mass, n, prior):
    """Shares of modes that weigh ``mass`` [m] by ``n`` effective draws: as if each had been met by
    ``prior`` more.
    """
    m = len(mass)
    return (n * mass / mass.sum() + prior) / (n + m * prior)


def defended(g, low, rare, settings=SETTINGS):
    """[(share, Gaussians), ...]: ``g``, its wide copies, and where failures are not rare the
    model.
    """
    d, model = g.means.shape[1], 0.0 if rare else settings.model
    wide, wide_share = g._replace(values=np.maximum(g.values, 1.0)), settings.defensive
    parts = (
        [(1 - wide_share - model, g._replace(values=np.maximum(g.values, low))), (wide_share, wide)]
        if (g.values < 1).any()
        else [(1 - model, g)]
    )
    return [*parts, (model, unit(np.zeros((1, d))))] if model else parts
