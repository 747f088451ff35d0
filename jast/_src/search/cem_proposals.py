"""How `jast.search.cem` makes the disturbances of an episode: of latent normal numbers
(`normal_space.sequences`), or copied from good episodes.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core import actions as choices
from jast._src.core.episode import stacked
from jast._src.core.failures import Failures
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.normal_space.sequences import disturbance_at
from jast._src.normal_space.transform import latents
from jast._src.util.checks import instance
from jast._src.util.pytrees import index_tree, select

__all__ = ["latents_around", "copy_steps", "make_draw", "proposal_kinds"]

# addresses of an episode's choice of parents, apart from those of its levels
_CHOICE = np.uint32(1 << 31)


def proposal_kinds(sim: Simulator, actions: Any) -> tuple[str, str]:
    """How x0 and x are proposed: "latent" where they have a quantile function or a box, else
    "copy".
    """
    if isinstance(actions, choices.Quantiles | choices.Wide | choices.UniformBox):
        # a start is never of the box
        return "latent" if signature_of(sim).start.quantile else "copy", "latent"
    return "copy", "copy"


def copy_steps(key, values, lengths, fresh, part):
    """The disturbances [T, ...] that one episode may copy, and whether it does [T].

    ``values`` [n, T, ...]: those of n parents, of which ``lengths`` [n] rows count, -1: no parent.
    Each step has a parent of its own, drawn uniformly, and with probability ``fresh`` none. The key
    is that of the episode; ``part`` tells x0 (0) from the steps (1).
    """
    steps = jax.tree.leaves(values)[0].shape[1]
    t = jnp.arange(steps, dtype=jnp.int32)
    parent, anew = jax.random.split(jax.random.fold_in(key, _CHOICE + np.uint32(part)))
    known = jnp.sum(lengths >= 0, dtype=jnp.int32)
    p = jax.random.randint(parent, (steps,), 0, jnp.maximum(known, 1), jnp.int32)
    use = (jax.random.uniform(anew, (steps,), fresh.dtype) >= fresh) & (t < lengths[p])
    return index_tree(values, (p, t)), use


def make_draw(kind, actions, anew):
    """``(key, row, distribution) -> disturbance``, the row being z, or a pair of `copy_steps`;
    ``anew(key, distribution)`` draws where there is nothing to copy.
    """
    if kind == "latent":
        return lambda key, z, dist: disturbance_at(actions, dist, z)

    def copied(key, row, dist):
        value, use = row
        return select(use, value, anew(key, dist))

    return copied


def latents_around(sim, actions, failures, settings):
    """The latents of the likeliest of ``failures``: leaves [1, ...] of x0 and [horizon, ...] of x;
    ``()`` where there is none. ``settings``: None inside of a transformation of JAX.
    """
    if settings is None:
        raise ValueError("cem: failures must be None inside of jax.jit and jax.vmap")
    instance("cem", "failures", failures, Failures, "an archive (result.failures)")
    words = "quantiles() or wide() where failures are given"
    instance("cem", "actions", actions, choices.Wide | choices.Quantiles, words)
    if not len(failures):
        return ()
    one = stacked([failures.best])
    signature = signature_of(sim)
    of_start = signature.random_start and signature.start.quantile
    z0, z = jax.device_get(latents(sim, (one.x0, one.disturbances, one.length), of_start))
    return z0, index_tree(z, 0)
