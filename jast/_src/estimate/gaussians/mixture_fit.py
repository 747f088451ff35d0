"""Mixtures of Gaussians fitted to weighted failures, for proposals: expectation maximisation with
covariances that only say what the sample can know.

On the host, in double precision. The cross-entropy optimum among mixtures is the maximum of the
weighted likelihood (de Boer, Kroese, Mannor and Rubinstein 2005); the number of components is the
one that the other half of the sample likes best.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.normal_space.transform import Latent
from jast._src.util.blocked_matmul import gram, product

__all__ = [
    "Gaussians",
    "as_latent",
    "effective_sample_size",
    "fit_mixture",
    "latent_along",
    "log_sum",
    "mix",
    "most_components",
    "nearest_centre",
    "shrink_to_anchors",
    "tempering_power",
    "unit_gaussians",
    "with_log_shares",
]

COMPONENTS = (1, 2, 4, 8, 16)  # numbers of components that are compared
ITERATIONS = 10  # of expectation maximisation
GAIN = 1e-3  # nats a point that an iteration must gain while numbers of components are compared
BETTER = 0.02  # nats a point that more components must gain to be preferred
POINTS_EACH = 10  # effective points of a half of the sample for each component
WEIGHTS_EACH = 4  # points of weight above 0 for each component
LEAST_MEMBERS = 2  # effective points below which a component ends
POINTS = 4000  # of a sample, that a fit looks at
FULL = 30  # dimensions above which a mixture is fitted in a subspace
ANCHOR_SHARE = 0.01  # of the points, above which the nearest anchor is part of the subspace
RANK = 1e-6  # part of the greatest singular value, below which one is rounding
NOTHING = 1e-6  # a variance of rounding alone
LEAST_VALUE = 1e-4  # eigenvalue of a covariance
BAND = 0.9, 1.1  # factors on the edges of the band of noise, for its spread in small samples
BAND_ITERATIONS = 20  # at most; a convention
COMPONENTS_HELD = (40, 256)  # the range of the greatest number of components of a `Latent`
MEMORY = 2**24  # numbers in all covariances of a `Latent` between these


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


def fit_mixture(
    rng: np.random.Generator,
    points: np.ndarray,
    weights: np.ndarray,
    count: float,
    covariance_count: float | None = None,
    limit: int = 16,
    anchors: np.ndarray | None = None,
) -> Gaussians:
    """`Gaussians` for ``points`` [n, D] of ``weights`` [n] (sum 1), which count as ``count``
    independent ones, or as ``covariance_count`` as to covariances; of at most ``limit`` components.
    ``anchors`` [m, D]: design points, which means near to them are shrunk to by what may be noise.

    Of many dimensions it is fitted in the few directions in which the points differ from noise:
    what is fitted to the others is noise (Uribe et al. 2021 find such a subspace by gradients).
    """
    counts = count, count if covariance_count is None else covariance_count
    anchors = None if anchors is None or not len(anchors) else anchors
    d = points.shape[1]
    basis, r = _subspace(points, weights, counts[1], anchors) if d > FULL else (None, d)
    if r > d // 2:
        return _fit(rng, points, weights, *counts, limit, anchors)
    q, rest = basis[:, :r], basis[:, r:]
    of_q = None if anchors is None else anchors @ q
    g = _fit(rng, points @ q, weights, *counts, limit, of_q)
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
    if anchors is not None:
        share = np.bincount(nearest_centre(points, anchors), weights, len(anchors))
        own = np.concatenate([anchors[share > ANCHOR_SHARE], own])
    spanning = np.concatenate([mean[None], own])
    basis, size, _ = np.linalg.svd(spanning.T)
    return basis, int((size > RANK * size[0]).sum())


def _fit(rng, points, weights, count, covariance_count, limit, anchors):
    """`fit_mixture` in all numbers."""
    if len(points) > POINTS:
        chosen = rng.choice(len(points), POINTS, replace=False)
        points, weights, part = points[chosen], weights[chosen], weights[chosen].sum()
        weights = weights / part
        count, covariance_count = (
            min(v, POINTS, v * max(part, 0.1)) for v in (count, covariance_count)
        )
    half = rng.permutation(len(points)) < len(points) // 2
    best, score = 1, -np.inf
    most = min(limit, count / 2 / POINTS_EACH, np.count_nonzero(weights) / WEIGHTS_EACH)
    for k in [k for k in COMPONENTS if k <= most] or [1]:
        value = 0.0
        for part in (half, ~half):
            w, v = (np.where(side, weights, 0) for side in (part, ~part))
            if not (w.sum() > 0 and v.sum() > 0):
                value = -np.inf
                break
            own = w[part] / w.sum()
            g = _maximise_likelihood(rng, points[part], own, covariance_count / 2, k, anchors, GAIN)
            value += v[~part] @ log_sum(_log_joint(g, points[~part])) / v.sum()
        if value > score + BETTER:
            best, score = k, value
        elif k > 2 * best:
            break
    return _maximise_likelihood(rng, points, weights, covariance_count, best, anchors)


def as_latent(parts: list[tuple[float, Gaussians]], dtype: Any) -> Latent:
    """The `Latent` of [(share, Gaussians), ...], of its greatest components; shares of any sum."""
    weights = np.concatenate([share * g.weights for share, g in parts])
    means, values, vectors = (np.concatenate([g[i] for _, g in parts]) for i in (1, 2, 3))
    other = values != 1
    if other.sum(axis=1).max() <= 1:
        k, way = np.arange(len(weights)), other.argmax(axis=1)
        return latent_along(weights, means, vectors[k, :, way], values[k, way], dtype)
    kept = _greatest(weights, means.shape[1])
    weights, means, values, vectors = (a[kept] for a in (weights, means, values, vectors))
    covariances = (vectors * values[:, None]) @ vectors.transpose(0, 2, 1)
    arrays = np.log(weights / weights.sum()), means, *_factored(covariances)
    return Latent(*(np.asarray(a, dtype) for a in arrays))


def latent_along(
    weights: np.ndarray, means: np.ndarray, ways: np.ndarray, variances: np.ndarray, dtype: Any
) -> Latent:
    """The `Latent` of the greatest of K Gaussians that are the model's but along their ``ways``
    [K, D]; ``weights`` of any sum.
    """
    kept = _greatest(weights, means.shape[1])
    weights = weights[kept]
    q = Latent(
        log_weights=np.log(weights / weights.sum()),
        means=means[kept],
        directions=ways[kept],
        variances=variances[kept],
    )
    return jax.tree.map(lambda a: np.asarray(a, dtype), q)


def _factored(covariances):
    """Their lower Cholesky factors, and the inverses of these."""
    factors = np.linalg.cholesky(covariances)
    return factors, np.tril(np.linalg.inv(factors))


def _with_factors(q):
    """The same `Latent` with factors."""
    if q.directions is None:
        return q
    ways, wider = np.asarray(q.directions, np.float64), np.asarray(q.variances, np.float64) - 1
    covariances = np.eye(ways.shape[1]) + wider[:, None, None] * ways[:, :, None] * ways[:, None]
    factors = (a.astype(q.means.dtype) for a in _factored(covariances))
    return Latent(q.log_weights, q.means, *factors)


def mix(a: Latent, b: Latent, share: float) -> Latent:
    """The mixture of two `Latent`, ``share`` of the second; of their components the least give
    way.
    """
    if (a.directions is None) != (b.directions is None):
        a, b = _with_factors(a), _with_factors(b)
    weights = np.concatenate(
        [np.exp(np.asarray(q.log_weights, np.float64)) * s for q, s in ((a, 1 - share), (b, share))]
    )
    kept = _greatest(weights, a.means.shape[1])
    both = jax.tree.map(lambda a, b: np.concatenate([a, b])[kept], a, b)
    log_weights = np.log(weights[kept] / weights[kept].sum())
    return both._replace(log_weights=np.asarray(log_weights, a.means.dtype))


def most_components(d: int) -> int:
    """How many components of ``d`` numbers a `Latent` has at most."""
    return int(np.clip(MEMORY // d**2, *COMPONENTS_HELD))


def _greatest(weights, d):
    """Which of the ``weights`` of components of ``d`` numbers a `Latent` has."""
    kept = np.argsort(-weights, kind="stable")[: most_components(d)]
    return kept[weights[kept] > 0]


def effective_sample_size(log_weights: np.ndarray) -> float:
    """The effective sample size (sum w)^2 / sum w^2."""
    w = np.exp(log_weights - log_weights.max())
    return w.sum() ** 2 / (w**2).sum()


def tempering_power(log_w: np.ndarray, least: float) -> float:
    """The greatest power, at most 1, of the weights that leaves an effective sample size of
    ``least``.
    """
    if effective_sample_size(log_w) >= least:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        if effective_sample_size(middle * log_w) >= least:
            low = middle
        else:
            high = middle
    return low


def nearest_centre(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Which of ``centres`` [m, D] as a unit Gaussian has most likely made each of ``points`` [n,
    D].
    """
    return np.argmax(product(points, centres.T) - 0.5 * (centres**2).sum(axis=1), axis=1)


def shrink_eigenvalues(values: np.ndarray, count: float) -> np.ndarray:
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
    low = (1 - ratio) ** 2 * BAND[0] if ratio < 1 else -1.0
    high = (1 + ratio) ** 2 * BAND[1]
    inside = np.ones(d, bool)
    for _ in range(BAND_ITERATIONS):
        s = values[inside].mean()
        now = (values > s * low) & (values < s * high)
        if not now.any() or (now == inside).all():
            return now
        inside = now
    return inside


def _maximise_likelihood(rng, z, w, count, k, anchors, gain=-np.inf):
    """Expectation maximisation from far-apart points on; components that almost nothing belongs to
    end.
    """
    live = w > 0
    z, w = z[live], w[live]
    g = _start(rng, z, w, k)
    if len(g.weights) == 1:
        return _maximise(z, w[:, None], count, anchors)
    last = -np.inf
    for _ in range(ITERATIONS):
        log_density, log_shares = with_log_shares(_log_joint(g, z))
        g = _maximise(z, np.exp(log_shares) * w[:, None], count, anchors)
        value = w @ log_density
        if value - last < gain:
            break
        last = value
    return g


def _start(rng, z, w, k):
    """Centres by the rule of k-means++ (Arthur and Vassilvitskii 2007), unit covariances."""
    centres = z[rng.choice(len(z), 1, p=w)]
    square = ((z - centres[0]) ** 2).sum(axis=1)
    for _ in range(1, k):
        gap = square * w
        if not gap.sum() > 0:
            break
        centres = np.concatenate([centres, z[rng.choice(len(z), 1, p=gap / gap.sum())]])
        square = np.minimum(square, ((z - centres[-1]) ** 2).sum(axis=1))
    return unit_gaussians(centres)


def unit_gaussians(centres: np.ndarray) -> Gaussians:
    """Equal `Gaussians` of unit covariance at ``centres`` [k, D]."""
    k, d = centres.shape
    return Gaussians(
        np.full(k, 1 / k), centres, np.ones((k, d)), np.broadcast_to(np.eye(d), (k, d, d))
    )


def shrink_to_anchors(mean: np.ndarray, count: float, anchors: np.ndarray | None) -> np.ndarray:
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
    """`Gaussians` of points ``z`` [n, D] that belong to each of them by ``r`` [n, K]."""
    total = r.sum(axis=0)
    kept = total * count > LEAST_MEMBERS
    if not kept.any():
        kept = total == total.max()
    parts = []
    for i in np.flatnonzero(kept):
        mean = np.einsum("n,nd->d", r[:, i], z) / total[i]
        mean = shrink_to_anchors(mean, count * total[i], anchors)
        values, vectors = np.linalg.eigh(gram(z - mean, r[:, i]) / total[i])
        values = np.maximum(shrink_eigenvalues(values, count * total[i]), LEAST_VALUE)
        parts.append((total[i], mean, values, vectors))
    weights, means, values, vectors = (np.stack(a) for a in zip(*parts, strict=True))
    return Gaussians(weights / weights.sum(), means, values, vectors)


def _log_joint(g, z):
    """log of weight_k times the density of each Gaussian [n, K]."""
    out = np.empty((len(g.weights), len(z)))
    for row, weight, mean, values, vectors in zip(out, *g, strict=True):
        e = product(z, vectors) - mean @ vectors
        np.einsum("nd,d->n", np.square(e, out=e), -0.5 / values, out=row)
        row += np.log(weight) - 0.5 * np.log(2 * np.pi * values).sum()
    # sums over components run along columns
    return out.T


def log_sum(a: np.ndarray) -> np.ndarray:
    """log of the sums of exp(a) [n, K]: [n]."""
    rows = np.ascontiguousarray(a.T)  # K is small: a maximum along it is many short ones
    top = rows.max(axis=0)
    return top + np.log(np.exp(rows - top).sum(axis=0))


def with_log_shares(log_joint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The log density [n] of a mixture, of log weight_k times those of its components [n, K], and
    the log shares [n, K] of these.
    """
    log_density = log_sum(log_joint)
    return log_density, log_joint - log_density[:, None]
