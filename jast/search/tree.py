"""A batch of search trees as arrays, and the four moves of a simulation: select, expand, roll out, back up.

All trees advance in lockstep: simulation i runs in every tree at once. Arrays never leave their place: every write is a row, or a scatter whose index is
out of range where there is nothing to write, and no tree array is an operand of a select.

 - Node ids: node ``i + 1`` is made by simulation i, in every tree; 0 is the first root. So making a node is one contiguous row write.
 - Edges: a node's children sit in pages of ``PAGE`` slots, each slot with the child's visits, the sum of its returns and its id. The first page of a node has
   the node's id; when a page fills up, the next free one is linked behind it, so a node may have any number of children. One page is one cache line an array.
 - A slot that was never visited needs no storage: the number of children is a function of the node's visits alone (`widths`), and the action of a slot is drawn
   from a key addressed by (tree, node, slot). Unvisited slots score alike, so they are visited in order.
 - Returns are those of whole episodes; Q(s, a) subtracts the reward up to s.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast.episode import Progress, advance, begin
from jast.search.records import pack, unpack

__all__ = ["PAGE", "Problem", "Roots", "Settings", "Tree", "bytes_per_tree", "grow", "make", "prune", "rebuild", "widths"]

PAGE = 15
LINK = PAGE  # a page's last entry is no child: its CHILD is the page that continues this one, or 0
VISITS, RETURNS, CHILD, REWARD = 0, 16, 32, 48  # columns of a page's row in Tree.edges
ROW = 64

FAILURE, FRESH, INVALID, RAN = 1, 2, 4, 8  # bits of Tree.outcome
_NODE = jnp.uint32(1 << 31)  # addresses of children, apart from those of simulations


class Settings(NamedTuple):
    """The real-valued settings of a search, all traced."""

    exploration: Any
    """c1 of MCFS-AP eq. 3."""
    widths: Any
    """[simulations + 2] int32: the number of children of a node by its visits."""


class Problem(NamedTuple):
    """What a tree search is about: pytrees, each shared by all trees or with a leading axis [B]."""

    sim: Any
    reward: Any
    actions: Any
    settings: Settings


class Tree(NamedTuple):
    """B trees of up to S simulations; H levels (the horizon, and one more for a random start)."""

    key: jax.Array
    """[B] counter keys."""
    edges: jax.Array
    """[pages * B * ROW] float: a row a page, ``page * B + lane``. Of each child: visits N(s, a), sum of returns, node id (negative: an episode's end, 0: not
    visited yet), reward from the start up to it."""
    nodes: jax.Array
    """[S + 1, B, words] uint32: a packed `Node` each."""
    desk: jax.Array
    """[2, B, words] uint32: where the node of a simulation is laid out to be read. XLA would cut a gather from a large array over threads, which for so few
    numbers costs more than it saves, unless the gather ends in an update in place."""
    pages: jax.Array
    """[B] int32: pages in use."""
    root: jax.Array
    """[B] int32: the current root."""
    root_visits: jax.Array
    """[B] int32: N(root)."""
    root_reward: jax.Array
    """[B] float: reward from the start up to the root."""
    depth: jax.Array
    """[B] int32: the current root's level."""
    trail: jax.Array
    """[H + 1, B] int32: nodes from the first root to the current one."""
    path: jax.Array
    """[H, B] int32: edges from the first root to the current one, as places in ``edges``."""
    turn: jax.Array
    """[2, B] float: visits and returns since the last root, which the edges of ``path`` have not seen yet."""
    alive: jax.Array
    """[B] bool: false once the root is an episode's end."""
    ended: jax.Array
    """[B] bool: the first root is one: the system ends at its start, and one simulation says all."""
    base: Any
    """[B, ...] the first root's state or, with memoization at roots, the current one's: where replays start."""
    worst: jax.Array
    """[B] float: least finite return so far, backed up in place of one that is not finite."""
    steps: jax.Array
    """[B] int32: simulator steps taken."""
    log: jax.Array
    """[S, B] float: reward of the episode of each simulation."""
    outcome: jax.Array
    """[S, B] uint8: bits FAILURE, FRESH (not an end seen before), INVALID, RAN."""


class Node(NamedTuple):
    """What a tree knows of a node beside its edges."""

    parent: jax.Array
    slot: jax.Array
    """Its place among its parent's children."""
    reward: jax.Array
    """From the start up to here."""
    distance: jax.Array
    failure: jax.Array
    state: Any
    """The simulator's state, or ``()`` where states are not kept at nodes."""


class Roots(NamedTuple):
    """Statistics of one root at the end of its turn, for training: K is the greatest number of children."""

    state: Any
    """[B, ...] the root's state."""
    depth: jax.Array
    """[B] int32."""
    actions: Any
    """[B, K, ...] the children's disturbances (of x0 at level 0 of a random start: see ``start``)."""
    visits: jax.Array
    """[B, K] int32: 0 where there is no such child."""
    q: jax.Array
    """[B, K] float: mean reward to go, the child's own step included."""
    valid: jax.Array
    """[B] bool: the tree was still searching."""


def widths(simulations, k, alpha):
    """[simulations + 2] int32: the number of children of a node that was visited n times before, n = 0, 1, ...

    Progressive widening adds at most one child a visit, while #children <= k n^alpha (MCFS-AP Algorithm 1; Moss's Algorithm 10 tests before it adds), which
    for alpha <= 1 comes to min(n, floor(k n^alpha) + 1). Made on the host in float64 unless ``k`` or ``alpha`` are traced.
    """
    if isinstance(k, jax.core.Tracer) or isinstance(alpha, jax.core.Tracer):
        n = jnp.arange(simulations + 2, dtype=jnp.int32)
        bound = jnp.floor(k * n.astype(jnp.float32) ** alpha * (1 + 4e-7)).astype(jnp.int32) + 1
        return jnp.minimum(n, bound)
    n = np.arange(simulations + 2)
    return jnp.asarray(np.minimum(n, np.floor(float(k) * n ** float(alpha) * (1 + 1e-14)) + 1), jnp.int32)


def levels(sim):
    """Levels of choices in an episode: x_1 .. x_horizon, and x0 where the start is random."""
    return sim.horizon + _random_start(sim)


def _random_start(sim):
    return bool(jax.tree.leaves(jax.eval_shape(lambda: D.sample(sim.start(), jax.random.key(0)))))


def make(problem, axes, keys, simulations, memoize="node"):
    """Trees of one root each, with room for ``simulations``; ``axes`` says which parts of ``problem`` differ between trees (0) or not (None)."""
    (lanes,) = keys.shape
    pages = simulations + 1 + simulations // PAGE + 1

    def origin(problem, key):
        if _random_start(problem.sim):
            x0 = problem.actions.draw_start(key, problem.sim.start())  # any state will do: the first level chooses x0
            first = begin(problem.sim, problem.reward, x0)
            zero = jnp.zeros((), bool)
            return Progress(first.state, jnp.zeros_like(first.reward), jnp.zeros_like(first.reward), jnp.full_like(first.distance, jnp.inf), zero, zero, zero)
        return begin(problem.sim, problem.reward, ())

    first = jax.vmap(origin, in_axes=(axes, 0))(problem, keys)
    dtype = first.reward.dtype
    count = jnp.zeros((lanes,), jnp.int32)
    node = Node(count, count, first.reward, first.distance, first.failure, first.state if memoize == "node" else ())
    record = jax.vmap(pack)(node)
    return Tree(
        key=keys,
        edges=jnp.zeros((pages * lanes * ROW,), dtype),
        nodes=jnp.zeros((simulations + 1, *record.shape), record.dtype).at[0].set(record),
        desk=jnp.zeros((2, *record.shape), record.dtype),
        pages=count + simulations + 1,
        root=count,
        root_visits=count + 1,
        root_reward=first.reward,
        depth=count,
        trail=jnp.zeros((levels(problem.sim) + 1, lanes), jnp.int32),
        path=jnp.zeros((levels(problem.sim), lanes), jnp.int32),
        turn=jnp.zeros((2, lanes), dtype),
        alive=jnp.ones((lanes,), bool),
        ended=first.done,
        base=first.state,
        worst=jnp.full((lanes,), jnp.inf, dtype),
        steps=count,
        log=jnp.full((simulations, lanes), -jnp.inf, dtype),
        outcome=jnp.zeros((simulations, lanes), jnp.uint8),
    )


def grow(problem, axes, tree, begin_at, end_at, memoize="node"):
    """Run simulations ``begin_at`` .. ``end_at - 1`` in every tree (traced: one program for any number)."""


    def body(i, tree):
        # the conditional also keeps XLA from cutting these small kernels over two threads, which costs more than it saves
        return lax.cond(jnp.any(tree.alive), lambda t: _simulation(problem, axes, t, i, memoize), lambda t: t, tree)

    return lax.fori_loop(begin_at, end_at, body, tree)


def _simulation(problem, axes, tree, i, memoize):
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    walk = _select(problem.settings, tree)
    fresh = tree.alive & ~tree.ended & (walk.best.child == 0)
    move = jax.vmap(_transition, in_axes=(axes, 0, 0, 0))
    nothing = jnp.zeros((lanes,), bool)
    zero = jnp.zeros((lanes,), tree.edges.dtype)

    def expand():
        """The new child of each tree; and the node it is a child of, or the episode's end that selection ran into."""
        at = jnp.where(fresh, walk.node, -walk.best.child)
        desk = lax.dynamic_update_slice_in_dim(tree.desk, tree.nodes[at, lane][None], i % 2, 0)
        like = _node_shapes(tree, memoize)
        node = jax.vmap(lambda w: unpack(w, like))(lax.dynamic_index_in_dim(desk, i % 2, keepdims=False))
        state, replayed = (node.state, jnp.zeros_like(at)) if memoize == "node" else _replay(problem, axes, tree, walk, memoize)
        before = Progress(state, zero, walk.reward, node.distance, nothing, nothing, nothing)
        child = move(problem, _child_key(tree.key, walk.node, walk.best.slot), walk.depth, before)
        return desk, child._replace(log_prob=zero), replayed, node.reward, node.failure

    # in a conditional, so that all reads of the tree are over before the first write: otherwise XLA copies the tree
    nobody = lambda: (tree.desk, *jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(expand)[1:]))
    desk, child, replayed, known_reward, known_failure = lax.cond(jnp.any(tree.alive), expand, nobody)

    # roll out; lanes that have ended step on, and only what is summed up is masked
    key = jax.vmap(jax.random.fold_in, in_axes=(0, None))(tree.key, i)

    def roll(carry):
        level, steps, at = carry
        live = ~at.done
        after = move(problem, jax.vmap(jax.random.fold_in)(key, level), level, at)
        kept = Progress(after.state, *(jnp.where(live, b, a) for a, b in zip(at[1:], after[1:], strict=True)))
        return level + 1, steps + _one(live), kept._replace(log_prob=zero)

    steps = _one(fresh & (walk.depth >= levels(problem.sim) - problem.sim.horizon))  # a random start is a level, but no step
    _, steps, end = lax.while_loop(lambda c: jnp.any(~c[2].done), roll, (walk.depth + 1, steps, child._replace(done=child.done | ~fresh)))

    value = jnp.where(fresh, end.reward, known_reward)
    finite = jnp.isfinite(value)
    worst = jnp.where(finite & tree.alive, jnp.minimum(tree.worst, value), tree.worst)
    backed = jnp.where(finite, value, jnp.where(jnp.isfinite(worst), worst, 0))
    first = tree.ended & tree.alive
    bits = (_bit(fresh | first, FRESH) | _bit(jnp.where(fresh, end.failure, known_failure), FAILURE) | _bit(~finite, INVALID) | _bit(True, RAN)) * tree.alive.astype(jnp.uint8)
    kept = Node(walk.node, walk.best.slot, child.reward, child.distance, child.failure, child.state if memoize == "node" else ())
    return tree._replace(
        edges=_back_up(tree, walk, fresh, child, backed, i + 1),
        nodes=lax.dynamic_update_slice_in_dim(tree.nodes, jax.vmap(pack)(kept)[None], i + 1, 0),
        desk=desk,
        pages=tree.pages + _one(fresh & _fills(walk)),
        root_visits=tree.root_visits + _one(tree.alive),
        turn=tree.turn + jnp.where(tree.alive, jnp.stack([jnp.ones_like(backed), backed]), 0),
        worst=worst,
        steps=tree.steps + steps + jnp.where(fresh, replayed, 0),
        log=lax.dynamic_update_slice_in_dim(tree.log, value[None], i, 0),
        outcome=lax.dynamic_update_slice_in_dim(tree.outcome, bits[None], i, 0),
        alive=tree.alive & ~tree.ended,
    )


def _back_up(tree, walk, fresh, child, value, new):
    """The edges with one more visit and return along each path, and the new children in their slots."""
    lanes = value.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    nowhere = tree.edges.size

    def level(carry):
        d, edges = carry
        at = jnp.where((d >= tree.depth) & (d < walk.depth + _one(tree.alive & ~tree.ended)), walk.path[d], nowhere)
        places, values = jnp.concatenate([at + VISITS, at + RETURNS]), jnp.concatenate([jnp.ones_like(value), value])
        return d + 1, edges.at[places].add(values, mode="drop")

    deepest = jnp.max(jnp.where(tree.alive, walk.depth, -1))
    _, edges = lax.while_loop(lambda c: c[0] <= deepest, level, (jnp.min(tree.depth), tree.edges))
    ids = jnp.where(child.done, -new, new).astype(edges.dtype)
    slot = jnp.where(fresh, walk.best.edge, nowhere)
    link = jnp.where(fresh & _fills(walk), walk.best.edge // ROW * ROW + CHILD + LINK, nowhere)  # the page is full now: another goes on
    places = jnp.concatenate([slot + CHILD, slot + REWARD, link])
    return edges.at[places].set(jnp.concatenate([ids, child.reward, tree.pages.astype(edges.dtype)]), mode="drop")


def _fills(walk):
    """Whether the chosen slot is the last of its page."""
    return walk.best.edge % ROW == PAGE - 1


class Best(NamedTuple):
    """The best child of a node so far."""

    score: jax.Array
    edge: jax.Array
    """Its place in the edges."""
    slot: jax.Array
    visits: jax.Array
    child: jax.Array
    """Node id; 0: never visited; negative: an episode's end."""
    reward: jax.Array


class Walk(NamedTuple):
    """Where the selection of each tree stands: at a page of a node, with the best child so far."""

    node: jax.Array
    row: jax.Array
    """The page's row in the edges."""
    offset: jax.Array
    """Slots in the pages before."""
    count: jax.Array
    """Children of the node."""
    bonus: jax.Array
    """Exploration weight times sqrt(ln N(s))."""
    reward: jax.Array
    """From the start up to the node."""
    depth: jax.Array
    best: "Best"
    done: jax.Array
    path: jax.Array
    trail: jax.Array
    desk: jax.Array
    scores: jax.Array
    turn: jax.Array


def _select(settings, tree):
    """Walk down to a child that was never visited, or to an episode's end: MCFS-AP eq. 3 and progressive widening, a page an iteration."""
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    edges, dtype = tree.edges, tree.edges.dtype
    slots = jnp.arange(PAGE + 1, dtype=jnp.int32)[None]
    place = jnp.arange(tree.trail.shape[0], dtype=jnp.int32)[:, None]
    exploration = jnp.broadcast_to(jnp.asarray(settings.exploration, dtype), (lanes,))
    lowest, nil = jnp.full((lanes,), -jnp.inf, dtype), jnp.zeros((lanes,), jnp.int32)

    def of_node(visits):
        count = settings.widths[visits] if settings.widths.ndim == 1 else settings.widths[lane, visits]
        return count, exploration * jnp.sqrt(jnp.log(visits.astype(dtype)))

    def read(w):
        """The pages' rows, laid out on the desk (see `Tree.desk`)."""
        rows = edges.reshape(-1, ROW)[w.row]
        desk = lax.dynamic_update_slice_in_dim(w.desk, rows[None], w.turn % 2, 0)
        return desk, lax.dynamic_index_in_dim(desk, w.turn % 2, keepdims=False)

    def pick(row, column, j):
        return jnp.take_along_axis(row, (column + j)[:, None], axis=1, mode="promise_in_bounds")[:, 0]

    def body(w):
        desk, row = read(w)
        n, total = row[:, VISITS:RETURNS], row[:, RETURNS:CHILD]
        q = jnp.where(n > 0, total / jnp.maximum(n, 1) - w.reward[:, None], 0)
        score = q + w.bonus[:, None] / jnp.sqrt(1 + n)  # eq. 3; the value term joins here
        score = jnp.where(slots < jnp.minimum(w.count - w.offset, PAGE)[:, None], score, -jnp.inf)
        scores = lax.dynamic_update_slice_in_dim(w.scores, score[None], w.turn % 2, 0)
        score = lax.dynamic_index_in_dim(scores, w.turn % 2, keepdims=False)
        j, top = jnp.argmax(score, axis=1).astype(jnp.int32), jnp.max(score, axis=1)
        visits, child, link = pick(row, VISITS, j).astype(jnp.int32), pick(row, CHILD, j).astype(jnp.int32), row[:, CHILD + LINK]
        found = Best(top, w.row * ROW + j, w.offset + j, visits, child, pick(row, REWARD, j))
        better = top > w.best.score  # the first maximum wins
        found = jax.tree.map(lambda a, b: jnp.where(better, a, b), found, w.best)
        more = ~w.done & (link > 0) & (w.offset + PAGE < w.count)  # without a link there is an unvisited slot here, and later ones score the same
        taken = ~w.done & ~more
        descend = taken & (found.child > 0)
        count, bonus = of_node(found.visits)
        return Walk(
            node=jnp.where(descend, found.child, w.node),
            row=jnp.where(more, link.astype(jnp.int32) * lanes + lane, jnp.where(descend, found.child * lanes + lane, w.row)),
            offset=jnp.where(more, w.offset + PAGE, 0),
            count=jnp.where(descend, count, w.count),
            bonus=jnp.where(descend, bonus, w.bonus),
            reward=jnp.where(descend, found.reward, w.reward),
            depth=w.depth + _one(descend),
            best=jax.tree.map(lambda a, b: jnp.where(w.done, b, a), found._replace(score=jnp.where(descend, -jnp.inf, found.score)), w.best),
            done=w.done | (taken & (found.child <= 0)),
            path=jnp.where(taken[None] & (place[:-1] == w.depth[None]), found.edge[None], w.path),
            desk=desk,
            scores=scores,
            turn=w.turn + 1,
            trail=jnp.where(descend[None] & (place == w.depth[None] + 1), found.child[None], w.trail),
        )

    row = tree.root * lanes + lane
    count, bonus = of_node(tree.root_visits)
    nobody = Best(jnp.full((lanes,), -jnp.inf, dtype), nil, nil, nil, nil, jnp.zeros((lanes,), dtype))
    stay = ~tree.alive | tree.ended
    start = Walk(tree.root, row, nil, count, bonus, tree.root_reward, tree.depth, nobody, stay, tree.path, tree.trail, jnp.zeros((2, lanes, ROW), dtype), jnp.zeros((2, lanes, PAGE + 1), dtype), jnp.int32(0))
    return lax.while_loop(lambda w: jnp.any(~w.done), body, start)


def _replay(problem, axes, tree, walk, memoize):
    """The simulator's state at each tree's selected node, from the state that is kept, and the simulator steps that it took to get there."""
    lanes = tree.key.shape[0]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    like = _node_shapes(tree, memoize)
    first = tree.depth if memoize == "root" else jnp.zeros_like(tree.depth)
    zero, nothing = jnp.zeros((lanes,), tree.edges.dtype), jnp.zeros((lanes,), bool)
    move = jax.vmap(_transition, in_axes=(axes, 0, 0, 0))
    running = tree.alive & ~tree.ended

    def body(carry):
        level, state = carry
        node = jax.vmap(lambda w: unpack(w, like))(tree.nodes[walk.trail[level + 1, lane], lane])
        after = move(problem, _child_key(tree.key, node.parent, node.slot), level, Progress(state, zero, zero, zero, nothing, nothing, nothing)).state
        live = running & (level < walk.depth)
        return level + _one(live), jax.tree.map(lambda a, b: jnp.where(_to_rank(live, a), b, a), state, after)

    _, state = lax.while_loop(lambda c: jnp.any(running & (c[0] < walk.depth)), body, (first, tree.base))
    chosen = levels(problem.sim) - problem.sim.horizon
    return state, jnp.maximum(walk.depth, chosen) - jnp.maximum(first, chosen)


def _node_shapes(tree, memoize):
    """The `shapes` of one tree's `Node`."""
    dtype = tree.edges.dtype
    number, real = jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((), dtype)
    state = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), tree.base) if memoize == "node" else ()
    return Node(number, number, real, real, jax.ShapeDtypeStruct((), jnp.bool_), state)


def _transition(problem, key, level, before):
    """One lane: draw the action of this key at ``before`` and take it; at level 0 of a random start, choose x0."""
    sim, reward, actions = problem[:3]
    start = int(_random_start(sim))
    x = actions.draw(key, sim.disturbance(before.state))
    after = advance(sim, reward, before, x, level + 1 - start >= sim.horizon)
    if start:
        first = begin(sim, reward, actions.draw_start(key, sim.start()))
        after = jax.tree.map(lambda a, b: jnp.where(level == 0, a, b), first, after)
    return after


def _child_key(keys, node, slot):
    fold = jax.vmap(jax.random.fold_in)
    return fold(fold(keys, node.astype(jnp.uint32) | _NODE), slot)


def _one(pred):
    return pred.astype(jnp.int32)


def _bit(pred, bit):
    return jnp.where(pred, bit, 0).astype(jnp.uint8)


def _to_rank(pred, like):
    return pred.reshape(pred.shape + (1,) * (like.ndim - pred.ndim))
