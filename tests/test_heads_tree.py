"""The tree engine with heads: the trees it builds, against an independent search; what holds in
every tree; and what it costs in memory and copies.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import honest, replays, same
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from jax.tree_util import Partial
from plain_tree import drawn_as_published, drawn_by_default, plain_search
from systems import mark_long, walk
from trees import SYSTEMS, counts_add_up, grown, large_copies, nbytes, problem, slots_of

import jast
from jast._src.core.counter_prng import tree_keys
from jast._src.search.tree import layout as T
from jast._src.search.tree import run
from jast._src.search.tree.head_guidance import guide
from jast._src.search.tree.packing import unpack
from jast.heads import Heads, Moments, settings
from jast.search import forest

# --- heads that are known
# ----------------------------------------------------------------------------


def bowl(params, x):
    """A value head: linear and quadratic, in steps, so that programs that round otherwise come to
    the same.
    """
    raw = jnp.sum(params["slope"] * x) - params["bend"] * (x[-1] - params["dip"]) ** 2
    return jnp.round(raw / params["step"]) * params["step"]


def tilted(params, seen):
    """A policy head: logits linear in the observation."""
    return jnp.einsum("dbn,n->db", params["tilt"], seen) + params["base"]


def known(n, d, levels, step=2.0**-16, seed=0, bins=7):
    """Heads of closed form for n observed numbers and d of a disturbance."""
    rng = np.random.default_rng(seed)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)
    value = dict(
        slope=normal(n + d), bend=np.float32(4), dip=np.float32(0.7), step=np.float32(step)
    )
    policy = dict(tilt=normal(d, bins, n) / 2, base=normal(d, bins) / 2)
    inputs = Moments(np.float32(9), normal(n + d), np.float32(1) + np.abs(normal(n + d)))
    returns = Moments(np.float32(9), np.float32(-1.5), np.float32(32))
    return Heads((policy, tilted), (value, bowl), inputs, returns, levels)


def normalised(heads, rows):
    inputs = jax.device_get(heads.inputs.first(rows.shape[-1]))
    return (rows.astype(np.float32) - inputs.mean) / inputs.deviation


def v_of(heads, seen, x):
    """What `bowl` says of rows [m, n] and [m, d], by NumPy."""
    p, row = (
        jax.device_get(heads.value.params),
        normalised(heads, np.concatenate([seen, x], axis=-1)),
    )
    raw = np.sum(p["slope"] * row, axis=-1) - p["bend"] * (row[..., -1] - p["dip"]) ** 2
    return heads.returns.mean + heads.returns.deviation * (np.round(raw / p["step"]) * p["step"])


def shares_of(heads, seen, power):
    """[d, bins] probabilities of the histogram at one observation, by NumPy."""
    p = jax.device_get(heads.policy.params)
    logits = np.einsum("dbn,n->db", p["tilt"], normalised(heads, seen)) + p["base"]
    mass = np.exp(power * logits.astype(np.float64))
    return mass / mass.sum(axis=1, keepdims=True)


KNOWN = dict(ferry=known(5, 1, 21), landing=known(2, 1, 11), ring=known(5, 3, 9))
CANDIDATES = ("all", "one")
EXACT = known(5, 1, 21, step=0.125)


# --- against an independent search
# ----------------------------------------------------------------------------


def seen_of(state):
    """What the networks see of the ferry's plain state."""
    ferry, x, y, heading, *_ = state
    return np.array(
        [ferry / 100, x / 100, y / 100, np.sin(heading) / 2 + 0.5, np.cos(heading) / 2 + 0.5]
    )


def drawn_by_head(keys, simulations, heads, power, share, levels):
    """For each tree, ``rollout -> rollout``: by the inverse of the histogram's distribution
    function, where it is the head's share and within its levels.
    """

    @jax.jit
    def table(key):
        simulation = jax.vmap(lambda i: jax.random.fold_in(key, i))(
            jnp.arange(simulations, dtype=jnp.int32)
        )
        own = jax.vmap(
            lambda k: jax.random.uniform(jax.random.fold_in(k, jnp.uint32(2**31)), (), jnp.float32)
        )(simulation)
        step = lambda k, level: jax.random.uniform(
            jax.random.fold_in(jax.random.fold_in(k, level), 1), (1,), jnp.float32
        )[0]
        return (
            jax.vmap(
                lambda k: jax.vmap(lambda level: step(k, level))(jnp.arange(21, dtype=jnp.int32))
            )(simulation),
            own < share,
        )

    def draw(u, own):
        def by_head(i, level, state):
            (p,) = shares_of(heads, seen_of(state), power)
            return np.interp(
                u[i, level], np.concatenate([[0], np.cumsum(p)]), np.arange(len(p) + 1) / len(p)
            )

        return lambda rollout: (
            lambda i, level, state: (
                by_head(i, level, state) if own[i] and level < levels else rollout(i, level, state)
            )
        )

    return [draw(*map(np.asarray, table(key))) for key in keys]


def agree(key, heads, k, alpha, candidates, weights, focus=1.0, share=1.0, power=2.0, within=1e-6):
    """Same numbers drawn, same tree: visits, Q and v of every child of every node, and every
    simulation's reward.
    """
    keys = tree_keys(key, 3)
    choices = dict(
        reward=jast.rewards.standard(event_bonus=30.0, density="mode"),
        actions=jast.actions.uniform(0.0, 1.0),
    )
    by = guide(
        heads,
        settings(
            candidates=candidates,
            q_weight=weights[0],
            v_weight=weights[1],
            share=share,
            power=power,
        ),
    )
    tree, *_ = grown(
        jast.simulators.ferry(),
        keys,
        widening=(k, alpha),
        spread=focus != 1,
        focus=focus,
        guide=by,
        **choices,
    )
    draws = (
        drawn_as_published(keys, 360, int(T.widths(360, k, alpha).max()))
        if focus == 1
        else drawn_by_default(keys, 360, focus)
    )
    if heads.policy is not None:
        draws = [
            (child, by_head(rollout))
            for (child, rollout), by_head in zip(
                draws, drawn_by_head(keys, 360, heads, power, share, heads.levels), strict=True
            )
        ]
    value = lambda state, a: float(v_of(heads, seen_of(state)[None], np.array([[a]]))[0])
    eq3 = (
        dict(value=value, weights=weights, one=candidates == "one")
        if heads.value is not None
        else {}
    )
    waited = 0  # nodes with a child that others overtook
    for lane, (child, rollout) in enumerate(draws):
        _, log, nodes = plain_search(child, rollout, 3, 120, k, alpha, 10.0, **eq3)
        np.testing.assert_allclose(np.asarray(tree.log)[:, lane], log, rtol=0, atol=within)
        found = slots_of(tree, lane)
        assert set(found) == set(nodes)
        waited += sum(
            any(n == 0 for n, *_ in slots[: sum(n > 0 for n, *_ in slots)])
            for slots in found.values()
        )
        reward = {0: 0.0} | {
            abs(child): r for slots in found.values() for _, _, child, r, _ in slots
        }
        for node, expected in nodes.items():
            here, more = found[node][: len(expected)], found[node][len(expected) :]
            assert [(n, abs(child)) for n, _, child, *_ in here] == [
                (s.visits, s.id) for s in expected
            ]
            assert not any(n for n, *_ in more)
            np.testing.assert_allclose(
                [w / max(n, 1) - reward[node] * (n > 0) for n, w, *_ in here],
                [s.q for s in expected],
                rtol=0,
                atol=within,
            )
            if heads.value is not None and len(expected) > 1:
                assert [v for *_, v in here] == [s.v for s in expected]
    assert (waited > 0) == (candidates == "all")


DRAWN = dict(all=1.0, one=0.25)  # independently, as published; spread and focused


@pytest.mark.parametrize("candidates", mark_long(CANDIDATES, "all"))
@pytest.mark.parametrize(
    ("widening", "weights"),
    [
        pytest.param((0.5, 0.6), (0.6, 0.4), marks=pytest.mark.long),
        ((2.0, 0.5), (0.5, 0.5)),
    ],
)
def test_builds_the_tree_of_an_independent_search_with_a_value_head(
    widening, weights, candidates, key, x64
):
    """The policy head has no share."""
    agree(key, EXACT, *widening, candidates, weights, share=0.0, focus=DRAWN[candidates])


@pytest.mark.slow
@pytest.mark.parametrize("candidates", mark_long(CANDIDATES, "all"))
def test_builds_the_tree_of_an_independent_search_with_both_heads(candidates, key, x64):
    agree(key, EXACT, 2.0, 0.5, candidates, (0.6, 0.4), focus=DRAWN[candidates], within=1e-3)


@pytest.mark.slow
def test_rolls_out_as_an_independent_search_at_the_first_levels_of_the_share_of_the_policy_head(
    key, x64
):
    agree(
        key,
        Heads(EXACT.policy, None, EXACT.inputs, EXACT.returns, 8),
        2.0,
        0.5,
        "one",
        (1.0, 0.0),
        share=0.6,
        power=1.3,
        within=1e-3,
    )


# --- what holds in every tree
# ----------------------------------------------------------------------------

EACH = list(itertools.product(SYSTEMS, CANDIDATES))
FERRY_ONE = mark_long(EACH, *(case for case in EACH if case != ("ferry", "one")))


def searching(name, candidates):
    """The problem of a search of 180 simulations a tree, with known heads."""
    sim, choices = SYSTEMS[name]
    return problem(
        sim,
        180,
        widening=(4.0, 0.5),
        guide=guide(KNOWN[name], settings(candidates=candidates)),
        **choices,
    )


@functools.cache
def built(name, candidates, memoize="node", lanes=3):
    sim, choices = SYSTEMS[name]
    by = guide(KNOWN[name], settings(candidates=candidates))
    return grown(
        sim,
        tree_keys(jax.random.key(11), lanes),
        3,
        60,
        memoize,
        widening=(4.0, 0.5),
        guide=by,
        **choices,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "candidates"), FERRY_ONE)
def test_counts_of_every_node_add_up(name, candidates):
    tree, root_visits, _ = built(name, candidates)
    np.testing.assert_array_equal(root_visits[0], 61)
    assert counts_add_up(tree, 4.0, 0.5) > T.PAGE or name == "landing"  # pages were linked


def edges_there(problem, tree, lane, places):
    """What networks see of the nodes and the disturbances of their children, [m, n] and [m, d], for
    pairs (node, slot).
    """
    like = T.node_shapes(tree, "node")

    @jax.jit
    def one(problem, records, key, node, slot):
        state = unpack(records[node], like).state
        _, x = T.choose_child(problem, T.node_keys(key[None], node[None])[0], slot, state)
        return problem.sim.observe(state), jnp.concatenate(
            [jnp.ravel(a).astype(jnp.float32) for a in jax.tree.leaves(x)]
        )

    nodes, slots = (jnp.asarray(column, jnp.int32) for column in zip(*places, strict=True))
    each = jax.vmap(one, in_axes=(None, None, None, 0, 0))(
        problem, tree.nodes[:, lane], tree.key[lane], nodes, slots
    )
    return [np.asarray(a) for a in each]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "candidates"), FERRY_ONE)
def test_every_child_has_the_value_of_its_head(name, candidates):
    """Visited or waiting: those to be had, and with "one" the next after the last that was tried.
    Others have none, nor has the level of a random start.
    """
    p, (tree, root_visits, roots) = searching(name, candidates), built(name, candidates)
    widths, random_start = np.asarray(p.settings.widths), T.levels(p.sim) > p.sim.horizon
    skipped = 0
    for lane in range(3):
        nodes = slots_of(tree, lane)
        visits = {abs(child): n for slots in nodes.values() for n, _, child, *_ in slots if n}
        visits |= {
            int(tree.trail[t, lane]): root_visits[t][lane] for t in range(3) if roots[t].valid[lane]
        }  # as a root's last visit found it
        ends = {-child for slots in nodes.values() for _, _, child, *_ in slots if child < 0}
        expected = {}
        for node, slots in nodes.items():
            tried = [s for s, (n, *_) in enumerate(slots) if n]
            skipped += tried != list(range(len(tried)))
            count = (
                (widths[visits[node]] if node not in ends else 0)
                if candidates == "all"
                else len(tried) + bool(tried)
            )
            expected |= {(node, s): slots[s][-1] for s in range(count if count > 1 else 0)}
        found = np.array(list(expected.values()))
        v = v_of(KNOWN[name], *edges_there(p, tree, lane, list(expected)))
        if random_start:
            v = np.where([node == 0 for node, _ in expected], 0, v)
        np.testing.assert_allclose(found, v, rtol=1e-5, atol=1e-3)
        everything = np.asarray(tree.values).reshape(-1, 3, T.PAGE + 1)[:, lane]
        assert np.count_nonzero(everything) == np.count_nonzero(found) > 50
    assert (skipped > 0) == (candidates == "all")  # the best by v goes first


KEPT = [
    ("ferry", "one", "root"),
    ("ferry", "one", "none"),
    ("landing", "all", "root"),
    ("ring", "all", "none"),
]
COPIED = [(*case, "node") for case in EACH] + KEPT


@pytest.mark.long  # rounding alike in programs that differ is the optimised compiler's
@pytest.mark.parametrize(("name", "candidates", "memoize"), KEPT)
def test_memoization_changes_the_steps_and_nothing_else(name, candidates, memoize, equal):
    node, other = built(name, candidates)[0], built(name, candidates, memoize)[0]
    for field in ("edges", "values", "pages", "log", "outcome", "trail", "root_visits"):
        equal(getattr(node, field), getattr(other, field))
    assert (np.asarray(node.steps) < other.steps).all()


@pytest.mark.compiled
@pytest.mark.parametrize("candidates", mark_long(CANDIDATES, "all"))
def test_a_tree_is_the_same_whatever_trees_grow_beside_it(candidates):
    few, many = built("ferry", candidates, lanes=2)[0], built("ferry", candidates)[0]
    np.testing.assert_array_equal(few.outcome, many.outcome[:, :2])
    np.testing.assert_array_equal(few.log, many.log[:, :2])
    assert all(slots_of(few, lane) == slots_of(many, lane) for lane in range(2))


# --- pages
# ----------------------------------------------------------------------------

WALK, ROOM = walk(fails=lambda s: s > 1e6), 2 * 60
WALKERS = {c: guide(known(1, 1, 6), settings(candidates=c)) for c in CANDIDATES}


def paid(gain, log_p, event, distance, terminal, approach):
    """The same for every step."""
    return gain.astype(log_p.dtype)


def pages_used(candidates, widening, exploration, gain):
    """Pages in use in each of two trees, those that there are, and those that there would be
    without a place for children that wait.
    """
    p = problem(
        WALK,
        ROOM,
        Partial(paid, jnp.asarray(gain)),
        jast.actions.samples(),
        widening=widening,
        guide=WALKERS[candidates],
    )
    p = p._replace(settings=p.settings._replace(exploration=jnp.asarray(exploration, jnp.float32)))
    most = T.pages_of(
        p._replace(settings=p.settings._replace(widths=T.widths(ROOM, 1.0, 1.0))), ROOM
    )  # of any widening: one program for all
    tree = run._make(p, tree_keys(jax.random.key(3), 2), ROOM, "node", most)
    for turn in range(2):
        tree = run._grow(p, tree, turn * 60, (turn + 1) * 60, "node")
        tree, _ = run._prune(p, tree, ROOM + 1, "node")
    return np.asarray(tree.pages), T.pages_of(p, ROOM), T.pages_of(p._replace(guide=()), ROOM)


@pytest.mark.slow
@pytest.mark.parametrize("candidates", CANDIDATES)
@pytest.mark.parametrize("widening", [(0.5, 0.6), (2.0, 0.5), (1.0, 1.0), (8.0, 0.3), (20.0, 0.0)])
def test_pages_never_run_out(widening, candidates):
    # down one path, over all children of the root, and between
    for exploration, gain in ((0.0, 1.0), (0.0, -1.0), (10.0, 1.0)):
        used, there, _ = pages_used(candidates, widening, exploration, gain)
        assert (used <= there).all()


@pytest.mark.slow
@given(
    k=st.floats(0.05, 30.0),
    alpha=st.floats(0.0, 1.0),
    exploration=st.sampled_from([0.0, 0.3, 3.0]),
    gain=st.sampled_from([-1.0, 0.0, 1.0]),
)
@examples(max_examples=25, deadline=None)
def test_pages_never_run_out_whatever_the_widening(k, alpha, exploration, gain):
    used, there, _ = pages_used("all", (k, alpha), exploration, gain)
    assert (used <= there).all()


def test_children_that_wait_need_more_pages():
    """Along one path that is walked again and again, all children of all its nodes wait: the bound
    is not an idle one.
    """
    used, there, few = pages_used("all", (1.0, 1.0), 0.0, 1.0)
    assert (used > few).all() and there - used.max() < (there - few) / 2


# --- copies and memory
# ----------------------------------------------------------------------------


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("name", "candidates", "memoize"),
    mark_long(COPIED, *(case for case in COPIED if case[::2] != ("ferry", "node"))),
)
def test_no_array_of_the_tree_is_copied_in_a_loop(name, candidates, memoize):
    p = searching(name, candidates)
    make = lambda: T.make(p, tree_keys(jax.random.key(0), 3), 180, memoize, T.pages_of(p, 180))
    text = run._grow.lower(p, jax.eval_shape(make), 0, 60, memoize).compile().as_text()
    assert not large_copies(text, 180)


@pytest.mark.parametrize("candidates", CANDIDATES)
@pytest.mark.parametrize("name", SYSTEMS)
def test_bytes_per_tree_are_those_of_its_arrays(name, candidates):
    p = searching(name, candidates)
    tree = run._make(p, tree_keys(jax.random.key(0), 3), 180, "node", T.pages_of(p, 180))
    assert tree.values.size == T.pages_of(p, 180) * 3 * (T.PAGE + 1)
    assert (
        run.bytes_per_tree(p, run.Plan(3, 60, 54, "node", T.pages_of(p, 180))) == nbytes(tree) / 3
    )


# --- all edges
# ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "candidates"),
    [
        ("ferry", "all"),
        pytest.param("landing", "one", marks=pytest.mark.long),
        pytest.param("ring", "all", marks=pytest.mark.long),
    ],
)
def test_edges_are_those_of_the_tree(name, candidates):
    p, (tree, *_) = searching(name, candidates), built(name, candidates)
    edges = jax.device_get(run._edges(p, tree, int(p.settings.widths.max())))
    random_start = T.levels(p.sim) > p.sim.horizon
    for lane in range(3):
        nodes = slots_of(tree, lane)
        edge = {
            abs(child): (node, slot, n, w, r)
            for node, slots in nodes.items()
            for slot, (n, w, child, r, _) in enumerate(slots)
            if n
        }
        q = {0: 0.0} | {
            new: w / n - (edge[node][-1] if node else 0.0)
            for new, (node, _, n, w, _) in edge.items()
        }
        taught = [new for new, (node, *_) in sorted(edge.items()) if node > 0 or not random_start]
        assert (np.flatnonzero(edges.valid[:, lane]) + 1).tolist() == taught and len(taught) > 50
        rows = np.array(taught) - 1
        seen, x = edges_there(p, tree, lane, [edge[new][:2] for new in taught])
        tolerance = dict(rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(edges.q[rows, lane], [q[new] for new in taught], **tolerance)
        np.testing.assert_allclose(
            edges.parent_q[rows, lane], [q[edge[new][0]] for new in taught], **tolerance
        )
        np.testing.assert_allclose(edges.seen[rows, lane], seen, **tolerance)
        np.testing.assert_allclose(edges.x[rows, lane], x, **tolerance)
        assert not np.isnan(edges.q).any() and not np.isnan(edges.parent_q).any()


# --- whole searches
# ----------------------------------------------------------------------------

SIZE = dict(trees=5, prunes=3, simulations=80, lanes=3, threads=1)


def searched(name, candidates="one", heads="known", key=7, **changed):
    sim, choices = SYSTEMS[name]
    heads = KNOWN[name] if heads == "known" else heads
    return forest(
        jax.random.key(key),
        sim,
        **SIZE
        | choices
        | dict(heads=heads, head_settings=settings(candidates=candidates, train=False))
        | changed,
    )


once = functools.cache(searched)


@pytest.mark.compiled
def test_the_same_key_gives_the_same_result():
    same(once("landing", "all"), searched("landing", "all"))


@pytest.mark.long
@pytest.mark.compiled
@pytest.mark.parametrize(("name", "candidates"), [("ferry", "one"), ("landing", "all")])
def test_threads_change_nothing(name, candidates):
    """Groups of three, the last one filled up, in one thread or two."""
    same(once(name, candidates), searched(name, candidates, threads=2))
    assert once(name, candidates).steps == searched(name, candidates, threads=2).steps


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("name", "candidates"),
    [("ferry", "one"), pytest.param("landing", "all", marks=pytest.mark.long)],
)
def test_results_are_honest_and_failures_replay_to_the_bit(name, candidates):
    (sim, choices), result = SYSTEMS[name], once(name, candidates)
    honest(result, sim, choices["reward"])
    assert name == "ferry" or result.failures.size > 0
    for i in range(0, result.failures.size, 3):
        replays(result.failures.episode(i), sim, choices["reward"])


@pytest.mark.long
def test_heads_guide():
    """Both heads, each of the two, and each of the two ways with candidates, come to other
    trees.
    """
    alone = [
        searched("ferry", head_settings=settings(train=False, **s))
        for s in (dict(share=0.0), dict(q_weight=1.0, v_weight=0.0))
    ]
    results = [once("ferry", heads=None), once("ferry"), once("ferry", "all"), *alone]
    for a, b in itertools.combinations(results, 2):
        assert (a.best_reward_per_tree != b.best_reward_per_tree).any()


def without(heads):
    """The same, but they have learned nothing."""
    return Heads(heads.policy, heads.value, heads.inputs, heads.returns, 0)


@pytest.mark.compiled
def test_heads_that_have_learned_nothing_change_nothing():
    """Nor do heads without weight and without a share of the rollouts."""
    same(once("ferry", heads=None), searched("ferry", heads=without(KNOWN["ferry"])))
    same(
        once("ferry", heads=None),
        searched(
            "ferry", head_settings=settings(q_weight=1.0, v_weight=0.0, share=0.0, train=False)
        ),
    )


# --- tracing
# ----------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnames="candidates")
def best_of(adversary, heads, candidates):
    sim, choices = jast.simulators.ferry(adversary), SYSTEMS["ferry"][1]
    use = settings(candidates=candidates, train=False)
    return forest(
        jax.random.key(7), sim, **SIZE | choices, heads=heads, head_settings=use
    ).best_reward_per_tree


NEAR = jnp.array([16.0, 0.0])


@pytest.mark.slow
def test_a_traced_search_is_the_same_search():
    np.testing.assert_allclose(
        best_of(NEAR, KNOWN["ferry"], "one"), once("ferry").best_reward_per_tree, rtol=1e-4
    )


@pytest.mark.long
def test_vmap_over_heads_is_a_loop():
    several = [KNOWN["ferry"], known(5, 1, 21, seed=1), without(KNOWN["ferry"])]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    together = jax.vmap(best_of, in_axes=(None, 0, None))(NEAR, stacked, "all")
    apart = np.stack(
        [searched("ferry", "all", heads=heads).best_reward_per_tree for heads in several]
    )
    np.testing.assert_allclose(together, apart, rtol=1e-4)
    assert (together[0] != together[1]).any() and (together[0] != together[2]).any()


@pytest.mark.slow
def test_a_simulator_of_a_kind_and_heads_of_a_kind_do_not_recompile(traced):
    once("ferry")
    traced.clear()
    _, choices = SYSTEMS["ferry"]
    use = settings(q_weight=0.6, v_weight=0.4, power=1.0, share=0.5, train=False)
    forest(
        jax.random.key(5),
        jast.simulators.ferry((17.0, 0.0)),
        **SIZE | choices,
        heads=known(5, 1, 9, seed=4),
        head_settings=use,
    )
    assert not {f.__name__ for f in (run._grow, run._prune, run._rebuild)} & set(traced)
