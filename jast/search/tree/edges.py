"""All edges of finished trees, as samples for a value head: the published training set."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast.distributions.numbers import flat
from jast.heads.heads import observed
from jast.outline import outline
from jast.search.tree.layout import (
    FRESH,
    LINK,
    PAGE,
    RETURNS,
    ROW,
    VISITS,
    choose_child,
    node_keys,
    node_shapes,
)
from jast.search.tree.packing import unpack

__all__ = ["Edges", "edges_of"]


class Edges(NamedTuple):
    """The edges (s, a) of B trees of S simulations; the one of row i was first taken by simulation
    i.
    """

    seen: Any
    """[S, B, n] what networks see of s."""
    x: Any
    """[S, B, d] the disturbance."""
    visits: Any
    """[S, B] N(s, a)."""
    q: Any
    """[S, B] Q(s, a)."""
    parent_q: Any
    """[S, B] Q of the edge that leads to s, 0 at the first root: the published target."""
    valid: Any
    """[S, B] bool: there is such an edge."""


def edges_of(problem, axes, tree, children):
    """The `Edges` of trees that keep states at every node; ``children``: the greatest number of a
    node.
    """
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)[None]
    like = node_shapes(tree, "node")
    node = jax.vmap(jax.vmap(lambda w: unpack(w, like)))(tree.nodes)  # [S + 1, B]
    parent, slot = node.parent[1:], node.slot[1:]
    row = parent * lanes + lane
    for hop in range(1, -(-children // PAGE)):
        row = jnp.where(
            slot >= hop * PAGE, tree.edges[row * ROW + LINK].astype(jnp.int32) * lanes + lane, row
        )
    at = row * ROW + slot % PAGE
    visits, total = tree.edges[at + VISITS], tree.edges[at + RETURNS]
    own = jnp.take_along_axis(node.reward, parent, axis=0)  # up to s
    valid = ((tree.outcome & FRESH) > 0) & ~tree.ended[None] & (visits > 0)
    q = jnp.where(valid, problem.onward(total, visits, own), 0)
    parent_q = jnp.take_along_axis(jnp.concatenate([jnp.zeros_like(q[:1]), q]), parent, axis=0)

    def one(problem, keys, states, parent, slot):
        """A tree's, [S, ...]."""

        def edge(parent, slot):
            state = jax.tree.map(lambda a: a[parent], states)
            return observed(problem.sim, state), flat(
                choose_child(problem, node_keys(keys[None], parent[None])[0], slot, state)[1]
            )

        return jax.vmap(edge)(parent, slot)

    seen, x = jax.vmap(one, in_axes=(axes, 0, 1, 1, 1), out_axes=1)(
        problem, tree.key, node.state, parent, slot
    )
    if outline(problem.sim).random_start:  # the first level chooses x0
        valid = valid & (parent > 0)
    return Edges(seen, x, visits.astype(jnp.int32), q, parent_q, valid)
