"""Random search: its counts and rate against a known truth, episodes known by their numbers, an
archive that replays, and traced runs.
"""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import archive_replays, reward_of
from systems import S0, mark_long, ring, two_densities, walk

import jast
from jast import actions
from jast._src.core import rewards
from jast._src.search.lanes import distinct_episodes
from jast._src.search.monte_carlo import monte_carlo
from jast.distributions import Categorical, seeds

# the package has the function by that name
module = importlib.import_module("jast._src.search.monte_carlo")


def lottery():
    """Four draws of seeds; fails where the low bits of all are zero: once in 2^8 episodes."""
    step = lambda s, x: s + (x % 4).astype(jnp.int32)
    return jast.Simulator(
        lambda x0: jnp.int32(0),
        step,
        lambda s: seeds(),
        lambda s: (s == 0, s.astype(float)),
        4,
        episodic=True,
    )


def coins():
    """Six coins that show heads in three of ten; fails at the fourth head."""
    step = lambda s, x: s + x.astype(jnp.int32)
    return jast.Simulator(
        lambda x0: jnp.int32(0),
        step,
        lambda s: Categorical(probs=jnp.array([0.7, 0.3])),
        lambda s: (s >= 4, jnp.maximum(4 - s, 0).astype(float)),
        6,
    )


@pytest.mark.long
def test_rate_of_a_known_system(key, equal):
    sim, n, p = jast.simulators.walk1d(), 40_000, 0.1087363323
    for choice in (actions.samples(), actions.quantiles()):
        r = monte_carlo(key, sim, episodes=n, actions=choice)
        assert abs(r.failing_share - p) < 4 * np.sqrt(p * (1 - p) / n)
        archive_replays(sim, r, reward_of(r), equal)
    assert (r.episodes, r.invalid, r.failures.size) == (
        n,
        0,
        64,
    )
    assert r.failing_per_tree.tolist() == [True]
    assert r.best_reward_per_tree.shape == (1,) and r.history.best_reward.shape[1] == 1
    assert r.history.simulations[-1] == n and r.history.failures[-1] == r.failures.seen
    assert (np.diff(r.history.best_reward[:, 0]) >= 0).all()
    assert r.settings["method"] == "monte_carlo"
    assert r.settings["episodes"] == n
    assert "interrupted" not in r.settings
    assert "likeliest failure" in str(r)


@pytest.mark.slow
def test_counts_are_those_of_the_episodes(key):
    """Steps, failures and the first one, against every episode played by itself."""
    sim, n = walk(), 301  # no multiple of any number of lanes
    r = monte_carlo(key, sim, episodes=n, top=1000, reward=rewards.STANDARD)
    tree = module.tree_keys(key, 1)[0]
    one = jax.jit(
        lambda i: (
            module.play_drawn(
                tree,
                sim,
                rewards.standard(),
                actions.samples(),
                i[None],
                jnp.ones((1,), bool),
                record=True,
            ).episode
        )
    )
    played = [jax.tree.map(lambda a: a[0], one(jnp.int32(i))) for i in range(n)]
    failing = [i for i, e in enumerate(played) if e.failure]
    assert r.episodes == n
    assert r.failures.seen == len(failing)
    assert r.first_failure == failing[0] + 1
    assert r.steps == sum(int(e.length) for e in played)
    assert sorted(r.failures.simulation) == failing and (r.failures.counts == 1).all()
    for i, number in enumerate(r.failures.simulation):
        np.testing.assert_allclose(r.failures.episodes.reward[i], played[number].reward, rtol=1e-5)


def test_episodes_do_not_depend_on_their_number_or_the_lanes(key, equal, monkeypatch):
    sim = walk()
    short, long = (monte_carlo(key, sim, episodes=n, top=400) for n in (500, 700))
    within = long.failures.simulation < 500
    assert sorted(short.failures.simulation) == sorted(long.failures.simulation[within])
    assert short.first_failure == long.first_failure
    equal(jax.tree.map(lambda a: a[within], long.failures.episodes), short.failures.episodes)
    monkeypatch.setattr(module, "LANES", 64)
    chunked = monte_carlo(key, sim, episodes=700, top=400)
    equal(chunked.failures, long.failures)
    assert chunked[4:9][:3] == long[4:9][:3] and len(chunked.history.failures) == 11
    assert chunked.best_reward_per_tree == pytest.approx(long.best_reward_per_tree)


@pytest.mark.parametrize(
    "make", mark_long([ring, coins, lottery, jast.simulators.landing], ring, coins)
)
def test_kinds_of_disturbances(key, equal, make):
    """Joint and integer disturbances, seeds of unknown density, random starts."""
    sim = make()
    r = monte_carlo(key, sim, episodes=3000, refine=0)
    archive_replays(sim, r, reward_of(r), equal)
    assert r.failing_per_tree.any() == (make is not jast.simulators.landing)
    if make is jast.simulators.landing:
        assert r.steps == 30_000
        assert not r.best.failure
        assert r.failures.size == 0
        assert r.first_failure is None
        assert "no failure" in str(r)
    # many repetitions: each distinct failure is kept once, with the times that it was found
    if make is coins:
        assert r.failures.size < 64 and r.failures.counts.sum() == r.failures.seen > 150
        p = sum(c * 0.3**k * 0.7 ** (6 - k) for k, c in ((4, 15), (5, 6), (6, 1)))
        assert abs(r.failing_share - p) < 4 * np.sqrt(p * (1 - p) / 3000)


def test_uniform_actions(key, equal):
    sim = jast.simulators.ferry()
    r = monte_carlo(key, sim, episodes=20_000, **S0)
    assert not r.failing_per_tree.any()
    assert 20.9 < r.steps / r.episodes <= 21
    assert -20 < r.best.reward < -13
    near = jast.Simulator(
        sim.init,
        sim.step,
        sim.disturbance,
        lambda s: (sim.evaluate(s)[0] | (sim.evaluate(s)[1] < 15), sim.evaluate(s)[1]),
        21,
    )
    archive_replays(near, monte_carlo(key, near, episodes=20_000, **S0), S0["reward"], equal)


@pytest.mark.slow
def test_invalid_episodes_are_counted_and_never_best(key):
    sim = walk(step=lambda s, x: jnp.where(x > 1.5, jnp.nan, s + x))
    r = monte_carlo(key, sim, episodes=2000, refine=0)
    assert 0.2 < r.invalid / 2000 < 0.5
    assert np.isfinite(r.best.reward)
    assert r.failing_per_tree.any()
    assert np.isfinite(r.failures.episodes.reward).all() and "invalid" in str(r)
    r = monte_carlo(key, walk(step=lambda s, x: s + jnp.nan), episodes=200)
    assert r.invalid == 200
    assert r.steps == 200
    assert r.best.reward == -np.inf
    assert not r.failing_per_tree.any()
    assert r.failures.size == 0
    assert r.best_reward_per_tree == -np.inf


@pytest.mark.slow
def test_systems_that_never_or_always_fail(key):
    r = monte_carlo(key, walk(fails=lambda s: s > 1e9), episodes=300)
    assert (r.failing_share, r.first_failure, r.failures.size, r.steps) == (
        0,
        None,
        0,
        1800,
    )
    r = monte_carlo(key, walk(fails=lambda s: s < 1e9), episodes=300)  # at the start
    assert (r.failing_share, r.first_failure, r.steps, r.best.length) == (1, 1, 0, 0)
    assert (r.failures.size, r.failures.counts.tolist(), r.failures.seen) == (1, [300], 300)


@pytest.mark.long
def test_under_jit_and_vmap(key):
    thresholds = jnp.array([2.0, 3.0, 50.0])
    search = lambda sim: monte_carlo(key, sim, episodes=1000, refine=0)
    loop = [search(jast.simulators.walk1d(threshold=float(t), horizon=6)) for t in thresholds]
    traced = jax.jit(jax.vmap(lambda t: search(jast.simulators.walk1d(threshold=t, horizon=6))))(
        thresholds
    )
    batch = jax.vmap(lambda t: jast.simulators.walk1d(threshold=t, horizon=6))(thresholds)
    np.testing.assert_allclose(
        jax.vmap(lambda sim: search(sim).best_reward_per_tree)(batch),
        traced.best_reward_per_tree,
        rtol=1e-5,
    )
    for i, r in enumerate(loop):
        np.testing.assert_allclose(
            traced.best_reward_per_tree[i], r.best_reward_per_tree, rtol=1e-5
        )
        np.testing.assert_allclose(
            traced.best.disturbances[i], r.best.disturbances, rtol=1e-4, atol=1e-5
        )
        assert (traced.episodes[i], traced.steps[i], traced.invalid[i]) == (
            r.episodes,
            r.steps,
            r.invalid,
        )
        assert traced.first_failure[i] == (-1 if r.first_failure is None else r.first_failure)
        assert traced.failing_per_tree[i] == r.failing_per_tree
        assert traced.failing_share[i] == pytest.approx(r.failing_share)
    assert traced.failures is None
    assert traced.history is None
    assert traced.settings is None


def test_interruption_and_callback(key, equal, monkeypatch):
    monkeypatch.setattr(module, "LANES", 128)
    seen = []

    def callback(done, total, _):
        seen.append((done, total))
        if done == 256:
            raise KeyboardInterrupt

    r = monte_carlo(key, walk(), episodes=1000, callback=callback)
    assert seen == [(128, 1000), (256, 1000)]
    assert r.episodes == 256
    assert r.settings["interrupted"] == "after 256 of 1000 episodes"
    assert "interrupted: after 256" in str(r)
    equal(r.failures, monte_carlo(key, walk(), episodes=256).failures)


@pytest.mark.slow
def test_progress_bar(key, capsys):
    monte_carlo(key, walk(), episodes=300, progress=True)
    assert "monte_carlo" in capsys.readouterr().err


def test_plain_functions_and_old_keys(key):
    r = monte_carlo(
        jax.random.PRNGKey(3),
        walk(),
        episodes=200,
        reward=lambda log_p, event, distance, terminal, approach: -distance,
    )
    assert r.settings["seed"] == [0, 3] and r.best.reward <= 0


@pytest.mark.parametrize(
    "settings, message",
    [
        (dict(episodes=0), "episodes must be a whole number from 1 to 2\\^31 - 1, received 0"),
        (dict(episodes=2.5), "episodes must be .* received 2.5"),
        (dict(top=0), "top must be .* received 0"),
        (dict(actions=actions.uniform(0.0, jnp.zeros(3))), "uniform"),
        (dict(actions=3), "actions: expected one of jast.actions, received 3"),
    ],
)
def test_bad_settings(key, settings, message):
    with pytest.raises(ValueError, match=message):
        monte_carlo(key, walk(), **settings)


def test_bad_simulator(key):
    with pytest.raises(ValueError, match="disturbance: log_prob has shape"):
        monte_carlo(key, two_densities())


def test_best_distinct_episodes():
    reward = jnp.array([1.0, 3.0, 3.0, jnp.nan, 2.0, 3.0, -jnp.inf, 5.0])
    tag = jnp.array([0, 7, 7, 0, 0, 8, 0, 0], jnp.uint32)
    failure = jnp.array([1, 1, 1, 1, 1, 1, 1, 0], bool)
    number = jnp.array([0, 12, 11, 13, 14, 15, 16, 17], jnp.int32)
    places, counts = distinct_episodes(failure, reward, tag, number, jnp.ones(8, jnp.int32), 7)
    assert places.tolist() == [2, 5, 4, 0, 7, 8, 8] and counts.tolist() == [2, 1, 1, 1, 1, 0, 0]


@pytest.mark.slow
def test_the_best_is_a_failure_whatever_a_miss_is_worth(monkeypatch):
    """Of any block of lanes, and of those of one worth the first."""
    monkeypatch.setattr(module, "LANES", 128)
    rare = walk(fails=lambda s: s > 7.5)
    miss_first = lambda log_p, event, distance, terminal, approach: jnp.where(event, -5.0, 5.0)
    r = monte_carlo(jax.random.key(0), rare, episodes=2000, reward=miss_first)
    assert r.first_failure > 128 and r.failures.seen > 1  # not in the first block
    assert r.best.failure
    first = int(np.argmin(r.failures.simulation))
    assert r.failures.simulation[first] == r.first_failure - 1
    np.testing.assert_array_equal(r.best.disturbances, r.failures.episodes.disturbances[first])
    assert r.best_reward_per_tree == r.best.reward
    traced = jax.jit(lambda k: monte_carlo(k, rare, episodes=2000, reward=miss_first))
    again = traced(jax.random.key(0))
    assert again.best.failure and again.best_reward_per_tree == r.best.reward
    np.testing.assert_array_equal(again.best.disturbances, r.best.disturbances)


def test_too_many_steps_for_a_transformation(key):
    count = lambda key: monte_carlo(key, walk(), episodes=2**31 // walk().horizon + 1).episodes
    with pytest.raises(ValueError, match="episodes times the horizon must be below 2\\^31"):
        jax.eval_shape(count, key)
