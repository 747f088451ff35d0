"""The rollout-policy head as a `Policy`: for rollouts of its own and for estimators, which need its
density.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core.policy import Policy
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Actions, Numeric
from jast._src.distributions.flat_rows import flat
from jast._src.distributions.mixtures import OneByOne
from jast._src.heads.heads import Heads, draw_by_bins, observation, policy_logits
from jast._src.heads.samples import cells

__all__ = ["as_policy"]


class Histogram(OneByOne):
    """Disturbances whose points in the unit cube (`jast.actions`) have a density constant in each
    of equal cells: ``logits`` [d, bins].
    """

    def __init__(self, logits, actions, dist):
        self._logits, self._actions, self._dist = logits, actions, dist

    @property
    def event_shape(self):
        return jax.tree.map(lambda s: s.shape, D.event_like(self._dist))

    def _draw(self, key):
        return draw_by_bins(key, self._logits, self._actions, self._dist)

    def log_prob(self, value):
        """Log density; floating disturbances only, since a cell need not hold whole integers."""
        bins = self._logits.shape[1]
        cell = cells(flat(self._actions.locate(value, self._dist)), bins)
        shares = jax.nn.log_softmax(self._logits, axis=1)
        logs = jnp.take_along_axis(shares, cell[:, None], axis=1) + jnp.log(jnp.float32(bins))
        base = self._actions.log_prob(value, self._dist)
        return base + jnp.sum(logs).astype(base.dtype)


def as_policy(sim: Simulator, heads: Heads, actions: Actions, power: Numeric = 1.0) -> Policy:
    """The policy head of some heads as a `jast.Policy`; x0 is drawn from the system's own start.

    Args:
        sim: the simulator.
        heads: `Heads` with a policy head.
        actions: those that it was trained on.
        power: as in `HeadSettings`: 1 is the histogram that was learned.

    Raises:
        ValueError: without a policy head, and for disturbances that hold integers.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> few = jast.heads.settings(round=2, hidden=(8,), steps=(5, 5), bins=4)
        >>> found = jast.search.forest(
        ...     jax.random.key(0), sim, trees=4, prunes=1, simulations=50, heads="rollout",
        ...     actions=jast.actions.wide(2.0), head_settings=few, refine=0,
        ... )
        >>> policy = jast.heads.as_policy(sim, found.heads, jast.actions.wide(2.0))
        >>> jast.rollout(jax.random.key(1), sim, policy).disturbances.shape
        (30,)
    """
    if heads.policy is None:
        raise ValueError("heads.as_policy: expected heads with a policy head, received none")
    like = signature_of(sim).x
    if not all(jnp.issubdtype(s.dtype, jnp.floating) for s in jax.tree.leaves(like)):
        raise ValueError(f"heads.as_policy: expected a disturbance of floats, received {like}")
    power = jnp.asarray(power, jnp.float32)
    return Policy(sim.start, Partial(_disturbance, sim, heads, actions, power))


def _disturbance(sim, heads, actions, power, state, t):
    return Histogram(
        power * policy_logits(heads, observation(sim, state)), actions, sim.disturbance(state)
    )
