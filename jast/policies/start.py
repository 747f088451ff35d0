"""The start that a learned policy deserves: p(x0) exp(V(s0)), fitted by a mixture in the latents of
x0.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.policies.latent import log_normal

__all__ = ["Tilt", "fit", "log_density"]


class Tilt(NamedTuple):
    """The mixture sum_k weights[k] N(means[k], deviations[k]^2) of the latents of x0: [K] of sum 1,
    [K, n0] and [K, n0].
    """

    weights: Any
    means: Any
    deviations: Any


def nominal(n0, deviation=1.0):
    """The `Tilt` that is N(0, deviation^2); with 1, p(x0)."""
    return Tilt(
        jnp.ones((1,), jnp.float32),
        jnp.zeros((1, n0), jnp.float32),
        jnp.full((1, n0), deviation, jnp.float32),
    )


def log_density(tilt, z):
    """Log density [] at the latents ``z`` [n0], and the log of each component's part in it [K]."""
    parts = jax.vmap(log_normal, (None, 0, 0))(z, tilt.means, tilt.deviations) + jnp.log(
        tilt.weights
    )
    return jax.nn.logsumexp(parts), parts


def fit(
    key,
    log_value,
    n0,
    *,
    wide=3.0,
    samples=4096,
    components=4,
    rounds=3,
    iterations=30,
    least=0.1,
    defensive=0.05,
):
    """The `Tilt` nearest to the density N(z0; 0, I) exp(log_value(z0)), up to its constant; its
    first component is p(x0), with the share ``defensive``.

    ``log_value`` is a function of the latents [n0]; what it gives may be -inf or NaN, which counts
    as 0. In each of ``rounds``, ``samples`` draws, half of them of N(0, wide^2) and half of the
    last fit, are weighted by the density over their own, and ``components`` normal distributions
    fitted by expectation maximisation (Bishop 2006, section 9.2, diagonal covariances), no
    deviation below ``least``. No symmetry is assumed. Where no weight is above 0 the fit is p(x0)
    alone. The key is consumed.
    """
    broad = nominal(n0, wide)
    value = jax.vmap(log_value)

    def improve(last, key):
        for_z, for_which, for_first = jax.random.split(key, 3)
        which = jax.random.categorical(for_which, jnp.log(last.weights), shape=(samples // 2,))
        mean, deviation = (
            jnp.concatenate([jnp.broadcast_to(b, (samples - samples // 2, n0)), a[which]])
            for a, b in zip(last[1:], broad[1:], strict=True)
        )
        z = mean + deviation * jax.random.normal(for_z, (samples, n0), jnp.float32)
        density = lambda tilt: jax.vmap(lambda z: log_density(tilt, z)[0])(z)
        log_w = jax.vmap(log_normal)(z) + value(z) - jnp.logaddexp(density(broad), density(last))
        log_w = jnp.where(jnp.isfinite(log_w), log_w, -jnp.inf)
        top = jnp.max(log_w)
        w = jnp.where(jnp.isfinite(top), jnp.exp(log_w - jnp.where(jnp.isfinite(top), top, 0)), 0)
        tilt = _first(for_first, z, w, components)
        return lax.fori_loop(
            0, iterations, lambda _, t: _iterate(t, z, w, least), tilt
        ), jnp.isfinite(top)

    wide_ones = Tilt(*(jnp.repeat(a, components, axis=0) for a in broad))._replace(
        weights=jnp.full((components,), 1 / components, jnp.float32)
    )
    last, known = lax.scan(improve, wide_ones, jax.random.split(key, rounds))
    share, own = jnp.where(known[-1], defensive, 1).astype(jnp.float32)[None], nominal(n0)
    return Tilt(
        *(
            jnp.concatenate(pair)
            for pair in (
                (share, (1 - share) * last.weights),
                (own.means, last.means),
                (own.deviations, last.deviations),
            )
        )
    )


def _first(key, z, w, components):
    """Components at draws by weight, each the one farthest from those taken before."""
    drawn = z[jax.random.categorical(key, jnp.log(jnp.where(jnp.sum(w) > 0, w, 1)), shape=(256,))]
    deviation = jnp.sqrt(jnp.var(drawn, axis=0) + 0.01)

    def take(nearest, _):
        i = jnp.argmax(nearest)
        return (
            jnp.minimum(
                nearest, jnp.sum(((drawn - drawn[i][None]) / deviation[None]) ** 2, axis=1)
            ),
            drawn[i],
        )

    _, means = lax.scan(take, jnp.full(drawn.shape[:1], jnp.finfo(z.dtype).max), length=components)
    return Tilt(
        jnp.full((components,), 1 / components, z.dtype),
        means,
        jnp.tile(deviation[None] / 2, (components, 1)),
    )


def _iterate(tilt, z, w, least):
    """One E and one M step."""
    r = jax.vmap(lambda z: jax.nn.softmax(log_density(tilt, z)[1]))(z) * w[:, None]
    count = jnp.sum(r, axis=0)
    # one that nothing is near to stays where it is, without weight
    kept = count > 1e-6 * jnp.sum(w)
    r = r / jnp.where(kept, count, 1)[None]
    means = jnp.einsum("nk,nd->kd", r, z)
    variance = jnp.einsum("nk,nkd->kd", r, (z[:, None] - means[None]) ** 2)
    weights = jnp.maximum(jnp.where(kept, count, 0), jnp.finfo(z.dtype).tiny)
    moved = Tilt(weights / jnp.sum(weights), means, jnp.maximum(jnp.sqrt(variance), least))
    return Tilt(
        moved.weights,
        *(jnp.where(kept[:, None], a, b) for a, b in zip(moved[1:], tilt[1:], strict=True)),
    )
