"""What a tree does with the best episode that it has seen: grow that episode's path, or feed its
action to later rollouts.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.search.tree.packing import unpack, width
from jast._src.util.pytrees import select

__all__ = [
    "Lead",
    "fed_of",
    "fed_source",
    "feed_level",
    "follows",
    "no_lead",
    "take_fed",
    "update_lead",
]


class Lead(NamedTuple):
    """The best episode of each of B trees; with ``follow``, the best failure. Without it ``on`` to
    ``path`` are ``()``, without ``feed`` ``fed`` is.
    """

    value: jax.Array
    """[B] float: its reward; -inf before there is one."""
    source: jax.Array
    """[B] int32: 1 + its simulation."""
    on: jax.Array | tuple[()]
    """[B] bool: the next simulation goes straight to ``node`` and takes there what the best episode
    took.
    """
    node: jax.Array | tuple[()]
    """[B] int32: the last node on the path of that episode."""
    depth: jax.Array | tuple[()]
    """[B] int32: its level."""
    reward: jax.Array | tuple[()]
    """[B] float: from the start up to it."""
    trail: jax.Array | tuple[()]
    """[H + 1, B] int32: nodes from the first root to it."""
    path: jax.Array | tuple[()]
    """[H, B] int32: edges to it, as places in the tree's edges."""
    fed: jax.Array | tuple[()]
    """[S + 1, B, words] uint32: what the rollout of each simulation is fed: whether there is
    anything, and the packed disturbance.
    """


def no_lead(problem, lanes, levels, simulations, dtype):
    """The `Lead` of trees that have seen nothing, or ``()`` where the search wants none."""
    follow, feed = problem.choice.follow, problem.choice.feed
    if not (follow or feed):
        return ()
    zero, low = jnp.zeros((lanes,), jnp.int32), jnp.full((lanes,), -jnp.inf, dtype)
    trail = jnp.zeros((levels + 1, lanes), jnp.int32)
    path = zero > 0, zero, zero, jnp.zeros_like(low), trail, trail[:-1]
    words = width(_fed_row(problem.sim))
    fed = jnp.zeros((simulations + 1, lanes, words), jnp.uint32) if feed else ()
    return Lead(low, zero, *(path if follow else ((),) * 6), fed)


def follows(tree):
    """Whether nodes may have taken their action from the best episode."""
    return isinstance(tree.lead, Lead) and not isinstance(tree.lead.on, tuple)


def feed_level(sim: Simulator) -> int:
    """The level at which floor(horizon / 2) steps remain (thesis Algorithm 9)."""
    return sim.horizon - sim.horizon // 2 + signature_of(sim).random_start


def fed_of(tree, simulation, lane):
    """What the rollouts of these simulations were fed, [..., words]; ``()`` where nothing ever
    is.
    """
    fed = tree.lead.fed if isinstance(tree.lead, Lead) else ()
    return fed if isinstance(fed, tuple) else fed[simulation, lane]


def fed_source(tree, source, lane):
    """What the rollouts that actions were taken from, ``source`` of `Node`, were fed; ``()`` where
    none is taken from any, or nothing ever is.
    """
    return fed_of(tree, jnp.maximum(source - 1, 0), lane) if follows(tree) else ()


def take_fed(sim, words, here, x):
    """One lane: the disturbance that is fed, where there is one and ``here``; else ``x``."""
    there, fed = unpack(words, _fed_row(sim))
    return select(here & there, fed, x)


def update_lead(tree, walk, fresh, child, value, failed, i, middle):
    """The `Lead` after simulation ``i``, whose episodes earned ``value`` [B]; ``middle`` [B,
    words]: what their rollouts took at `feed_level`. ``()`` where the search wants none.
    """
    lead = tree.lead
    if not isinstance(lead, Lead):
        return ()
    better = fresh & jnp.isfinite(value) & (value > lead.value)
    # of failures only: following every better miss costs more finds than it brings
    if follows(tree):
        better &= failed
        moves = fresh & (better | lead.on)
        lane, new = jnp.arange(len(value), dtype=jnp.int32), jnp.zeros_like(lead.node) + i + 1
        lead = lead._replace(
            on=moves & ~child.done,
            node=jnp.where(moves, new, lead.node),
            depth=jnp.where(moves, walk.depth + 1, lead.depth),
            reward=jnp.where(moves, child.reward, lead.reward),
            trail=jnp.where(moves[None], walk.trail.at[walk.depth + 1, lane].set(new), lead.trail),
            path=jnp.where(moves[None], walk.path, lead.path),
        )
    if not isinstance(lead.fed, tuple):
        # thesis Algorithm 9: a* after this rollout
        row = jnp.where((better & (middle[:, 0] > 0))[:, None], middle, lead.fed[i])
        lead = lead._replace(fed=jax.lax.dynamic_update_slice_in_dim(lead.fed, row[None], i + 1, 0))
    return lead._replace(
        value=jnp.where(better, value, lead.value),
        source=jnp.where(better, jnp.zeros_like(lead.source) + i + 1, lead.source),
    )


def _fed_row(sim: Simulator) -> Any:
    """The shapes of what a row of ``Lead.fed`` packs: whether there is anything, and what."""
    return jax.ShapeDtypeStruct((), jnp.bool_), signature_of(sim).x
