"""The failures that an estimate has drawn, as points of normal numbers."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri

from jast._src.core.episode import replay
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.distributions.standardised import chances
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.exceedance_and_times import draws_and_level
from jast._src.estimate.redraw import dimension_of, redraw_failures
from jast._src.normal_space import transform
from jast._src.util.checks import wrong
from jast._src.util.pytrees import index_tree

__all__ = ["UNRELIABLE", "failing_draws", "free_undecided", "normalised"]

LANES = 1024  # failures whose choices are looked up at a time
UNRELIABLE = "UNRELIABLE: the estimate is unreliable, or there are too few failures"


def normalised(log_w: np.ndarray) -> np.ndarray:
    """Weights [m] of sum 1."""
    w = np.exp(log_w - log_w.max())
    return w / w.sum()


def failing_draws(
    name: str, sim: Simulator, estimate: Estimate, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """At most ``most`` of the failures that ``estimate`` drew: points [m, D], log weights [m],
    steps [m], and evaluations, none unless it drew by tilts.

    Raises:
        ValueError: in the name of the function ``name``, where it drew none, or other numbers.
    """
    kept, _ = draws_and_level(name, estimate, None)
    if isinstance(kept.source, str) and kept.source != "model":
        must = "have drawn normal numbers"
        raise wrong(name, "estimate", must, f"one by {estimate.method} that drew by {kept.source}")
    if not kept.failure.any():
        raise ValueError(f"{name}: estimate must have seen a failure, received one that saw none")
    if (of := dimension_of(kept.source)) not in (None, d := transform.dimension(sim)):
        must = f"be the simulator of the estimate, with {of} random numbers in an episode"
        raise wrong(name, "sim", must, f"one with {d}")
    return redraw_failures(sim, kept, most)


def free_undecided(
    sim: Simulator, z: np.ndarray, length: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The points ``z`` [m, D] as drawn from p(z | failure): a whole number anywhere in the normal
    numbers that give it, and numbers behind the end of an episode, which decided nothing, as the
    model has them.
    """
    signature = signature_of(sim)
    leaves = jax.tree.leaves((signature.x0, signature.x))
    if any(np.issubdtype(leaf.dtype, np.integer) for leaf in leaves):
        chance = transform.side_by_side(sim, partial(_chances, sim), z, lanes=LANES)
        u = np.asarray(ndtr(-np.abs(z)))
        u = u + chance * (rng.random(z.shape) - 0.5)
        moved = np.asarray(ndtri(jnp.clip(u, 1e-30, 1 - 1e-7))) * np.where(z > 0, -1, 1)
        z = np.where(chance > 0, moved, z)
    undecided = np.arange(z.shape[1]) >= transform.used_numbers(sim, length)[:, None]
    return np.where(undecided, rng.standard_normal(z.shape), z).astype(z.dtype)


@jax.jit
def _chances(sim: Simulator, z: jax.Array) -> jax.Array:
    """[n, D]: the probability of each whole number of the episodes of ``z``, 0 of the others."""

    def one(e: Any) -> tuple[Any, Any]:
        states = index_tree(replay(sim, e).states, np.s_[:-1])
        steps = jax.vmap(lambda s, x: chances(sim.disturbance(s), x))(states, e.disturbances)
        return chances(sim.start(), e.x0) if signature_of(sim).random_start else (), steps

    first, steps = jax.vmap(one)(transform.episodes(sim, z))
    return transform.flat(sim, first, steps)
