"""Trees of small systems, grown and looked into."""

import re

import jax
import jax.numpy as jnp
import numpy as np
from systems import S0, ring

import jast
from jast._src.search.tree import layout as T
from jast._src.search.tree import pages as P
from jast._src.search.tree import run
from jast._src.search.tree.settings import Choice

FERRY, LANDING, RING = jast.simulators.ferry(), jast.simulators.landing(b=0.3), ring()
PLAIN = dict(reward=jast.rewards.standard(event_bonus=30.0), actions=jast.actions.samples())
SYSTEMS = dict(ferry=(FERRY, S0), landing=(LANDING, PLAIN), ring=(RING, PLAIN))


def problem(
    sim,
    simulations,
    reward,
    actions,
    widening=(2.0, 0.5),
    spread=False,
    focus=1.0,
    guide=(),
    **switches,
):
    choice = Choice(
        actions, jnp.asarray(focus, jnp.float32), spread=spread, focused=focus != 1.0, **switches
    )
    parts = T.Problem(
        sim,
        reward,
        choice,
        T.Settings(jnp.asarray(10.0, jnp.float32), T.widths(simulations, *widening)),
        guide,
    )
    return jax.tree.map(jnp.asarray, parts)


def grown(sim, keys, prunes=3, simulations=120, memoize="node", **choices):
    """The tree after its last prune, the visits N(root) before each, and the `Roots` of each."""
    total = prunes * simulations
    p = problem(sim, total, **choices)
    children = int(p.settings.widths.max())
    tree = run._make(p, keys, total, memoize, T.pages_of(p, total))
    visits, roots = [], []
    for turn in range(prunes):
        tree = run._grow(p, tree, turn * simulations, (turn + 1) * simulations, memoize)
        visits.append(np.asarray(tree.root_visits))
        tree, turned = run._prune(p, tree, children, memoize)
        roots.append(jax.device_get(turned))
    return tree, visits, roots


def slots_of(tree, lane):
    """What one tree holds: node -> [(visits, sum of returns, child's id, child's reward, v)], the
    slots of its pages; the only place that knows the layout.
    """
    lanes = tree.key.shape[0]
    pages = np.asarray(tree.edges, np.float64).reshape(-1, lanes, P.ROW)[:, lane]
    values = (
        np.asarray(tree.values, np.float64).reshape(-1, lanes, P.PAGE + 1)[:, lane]
        if len(tree.values)
        else np.zeros((len(pages), P.PAGE + 1))
    )
    made = np.flatnonzero((np.asarray(tree.outcome)[:, lane] & T.FRESH) > 0) + 1
    out = {}
    for node in [0, *made]:
        page, found = node, []
        while True:
            row = pages[page]
            columns = (row[c : c + P.PAGE] for c in (P.VISITS, P.RETURNS, P.CHILD, P.REWARD))
            found += [
                (int(n), w, int(i), r, v)
                for n, w, i, r, v in zip(*columns, values[page, : P.PAGE], strict=True)
            ]
            page = int(row[P.LINK])
            if page == 0:
                break
        out[int(node)] = found
    return out


def visited_children(tree, lane):
    """Of the children that were visited, without v."""
    return {
        node: [found[:4] for found in slots if found[0] > 0]
        for node, slots in slots_of(tree, lane).items()
    }


def counts_add_up(tree, k, alpha):
    """In every node; the greatest number of children of one."""
    log, outcome = np.asarray(tree.log), np.asarray(tree.outcome)
    widest = 0
    for lane in range(log.shape[1]):
        nodes = visited_children(tree, lane)
        ran = (outcome[:, lane] & T.RAN) > 0
        visits, ends = {0: 1 + int(ran.sum())}, set()
        for found in nodes.values():
            visits |= {abs(child): n for n, _, child, _ in found}
            ends |= {-child for _, _, child, _ in found if child < 0}
        assert set(visits) == set(nodes)  # every node made has one edge that leads to it
        for node, found in nodes.items():
            if node in ends:
                assert not found
            else:
                assert visits[node] == 1 + sum(n for n, *_ in found)
                assert len(found) <= np.floor(k * visits[node] ** alpha) + 1
            widest = max(widest, len(found))
        total = sum(w for _, w, _, _ in nodes[0])
        np.testing.assert_allclose(
            total / (visits[0] - 1), log[ran, lane].astype(np.float64).mean(), rtol=1e-5
        )
    return widest


def large_copies(text, capacity):
    """Lines outside ENTRY that copy or select as many numbers as the tree has nodes, or more."""
    found, entry = [], False
    for line in text.splitlines():
        if line and not line[0].isspace():
            entry = line.startswith("ENTRY")
        made = re.match(
            r"\s+(?:ROOT )?%?[\w.-]+ = \w+\[([\d,]*)\]\S* (copy|select|copy-start)\(", line
        )
        if made and not entry and np.prod([int(n) for n in made[1].split(",") if n]) >= capacity:
            found.append(line.strip())
    return found


def nbytes(tree):
    return sum(
        jax.random.key_data(a).nbytes if jnp.issubdtype(a.dtype, jax.dtypes.prng_key) else a.nbytes
        for a in jax.tree.leaves(tree)
    )
