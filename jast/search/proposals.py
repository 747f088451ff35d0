"""Proposals for sequences of disturbances, a distribution of its own for every step: of latent normal numbers, or copied from good episodes."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from jast import actions as choices
from jast import distributions as D

__all__ = ["Gaussian", "copies", "drawer", "fit", "kinds", "noise", "standard"]

_CHOICE = np.uint32(1 << 31)  # addresses of an episode's choice of parents, apart from those of its levels


class Gaussian(NamedTuple):
    """z_t ~ N(mean_t, deviation_t^2), for t = 1 .. T: pytrees like a disturbance, leaves [T, ...], floats."""

    mean: Any
    deviation: Any


def kinds(sim, actions):
    """How x0 and x are proposed: "latent" where they have a quantile function or a box, else "copy"."""
    if isinstance(actions, choices.Quantiles):
        return "latent", "latent"
    if isinstance(actions, choices.UniformBox):  # a start is not of the box
        return "latent" if D.has_quantile(sim.start()) else "copy", "latent"
    return "copy", "copy"


def standard(like, steps):
    """The `Gaussian` N(0, 1) over ``steps`` disturbances of these shapes and dtypes: u = Phi(z) is uniform."""
    full = lambda value: jax.tree.map(lambda s: jnp.full((steps, *s.shape), value, D.float_dtype(s.dtype)), like)
    return Gaussian(full(0), full(1))


def noise(key, gaussian, offset):
    """z [T, ...] of one episode, by its ``key``: that of step t is drawn at level ``offset + t``."""
    leaves, treedef = jax.tree.flatten(gaussian.mean)

    def step(t):
        k = jax.random.fold_in(key, t + offset)
        keys = [k] if len(leaves) == 1 else [jax.random.fold_in(k, i) for i in range(len(leaves))]
        return treedef.unflatten([jax.random.normal(k, a.shape[1:], a.dtype) for k, a in zip(keys, leaves, strict=True)])

    z = jax.vmap(step)(jnp.arange(leaves[0].shape[0], dtype=jnp.int32))
    return jax.tree.map(lambda m, s, e: m + s * e, gaussian.mean, gaussian.deviation, z)


def copies(key, values, lengths, fresh, part):
    """The disturbances [T, ...] that one episode may copy, and whether it does [T].

    ``values`` [n, T, ...]: those of n parents, of which ``lengths`` [n] rows count, -1: no parent. Each step has a parent of its own, drawn uniformly, and
    with probability ``fresh`` none. The key is that of the episode; ``part`` tells x0 (0) from the steps (1).
    """
    steps = jax.tree.leaves(values)[0].shape[1]
    t = jnp.arange(steps, dtype=jnp.int32)
    parent, anew = jax.random.split(jax.random.fold_in(key, _CHOICE + np.uint32(part)))
    known = jnp.sum(lengths >= 0, dtype=jnp.int32)
    p = jax.random.randint(parent, (steps,), 0, jnp.maximum(known, 1), jnp.int32)
    use = (jax.random.uniform(anew, (steps,), fresh.dtype) >= fresh) & (t < lengths[p])
    return jax.tree.map(lambda a: a[p, t], values), use


def drawer(kind, actions, anew):
    """``(key, row, distribution) -> disturbance``, the row being z, or a pair of `copies`; ``anew(key, distribution)`` draws where there is nothing to copy."""

    def latent(key, z, dist):
        return _place(actions, dist, z)

    def copied(key, row, dist):
        value, use = row
        return jax.tree.map(lambda a, b: jnp.where(use, a, b), value, anew(key, dist))

    return latent if kind == "latent" else copied


def _place(actions, dist, z):
    """The disturbance at z ~ N(0, I): of the box by the uniform number Phi(z), else of ``dist`` by its quantile function."""
    if isinstance(actions, choices.UniformBox):
        return actions.place(jax.tree.map(_phi, z), dist)
    return _quantile(dist, z)


def _quantile(dist, z):
    """``quantile(dist, Phi(z))``, exact for normal distributions also where Phi(z) rounds to 1."""
    if isinstance(dist, D.Normal):
        return dist.loc + dist.scale * z
    if isinstance(dist, D.MultivariateNormalDiag):
        return dist.loc + dist.scale_diag * z
    if isinstance(dist, D.Independent):
        return _quantile(dist.distribution, z)
    if isinstance(dist, D.Joint):
        return jax.tree.map(_quantile, dist.distributions, z, is_leaf=lambda d: isinstance(d, D.Distribution))
    return D.quantile(dist, jax.tree.map(_phi, z))


def _phi(z):
    return jnp.minimum(ndtr(z), 1 - jnp.finfo(z.dtype).epsneg)


def fit(gaussian, z, counts, smoothing, floor):
    """The `Gaussian` nearer to episodes' ``z`` [n, T, ...], where they count ([n, T] bool): mean and standard deviation, ``smoothing`` of the old ones kept.

    A step that fewer than two episodes reached keeps its proposal. No deviation is below ``floor``.
    """

    def one(mean, deviation, z):
        w = counts.reshape(counts.shape + (1,) * (z.ndim - 2)).astype(z.dtype)
        n = jnp.sum(w, axis=0)
        centre = jnp.sum(w * z, axis=0) / jnp.maximum(n, 1)
        spread = jnp.sqrt(jnp.sum(w * (z - centre[None]) ** 2, axis=0) / jnp.maximum(n, 1))
        kept = jnp.where(n >= 2, smoothing.astype(z.dtype), 1)
        return kept * mean + (1 - kept) * centre, jnp.maximum(kept * deviation + (1 - kept) * spread, floor.astype(z.dtype))

    leaves, treedef = jax.tree.flatten(gaussian.mean)
    fitted = [one(*each) for each in zip(leaves, jax.tree.leaves(gaussian.deviation), jax.tree.leaves(z), strict=True)]
    return Gaussian(*(treedef.unflatten(part) for part in zip(*fitted, strict=True)))
