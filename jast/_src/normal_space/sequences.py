"""Sequences of disturbances as normal numbers: z ~ N(0, I) is a draw of the model, x = Q(Phi(z)),
and a proposal moves each step's z.

Shared by the search `jast.search.cem`, the objective of `jast.cross_entropy.over` and
`jast.estimate.failure_proposal`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core import actions as choices
from jast._src.core.policy import Policy
from jast._src.core.typing import ArrayTree
from jast._src.distributions import fine_draws
from jast._src.distributions.flat_rows import filled

__all__ = [
    "Steps",
    "fit",
    "log_ratio",
    "sample",
    "disturbance_at",
    "latent_policy",
    "standard_normal",
]


class Steps(NamedTuple):
    """z_t ~ N(mean_t, deviation_t^2), for t = 1 .. T: pytrees like a disturbance, leaves [T, ...],
    floats.
    """

    mean: ArrayTree
    deviation: ArrayTree


def standard_normal(like, steps, deviation=1):
    """The `Steps` N(0, deviation^2) over ``steps`` disturbances of these shapes and dtypes; by
    default u = Phi(z) is uniform.
    """
    return Steps(filled(like, 0, steps), filled(like, deviation, steps))


def sample(key, steps, offset):
    """z [T, ...] of one episode, by its ``key``: that of step t is drawn at level ``offset +
    t``.
    """
    leaves, treedef = jax.tree.flatten(steps.mean)

    def step(t):
        k = jax.random.fold_in(key, t + offset)
        keys = [k] if len(leaves) == 1 else [jax.random.fold_in(k, i) for i in range(len(leaves))]
        return treedef.unflatten(
            [fine_draws.normal(k, a.shape[1:], a.dtype) for k, a in zip(keys, leaves, strict=True)]
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

    parts = jax.tree.leaves(jax.tree.map(of, steps.mean, steps.deviation, z))
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
        deviation = jnp.maximum(kept * deviation + (1 - kept) * spread, floor.astype(z.dtype))
        return Steps(kept * mean + (1 - kept) * centre, deviation)

    fitted = jax.tree.map(one, steps.mean, steps.deviation, z)
    return jax.tree.transpose(jax.tree.structure(steps.mean), None, fitted)


def disturbance_at(actions, dist, z):
    """The disturbance at z ~ N(0, I): of the box by the uniform number Phi(z), else of ``dist``, or
    the actions' proposal, by its quantile function.
    """
    if isinstance(actions, choices.UniformBox):
        return actions.place(jax.tree.map(D.phi, z), dist)
    return D.from_normal(actions.of(dist), z)


def latent_policy(sim, actions, z0, z):
    """The `Policy` that plays the latents ``z0`` (like x0; ``()``: the start is drawn from its own
    distribution) and ``z`` [T, ...].
    """
    return Policy(
        Partial(_start, sim.start, z0) if jax.tree.leaves(z0) else sim.start,
        Partial(_disturbance, sim.disturbance, actions, z),
    )


def _start(start, z0):
    return D.Deterministic(D.from_normal(start(), z0))


def _disturbance(disturbance, actions, z, state, t):
    now = jax.tree.map(lambda a: a[jnp.minimum(t, a.shape[0] - 1)], z)
    return D.Deterministic(disturbance_at(actions, disturbance(state), now))
