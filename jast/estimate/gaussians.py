"""Mixtures of Gaussians fitted to weighted failures, for proposals: expectation maximisation with
covariances that only say what the sample can know.

On the host, in double precision. The cross-entropy optimum among mixtures is the maximum of the
weighted likelihood (de Boer, Kroese, Mannor and Rubinstein 2005); the number of components is the
one that the other half of the sample likes best.
"""

from typing import NamedTuple

import numpy as np

from jast.limit_state import Latent
from jast.products import gram, product

__all__ = [
    "Gaussians",
    "as_latent",
    "effective",
    "fit",
    "held",
    "log_density",
    "log_sum",
    "nearest",
    "shrunk",
    "tempered",
    "to_anchors",
    "together",
    "unit",
]

COMPONENTS = (1, 2, 4, 8, 16)
ITERATIONS, GAIN = 10, 1e-3
"""Rounds of expectation maximisation; what each must gain while numbers of components are compared,
in nats a point.
"""
MOST, FULL = 4000, 30
"""Points that are looked at; dimensions above which a mixture is fitted in a few of them."""
NOTHING = 1e-6
"""Of a variance: rounding."""
SIZE, MEMORY = (40, 256), 2**24
"""Components of a `Latent`: the least and the greatest number that is their limit, and numbers of
all their covariances that it holds between these.
"""


class Gaussians(NamedTuple):
    """K Gaussians by the eigensystems of their covariances: vectors[k] diag(values[k])
    vectors[k]^T.
    """

    weights: np.ndarray
    """[K]"""
    means: np.ndarray
    """[K, D]"""
    values: np.ndarray
    """[K, D]"""
    vectors: np.ndarray
    """[K, D, D]"""


def fit(rng, points, weights, count, known=None, limit=16, anchors=None):
    """`Gaussians` as of `_fit`, in the few directions in which the points differ from noise where
    there are many: what is fitted to the others is noise (Uribe et al. 2021 find such a subspace by
    gradients).
    """
    known_count = count if known is None else known
    d = points.shape[1]
    basis, r = _subspace(points, weights, known_count, anchors) if d > FULL else (None, d)
    if r > d // 2:
        return _fit(rng, points, weights, count, known, limit, anchors)
    q, rest = basis[:, :r], basis[:, r:]
    of_q = None if anchors is None or not len(anchors) else anchors @ q
    g = _fit(rng, points @ q, weights, count, known, limit, of_q)
    k, other = len(g.weights), weights @ ((points @ rest) ** 2).mean(axis=1)
    if other < NOTHING:  # points that are all anchors say nothing of the others: as in the model
        other = 1.0
    return Gaussians(
        g.weights,
        g.means @ q.T,
        np.concatenate([g.values, np.full((k, d - r), other)], axis=1),
        np.stack([np.concatenate([q @ v, rest], axis=1) for v in g.vectors]),
    )


def _subspace(points, weights, count, anchors):
    """An orthonormal basis [D, D], and how many of its first columns span the directions of the
    mean, of the anchors near to points, and those in which the points do not vary like noise.
    """
    mean = weights @ points
    e = points - mean
    values, vectors = np.linalg.eigh((e * weights[:, None]).T @ e)
    inside = _like_noise(values, count)
    own = vectors[:, ~inside].T
    if anchors is not None and len(anchors):
        share = np.bincount(nearest(points, anchors), weights, len(anchors))
        own = np.concatenate([anchors[share > 0.01], own])
    spanning = np.concatenate([mean[None], own])
    basis, size, _ = np.linalg.svd(spanning.T)
    return basis, int((size > 1e-6 * size[0]).sum())


def _fit(rng, points, weights, count, known=None, limit=16, anchors=None):
    """`Gaussians` for ``points`` [n, D] of ``weights`` [n] (sum 1), which count as ``count``
    independent ones; of at most ``limit`` components.

    ``anchors`` [m, D]: design points, which means near to them are shrunk to by what may be noise.

    ``known``: how many they count for as to covariances, where that is less. Of many points
    ``MOST`` are looked at.
    """
    known = count if known is None else known
    if len(points) > MOST:
        chosen = rng.choice(len(points), MOST, replace=False)
        points, weights, part = points[chosen], weights[chosen], weights[chosen].sum()
        weights, count, known = (
            weights / part,
            *(min(v, MOST, v * max(part, 0.1)) for v in (count, known)),
        )
    n = len(points)
    half = rng.permutation(n) < n // 2
    best, score = 1, -np.inf
    starts = [
        k
        for k in COMPONENTS
        if k <= limit and count / 2 >= 10 * k and np.count_nonzero(weights) >= 4 * k
    ] or [1]
    for k in starts:
        value = 0.0
        for part in (half, ~half):
            w, v = (np.where(side, weights, 0) for side in (part, ~part))
            if not (w.sum() > 0 and v.sum() > 0):
                value = -np.inf
                break
            g = _em(rng, points[part], w[part] / w.sum(), known / 2, k, anchors, GAIN)
            value += v[~part] @ log_sum(_log_joint(g, points[~part])) / v.sum()
        if value > score + 0.02:
            best, score = k, value
        elif k > 2 * best:
            break
    return _em(rng, points, weights, known, best, anchors)


def as_latent(parts, dtype):
    """The `Latent` of [(share, Gaussians), ...], of its greatest components."""
    weights = np.concatenate([share * g.weights for share, g in parts])
    kept = _greatest(weights, parts[0][1].means.shape[1])
    weights, (means, values, vectors) = (
        weights[kept],
        (np.concatenate([g[i] for _, g in parts])[kept] for i in (1, 2, 3)),
    )
    covariances = (vectors * values[:, None]) @ vectors.transpose(0, 2, 1)
    factors = np.linalg.cholesky(covariances)
    log_weights = np.log(weights / weights.sum())
    arrays = log_weights, means, factors, np.tril(np.linalg.inv(factors))
    return Latent(*(np.asarray(a, dtype) for a in arrays))


def together(a, b, share):
    """The mixture of two `Latent`, ``share`` of the second; of their components the least give
    way.
    """
    weights = np.concatenate(
        [np.exp(np.asarray(q.log_weights, np.float64)) * s for q, s in ((a, 1 - share), (b, share))]
    )
    kept = _greatest(weights, a.means.shape[1])
    return Latent(
        np.asarray(np.log(weights[kept] / weights[kept].sum()), a.means.dtype),
        *(np.concatenate(each)[kept] for each in zip(a[1:], b[1:], strict=True)),
    )


def held(d):
    """How many components of ``d`` numbers a `Latent` has at most."""
    return int(np.clip(MEMORY // d**2, *SIZE))


def _greatest(weights, d):
    """Which of the ``weights`` of components of ``d`` numbers a `Latent` has."""
    kept = np.argsort(-weights, kind="stable")[: held(d)]
    return kept[weights[kept] > 0]


def effective(log_weights):
    """(sum w)^2 / sum w^2."""
    w = np.exp(log_weights - log_weights.max())
    return w.sum() ** 2 / (w**2).sum()


def tempered(log_w, least):
    """The greatest power, at most 1, of the weights that leaves an effective number of
    ``least``.
    """
    if effective(log_w) >= least:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if effective(middle * log_w) >= least else (low, middle)
    return low


def nearest(points, centres):
    """Which of ``centres`` [m, D] as a unit Gaussian has most likely made each of ``points`` [n,
    D].
    """
    return np.argmax(product(points, centres.T) - 0.5 * (centres**2).sum(axis=1), axis=1)


def log_density(g, z):
    """log of the density of `Gaussians` at ``z`` [n, D]: [n]."""
    return log_sum(_log_joint(g, z))


def shrunk(values, count):
    """Eigenvalues [D] of a sample covariance with what is noise of ``count`` independent points
    taken out.

    Those within the band that a covariance s I would show (Marchenko and Pastur 1967) are set to
    their mean s, found by repetition; the others are kept.
    """
    inside = _like_noise(values, count)
    return np.where(inside, values[inside].mean(), values) if inside.any() else values


def _like_noise(values, count):
    """Which of the eigenvalues [D] may be noise."""
    d = len(values)
    ratio = np.sqrt(d / max(count, 1.0))
    # fewer points than dimensions leave values of 0
    low, high = (1 - ratio) ** 2 * 0.9 if ratio < 1 else -1.0, (1 + ratio) ** 2 * 1.1
    inside = np.ones(d, bool)
    for _ in range(20):
        s = values[inside].mean()
        now = (values > s * low) & (values < s * high)
        if not now.any() or (now == inside).all():
            return now
        inside = now
    return inside


def _em(rng, z, w, count, k, anchors, gain=-np.inf):
    """Expectation maximisation from far-apart points on; components that almost nothing belongs to
    end.
    """
    live = w > 0
    z, w = z[live], w[live]
    g = _start(rng, z, w, k)
    one = len(g.weights) == 1
    last = -np.inf
    for _ in range(1 if one else ITERATIONS):
        joint = np.zeros((len(z), 1)) if one else _log_joint(g, z)
        total = log_sum(joint)
        r = np.exp(joint - total[:, None]) * w[:, None]
        g = _maximise(z, r, count, anchors)
        if w @ total - last < gain:
            break
        last = w @ total
    return g


def _start(rng, z, w, k):
    """Centres by the rule of k-means++ (Arthur and Vassilvitskii 2007), unit covariances."""
    centres = z[rng.choice(len(z), 1, p=w)]
    nearest = ((z - centres[0]) ** 2).sum(axis=1)
    for _ in range(1, k):
        gap = nearest * w
        if not gap.sum() > 0:
            break
        centres = np.concatenate([centres, z[rng.choice(len(z), 1, p=gap / gap.sum())]])
        nearest = np.minimum(nearest, ((z - centres[-1]) ** 2).sum(axis=1))
    return unit(centres)


def unit(centres):
    """Equal `Gaussians` of unit covariance at ``centres`` [k, D]."""
    k, d = centres.shape
    return Gaussians(
        np.full(k, 1 / k), centres, np.ones((k, d)), np.broadcast_to(np.eye(d), (k, d, d))
    )


def to_anchors(mean, count, anchors):
    """The ``mean`` [D] of ``count`` points, shrunk to the next of ``anchors`` [m, D]: what it
    differs from there may be noise alone (James and Stein 1961).
    """
    d = len(mean)
    if anchors is None or not len(anchors) or d <= 2:
        return mean
    gaps = mean - anchors
    gap = gaps[np.argmin((gaps**2).sum(axis=1))]
    return mean - gap * min((d - 2) / (count * (gap**2).sum() + 1e-12), 1)


def _maximise(z, r, count, anchors):
    total = r.sum(axis=0)
    kept = total * count > 2
    if not kept.any():
        kept = total == total.max()
    parts = []
    for i in np.flatnonzero(kept):
        mean = np.einsum("n,nd->d", r[:, i], z) / total[i]
        mean = to_anchors(mean, count * total[i], anchors)
        e = z - mean
        values, vectors = np.linalg.eigh(gram(e, r[:, i]) / total[i])
        parts.append((total[i], mean, np.maximum(shrunk(values, count * total[i]), 1e-4), vectors))
    weights, means, values, vectors = (np.stack(a) for a in zip(*parts, strict=True))
    return Gaussians(weights / weights.sum(), means, values, vectors)


def _log_joint(g, z):
    out = np.empty((len(g.weights), len(z)))
    for row, weight, mean, values, vectors in zip(out, *g, strict=True):
        e = product(z, vectors) - mean @ vectors
        np.einsum("nd,d->n", np.square(e, out=e), -0.5 / values, out=row)
        row += np.log(weight) - 0.5 * np.log(2 * np.pi * values).sum()
    # sums over components run along columns
    return out.T


def log_sum(a):
    """log of the sums of exp(a) [n, K]: [n]."""
    rows = np.ascontiguousarray(a.T)  # K is small: a maximum along it is many short ones
    top = rows.max(axis=0)
    return top + np.log(np.exp(rows - top).sum(axis=0))
