"""Forest and tree search as users see them: what a result holds, that it is honest, and that
strange systems and bad input do no harm.
"""

import functools
import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import honest, replays
from systems import S0, TOLD, dice, mark_long, ring, walk

import jast
from jast import failures as F
from jast._src.search.tree import run
from jast.search import forest, mcts

FERRY, LANDING, RING = jast.simulators.ferry(), jast.simulators.landing(b=0.2), ring()
BONUS = jast.rewards.standard(event_bonus=30.0)
SIZE = dict(trees=6, prunes=3, simulations=60)
EPISODES = 6 * 3 * 60


def _four_branches(x):
    diagonal, across = (x[0] + x[1]) / jnp.sqrt(2.0), x[0] - x[1]
    near = 1 + 0.1 * across**2
    return jnp.min(jnp.stack([near - diagonal, near + diagonal, across + 2, 2 - across]))


WALK, STATIC = jast.simulators.walk1d(threshold=6.0), jast.simulators.limit_state(_four_branches, 2)
SYSTEMS = dict(
    ferry=FERRY, landing=LANDING, ring=RING, walk1d=WALK, limit_state=STATIC, dice=dice()
)
ACTIONS = dict(
    samples=jast.actions.samples(),
    quantiles=jast.actions.quantiles(),
    uniform=jast.actions.uniform(0.0, 1.0),
)


def searched(name, **changed):
    choices = S0 if name == "ferry" else dict(reward=BONUS, actions=ACTIONS["samples"])
    return forest(jax.random.key(3), SYSTEMS[name], **SIZE | choices | changed)


once = functools.cache(searched)


# --- what a result holds
# ----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", ["ferry", "landing"])
def test_fields_are_as_documented(name):
    result, real = once(name), np.dtype(jnp.zeros(()).dtype)
    horizon = SYSTEMS[name].horizon
    assert isinstance(result, jast.search.SearchResult)
    assert result.best.disturbances.shape == (horizon,)
    assert jax.tree.leaves(result.best.states)[0].shape == (horizon + 1,)
    assert (result.best_reward_per_tree.shape, result.best_reward_per_tree.dtype) == ((6,), real)
    assert (result.failing_per_tree.shape, result.failing_per_tree.dtype) == ((6,), np.dtype(bool))
    assert all(type(v) is int for v in (result.episodes, result.steps, result.invalid))
    assert type(result.failing_share) is float
    assert result.first_failure is None if name == "ferry" else type(result.first_failure) is int
    history = result.history
    moments = history.simulations.shape[0]
    assert history.simulations[-1] == 180 and (np.diff(history.simulations) > 0).all()
    assert history.best_reward.shape == (moments, 6) and history.failures.shape == (moments,)
    np.testing.assert_array_equal(history.best_reward[-1], result.best_reward_per_tree)
    roots = result.roots
    children = roots.visits.shape[2]
    assert (
        roots.depth.shape
        == roots.valid.shape
        == (
            3,
            6,
        )
    )
    assert roots.visits.shape == roots.q.shape == roots.actions.shape == (3, 6, children)
    assert (
        jax.tree.leaves(roots.starts) == []
        if name == "ferry"
        else roots.starts.shape == (3, 6, children)
    )
    assert all(
        isinstance(leaf, np.ndarray | np.generic | int | float | str)
        for leaf in jax.tree.leaves(result._replace(settings=None))
    )


@pytest.mark.compiled
@pytest.mark.parametrize("name", mark_long(["ferry", "landing", "ring"], "landing", "ring"))
def test_results_are_honest(name):
    honest(once(name), SYSTEMS[name], (S0 if name == "ferry" else dict(reward=BONUS))["reward"])


@pytest.mark.compiled
def test_every_archived_failure_replays_to_the_bit():
    archive = once("ring").failures
    assert archive.size > 10
    for i in range(0, archive.size, 3):
        replays(archive.episode(i), RING, BONUS)


@pytest.mark.slow
def test_every_episode_is_counted_once():
    result = once("ferry")
    assert result.episodes == EPISODES  # no root of S0 comes to an end so early
    assert result.roots.valid.all() and (result.roots.visits[0].sum(1) == 60).all()


@pytest.mark.slow
def test_the_archive_holds_the_best():
    three, many = once("landing", top=3), once("landing")
    assert three.failures.size == 3 and three.failures.seen == many.failures.seen > 64
    np.testing.assert_array_equal(three.failures.episodes.reward, many.failures.episodes.reward[:3])
    np.testing.assert_array_equal(three.failures.episodes.x0, many.failures.episodes.x0[:3])


@pytest.mark.slow
def test_the_first_failure_is_counted_in_the_order_of_simulation():
    result = once("landing")
    n = -(-result.first_failure // 6)  # the trees take turns
    before = np.searchsorted(result.history.simulations, n)
    assert before == 0 or result.history.failures[before - 1] == 0
    assert result.history.failures[result.history.simulations >= n][0] >= 1
    assert result.failures.simulation.min() >= n - 1


def test_settings_say_what_was_asked_and_are_saved_with_the_failures(tmp_path, equal):
    result = once("landing")
    asked = (
        dict(
            method="forest",
            mode="default",
            memoize="node",
            exploration=10.0,
            widening=[2.0, 0.5],
            spread=True,
            focus=1.0,
        )
        | SIZE
    )
    assert json.loads(json.dumps(result.settings)) == result.settings
    assert asked.items() <= result.settings.items()
    F.save(tmp_path / "found.jast", result.failures, result.settings)
    loaded, settings = F.load(tmp_path / "found.jast", LANDING)
    assert settings == result.settings
    equal(loaded, result.failures)


def test_a_result_is_readable():
    found, none = str(once("landing")), str(once("ferry"))
    for text in (found, none):
        assert text.splitlines()[0].split()[:3] == ["method", "episodes", "steps"]
        assert "forest" in text
        assert str(EPISODES) in text
        assert max(map(len, text.splitlines())) < 120
    assert "likeliest failure: reward" in found
    assert "no failure was found; the nearest episode came to distance" in none
    assert "more episodes;\n  the default reward, which ranks any failure above" in none


@pytest.mark.slow
def test_random_starts_are_found():
    """x0 is chosen by the tree: it differs between failures, and the first root's children are
    starts.
    """
    result = once("landing")
    assert np.unique(result.failures.episodes.x0).size > 5
    first = result.roots.visits[0] > 0
    np.testing.assert_allclose(result.roots.starts[0][first].std(), 0.1, rtol=0.5)
    mixed = once("ring")
    assert np.issubdtype(mixed.failures.episodes.x0["hit"].dtype, np.integer)
    assert set(np.unique(mixed.failures.episodes.x0["hit"])) <= {0, 1}
    assert mixed.failures.episodes.disturbances["gust"].shape == (mixed.failures.size, 8, 2)


@pytest.mark.slow
def test_seeds_that_start_an_episode_have_no_place(key):
    """They have no quantile function, and are drawn; the disturbances have places."""
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        start=jast.distributions.seeds,
        step=lambda s, x: s + x,
        disturbance=lambda s: jast.distributions.Normal(0.0, 1.0),
        evaluate=lambda s: (s > 6, jnp.maximum(6 - s, 0.0)),
        horizon=5,
    )
    found = forest(key, sim, trees=2, simulations=200, prunes=2)
    assert found.failures and bool(jast.replay(sim, found.failures[0]).failure)


def test_mcts_is_a_forest_of_one_root(equal):
    size = dict(trees=6, simulations=60, reward=BONUS, widening=(2.0, 0.5))
    one, other = (
        mcts(jax.random.key(0), LANDING, **size),
        forest(jax.random.key(0), LANDING, prunes=1, **size),
    )
    assert one.settings["method"] == "mcts"
    equal(one._replace(settings=None), other._replace(settings=None))


# --- all kinds of systems and actions
# ----------------------------------------------------------------------------


KINDS = dict(
    samples=SYSTEMS,
    quantiles=("landing", "ring", "limit_state", "dice"),
    uniform=("ferry", "ring", "dice"),
)


@pytest.mark.long
@pytest.mark.parametrize(
    ("actions", "name"), [(actions, name) for actions, names in KINDS.items() for name in names]
)
def test_all_actions_search_all_systems(name, actions):
    reward = S0["reward"] if name == "ferry" else BONUS
    if (name, actions) == ("dice", "quantiles"):
        with pytest.raises(ValueError, match="Seeds has no quantile function"):
            searched(name, actions=ACTIONS[actions])
        return
    result = (
        once(name, actions=ACTIONS[actions])
        if actions == "samples"
        else searched(name, actions=ACTIONS[actions])
    )
    honest(result, SYSTEMS[name], reward)
    assert 6 * 60 <= result.episodes <= EPISODES and result.invalid == 0
    if actions == "samples" and name != "ferry":
        assert result.failures.size > 0


@pytest.mark.slow
def test_prunes_beyond_the_horizon_are_left_out():
    result = searched("limit_state")
    assert result.settings["prunes"] == 1 and result.episodes == 6 * 60


def _breaking(s, x):
    return s + jnp.where(s > 1.0, jnp.nan, x)


@pytest.mark.slow
def test_a_simulator_that_returns_nan_is_counted_and_never_best():
    sim = walk(step=_breaking)
    result = forest(jax.random.key(0), sim, **SIZE, reward=BONUS, actions=ACTIONS["samples"])
    assert 0 < result.invalid < result.episodes
    assert np.isfinite(result.best_reward_per_tree).all() and np.isfinite(result.best.reward)
    assert f"{result.invalid} episodes were invalid" in str(result)
    honest(result, sim, BONUS)


@pytest.mark.slow
def test_a_simulator_that_returns_only_nan():
    sim = walk(step=lambda s, x: s * jnp.nan)
    result = forest(jax.random.key(0), sim, **SIZE, reward=BONUS, actions=ACTIONS["samples"])
    assert result.invalid == result.episodes > 0
    assert result.failures.size == 0
    assert not result.best.failure
    np.testing.assert_array_equal(result.best_reward_per_tree, -np.inf)
    assert "no failure was found" in str(result)
    honest(result, sim, BONUS)


def test_a_system_that_never_fails():
    sim = walk(fails=lambda s: s > 1e6)
    result = forest(jax.random.key(0), sim, **SIZE, reward=BONUS, actions=ACTIONS["samples"])
    assert result.failures.size == result.failures.seen == 0
    assert result.first_failure is None
    assert result.failing_share == 0
    assert "no failure was found" in str(result) and "no failure was found" in str(result.failures)
    honest(result, sim, BONUS)


def test_a_system_that_fails_at_its_start_takes_one_episode_a_tree():
    sim = walk(fails=lambda s: s > -1.0)
    result = forest(jax.random.key(0), sim, **SIZE, reward=BONUS, actions=ACTIONS["samples"])
    assert (
        result.episodes,
        result.steps,
        result.first_failure,
        result.failing_share,
    ) == (6, 0, 1, 1.0)
    assert result.best.length == 0
    assert result.failures.size == 1
    assert result.failures.seen == result.failures.counts[0] == 6
    honest(result, sim, BONUS)


def test_a_system_that_always_fails_at_its_first_step():
    sim = walk(step=lambda s, x: jnp.full_like(s, 4.0))
    result = forest(jax.random.key(0), sim, **SIZE, reward=BONUS, actions=ACTIONS["samples"])
    # the next root would be an episode's end
    assert result.episodes == 6 * 60
    assert result.failing_share == 1.0
    assert result.first_failure == 1
    # an end that is visited again is not simulated again
    assert result.steps < result.episodes
    assert (result.failures.episodes.length == 1).all()
    honest(result, sim, BONUS)


@pytest.mark.slow
def test_trees_that_end_early_end_apart():
    """A tree whose root is an episode's end stops; the others go on, also those of other groups."""
    sim = walk(fails=lambda s: s > 2.0)
    result = forest(
        jax.random.key(0),
        sim,
        trees=6,
        prunes=6,
        simulations=60,
        lanes=2,
        **TOLD | dict(reward=BONUS),
    )
    turns = result.roots.valid.sum(0)
    assert turns.min() < turns.max()
    assert result.episodes == 60 * turns.sum()
    honest(result, sim, BONUS)


# --- interruption and input
# ----------------------------------------------------------------------------


@pytest.mark.slow
def test_an_interrupted_search_says_so():
    def stop(done, total, _):
        assert 0 < done <= total == 12 * 18 * 400
        raise KeyboardInterrupt

    result = forest(
        jax.random.key(0),
        FERRY,
        trees=12,
        prunes=18,
        simulations=400,
        lanes=6,
        threads=1,
        **S0,
        callback=stop,
    )
    assert 0 < result.episodes < 12 * 18 * 400
    assert "of 86400 simulations" in result.settings["interrupted"] and "interrupted" in str(result)
    honest(result, FERRY, S0["reward"])
    json.dumps(result.settings)


@pytest.mark.slow
def test_an_error_of_the_callback_ends_the_search_at_once():
    def fail(done, total, _):
        raise RuntimeError("enough")

    began = time.perf_counter()
    with pytest.raises(RuntimeError, match="enough"):
        forest(
            jax.random.key(0),
            FERRY,
            trees=6000,
            prunes=18,
            simulations=400,
            lanes=6,
            threads=1,
            **S0,
            callback=fail,
        )
    assert time.perf_counter() - began < 60  # all of it would take minutes


@pytest.mark.slow
def test_the_callback_is_told_of_every_simulation():
    told = []
    searched("ferry", callback=lambda done, total, _: told.append((done, total)))
    assert told[-1] == (EPISODES, EPISODES) and sorted(told) == told


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("trees", 0),
        ("prunes", -1),
        ("simulations", 0),
        ("simulations", 2.5),
        ("top", 0),
        ("threads", 0),
        ("lanes", 0),
        ("widening", (1.0,)),
        ("widening", 2.0),
        ("widening", (0.0, 0.5)),
        ("widening", (1.0, 1.5)),
        ("widening", (float("nan"), 0.5)),
        ("mode", "published"),
        ("memoize", "leaf"),
        ("trees", True),
        ("focus", 0.0),
        ("focus", -1.0),
    ],
)
def test_bad_input_is_named(name, value):
    with pytest.raises(ValueError, match=f"forest: {name} must .*received"):
        searched("ferry", **{name: value})
    if name != "prunes":
        with pytest.raises(ValueError, match=f"mcts: {name} must .*received"):
            mcts(jax.random.key(0), FERRY, **dict(trees=2, simulations=20) | {name: value})


def test_a_setting_that_mcts_has_not_is_named(key):
    with pytest.raises(TypeError, match=r"mcts\(\) got an unexpected keyword argument 'prunes'"):
        mcts(key, jast.simulators.walk1d(), prunes=3)


def test_a_simulator_that_breaks_its_contract_is_refused():
    with pytest.raises(ValueError, match="^step: "):
        forest(jax.random.key(0), walk(step=lambda s, x: s[None]), **SIZE)
    with pytest.raises(ValueError, match="sim must be a jast.Simulator"):
        forest(jax.random.key(0), lambda s: s, **SIZE)
    with pytest.raises(ValueError, match=r"below 2\*\*24"):
        forest(jax.random.key(0), FERRY, trees=2, prunes=18, simulations=2**20)


# --- tracing
# ----------------------------------------------------------------------------


def test_a_second_simulator_of_a_kind_does_not_recompile(traced):
    once("ferry")
    traced.clear()
    forest(
        jax.random.key(5),
        jast.simulators.ferry(adversary=(17.0, 0.0)),
        **SIZE,
        **S0,
        exploration=5.0,
    )
    assert not {f.__name__ for f in (run._grow, run._prune, run._rebuild)} & set(traced)


@jax.jit
def best_of(key, adversary, exploration):
    return forest(
        key, jast.simulators.ferry(adversary), **SIZE, **S0, exploration=exploration
    ).best_reward_per_tree


@pytest.mark.slow
def test_a_traced_search_is_the_same_search():
    traced = best_of(jax.random.key(3), jnp.array([16.0, 0.0]), 10.0)
    np.testing.assert_allclose(traced, once("ferry").best_reward_per_tree, rtol=1e-4)


@pytest.mark.long
def test_vmap_over_simulators_is_a_loop():
    adversaries = jnp.array([[16.0, 0.0], [17.0, 0.0], [30.0, 10.0]])
    together = jax.vmap(best_of, in_axes=(None, 0, None))(jax.random.key(3), adversaries, 10.0)
    apart = jnp.stack([best_of(jax.random.key(3), adversary, 10.0) for adversary in adversaries])
    np.testing.assert_allclose(together, apart, rtol=1e-4)
    assert (together[2] != together[0]).all()


@pytest.mark.long
def test_vmap_over_a_setting_is_a_loop():
    weights = jnp.array([0.5, 10.0, 40.0])
    together = jax.vmap(best_of, in_axes=(None, None, 0))(
        jax.random.key(3), jnp.array([16.0, 0.0]), weights
    )
    apart = jnp.stack(
        [best_of(jax.random.key(3), jnp.array([16.0, 0.0]), weight) for weight in weights]
    )
    np.testing.assert_allclose(together, apart, rtol=1e-4)
    assert (together[0] != together[1]).any()


@pytest.mark.long
def test_a_traced_result_counts_as_an_eager_one():
    """Also where trees fail; without an archive, and with -1 in place of None."""
    eager = once("landing")
    choices = dict(reward=BONUS, actions=ACTIONS["samples"])
    traced = jax.jit(lambda key: forest(key, LANDING, **SIZE, **choices))(jax.random.key(3))
    assert traced.failures is None and traced.history is None
    assert (traced.episodes, traced.steps, traced.first_failure) == (
        eager.episodes,
        eager.steps,
        eager.first_failure,
    )
    np.testing.assert_allclose(traced.failing_share, eager.failing_share, rtol=1e-6)
    np.testing.assert_array_equal(traced.failing_per_tree, eager.failing_per_tree)
    np.testing.assert_allclose(traced.best.reward, eager.best.reward, rtol=1e-4)
    none = jax.jit(lambda key: forest(key, FERRY, **SIZE, **S0).first_failure)(jax.random.key(3))
    assert none == -1


@pytest.mark.long
def test_float64_within_a_block(x64):
    """Precision that is set for a block of code holds in the search's own threads."""
    choices = dict(
        reward=jast.rewards.standard(event_bonus=30.0, density="mode"),
        actions=jast.actions.uniform(0.0, 1.0),
    )
    ferry = jast.simulators.ferry()
    result = forest(jax.random.key(3), ferry, **SIZE, **choices)
    assert (
        result.best_reward_per_tree.dtype
        == result.best.reward.dtype
        == result.roots.q.dtype
        == np.float64
    )
    honest(result, ferry, choices["reward"])


# --- what it is for
# ----------------------------------------------------------------------------


@pytest.mark.long
def test_a_forest_beats_random_search():
    """At equal budget, on a walk that fails about once in 8000 episodes, a forest over draws of the
    model sees far more failures, and a likelier one.
    """
    sim, reward = (
        jast.simulators.walk1d("one-sided", threshold=12.0),
        jast.rewards.standard(event_bonus=20.0, density="mode"),
    )
    size = dict(trees=10, prunes=8, simulations=150, exploration=3.0)
    result = forest(jax.random.key(1), sim, **size, reward=reward, actions=ACTIONS["samples"])
    random = jax.vmap(lambda key: jast.rollout(key, sim, reward=reward)._replace(states=None))(
        jax.random.split(jax.random.key(101), result.episodes)
    )
    assert result.failing_share > 10 * float(random.failure.mean())
    assert result.best.reward > random.reward.max()


@pytest.mark.parametrize("name", ["ferry", pytest.param("landing", marks=pytest.mark.long)])
def test_the_best_paths_that_do_not_fail(name):
    """One a tree without a failure, by falling reward; they replay to what they say."""
    result = once(name)
    misses, safe = result.misses, ~result.failing_per_tree
    assert len(misses.reward) == safe.sum() and not misses.failure.any()
    np.testing.assert_array_equal(misses.reward, -np.sort(-result.best_reward_per_tree[safe]))
    for i in range(min(2, len(misses.reward))):
        one = jax.tree.map(lambda a, i=i: a[i], misses._replace(states=None))
        again = jast.replay(SYSTEMS[name], one.disturbances, x0=one.x0)
        assert not again.failure and again.distance == pytest.approx(one.distance, rel=1e-5)
    assert len(searched(name, top=1).misses.reward) <= 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("search", "shares"),
    [(forest, ((0.295, 200), (0.298, 2000))), (mcts, ((0.355, 200), (0.405, 1500)))],
)
def test_the_published_failure_rates_on_s0(search, shares):
    """Share of 1000 trees of 9000 simulations that find a collision: MCFS-AP without networks, and
    MCTS-SA. It is compared with the share that the paper prints, of 200 trees, and with that of an
    independent version of the published code. Bounds: 2.5 standard errors of the difference.
    """
    size = dict(prunes=18, simulations=500) if search is forest else dict(simulations=9000)
    result = search(jax.random.key(0), FERRY, trees=1000, mode="paper", **size, **S0)
    # a tree whose root is a collision ends early
    assert 0.999 * 9_000_000 < result.episodes <= 9_000_000
    for share, trees in shares:
        error = np.sqrt(share * (1 - share) * (1 / 1000 + 1 / trees))
        assert abs(result.failing_trees - share) < 2.5 * error
