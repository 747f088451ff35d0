"""Stress testing as a function of a vector to minimise: the bridge from a simulator to the
cross-entropy methods.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial

from jast._src.core import failures
from jast._src.core.actions import Quantiles, UniformBox, quantiles
from jast._src.core.contract import contract
from jast._src.core.episode import Episode, rollout
from jast._src.core.failures import Failures
from jast._src.core.rewards import LogLikelihood, as_pytree
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Actions, Objective, Reward
from jast._src.cross_entropy.gaussian import Gaussian, normal
from jast._src.cross_entropy.result import CEResult
from jast._src.distributions.flat_rows import filled
from jast._src.normal_space.sequences import latent_policy
from jast._src.util.checks import wrong
from jast._src.util.pytrees import index_tree

__all__ = ["Stress", "over"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stress:
    """The search for failures of a system as a minimisation; see `over`. A pytree.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import cross_entropy as ce
        >>> stress = ce.over(jast.simulators.landing(b=0.3))
        >>> z = jnp.zeros_like(stress.proposal.mean)  # an undisturbed episode
        >>> bool(stress.episode(z).failure), float(stress.objective(z)) > 0
        (False, True)
    """

    sim: Simulator
    reward: Reward
    """That of the episodes; `LogLikelihood` where none was given"""
    actions: Actions

    @property
    def objective(self) -> Objective:
        """z [D] -> scalar, to be minimised: a `jax.tree_util.Partial`. NaN where the episode's
        numbers are not finite.
        """
        return Partial(_value, self.sim, self.reward, self.actions)

    @property
    def proposal(self) -> Gaussian:
        """N(0, I) over z [D], the `Gaussian` to begin with: under it disturbances are draws of the
        model, or uniform in the box.
        """
        z, _ = _flat(self.sim)
        return normal(jnp.zeros_like(z), 1)

    def episode(self, z: Any) -> Episode:
        """The `jast.Episode` at the point ``z`` [D], replayed, with its states. ValueError for
        another shape.
        """
        return _played(self.sim, self.reward, self.actions, z)

    def failures(self, result: CEResult, top: int = 64) -> Failures:
        """The ``top`` best distinct failures among all points that ``result``, a `CEResult`,
        evaluated: `jast.failures.Failures`, each replayed.

        Ranked by the reward, or where none was given by likelihood, as by the objective.
        ``simulation`` is the number of the evaluation, from 0; of a batch of runs (a leading axis),
        ``tree`` is the run. On the host. ValueError for points of another dimension.
        """
        x = np.asarray(result.history.x)
        rows = x.reshape(-1, x.shape[-1])
        # a search that goes on has rows to come
        known = np.flatnonzero(np.isfinite(rows).all(axis=1))
        if not known.size:
            return failures.empty(self.sim)
        episodes = jax.device_get(_episodes(self.sim, self.reward, self.actions, jnp.asarray(rows)))
        failing = known[episodes.failure[known] & np.isfinite(episodes.reward[known])]
        kept = index_tree(episodes, failing)
        return failures.collect(
            self.sim, self.reward, kept, failing // x.shape[-2], failing % x.shape[-2], top=top
        )


def over(sim: Simulator, *, reward: Reward | None = None, actions: Actions | None = None) -> Stress:
    """The search for failures of a system as a minimisation, with an ``objective`` and a
    ``proposal`` for the methods of `jast.cross_entropy`.

    A point z [D] holds normal numbers: first those of x0, where the start is random, then those of
    x_1 .. x_horizon; D is ``stress.proposal.mean.size``. A Gaussian needs more elites than D for
    its covariance. With tens of dimensions and few evaluations that of `ce_method` collapses before
    a failure is found: take `ce_surrogate`, or `jast.search.cem`, whose steps are independent.

    Without a ``reward`` the order is lexicographic, whatever the units. An episode that does not
    fail has its miss distance, at least 0. One that fails has -1 / (1 + c), where c >= 0 is how far
    its log density is below that of the mode at each of its steps: any failure is below all else, a
    likelier one below a less likely one. (Where a distribution names no mode, c is less the raw log
    density, and the value is -1 + c where c < 0, which continues smoothly.) An episode whose
    numbers are not finite, or that is impossible, has NaN, which a method counts.

    Pure JAX, for `jax.jit`, `jax.vmap` (over simulators too) and ask and tell.

    Args:
        sim: the simulator.
        reward: of `jast.rewards`: the objective is less the reward.
        actions: ``jast.actions.quantiles()``, the default: x_t is the quantile of p(x | s) at
            Phi(z_t). ``uniform(low, high)``: it is that point of a box; a start is never of the
            box.

    Returns:
        `Stress`; ``stress.failures(result)`` is the archive of the failures of a result.

    Raises:
        ValueError: for actions that are neither of the two, a distribution without a quantile
            function where one is needed, and what `jast.check` finds in the simulator's functions
            by tracing them.

    Example:
        >>> import jax, jast
        >>> from jast import cross_entropy as ce
        >>> stress = ce.over(jast.simulators.landing(b=0.3))
        >>> result = ce.ce_method(
        ...     jax.random.key(0), stress.objective, stress.proposal, samples=100, elites=30
        ... )
        >>> len(stress.failures(result)) > 0
        True
    """
    if reward is not None and not callable(reward):
        raise wrong("over", "reward", "be a function, one of jast.rewards or yours", f"{reward!r}")
    actions = quantiles() if actions is None else actions
    if not isinstance(actions, Quantiles | UniformBox):
        must = "be jast.actions.quantiles() or uniform(low, high)"
        raise wrong("over", "actions", must, f"{actions!r}")
    contract("over", sim)
    signature = signature_of(sim)
    box = isinstance(actions, UniformBox)
    for name, offer, other in (
        ("start", signature.start, ""),
        ("disturbance", signature.disturbance, "; give actions=jast.actions.uniform(low, high)"),
    ):
        if not offer.quantile and not (box and name == "disturbance"):
            raise ValueError(f"over: {name}: {offer.lacking} has no quantile function{other}")
    contract("over", sim, actions)
    density = signature.density
    return Stress(sim, LogLikelihood(density) if reward is None else as_pytree(reward), actions)


def _value(sim, reward, actions, z):
    e = _played(sim, reward, actions, z)
    if isinstance(reward, LogLikelihood):
        c = -e.reward
        rank = jnp.where(c >= 0, -1 / (1 + jnp.maximum(c, 0)), c - 1)
        value = jnp.where(e.failure, rank, jnp.maximum(e.distance, 0))
    else:
        value = -e.reward
    return jnp.where(jnp.isfinite(e.reward) & jnp.isfinite(e.distance), value, jnp.nan)


@jax.jit
def _episodes(sim, reward, actions, rows):
    return jax.vmap(lambda z: _played(sim, reward, actions, z)._replace(states=None))(rows)


def _played(sim, reward, actions, z):
    """The episode of the point ``z`` [D]."""
    like, unflat = _flat(sim)
    z = jnp.asarray(z)
    if z.shape != like.shape:
        raise ValueError(f"over: a point must have the shape {like.shape}, received {z.shape}")
    policy = latent_policy(sim, actions, *unflat(z.astype(like.dtype)))
    return rollout(jax.random.key(0), sim, policy, reward)


def _flat(sim: Simulator) -> tuple[jax.Array, Callable[[jax.Array], Any]]:
    """Zeros [D], in the widest float dtype of x0 and x, and the function from a point to the
    latents (of x0, of x [horizon, ...]).
    """
    signature = signature_of(sim)
    return ravel_pytree((filled(signature.x0, 0), filled(signature.x, 0, sim.horizon)))
