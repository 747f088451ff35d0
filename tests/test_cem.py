"""The cross-entropy search: it finds what random search does not, for every kind of disturbance,
and its counts, archive and traced runs are honest.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import archive_replays, reward_of
from systems import S0, TOLD, hyperplane, ring, two_densities, walk

import jast
from jast import actions
from jast._src.core import rewards
from jast._src.search.cem import cem
from jast._src.search.monte_carlo import monte_carlo
from jast.distributions import seeds
from jast.failures import collect

SMALL = dict(samples=100, elites=10, iterations=10) | TOLD | dict(actions=actions.quantiles())
WEIGHED = rewards.shaped(20.0, event_bonus=30.0, density="mode")


def lock():
    """Ten seeds, of which each must fall into its own eighth: 2^-30."""

    def step(s, x):
        right = (x >> 29) == (s[1] * 3 % 8).astype(jnp.uint32)
        return s[0] + right.astype(jnp.int32), s[1] + 1

    return jast.Simulator(
        lambda x0: (jnp.int32(0), jnp.int32(0)),
        step,
        lambda s: seeds(),
        lambda s: (s[0] >= 10, (10 - s[0]).astype(float)),
        10,
    )


@pytest.mark.long
def test_finds_a_rare_failure_that_random_search_does_not(key, equal):
    """Phi(-6) = 1e-9, and the likeliest failure is x = 3 everywhere."""
    sim, reward = hyperplane(6.0), rewards.Partial(_distance_first)
    assert not monte_carlo(key, sim, episodes=4000, reward=reward).failing_per_tree.any()
    r = cem(key, sim, **SMALL | dict(reward=reward, samples=200, elites=20, iterations=20))
    assert r.failing_per_tree.all()
    assert r.failures.size == 64
    assert r.settings["actions"] == "actions.quantiles"
    assert archive_replays(sim, r, reward, equal)
    np.testing.assert_allclose(r.best.disturbances[0], 3, atol=0.3)


def _distance_first(log_p, event, distance, terminal, approach):
    return log_p - 20 * distance


@pytest.mark.parametrize(
    "choice",
    [
        actions.uniform(0.0, 1.0),
        pytest.param(actions.quantiles(), marks=pytest.mark.long),
        pytest.param(actions.samples(), marks=pytest.mark.long),
    ],
)
def test_ferry(key, equal, choice):
    """Random search finds no collision in two million episodes."""
    sim = jast.simulators.ferry()
    r = cem(key, sim, trees=4, actions=choice, reward=S0["reward"])
    assert r.failing_per_tree.all()
    assert (r.best_reward_per_tree > 29).all()
    assert r.best.reward < 29.65
    assert r.episodes == 36_000
    assert r.steps <= 36_000 * 21
    assert r.best_reward_per_tree.max() == pytest.approx(r.best.reward, rel=1e-5)
    assert archive_replays(sim, r, S0["reward"], equal)
    assert r.history.best_reward.shape == (30, 4)
    assert (np.diff(r.history.best_reward, axis=0) >= 0).all()
    assert r.history.simulations.tolist() == list(range(300, 9001, 300))
    assert r.history.failures[-1] == r.failures.seen
    assert 1 < r.first_failure <= r.episodes and r.failing_share == r.failures.seen / r.episodes


@pytest.mark.long
@pytest.mark.parametrize("choice", [None, actions.samples(), actions.uniform(0.0, 1.0)])
def test_structured_disturbances_and_a_random_start(key, equal, choice):
    sim = ring()
    r = cem(key, sim, actions=choice, trees=4, refine=0)
    assert archive_replays(sim, r, reward_of(r), equal)
    assert r.failing_per_tree.all()
    assert (
        r.best_reward_per_tree.mean() > monte_carlo(key, sim, episodes=9000, refine=0).best.reward
    )


def test_random_start_of_a_rare_failure(key, equal):
    """P = 4e-13; the likeliest failure starts at .526 and drifts by .047 a step."""
    sim, reward = jast.simulators.landing(), rewards.Partial(_far_from_the_line)
    r = cem(key, sim, reward=reward)
    assert archive_replays(sim, r, reward, equal)
    assert abs(r.best.x0) == pytest.approx(0.526, abs=0.06)
    assert abs(r.best.disturbances).mean() == pytest.approx(0.0474, abs=0.006)


def _far_from_the_line(log_p, event, distance, terminal, approach):
    return log_p - jnp.where(terminal, 100 * distance, 0)


def test_seeds_of_unknown_density(key, equal):
    sim = lock()
    assert not monte_carlo(key, sim, episodes=9000, refine=0).failing_per_tree.any()
    r = cem(key, sim, trees=3, refine=0)
    assert r.failing_per_tree.all() and r.settings["actions"] == "actions.samples"
    assert archive_replays(sim, r, reward_of(r), equal)


def test_trees_are_independent_of_their_number(key, equal):
    few, many = (cem(key, walk(), trees=n, **SMALL) for n in (1, 3))
    np.testing.assert_allclose(few.best_reward_per_tree, many.best_reward_per_tree[:1], rtol=1e-5)
    assert len(set(many.best_reward_per_tree.tolist())) == 3
    assert set(many.failures.tree) <= {
        0,
        1,
        2,
    }


@pytest.mark.slow
def test_counts_of_repetitions(key):
    """One failure only: every time it was found is counted."""
    sim = jast.Simulator(
        lambda x0: jnp.int32(0),
        lambda s, x: x.astype(jnp.int32),
        lambda s: jast.distributions.Categorical(probs=jnp.array([0.9, 0.1])),
        lambda s: (s == 1, (1 - s).astype(float)),
        1,
    )
    r = cem(key, sim, trees=2, **TOLD, samples=50, elites=5, iterations=4)
    assert r.failures.size == 1
    assert r.failures.counts.sum() == r.failures.seen == round(r.failing_share * 400)


@pytest.mark.slow
def test_invalid_episodes_are_counted_and_never_elite(key):
    r = cem(key, walk(step=lambda s, x: jnp.where(x > 1.5, jnp.nan, s + x)), **SMALL)
    assert 0 < r.invalid < 600
    assert np.isfinite(r.best.reward)
    assert np.isfinite(r.failures.episodes.reward).all()
    r = cem(key, walk(step=lambda s, x: s + jnp.nan), trees=2, **SMALL)
    assert r.invalid == r.episodes == r.steps == 2000
    assert r.best.reward == -np.inf
    assert not r.best.failure
    assert (r.best_reward_per_tree == -np.inf).all()
    assert r.failures.size == 0
    assert r.first_failure is None


@pytest.mark.slow
def test_systems_that_never_or_always_fail(key):
    r = cem(key, walk(fails=lambda s: s > 1e9), **SMALL)
    assert (r.failing_share, r.first_failure, r.failures.size, r.steps) == (
        0,
        None,
        0,
        6000,
    )
    r = cem(key, walk(fails=lambda s: s < 1e9), trees=2, **SMALL)  # at the start
    assert (r.failing_share, r.first_failure, r.steps, r.best.length) == (1, 1, 0, 0)
    assert r.failures.size == 1 and r.failures.counts.tolist() == [r.failures.seen] == [2000]


@pytest.mark.slow
def test_under_jit_and_vmap(key):
    betas = jnp.array([3.0, 4.0])
    search = lambda sim, smoothing=0.3: cem(
        key, sim, trees=2, smoothing=smoothing, **SMALL | dict(reward=WEIGHED)
    )
    traced = jax.jit(jax.vmap(lambda b, s: search(hyperplane(b), s)))(betas, jnp.array([0.3, 0.3]))
    for i, b in enumerate(betas):
        r = search(hyperplane(b))
        # the last digit of an episode may decide who is an elite
        np.testing.assert_allclose(
            traced.best_reward_per_tree[i], r.best_reward_per_tree, rtol=2e-2
        )
        assert (traced.episodes[i], traced.steps[i], traced.invalid[i]) == (
            r.episodes,
            r.steps,
            r.invalid,
        )
        assert float(traced.best.reward[i]) == pytest.approx(
            float(traced.best_reward_per_tree[i].max()), rel=1e-5
        )
    assert traced.failures is None
    assert traced.history is None
    assert traced.settings is None
    assert traced.failing_per_tree.shape == (2, 2)


def test_interruption(key, equal):
    def callback(done, total, _):
        assert total == 2000
        if done == 600:
            raise KeyboardInterrupt

    r = cem(key, walk(), trees=2, callback=callback, **SMALL)
    assert r.episodes == 600
    assert r.settings["interrupted"] == "after 600 of 2000 episodes"
    assert len(r.history.failures) == 3
    equal(r.failures, cem(key, walk(), trees=2, **SMALL | dict(iterations=3)).failures)


@pytest.mark.parametrize(
    "settings, message",
    [
        (dict(samples=10, elites=11), "elites must be at most samples, 10, received 11"),
        (dict(iterations=0), "iterations must be a whole number from 1 to 2\\^31 - 1, received 0"),
        (dict(trees=True), "trees must be .* received True"),
        (dict(samples=2**20, trees=2**10), "below 2\\^31"),
        (dict(smoothing=1.5), "smoothing must be a number from 0 to 1, received 1.5"),
        (dict(floor=-1), "floor must be .* received -1"),
    ],
)
def test_bad_settings(key, settings, message):
    with pytest.raises(ValueError, match=message):
        cem(key, walk(), **settings)


def test_bad_simulator(key):
    with pytest.raises(ValueError, match="disturbance: log_prob has shape"):
        cem(key, two_densities())


@pytest.mark.slow
def test_leads_on_from_known_failures(key):
    """Phi(-6) = 1e-9: no draw of the model is near, but a known failure at (4, 4, 4, 4) is."""
    sim, reward = hyperplane(6.0), rewards.Partial(_distance_first)
    one = jast.replay(sim, jnp.full((1, 4), 4.0))._replace(states=None)
    known = collect(sim, reward, jax.tree.map(lambda a: np.asarray(a)[None], one))
    few = SMALL | dict(reward=reward, samples=50, elites=5, iterations=1)
    assert not len(cem(key, sim, **few).failures)
    around = cem(key, sim, **few, failures=known)
    assert len(around.failures) > 10 and around.settings["samples"] == 50
    with pytest.raises(ValueError, match=r"cem: actions must be quantiles\(\) or wide\(\)"):
        cem(key, sim, **few | dict(actions=actions.samples()), failures=known)
    with pytest.raises(ValueError, match="cem: failures must be an archive .* received list"):
        cem(key, sim, **few, failures=[known.best])
