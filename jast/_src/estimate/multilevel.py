"""The cross-entropy method for rare events: a proposal for importance sampling of failures.

De Boer, Kroese, Mannor and Rubinstein 2005, A tutorial on the cross-entropy method, section 3.1
(the multi-level algorithm), on sequences of disturbances.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core import actions
from jast._src.core.contract import contract
from jast._src.core.episode import rollout
from jast._src.core.policy import Policy
from jast._src.core.signature import ask, signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array, PRNGKey
from jast._src.normal_space import sequences
from jast._src.runtime._jax import jit
from jast._src.runtime.memory import require_episodes
from jast._src.util import display
from jast._src.util.checks import check_random_key, real_number, whole_number
from jast._src.util.pytrees import index_tree

__all__ = ["FailureProposal", "failure_proposal"]


LEAST_ESS = 2  # of the last elites, for a proposal that reached failures


@display.result_class("episodes", batches=True)
class FailureProposal(NamedTuple):
    """A proposal and how it was found. K iterations; with a leading axis everywhere after
    `jax.vmap`.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing()
        >>> found = jast.estimate.failure_proposal(key, sim, samples=200)
        >>> float(found.levels[-1])  # the last elites fail
        0.0
        >>> jast.rollout(key, sim, found.policy).disturbances.shape
        (10,)
    """

    policy: Policy
    """`Policy`: the simulator's disturbances, tilted step by step"""
    start: sequences.Steps | tuple[()]
    """`Steps` [1, ...] of the latent of x0, ``()`` where x0 is not tilted"""
    steps: sequences.Steps
    """`Steps` [horizon, ...] of the latents of x_1 .. x_T"""
    levels: Array
    """[K]: the miss distance gamma_k that the elites of an iteration reached, 0 where they failed;
    inf where no episode counted
    """
    failing: Array
    """[K] int32: failing episodes of an iteration"""
    ess: Array
    """[K]: effective number of the elites, (sum w)^2 / sum w^2"""
    episodes: Array
    """int: episodes simulated in all; ``evaluations`` is another name"""
    invalid: Array
    """int: those in which the simulator returned a number that is not finite"""
    reached: Array
    """bool: whether all of the last elites fail, and are worth two effective episodes or more;
    otherwise the proposal is fitted to near misses too
    """

    @display.Former
    def failures(self) -> Any:
        """Deprecated: ``failing``."""
        return display.renamed(self, "failures", "failing")

    @property
    def evaluations(self) -> Any:
        """The same as ``episodes``."""
        return self.episodes

    def __str__(self) -> str:
        reached, levels = np.asarray(self.reached), np.asarray(self.levels)
        if reached.ndim:
            return (
                f"{reached.size} runs of {np.ravel(self.episodes)[0]} evaluations:"
                f" {int(reached.sum())} reached failures"
            )
        rows = "\n".join(
            f"{i:9d} {g:11.6g} {n:9d} {e:10.1f}"
            for i, (g, n, e) in enumerate(zip(levels, self.failing, self.ess, strict=True), 1)
        )
        note = "" if reached else "\nthe last elites do not fail: more iterations, or more samples"
        return f"{'iteration':>9} {'level':>11} {'failures':>9} {'ess':>10}\n{rows}{note}"


def failure_proposal(
    key: PRNGKey,
    sim: Simulator,
    *,
    samples: int = 1000,
    iterations: int = 10,
    quantile: float = 0.1,
    smoothing: float = 0.3,
    floor: float = 0.7,
) -> FailureProposal:
    """Find a proposal under which failures are frequent. Its ``policy`` is for `jast.rollout` and
    importance sampling.

    The disturbances are x_t = Q(Phi(z_t)), Q the quantile function of p(x | s) and z_t ~ N(m_t,
    s_t^2), beginning at N(0, 1), the model itself. In each iteration m_t and s_t are fitted to the
    elites, the episodes of least miss distance, with importance ratios for weights, over the steps
    that an episode took. A random start is tilted likewise where it has a quantile function, else
    it is drawn from its own distribution. A proposal that is much narrower than the model in many
    steps gives weights with heavy tails; in one or two dimensions a lower ``floor`` is sharper.

    The result is a proposal, not an estimate: estimate with new episodes, drawn under it alone. It
    is one Gaussian with independent steps. Where failures lie in several places it may settle on
    one of them, or between, and an estimate misses the others without a sign of it. Look at
    ``reached`` first. An invalid episode is counted and never an elite. One program, works under
    `jax.jit` and `jax.vmap`.

    Args:
        key: consumed.
        sim: the simulator.
        samples: episodes in an iteration; static, like ``iterations``.
        iterations: how many.
        quantile: share of the episodes that are elites, above 0 and below 1; all failing episodes
            once that many fail. Traced, like those below.
        smoothing: share of the last m_t and s_t that is kept, from 0 to below 1.
        floor: the least s_t, above 0.

    Returns:
        `FailureProposal`.

    Raises:
        ValueError: for a count below 1, a setting outside its range, and a disturbance that cannot
            be tilted.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing()
        >>> found = jast.estimate.failure_proposal(jax.random.key(0), sim, samples=200)
        >>> bool(found.reached)
        True
    """
    name = "failure_proposal"
    check_random_key(name, key)
    samples = whole_number(name, "samples", samples, 2)
    iterations = whole_number(name, "iterations", iterations)
    quantile = real_number(name, "quantile", quantile, lambda v: 0 < v < 1, "above 0 and below 1")
    smoothing = real_number(name, "smoothing", smoothing, lambda v: 0 <= v < 1, "from 0 to below 1")
    floor = real_number(name, "floor", floor, lambda v: 0 < v < np.inf, "above 0")
    contract(name, sim)
    require_episodes(name, sim, samples)
    return _search(key, sim, quantile, (smoothing, floor), _tilts_start(sim), samples, iterations)


@partial(jit, static_argnums=(4, 5, 6))
def _search(key, sim, quantile, kept, tilt_start, samples, iterations):
    like = signature_of(sim)
    first = (
        sequences.standard_normal(like.x0, 1) if tilt_start else (),
        sequences.standard_normal(like.x, sim.horizon),
    )

    def iterate(proposal, key):
        start, steps = proposal
        keys = jax.random.split(key, samples)
        z0, z, e, log_w = jax.vmap(lambda k: _play(k, sim, proposal))(keys)
        valid = jnp.isfinite(e.distance)
        level, fails, counts = _elites(e, jnp.where(valid, log_w, -jnp.inf), quantile)
        ess = jnp.sum(counts)
        reached = jnp.arange(sim.horizon, dtype=jnp.int32)[None, :] < e.length[:, None]
        if tilt_start:
            start = sequences.fit(start, z0, counts[:, None], *kept)
        steps = sequences.fit(steps, z, jnp.where(reached, counts[:, None], 0), *kept)
        failing, invalid = (jnp.sum(a, dtype=jnp.int32) for a in (e.failure, ~valid))
        return (start, steps), (level, failing, ess, invalid, fails)

    last, (levels, failing, ess, invalid, fails) = lax.scan(
        iterate, first, jax.random.split(key, iterations)
    )
    start, steps = last
    return FailureProposal(
        policy=proposing(sim, start, steps),
        start=start,
        steps=steps,
        levels=levels,
        failing=failing,
        ess=ess,
        episodes=jnp.asarray(samples * iterations, jnp.int32),
        invalid=jnp.sum(invalid, dtype=jnp.int32),
        reached=fails[-1] & (ess[-1] >= LEAST_ESS),
    )


def proposing(sim: Simulator, start: Any, steps: Any) -> Policy:
    """The `Policy` of a simulator's disturbances, tilted by `Steps` of x0 (``()``: not tilted) and
    of x.
    """
    begin = Partial(_start, sim.start, start) if start != () else sim.start
    return Policy(begin, Partial(_disturbance, sim.disturbance, steps))


def _play(key, sim, proposal):
    """One episode: its latents ((1, ...), (T, ...)), itself, and the log of its importance
    ratio.
    """
    for_noise, for_start = jax.random.split(key)
    start, steps = proposal
    z0 = sequences.sample(for_noise, start, 0) if start != () else ()
    z = sequences.sample(for_noise, steps, 1)
    player = sequences.latent_policy(sim, actions.quantiles(), index_tree(z0, 0), z)
    e = rollout(for_start, sim, player)._replace(states=None, disturbances=None)
    # W = f(X; u) / f(X; v) in the latents, in which f is N(0, 1); to the end of the episode, as
    # later steps decide nothing
    ratios = sequences.log_ratio(steps, z)
    log_w = jnp.sum(jnp.where(jnp.arange(sim.horizon, dtype=jnp.int32) < e.length, ratios, 0))
    if start != ():
        log_w = log_w + sequences.log_ratio(start, z0)[0].astype(log_w.dtype)
    return z0, z, e, log_w


def _elites(e, log_w, quantile):
    """(gamma_k, whether the elites fail, weights [n] of the elites that sum to their effective
    number); -inf in ``log_w``: does not count.
    """
    usable = jnp.isfinite(log_w)
    score = jnp.where(usable, jnp.where(e.failure, -jnp.inf, e.distance), jnp.inf)
    n = jnp.sum(usable, dtype=score.dtype)
    # gamma_k: the sample quantile of the performances, and 0 once it fails
    place = jnp.clip(jnp.ceil(quantile.astype(score.dtype) * n) - 1, 0, len(score) - 1)
    level = jnp.sort(score)[place.astype(jnp.int32)]
    elite = usable & (score <= level)
    # I{S(X) <= gamma} W(X), whose sums are those of the weighted likelihood equations; over its
    # greatest, so that none overflows
    log_w = jnp.where(elite, log_w, -jnp.inf)
    top = jnp.max(log_w)
    w = jnp.where(elite, jnp.exp(log_w - jnp.where(jnp.isfinite(top), top, 0)), 0)
    total, squares = jnp.sum(w), jnp.sum(w**2)
    counts = w * jnp.where(squares > 0, total / jnp.where(squares > 0, squares, 1), 0)
    return jnp.maximum(level, 0), jnp.isneginf(level), counts


def _start(start, steps):
    return D.tilted(start(), *index_tree(steps, 0))


def _disturbance(disturbance, steps, state, t):
    return D.tilted(
        disturbance(state), *jax.tree.map(lambda a: a[jnp.minimum(t, a.shape[0] - 1)], steps)
    )


def _tilts_start(sim: Simulator) -> bool:
    """Whether x0 is tilted; ValueError where x cannot be."""
    start, step = ask(sim, lambda start, state, dist: (D.untiltable(start), D.untiltable(dist)))
    if step is not None:
        raise ValueError(f"failure_proposal: disturbance: {step}")
    return signature_of(sim).random_start and start is None
