"""Chains on the failures: each width has the distribution that it should have, modes are mixed, and
what is archived replays.
"""

import importlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import archive_replays
from systems import walk

import jast
from benchmarks import stress_systems
from jast import rewards
from jast._src.normal_space import transform
from jast._src.search import chain_moves
from jast._src.search.best_episodes import BestEpisodes, standard_reward
from jast._src.search.chain import chain
from jast.distributions import Normal, seeds

module = importlib.import_module("jast._src.search.chain")
SMALL = dict(episodes=3000, refine=0)
BRANCHES = stress_systems.branches(3.0)


@pytest.mark.long
def test_every_width_has_its_distribution(key):
    """Against plain draws of that width that fail: mean squares, lengths, and the last number that
    decides. The walk fails at any of several steps, so exchanges change how many numbers count.
    """
    sim = walk()
    search = module._Search(key, sim, 10_000, 0.9, 64)
    search.levels, search.chains = 4, 16
    best, d = BestEpisodes.none(sim, 64), transform.dimension(sim)
    nothing = chain_moves.no_points(64, d, np.float32)
    draws = nothing, nothing, nothing, chain_moves.Points(*_drawn(key, sim, 3.0, 64))
    chains, widths = search.first_chains(draws)
    assert widths[0] == 3 and np.isclose(widths[-1], 0.9)
    seen = []
    for i in range(600):
        ends = jnp.int32(64 * 4 * i), jnp.int32(64 * 4 * (i + 1))
        args = search.key, sim, search.reward, best, chains, widths, *ends
        (best, chains), _ = chain_moves.move_chains(*args)
        if i >= 100:
            points = jax.device_get(chains.points)
            seen.append(_numbers(points.z, points.used, d))
    assert (chains.swapped > 0.1).all()
    seen = np.stack(seen)  # [snapshots, 3, levels, chains]
    for level, width in enumerate(np.asarray(widths)):
        z, used, failing, _ = _drawn(key, sim, float(width), 1 << 17)
        truth = _numbers(np.asarray(z), np.asarray(used), d)[:, np.asarray(failing)]
        assert truth.shape[1] > 1000
        here = seen[:, :, level].reshape(20, -1, 3, 16).mean(axis=(1, 3))
        error = np.sqrt(here.var(axis=0, ddof=1) / 20 + truth.var(axis=1) / truth.shape[1])
        np.testing.assert_array_less(np.abs(here.mean(axis=0) - truth.mean(axis=1)), 4.5 * error)


def _drawn(key, sim, width, n):
    shape = n, transform.dimension(sim)
    z = width * jax.random.normal(key, shape, transform.normal_numbers(sim))
    o = transform.outcomes(sim, z)
    return z, o.used, o.failure, o.distance


def _numbers(z, used, d):
    live = np.arange(d) < used[..., None]
    last = np.take_along_axis(z, used[..., None] - 1, -1)[..., 0]
    return np.stack([(np.where(live, z, 0) ** 2).sum(axis=-1), used, last])


def test_finds_all_modes_and_comes_near_the_best(key, equal):
    r = chain(key, BRANCHES, **SMALL, top=2000)
    assert archive_replays(BRANCHES, r, rewards.standard(density="mode"), equal) > 300
    assert -4.6 < r.best.reward <= -4.5
    x = r.failures.episodes.disturbances[:, 0]
    assert len({tuple(signs) for signs in np.sign(x).astype(int)}) == 4
    assert r.settings["widths"][-1] == 0.25 and len(r.settings["accepted"]) == 4
    assert r.episodes == 3000 == r.steps and r.history.simulations[-1] == 3000


@pytest.mark.long
@pytest.mark.parametrize("make", [stress_systems.slips, jast.simulators.landing])
def test_kinds_of_disturbances(key, equal, make):
    """Whole numbers and random starts."""
    sim = make()
    r = chain(key, sim, **SMALL)
    assert r.failing_per_tree.all() and archive_replays(sim, r, standard_reward(sim), equal)


def far(limit, distance):
    """One number has to be beyond ``limit``."""
    return jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: Normal(0.0, 1.0),
        lambda s: (s >= limit, distance(s)),
        2,
    )


@pytest.mark.long
def test_goes_to_failures_that_no_draw_reaches(key):
    """Fourteen deviations away."""
    r = chain(key, far(20.0, lambda s: jnp.maximum(20 - s, 0)), **SMALL)
    assert r.failing
    assert r.first_failure > 5 * 64
    assert -200 < r.best.reward <= -100


@pytest.mark.slow
def test_nan_is_counted_and_never_best(key):
    r = chain(key, far(40.0, lambda s: jnp.where(s > 5, jnp.nan, 40 - s)), **SMALL)
    assert r.invalid
    assert not r.failing
    assert 35 <= r.best.distance < 36
    assert not r.failures.size


@pytest.mark.long
def test_fewer_episodes_than_looks(key):
    r = chain(key, BRANCHES, episodes=10)
    assert r.episodes == 10 and "widths" not in r.settings


@pytest.mark.long
def test_the_same_key_gives_the_same_and_is_interrupted(key, equal):
    a, b = (chain(key, BRANCHES, **SMALL, top=3) for _ in range(2))
    equal(a.failures, b.failures)
    assert len(a.failures) == 3
    seen = []

    def stop(done, total, result):
        seen.append((done, total, result))
        if len(seen) == 9:
            raise KeyboardInterrupt

    r = chain(key, BRANCHES, **SMALL, callback=stop)
    assert seen[0] == (64, 3000, None) and r.episodes == seen[-1][0] < 3000
    assert "interrupted" in r.settings


@pytest.mark.parametrize(
    "bad, words",
    [
        (dict(episodes=0), "chain: episodes must be a whole number"),
        (dict(top=0), "chain: top must be a whole number"),
        (dict(narrowest=1), "chain: narrowest must be a number above 0 and below 1"),
    ],
)
def test_bad_settings(key, bad, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        chain(key, BRANCHES, **bad)


def test_bad_systems(key):
    sim = jast.Simulator(
        lambda x0: jnp.uint32(0),
        lambda s, x: x,
        lambda s: seeds(),
        lambda s: (s == 7, jnp.where(s == 7, 0.0, 1.0)),
        3,
    )
    with pytest.raises(ValueError, match="chain: disturbance: .* has no quantile function"):
        chain(key, sim)
    with pytest.raises(ValueError, match="chain: cannot be traced"):
        jax.jit(lambda key: chain(key, BRANCHES, episodes=10).steps)(key)
