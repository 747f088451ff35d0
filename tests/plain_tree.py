"""Tree search in plain Python, to compare the trees of the engine with; the numbers it draws."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.search.tree import layout as T


def drawn_as_published(keys, simulations, slots):
    """For each tree: ``child(node, slot, last)`` and ``rollout(i, level, state)``, uniform numbers
    addressed by the keys of the tree, drawn beforehand.
    """
    node_slot = jnp.stack(jnp.divmod(jnp.arange((simulations + 1) * slots), slots), axis=1).astype(
        jnp.int32
    )

    @jax.jit
    def table(key):
        nodes = jax.vmap(lambda n: T.node_keys(key[None], n[None])[0])(node_slot[:, 0])
        children = jax.vmap(lambda k, slot: jax.random.uniform(jax.random.fold_in(k, slot), ()))(
            nodes, node_slot[:, 1]
        )
        return children.reshape(-1, slots), rollouts(key, simulations)[0]

    def draw(of_child, of_level):
        return (
            lambda node, slot, last: of_child[node, slot],
            lambda i, level, state: of_level[i, level],
        )

    return [draw(*(np.asarray(a, np.float64) for a in table(key))) for key in keys]


def drawn_by_default(keys, simulations, focus):
    """The same for spread and focused actions: golden-ratio steps from a random place for each
    node; every second child, and steps by a coin, near the last.

    The steps only in half of the trees, by a coin of each.
    """

    @jax.jit
    def table(key):
        nodes = jax.vmap(lambda n: T.node_keys(key[None], n[None])[0])(
            jnp.arange(simulations + 1, dtype=jnp.int32)
        )
        return (
            jax.vmap(lambda k: jax.random.bits(k, (), jnp.uint32))(nodes),
            *rollouts(key, simulations),
            jax.random.key_data(key)[1] & 1,
        )

    near = lambda pred, a, last: (
        min(max((0.5 if last is None else last) + focus * (a - 0.5), 0.0), 1.0) if pred else a
    )
    step = int((5**0.5 - 1) / 2 * 2**32)

    def draw(shift, of_level, coin, of_tree):
        place = lambda node, slot: ((int(shift[node]) + step * (slot // 2)) % 2**32 >> 8) / 2**24
        child = lambda node, slot, last: near(slot % 2, place(node, slot), last)
        return child, lambda i, level, state: near(
            coin[i, level] & of_tree, float(of_level[i, level]), state[4]
        )

    return [draw(*map(np.asarray, table(key))) for key in keys]


def rollouts(key, simulations):
    """[simulations, 21] the uniform number and the coin of each level of each simulation."""
    at = lambda i, level: jax.random.fold_in(jax.random.fold_in(key, i), level)
    keys = jax.vmap(
        lambda i: jax.vmap(lambda level: at(i, level))(jnp.arange(21, dtype=jnp.int32))
    )(jnp.arange(simulations, dtype=jnp.int32))
    return (
        jax.vmap(jax.vmap(lambda k: jax.random.uniform(k, ())))(keys),
        jax.random.key_data(keys)[..., 1] & 1,
    )


class Slot(NamedTuple):
    """A place for a child."""

    visits: int
    q: float
    id: int
    v: float


def plain_search(
    child,
    rollout,
    prunes,
    simulations,
    k,
    alpha,
    c,
    value=None,
    weights=(1.0, 0.0),
    one=False,
    follow=False,
    feed=False,
    urgent=False,
    x=16.0,
):
    """MCFS-AP on S0 as its pseudo-code has it, in plain Python: the visits of the root's children
    at each prune, and the reward of every simulation.

    With ``value(state, a)``, of ``weights`` (of Q, of v); ``one``: of a node's children that were
    not visited only the first is to be had. Third: of each node the children to be had, (visits, Q,
    id, v), 0 where there is none; the v of an only child is never asked for.

    ``urgent``: children that were not visited first. ``follow``: after a failure better than all
    before, its actions are put into the tree one by one. ``feed``: at level 11 of 21 a rollout
    takes what the best episode's rollout took there (with ``follow``, of the failures).
    """

    def step(state, a):
        ferry, x, y, heading, last, nearest = state
        heading = heading + (10 * a - 5) * np.pi / 100
        ferry, x, y = ferry + 5, x + 5 * np.sin(heading), y + 5 * np.cos(heading)
        distance = np.hypot(x - ferry, y - 50)
        nearest = min(nearest, distance)
        gain = 0.0 if last is None else np.log(1 - abs(a - last))
        end = distance < 5 or ferry > 100
        if end:
            gain += 30.0 if distance < 5 else -nearest
        return (ferry, x, y, heading, a, nearest), gain, end

    children, count, visits, q, gains, ends, states = (
        {0: []},
        {0: 0},
        {0: 1},
        {0: 0.0},
        {0: 0.0},
        {},
        {0: (0.0, x, 0.0, 0.0, None, np.hypot(x, 50))},
    )
    root, ancestors, log, at_prune = 0, [], [], []
    # way: the best episode's nodes; ahead: the same while there are more to come
    best, source, way, ahead, fed, feeds = -np.inf, None, (), None, None, {}

    def rolled(i, level, state):
        return (
            feeds[i] if feed and level == 11 and feeds[i] is not None else rollout(i, level, state)
        )

    def score(n, bonus):
        if urgent:
            return np.inf if n.visits == 0 else n.q + c * bonus / np.sqrt(n.visits)
        return weights[0] * n.q + weights[1] * n.v + c * bonus / np.sqrt(1 + n.visits)

    @functools.cache
    def v(node, slot):
        return value(states[node], child(node, slot, states[node][4]))

    def to_be_had(node):
        ids = [n for n in children[node] if n is not None] + [None] if one else children[node]
        lonely = value is None or len(children[node]) < 2
        return [
            Slot(
                *((0, 0.0, 0) if n is None else (visits[n], q[n], n)),
                0.0 if lonely else v(node, slot),
            )
            for slot, n in enumerate(ids[: len(children[node])])
        ]

    for turn in range(prunes):
        for i in range(turn * simulations, (turn + 1) * simulations):
            feeds[i] = fed
            follows, middle = ahead is not None, None
            node, path = (ahead[-1], ahead[:-1]) if follows else (root, list(ancestors))
            while True:
                path.append(node)
                if ends.get(node):
                    level = total = None
                    break
                # widen by at most one child a visit; 32^0.6 is 8, not a little less
                if count[node] <= k * visits[node] ** alpha * (1 + 1e-14):
                    count[node] += 1
                    children[node].append(None)
                bonus = np.sqrt(np.log(visits[node]))
                scores = [score(n, bonus) for n in to_be_had(node)]
                slot = int(np.argmax(scores))
                if children[node][slot] is None:
                    new = i + 1
                    a = (
                        rolled(source, len(path) - 1, states[node])
                        if follows
                        else child(node, slot, states[node][4])
                    )
                    states[new], gains[new], ends[new] = step(states[node], a)
                    children[node][slot], children[new], count[new], visits[new], q[new] = (
                        new,
                        [],
                        0,
                        0,
                        0.0,
                    )
                    path.append(new)
                    node, level, total = new, len(path) - 1, 0.0
                    break
                node = children[node][slot]
            if total is None:
                total = 0.0
            else:
                state, end = states[node], ends[node]
                while not end:
                    a = rolled(i, level, state)
                    middle = a if level == 11 else middle
                    state, gain, end = step(state, a)
                    total, level = total + gain, level + 1
                reward = total + sum(gains[n] for n in path)
                better = reward > best and (
                    not follow or np.hypot(state[1] - state[0], state[2] - 50) < 5
                )
                if better:
                    best, source, fed = reward, i, fed if middle is None else middle
                if follow and (better or follows):
                    way = list(path)
                    ahead = None if ends[node] else way
            for n in reversed(path):
                total += gains[n]
                visits[n] += 1
                q[n] += (total - q[n]) / (visits[n] - (n == 0))
            log.append(total)
        at_prune.append([visits[n] for n in children[root] if n is not None])
        ancestors.append(root)
        root = max((n for n in children[root] if n is not None), key=visits.get)
        if root not in way:  # of another branch
            ahead, best = None, -np.inf if follow else best
    return at_prune, log, {node: to_be_had(node) for node in children}
