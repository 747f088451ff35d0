"""How a search uses its heads: what they count for, and rollout steps drawn from the policy head's
histogram.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.heads.heads import Heads, draw_by_bins, observation, policy_logits
from jast._src.util.pytrees import select

__all__ = ["Guide", "guide", "rolled"]


_SHARE = np.uint32(1 << 31)  # address apart from those of levels
_HEAD = np.uint32(1)  # address apart from that of what is drawn without heads


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Guide:
    """Heads in a search; the numbers are traced."""

    heads: Heads
    power: jax.Array
    """A bin is drawn with probability proportional to p^power."""
    q_weight: jax.Array
    """Of Q(s, a) where there is a value head."""
    v_weight: jax.Array
    """c2 of MCFS-AP eq. 3."""
    share: jax.Array
    """Of the rollouts that the policy head draws."""
    levels: jax.Array
    """The first levels of an episode, at which the policy head draws."""
    eager: bool = field(default=False, metadata=dict(static=True))
    """Whether a node's unvisited children are all that widening allows, or one at a time."""


def guide(heads, settings):
    """The `Guide` by ``heads`` (of `jast.heads`) and their settings; one without influence where
    they were never trained and may not guide so.
    """
    levels = jnp.where(settings.from_start, 2**30, jnp.asarray(heads.levels, jnp.int32))
    trained = levels > 0
    made = Guide(
        heads,
        power=jnp.float32(settings.power),
        q_weight=jnp.where(trained, jnp.float32(settings.q_weight), jnp.float32(1)),
        v_weight=jnp.where(trained, jnp.float32(settings.v_weight), jnp.float32(0)),
        share=jnp.float32(settings.share),
        levels=levels,
        eager=settings.candidates == "all",
    )
    return jax.tree.map(jnp.asarray, made)


def rolled(guide, sim, actions, simulation, key, level, state, dist, otherwise):
    """A rollout's disturbance by the policy head; ``otherwise`` at levels that it has learned
    nothing of, and in the simulations that are not its share.
    """
    logits = guide.power * policy_logits(guide.heads, observation(sim, state))
    own = jax.random.uniform(jax.random.fold_in(simulation, _SHARE), (), jnp.float32) < guide.share
    x = draw_by_bins(jax.random.fold_in(key, _HEAD), logits, actions, dist)
    return select(own & (level < guide.levels), x, otherwise)
