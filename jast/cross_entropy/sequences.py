"""Sequences of disturbances as normal numbers: z ~ N(0, I) is a draw of the model, x = Q(Phi(z)),
and a proposal moves each step's z.

Shared by the search `jast.search.cem`, the objective of `jast.cross_entropy.over` and
`jast.estimate.failure_proposal`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import log_ndtr, ndtr, ndtri
from jax.tree_util import Partial

from jast import actions as choices
from jast import distributions as D
from jast.policy import Policy

__all__ = [
    "Steps",
    "cells",
    "fit",
    "latent",
    "log_ratio",
    "noise",
    "normal_score",
    "phi",
    "place",
    "player",
    "quantile",
    "standard",
]


LOG_2 = 0.6931471805599453


class Steps(NamedTuple):
    """z_t ~ N(mean_t, deviation_t^2), for t = 1 .. T: pytrees like a disturbance, leaves [T, ...],
    floats.
    """

    mean: Any
    deviation: Any


def standard(like, steps):
    """The `Steps` N(0, 1) over ``steps`` disturbances of these shapes and dtypes: u = Phi(z) is
    uniform.
    """
    full = lambda value: jax.tree.map(
        lambda s: jnp.full((steps, *s.shape), value, D.float_dtype(s.dtype)), like
    )
    return Steps(full(0), full(1))


def noise(key, steps, offset):
    """z [T, ...] of one episode, by its ``key``: that of step t is drawn at level ``offset +
    t``.
    """
    leaves, treedef = jax.tree.flatten(steps.mean)

    def step(t):
        k = jax.random.fold_in(key, t + offset)
        keys = [k] if len(leaves) == 1 else [jax.random.fold_in(k, i) for i in range(len(leaves))]
        return treedef.unflatten(
            [jax.random.normal(k, a.shape[1:], a.dtype) for k, a in zip(keys, leaves, strict=True)]
        )

    z = jax.vmap(step)(jnp.arange(leaves[0].shape[0], dtype=jnp.int32))
    return jax.tree.map(lambda m, s, e: m + s * e, steps.mean, steps.deviation, z)


def log_ratio(steps, z):
    """log N(z_t; 0, 1) - log N(z_t; mean_t, deviation_t^2) of one episode's ``z`` [T, ...], summed
    over all but the steps: [T].
    """

    def of(m, s, z):
        # with e = (z - m) / s the squares differ by (z - e)(z + e): no cancellation of two large
        # numbers
        e = (z - m) / s
        return (jnp.log(s) - 0.5 * (z - e) * (z + e)).reshape(z.shape[0], -1).sum(axis=1)

    parts = [
        of(*each)
        for each in zip(*map(jax.tree.leaves, (steps.mean, steps.deviation, z)), strict=True)
    ]
    dtype = max((p.dtype for p in parts), key=lambda t: t.itemsize)
    return sum((p.astype(dtype) for p in parts[1:]), parts[0].astype(dtype))


def fit(steps, z, counts, smoothing, floor):
    """The `Steps` nearer to episodes' ``z`` [n, T, ...]: mean and standard deviation, ``smoothing``
    of the old ones kept.

    ``counts`` [n, T]: whether each counts (bool), or for how many episodes (floats, of a sum that
    is the effective number). A step that fewer than two episodes reached keeps its proposal. No
    deviation is below ``floor``.
    """

    def one(mean, deviation, z):
        w = counts.reshape(counts.shape + (1,) * (z.ndim - 2)).astype(z.dtype)
        n = jnp.sum(w, axis=0)
        centre = jnp.sum(w * z, axis=0) / jnp.maximum(n, 1)
        spread = jnp.sqrt(jnp.sum(w * (z - centre[None]) ** 2, axis=0) / jnp.maximum(n, 1))
        kept = jnp.where(n >= 2, smoothing.astype(z.dtype), 1)
        return kept * mean + (1 - kept) * centre, jnp.maximum(
            kept * deviation + (1 - kept) * spread, floor.astype(z.dtype)
        )

    leaves, treedef = jax.tree.flatten(steps.mean)
    fitted = [
        one(*each)
        for each in zip(leaves, jax.tree.leaves(steps.deviation), jax.tree.leaves(z), strict=True)
    ]
    return Steps(*(treedef.unflatten(part) for part in zip(*fitted, strict=True)))


def place(actions, dist, z):
    """The disturbance at z ~ N(0, I): of the box by the uniform number Phi(z), else of ``dist``, or
    the actions' proposal, by its quantile function.
    """
    if isinstance(actions, choices.UniformBox):
        return actions.place(jax.tree.map(phi, z), dist)
    return quantile(actions.of(dist), z)


def quantile(dist, z):
    """``jast.distributions.quantile(dist, Phi(z))``, exact for normal distributions also where
    Phi(z) rounds to 1.
    """
    if isinstance(dist, D.Normal):
        return dist.loc + dist.scale * z
    if isinstance(dist, D.MultivariateNormalDiag):
        return dist.loc + dist.scale_diag * z
    if isinstance(dist, D.MultivariateNormalTri):
        return dist.loc + dist.scale_tri @ z
    if isinstance(dist, D.Independent):
        return quantile(dist.distribution, z)
    if isinstance(dist, D.Where):
        return dist._select(quantile(dist._a, z), quantile(dist._b, z))
    if isinstance(dist, D.Joint):
        return jax.tree.map(
            quantile, dist.distributions, z, is_leaf=lambda d: isinstance(d, D.Distribution)
        )
    # not by way of Phi(z), whose grid below 1 is 6e-8 in float32
    if isinstance(dist, D.Laplace):
        return dist.loc - dist.scale * jnp.sign(z) * (LOG_2 + log_ndtr(-jnp.abs(z)))
    if isinstance(dist, D.Logistic):
        return dist.loc + dist.scale * (log_ndtr(z) - log_ndtr(-z))
    if isinstance(dist, D.Uniform):
        width = dist.high - dist.low
        return jnp.where(z < 0, dist.low + width * ndtr(z), dist.high - width * ndtr(-z))
    if isinstance(dist, D.Bernoulli):
        return jnp.asarray(z >= -ndtri(dist.probs), dist.dtype)
    if isinstance(dist, D.Categorical):
        order, edges = cells(dist.probs)
        i = jnp.sum(z[..., None] >= edges, axis=-1)
        return jnp.take_along_axis(order, i[..., None], axis=-1)[..., 0].astype(dist.dtype)
    return D.quantile(dist, jax.tree.map(phi, z))


def cells(probs):
    """(the whole numbers by falling probability [..., k], the z between them [..., k - 1]): rare
    ones lie in the upper tail, where more noise reaches them.
    """
    order = jnp.argsort(-probs, axis=-1)
    p = jnp.take_along_axis(probs / jnp.sum(probs, axis=-1, keepdims=True), order, axis=-1)
    below = jnp.cumsum(p, axis=-1)[..., :-1]
    above = jnp.flip(jnp.cumsum(jnp.flip(p, axis=-1), axis=-1), axis=-1)[..., 1:]
    return order, jnp.where(below < 0.5, ndtri(below), -ndtri(above))


def latent(dist, x):
    """The inverse of `quantile`: z with ``quantile(dist, z) == x``, for a whole number the middle
    (in probability) of those; ValueError where none is known.
    """
    if isinstance(dist, D.Normal):
        return (x - dist.loc) / dist.scale
    if isinstance(dist, D.MultivariateNormalDiag):
        return (x - dist.loc) / dist.scale_diag
    if isinstance(dist, D.MultivariateNormalTri):
        return solve_triangular(dist.scale_tri, x - dist.loc, lower=dist.is_lower)
    if isinstance(dist, D.Independent):
        return latent(dist.distribution, x)
    if isinstance(dist, D.Where):
        return dist._select(latent(dist._a, x), latent(dist._b, x))
    if isinstance(dist, D.Joint):
        return jax.tree.map(
            latent, dist.distributions, x, is_leaf=lambda d: isinstance(d, D.Distribution)
        )
    if isinstance(dist, D.Laplace):
        v = (x - dist.loc) / dist.scale
        return -jnp.sign(v) * ndtri(jnp.exp(-jnp.abs(v)) / 2)
    if isinstance(dist, D.Logistic):
        v = (x - dist.loc) / dist.scale
        return -jnp.sign(v) * ndtri(jax.nn.sigmoid(-jnp.abs(v)))
    if isinstance(dist, D.Uniform):
        x = jnp.clip(x, dist.low, dist.high)
        # at an end of the support half a unit of rounding from there
        least = jnp.maximum(jnp.abs(x) * (jnp.finfo(x.dtype).eps / 4), jnp.finfo(x.dtype).tiny)
        below, above = (
            jnp.maximum(gap, least) / (dist.high - dist.low)
            for gap in (x - dist.low, dist.high - x)
        )
        return jnp.where(
            below < above, ndtri(jnp.minimum(below, 0.5)), -ndtri(jnp.minimum(above, 0.5))
        )
    if isinstance(dist, D.Categorical):
        order, edges = cells(dist.probs)
        i = jnp.argmax(order == x[..., None].astype(order.dtype), axis=-1)[..., None]
        end = jnp.full((*edges.shape[:-1], 1), jnp.inf, edges.dtype)
        low, high = (
            jnp.take_along_axis(e, i, axis=-1)[..., 0]
            for e in (jnp.concatenate([-end, edges], -1), jnp.concatenate([edges, end], -1))
        )
        # the middle in probability, from the side where the numbers are small
        return jnp.where(
            low + high > 0,
            -ndtri((ndtr(-low) + ndtr(-high)) / 2),
            ndtri((ndtr(low) + ndtr(high)) / 2),
        )
    return jax.tree.map(normal_score, D.cdf(dist, x))


def normal_score(u):
    """Phi^-1(u), finite: what rounds to 0 or 1 counts as half a unit of rounding from there."""
    eps = jnp.finfo(u.dtype).eps
    return ndtri(jnp.where(u > 0, jnp.minimum(u, 1 - eps / 2), eps / 2))


def phi(z):
    """The normal distribution function, kept below 1."""
    return jnp.minimum(ndtr(z), 1 - jnp.finfo(z.dtype).epsneg)


def player(sim, actions, z0, z):
    """The `Policy` that plays the latents ``z0`` (like x0; ``()``: the start is drawn from its own
    distribution) and ``z`` [T, ...].
    """
    return Policy(
        Partial(_start, sim.start, z0) if jax.tree.leaves(z0) else sim.start,
        Partial(_disturbance, sim.disturbance, actions, z),
    )


def _start(start, z0):
    return D.Deterministic(quantile(start(), z0))


def _disturbance(disturbance, actions, z, state, t):
    return D.Deterministic(
        place(
            actions,
            disturbance(state),
            jax.tree.map(lambda a: a[jnp.minimum(t, a.shape[0] - 1)], z),
        )
    )
