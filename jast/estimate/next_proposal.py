"""The next proposal of a search, fitted by cross-entropy to the failures of all batches so far: the
one of a few that promises the least variance.
"""

import math

import numpy as np

from jast.estimate.batches import balanced, over_batches
from jast.estimate.gaussians import (
    Gaussians,
    as_latent,
    effective,
    fit,
    nearest,
    tempered,
    to_anchors,
    unit,
)

__all__ = ["MANY", "defended", "failing", "refitted", "weighed"]

WIDE, MODEL = 0.2, 0.1
"""Shares of a proposal: components whose covariances are nowhere narrower than the model's, so that
no weight is without variance; where failures are not rare the model itself.
"""
RARE, FEW, NOTHING = math.log(1e-4), 20, 1e-6
MANY = 16
"""Directions above which each has too few failures for a covariance of all numbers."""
NUMBERS, SPREAD, SEEN = 4, 3.0, 5.0
"""Numbers, at most, that a direction of many is fitted in; failures that the model's variance and,
in its share, each direction is as good as.
"""
LEAST, MINOR = 0.05, 0.2
"""Share of the draws that a direction has at least, and all of those together: what a few failures
tell of its mass is mostly too little.
"""


def weighed(s):
    """The log weights of the failures of all batches, which say about what the probability is."""
    log_w, _ = balanced(s.batches)
    total = np.exp(log_w - log_w.max()).sum()
    s.log_mean = log_w.max() + math.log(total / sum(len(b.z) for b in s.batches))
    s.rare = s.log_mean < RARE
    return log_w


def refitted(s):
    """The proposal becomes what promises the least variance: a mixture for all failures, one with
    parts for each mode, a sphere, or itself.
    """
    log_w = weighed(s)
    w = np.exp(log_w - log_w.max())
    points, centres = s.filled(*failing(s.batches)), s.centres()
    owner = nearest(points, centres)
    many = np.bincount(owner, minlength=len(centres)) >= FEW
    owner = nearest(points, centres[many]) if many.any() else np.zeros_like(owner)
    # the second moment of the weights under another proposal, by the points at hand: sum of w p / q
    variance = lambda q: np.logaddexp.reduce(log_w - over_batches(q, s.batches))
    choices = {"as it was": s.q}
    if len(centres) <= MANY or effective(log_w) > FEW * s.dimension * len(centres):
        choices["modes"] = _by_owner(s, points, log_w, owner)
    if len(centres) > MANY:
        choices["sparse"] = _sparse(s, points, log_w, centres)
    if "modes" not in choices or owner.any():
        choices["one"] = _by_owner(s, points, log_w, np.zeros_like(owner))
    # failures in all directions: no number of Gaussians elsewhere covers a sphere in many
    # dimensions
    spread = (w @ (points**2).mean(axis=1)) / w.sum()
    choices["all around"] = as_latent(
        [
            (
                1.0,
                unit(np.zeros((1, s.dimension)))._replace(values=np.full((1, s.dimension), spread)),
            )
        ],
        s.dtype,
    )
    name = min(choices, key=lambda name: variance(choices[name]))
    s.q = choices[name]
    return name, effective(log_w)


def _by_owner(s, points, log_w, owner):
    """A `Latent`: Gaussians fitted to the points of each owner apart."""
    parts, w, owners = [], np.exp(log_w - log_w.max()), np.unique(owner)
    least = min(LEAST, MINOR / len(owners))
    for i in owners:
        rows = np.flatnonzero(owner == i)
        mass = w[rows].sum() / w.sum()
        if mass < NOTHING:
            continue
        # few great weights would make a mixture fit their own noise: a power below 1 of them leads
        # the same way, in more batches
        power = tempered(log_w[rows], min(max(200, 5 * s.dimension), 0.5 * len(rows)))
        v = np.exp(power * (log_w[rows] - log_w[rows].max()))
        g = fit(
            s.rng,
            points[rows],
            v / v.sum(),
            v.sum() ** 2 / (v**2).sum(),
            limit=max(MANY // len(owners), 2),
            anchors=s.anchors,
        )
        parts.append(g._replace(weights=g.weights * max(mass, least)))
    return as_latent(
        defended(
            Gaussians(*(np.concatenate(each) for each in zip(*parts, strict=True))), 0.0, s.rare
        ),
        s.dtype,
    )


def _sparse(s, points, log_w, centres):
    """A `Latent`: a Gaussian for each of ``centres`` [m, D] that differs from the model in a few
    directions alone, which few points tell: those numbers that the centre's anchor needs, or where
    these are many the direction of the mean.
    """
    owner = nearest(points, centres)
    means, masses = centres.copy(), np.zeros(len(centres))
    values, vectors = np.ones_like(centres), np.repeat(np.eye(s.dimension)[None], len(centres), 0)
    of = nearest(centres, s.anchors)
    for i in np.unique(owner):
        own, z = log_w[owner == i], points[owner == i]
        masses[i] = np.exp(own - log_w.max()).sum()
        v, n = np.exp(own - own.max()), effective(own)
        v /= v.sum()
        on = s.anchors[of[i]] != 0
        if 0 < on.sum() <= NUMBERS:
            means[i] = 0.0
            means[i, on] = to_anchors(v @ z[:, on], n, s.anchors[of[i], on][None])
            spread = v @ (z[:, on] - means[i, on]) ** 2
        else:
            means[i] = to_anchors(v @ z, n, s.anchors)
            vectors[i] = np.linalg.qr(means[i][:, None], mode="complete").Q
            on = np.arange(s.dimension) == 0
            spread = v @ ((z - means[i]) @ vectors[i, :, on].T) ** 2
        values[i, on] = (n * spread + SPREAD) / (n + SPREAD)
    g = Gaussians(_masses(masses, effective(log_w)), means, values, vectors)
    return as_latent(defended(g, 0.0, s.rare), s.dtype)


def _masses(mass, n):
    """Shares of modes that weigh ``mass`` [m] by ``n`` effective draws: as if each had been met by
    `SEEN` more.
    """
    m = len(mass)
    return (n * mass / mass.sum() + SEEN) / (n + m * SEEN)


def failing(batches):
    """The failing points [n, D] of ``batches`` and how many numbers each has used [n]."""
    rows = np.concatenate([b.failure for b in batches])
    return tuple(np.concatenate([getattr(b, a) for b in batches])[rows] for a in ("z", "used"))


def defended(g, low, rare):
    """[(share, Gaussians), ...]: ``g``, its wide copies, and where failures are not rare the
    model.
    """
    d, model = g.means.shape[1], 0.0 if rare else MODEL
    wide = g._replace(values=np.maximum(g.values, 1.0))
    parts = (
        [(1 - WIDE - model, g._replace(values=np.maximum(g.values, low))), (WIDE, wide)]
        if (g.values < 1).any()
        else [(1 - model, g)]
    )
    return [*parts, (model, unit(np.zeros((1, d))))] if model else parts
