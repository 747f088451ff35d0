"""Proposals of importance resampling: recorded failure traces and failure policies, mixed with the
model so that nothing is left uncovered.

Lipkis and Agogino, Discovery and Analysis of Rare High-Impact Failure Modes Using Adversarial
RL-Informed Sampling ("the paper").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core.contract import contract
from jast._src.core.episode import Episode
from jast._src.core.policy import Policy
from jast._src.core.signature import ask, signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array
from jast._src.distributions.mixtures import blend
from jast._src.normal_space.transform import latents
from jast._src.runtime._jax import is_traced
from jast._src.util import display
from jast._src.util.checks import instance, one_of, real_number, wrong
from jast._src.util.pytrees import conform, index_tree

__all__ = ["Proposal", "as_proposal", "policy_proposal", "trace_proposal"]

MIXING = ("step", "trace")


@display.printable()
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Proposal:
    """A mixture of K policies, one of which is drawn for a whole trace: q(trace) = sum of
    exp(log_weights[k]) q_k(trace). A pytree.

    Example:
        >>> import jast
        >>> from jast import distributions as D
        >>> sim = jast.simulators.walk1d()
        >>> push = jast.Policy(sim.start, lambda state, t: D.Normal(1.0, 1.0))
        >>> jast.estimate.policy_proposal(sim, push).covers  # its density is nowhere 0
        True
    """

    log_weights: Array
    """[K], of sum 1 as probabilities"""
    policies: Policy
    """Stacked: a leading axis [K] on every leaf"""
    covers: bool = field(default=False, metadata=dict(static=True))
    """Whether its density is known to be above 0 wherever the model's is, because it holds a share
    of the model; static.
    """


def trace_proposal(
    sim: Simulator,
    episodes: Episode | Sequence[Episode],
    epsilon: float = 0.05,
    *,
    mixing: Literal["step", "trace"] = "step",
    tilt_start: bool = True,
) -> Proposal:
    """The proposal of recorded failures, Algorithm 1 (one trace) and eq. 19-20 (several) of Lipkis
    and Agogino.

    Each episode is replayed. Its disturbance x*_t moves p(x | s) so that its middle is where x*_t
    lies in the recorded state: for a normal distribution q = p(x + E[X] - x*_t) (eq. 10-11), in
    general `jast.distributions.tilted`, which keeps within bounds and suits whole numbers too.
    Steps after the end of a trace are the model's own.

    Args:
        sim: the simulator.
        episodes: an `Episode`, a batch with a leading axis [K] (``result.failures.episodes``), or a
            list of either.
        epsilon: the share of the model, above 0 and at most 1 (traced).
        mixing: "step" mixes the model in at each step, as in the paper (eq. 12; of T steps all are
            moved with probability (1 - epsilon)^T only); "trace" makes the model itself one more
            component, for long horizons.
        tilt_start: whether x0 is moved too; False draws it from the model.

    Returns:
        `Proposal` of one component a trace.

    Raises:
        ValueError: for another epsilon or mixing, episodes that do not fit the simulator, and a
            disturbance that cannot be tilted (named).

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> failure = jast.replay(sim, jnp.full(6, 2.0))
        >>> jast.estimate.trace_proposal(sim, failure, mixing="trace").log_weights.shape
        (2,)
    """
    epsilon = _epsilon("trace_proposal", epsilon, mixing)
    contract("trace_proposal", sim)
    recorded, tilt_start = _stacked(sim, episodes), tilt_start and signature_of(sim).random_start
    try:
        start, steps = latents(sim, recorded, tilt_start)
    except ValueError as error:
        raise ValueError(f"trace_proposal: disturbance: {error}") from None
    if not all(is_traced(a) or np.isfinite(a).all() for a in jax.tree.leaves((start, steps))):
        raise ValueError(
            "trace_proposal: episodes must hold finite disturbances that the model can draw,"
            " received some that are not finite or outside its support"
        )
    k = len(jax.tree.leaves(steps)[0])
    if mixing == "trace":
        start, steps = jax.tree.map(
            lambda a: jnp.concatenate([a, jnp.zeros_like(a[:1])]), (start, steps)
        )
        log_weights = jnp.log(jnp.append(jnp.full((k,), (1 - epsilon) / k), epsilon))
    else:
        log_weights = jnp.full((k,), -jnp.log(jnp.asarray(k, epsilon.dtype)))
    share = epsilon if mixing == "step" else None

    def component(start, steps):
        begin = Partial(_trace_start, sim.start, start, share) if tilt_start else sim.start
        return Policy(begin, Partial(_trace_step, sim.disturbance, steps, share))

    return Proposal(log_weights, jax.vmap(component)(start, steps), True)


def policy_proposal(
    sim: Simulator,
    policy: Policy,
    epsilon: float = 0.05,
    *,
    tilt_start: bool = True,
    mixing: Literal["step", "trace"] = "step",
) -> Proposal:
    """The proposal of a failure policy, Algorithm 2 of Lipkis and Agogino: p(x | s) moved to the
    policy's value pi*(s), its mode, at each step (eq. 23-28).

    Where x0 decides whether the system fails, an estimate with a start from the model is not to be
    trusted, whatever the policy: see `jast.estimate.Estimate`. A policy that itself draws from all
    failures can be given to `importance` as it is.

    Args:
        sim: the simulator.
        policy: a `jast.Policy`.
        epsilon: as for `trace_proposal`.
        tilt_start: x0 is drawn from ``policy.start()``, mixed with the model's; False draws it from
            the model alone, as Algorithm 2 is printed.
        mixing: as for `trace_proposal`.

    Returns:
        `Proposal`.

    Raises:
        ValueError: for another epsilon or mixing, what is no `jast.Policy`, and a disturbance that
            cannot be tilted (named).

    Example:
        >>> import jast
        >>> from jast import distributions as D
        >>> sim = jast.simulators.walk1d()
        >>> push = jast.Policy(sim.start, lambda state, t: D.Normal(1.0, 1.0))
        >>> jast.estimate.policy_proposal(sim, push).log_weights.shape
        (1,)
    """
    epsilon = _epsilon("policy_proposal", epsilon, mixing)
    contract("policy_proposal", sim)
    instance("policy_proposal", "policy", policy, Policy, "a jast.Policy")
    tilt_start = tilt_start and signature_of(sim).random_start
    share = epsilon if mixing == "step" else None
    strength = jnp.ones((1,), epsilon.dtype)
    log_weights = jnp.zeros((1,), epsilon.dtype)
    if mixing == "trace":
        strength = jnp.append(strength, 0)
        log_weights = jnp.log(jnp.stack([1 - epsilon, epsilon]))

    def component(strength):
        begin = Partial(_policy_start, sim.start, policy.start, strength, share)
        step = Partial(_policy_step, sim.disturbance, policy.disturbance, strength, share)
        return Policy(begin if tilt_start else sim.start, step)

    try:
        ask(sim, lambda start, state, dist: component(strength[0]).disturbance(state, jnp.int32(0)))
    except ValueError as error:
        raise ValueError(f"policy_proposal: disturbance: {error}") from None
    return Proposal(log_weights, jax.vmap(component)(strength), True)


def as_proposal(function, sim, proposal):
    """A `Proposal`: ``proposal`` itself, or a mixture of the one `Policy` that it is. ValueError
    for anything else, and for a policy without a density.
    """
    if isinstance(proposal, Policy):
        stacked = jax.tree.map(lambda a: jnp.asarray(a)[None], proposal)
        proposal = Proposal(jnp.zeros(1), stacked)
    instance(function, "proposal", proposal, Proposal, "a Proposal or a jast.Policy")

    def plays_one_value(start: Any, state: Any, dist: Any) -> bool:
        policy = index_tree(proposal.policies, 0)
        pairs = (policy.start(), start), (policy.disturbance(state, jnp.int32(0)), None)
        return any(
            isinstance(q, D.Deterministic) and not isinstance(p, D.Deterministic) for q, p in pairs
        )

    if ask(sim, plays_one_value):
        raise ValueError(
            f"{function}: proposal must have a density, received a policy that plays one value;"
            " make a proposal of it with trace_proposal or policy_proposal"
        )
    return proposal


def _epsilon(function, epsilon, mixing):
    one_of(function, "mixing", mixing, MIXING)
    return real_number(function, "epsilon", epsilon, lambda v: 0 < v <= 1, "above 0 and at most 1")


def _stacked(sim, episodes):
    """x0, disturbances and lengths with one leading axis [K]."""
    several = isinstance(episodes, (list, tuple)) and not hasattr(episodes, "_fields")
    parts = list(episodes) if several else [episodes]
    if not parts or not all(isinstance(e, Episode) for e in parts):
        must = "be a jast.Episode, a batch of them or a list"
        raise wrong("trace_proposal", "episodes", must, [type(e).__name__ for e in parts])
    fields = [(e.x0, e.disturbances, e.length) for e in parts]
    batched = [
        f if np.ndim(f[2]) else jax.tree.map(lambda a: jnp.asarray(a)[None], f) for f in fields
    ]
    if not all(len(np.shape(b[2])) == 1 and len(b[2]) for b in batched):
        raise ValueError(
            "trace_proposal: episodes must have at most one leading axis, of at least 1, received"
            f" lengths {[np.shape(b[2]) for b in batched]}"
        )
    like = signature_of(sim)
    full = jax.tree.map(lambda s: jax.ShapeDtypeStruct((sim.horizon, *s.shape), s.dtype), like.x)
    for x0, x, _ in batched:
        one = index_tree((x0, x), 0)
        try:
            conform("x0", one[0], like.x0), conform("disturbances", one[1], full)
        except ValueError as error:
            raise ValueError(
                f"trace_proposal: episodes do not fit the simulator: {error}"
            ) from None
    return jax.tree.map(lambda *leaves: jnp.concatenate([jnp.asarray(a) for a in leaves]), *batched)


def _moved(p, z):
    return D.tilted(p, z, jax.tree.map(jnp.ones_like, z))


def _mixed(share, p, q):
    """epsilon p + (1 - epsilon) q (eq. 12), or q alone."""
    return q if share is None else blend(jnp.stack([share, 1 - share]), p, q)


def _trace_start(start, z, share):
    p = start()
    return _mixed(share, p, _moved(p, z))


def _trace_step(disturbance, z, share, state, t):
    p = disturbance(state)
    return _mixed(share, p, _moved(p, index_tree(z, t)))


def _policy_start(start, other, strength, share):
    p, q = start(), other()
    if isinstance(q, D.Deterministic):
        q = _towards(p, D.mode(q), strength)
    elif share is None:
        q = blend(jnp.stack([1 - strength, strength]), p, q)
    return _mixed(share, p, q)


def _policy_step(disturbance, policy, strength, share, state, t):
    p = disturbance(state)
    return _mixed(share, p, _towards(p, D.mode(policy(state, t)), strength))


def _towards(p, x, strength):
    """p moved so that its middle is x (eq. 10-11)."""
    return _moved(p, jax.tree.map(lambda z: strength.astype(z.dtype) * z, D.to_normal(p, x)))
