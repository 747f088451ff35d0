"""A simulator as a limit state of normal numbers: an episode is a point z [D], under the model z ~
N(0, I), and proposals are mixtures of Gaussians there.

z holds the latents of x0 first, then those of x_1, x_2 ..: x_t is the quantile of p(x | s) at
Phi(z_t). An episode that ends after n steps has used the first ``used`` numbers; the others decide
nothing, so densities are taken over the used ones. With Cholesky factors, lower triangular, these
are a cumulative sum.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core import actions, rewards
from jast._src.core.contract import contract
from jast._src.core.episode import Episode, play_back, play_chosen
from jast._src.core.policy import Policy
from jast._src.core.rewards import likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.transition import Progress, advance, begin, conclude
from jast._src.core.typing import Array
from jast._src.distributions.flat_rows import unflat
from jast._src.normal_space.sequences import latent_policy
from jast._src.runtime._jax import jit, quick
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.blocked_matmul import product, rows_of
from jast._src.util.pytrees import count_numbers, index_tree, map_in_lanes, with_rows_of, zero_where

__all__ = [
    "Latent",
    "Outcomes",
    "check",
    "component",
    "dimension",
    "episodes",
    "flat",
    "is_model",
    "latents",
    "log_ratios",
    "normal_numbers",
    "normal_of",
    "outcome",
    "outcome_and_distances",
    "outcome_by_level",
    "outcomes",
    "outcomes_of",
    "place",
    "play",
    "played",
    "policy_of",
    "side_by_side",
    "simulate",
    "smooth_numbers",
    "split_point",
    "used_numbers",
    "unit",
]

ROWS = 2**18  # numbers that densities are worked out for at a time
LANES = 32  # episodes that are played side by side, so that one program serves any number of them


class Outcomes(NamedTuple):
    """What episodes [n] came to."""

    failure: Array
    """bool"""
    distance: Array
    """Miss distance; inf where invalid"""
    used: Array
    """int32: how many of the numbers of z decided it"""
    length: Array
    """int32: steps"""
    invalid: Array
    """bool"""
    log_p: Array | None = None
    """Log density of its disturbances, relative to the mode where these have modes; None where
    nobody asked"""

    @property
    def score(self):
        """What a search minimises: the miss distance, -inf for a failure, inf for an invalid
        episode.
        """
        on_host = isinstance(self.failure, np.ndarray)
        where = np.where if on_host else jnp.where
        return where(self.failure, -np.inf, where(self.invalid, np.inf, self.distance))


class Latent(NamedTuple):
    """A mixture of K Gaussians over z [D], one drawn a trace. Their covariances are factored; where
    each is that of the model but along one direction, that and its variance stand in their place.
    """

    log_weights: Array
    """[K], of sum 1 as probabilities; -inf for a component that is not used"""
    means: Array
    """[K, D]"""
    factors: Array | None = None
    """[K, D, D] lower Cholesky factors of the covariances"""
    inverses: Array | None = None
    """[K, D, D] their inverses"""
    directions: Array | None = None
    """[K, D] of norm 1"""
    variances: Array | None = None
    """[K] along these"""


def check(function: str, sim: Simulator) -> None:
    """ValueError unless the simulator fits the contract and its disturbances have a quantile
    function.
    """
    contract(function, sim)
    signature = signature_of(sim)
    for name, offer in (("disturbance", signature.disturbance), ("start", signature.start)):
        if not offer.quantile:
            raise ValueError(
                f"{function}: {name}: {offer.kind} has no quantile function;"
                " jast.estimate.monte_carlo needs none"
            )


def dimension(sim: Simulator) -> int:
    """D."""
    return used_numbers(sim, sim.horizon)


def used_numbers(sim: Simulator, steps: Any) -> Any:
    """How many numbers the start and so many ``steps`` take."""
    signature = signature_of(sim)
    return count_numbers(signature.x0) + steps * count_numbers(signature.x)


def split_point(sim: Simulator, z: Any) -> tuple[Any, Any]:
    """The numbers of x0 and those of the disturbances, [horizon, ...], of a point ``z`` [D]."""
    like = signature_of(sim)
    start = count_numbers(like.x0)
    steps = z[start:].reshape(sim.horizon, -1)
    return unflat(z[:start], like.x0), jax.vmap(lambda row: unflat(row, like.x))(steps)


def normal_numbers(sim: Simulator) -> Any:
    """The float dtype of z."""
    signature = signature_of(sim)
    return jnp.result_type(
        *(D.float_dtype(s.dtype) for s in jax.tree.leaves((signature.x0, signature.x)))
    )


def simulate(
    sim: Simulator, z: jax.Array, seen: Any = None, see: Callable | None = None
) -> tuple[Progress, jax.Array, Any]:
    """The `Progress` at the end of the one episode of ``z`` [D], its steps, and what is ``seen`` by
    then: ``see(progress, t, seen)`` is asked at each state s_0 .. s_T. Differentiable in forward
    mode.
    """
    policy, last, reward = policy_of(sim, z), jnp.asarray(sim.horizon, jnp.int32), likelihood(sim)

    def look(progress, t, seen):
        return seen if see is None else see(progress, t, seen)

    def body(carry):
        progress, t, seen = carry
        x = D.mode(policy.disturbance(progress.state, t))
        new = advance(sim, reward, progress, x, t + 1 >= last)
        return new, t + 1, look(new, t + 1, seen)

    begun, none = begin(sim, reward, D.mode(policy.start())), jnp.zeros((), jnp.int32)
    start = with_rows_of(z, (begun, none, look(begun, none, seen)))
    end, length, seen = lax.while_loop(lambda c: ~c[0].done, body, start)
    return conclude(sim, reward, end), length, seen


def smooth_numbers(sim: Simulator) -> np.ndarray:
    """Which of the numbers [D] make a float, by its dtype; the others make choices and counts."""

    def of(tree):
        each = [(count_numbers(s), jnp.issubdtype(s.dtype, jnp.floating)) for s in tree]
        return [is_float for n, is_float in each for _ in range(n)]

    like = signature_of(sim)
    start, step = (of(jax.tree.leaves(tree)) for tree in (like.x0, like.x))
    return np.array(start + sim.horizon * step, bool)


def unit(z: np.ndarray) -> np.ndarray:
    """The directions of points ``z`` [..., D]; that of 0 is 0. On the host."""
    return z / np.maximum(np.linalg.norm(z, axis=-1, keepdims=True), 1e-12)


def outcome(sim: Simulator, z: jax.Array) -> Outcomes:
    """`Outcomes` of the one episode of ``z`` [D], differentiable in forward mode."""
    end, length, _ = simulate(sim, z)
    return outcomes_of(sim, end, length)


def outcome_by_level(sim: Simulator, z: jax.Array, level: Any) -> tuple[Outcomes, jax.Array]:
    """The same, and how many of the numbers were used when the episode failed or its distance first
    came to the ``level``.
    """

    def wait(progress, t, steps):
        return steps + (~progress.failure & (progress.distance > level)).astype(steps.dtype)

    end, length, steps = simulate(sim, z, jnp.zeros((), jnp.int32), wait)
    return outcomes_of(sim, end, length)._replace(log_p=None), used_numbers(sim, steps)


def outcomes_of(sim: Simulator, end: Progress, length: jax.Array) -> Outcomes:
    """`Outcomes` of the `Progress` at the ends of episodes, and their steps."""
    return Outcomes(
        failure=end.failure,
        distance=end.distance,
        used=used_numbers(sim, length),
        length=length,
        invalid=end.invalid,
        log_p=end.reward,
    )


@jit
def outcomes(sim, z):
    """`Outcomes` [n] of ``z`` [n, D]."""
    return jax.vmap(partial(outcome, sim))(z)


def outcome_and_distances(sim: Simulator, z: jax.Array) -> tuple[Outcomes, jax.Array]:
    """The same, and the miss distance at each moment [M]: at s_0 .. s_T, or at the end of a system
    that is judged there. NaN where an episode had failed, or ended.
    """

    def see(progress, t, g):
        return g.at[t].set(jnp.where(progress.failure, jnp.nan, sim.evaluate(progress.state)[1]))

    if sim.episodic:
        end, length, _ = simulate(sim, z)
        g = jnp.where(end.failure, jnp.nan, end.distance)[None]
    else:
        nothing = jnp.full(sim.horizon + 1, jnp.nan, signature_of(sim).dtype)
        end, length, g = simulate(sim, z, nothing, see)
    return outcomes_of(sim, end, length), g


def play(sim: Simulator, reward: Callable, z: jax.Array) -> Episode:
    """The `jast.Episode` of ``z`` [D]; of a constant number of steps, so that it can be
    differentiated backwards.
    """
    policy = policy_of(sim, z)

    def choose(state, t, _):
        return D.mode(policy.disturbance(state, t))

    return play_chosen(sim, reward, D.mode(policy.start()), choose, (), sim.horizon, z)


@quick
def episodes(sim, z):
    """The `jast.Episode` of each of ``z`` [n, D], without states."""

    def one(z):
        return play(sim, rewards.STANDARD, z)._replace(states=None)

    return jax.vmap(one)(z)


def place(q: Latent, u: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Points [n, D] of the mixture ``q`` by uniform numbers ``u`` [n], of the components, and
    normal ones ``e`` [n, D]. On the host.
    """
    k, z = component(q, u), np.empty_like(e)
    for i in np.unique(k):
        rows = k == i
        if q.directions is None:
            z[rows] = np.asarray(q.means[i]) + product(e[rows], np.asarray(q.factors[i]).T)
        else:
            way, wider = np.asarray(q.directions[i])[None], np.sqrt(q.variances[i]) - 1
            z[rows] = np.asarray(q.means[i]) + e[rows] + wider * product(e[rows], way.T) * way
    return z


def component(q: Latent, u: np.ndarray) -> np.ndarray:
    """Which component of ``q`` each of the uniform numbers ``u`` [n] chooses."""
    edges = np.cumsum(np.exp(np.asarray(q.log_weights)))
    return np.minimum(np.searchsorted(edges, u, side="right"), _live(q) - 1)


def is_model(q: Latent) -> np.ndarray:
    """Which components [K] are the model itself: their draws are plain ones."""
    if q.directions is None:
        unit = (np.asarray(q.factors) == np.eye(q.means.shape[1])).all(axis=(1, 2))
    else:
        unit = np.asarray(q.variances) == 1
    return unit & ~np.asarray(q.means).any(axis=1)


def log_ratios(q: Latent, z: np.ndarray, used: np.ndarray) -> np.ndarray:
    """log q_k - log p [n, K] over the first ``used`` [n] numbers of each of ``z`` [n, D], 0 for
    components that are not used. On the host.
    """
    if q.directions is not None:
        return _log_ratios_along(q, z, used)
    live, (n, d) = _live(q), z.shape
    means, inverses = (np.asarray(a)[:live].astype(z.dtype) for a in (q.means, q.inverses))
    shift = np.einsum("kij,kj->ki", inverses, means)[:, None]
    diagonals = np.log(np.diagonal(inverses, axis1=1, axis2=2).astype(np.float64))
    volumes = np.concatenate([np.zeros((live, 1)), np.cumsum(diagonals, axis=1)], axis=1)
    out = np.zeros((n, len(q.log_weights)))
    turned = inverses.transpose(0, 2, 1)
    rows = max(min(ROWS // (live * d), rows_of(n, d * d)), 1)
    for i in range(0, n, rows):
        part, m = z[i : i + rows], used[i : i + rows]
        e = np.matmul(part, turned) - shift
        # the squares differ by (z - e)(z + e): no cancellation of two large sums
        gap = part - e
        if (m < d).any():
            gap *= np.arange(d) < m[:, None]
        ratio = 0.5 * np.einsum("knd,knd->kn", gap, part + e) + volumes[:, m]
        out[i : i + rows, :live] = ratio.T
    return out


def _log_ratios_along(q, z, used):
    """The same of Gaussians that are the model's but along one direction: of the first numbers of z
    the covariance is I + (variance - 1) a a^T, with what the direction has of them as a.
    """
    live, (n, d) = _live(q), z.shape
    fields = q.means, q.directions, q.variances
    means, ways, variances = (np.asarray(a, np.float64)[:live] for a in fields)

    def of_first(a):
        """Sums [m, K] of the first numbers of ``a`` [K, D]."""
        return np.concatenate([np.zeros((1, live)), np.cumsum(a, axis=1).T])

    squares, along, size = of_first(means**2), of_first(means * ways), of_first(ways**2)
    out, rows = np.zeros((n, len(q.log_weights))), max(ROWS // d, 1)
    for i in range(0, n, rows):
        m = used[i : i + rows]
        part = np.where(np.arange(d) < m[:, None], z[i : i + rows], 0).astype(np.float64)
        gap, wider = product(part, ways.T) - along[m], (variances - 1) * size[m]
        # its determinant is 1 + wider, its inverse I - (variance - 1) a a^T / (1 + wider)
        bend = (variances - 1) * gap**2 / (1 + wider) - np.log1p(wider)
        out[i : i + rows, :live] = product(part, means.T) - 0.5 * squares[m] + 0.5 * bend
    return out


def _live(q):
    """How many components are used: they come first."""
    return int(np.isfinite(np.asarray(q.log_weights)).sum())


def policy_of(sim: Simulator, z: jax.Array) -> Policy:
    """The `Policy` that plays the one episode of ``z`` [D]."""
    return latent_policy(sim, actions.quantiles(), *split_point(sim, z))


def played(sim: Simulator, z: np.ndarray) -> Episode:
    """The `jast.Episode` of each of ``z`` [n, D], without states. On the host."""
    return side_by_side(sim, partial(episodes, sim), np.asarray(z, normal_numbers(sim)))


def side_by_side(sim: Simulator, function: Callable, *rows: Any, lanes: int = LANES) -> Any:
    """``function`` of ``rows`` [n, ...], ``lanes`` at a time (`map_in_lanes`); a black box plays
    none twice.
    """
    size = len(jax.tree.leaves(rows)[0]) if runs_on_host(sim) else lanes
    return map_in_lanes(size, function, *rows)


def flat(sim: Simulator, z0: Any, z: Any) -> jax.Array:
    """The points [n, D] of latents like x0 [n, ...] (``()``: one start) and x [n, horizon, ...]."""
    steps = [a.reshape(*a.shape[:2], -1) for a in jax.tree.leaves(z)]
    steps = [jnp.concatenate(steps, axis=2)] if steps else []  # none where only the start is random
    parts = [a.reshape(len(a), -1) for a in (*jax.tree.leaves(z0), *steps)]
    return jnp.concatenate([a.astype(normal_numbers(sim)) for a in parts], axis=1)


@partial(jit, static_argnums=2)
def latents(sim, recorded, of_start):
    """The latents ([K, ...], [K, T, ...]) of recorded (x0, disturbances, lengths), 0 after the end
    of each.
    """

    def one(x0, x, length):
        # of states alone: where the disturbance depends on none, XLA drops the simulation
        states = play_back(sim, rewards.STANDARD, x0, x, length).states
        states = index_tree(states, np.s_[:-1])
        z = jax.vmap(lambda s, x: D.to_normal(sim.disturbance(s), x))(states, x)
        live = jnp.arange(sim.horizon, dtype=jnp.int32) < length
        z = jax.vmap(zero_where)(~live, z)
        return D.to_normal(sim.start(), x0) if of_start else (), z

    return jax.vmap(one)(*recorded)


def normal_of(sim: Simulator, given: Episode) -> np.ndarray:
    """The points [n, D] of the episodes ``given`` [n]; numbers that decided nothing are 0."""
    if not len(given.length):
        return np.zeros((0, dimension(sim)), normal_numbers(sim))
    recorded = given.x0, given.disturbances, np.asarray(given.length)
    return side_by_side(sim, partial(_points, sim), recorded)


@quick
def _points(sim, recorded):
    return flat(sim, *latents(sim, recorded, signature_of(sim).random_start))
