"""What a search does when it is told nothing: its reward, its scales, its actions.

Any failure ranks above all misses, and neither the unit of a disturbance nor that of the miss
distance changes what is found.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import archive_replays, reward_of
from systems import TOLD, mark_long, ring, walk

import jast
from jast import actions
from jast import distributions as D
from jast._src.core import rewards
from jast._src.search.calibration import calibrate
from jast.search import cem, forest, mcts, monte_carlo

SEARCHES = {
    "cem": lambda key, sim, **of: cem(key, sim, samples=100, elites=10, iterations=8, **of),
    "mcts": lambda key, sim, **of: mcts(key, sim, simulations=600, **of),
    "forest": lambda key, sim, **of: forest(
        key, sim, trees=4, prunes=3, simulations=60, lanes=2, threads=1, **of
    ),
    "monte_carlo": lambda key, sim, **of: monte_carlo(key, sim, episodes=600, **of),
}
LEARNING = ["cem", "mcts", "forest"]


def filter(unit=1.0, metre=1.0, beta=4.0, steps=10):
    """A filter of white noise leaves its band: the likeliest failure costs beta^2 / 2. ``unit``: of
    the noise, ``metre``: of the miss distance.
    """
    limit = beta * np.sqrt(sum(0.9 ** (2 * i) for i in range(steps)))
    return jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda y, x: 0.9 * y + x / jnp.asarray(unit, x.dtype),
        lambda y: D.Normal(jnp.zeros(()), unit),
        lambda y: (y >= limit, metre * jnp.maximum(limit - y, 0)),
        steps,
    )


def latch():
    """Three numbers in a row above a threshold, and nothing that says how near one is."""
    return jast.Simulator(
        lambda x0: jnp.int32(0),
        lambda run, x: jnp.where(x >= 1.9, run + 1, 0),
        lambda run: D.Normal(jnp.zeros(()), 1.0),
        lambda run: (run >= 3, jnp.where(run >= 3, 0.0, 1.0)),
        12,
    )


def test_failures_come_first_then_the_likeliest_then_the_nearest():
    reward = rewards.lexicographic(near=2.0, rare=5.0)
    rng = np.random.default_rng(0)
    log_p, distance = -rng.exponential(30, 200), rng.exponential(3, 200)
    event = rng.random(200) < 0.5
    value = np.array(
        [
            reward(jnp.asarray(p), jnp.asarray(e), jnp.asarray(d), True)
            for p, e, d in zip(log_p, event, distance, strict=True)
        ]
    )
    ranked = np.lexsort((np.where(event, log_p, -distance), event))
    assert (np.diff(value[ranked]) >= 0).all() and (value[event] > 0).all()
    assert (np.abs(value) <= 1).all() and (value[~event] <= 0).all()
    # what the model never does is no failure that counts
    assert reward(jnp.asarray(-jnp.inf), True, jnp.asarray(0.0), True) == -jnp.inf
    raw = rewards.lexicographic(near=2.0, rare=5.0, likely=-3.0, density="raw")
    likelier = [float(raw(jnp.asarray(p), True, jnp.asarray(0.0), True)) for p in (-9.0, -3.0, 9.0)]
    assert likelier == sorted(likelier)
    assert likelier[1] == 1
    assert likelier[2] < 2


def test_the_reward_of_an_episode_is_that_of_its_log_p_and_distance(key):
    reward, sim = rewards.lexicographic(near=2.0, rare=5.0), walk()
    e = jax.vmap(lambda k: jast.rollout(k, sim, reward=reward))(jax.random.split(key, 200))
    cost = (e.disturbances**2).sum(1, where=jnp.arange(6)[None] < e.length[:, None]) / 2
    expected = jnp.where(e.failure, 1 / (1 + cost / 5), -e.distance / (2 + e.distance))
    assert e.failure.any() and not e.failure.all()
    np.testing.assert_allclose(e.reward, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: rewards.lexicographic(near=0.0), "near must be above 0, received 0.0"),
        (lambda: rewards.lexicographic(rare=-1), "rare must be above 0, received -1"),
        (lambda: rewards.lexicographic(density="log"), 'density must be "raw" or "mode"'),
        (lambda: actions.wide(0), "wide: width must be above 0, received 0"),
        (
            lambda: jast.rollout(jax.random.key(0), walk(), reward=rewards.lexicographic()),
            "only a search sets near and rare by itself; here give both",
        ),
    ],
)
def test_bad_settings(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(LEARNING, "mcts", "forest"))
def test_units_change_nothing(key, name):
    """Exactly for powers of two, which lose no digit; up to rounding for others."""
    search = SEARCHES[name]
    plain = search(key, filter())
    scaled = search(key, filter(unit=2.0**-7, metre=2.0**7))
    assert plain.failures.size > 0 and plain.failures.size == scaled.failures.size
    np.testing.assert_array_equal(
        plain.failures.episodes.disturbances, scaled.failures.episodes.disturbances * 2.0**7
    )
    np.testing.assert_array_equal(plain.failures.episodes.reward, scaled.failures.episodes.reward)
    assert (plain.episodes, plain.failing, plain.steps) == (
        scaled.episodes,
        scaled.failing,
        scaled.steps,
    )
    found = search(key, filter(unit=0.01, metre=100.0))
    assert found.settings["reward_settings"]["near"] == pytest.approx(
        plain.settings["reward_settings"]["near"] * 100, rel=1e-4
    )
    np.testing.assert_allclose(found.best.reward, plain.best.reward, rtol=2e-2)
    np.testing.assert_allclose(found.failing, plain.failing, rtol=0.1, atol=5)


def test_the_default_finds_the_likeliest_where_raw_log_p_finds_nothing(key, equal):
    sim = filter(beta=4.5)
    before = cem(key, sim, **TOLD | dict(actions=actions.quantiles()))
    assert before.failures.size == 0
    found = cem(key, sim, refine=0)
    assert archive_replays(sim, found, reward_of(found), equal)
    rare = found.settings["reward_settings"]["rare"]
    assert rare * (1 / found.best.reward - 1) == pytest.approx(4.5**2 / 2, abs=0.1)


@pytest.mark.parametrize("name", mark_long(SEARCHES, *LEARNING))
def test_the_scales_are_the_systems_own(key, name, equal):
    """The same for every key; and the episodes that gave them are counted once."""
    sim, search = filter(beta=2.5), SEARCHES[name]
    a, b = (search(k, sim) for k in jax.random.split(key))
    assert a.settings["reward_settings"] == b.settings["reward_settings"]
    assert a.settings["action_settings"] == b.settings["action_settings"]
    assert archive_replays(sim, a, reward_of(a), equal)
    told = search(key, sim, reward=reward_of(a), actions=_said(a), top=1000)
    bare = search(key, sim, top=1000)
    widen = {"cem": "blind", "monte_carlo": "never"}.get(name, "always")
    own = calibrate(sim, "mode", widen).tally
    if name == "monte_carlo":
        assert bare.episodes == told.episodes == 600
        return
    assert bare.episodes - told.episodes == own.episodes
    assert bare.failing - told.failing == own.failures == (bare.failures.tree == -1).sum()
    assert bare.steps - told.steps == own.steps
    assert bare.failing_share == bare.failing / bare.episodes


def _said(result):
    made = dict(wide=actions.wide, samples=actions.samples)
    return made[result.settings["actions"].split(".")[1]](**result.settings["action_settings"])


@pytest.mark.parametrize("name", ["cem", pytest.param("mcts", marks=pytest.mark.long)])
def test_under_jit_and_vmap(key, name):
    search = SEARCHES[name]
    traced = jax.jit(jax.vmap(lambda k: search(k, filter(beta=2.5))))(jax.random.split(key))
    for i, k in enumerate(jax.random.split(key)):
        own = search(k, filter(beta=2.5))
        assert traced.episodes[i] == own.episodes and traced.failing[i] == own.failing
        assert traced.best.failure[i]
        np.testing.assert_allclose(traced.best.reward[i], own.best.reward, rtol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("mode", ["paper", "thesis"])
def test_published_modes_keep_their_reward(key, mode):
    sim = walk()
    found = mcts(key, sim, simulations=30, mode=mode)
    named = mcts(key, sim, simulations=30, mode=mode, exploration=10.0, **TOLD)
    assert found.settings == named.settings and found.episodes == 30
    assert found.settings["refine"] == 0
    assert found.best.reward == named.best.reward
    assert mcts(key, sim, simulations=30, reward=rewards.STANDARD).settings["exploration"] == 10
    assert mcts(key, sim, simulations=30).settings["exploration"] == 1


@pytest.mark.long
def test_where_nothing_points_to_failures_cem_begins_with_wide_noise(key):
    few = dict(samples=20, elites=4, iterations=1)
    blind, guided = (cem(key, sim, **few) for sim in (latch(), filter()))
    assert blind.settings["action_settings"]["width"] > 1
    assert guided.settings["action_settings"]["width"] == 1


def test_scales_of_systems_that_say_little():
    """No distance, no density, no finite mode, nothing valid."""
    zero = lambda log_p: jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s,
        lambda s: D.seeds(),
        lambda s: (s > 1, jnp.zeros(())),
        2,
    )
    found = calibrate(zero(0), "mode", "never")
    assert (found.near, found.rare, found.likely) == (1, 1, 0)
    broken = walk(step=lambda s, x: s + jnp.nan)
    found = calibrate(broken, "mode", "always")
    assert np.isfinite([found.near, found.rare, found.likely, found.width]).all()
    assert found.tally.invalid == found.tally.episodes


class Unbounded(D.Gamma):
    """Of a shape below 1, with its mode where the density is infinite."""

    def mode(self):
        return jnp.zeros_like(self.rate)


@pytest.mark.slow
@pytest.mark.parametrize("family, density", [(Unbounded, "raw"), (D.Gamma, "mode")])
def test_a_mode_of_infinite_density_is_not_counted_from(family, density, key):
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: family(0.5, 1.0),
        lambda s: (s > 4, jnp.maximum(4 - s, 0)),
        4,
    )
    found = cem(key, sim, samples=50, elites=5, iterations=4)
    assert found.settings["reward_settings"]["density"] == density
    assert found.failures.size and found.invalid == 0
    if density == "mode":
        return
    e = found.failures.episodes
    order = np.argsort(-e.log_prob, kind="stable")
    assert (e.reward[order] == np.sort(e.reward)[::-1]).all()


@pytest.mark.slow
@pytest.mark.parametrize("width", [1.0, 2.5])
def test_wide_draws_and_their_density(key, width):
    wide, keys = actions.wide(width), jax.random.split(key, 4000)
    normal = D.Normal(1.0, 0.5)
    x = jax.vmap(lambda k: wide.draw(k, normal))(keys)
    assert abs(x.mean() - 1) < 4 * 0.5 * width / np.sqrt(4000)
    assert abs(x.std() / (0.5 * width) - 1) < 4 / np.sqrt(8000)
    np.testing.assert_allclose(
        jax.vmap(lambda x: wide.log_prob(x, normal))(x),
        D.Normal(1.0, 0.5 * width).log_prob(x),
        rtol=1e-4,
        atol=1e-4,
    )
    u = jax.vmap(lambda x: wide.locate(x, normal))(x)
    np.testing.assert_allclose(jax.vmap(lambda u: wide.at(u, normal))(u), x, rtol=1e-3, atol=1e-3)
    assert abs(u.mean() - 0.5) < 4 / np.sqrt(12 * 4000)
    # it stays in the support, and reaches its ends
    flat = jax.vmap(lambda k: wide.draw(k, D.Uniform(2.0, 3.0)))(keys)
    assert (flat >= 2).all() and (flat <= 3).all()
    coins = jax.vmap(lambda k: wide.draw(k, D.Bernoulli(probs=0.01)))(keys)
    share = float(jax.scipy.stats.norm.cdf(jax.scipy.stats.norm.ppf(0.01) / width))
    assert abs(coins.mean() - share) < 4 * np.sqrt(share * (1 - share) / 4000)


@pytest.mark.long
def test_structured_disturbances_and_starts_are_widened(key, equal):
    sim = ring()
    found = forest(key, sim, trees=2, prunes=2, simulations=40, threads=1)
    assert found.settings["actions"] == "actions.wide"
    assert archive_replays(sim, found, reward_of(found), equal)
