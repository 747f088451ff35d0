"""One iteration of a cross-entropy method as two pure functions, ask and tell, and their loop in
one program for objectives in JAX; and how a proposal is refitted to the elites: those that were
truly evaluated, those of the surrogate, and those of short searches on it.

Every evaluation is kept in one log, in order; an iteration reads the rows that it may remember from
there. Batches are padded to the largest one, with masks.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.counter_prng import tree_keys
from jast._src.cross_entropy import gaussian, mixture, surrogates
from jast._src.cross_entropy.gaussian import Gaussian
from jast._src.cross_entropy.mixture import Mixture
from jast._src.cross_entropy.result import CEResult, History
from jast._src.util.pytrees import select

__all__ = ["Plan", "Settings", "State", "ask", "begin", "finish", "run", "tell"]


class Plan(NamedTuple):
    """The static part of a method: what is compiled."""

    method: str
    """"ce_method", "ce_surrogate" or "ce_mixture\""""
    counts: tuple[int, ...]
    """True evaluations of each iteration"""
    elites: tuple[int, ...]
    """Of each iteration"""
    elitism: bool
    """Elites of all iterations, not only of the last batch"""
    memory: int = 0
    """The surrogate sees the evaluations of so many iterations ..."""
    best: int = 0
    """... and so many of the best before"""
    evaluated: int = 0
    """Points of the last iteration's searches on the surrogate that are truly evaluated, of at most
    half a batch
    """
    current: bool = False
    """Those searches have the current covariance, not the initial one"""
    surrogate: str = ""
    detail: int | str | None = None
    """Of the surrogate: see `surrogates.fit`"""
    warp: str = ""
    frame: str = ""
    """Of the surrogate: "window", that of the points it sees, or "initial", the scale of the
    initial proposal
    """
    optimistic: bool = False
    """Those searches minimise the model's mean less ``Settings.optimism`` of its standard
    deviations
    """
    judged: int = 0
    """Samples that only the surrogate judges, in each iteration"""
    chosen: tuple[int, ...] = ()
    """How many of them are elites, in each iteration"""
    sub: tuple[int, ...] = ()
    """Samples, elites and iterations of a search on the surrogate"""
    components: int = 0
    start: str = ""
    """Where a mixture's fit begins: "elites" with the searches' first covariance, or "searches", as
    these ended
    """


class Settings(NamedTuple):
    """The traced part."""

    alpha: jax.Array
    optimism: jax.Array
    regularisation: jax.Array


class State(NamedTuple):
    """Between two iterations. [n] true evaluations in all, K iterations."""

    key: jax.Array
    k: jax.Array
    """int32: the iteration to come"""
    x: jax.Array
    """[n, d]: the log"""
    value: jax.Array
    """[n]: inf where there is none yet"""
    first: Gaussian | Mixture
    """The initial proposal"""
    proposal: Gaussian | Mixture
    pending: jax.Array
    """[evaluated, d]: points to be evaluated"""
    proposals: Gaussian | Mixture
    """[K + 1, ...]"""
    model_x: jax.Array
    """[K, m, d]"""


@partial(jax.jit, static_argnums=0)
def begin(plan: Plan, key: jax.Array, proposal: Gaussian | Mixture) -> State:
    """The `State` before the first iteration."""
    d, dtype = moments(proposal).mean.shape[0], jax.tree.leaves(proposal)[0].dtype
    n, steps = sum(plan.counts), len(plan.counts)
    proposals = jax.tree.map(lambda a: jnp.broadcast_to(a[None], (steps + 1, *a.shape)), proposal)
    return State(
        key=tree_keys(key, 1)[0],
        k=jnp.int32(0),
        x=jnp.full((n, d), jnp.nan, dtype),
        value=jnp.full((n,), jnp.inf, dtype),
        first=proposal,
        proposal=proposal,
        pending=jnp.zeros((plan.evaluated, d), dtype),
        proposals=proposals,
        model_x=jnp.full((steps, plan.judged, d), jnp.nan, dtype),
    )


@partial(jax.jit, static_argnums=0)
def ask(plan: Plan, state: State) -> jax.Array:
    """The points of the next iteration, [max(m), d], of which the first ``plan.counts[k]``
    count.
    """
    x = draw(_key(state, 0), state.proposal, max(plan.counts))
    rows = jnp.arange(plan.evaluated, dtype=jnp.int32)
    known = (state.k > 0) & (rows < _at(plan.counts, state.k) // 2)
    return x.at[: plan.evaluated].set(jnp.where(known[:, None], state.pending, x[: plan.evaluated]))


@partial(jax.jit, static_argnums=0)
def tell(plan, settings, state, x, value):
    """The `State` after the values [max(m)] at ``x`` [max(m), d]."""
    k, rows = state.k, jnp.arange(max(plan.counts), dtype=jnp.int32)
    at = _at(np.cumsum((0, *plan.counts)), k)
    count, kept = _at(plan.counts, k), _at(plan.elites, k)
    live = rows < count
    value = jnp.where(live, value, jnp.inf)
    places = jnp.where(live, at + rows, len(state.value))
    state = state._replace(
        x=state.x.at[places].set(x, mode="drop"),
        value=state.value.at[places].set(value, mode="drop"),
    )
    pool = (state.x, state.value) if plan.elitism else (x, value)
    elites = _elites(*pool, kept, max(plan.elites))
    proposal, pending = state.proposal, state.pending
    if plan.method == "ce_method":
        proposal = gaussian.fit(proposal, *elites)  # Algorithm 1
    else:
        seen = _surrogate_data(plan, state)
        proposal, better, judged = refit_with_surrogate(
            _key(state, 1), plan, settings, proposal, state.first, elites, seen, _at(plan.chosen, k)
        )
        pending = better[: plan.evaluated]
        state = state._replace(model_x=state.model_x.at[k].set(judged))
    proposals = jax.tree.map(lambda a, b: a.at[k + 1].set(b), state.proposals, proposal)
    return state._replace(k=k + 1, proposal=proposal, pending=pending, proposals=proposals)


def _key(state, part):
    return jax.random.fold_in(jax.random.fold_in(state.key, state.k), part)


def _at(sizes, k):
    return jnp.asarray(sizes, jnp.int32)[k]


def _elites(x, value, count, most):
    """`Points`: the ``count`` best of finite value, of at most ``most``, best first; the others
    have weight 0.
    """
    finite = jnp.isfinite(value)
    _, i = lax.top_k(-jnp.where(finite, value, jnp.inf), min(most, len(value)))
    weights = finite[i] & (jnp.arange(len(i), dtype=jnp.int32) < count)
    return Points(jnp.where(weights[:, None], x[i], x[i[0]]), weights.astype(x.dtype))


def _surrogate_data(plan, state):
    """What the surrogate is fitted to, (x, values, mask): the rows of the log of the iterations
    that it remembers, and the best before.
    """
    n, begins = len(state.value), np.cumsum((0, *plan.counts))
    firsts = [begins[max(0, i + 1 - plan.memory)] for i in range(len(plan.counts))]
    width, since = max(begins[1:] - firsts), _at(firsts, state.k)
    rows = since + jnp.arange(width, dtype=jnp.int32)
    mask = rows < _at(begins[1:], state.k)
    if older := min(plan.best, n - width):
        before = (jnp.arange(n, dtype=jnp.int32) < since) & jnp.isfinite(state.value)
        _, i = lax.top_k(-jnp.where(before, state.value, jnp.inf), older)
        rows, mask = jnp.concatenate([rows, i]), jnp.concatenate([mask, before[i]])
    x, value = (a.at[rows].get(mode="clip") for a in (state.x, state.value))
    return x, value, mask


@partial(jax.jit, static_argnums=0)
def finish(plan: Plan, state: State) -> CEResult:
    """The `CEResult` of what has been evaluated."""
    last = np.cumsum(plan.counts) - 1
    finite = jnp.isfinite(state.value)
    value = jnp.where(finite, state.value, jnp.inf)
    order = jnp.arange(len(value), dtype=jnp.int32)
    so_far = order[None, :] <= jnp.asarray(last, jnp.int32)[:, None]
    place = jnp.argmin(jnp.where(so_far, value[None, :], jnp.inf), axis=1)
    best = value[place]
    x = jnp.where(jnp.isfinite(best)[:, None], state.x[place], jnp.nan)
    evaluated = order < _at(np.cumsum((0, *plan.counts)), state.k)
    iteration = jnp.asarray(np.repeat(np.arange(len(plan.counts), dtype=np.int32), plan.counts))
    history = History(
        x=state.x,
        value=state.value,
        iteration=iteration,
        best_x=x,
        best_value=best,
        proposals=state.proposals,
        model_x=state.model_x,
    )
    return CEResult(
        proposal=state.proposal,
        best_x=x[-1],
        best_value=best[-1],
        history=history,
        invalid=jnp.sum(evaluated & ~finite, dtype=jnp.int32),
    )


@partial(jax.jit, static_argnums=0)
def run(plan, settings, key, objective, proposal):
    """All iterations in one program: `CEResult`. ``objective`` is a pytree that is called, [d] ->
    scalar.
    """

    def iterate(state, _):
        x = ask(plan, state)
        return tell(plan, settings, state, x, jax.vmap(objective)(x).astype(x.dtype)), None

    return finish(plan, lax.scan(iterate, begin(plan, key, proposal), length=len(plan.counts))[0])


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
    within = jnp.einsum("k,kde->de", w, proposal.covariances)
    return Gaussian(mean, within + jnp.einsum("k,kd,ke->de", w, z, z))


def search_around(key, model, centres, covariance, samples, elites, iterations):
    """The cross-entropy method on a surrogate ``model`` ([n, d] -> [n]) from N(centre, covariance),
    for each of ``centres`` [n, d] (Algorithm 4): (the best point of each [n, d], what the surrogate
    says there [n], their last proposals, a `Gaussian` [n, ...]).
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
        return best, value, g

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
    mean = surrogates.fit(plan.surrogate, x, y, mask, frame, plan.detail)
    aim = partial(mean, optimism=settings.optimism) if plan.optimistic else mean

    judged = draw(for_samples, proposal, plan.judged)  # Algorithm 3
    _, i = lax.top_k(-mean(judged), max(plan.chosen))
    model_elites = Points(judged[i], (jnp.arange(len(i), dtype=jnp.int32) < chosen).astype(x.dtype))

    spread = (moments(proposal) if plan.current else moments(first)).covariance / settings.alpha
    best, value, fitted = search_around(for_searches, aim, elites.x, spread, *plan.sub)
    found = Points(best, elites.weights)
    # Algorithm 2: true, model and sub-elites
    everything = jax.tree.map(lambda *a: jnp.concatenate(a), elites, model_elites, found)
    better = best[jnp.argsort(jnp.where(elites.weights > 0, value, jnp.inf))]
    if isinstance(proposal, Gaussian):
        return gaussian.fit(proposal, *everything), better, judged
    new = _refit_mixture(plan, settings, proposal, elites, fitted, spread, everything)
    return new, better, judged


def _refit_mixture(plan, settings, proposal, elites, fitted, spread, everything):
    """Algorithm 5: expectation maximisation from a component an elite, `plan.components` of
    them.
    """
    k = plan.components
    there = elites.weights[:k]
    weights = there / jnp.maximum(jnp.sum(there), 1)
    if plan.start == "searches":
        first = Mixture(weights, fitted.mean[:k], fitted.covariance[:k])
    else:
        covariances = jnp.broadcast_to(spread[None], (k, *spread.shape))
        first = Mixture(weights, elites.x[:k], covariances)
    new = mixture.em(first, *everything, regularisation=settings.regularisation)
    return select(jnp.any(there > 0), new, proposal)


def _spherical_frame(proposal):
    """The frame of one scale for all coordinates: the root of the mean variance."""
    d = proposal.mean.size
    scale = jnp.sqrt(jnp.trace(proposal.covariance) / d)
    return surrogates.Frame(proposal.mean, scale * jnp.eye(d, dtype=proposal.mean.dtype))
