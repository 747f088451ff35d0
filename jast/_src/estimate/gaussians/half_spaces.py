"""Half-spaces of failure, and the mixtures of Gaussians that draw from them.

The probability of half-spaces is a sum that counts some failures twice; draws of a mixture of the
model within each, weighed by all of it, count them once (importance sampling of a union of rare
events: Owen, Maximov and Chertkov 2019; of several design points: Au and Beck 2001). Here each is a
Gaussian of the model's mean and variance beyond its plane, with a wide copy, and weighted failures
tell by how much those of a system that is not linear are spread more widely.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from jast._src.estimate.gaussians.mixture_fit import (
    effective_sample_size,
    latent_along,
    most_components,
)
from jast._src.estimate.proposal_search.settings import SETTINGS
from jast._src.normal_space.moments import Linearised
from jast._src.normal_space.transform import Latent
from jast._src.util.pytrees import index_tree

__all__ = [
    "Planes",
    "first_layers",
    "fit_layers",
    "layers_as_latent",
    "likely",
    "merge_planes",
    "no_planes",
    "planes_of",
    "that_matter",
]

LITTLE = 1e-3
"""Part of the greatest probability of a half-space, below which one is left out: a hundred of them
are then a tenth."""
SAME = 0.9
"""Cosine above which two half-spaces of a moment are one."""
ALIKE = 0.97
"""Cosine above which the less likely of two is left out: of the drone of `benchmarks.closed_loops`
(key 0, 5000 evaluations) 24 stay of 128, and batches of 200 have effective sample sizes of 70, 58
and 42 in place of 32, 10 and 29."""
SPREAD = 2.0
"""Factor on the variance beyond a plane: with it, and a fifth of wide copies at the same place, .45
effective draws a draw where the plane is right, .21 where the boundary is .3 standard deviations
nearer, .03 where it is .9 nearer (one dimension, 4.2 standard deviations out, by quadrature; with a
factor of 1 the first two are .54 and .12). A fit to draws may bring the factor back to 1."""
WIDE_SHARE = 0.3
"""Share of the wide copies. With it and the next number these are some .4, .21 and .065."""
WIDE_NEARER = 0.5
"""How much nearer than its plane a wide copy lies."""
PRIOR = 20.0
"""Failures that half-spaces as they were found count for beside those that were drawn. A
convention."""
ITERATIONS = 20
"""Of expectation maximisation, which costs nothing beside a batch. A convention."""


class Planes(NamedTuple):
    """Half-spaces of failure, normal . z >= depth, [K] each."""

    normal: np.ndarray
    """[K, D] of norm 1"""
    depth: np.ndarray
    moment: np.ndarray
    rate: np.ndarray
    """How much nearer to failing a standard deviation brings"""

    @property
    def log_mass(self) -> np.ndarray:
        """[K] logs of their probabilities."""
        from scipy.special import log_ndtr  # here: slow to import

        return log_ndtr(-self.depth)

    @property
    def nearest(self) -> np.ndarray:
        """[K, D] their design points."""
        return self.depth[:, None] * self.normal


class Layers(NamedTuple):
    """Gaussians beyond K half-spaces, a narrow one and a wide one each, [2, K]."""

    share: np.ndarray
    mean: np.ndarray
    """Along the normal of a plane; the others are the model's"""
    variance: np.ndarray


def no_planes(d: int) -> Planes:
    """None of ``d`` numbers."""
    return Planes(np.zeros((0, d)), np.zeros(0), np.zeros(0, int), np.zeros(0))


def planes_of(here: Linearised) -> Planes:
    """The half-spaces of the moments that a slope leads to failure from."""
    size = np.linalg.norm(here.slope, axis=1)
    moment = np.flatnonzero((size > 0) & (here.distance > 0))
    normal = -here.slope[moment] / size[moment, None]
    beyond = here.distance[moment] / size[moment]
    depth = normal @ here.point + beyond
    return index_tree(Planes(normal, depth, moment, size[moment]), depth > 0)


def merge_planes(old: Planes, new: Planes) -> Planes:
    """Both; of two of one moment and side the nearer one: each is as deep as the system has it on
    the ray to its design point, and so no nearer than the nearest failure.
    """
    both = Planes(*map(np.concatenate, zip(old, new, strict=True)))
    order = np.argsort(both.depth, kind="stable")
    kept: list[int] = []
    for i in order:
        same = [j for j in kept if both.moment[j] == both.moment[i]]
        if not same or (both.normal[same] @ both.normal[i]).max() < SAME:
            kept.append(i)
    return index_tree(both, np.sort(kept))


def likely(planes: Planes, least: float = LITTLE) -> Planes:
    """Those with more than this part of the greatest probability of one."""
    mass = planes.log_mass
    return index_tree(planes, mass > mass.max() + math.log(least))


def that_matter(planes: Planes, d: int) -> Planes:
    """The `likely` ones that differ from one another, as many as a proposal holds with their wide
    copies.
    """
    planes, kept, most = likely(planes), [], most_components(d) // 2
    for i in np.argsort(-planes.log_mass, kind="stable"):
        if len(kept) < most and (planes.normal[kept] @ planes.normal[i]).max(initial=-1) < ALIKE:
            kept.append(i)
    return index_tree(planes, kept)


def first_layers(planes: Planes) -> Layers:
    """The model beyond each of the ``planes``, narrow and wide."""
    mass = planes.log_mass
    # mean and variance of a standard normal number beyond the depth
    mean = np.exp(-0.5 * planes.depth**2 - 0.5 * math.log(2 * math.pi) - mass)
    variance = SPREAD * (1 - mean * (mean - planes.depth))
    shares = np.exp(mass - mass.max())
    return Layers(
        np.outer([1 - WIDE_SHARE, WIDE_SHARE], shares / shares.sum()),
        np.stack([mean, planes.depth - WIDE_NEARER]),
        np.stack([variance, np.maximum(variance, 1.0)]),
    )


def layers_as_latent(planes: Planes, layers: Layers, dtype: Any) -> Latent:
    """The `Latent` of two ``layers`` of Gaussians beyond each of the ``planes``."""
    means = (layers.mean[..., None] * planes.normal).reshape(-1, planes.normal.shape[1])
    ways = np.concatenate([planes.normal, planes.normal])
    parts = layers.share.ravel(), means, ways, layers.variance.ravel()
    if planes.log_mass.max() > math.log(SETTINGS.rare_probability):
        model = SETTINGS.model_share, np.zeros_like(means[0]), ways[0], 1.0
        parts = (np.concatenate([a, np.array(b)[None]]) for a, b in zip(parts, model, strict=True))
    return latent_along(*parts, dtype)


def fit_layers(z: np.ndarray, log_weight: np.ndarray, planes: Planes, first: Layers) -> Layers:
    """Layers fitted to weighted failures ``z`` [n, D] by expectation maximisation: the shares, and
    for all planes together how much nearer each layer is than the ``first``, and the ratio of their
    variances: at least that of what lies beyond a plane, and 1 for the wide layer.
    """
    x = (z.astype(np.float64) @ planes.normal.T)[:, None]  # [n, 1, K]
    w = np.exp(log_weight - log_weight.max())
    w *= effective_sample_size(log_weight) / w.sum()
    layers = first
    for _ in range(ITERATIONS):
        share, mean, variance = layers
        joint = np.log(share) - 0.5 * (x - mean) ** 2 / variance - 0.5 * np.log(variance)
        joint += 0.5 * x**2
        part = np.exp(joint - joint.max(axis=(1, 2), keepdims=True))
        part *= w[:, None, None] / part.sum(axis=(1, 2), keepdims=True)
        n = part.sum(axis=(0, 2)) + PRIOR  # of each layer
        nearer = np.minimum((part * (x - first.mean)).sum(axis=(0, 2)) / n, 0.0)[:, None]
        square = (x - first.mean - nearer) ** 2 / first.variance
        ratio = ((part * square).sum(axis=(0, 2)) + PRIOR) / n
        share = part.sum(axis=0) + PRIOR * first.share
        share /= share.sum(axis=1, keepdims=True)
        wide = max(n[1] / n.sum(), WIDE_SHARE)
        layers = Layers(
            np.array([[1 - wide], [wide]]) * share,
            first.mean + nearer,
            first.variance * np.maximum(ratio, [1 / SPREAD, 1.0])[:, None],
        )
    return layers
