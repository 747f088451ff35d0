"""All edges of finished trees: as samples for a value head (the published training set), and as
they stand, to be looked at.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.core.signature import signature_of
from jast._src.core.typing import Array
from jast._src.distributions.flat_rows import flat
from jast._src.heads.heads import observation
from jast._src.search.tree.best_episode import fed_source
from jast._src.search.tree.layout import choose, choose_child, flags, node_keys, nodes_of
from jast._src.search.tree.pages import CHILD, RETURNS, VISITS, edge_of
from jast._src.util import display
from jast._src.util.pytrees import index_tree

__all__ = ["Branches", "Edges", "branches_of", "edges_of"]


class Edges(NamedTuple):
    """The edges (s, a) of B trees of S simulations; the one of row i was first taken by simulation
    i.
    """

    seen: jax.Array
    """[S, B, n] what networks see of s."""
    x: jax.Array
    """[S, B, d] the disturbance."""
    q: jax.Array
    """[S, B] Q(s, a)."""
    parent_q: jax.Array
    """[S, B] Q of the edge that leads to s, 0 at the first root: the published target."""
    valid: jax.Array
    """[S, B] bool: there is such an edge."""


def edges_of(problem, tree, children, axes=None):
    """The `Edges` of trees that keep states at every node; ``children``: the greatest number of a
    node.
    """
    node, _, _, q, valid = _numbers(problem, tree, children)
    parent, slot = node.parent[1:], node.slot[1:]
    parent_q = jnp.take_along_axis(jnp.concatenate([jnp.zeros_like(q[:1]), q]), parent, axis=0)

    def one(problem, keys, states, parent, slot):
        """A tree's, [S, ...]."""

        def edge(parent, slot):
            state = index_tree(states, parent)
            node_key = node_keys(keys[None], parent[None])[0]
            _, x = choose_child(problem, node_key, slot, state)
            return observation(problem.sim, state), flat(x)

        return jax.vmap(edge)(parent, slot)

    seen, x = jax.vmap(one, in_axes=(axes, 0, 1, 1, 1), out_axes=1)(
        problem, tree.key, node.state, parent, slot
    )
    if signature_of(problem.sim).random_start:  # the first level chooses x0
        valid = valid & (parent > 0)
    return Edges(seen, x, q, parent_q, valid)


@display.printable()
class Branches(NamedTuple):
    """B trees of up to S nodes beside their first roots. Row i is the node that simulation i made,
    number i + 1, and the edge that leads to it; the first root has number 0.
    """

    parent: Array
    """[S, B] int32: the number of the node that it is a child of."""
    start: Any
    """[S, B, ...] its x0, which is the choice at the first root of a system with a random start;
    ``()`` for one start.
    """
    x: Any
    """[S, B, ...] its disturbance; at the first root of a random start it means nothing."""
    visits: Array
    """[S, B] int32: N(s, a), 0 where there is no such node."""
    q: Array
    """[S, B] float: Q(s, a)."""
    end: Array
    """[S, B] bool: an episode ends there."""
    distance: Array
    """[S, B] float: miss distance up to there."""
    reward: Array
    """[S, B] float: of the episode of the simulation that made it."""
    failure: Array
    """[S, B] bool: that episode failed."""


def branches_of(problem, tree, children, axes=None):
    """The `Branches` of trees that keep states at every node; ``children`` as for `edges_of`."""
    node, child, visits, q, valid = _numbers(problem, tree, children)
    parent, slot = node.parent[1:], node.slot[1:]
    lane = jnp.arange(tree.key.shape[0], dtype=jnp.int32)
    level, source = jnp.zeros_like(parent), node.source
    if problem.choice.follow:

        def up(_, at):
            above, level = at
            return jnp.take_along_axis(node.parent, above, axis=0), level + jnp.sign(above)

        _, level = lax.fori_loop(0, problem.levels, up, (parent, level))
        source = source[1:]
    fed = fed_source(tree, source, lane[None])

    def one(problem, key, states, *of):
        """A tree's, [S, ...]."""

        def edge(parent, slot, level, source, fed):
            state = index_tree(states, parent)
            return choose(problem, key, parent, slot, level, state, source, fed)

        return jax.vmap(edge)(*of)

    start, x = jax.vmap(one, in_axes=(axes, 0, *[1] * 6), out_axes=1)(
        problem, tree.key, node.state, parent, slot, level, source, fed
    )
    failed, *_ = flags(tree.outcome)
    return Branches(
        parent=parent,
        start=start,
        x=x,
        visits=jnp.where(valid, visits, 0).astype(jnp.int32),
        q=q,
        end=valid & (child < 0),
        distance=node.distance[1:],
        reward=tree.log,
        failure=failed,
    )


def _numbers(problem, tree, children):
    """The nodes [S + 1, B], and of the edge that leads to each but the first root [S, B]: the
    child's id, visits, Q, and whether there is such an edge.
    """
    node = nodes_of(tree, "node", tree.nodes)
    parent = node.parent[1:]
    at = edge_of(tree, parent, node.slot[1:], children)
    visits, total = tree.edges[at + VISITS], tree.edges[at + RETURNS]
    own = jnp.take_along_axis(node.reward, parent, axis=0)  # up to s
    _, fresh, *_ = flags(tree.outcome)
    valid = fresh & ~tree.ended[None] & (visits > 0)
    q = jnp.where(valid, problem.q_value(total, visits, own), 0)
    return node, tree.edges[at + CHILD], visits, q, valid
