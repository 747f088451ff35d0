"""The tree engine: the trees it builds, against an independent search; what holds in every tree;
and what it costs in memory and copies.
"""

import functools
import re

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from checks import same
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_tree import drawn_as_published, drawn_by_default, plain_search
from systems import S0, TOLD, mark_long
from trees import (
    FERRY,
    LANDING,
    PLAIN,
    SYSTEMS,
    counts_add_up,
    grown,
    large_copies,
    nbytes,
    problem,
    visited_children,
)

import jast
from jast._src.core.counter_prng import tree_keys
from jast._src.search.tree import layout as T
from jast._src.search.tree import packing as records
from jast._src.search.tree import run
from jast._src.search.tree.packing import pack, unpack
from jast.search import forest

SIZE = dict(trees=5, prunes=3, simulations=120, lanes=3, threads=1)


# --- against an independent search
# ----------------------------------------------------------------------------


def agree(key, k, alpha, focus=1.0, x=16.0, **switches):
    """Same numbers drawn, same tree: visits of all children of every root, and every simulation's
    reward.
    """
    keys = tree_keys(key, 3)
    choices = dict(
        reward=jast.rewards.standard(event_bonus=30.0, density="mode"),
        actions=jast.actions.uniform(0.0, 1.0),
    )
    tree, _, roots = grown(
        jast.simulators.ferry(adversary=(x, 0.0)),
        keys,
        widening=(k, alpha),
        spread=focus != 1,
        focus=focus,
        **choices,
        **switches,
    )
    assert (
        not (switches.get("follow") or switches.get("feed"))
        or (np.asarray(tree.lead.source) > 0).any()
    )
    draws = (
        drawn_as_published(keys, 360, int(T.widths(360, k, alpha).max()))
        if focus == 1
        else drawn_by_default(keys, 360, focus)
    )
    for lane, (child, rollout) in enumerate(draws):
        at_prune, log, _ = plain_search(child, rollout, 3, 120, k, alpha, 10.0, x=x, **switches)
        for turn, expected in enumerate(at_prune):
            found = roots[turn].visits[lane]
            assert found[found > 0].tolist() == expected, f"tree {lane}, prune {turn}"
        np.testing.assert_allclose(
            np.asarray(tree.log)[:, lane],
            log,
            rtol=0,
            atol=1e-6 if tree.log.dtype == jnp.float64 else 1e-3,
        )


@pytest.mark.parametrize(
    ("k", "alpha"), [pytest.param(2.0, 0.5, marks=pytest.mark.long), (0.5, 0.6)]
)
def test_builds_the_tree_of_an_independent_search(key, k, alpha):
    agree(key, k, alpha)


@pytest.mark.slow
def test_builds_the_tree_of_an_independent_search_with_spread_and_focused_actions(key):
    agree(key, 2.0, 0.5, focus=0.25)


@pytest.mark.parametrize(
    "switches",
    [
        pytest.param(("urgent",), marks=pytest.mark.long),
        pytest.param(("feed",), marks=pytest.mark.long),
        pytest.param(("follow",), marks=pytest.mark.long),
        ("follow", "feed", "urgent"),
    ],
    ids=" ".join,
)
def test_builds_the_tree_of_an_independent_search_that_uses_its_best_episode(key, switches):
    agree(key, 2.0, 0.5, x=28.0, **dict.fromkeys(switches, True))  # nearer to a collision


@pytest.mark.slow
def test_builds_the_tree_of_an_independent_search_in_float64(key, x64):
    agree(key, 2.0, 0.5)


# --- what holds in every tree
# ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", mark_long(SYSTEMS, "landing", "ring"))
def test_counts_of_every_node_add_up(name, key):
    sim, choices = SYSTEMS[name]
    tree, root_visits, _ = grown(sim, tree_keys(key, 3), widening=(4.0, 0.5), **choices)
    # the simulations, and the 1 that a root starts from
    np.testing.assert_array_equal(root_visits[0], 121)
    widest = counts_add_up(tree, 4.0, 0.5)
    assert name != "ferry" or widest > T.PAGE  # pages were linked


def test_nodes_are_numbered_by_the_simulation_that_made_them(key):
    tree, *_ = grown(FERRY, tree_keys(key, 3), **S0)
    ids = [abs(child) for found in visited_children(tree, 0).values() for _, _, child, _ in found]
    made = np.flatnonzero((np.asarray(tree.outcome)[:, 0] & T.FRESH) > 0) + 1
    assert sorted(ids) == made.tolist()


def test_the_most_visited_child_becomes_the_root(key):
    tree, root_visits, roots = grown(FERRY, tree_keys(key, 3), **S0)
    for turn in range(2):
        most = roots[turn].visits.max(1)
        np.testing.assert_array_equal(root_visits[turn + 1], most + 120)
    np.testing.assert_array_equal(roots[2].depth, 2)
    np.testing.assert_array_equal(tree.depth, 3)


def searched(name, **changed):
    sim, choices = SYSTEMS[name]
    return forest(jax.random.key(7), sim, **SIZE | choices | changed)


once = functools.cache(searched)


@pytest.mark.compiled
@pytest.mark.parametrize("name", mark_long(SYSTEMS, "landing", "ring"))
def test_the_same_key_gives_the_same_result(name):
    same(once(name), searched(name))


@pytest.mark.compiled
@pytest.mark.parametrize("name", ["ferry", pytest.param("ring", marks=pytest.mark.long)])
def test_threads_and_lanes_change_nothing(name):
    """Groups of three, the last one filled up, in one thread or two; and all trees in one group."""
    for other in (searched(name, threads=2), searched(name, lanes=None)):
        same(once(name), other)
        assert once(name).steps == other.steps


@pytest.mark.compiled
def test_a_tree_is_the_same_alone_and_among_others():
    alone, among = once("ferry", trees=1), once("ferry")
    np.testing.assert_array_equal(alone.best_reward_per_tree, among.best_reward_per_tree[:1])
    np.testing.assert_array_equal(alone.roots.visits, among.roots.visits[:, :1])
    np.testing.assert_array_equal(alone.history.best_reward, among.history.best_reward[:, :1])


@pytest.mark.long  # rounding alike in programs that differ is the optimised compiler's
@pytest.mark.parametrize("name", SYSTEMS)
def test_memoization_changes_the_steps_and_nothing_else(name):
    node, root, none = once(name), once(name, memoize="root"), once(name, memoize="none")
    same(node, root)
    same(node, none)
    assert node.steps < root.steps < none.steps


@pytest.mark.long
def test_the_steps_of_replays_add_up():
    """From so far off nothing collides, so all episodes are of 21 steps, of which a kept root saves
    its depth.
    """
    sim, choices = jast.simulators.ferry(adversary=(16.0, -500.0)), SYSTEMS["ferry"][1]
    root, none = (
        forest(jax.random.key(7), sim, **SIZE | choices, memoize=memoize)
        for memoize in ("root", "none")
    )
    assert none.steps == 5 * 360 * 21
    assert root.steps == none.steps - 5 * 120 * (0 + 1 + 2)


# --- widths
# ----------------------------------------------------------------------------


@given(k=st.floats(0.05, 8.0), alpha=st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_widths_are_those_of_widening_step_by_step(k, alpha):
    children, expected = 0, [0]
    for n in range(1, 402):
        # n^alpha of a whole result may come out just below it
        children += children <= k * n**alpha * (1 + 1e-14)
        expected.append(children)
    assert T.widths(400, k, alpha).tolist() == expected


@pytest.mark.parametrize(("k", "alpha"), [(2.0, 0.5), (1.0, 0.5), (3.0, 0.0), (1.0, 1.0)])
def test_traced_widths_are_the_same(k, alpha):
    traced = jax.jit(lambda k, alpha: T.widths(9000, k, alpha))(k, alpha)
    np.testing.assert_array_equal(traced, T.widths(9000, k, alpha))


@pytest.mark.parametrize(("k", "alpha"), [(0.5, 0.6), (2.0, 0.4)])
def test_traced_widths_of_an_exponent_that_float32_rounds_are_nearly_the_same(k, alpha):
    """Where k n^alpha comes within rounding of a whole number, a child may come one visit early or
    late.
    """
    traced = jax.jit(lambda k, alpha: T.widths(9000, k, alpha))(k, alpha)
    off = np.asarray(traced) - np.asarray(T.widths(9000, k, alpha))
    assert np.abs(off).max() <= 1 and np.count_nonzero(off) <= 3


# --- records
# ----------------------------------------------------------------------------

DTYPES = [
    "bool",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "float16",
    "bfloat16",
    "float32",
    "complex64",
]
WIDE = ["int64", "uint64", "float64", "complex128"]
NAMED = dict(bfloat16=ml_dtypes.bfloat16)


@st.composite
def arrays(draw, names):
    """An array of any bits, NaN of any payload included."""
    dtype = np.dtype(NAMED.get(name := draw(st.sampled_from(names)), name))
    shape = draw(st.sampled_from([(), (1,), (3,), (2, 3), (0,)]))
    if dtype.kind == "b":
        return np.array(
            draw(
                st.lists(st.booleans(), min_size=int(np.prod(shape)), max_size=int(np.prod(shape)))
            ),
            bool,
        ).reshape(shape)
    size = int(np.prod(shape)) * dtype.itemsize
    return np.frombuffer(draw(st.binary(min_size=size, max_size=size)), dtype).reshape(shape)


def round_trip(tree):
    tree = jax.tree.map(jnp.asarray, tree)
    words = jax.jit(pack)(tree)
    like = jax.eval_shape(lambda: tree)
    assert words.dtype == jnp.uint32 and words.shape == (records.width(like),)
    return jax.tree.map(np.asarray, jax.jit(lambda w: unpack(w, like))(words))


def same_bytes(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())


@pytest.mark.slow
@given(tree=st.lists(arrays(DTYPES), max_size=4))
@settings(max_examples=25, deadline=None)
def test_records_give_back_every_bit(tree):
    tree = dict(state=tree, empty=(), none=None)
    same_bytes(tree, round_trip(tree))


@given(tree=st.lists(arrays(WIDE + ["float32", "bool"]), min_size=1, max_size=3))
@settings(max_examples=12, deadline=None)
def test_records_give_back_every_bit_of_wide_numbers(tree):
    with jax.enable_x64(True):
        same_bytes(tree, round_trip(tree))


@pytest.mark.parametrize(
    ("dtype", "bits"),
    [
        ("float32", [0x7FC00001, 0xFFC12345, 0x7F800000, 0x80000000]),
        ("float16", [0x7E01, 0xFE23, 0x7C00, 0x8000]),
    ],
)
def test_records_keep_payloads_of_nan(dtype, bits):
    a = np.array(bits, f"u{np.dtype(dtype).itemsize}").view(dtype)
    same_bytes(a, round_trip(a))


def test_a_record_of_nothing_is_empty():
    assert pack(()).shape == (0,) and unpack(pack(()), ()) == ()


# --- copies
# ----------------------------------------------------------------------------


def compiled_text(sim, simulations, memoize, record=False, **choices):
    p = problem(sim, simulations, **choices)
    keys = tree_keys(jax.random.key(0), 2)
    tree = jax.eval_shape(lambda: T.make(p, keys, simulations, memoize, record=record))
    return run._grow.lower(p, tree, 0, 100, memoize).compile().as_text()


def test_large_copies_are_seen():
    """The test below would see one: a select of the whole array in a loop."""
    body = lambda i, a: jnp.where(a[i % 1000] > 0, a.at[i].set(1.0), a[::-1])
    text = (
        jax.jit(lambda a: jax.lax.fori_loop(0, 10, body, a))
        .lower(jnp.zeros(1000))
        .compile()
        .as_text()
    )
    assert large_copies(text, 1000)


@pytest.mark.compiled
@pytest.mark.parametrize("memoize", mark_long(["node", "root", "none"], "root", "none"))
def test_no_array_of_the_tree_is_copied_in_a_loop(memoize):
    assert not large_copies(compiled_text(FERRY, 307, memoize, **S0), 307)


@pytest.mark.long
@pytest.mark.compiled
@pytest.mark.parametrize("name", ["landing", "ring"])
def test_nor_with_other_states(name):
    sim, choices = SYSTEMS[name]
    assert not large_copies(compiled_text(sim, 307, "node", **choices), 307)


@pytest.mark.compiled
@pytest.mark.parametrize(
    "sim", [FERRY, pytest.param(LANDING, marks=pytest.mark.long)], ids=["ferry", "landing"]
)
def test_nor_when_the_best_episode_is_followed_and_trials_are_recorded(sim):
    assert not large_copies(
        compiled_text(
            sim,
            307,
            "node",
            record=True,
            follow=True,
            feed=True,
            urgent=True,
            **(S0 if sim is FERRY else PLAIN),
        ),
        307,
    )


def test_the_program_does_not_grow_with_the_simulations():
    texts = [compiled_text(FERRY, n, "node", **S0) for n in (307, 2903)]
    instructions = [len(re.findall(r"^\s.* = ", text, re.MULTILINE)) for text in texts]
    assert instructions[0] == instructions[1] > 1000


# --- memory
# ----------------------------------------------------------------------------


@pytest.mark.parametrize("memoize", ["node", "root"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_bytes_per_tree_are_those_of_its_arrays(name, memoize):
    sim, choices = SYSTEMS[name]
    p = problem(sim, 360, **choices)
    tree = run._make(p, tree_keys(jax.random.key(0), 4), 360, memoize)
    assert run.bytes_per_tree(p, run.Plan(3, 120, 39, memoize)) == nbytes(tree) / 4


def large(words):
    """A system with a state of so many 32-bit words."""
    zero = jnp.zeros((), jnp.int32)
    init = lambda x0: (jnp.zeros(()), zero + jnp.zeros((words,), jnp.int32))
    return jast.Simulator(
        init,
        lambda s, x: (s[0] + x, s[1] + 1),
        lambda s: jast.distributions.Normal(0.0, 1.0),
        lambda s: (s[0] > 9, 9 - s[0]),
        6,
        observe=lambda s: s[0][None],
    )


def per_tree(sim, simulations, memoize):
    return run.bytes_per_tree(
        problem(sim, simulations, **PLAIN), run.Plan(1, simulations, 20, memoize)
    )


def test_a_node_costs_its_edges_and_its_state():
    a_node = lambda sim, memoize: (
        (per_tree(sim, 15_000, memoize) - per_tree(sim, 7_500, memoize)) / 7_500
    )
    real = jnp.zeros(()).dtype.itemsize
    assert a_node(large(0), "root") < T.ROW * real * (1 + 1 / T.PAGE) + 8 * real + 24
    assert a_node(large(1000), "root") == a_node(large(0), "root")
    assert a_node(large(1000), "node") - a_node(large(0), "node") == 4000


@pytest.mark.slow
def test_trees_that_do_not_fit_are_refused_with_the_numbers():
    ran = []
    with pytest.raises(
        ValueError, match="forest: 1 trees .* MB .*3 x 120 simulations.*10 kB .*use fewer"
    ):
        forest(
            jax.random.key(0),
            large(2000),
            trees=1,
            prunes=3,
            simulations=120,
            available=10_000,
            memoize="node",
            callback=lambda *a: ran.append(a),
        )
    with pytest.raises(ValueError, match="10 kB are free"):
        forest(jax.random.key(0), FERRY, trees=4, prunes=3, simulations=120, available=10_000)
    with pytest.raises(ValueError, match="10 kB are free"):
        forest(
            jax.random.key(0), FERRY, trees=4, prunes=3, simulations=120, available=10_000, lanes=2
        )
    assert not ran


@pytest.mark.slow
def test_states_that_do_not_fit_at_nodes_are_kept_at_roots():
    sim, size = large(2000), dict(trees=2, prunes=3, simulations=120, threads=1)
    node, root = (
        run.bytes_per_tree(problem(sim, 360, **PLAIN), run.Plan(3, 120, 39, memoize))
        for memoize in ("node", "root")
    )
    assert node > 5 * root
    with pytest.warns(UserWarning, match='kept at the roots alone: memoize="root"'):
        result = forest(jax.random.key(0), sim, **size, **TOLD, available=2 * 2 * root)
    assert result.settings["memoize"] == "root" and result.episodes == 720
    result = forest(jax.random.key(0), sim, **size, **TOLD, available=2 * 2 * node)
    assert result.settings["memoize"] == "node"
