"""Action pruning (MCFS-AP A1): the robust child becomes the root, its subtree stays, and the old
root's statistics are kept for training.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.search.tree.best_episode import fed_source, follows
from jast._src.search.tree.layout import choose, nodes_of
from jast._src.search.tree.pages import PAGE, ROW, add_turn, children_of
from jast._src.search.tree.simulate import child_state, replay_to
from jast._src.util import display
from jast._src.util.pytrees import index_tree, select_rows

__all__ = ["Roots", "prune", "recounted"]


@display.printable()
class Roots(NamedTuple):
    """What is known of B roots at the end of their turn: K is the greatest number of children."""

    state: Any
    """[B, ...] the simulator's state at the root."""
    depth: jax.Array
    """[B] int32: levels above the root."""
    actions: Any
    """[B, K, ...] the disturbances x of the children."""
    starts: Any
    """[B, K, ...] the x0 of the children, which are the choices at depth 0 of a random start;
    ``()`` for a system with one start.
    """
    visits: jax.Array
    """[B, K] int32: 0 where there is no such child."""
    q: jax.Array
    """[B, K] float: mean reward from the root on, the child's own step included."""
    valid: jax.Array
    """[B] bool: the tree was searching from this root."""


def prune(problem, tree, children, memoize="node", axes=None):
    """Make the most visited child of each root the root (ties: the first made): the tree and the
    old roots' `Roots`.

    ``children``: the greatest number of children a node can have, static. A tree whose new root is
    an episode's end is at its end.
    """
    root, level = tree.root, tree.depth
    searching = tree.alive & ~tree.ended
    state = _root_state(problem, axes, tree, memoize)
    tree = add_turn(tree)
    pages, visits, total, child, reward = children_of(tree, children)
    q = problem.q_value(total, visits, tree.root_reward[:, None])

    slots, lane = jnp.arange(children, dtype=jnp.int32), jnp.arange(len(root), dtype=jnp.int32)
    source, fed = (), ()
    if follows(tree):
        rows = tree.nodes[jnp.abs(child).astype(jnp.int32), lane[:, None]]
        source = jnp.where(visits > 0, nodes_of(tree, memoize, rows).source, 0)
        fed = fed_source(tree, source, lane[:, None])

    def draw(p, key, root, level, state, *of):
        return jax.vmap(lambda slot, *of: choose(p, key, root, slot, level, state, *of))(slots, *of)

    starts, actions = jax.vmap(draw, in_axes=(axes, *[0] * 6))(
        problem, tree.key, root, level, state, source, fed
    )
    roots = Roots(state, level, actions, starts, visits.astype(jnp.int32), q, searching)

    slot = jnp.argmax(visits, axis=1).astype(jnp.int32)
    n, to, reward = (_pick(a, slot) for a in (visits, child, reward))
    move = searching & (n > 0)
    new = jnp.where(move, jnp.abs(to).astype(jnp.int32), root)
    place = jnp.arange(tree.trail.shape[0], dtype=jnp.int32)[:, None]
    edge = _pick(pages, slot // PAGE) * ROW + slot % PAGE
    tree = tree._replace(
        path=jnp.where(move[None] & (place[:-1] == level[None]), edge[None], tree.path),
        trail=jnp.where(move[None] & (place == level[None] + 1), new[None], tree.trail),
        root=new,
        root_visits=jnp.where(move, n.astype(jnp.int32), tree.root_visits),
        root_reward=jnp.where(move, reward, tree.root_reward),
        depth=level + move.astype(jnp.int32),
        alive=tree.alive & move & (to > 0),
    )
    if follows(tree):  # what is known of another branch says nothing of this one
        lead, keep = tree.lead, _pick(tree.lead.trail.T, level + 1) == new
        tree = tree._replace(
            lead=lead._replace(on=lead.on & keep, value=jnp.where(keep, lead.value, -jnp.inf))
        )
    if memoize == "root":
        of = jax.vmap(index_tree)((source, fed), slot)
        after = jax.vmap(child_state, in_axes=(axes, *[0] * 7))(
            problem, tree.key, root, slot, level, state, *of
        )
        tree = tree._replace(base=select_rows(move, after, state))
    return tree, roots


def recounted(problem, tree, roots, children, memoize="node"):
    """`Roots` [turns, B] of a finished tree with the visits and means that their children have at
    its end, when the simulations of later roots have gone through one child of each.
    """
    lane = jnp.arange(len(tree.root), dtype=jnp.int32)

    def one(root):
        node = tree.trail[root.depth, lane]
        reward = nodes_of(tree, memoize, tree.nodes[node, lane]).reward
        _, visits, total, *_ = children_of(tree._replace(root=node), children)
        q = problem.q_value(total, visits, reward[:, None])
        count = jnp.where(root.valid[:, None], visits, 0).astype(jnp.int32)
        return root._replace(visits=count, q=q)

    return lax.map(one, roots)


def _root_state(problem, axes, tree, memoize):
    if memoize == "node":
        rows = tree.nodes[tree.root, jnp.arange(len(tree.root))]
        return nodes_of(tree, memoize, rows).state
    if memoize == "root":
        return tree.base
    return replay_to(problem, axes, tree, tree.trail, tree.depth, memoize)[0]


def _pick(array, index):
    return jnp.take_along_axis(array, index[:, None], axis=1)[:, 0]
