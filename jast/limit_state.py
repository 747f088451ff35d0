"""A simulator as a limit state of normal numbers: an episode is a point z [D], under the model z ~
N(0, I), and proposals are mixtures of Gaussians there.

z holds the latents of x0 first, then those of x_1, x_2 ..: x_t is the quantile of p(x | s) at
Phi(z_t). An episode that ends after n steps has used the first ``used`` numbers; the others decide
nothing, so densities are taken over the used ones. With Cholesky factors, lower triangular, these
are a cumulative sum.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import actions as choices
from jast import distributions as D
from jast.contract import contract
from jast.cross_entropy.sequences import player
from jast.distributions.numbers import unflat
from jast.episode import Episode, replay, rollout
from jast.outline import outline
from jast.policy import Policy
from jast.progress import Progress, advance, begin, conclude
from jast.pytrees import count
from jast.rewards import log_likelihood
from jast.simulator import Simulator

__all__ = ["log_ratios", "outcomes", "place"]


class Outcomes(NamedTuple):
    """What episodes [n] came to."""

    failure: Any
    """bool"""
    distance: Any
    """Miss distance; inf where invalid"""
    used: Any
    """int32: how many of the numbers of z decided it"""
    length: Any
    """int32: steps"""
    invalid: Any
    """bool"""

    @property
    def score(self):
        """What a search minimises: the miss distance, -inf for a failure, inf for an invalid
        episode.
        """
        return jnp.where(self.failure, -jnp.inf, jnp.where(self.invalid, jnp.inf, self.distance))


class Latent(NamedTuple):
    """A mixture of K Gaussians over z [D], one drawn a trace."""

    log_weights: Any
    """[K], of sum 1 as probabilities; -inf for a component that is not used"""
    means: Any
    """[K, D]"""
    factors: Any
    """[K, D, D] lower Cholesky factors of the covariances"""
    inverses: Any
    """[K, D, D] their inverses"""


def check(function: str, sim: Simulator) -> None:
    """ValueError unless the simulator fits the contract and its disturbances have a quantile
    function.
    """
    contract(sim, observed=False)
    about = outline(sim)
    for name, offer in (("disturbance", about.disturbance), ("start", about.start)):
        if not offer.quantile:
            raise ValueError(
                f"{function}: {name}: {offer.kind} has no quantile function;"
                " jast.estimate.monte_carlo needs none"
            )


def dimension(sim: Simulator) -> int:
    """D."""
    about = outline(sim)
    return count(about.x0) + sim.horizon * count(about.x)


def normal_numbers(sim: Simulator) -> Any:
    """The float dtype of z."""
    about = outline(sim)
    return jnp.result_type(*(D.float_dtype(s.dtype) for s in jax.tree.leaves((about.x0, about.x))))


def ended(sim: Simulator, z: jax.Array, reward: Callable) -> tuple[Progress, jax.Array]:
    """The `Progress` at the end of the one episode of ``z`` [D], and its steps; differentiable in
    forward mode.
    """
    policy, last = policy_of(sim, z), jnp.asarray(sim.horizon, jnp.int32)
    first = begin(sim, reward, D.mode(policy.start()))

    def body(carry):
        progress, t = carry
        x = D.mode(policy.disturbance(progress.state, t))
        return advance(sim, reward, progress, x, t + 1 >= last), t + 1

    end, length = lax.while_loop(lambda c: ~c[0].done, body, (first, jnp.zeros((), jnp.int32)))
    return conclude(sim, reward, end), length


def unit(z: np.ndarray) -> np.ndarray:
    """The directions of points ``z`` [..., D]; that of 0 is 0. On the host."""
    return z / np.maximum(np.linalg.norm(z, axis=-1, keepdims=True), 1e-12)


def outcome(sim: Simulator, z: jax.Array) -> Outcomes:
    """`Outcomes` of the one episode of ``z`` [D], differentiable in forward mode."""
    end, length = ended(sim, z, log_likelihood)
    about = outline(sim)
    used = count(about.x0) + length * count(about.x)
    return Outcomes(end.failure, end.distance, used, length, end.invalid)


@jax.jit
def outcomes(sim, z):
    """`Outcomes` [n] of ``z`` [n, D]."""
    return jax.vmap(lambda z: outcome(sim, z))(z)


@jax.jit
def episodes(sim, z):
    """The `jast.Episode` of each of ``z`` [n, D], without states."""
    return jax.vmap(
        lambda z: rollout(jax.random.key(0), sim, policy_of(sim, z))._replace(states=None)
    )(z)


def place(q, u, e):
    """Points [n, D] of the mixture ``q`` by uniform numbers ``u`` [n], of the components, and
    normal ones ``e`` [n, D].
    """
    live = _live(q)
    k = jnp.minimum(
        jnp.sum(u[:, None] >= jnp.cumsum(jnp.exp(q.log_weights))[None], axis=1, dtype=jnp.int32),
        live - 1,
    )

    def component(i, z):
        return jnp.where((k == i)[:, None], q.means[i][None] + e @ q.factors[i].T, z)

    return lax.fori_loop(0, live, component, e)


def log_ratios(q, z, used):
    """log q_k - log p [n, K] over the first ``used`` [n] numbers of each of ``z`` [n, D]."""

    def component(mean, inverse):
        e = (z - mean[None]) @ inverse.T
        each = 0.5 * (z - e) * (z + e) + jnp.log(jnp.diagonal(inverse))[None]
        kept = jnp.arange(z.shape[1], dtype=jnp.int32)[None] < used[:, None]
        return jnp.sum(jnp.where(kept, each, 0), axis=1)

    one = lambda i, out: out.at[:, i].set(component(q.means[i], q.inverses[i]))
    return lax.fori_loop(0, _live(q), one, jnp.zeros((len(z), len(q.means)), z.dtype))


def _live(q):
    """How many components are used: they come first."""
    return jnp.sum(jnp.isfinite(q.log_weights), dtype=jnp.int32)


def policy_of(sim: Simulator, z: jax.Array) -> Policy:
    like = outline(sim)
    size0 = count(like.x0)
    return player(
        sim,
        choices.quantiles(),
        unflat(z[:size0], like.x0),
        jax.vmap(lambda row: unflat(row, like.x))(z[size0:].reshape(sim.horizon, -1)),
    )


def flat(sim: Simulator, z0: Any, z: Any) -> jax.Array:
    """The points [n, D] of latents like x0 [n, ...] (``()``: one start) and x [n, horizon, ...]."""
    rows = [a.reshape(*a.shape[:2], -1) for a in jax.tree.leaves(z)]
    first = [a.reshape(a.shape[0], -1) for a in jax.tree.leaves(z0)]
    n = rows[0].shape[0]
    return jnp.concatenate(
        [
            a.astype(normal_numbers(sim))
            for a in (*first, jnp.concatenate(rows, axis=2).reshape(n, -1))
        ],
        axis=1,
    )


@partial(jax.jit, static_argnums=2)
def latents(sim, recorded, of_start):
    """The latents ([K, ...], [K, T, ...]) of recorded (x0, disturbances, lengths), 0 after the end
    of each.
    """

    def one(x0, x, length):
        e = replay(
            sim, Episode(x0, x, *(jnp.zeros(()),) * 2, jnp.zeros((), bool), length, jnp.zeros(()))
        )
        states = jax.tree.map(lambda a: a[:-1], e.states)
        z = jax.vmap(lambda s, x: D.to_normal(sim.disturbance(s), x))(states, e.disturbances)
        live = jnp.arange(sim.horizon, dtype=jnp.int32) < e.length
        z = jax.tree.map(lambda a: jnp.where(live.reshape(-1, *(1,) * (a.ndim - 1)), a, 0), z)
        return D.to_normal(sim.start(), x0) if of_start else (), z

    return jax.vmap(one)(*recorded)


def normal_of(sim: Simulator, given: Episode) -> np.ndarray:
    """The points [n, D] of the episodes ``given`` [n]; numbers that decided nothing are 0."""
    if not len(given.length):
        return np.zeros((0, dimension(sim)), normal_numbers(sim))
    recorded = given.x0, given.disturbances, jnp.asarray(given.length)
    return np.asarray(flat(sim, *latents(sim, recorded, outline(sim).random_start)))
