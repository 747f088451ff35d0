"""Proposals that are mixtures of Gaussians over the normal numbers of an episode.

They are fitted by cross-entropy to the failures of all batches: one mixture for all, one with parts
for each mode, or Gaussians that differ from the model in a few numbers.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.estimate.gaussians.design_points import distinct
from jast._src.estimate.gaussians.mixture_fit import (
    Gaussians,
    as_latent,
    effective_sample_size,
    fit_mixture,
    mix,
    most_components,
    nearest_centre,
    shrink_to_anchors,
    tempering_power,
    unit_gaussians,
)
from jast._src.estimate.proposal_search.mixture_draws import draw_mixture, log_ratio, random_numbers
from jast._src.estimate.proposal_search.search_state import Batch, SearchContext, SearchState
from jast._src.estimate.proposal_search.settings import SETTINGS, SearchSettings
from jast._src.normal_space import transform

__all__ = ["GaussianFamily", "Points", "defensive_parts"]

BATCHES = 25  # of a budget: half of it for batches, at most, leaves as much for the estimate
NOTHING = 1e-6  # mass of a direction that is rounding alone
PER_POINT = 5  # members of a population, which are not independent, that count as one point
PER_POINT_OF_COVARIANCE = 20  # the same as to covariances
TEMPERED_EACH = 5  # effective failures of a fit for each dimension, at the least
TEMPERED_PART = 0.5  # of the failures of a direction, that weights are tempered to at most
LEAST_COMPONENTS = 2  # that a direction may have


class Points(NamedTuple):
    """Points of normal numbers."""

    z: np.ndarray
    """[m, D]"""
    used: np.ndarray
    """[m] how many of the numbers decided the episode"""


class GaussianFamily(NamedTuple):
    """Mixtures of Gaussians over the normal numbers of an episode: a `Family`, which says what
    its methods do.
    """

    sim: Simulator
    budget: int
    context: SearchContext
    settings: SearchSettings = SETTINGS
    name: str = "Gaussians"

    @property
    def batch(self) -> int:
        """Episodes of a batch."""
        return self.budget // BATCHES

    @property
    def dimension(self) -> int:
        """D."""
        return transform.dimension(self.sim)

    @property
    def dtype(self) -> Any:
        """Of the normal numbers."""
        return transform.normal_numbers(self.sim)

    @property
    def chains(self) -> int:
        """Markov chains that the budget affords."""
        s = self.settings
        return int(np.clip(self.budget // s.evaluations_per_chain, s.chains_least, s.chains_most))

    @property
    def directions(self) -> int:
        """That a proposal can hold, each by two components, beside the model."""
        held = (most_components(self.dimension) - 1) // 2
        return max(min(self.chains, held), self.settings.dense_directions)

    def model(self) -> transform.Latent:
        """The model itself as a proposal."""
        return as_latent([(1.0, unit_gaussians(np.zeros((1, self.dimension))))], self.dtype)

    def draw(self, q: transform.Latent) -> Batch:
        numbers = random_numbers(self.context.rng, self.batch, self.dimension, self.dtype)
        z, o, log_w, _ = draw_mixture(self.sim, q, *numbers)
        points = Points(z[o.failure], np.asarray(o.used)[o.failure])
        return Batch(
            q=q,
            points=points,
            log_weight=log_w[o.failure],
            size=self.batch,
            invalid=int(np.sum(o.invalid)),
        )

    def log_ratio(self, q: transform.Latent, points: Points) -> np.ndarray:
        return log_ratio(q, points.z, points.used)

    def as_points(self, state: SearchState, z: Any, used: Any) -> tuple[SearchState, Points]:
        """`Points` of failing ones, at no cost."""
        return state, Points(np.asarray(z), np.asarray(used))

    def on_device(self, q: transform.Latent) -> transform.Latent:
        return q

    def with_model(self, q: transform.Latent, share: float) -> transform.Latent:
        return mix(q, self.model(), share)

    def exclusion(
        self, q: transform.Latent, threshold: float
    ) -> tuple[transform.Latent, float] | None:
        """What keeps populations out of where log q - log p is above the ``threshold``; None, which
        costs no densities, for one that is infinite.
        """
        return None if threshold == math.inf else (q, threshold)

    def absorb(self, state: SearchState, found: Sequence[tuple[Points, float]]) -> SearchState:
        """The proposal with a mixture fitted to the points of each of ``found``, whose probability
        is a share, as great, times what it found.
        """
        least = self.settings.absorbed_share_least
        for points, share in found:
            part = min(max(share / (1 + share), least), 1 - least)
            state = self.add(state, self.of_population(points), part)
        return state._replace(planes=None)  # they do not have what was missing

    def add(self, state: SearchState, g: Gaussians, share: float | None) -> SearchState:
        """The proposal with the `Gaussians` ``g`` for ``share`` of it; None: in place of it."""
        new = self.defensive(state, g, self.settings.variance_least)
        return state._replace(q=new if share is None else mix(state.q, new, share))

    def defensive(self, state: SearchState, g: Gaussians, least: float = 0.0) -> transform.Latent:
        """The `Latent` of the `defensive_parts` of ``g``, with the model unless failures are rare,
        as far as anything tells.
        """
        rare = state.log_p < math.log(self.settings.rare_probability)
        return as_latent(defensive_parts(g, least, rare, self.settings), self.dtype)

    def of_population(self, points: Points) -> Gaussians:
        """`Gaussians` fitted to a population."""
        n = len(points.z)
        even = np.full(n, 1 / n)
        counts = n / PER_POINT, n / PER_POINT_OF_COVARIANCE
        return fit_mixture(self.context.rng, self.impute_unused(points), even, *counts)

    def impute_unused(self, points: Points) -> np.ndarray:
        """The points with the numbers that decided nothing drawn anew from the model, which is what
        they are given the failure.
        """
        z = points.z.astype(np.float64)
        decided = np.arange(self.dimension)[None] < points.used[:, None]
        return np.where(decided, z, self.context.rng.standard_normal(z.shape))

    def centres(self, q: transform.Latent) -> np.ndarray:
        """The distinct means of a proposal [m, D]."""
        least = math.log(self.settings.direction_share_least / self.directions)
        heavy = np.asarray(q.log_weights) > least
        return distinct(np.asarray(q.means, np.float64)[heavy], self.directions)

    def refit(self, state: SearchState) -> dict[str, transform.Latent]:
        """Mixtures fitted to the failures of all batches, by name."""
        log_w, centres = state.log_weight, self.centres(state.q)
        batches = zip(*(b.points for b in state.batches), strict=True)
        points = self.impute_unused(Points(*map(np.concatenate, batches)))
        owner = nearest_centre(points, centres)
        few = self.settings.direction_failures
        many = np.bincount(owner, minlength=len(centres)) >= few
        owner = nearest_centre(points, centres[many]) if many.any() else np.zeros_like(owner)
        choices = {}
        dense = len(centres) <= self.settings.dense_directions
        if dense or effective_sample_size(log_w) > few * self.dimension * len(centres):
            choices["modes"] = _fit_by_owner(self, state, points, owner)
        if not dense:
            choices["sparse"] = _fit_sparse(self, state, points, centres)
        if "modes" not in choices or owner.any():
            choices["one"] = _fit_by_owner(self, state, points, np.zeros_like(owner))
        return choices


def _fit_by_owner(f, state, points, owner):
    """A `Latent`: Gaussians fitted to the points of each owner apart."""
    log_w, owners = state.log_weight, np.unique(owner)
    parts, w = [], np.exp(log_w - log_w.max())
    s = f.settings
    least = min(s.direction_share_least, s.directions_share_least / len(owners))
    for i in owners:
        rows = np.flatnonzero(owner == i)
        mass = w[rows].sum() / w.sum()
        if mass < NOTHING:
            continue
        # few great weights would make a mixture fit their own noise: a power below 1 of them leads
        # the same way, in more batches
        size = max(s.tempered_size, TEMPERED_EACH * f.dimension)
        power = tempering_power(log_w[rows], min(size, TEMPERED_PART * len(rows)))
        v = np.exp(power * (log_w[rows] - log_w[rows].max()))
        g = fit_mixture(
            f.context.rng,
            points[rows],
            v / v.sum(),
            v.sum() ** 2 / (v**2).sum(),
            limit=max(s.dense_directions // len(owners), LEAST_COMPONENTS),
            anchors=state.anchors,
        )
        parts.append(g._replace(weights=g.weights * max(mass, least)))
    return f.defensive(state, Gaussians(*map(np.concatenate, zip(*parts, strict=True))))


def _fit_sparse(f, state, points, centres):
    """A `Latent`: a Gaussian for each of ``centres`` [m, D] that differs from the model in a few
    directions alone, which few points tell: those numbers that the centre's anchor needs, or where
    these are many the direction of the mean.
    """
    log_w, owner = state.log_weight, nearest_centre(points, centres)
    means, masses = centres.copy(), np.zeros(len(centres))
    values, vectors = np.ones_like(centres), np.repeat(np.eye(f.dimension)[None], len(centres), 0)
    anchors = state.anchors if len(state.anchors) else centres
    of = nearest_centre(centres, anchors)
    for i in np.unique(owner):
        own, z = log_w[owner == i], points[owner == i]
        masses[i] = np.exp(own - log_w.max()).sum()
        v, n = np.exp(own - own.max()), effective_sample_size(own)
        v /= v.sum()
        on = anchors[of[i]] != 0
        if 0 < on.sum() <= f.settings.sparse_numbers:
            means[i] = 0.0
            means[i, on] = shrink_to_anchors(v @ z[:, on], n, anchors[of[i], on][None])
            spread = v @ (z[:, on] - means[i, on]) ** 2
        else:
            means[i] = shrink_to_anchors(v @ z, n, anchors)
            vectors[i] = np.linalg.qr(means[i][:, None], mode="complete").Q
            on = np.arange(f.dimension) == 0
            spread = v @ ((z - means[i]) @ vectors[i, :, on].T) ** 2
        prior = f.settings.variance_prior
        values[i, on] = (n * spread + prior) / (n + prior)
    # shares as if each direction had been drawn `share_prior` times more
    n, prior = effective_sample_size(log_w), f.settings.share_prior
    shares = (n * masses / masses.sum() + prior) / (n + len(masses) * prior)
    return f.defensive(state, Gaussians(shares, means, values, vectors))


def defensive_parts(
    g: Gaussians, least: float, rare: bool, settings: SearchSettings = SETTINGS
) -> list[tuple[float, Gaussians]]:
    """[(share, Gaussians), ...]: ``g`` with variances of ``least`` or more, its wide copies, and
    the model where failures are not ``rare``.
    """
    model, wide = 0.0 if rare else settings.model_share, settings.defensive_share
    if (g.values < 1).any():
        narrow = g._replace(values=np.maximum(g.values, least))
        parts = [(1 - wide - model, narrow), (wide, g._replace(values=np.maximum(g.values, 1.0)))]
    else:
        parts = [(1 - model, g)]
    return [*parts, (model, unit_gaussians(np.zeros((1, g.means.shape[1]))))] if model else parts
