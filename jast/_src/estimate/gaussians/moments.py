"""A first proposal from few runs, for systems of many numbers: half-spaces of failure, one a moment
of the episode and side, each from the system linearised near to its own boundary.

The probability of half-spaces is a sum that counts some failures twice; draws of a mixture of the
model within each, weighed by all of it, count them once (importance sampling of a union of rare
events: Owen, Maximov and Chertkov 2019; of several design points: Au and Beck 2001). Here each is a
Gaussian of the model's mean and variance beyond its plane, with a wide copy, so that weights stay
bounded where the system is not linear.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from jast._src.estimate.gaussians.design_points import distinct, explained
from jast._src.estimate.gaussians.family import GaussianFamily, Points, defensive_parts
from jast._src.estimate.gaussians.mixture_fit import (
    Gaussians,
    as_latent,
    effective_sample_size,
    most_components,
    with_log_shares,
)
from jast._src.estimate.proposal_search.mixture_draws import log_joint
from jast._src.estimate.proposal_search.search_state import SearchState, add_batch
from jast._src.normal_space.moments import Linearised, cost_of_slopes, distances, slopes

__all__ = ["explore_moments"]

FIRST_DRAWS = 20
"""Draws of the model, the nearest to failure of which is where linearising begins: on neither side
of a system with two."""
COMMON = 0.25
"""Share of them that fail, from which plain draws tell the probability."""
INSIDE = 0.95
"""Part of the way to a boundary at which a system is linearised: next to it, and still safe."""
HALVINGS = 4
"""Of the way to there, where it fails already."""
KNOWN = 0.15
"""Standard deviations to which the nearest boundary must be where its plane says: a probability at
four of them is then known to a factor of two, and the draws tell the rest."""
ROUNDS = 6
"""Linearisations from one start at most."""
GIVEN = 4
"""Failures that came with the call, and that no plane explains, from which others start."""
ROOTS = 3
"""Runs at most to see how deep a half-space is on the way to its own design point."""
FARTHER = 2.0
"""Standard deviations at most that one of them goes on."""
LITTLE = 1e-3
"""Part of the greatest probability of a half-space, below which one is left out."""
SAME = 0.9
"""Cosine above which two half-spaces of a moment are one."""
ALIKE = 0.97
"""Cosine above which the less likely of two is left out."""
MOST = 64
"""Half-spaces of a proposal at most: densities take their number times that of the numbers
squared."""
SPREAD = 2.0
"""Factor on the variance beyond a plane: with it, and a fifth of wide copies, .45 effective draws a
draw where the plane is right, .2 where the boundary is .3 standard deviations nearer (one
dimension, 4.2 standard deviations out, by quadrature; with a factor of 1: .54 and .12)."""
PRIOR = 50.0
"""Failures that the shares by half-spaces count for beside those by draws."""
BATCHES = 3
"""Batches that shares are fitted to."""


class Planes(NamedTuple):
    """Half-spaces of failure, normal . z >= depth, [K] each."""

    normal: np.ndarray
    """[K, D] of norm 1"""
    depth: np.ndarray
    moment: np.ndarray
    rate: np.ndarray
    """How much nearer to failing a standard deviation brings"""
    gap: np.ndarray
    """From where it was linearised to its nearest failing point"""

    def take(self, rows: np.ndarray) -> Planes:
        """Some of them."""
        return Planes(*(a[rows] for a in self))

    @property
    def log_mass(self) -> np.ndarray:
        """[K] logs of their probabilities."""
        from scipy.special import log_ndtr  # here: slow to import

        return log_ndtr(-self.depth)

    @property
    def nearest(self) -> np.ndarray:
        """[K, D] their design points."""
        return self.depth[:, None] * self.normal


def explore_moments(
    f: GaussianFamily, given: np.ndarray | None, gradients: bool
) -> SearchState:
    """The state of a search with a proposal of the half-spaces that linearising leads to, fitted to a few
    batches; without one where it leads to none. ``given`` [m, D]: failures that came with the call.
    """
    state, start = _draw_model(f, SearchState())
    if start is None:
        return state
    end = f.settings.exploration_end * f.budget
    planes = _none(f.dimension)
    state, planes = _approach(f, state, planes, start, gradients, end)
    for i in range(GIVEN if given is not None else 0):
        rest = given[~explained(given, planes.nearest, KNOWN)] if len(planes.depth) else given
        points = distinct(rest.astype(np.float64), 1)
        if not len(points):
            break
        given = rest[(rest != points[0]).any(axis=1)]
        state, planes = _approach(f, state, planes, INSIDE * points[0], gradients, end)
    if len(planes.depth):
        opposite = -INSIDE * planes.nearest[np.argmin(planes.depth)]
        state, planes = _approach(f, state, planes, opposite, gradients, end)
    if not len(planes.depth):
        return state.note("moments: no slope leads to failures")
    state, planes = _with_mirror_images(f, state, _that_matter(planes, f.dimension))
    depths = f"at {planes.depth.min():.3f} to {planes.depth.max():.3f}"
    state = state.note(f"moments: {len(planes.depth)} half-spaces {depths}")
    state = state._replace(q=_proposal(f, planes), anchors=planes.nearest)
    return _fit_shares(f, state)


def _none(d):
    return Planes(np.zeros((0, d)), np.zeros(0), np.zeros(0, int), np.zeros(0), np.zeros(0))


def _draw_model(f, state):
    """The state after some draws of the model, and the safe one that came nearest to failing; None
    where failures are common, or nothing tells how near one came.
    """
    z = f.context.rng.standard_normal((FIRST_DRAWS, f.dimension)).astype(f.dtype)
    o, g = distances(f.sim, z)
    failing, invalid = int(o.failure.sum()), int(o.invalid.sum())
    plain = tuple(
        a + b for a, b in zip(state.plain, (failing, invalid, FIRST_DRAWS), strict=True)
    )
    state = state._replace(plain=plain)
    state = state.note(f"moments: draws of the model, {failing} fail", FIRST_DRAWS)
    far = np.where(np.isnan(g), np.inf, g).min(axis=1)
    far[np.asarray(o.failure | o.invalid)] = np.inf
    if failing > COMMON * FIRST_DRAWS or not np.isfinite(far).any():
        return state, None
    return state, z[np.argmin(far)].astype(np.float64)


def _approach(f, state, planes, start, gradients, end):
    """The state and the `Planes` after linearising from ``start`` on, each time next to the nearest
    boundary that the last one led to, until that is where it was said to be.
    """
    cost = cost_of_slopes(f.sim, f.dimension, gradients)
    last = np.zeros_like(start)
    for _ in range(ROUNDS):
        if state.spent + cost + HALVINGS > end:
            return state.note("moments: no room for more slopes"), planes
        state, start = _step_back(f, state, start, last)
        here = slopes(f.sim, start.astype(f.dtype), gradients)
        said = _planes_of(here)
        state = state.note(f"moments: linearised at {np.linalg.norm(start):.3f}", cost)
        if not len(said.depth):
            break
        state, new = _to_their_roots(f, state, said)
        planes = _merge(planes, new)
        top = np.argmin(new.depth)
        if abs(new.depth[top] - said.depth[top]) <= KNOWN:
            break
        last, start = start, INSIDE * new.nearest[top]
    return state, planes


def _step_back(f, state, aim, safe):
    """The state, and ``aim``, or a point between it and the ``safe`` one where it fails."""
    for i in range(HALVINGS + 1):
        point = aim if i == 0 else (point + safe) / 2
        o, _ = distances(f.sim, point[None].astype(f.dtype))
        state = state._replace(spent=state.spent + 1)
        if not (o.failure[0] or o.invalid[0]):
            break
    return state, point


def _planes_of(here: Linearised) -> Planes:
    """The half-spaces of the moments that a slope leads to failure from."""
    size = np.linalg.norm(here.slope, axis=1)
    moment = np.flatnonzero((size > 0) & (here.distance > 0))
    normal = -here.slope[moment] / size[moment, None]
    beyond = here.distance[moment] / size[moment]
    depth = normal @ here.point + beyond
    gap = np.linalg.norm(depth[:, None] * normal - here.point, axis=1)
    return Planes(normal, depth, moment, size[moment], gap).take(depth > 0)


def _merge(old: Planes, new: Planes) -> Planes:
    """Both; of two of one moment and side the one that was linearised nearer to its boundary."""
    both = Planes(*map(np.concatenate, zip(old, new, strict=True)))
    order = np.argsort(both.gap, kind="stable")
    kept: list[int] = []
    for i in order:
        same = [j for j in kept if both.moment[j] == both.moment[i]]
        if not same or (both.normal[same] @ both.normal[i]).max() < SAME:
            kept.append(i)
    return both.take(np.sort(kept))


def _with_mirror_images(f, state, planes):
    """The state, and the ``planes`` with their mirror images where the system fails there too: what
    fails to the left often fails to the right.
    """
    images = planes._replace(normal=-planes.normal)
    new = np.array([len(_merge(planes, images.take([i])).depth) for i in range(len(planes.depth))])
    images = images.take(new > len(planes.depth))
    if not len(images.depth):
        return state, planes
    beyond = (images.depth + KNOWN)[:, None] * images.normal
    failure = np.asarray(distances(f.sim, beyond.astype(f.dtype))[0].failure)
    text = f"moments: {failure.sum()} of {len(failure)} mirror images fail"
    both = zip(planes, images.take(failure), strict=True)
    planes = _that_matter(Planes(*map(np.concatenate, both)), f.dimension)
    return state.note(text, len(failure)), planes


def _to_their_roots(f, state, planes):
    """The state, and the ``planes`` as deep as the system has them on the ray to each design
    point, by the secant rule.
    """
    depth, unknown, runs = planes.depth.copy(), np.arange(len(planes.depth)), 0
    for _ in range(ROOTS):
        aim = INSIDE * depth[unknown, None] * planes.normal[unknown]
        _, g = distances(f.sim, aim.astype(f.dtype))
        left = np.nan_to_num(g[np.arange(len(unknown)), planes.moment[unknown]])
        farther = np.minimum(left / planes.rate[unknown], FARTHER)
        new = INSIDE * depth[unknown] + farther
        runs += len(unknown)
        far = np.abs(new - depth[unknown]) > KNOWN
        depth[unknown], unknown = new, unknown[far]
        if not len(unknown):
            break
    text = f"moments: {len(unknown)} of {len(depth)} boundaries not where they were said to be"
    return state.note(text, runs), planes._replace(depth=depth)


def _that_matter(planes: Planes, d: int) -> Planes:
    """Those of great probability that differ from one another, as many as a proposal is to hold
    with their wide copies.
    """
    mass = planes.log_mass
    order = np.argsort(-mass, kind="stable")
    order = order[mass[order] > mass.max() + math.log(LITTLE)]
    most, kept = min(most_components(d) // 2, MOST), []
    for i in order:
        if len(kept) < most and (planes.normal[kept] @ planes.normal[i]).max(initial=-1) < ALIKE:
            kept.append(i)
    return planes.take(kept)


def _proposal(f, planes):
    """A `Latent` of the model beyond each of the ``planes``."""
    k, d = planes.normal.shape
    mass = planes.log_mass
    # mean and variance of a standard normal number beyond the depth
    mean = np.exp(-0.5 * planes.depth**2 - 0.5 * math.log(2 * math.pi) - mass)
    variance = 1 - mean * (mean - planes.depth)
    values = np.ones((k, d))
    values[:, 0] = SPREAD * variance
    # the reflection that takes the first axis to the normal
    way = planes.normal - np.eye(d)[0]
    size = np.maximum((way**2).sum(axis=1), 1e-12)
    vectors = np.eye(d) - 2 * way[:, :, None] * way[:, None] / size[:, None, None]
    shares = np.exp(mass - mass.max())
    g = Gaussians(shares / shares.sum(), mean[:, None] * planes.normal, values, vectors)
    rare = mass.max() < math.log(f.settings.rare_probability)
    return as_latent(defensive_parts(g, 0.0, rare, f.settings), f.dtype)


def _fit_shares(f, state):
    """The state after a few batches, each of shares that are fitted to all before it."""
    q = state.q
    for _ in range(BATCHES):
        batch = f.draw(q)
        state = add_batch(f, state, batch)
        failing, ess = len(batch.log_weight), 0.0
        if failing:
            ess = effective_sample_size(batch.log_weight)
        text = f"moments: {failing / batch.size:.1%} fail, ESS {ess:.4g}"
        state = state.note(f"{text}; of all: log p {state.log_mean:.3f}", f.batch)
        if state.efficiency < f.settings.family_efficiency:
            break
        q = _with_shares(state, q)
    return state


def _with_shares(state, q):
    """The proposal ``q`` with shares by what its components carry of the failures of all
    batches.
    """
    points = Points(*map(np.concatenate, zip(*(b.points for b in state.batches), strict=True)))
    carried = np.exp(with_log_shares(log_joint(q, points.z, points.used))[1])
    mass = np.exp(state.log_weight - state.log_weight.max()) @ carried
    n = effective_sample_size(state.log_weight)
    shares = n * mass / mass.sum() + PRIOR * np.exp(np.asarray(q.log_weights, np.float64))
    return q._replace(log_weights=np.log(shares / shares.sum()).astype(q.log_weights.dtype))
