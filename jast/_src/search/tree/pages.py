"""The edges of trees, in rows of `search.tree.layout.Tree.edges`: what stands where in a row, what
a simulation and a prune add to them, and how the children of nodes are found there.
"""

import jax.numpy as jnp
from jax import lax

__all__ = [
    "CHILD",
    "LINK",
    "PAGE",
    "RETURNS",
    "REWARD",
    "ROW",
    "VISITS",
    "add_turn",
    "back_up",
    "children_of",
    "edge_of",
    "fills",
]

PAGE = 15  # children on a page: with the link a row of 16, a cache line of 64 bytes
# columns of a page's row in Tree.edges
VISITS, RETURNS, CHILD, REWARD = (column * (PAGE + 1) for column in range(4))
# a page's last entry is no child: there stands the page that continues this one, or 0
LINK = VISITS + PAGE
ROW = 4 * (PAGE + 1)  # numbers of a row: four columns


def back_up(tree, walk, fresh, child, value, new, link):
    """The edges with one more visit and return along each path, and the new children in their
    slots: one scatter, since what is new was 0.
    """
    nowhere = tree.edges.size
    level = jnp.arange(tree.path.shape[0], dtype=jnp.int32)[:, None]
    last = walk.depth + (tree.alive & ~tree.ended).astype(jnp.int32)
    between = (level >= tree.depth[None]) & (level < last[None])
    at = jnp.where(between, walk.path, nowhere).reshape(-1)
    ids = jnp.where(child.done, -new, new).astype(tree.edges.dtype)
    slot = jnp.where(fresh, walk.best.edge, nowhere)
    returns = jnp.broadcast_to(value[None], walk.path.shape).reshape(-1)
    places = [at + VISITS, at + RETURNS, slot + CHILD, slot + REWARD]
    values = [jnp.ones_like(returns), returns, ids, child.reward]
    if link:  # where the page is full now, another goes on
        places.append(jnp.where(fresh & fills(walk), walk.best.edge // ROW * ROW + LINK, nowhere))
        values.append(tree.pages.astype(tree.edges.dtype))
    return tree.edges.at[jnp.concatenate(places)].add(jnp.concatenate(values), mode="drop")


def fills(walk):
    """Whether the chosen slot is the last of its page."""
    return walk.best.edge % ROW == PAGE - 1


def add_turn(tree):
    """The visits and returns of this turn, added to the edges above the root: the backup of
    Algorithm 1 goes to the first root.
    """
    place = jnp.arange(tree.path.shape[0], dtype=jnp.int32)[:, None]
    at = jnp.where(place < tree.depth[None], tree.path, tree.edges.size)
    places = jnp.stack([at + VISITS, at + RETURNS]).reshape(-1)
    values = jnp.broadcast_to(tree.turn[:, None], (2, *at.shape)).reshape(-1)
    return tree._replace(
        edges=tree.edges.at[places].add(values, mode="drop"), turn=jnp.zeros_like(tree.turn)
    )


def children_of(tree, children):
    """Of each root's children: their pages' rows [B, pages], and [B, children] visits, returns, ids
    and rewards; 0 where there is none.
    """
    (lanes,) = tree.key.shape
    lane = jnp.arange(lanes, dtype=jnp.int32)
    edges = tree.edges.reshape(-1, ROW)

    def page(carry, _):
        row, there = carry
        record = jnp.where(there[:, None], edges[row], 0)
        link = record[:, LINK].astype(jnp.int32)
        return (jnp.where(link > 0, link * lanes + lane, row), there & (link > 0)), (row, record)

    start = (tree.root * lanes + lane, jnp.ones((lanes,), bool))
    _, (rows, records) = lax.scan(page, start, None, length=-(-children // PAGE))
    columns = (
        records[:, :, c : c + PAGE].swapaxes(0, 1).reshape(lanes, -1)[:, :children]
        for c in (VISITS, RETURNS, CHILD, REWARD)
    )
    return rows.T, *columns


def edge_of(tree, parent, slot, children):
    """The place [n, B] in the edges of the child in this slot of the node ``parent``; ``children``:
    the greatest number of a node.
    """
    (lanes,) = tree.key.shape
    lane = jnp.arange(lanes, dtype=jnp.int32)[None]
    row = parent * lanes + lane
    for hop in range(1, -(-children // PAGE)):
        following = tree.edges[row * ROW + LINK].astype(jnp.int32) * lanes + lane
        row = jnp.where(slot >= hop * PAGE, following, row)
    return row * ROW + slot % PAGE
