"""How a proposal moves to the elites: those that were truly evaluated, those of the surrogate, and
those of short searches on it.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.cross_entropy import gaussian, mixture, surrogates
from jast.cross_entropy.gaussian import Gaussian
from jast.cross_entropy.mixture import Mixture

__all__ = [
    "Points",
    "draw",
    "moments",
    "refit_to_elites",
    "refit_with_surrogate",
    "search_around",
]


class Points(NamedTuple):
    """Weighted points; one of weight 0 is not there."""

    x: jax.Array
    """[n, d]"""
    weights: jax.Array
    """[n]"""


def draw(key, proposal, n):
    """``n`` draws [n, d]."""
    return (mixture if isinstance(proposal, Mixture) else gaussian).sample(key, proposal, n)


def moments(proposal):
    """The `Gaussian` of the proposal's mean and covariance."""
    if isinstance(proposal, Gaussian):
        return proposal
    w = proposal.weights / jnp.sum(proposal.weights)
    mean = w @ proposal.means
    z = proposal.means - mean[None]
    return Gaussian(
        mean, jnp.einsum("k,kde->de", w, proposal.covariances) + jnp.einsum("k,kd,ke->de", w, z, z)
    )


def refit_to_elites(proposal, elites):
    """Algorithm 1: the `Gaussian` of greatest likelihood for the elites, the old one where they are
    too few for a covariance.
    """
    return gaussian.fit(proposal, elites.x, elites.weights)


class ModelSearch(NamedTuple):
    """The outcome of short searches on the surrogate, one an elite."""

    x: jax.Array
    """[n, d]: the best point of each"""
    value: jax.Array
    """[n]: what the surrogate says there"""
    fitted: Gaussian
    """[n, ...]: their last proposals"""


def search_around(key, model, centres, covariance, samples, elites, iterations):
    """`ModelSearch`: the cross-entropy method on a surrogate ``model`` ([n, d] -> [n]) from
    N(centre, covariance), for each of ``centres`` [n, d] (Algorithm 4).
    """

    def search(key, centre):
        def iterate(carry, key):
            g, best, value = carry
            x = gaussian.sample(key, g, samples)
            v = model(x)
            least, i = lax.top_k(-v, elites)
            better = -least[0] < value
            g = gaussian.fit(g, x[i], jnp.ones((elites,), x.dtype))
            return (g, jnp.where(better, x[i[0]], best), jnp.where(better, -least[0], value)), None

        start = Gaussian(centre, covariance), centre, jnp.asarray(jnp.inf, centre.dtype)
        (g, best, value), _ = lax.scan(iterate, start, jax.random.split(key, iterations))
        return ModelSearch(best, value, g)

    return jax.vmap(search)(jax.random.split(key, len(centres)), centres)


def refit_with_surrogate(key, plan, settings, proposal, first, elites, seen, chosen):
    """Algorithms 2 to 5: (the next proposal, points to evaluate best first [n, d], the points that
    the surrogate judged [m, d]).

    ``first``: the initial proposal; ``elites``: `Points`, best first; ``seen``: the (x, values,
    mask) that the surrogate is fitted to; ``chosen``: how many of the judged samples are elites,
    traced.
    """
    for_samples, for_searches = jax.random.split(key)
    x, y, mask = seen
    y, mask = surrogates.warp_values(plan.warp, y, mask)
    window = plan.frame == "window"
    frame = surrogates.whitening_frame(x, mask) if window else _spherical_frame(moments(first))
    model = surrogates.fit(plan.surrogate, x, y, mask, frame, plan.detail)
    mean = partial(surrogates.predict, plan.surrogate, model)
    aim = mean
    if plan.optimistic:
        aim = partial(surrogates.lower_bound, plan.surrogate, model, settings.optimism)

    judged = draw(for_samples, proposal, plan.judged)  # Algorithm 3
    _, i = lax.top_k(-mean(judged), max(plan.chosen))
    model_elites = Points(judged[i], (jnp.arange(len(i), dtype=jnp.int32) < chosen).astype(x.dtype))

    spread = (moments(proposal) if plan.current else moments(first)).covariance / settings.alpha
    sub = search_around(for_searches, aim, elites.x, spread, *plan.sub)
    found = Points(sub.x, elites.weights)
    # Algorithm 2: true, model and sub-elites
    everything = jax.tree.map(lambda *a: jnp.concatenate(a), elites, model_elites, found)
    best = jnp.argsort(jnp.where(elites.weights > 0, sub.value, jnp.inf))
    if isinstance(proposal, Gaussian):
        return refit_to_elites(proposal, everything), sub.x[best], judged
    new = _refit_mixture(plan, settings, proposal, elites, sub, spread, everything)
    return new, sub.x[best], judged


def _refit_mixture(plan, settings, proposal, elites, sub, spread, everything):
    """Algorithm 5: expectation maximisation from a component an elite, `plan.components` of
    them.
    """
    k = plan.components
    there = elites.weights[:k]
    weights = there / jnp.maximum(jnp.sum(there), 1)
    means, covariances = (
        (sub.fitted.mean[:k], sub.fitted.covariance[:k])
        if plan.start == "searches"
        else (elites.x[:k], jnp.broadcast_to(spread[None], (k, *spread.shape)))
    )
    new = mixture.em(
        Mixture(weights, means, covariances),
        *everything,
        iterations=plan.em_iterations,
        regularisation=settings.regularisation,
    )
    return jax.tree.map(lambda a, b: jnp.where(jnp.any(there > 0), a, b), new, proposal)


def _spherical_frame(proposal):
    """The frame of one scale for all coordinates: the root of the mean variance."""
    d = proposal.mean.size
    return surrogates.Frame(
        proposal.mean,
        jnp.sqrt(jnp.trace(proposal.covariance) / d) * jnp.eye(d, dtype=proposal.mean.dtype),
    )
