"""The start that goes with a learned policy: p(x0) exp(V(s0)), fitted by a mixture in the latents
of x0.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.cross_entropy import mixture
from jast._src.cross_entropy.mixture import Mixture

__all__ = ["Tilt", "fit_tilt"]

COMPONENTS = 4  # of the fit; a convention
EM_ITERATIONS = 30  # in each round; a convention
LEAST_DEVIATION = 0.1  # so that no component shrinks onto a few draws
DEFENSIVE = 0.05  # weight of p(x0), which keeps importance weights bounded
CANDIDATES = 256  # draws among which the first means are chosen


class Tilt(NamedTuple):
    """The mixture sum_k weights[k] N(means[k], deviations[k]^2) of the latents of x0."""

    weights: jax.Array
    """[K] of sum 1"""
    means: jax.Array
    """[K, n0]"""
    deviations: jax.Array
    """[K, n0]"""


def fit_tilt(
    key: jax.Array,
    log_value: Callable[[jax.Array], jax.Array],
    n0: int,
    *,
    width: float | jax.Array = 3.0,
    samples: int = 4096,
    rounds: int = 3,
) -> Tilt:
    """The `Tilt` nearest to the density N(z0; 0, I) exp(log_value(z0)), up to its constant; its
    first component is p(x0).

    ``log_value`` is a function of the latents [n0]; what it gives may be -inf or NaN, which counts
    as 0. In each of ``rounds``, ``samples`` draws, about half of them of N(0, width^2) and half of
    the last fit, are weighted, and a mixture is fitted by expectation maximisation. No symmetry is
    assumed. Where no weight is above 0 the fit is p(x0) alone. The key is consumed.
    """
    model, broad = _normal(n0, 1.0), _normal(n0, width)

    def improve(last, key):
        for_z, for_first = jax.random.split(key)
        proposal = _join(0.5, broad, last)
        z = mixture.sample(for_z, proposal, samples)
        log_ratio = mixture.log_prob(model, z) - mixture.log_prob(proposal, z)
        log_weights = log_ratio + jax.vmap(log_value)(z)
        log_weights = jnp.where(jnp.isfinite(log_weights), log_weights, -jnp.inf)
        top = jnp.max(log_weights)
        any_weight = jnp.isfinite(top)
        weights = jnp.where(any_weight, jnp.exp(log_weights - jnp.where(any_weight, top, 0)), 0)
        fitted = mixture.em(
            _first_components(for_first, z, weights, COMPONENTS),
            z,
            weights,
            EM_ITERATIONS,
            least=0,
            diagonal=True,
            least_variance=LEAST_DEVIATION**2,
        )
        return fitted, any_weight

    first = jax.tree.map(lambda a: jnp.repeat(a, COMPONENTS, axis=0), broad)
    first = first._replace(weights=first.weights / COMPONENTS)
    last, any_weight = lax.scan(improve, first, jax.random.split(key, rounds))
    fitted = _join(jnp.where(any_weight[-1], DEFENSIVE, 1), model, last)
    variances = jnp.diagonal(fitted.covariances, axis1=1, axis2=2)
    return Tilt(fitted.weights, fitted.means, jnp.sqrt(variances))


def _normal(n0, deviation):
    """N(0, deviation^2) as a `Mixture` of one component."""
    return Mixture(
        jnp.ones((1,), jnp.float32),
        jnp.zeros((1, n0), jnp.float32),
        jnp.asarray(deviation, jnp.float32) ** 2 * jnp.eye(n0, dtype=jnp.float32)[None],
    )


def _join(weight, one, other):
    """``one`` with this ``weight``, and ``other`` with the rest."""
    weight = jnp.asarray(weight, jnp.float32)
    one = one._replace(weights=weight * one.weights)
    other = other._replace(weights=(1 - weight) * other.weights)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, other)


def _first_components(key, z, weights, k):
    """``k`` components at draws by weight, each the one farthest from those taken before."""
    log_weights = jnp.log(jnp.where(jnp.sum(weights) > 0, weights, 1))
    drawn = z[jax.random.categorical(key, log_weights, shape=(CANDIDATES,))]
    variance = jnp.var(drawn, axis=0) + 0.01  # never 0

    def take(nearest, _):
        mean = drawn[jnp.argmax(nearest)]
        distance = jnp.sum((drawn - mean[None]) ** 2 / variance[None], axis=1)
        return jnp.minimum(nearest, distance), mean

    _, means = lax.scan(take, jnp.full((CANDIDATES,), jnp.finfo(z.dtype).max), length=k)
    return Mixture(
        jnp.full((k,), 1 / k, z.dtype), means, jnp.tile(jnp.diag(variance / 4)[None], (k, 1, 1))
    )
