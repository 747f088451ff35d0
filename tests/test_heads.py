"""Heads: the networks, what they learn from and how, and forests that use them."""

import functools
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import honest, replays, same
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scipy import special
from systems import S0, dice, plane, ring

import jast
from jast._src.distributions.flat_rows import flat, unflat
from jast._src.heads.heads import sample_bins, update_moments
from jast._src.heads.samples import (
    Samples,
    _episode_rows,
    _root_rows,
    samples_of_edges,
    samples_of_episodes,
    samples_of_roots,
)
from jast._src.heads.train_head import _fit, init_head, train_head
from jast._src.heads.train_heads import best_trees, init_heads
from jast._src.search.tree import forest_run as trees
from jast._src.search.tree import run
from jast._src.search.tree.edges import Edges
from jast._src.search.tree.prune import Roots
from jast.actions import quantiles, samples, uniform
from jast.heads import MODES, Heads, Lesson, Moments, make_head, settings
from jast.search import forest

# --- networks
# ----------------------------------------------------------------------------

ACTIVATIONS = dict(
    gelu=lambda x: x * (1 + special.erf(x / np.sqrt(2))) / 2,
    relu=lambda x: np.maximum(x, 0),
    tanh=np.tanh,
    silu=lambda x: x / (1 + np.exp(-x)),
)


def layers(head):
    """(kernel, bias) of each layer."""
    of = jax.device_get(head.params)["params"]
    return [(layer["kernel"], layer["bias"]) for _, layer in sorted(of.items())]


@pytest.mark.slow
@pytest.mark.parametrize("outputs", [(), (2, 7)])
@pytest.mark.parametrize("first_activation", [True, False])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_network_is_the_formula(activation, first_activation, outputs, key):
    """Without its first activation the first two layers are linear."""
    head = make_head(
        key, 3, outputs, hidden=(16, 8), activation=activation, first_activation=first_activation
    )
    (a, b), (c, d), (e, f) = layers(head)
    assert [w.shape for w in (a, c, e)] == [(3, 16), (16, 8), (8, int(np.prod(outputs)))]
    assert [w.shape for w in (b, d)] == [(16,), (8,)]
    x = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    act = ACTIVATIONS[activation]
    below = x @ a + b
    out = act((act(below) if first_activation else below) @ c + d) @ e + f
    given = jax.vmap(lambda row: head.apply(head.params, row))(jnp.asarray(x))
    assert given.dtype == jnp.float32 and given.shape == (5, *outputs)
    np.testing.assert_allclose(given, out.reshape(5, *outputs), rtol=1e-4, atol=1e-5)


def test_weights_and_biases_start_uniform_within_the_root_of_the_fan_in(key):
    for kernel, bias in layers(make_head(key, 50, (4, 25), hidden=(200, 100))):
        bound = 1 / np.sqrt(len(kernel))
        for numbers in (kernel, bias):
            assert numbers.dtype == np.float32 and 0.9 * bound < np.abs(numbers).max() <= bound
            m, s = numbers.size, bound / np.sqrt(3)
            assert abs(numbers.mean()) < 4 * s / np.sqrt(m)
            assert abs(numbers.std() / s - 1) < 4 / np.sqrt(m)


def test_networks_of_one_shape_share_their_function_and_differ_by_key():
    a, b = (make_head(jax.random.key(i), 3, hidden=(4,)) for i in range(2))
    assert a.apply is b.apply and (layers(a)[0][0] != layers(b)[0][0]).all()
    assert make_head(jax.random.key(0), 3, hidden=(4,), activation="tanh").apply is not a.apply


@pytest.mark.parametrize(
    "changed",
    [
        dict(inputs=0),
        dict(inputs=2.0),
        dict(inputs=True),
        dict(outputs=(2, 0)),
        dict(hidden=()),
        dict(hidden=(3, -1)),
    ],
)
def test_sizes_of_networks_are_checked(changed):
    with pytest.raises(ValueError, match="make_head: inputs, hidden and outputs must be integers"):
        make_head(jax.random.key(0), **dict(inputs=2) | changed)


def test_activations_of_networks_are_checked():
    with pytest.raises(ValueError, match="activation must .*received 'elu'"):
        make_head(jax.random.key(0), 2, activation="elu")


# --- numbers
# ----------------------------------------------------------------------------

numbers = st.integers(-400, 400).map(lambda n: n / 4)


@given(batches=st.lists(st.lists(st.tuples(numbers, numbers), max_size=6), max_size=5))
@examples(max_examples=100, deadline=None)
def test_moments_are_those_of_all_batches_together(batches):
    found = Moments.empty(2)
    for batch in batches:
        found = update_moments(found, np.array(batch).reshape(-1, 2))
    everything = np.array([row for batch in batches for row in batch])
    assert found.count == len(everything) and all(a.dtype == np.float32 for a in found)
    if len(everything):
        deviation = everything.std(0)
        np.testing.assert_allclose(found.mean, everything.mean(0), rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(found.deviation, deviation, rtol=1e-3, atol=1e-3)
        assert (found.deviation[deviation == 0] == 0).all()


def test_moments_of_single_numbers_and_of_none():
    found = update_moments(update_moments(Moments.empty(), np.array([1.0, 2.0])), np.array([6.0]))
    np.testing.assert_allclose(
        [found.count, found.mean, found.deviation], [3, 3, np.std([1, 2, 6])], rtol=1e-6
    )
    assert update_moments(found, np.zeros(0)) is found
    np.testing.assert_array_equal(
        Moments.empty(2).normalise(np.array([3.0, 4.0], np.float32)), [3.0, 4.0]
    )
    constant = update_moments(Moments.empty(1), np.full((5, 1), 3.0))
    np.testing.assert_array_equal(constant.normalise(np.array([3.5], np.float32)), [0.5])
    np.testing.assert_array_equal(constant.restore(np.array([0.5], np.float32)), [3.5])


def test_moments_normalise_and_restore():
    found = update_moments(Moments.empty(3), np.random.default_rng(0).normal(5.0, 3.0, (100, 3)))
    x = np.arange(3, dtype=np.float32)
    np.testing.assert_allclose(found.restore(found.normalise(x)), x, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found.first(2).normalise(x[:2]), found.normalise(x)[:2])


@given(
    shapes=st.dictionaries(
        st.sampled_from("abcd"), st.sampled_from([(), (1,), (3,), (2, 2), (0,)]), min_size=1
    )
)
@examples(max_examples=25, deadline=None)
def test_unflat_is_the_inverse_of_flat(shapes):
    event = {
        name: jax.ShapeDtypeStruct(shape, jnp.int32 if name == "a" else jnp.float32)
        for name, shape in shapes.items()
    }
    n = sum(int(np.prod(shape)) for shape in shapes.values())
    u = jnp.arange(n, dtype=jnp.float32) / 16
    back = unflat(u, event)
    assert {name: a.shape for name, a in back.items()} == shapes
    assert all(jnp.issubdtype(a.dtype, jnp.floating) for a in back.values())
    np.testing.assert_array_equal(flat(back), u)


def test_flat_makes_one_row_of_any_disturbance():
    x = dict(hit=jnp.int32(2), gust=jnp.array([[1.5, 2.5]]), ok=jnp.array(True))
    row = flat(x)
    assert row.dtype == jnp.float32
    np.testing.assert_array_equal(row, [1.5, 2.5, 2.0, 1.0])


# --- histograms
# ----------------------------------------------------------------------------

binned = jax.jit(sample_bins)
logit = st.floats(-20, 20, width=32)


@given(
    logits=st.lists(logit, min_size=5, max_size=5),
    u=st.lists(st.floats(0, 1, exclude_max=True, width=32), min_size=8, max_size=8),
)
@examples(max_examples=100, deadline=None)
def test_draws_of_a_histogram_invert_its_distribution_function(logits, u):
    u = np.sort(np.array(u + [0.0, 1 - 2.0**-24], np.float32))
    rows = jnp.broadcast_to(jnp.asarray(logits, jnp.float32), (len(u), 5))
    x = np.asarray(binned(rows, jnp.asarray(u)), np.float64)
    assert (0 <= x).all()
    assert (x < 1).all()
    assert (np.diff(x) >= -1e-6).all()
    p = special.softmax(np.array(logits))
    # the distribution function
    below = np.interp(x, np.arange(6) / 5, np.concatenate([[0], np.cumsum(p)]))
    np.testing.assert_allclose(below, u, atol=2e-6)


def test_draws_have_the_density_of_the_histogram(key):
    """Of two numbers at once: the share of each cell and the mean within it, in standard errors."""
    logits, n = jnp.asarray([[0.0, 1.0, -1.0, 2.0], [1.0, 1.0, 1.0, -8.0]], jnp.float32), 20_000
    x = np.asarray(
        jax.vmap(lambda k: sample_bins(logits, jax.random.uniform(k, (2,), jnp.float32)))(
            jax.random.split(key, n)
        )
    )
    p = special.softmax(np.asarray(logits), axis=1)
    for column, shares in zip(x.T, p, strict=True):
        cell = np.floor(4 * column).astype(int)
        for k, share in enumerate(shares):
            inside = (4 * column - k)[cell == k]
            assert abs(len(inside) / n - share) < 4 * np.sqrt(share * (1 - share) / n)
            assert len(inside) < 100 or abs(inside.mean() - 0.5) < 4 / np.sqrt(12 * len(inside))
    assert abs(np.corrcoef(x.T)[0, 1]) < 4 / np.sqrt(n)


def test_histograms_at_their_ends():
    u = jnp.asarray([0.0, 0.25, 0.999, 1 - 2.0**-24], jnp.float32)
    rows = lambda logits: jnp.broadcast_to(jnp.asarray(logits, jnp.float32), (4, len(logits)))
    for k in range(4):  # all in one cell
        x = np.asarray(sample_bins(rows([200.0 * (j == k) for j in range(4)]), u))
        assert (k / 4 <= x).all() and (x < (k + 1) / 4).all()
        np.testing.assert_allclose(x, (k + np.asarray(u)) / 4, atol=1e-6)
    for logits in ([jnp.nan] * 4, [-jnp.inf] * 4, [0.0, jnp.nan, 1.0, 2.0]):  # nothing is known
        np.testing.assert_allclose(sample_bins(rows(logits), u), u, atol=2e-6)
    some = np.random.default_rng(0).normal(size=(5000, 40)).astype(np.float32)
    # the greatest number that is drawn stays below the end of the last cell that has mass
    for last, bins in ((1.0, 40), (0.75, 30)):
        logits = jnp.asarray(np.where(np.arange(40) < bins, some, -200), jnp.float32)
        assert float(binned(logits, jnp.full(5000, 1 - 2.0**-23, jnp.float32)).max()) < last
    np.testing.assert_allclose(
        sample_bins(rows([-jnp.inf, 0.0]), u), (1 + np.asarray(u)) / 2, atol=1e-6
    )
    np.testing.assert_allclose(
        sample_bins(rows([0.0, jnp.inf]), u), (1 + np.asarray(u)) / 2, atol=1e-6
    )


# --- samples
# ----------------------------------------------------------------------------

PLANE = plane()


def some_roots(turns=3, trees=4, children=6):
    """Roots of `plane` as a search would have them: the last of them invalid, and one whose
    children were not visited.
    """
    rng = np.random.default_rng(1)
    f = lambda *shape: rng.normal(size=shape).astype(jnp.zeros(()).dtype)
    visits = rng.integers(0, 9, (turns, trees, children)).astype(np.int32)
    visits[0, 1] = 0
    valid = np.ones((turns, trees), bool)
    valid[-1, -2:] = False
    depth = np.broadcast_to(np.arange(turns, dtype=np.int32)[:, None], (turns, trees))
    return Roots(
        f(turns, trees, 2),
        depth,
        f(turns, trees, children, 2),
        (),
        visits,
        f(turns, trees, children),
        valid,
    )


@pytest.mark.parametrize("first", [0, 1])
def test_samples_of_roots(first):
    """Tree by tree, root by root, and for a value head child by child."""
    roots, good, bins = some_roots(), np.array([True, False, True, True]), 5
    policy, value = samples_of_roots(PLANE, samples(), roots, bins, good, first)
    shares, edges = [], []
    for tree, turn in np.ndindex(4, 3):
        at = turn, tree
        if not roots.valid[at] or roots.depth[at] < first:
            continue
        n, x = roots.visits[at], roots.actions[at]
        edges += [(roots.state[at], x[k], roots.q[at][k]) for k in range(6) if n[k]]
        if good[tree] and n.sum():
            cells = np.floor(bins * special.ndtr(x.astype(np.float64))).astype(int)
            shares.append(
                (
                    roots.state[at],
                    [[n[cells[:, j] == b].sum() / n.sum() for b in range(bins)] for j in range(2)],
                )
            )
    for found, columns in (
        (policy, zip(*((s, np.zeros(0), t) for s, t in shares), strict=True)),
        (value, zip(*edges, strict=True)),
    ):
        for a, b in zip(found[:3], columns, strict=True):
            np.testing.assert_allclose(a, np.array(b), rtol=1e-6)
        assert all(a.dtype == np.float32 for a in found[:3]) and found.dropped == 0
    np.testing.assert_allclose(policy.target.sum(2), 1, rtol=1e-6)
    none, same_value = samples_of_roots(PLANE, samples(), roots, None, good, first)
    assert none is None and (same_value.target == value.target).all()


def test_samples_of_roots_that_are_not_finite_are_left_out_and_counted():
    roots, good = some_roots(), np.ones(4, bool)
    roots.state[0, 0, 1] = np.nan
    roots.q[1, 2, 3] = np.inf
    roots.visits[1, 2, 3] = roots.visits[0, 0, 0] = 2
    policy, value = samples_of_roots(PLANE, samples(), roots, 5, good)
    assert policy.dropped == 1 and value.dropped == 1 + (roots.visits[0, 0] > 0).sum()
    assert len(policy.seen) == roots.valid.sum() - 2
    assert len(value.seen) == (roots.visits[roots.valid] > 0).sum() - value.dropped
    assert all(np.isfinite(a).all() for found in (policy, value) for a in found[:3])


def test_samples_of_edges():
    rng = np.random.default_rng(2)
    f = lambda *shape: rng.normal(size=shape).astype(np.float32)
    edges = Edges(
        f(7, 3, 2),
        f(7, 3, 1),
        f(7, 3),
        f(7, 3),
        rng.random((7, 3)) < 0.7,
    )
    edges.valid[2:4, 1] = True
    edges.seen[2, 1, 0], edges.q[3, 1] = np.nan, -np.inf
    for target, values, dropped in (("own", edges.q, 2), ("parent", edges.parent_q, 1)):
        taught = [
            (tree, i)
            for tree, i in np.ndindex(3, 7)
            if edges.valid[i, tree]
            and np.isfinite(values[i, tree])
            and np.isfinite(edges.seen[i, tree]).all()
        ]
        found = samples_of_edges(edges, target)
        assert found.dropped == dropped
        for a, b in zip(found[:3], (edges.seen, edges.x, values), strict=True):
            np.testing.assert_array_equal(a, [b[i, tree] for tree, i in taught])


@pytest.mark.slow
@pytest.mark.parametrize(("sim", "n", "d"), [(PLANE, 2, 2), (ring(), 5, 3)], ids=["plane", "ring"])
def test_samples_of_episodes(sim, n, d):
    """At each state of the good ones, the cell of what came next."""
    episodes = jax.device_get(
        jax.vmap(lambda key: jast.rollout(key, sim))(jax.random.split(jax.random.key(0), 9))
    )
    good, bins = np.arange(9) % 3 > 0, 4
    found = samples_of_episodes(sim, samples(), episodes, bins, good)
    there = jax.tree.map(lambda a: a[:, :-1], episodes.states)
    located = lambda state, x: (
        sim.observe(state),
        flat(jast.distributions.cdf(sim.disturbance(state), x)),
    )
    seen, u = jax.device_get(jax.jit(jax.vmap(jax.vmap(located)))(there, episodes.disturbances))
    rows = [
        (seen[i, t], np.eye(bins)[np.floor(u[i, t] * bins).astype(int)])
        for i in np.flatnonzero(good)
        for t in range(int(episodes.length[i]))
    ]
    assert found.seen.shape == (len(rows), n)
    assert found.x.shape == (len(rows), 0)
    assert found.target.shape == (len(rows), d, bins)
    assert found.dropped == 0
    np.testing.assert_allclose(found.seen, [seen for seen, _ in rows], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found.target, [target for _, target in rows])


@given(data=st.data(), share=st.floats(0.01, 1.0))
@examples(max_examples=50, deadline=None)
def test_the_best_trees_are_the_best(data, share):
    """Of all groups together, about this share of them: never fewer."""
    reward = st.one_of(st.floats(-10, 10, width=32), st.just(-np.inf), st.just(np.nan))
    logs = data.draw(st.lists(st.integers(1, 4), min_size=1, max_size=3))
    harvests = [
        SimpleNamespace(
            log=np.array(
                data.draw(
                    st.lists(st.lists(reward, min_size=n, max_size=n), min_size=2, max_size=2)
                )
            )
        )
        for n in logs
    ]
    chosen = np.concatenate(best_trees(harvests, share))
    best = np.concatenate([np.where(np.isfinite(h.log), h.log, -np.inf).max(0) for h in harvests])
    assert chosen.sum() >= share * len(best) - 1e-9
    assert chosen.all() or best[chosen].min() > best[~chosen].max()
    assert np.unique(best).size < len(best) or chosen.sum() <= share * len(best) + 2


# --- learning
# ----------------------------------------------------------------------------

PLAIN = (Moments.empty(), Moments.empty())
HOW = dict(rate=0.01, batch=32, steps=1000, capacity=0)


def linear(params, x):
    """A value, or logits of two numbers in three bins, linear in the input."""
    return jnp.einsum("...n,n->...", params, x)


def toy(m, n, target):
    """Samples of normal inputs."""
    x = np.random.default_rng(3).normal(size=(m, n)).astype(np.float32)
    return Samples(
        x, np.zeros((m, 0), np.float32), np.array([target(row) for row in x], np.float32)
    )


VALUES = toy(40, 2, lambda x: 3 * x[0] - x[1])
SHARES = toy(
    40, 2, lambda x: special.softmax(np.array([[x[0], 0, -x[0]], [2 * x[1], x[0], 0]]), axis=1)
)
CASES = dict(
    squared=(VALUES, (2,)), cross_entropy=(SHARES, (2, 3, 2)), squared_shares=(SHARES, (2, 3, 2))
)


def loss_of(loss, params, samples):
    out = np.einsum("...n,mn->m...", params, samples.seen.astype(np.float64))
    if loss == "squared":
        return ((out - samples.target) ** 2).mean()
    if loss == "squared_shares":
        return ((special.softmax(out, axis=-1) - samples.target) ** 2).mean()
    return -(samples.target * special.log_softmax(out, axis=-1)).sum(-1).mean()


@pytest.mark.parametrize("loss", CASES)
def test_the_loss_is_the_formula_and_falls_to_its_least(loss, key):
    samples, shape = CASES[loss]
    params = np.random.default_rng(4).normal(size=shape).astype(np.float32)
    pupil, lesson = train_head(
        key,
        init_head(jnp.asarray(params)),
        jax.tree_util.Partial(linear),
        PLAIN,
        samples,
        loss=loss,
        **HOW | dict(rate=0.0, batch=40, steps=1),
    )
    assert lesson == Lesson(
        pytest.approx(loss_of(loss, params, samples), rel=1e-4), 1, 40, 0, False
    )
    np.testing.assert_array_equal(pupil.params, params)
    pupil, lesson = train_head(
        key,
        init_head(jnp.asarray(params)),
        jax.tree_util.Partial(linear),
        PLAIN,
        samples,
        loss=loss,
        **HOW,
    )
    assert not lesson.rejected and lesson.steps == 1000
    least = (
        0.0
        if loss != "cross_entropy"
        else -(samples.target * np.log(samples.target)).sum(-1).mean()
    )
    for found in (lesson.loss, loss_of(loss, np.asarray(pupil.params), samples)):
        assert abs(found - least) < 0.02 * (loss_of(loss, params, samples) - least)


def test_what_a_head_sees_and_says_is_normalised(key):
    """A network that is right in normalised numbers is right; so is the loss measured in them."""
    inputs, targets = (
        Moments(np.float32(1), np.float32([1, -2]), np.float32([2, 4])),
        Moments(np.float32(1), np.float32(10), np.float32(5)),
    )
    samples = VALUES._replace(
        seen=VALUES.seen * inputs.deviation + inputs.mean, target=VALUES.target * 5 + 10
    )
    once = HOW | dict(rate=0.0, batch=40, steps=1)
    right, wrong = (
        train_head(
            key,
            init_head(jnp.asarray(p, jnp.float32)),
            jax.tree_util.Partial(linear),
            (inputs, targets),
            samples,
            loss="squared",
            **once,
        )[1].loss
        for p in ([3, -1], [3, 0])
    )
    assert right < 1e-8 and wrong == pytest.approx((VALUES.seen[:, 1] ** 2).mean(), rel=1e-4)


@pytest.mark.parametrize("passes", [1, 2])
def test_a_pass_visits_each_sample_once(passes, key):
    """Each sample has a parameter of its own, so that Adam's first moment tells when it was
    visited: 0.1 g 0.9^(steps since then).
    """
    m = 30
    samples = Samples(
        np.eye(m, dtype=np.float32),
        np.zeros((m, 0), np.float32),
        np.arange(1, m + 1, dtype=np.float32),
    )
    how = HOW | dict(rate=0.0, batch=1, steps=None if passes == 1 else passes * m)
    pupil, lesson = train_head(
        key,
        init_head(jnp.zeros(m, jnp.float32)),
        jax.tree_util.Partial(linear),
        PLAIN,
        samples,
        loss="squared",
        **how,
    )
    assert (lesson.steps, lesson.samples) == (passes * m, m)
    decay = (
        np.asarray(pupil.optimiser.mu, np.float64)
        / (0.1 * -2 * samples.target)
        / sum(0.9 ** (m * i) for i in range(passes))
    )
    ago = np.log(decay) / np.log(0.9)
    np.testing.assert_allclose(np.sort(ago), np.arange(m), atol=1e-2)
    assert (np.diff(np.round(ago)) != -1).any()  # in a shuffled order


def test_latest_samples_are_kept_up_to_the_capacity(key):
    first, second = (
        VALUES._replace(**{f: getattr(VALUES, f)[part] for f in ("seen", "x", "target")})
        for part in (slice(0, 25), slice(25, 40))
    )
    how = dict(loss="squared", rate=0.01, batch=8, steps=5)
    pupil, _ = train_head(
        key,
        init_head(jnp.zeros(2, jnp.float32)),
        jax.tree_util.Partial(linear),
        PLAIN,
        first,
        capacity=30,
        **how,
    )
    assert len(pupil.kept.seen) == 25
    pupil, lesson = train_head(
        key, pupil, jax.tree_util.Partial(linear), PLAIN, second, capacity=30, **how
    )
    assert lesson.samples == 15
    for kept, column in zip(pupil.kept[:3], VALUES[:3], strict=True):
        np.testing.assert_array_equal(kept, column[-30:])
    pupil, lesson = train_head(
        key,
        pupil,
        jax.tree_util.Partial(linear),
        PLAIN,
        second,
        capacity=30,
        **how | dict(steps=None, batch=1),
    )
    assert lesson.steps == 30
    pupil, lesson = train_head(
        key,
        init_head(jnp.zeros(2, jnp.float32)),
        jax.tree_util.Partial(linear),
        PLAIN,
        first,
        capacity=0,
        **how | dict(steps=None),
    )
    assert pupil.kept is None and lesson.steps == 4


@pytest.mark.parametrize("bad", ["target", "apply", "rate"])
def test_a_lesson_that_is_not_finite_is_rejected(bad, key, equal):
    samples, apply, how = VALUES, linear, HOW | dict(loss="squared", steps=20, capacity=50)
    if bad == "target":
        samples = VALUES._replace(
            target=np.where(np.arange(40) == 7, np.nan, VALUES.target).astype(np.float32)
        )
    elif bad == "apply":
        apply = lambda params, x: linear(params, x) * jnp.nan
    else:
        how |= dict(rate=1e30)
    before = init_head(jnp.asarray([0.5, -0.25], jnp.float32))
    after, lesson = train_head(key, before, jax.tree_util.Partial(apply), PLAIN, samples, **how)
    assert lesson.rejected
    assert not np.isfinite(lesson.loss)
    assert lesson.steps == 20
    equal(after._replace(kept=None), before)


@pytest.mark.parametrize(
    ("samples", "steps"),
    [(VALUES, 0), (Samples(np.zeros((0, 2)), np.zeros((0, 0)), np.zeros(0), dropped=3), 10)],
)
def test_nothing_is_learned_without_steps_or_samples(samples, steps, key, equal):
    before = init_head(jnp.asarray([0.5, -0.25], jnp.float32))
    after, lesson = train_head(
        key,
        before,
        jax.tree_util.Partial(linear),
        PLAIN,
        samples,
        loss="squared",
        **HOW | dict(steps=steps),
    )
    equal(after, before)
    assert np.isnan(lesson.loss) and lesson[1:] == (0, 0, samples.dropped, False)


# --- forests with heads
# ----------------------------------------------------------------------------

SYSTEMS = dict(
    plane=PLANE,
    walk1d=jast.simulators.walk1d(threshold=5.0),
    landing=jast.simulators.landing(b=0.2),
    ring=ring(),
)
NUMBERS = dict(plane=(2, 2), walk1d=(1, 1), landing=(2, 1), ring=(5, 3))
ACTIONS = dict(samples=samples(), quantiles=quantiles(), uniform=uniform(-2.0, 2.0))
BONUS = jast.rewards.standard(event_bonus=10.0)
SIZE = dict(trees=8, prunes=3, simulations=40, lanes=2, threads=1, reward=BONUS)
QUICK = settings(round=4, steps=(50, 50), bins=8, hidden=(8,), batch=(16, 32))
TRAINED = dict(both=("policy", "value"), rollout=("policy",), value=("value",))


def searched(name="plane", heads="both", actions="samples", key=5, sim=None, **changed):
    sim = SYSTEMS[name] if sim is None else sim
    return forest(
        jax.random.key(key),
        sim,
        **SIZE | dict(actions=ACTIONS[actions], heads=heads, head_settings=QUICK) | changed,
    )


once = functools.cache(searched)


@pytest.mark.long
def test_rounds_and_searches_share_their_programs(traced):
    """By a first search of two rounds, one of each function, but two to train: policy and value. A
    second one with other settings and another simulator of the kind adds none.
    """
    jax.clear_caches()  # of what other tests have compiled
    shared = run._make, run._grow, run._prune, run._rebuild, _fit, _root_rows, _episode_rows
    searched()
    assert [traced.count(f.__name__) for f in shared] == [1, 1, 1, 1, 2, 1, 1]
    traced.clear()
    searched(
        key=6,
        sim=plane(2.5),
        head_settings=QUICK._replace(
            elite=1.0, power=1.0, learning_rate=(0.1, 0.1), steps=(7, 9), q_weight=0.6, share=0.5
        ),
    )
    assert not {f.__name__ for f in shared} & set(traced)


KINDS = [
    ("plane", "both", "samples"),
    ("plane", "value", "uniform"),
    ("walk1d", "rollout", "samples"),
    pytest.param("landing", "both", "quantiles", marks=pytest.mark.long),
    pytest.param("ring", "both", "samples", marks=pytest.mark.long),
]


@pytest.mark.long
@pytest.mark.parametrize(("name", "heads", "actions"), KINDS)
def test_forests_of_all_kinds_learn(name, heads, actions):
    result, (n, d) = (
        once(name, heads, actions) if name != "plane" or heads != "both" else once(),
        NUMBERS[name],
    )
    honest(result, SYSTEMS[name], BONUS)
    assert result.invalid == 0 and result.failures.size > 0
    for i in range(0, result.failures.size, 5):
        replays(result.failures.episode(i), SYSTEMS[name], BONUS)
    assert [tuple(lesson) for lesson in result.lessons] == [TRAINED[heads]] * 2
    for of in (of for lesson in result.lessons for of in lesson.values()):
        assert of.steps == 50
        assert of.samples > 0
        assert of.dropped == 0
        assert not of.rejected
        assert np.isfinite(of.loss)
    made = init_heads(
        jax.random.fold_in(jax.random.key(5), 8), SYSTEMS[name], ACTIONS[actions], heads, QUICK
    ).heads
    for part, shape in (("policy", (d, 8)), ("value", ())):
        head, new = getattr(result.heads, part), getattr(made, part)
        assert (head is None) == (new is None) == (part not in TRAINED[heads])
        if head is not None:
            out = head.apply(head.params, jnp.zeros(n if part == "policy" else n + d, jnp.float32))
            assert out.shape == shape and out.dtype == jnp.float32
            assert all(
                (np.asarray(a) != b).any()
                for a, b in zip(
                    jax.tree.leaves(head.params), jax.tree.leaves(new.params), strict=True
                )
            )
    assert result.heads.levels == SYSTEMS[name].horizon + 1


@pytest.mark.slow
def test_fields_are_as_documented():
    result = once()
    assert isinstance(result.heads, Heads)
    assert isinstance(result.lessons, tuple)
    assert all(isinstance(of, Lesson) for of in result.lessons[0].values())
    asked = QUICK._asdict() | dict(round=4)
    assert result.settings["heads"] == "both"
    assert json.loads(json.dumps(result.settings)) == result.settings
    assert result.settings["head_settings"] == {
        name: list(v) if isinstance(v, tuple) else v for name, v in asked.items()
    }
    assert "rejected" not in str(result) and "left out" not in str(result)
    assert all(
        a.dtype == jnp.float32
        for a in jax.tree.leaves(
            (result.heads.policy.params, result.heads.value.params, result.heads.inputs)
        )
    )


@pytest.mark.slow
def test_moments_are_those_of_all_children_of_all_roots():
    """Also the numbers of samples that the lessons tell of."""
    result = once()
    there = (result.roots.visits > 0) & result.roots.valid[..., None]
    seen = np.broadcast_to(result.roots.state[:, :, None], (*there.shape, 2))[there]
    rows = np.concatenate([seen, result.roots.actions[there]], axis=1)
    inputs, returns = result.heads.inputs, result.heads.returns
    assert inputs.count == returns.count == len(rows)
    assert [lesson["value"].samples for lesson in result.lessons] == [
        there[:, :4].sum(),
        there[:, 4:].sum(),
    ]
    np.testing.assert_allclose(inputs.mean, rows.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(inputs.deviation, rows.std(0), rtol=1e-4)
    np.testing.assert_allclose(
        [returns.mean, returns.deviation],
        [result.roots.q[there].mean(), result.roots.q[there].std()],
        rtol=1e-4,
    )


def test_a_round_is_a_fifth_of_the_trees_unless_it_is_said():
    heads = made()
    use = QUICK._replace(round=None, steps=(0, 0))
    result = searched(heads=heads, head_settings=use, trees=10)
    assert result.settings["head_settings"]["round"] == 2 and len(result.lessons) == 5
    assert (
        searched(heads=heads, head_settings=use._replace(round=300)).settings["head_settings"][
            "round"
        ]
        == 8
    )


@pytest.mark.long
def test_threads_and_lanes_change_nothing():
    """Nor do they when heads learn between the rounds."""
    for other in (searched(threads=2), searched(lanes=4)):
        same(once(), other)
        assert other.lessons == once().lessons
        for a, b in zip(jax.tree.leaves(other.heads), jax.tree.leaves(once().heads), strict=True):
            np.testing.assert_array_equal(a, b)


def made(heads="both", settings=QUICK, key=5, trees=8):
    """Heads as `searched` makes them."""
    return init_heads(
        jax.random.fold_in(jax.random.key(key), trees), PLANE, samples(), heads, settings
    ).heads


def unchanged(heads, before, equal):
    for part in ("policy", "value"):
        if getattr(before, part) is not None:
            equal(getattr(heads, part).params, getattr(before, part).params)


def test_heads_that_are_not_trained_stay_as_they_are(equal):
    """And are used from the first tree on, where they know something."""
    first, again = (
        once().heads,
        searched(heads=once().heads, head_settings=QUICK._replace(train=False)),
    )
    unchanged(again.heads, first, equal)
    assert again.lessons == ()
    assert again.heads.levels == first.levels
    assert again.settings["heads"] == "policy/value"
    nothing = searched(heads=made(), head_settings=QUICK._replace(train=False))
    # so are the heads of the first round
    np.testing.assert_array_equal(nothing.best_reward_per_tree[:4], once().best_reward_per_tree[:4])
    assert (again.best_reward_per_tree[:4] != nothing.best_reward_per_tree[:4]).any()


def test_heads_learn_on(equal):
    on = searched(heads=once().heads)
    assert len(on.lessons) == 2 and on.heads.inputs.count > once().heads.inputs.count
    assert (
        np.asarray(on.heads.value.params["params"]["Dense_0"]["kernel"])
        != once().heads.value.params["params"]["Dense_0"]["kernel"]
    ).any()


def test_levels_are_those_of_the_roots_without_episodes():
    result = searched(head_settings=QUICK._replace(episodes=False))
    assert result.heads.levels == 1 + result.roots.depth[result.roots.valid].max() < PLANE.horizon


def test_training_that_diverges_is_rejected_and_the_search_goes_on(equal):
    result = searched(head_settings=QUICK._replace(learning_rate=(1e30, 1e30)))
    assert [of.rejected for lesson in result.lessons for of in lesson.values()] == [True] * 4
    unchanged(result.heads, made(), equal)
    assert result.heads.levels == 0
    text = str(result)
    for n, name in ((1, "policy"), (2, "value")):
        assert f"round {n}: training of the {name} head was rejected, its loss was" in text
        assert "the parameters from before were kept" in text
    guided = searched(heads=made(), head_settings=QUICK._replace(train=False))
    np.testing.assert_array_equal(result.best_reward_per_tree, guided.best_reward_per_tree)
    honest(result, PLANE, BONUS)


def logits(params, seen):
    return jnp.einsum("dbn,n->db", params["w"], seen) + params["b"]


def broken(params, x):
    return jnp.sum(params * x) * jnp.nan


@pytest.mark.long
def test_heads_of_any_framework_and_one_that_only_says_nan(equal):
    """What is not finite is no value: the tree goes on by Q, and the head learns nothing."""
    own = Heads(
        (dict(w=jnp.zeros((2, 6, 2), jnp.float32), b=jnp.zeros((2, 6), jnp.float32)), logits),
        (jnp.ones(4, jnp.float32), broken),
        levels=5,
    )
    result = searched(heads=own, actions="quantiles")
    honest(result, PLANE, BONUS)
    assert [(lesson["policy"].rejected, lesson["value"].rejected) for lesson in result.lessons] == [
        (False, True)
    ] * 2
    equal(result.heads.value.params, own.value.params)
    assert (result.heads.policy.params["w"] != 0).any()
    assert result.settings["heads"] == "policy/value"
    assert "training of the value head was rejected, its loss was nan" in str(result)
    assert "policy head was rejected" not in str(result)


@pytest.mark.parametrize("sight", [1.5, 0.0])
def test_an_observe_that_turns_nan_loses_samples_and_nothing_else(sight):
    result = searched(sim=plane(sight=sight))
    dropped = sum(of.dropped for lesson in result.lessons for of in lesson.values())
    assert dropped > 0 and f"{dropped} samples for the heads were left out" in str(result)
    assert result.invalid == 0
    assert np.isfinite(result.best.reward)
    assert np.isfinite(result.best_reward_per_tree).all()
    assert not any(of.rejected for lesson in result.lessons for of in lesson.values())
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(result.heads))
    honest(result, plane(sight=sight), BONUS)


def test_a_system_that_fails_at_its_start():
    result = searched(sim=plane(-1.0))
    assert result.episodes == 8
    assert result.failing_share == 1
    assert result.steps == 0
    assert all(of.samples == of.steps == 0 for lesson in result.lessons for of in lesson.values())
    assert result.heads.levels == 0


# --- interruption
# ----------------------------------------------------------------------------


def test_a_search_interrupted_between_rounds_says_so():
    """In the second round: what the first has taught is there."""

    def stop(done, total, _):
        assert total == 8 * 120
        if done > 4 * 120:
            raise KeyboardInterrupt

    result = searched(callback=stop)
    assert 40 * result.roots.valid[:, :4].sum() < result.episodes <= 960
    assert "of 960 simulations" in result.settings["interrupted"]
    assert len(result.lessons) == 1
    assert 4 < len(result.best_reward_per_tree) <= 8
    np.testing.assert_array_equal(result.best_reward_per_tree[:4], once().best_reward_per_tree[:4])
    honest(result, PLANE, BONUS)


def test_a_search_interrupted_in_a_lesson_says_so(monkeypatch, equal):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(trees, "train_heads", interrupted)
    result = searched()
    assert result.episodes == 40 * result.roots.valid.sum()
    assert result.best_reward_per_tree.shape == (4,)
    assert "of 960 simulations" in result.settings["interrupted"] and result.lessons == ()
    unchanged(result.heads, made(), equal)


# --- as published
# ----------------------------------------------------------------------------


PUBLISHED = dict(trees=4, prunes=2, simulations=30, reward=BONUS, lanes=1, threads=1)


@pytest.mark.long
@pytest.mark.parametrize("round", [1, 2])
def test_the_published_heads(round, equal):
    """One pass over the round's own edges, one by one; the networks guide from the first tree
    on.
    """
    result = forest(
        jax.random.key(5),
        PLANE,
        mode="code",
        heads="both",
        head_settings=settings("code", round=round, hidden=(8,)),
        **PUBLISHED,
    )
    honest(result, PLANE, BONUS)
    assert len(result.lessons) == 4 // round and result.settings["head_settings"]["round"] == round
    for lesson in result.lessons:
        assert lesson["policy"].steps == lesson["policy"].samples == 2 * round  # roots
        assert lesson["value"].steps == lesson["value"].samples > 20 * round  # edges
    assert result.heads.inputs.count == 0
    assert not any(of.rejected for lesson in result.lessons for of in lesson.values())


def test_the_text_departs_from_the_code_where_the_table_says():
    """And "paper" is "code" by its earlier name."""
    code, text = MODES["code"], MODES["text"]
    differ = {name for name in code._fields if getattr(code, name) != getattr(text, name)}
    named = settings.__doc__
    assert all(f"``{name}``" in named for name in differ - {"q_weight"}) and len(differ) == 6
    assert MODES["paper"] is code
    sees = {
        name: jast.simulators.ferry(observation=name)
        .observe(jast.simulators.ferry().init(()))
        .shape
        for name in ("code", "text")
    }
    assert sees == {"code": (5,), "text": (6,)}
    with pytest.raises(ValueError, match="ferry: observation must be one of .*, received 'six'"):
        jast.simulators.ferry(observation="six")


@pytest.mark.long
def test_statistics_counted_at_the_end_of_the_tree():
    """One more child of each root, the next root, has what all later simulations brought it."""
    grow = lambda counted: (
        forest(
            jax.random.key(5),
            PLANE,
            mode="code",
            heads="rollout",
            head_settings=settings("code", round=4, hidden=(8,), counted=counted, steps=(0, 0)),
            **PUBLISHED,
        ).roots
    )
    turn, tree = grow("turn"), grow("tree")
    more = tree.visits - turn.visits
    assert turn.visits[0].sum(1).tolist() == [30] * 4
    assert tree.visits[0].sum(1).tolist() == [60] * 4 and (more[1] == 0).all()
    for lane, row in enumerate(more[0]):
        assert np.flatnonzero(row).tolist() == [turn.visits[0, lane].argmax()]
    still = more[0] == 0
    np.testing.assert_allclose(tree.q[0][still], turn.q[0][still], rtol=1e-6)
    np.testing.assert_allclose(tree.q[1], turn.q[1], rtol=1e-6)


@pytest.mark.long
def test_the_rollout_head_of_the_published_code_on_s0():
    """Independent code of the same algorithm finds a collision in 34.5 % of 200 trees, SD over
    seeds 3.6; 100 trees in one sequence add a binomial SD of 4.8 minus what 200 have: 6 in all.
    """
    result = forest(
        jax.random.key(0),
        jast.simulators.ferry(),
        trees=100,
        prunes=18,
        simulations=500,
        mode="code",
        heads="rollout",
        **S0,
    )
    assert abs(result.failing_trees - 0.345) < 3 * 0.06
    assert len(result.lessons) == 100


@pytest.mark.long
def test_a_published_value_head_alone_is_not_trained(equal):
    result = forest(jax.random.key(5), PLANE, mode="code", heads="value", **PUBLISHED)
    assert result.lessons == ({},) * 4
    assert [kernel.shape for kernel, _ in layers(result.heads.value)] == [
        (4, 64),
        (64, 124),
        (124, 64),
        (64, 1),
    ]
    unchanged(result.heads, made("value", settings("code"), trees=4), equal)


# --- what it is for
# ----------------------------------------------------------------------------


@functools.cache
def on_the_ferry(heads, **changed):
    return forest(
        jax.random.key(0),
        jast.simulators.ferry(),
        **dict(trees=100, prunes=18, simulations=50, heads=heads, **S0) | changed,
    )


@pytest.mark.long
def test_learned_heads_find_more_failures():
    """The first round is that of a search without heads; in the last half of the trees nearly all
    fail.
    """
    without, learned = on_the_ferry(None), on_the_ferry("both")
    np.testing.assert_array_equal(
        without.best_reward_per_tree[:20], learned.best_reward_per_tree[:20]
    )
    a, b = without.failing_per_tree[50:].mean(), learned.failing_per_tree[50:].mean()
    assert b - a > 4 * np.sqrt((a * (1 - a) + b * (1 - b)) / 50)
    assert learned.best.reward > without.best.reward


@pytest.mark.long
def test_learned_heads_guide_another_search_from_its_first_tree():
    again = on_the_ferry(None, trees=20)
    warm = forest(
        jax.random.key(9),
        jast.simulators.ferry(),
        heads=on_the_ferry("both").heads,
        head_settings=settings(train=False),
        trees=20,
        prunes=18,
        simulations=50,
        **S0,
    )
    assert warm.failing_per_tree.mean() > again.failing_per_tree.mean() + 0.3


# --- bad input
# ----------------------------------------------------------------------------

zeros = lambda *shape, dtype=jnp.float32: (0.0, lambda params, x: jnp.zeros(shape, dtype))


def fails(params, x):
    raise KeyError("weights")


@pytest.mark.parametrize(
    ("heads", "message"),
    [
        (
            "policy",
            (
                'heads must be None, "rollout", "value", "both" or jast.heads.Heads, received'
                " 'policy'"
            ),
        ),
        (3, 'heads must be None, "rollout", "value", "both" or jast.heads.Heads, received 3'),
        (zeros(2, 5), r"received \(0.0, <function"),
        (Heads(), "must have a policy or a value head, received Heads"),
        (
            Heads(policy=zeros(1, 5)),
            (
                r"the policy head returned float32\[1, 5\], expected logits of shape \(2, bins\),"
                r" bins at least 2"
            ),
        ),
        (Heads(policy=zeros(2)), r"the policy head returned float32\[2\], expected"),
        (Heads(policy=zeros(2, 1)), r"the policy head returned float32\[2, 1\], expected"),
        (
            Heads(policy=zeros(2, 5, dtype=jnp.int32)),
            r"the policy head returned int32\[2, 5\], expected",
        ),
        (Heads(value=zeros(1)), r"the value head returned float32\[1\], expected a scalar"),
        (Heads(zeros(2, 5), zeros(1)), "the value head returned"),
        (Heads(value=(0.0, lambda params, x: (x[0], x[1]))), "the value head"),
        (
            Heads(policy=(0.0, fails)),
            r"the policy head's apply\(params, x\) failed on x of shape \(2,\) float32: 'weights'",
        ),
        (
            Heads(value=(0.0, lambda params: 0.0)),
            r"the value head's apply\(params, x\) failed on x of shape \(4,\) float32",
        ),
        (
            Heads(value=make_head(jax.random.key(0), 7)),
            r"the value head's apply\(params, x\) failed on x of shape \(4,\) float32",
        ),
        (
            Heads(value=zeros(), inputs=Moments.empty(9)),
            r"must take 4 numbers \(2 observed, 2 of the disturbance\), received .* take 9",
        ),
    ],
)
def test_bad_heads_are_named(heads, message):
    with pytest.raises(ValueError, match=message):
        searched(heads=heads)


@pytest.mark.parametrize("heads", ["both", Heads(zeros(2, 5))])
def test_an_observe_that_is_not_finite_at_the_start_is_named(heads):
    with pytest.raises(
        ValueError, match=r"must return finite numbers .*received \[nan nan\] at the start"
    ):
        searched(heads=heads, sim=plane(sight=-1.0))


def test_a_policy_head_needs_a_distribution_function():
    for heads in ("rollout", "both", Heads(zeros(1, 5))):
        with pytest.raises(
            ValueError, match="a rollout head needs .* distribution function; .*cdf: Seeds"
        ):
            searched(heads=heads, sim=dice())


def test_heads_cannot_be_trained_in_a_traced_search():
    with pytest.raises(
        ValueError,
        match="inside of jax.jit and jax.vmap: pass trained jast.heads.Heads",
    ):
        jax.jit(lambda key: forest(key, PLANE, **SIZE, heads="both").episodes)(jax.random.key(0))


@pytest.mark.parametrize("memoize", ["root", "none"])
def test_edges_need_states_at_every_node(memoize):
    with pytest.raises(
        ValueError, match=f"all edges .* needs states at every node, received '{memoize}'"
    ):
        searched(mode="paper", head_settings=None, memoize=memoize)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("round", (0, -1, 2.0, True)),
        ("bins", (1, 2.5)),
        ("learning_rate", ((0.0, 0.1), 0.1, (0.1,), (0.1, float("nan")))),
        ("batch", ((0, 1), 1, (1, 1.5))),
        ("steps", ((-1, 0), 10, (1.5, 1))),
        ("replay", ((-1, 0), 7, (None, 1))),
        ("hidden", (8, (0,), (8.0,))),
        ("elite", (0.0, 1.5, float("nan"), "all")),
        ("power", (-0.5, float("nan"), None)),
        ("share", (-0.1, 2.0)),
        ("q_weight", (float("nan"), "half")),
        ("v_weight", (float("nan"), None)),
        ("loss", ("mse",)),
        ("target", ("q",)),
        ("edges", ("none",)),
        ("candidates", ("two",)),
    ],
)
def test_settings_out_of_range_are_named(name, values):
    for value in values:
        with pytest.raises(ValueError, match=f"heads.settings: {name} must be .*, received"):
            settings(**{name: value})
        with pytest.raises(ValueError, match=f"heads.settings: {name} must be .*, received"):
            searched(head_settings=QUICK._replace(**{name: value}))


def test_unknown_settings_are_named():
    with pytest.raises(ValueError, match="mode must .*received 'published'"):
        settings("published")
    with pytest.raises(ValueError, match="expected settings among .*, received epochs, layers"):
        settings(layers=3, epochs=2)
    with pytest.raises(
        ValueError,
        match="head_settings must .*received dict",
    ):
        searched(head_settings=dict(round=3))
    assert settings("code", round=8) == MODES["code"]._replace(round=8)
    assert settings() == MODES["default"]
