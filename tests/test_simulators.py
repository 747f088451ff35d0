"""Every simulator fits the contract, and its stated truth is re-derived here, by other means than
sampling where there are any.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.tree_util import Partial
from systems import mark_long

import jast
from benchmarks.limit_states import walk_probability
from jast.simulators import (
    autoregression,
    ferry,
    landing,
    landing_probability,
    limit_state,
    pendulum,
    ruin,
    walk1d,
)


def plane(x):
    return 5 - jnp.sum(x) / jnp.sqrt(jnp.asarray(x.size, x.dtype))


def four_branch(x):
    s = jnp.sqrt(jnp.asarray(2, x.dtype))
    bowl, tilt, across = 3 + 0.1 * (x[0] - x[1]) ** 2, (x[0] + x[1]) / s, x[0] - x[1]
    return jnp.minimum(jnp.minimum(bowl - tilt, bowl + tilt), jnp.minimum(across, -across) + 7 / s)


def corner(x):
    return jnp.maximum(3.5 - x[0], 3.5 - x[1])


ALL = {
    "ferry": ferry,
    "walk1d two-sided": walk1d,
    "walk1d one-sided": lambda: walk1d("one-sided"),
    "landing": landing,
    "limit_state": lambda: limit_state(plane, 3),
    "limit_state of 200": lambda: limit_state(plane, 200),
    "pendulum": pendulum,
    "autoregression": autoregression,
    "ruin": ruin,
}
CASES = mark_long(ALL, "walk1d one-sided", "limit_state of 200")


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_contract(name, key):
    sim = ALL[name]()
    assert jast.check(sim) is sim
    found = jast.nominal(key, sim, episodes=1000)
    assert found.invalid == 0
    assert not found.undisturbed.failure
    assert found.rate < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_dtypes(name):
    for enabled, expected in ((False, jnp.float32), (True, jnp.float64)):
        with jax.enable_x64(enabled):
            episode = jast.rollout(jax.random.key(0), ALL[name]())
            leaves = [a for a in jax.tree.leaves(episode) if jnp.issubdtype(a.dtype, jnp.floating)]
            assert all(a.dtype == expected for a in leaves) and episode.length.dtype == jnp.int32


# walk


@pytest.mark.parametrize(
    "form, two_sided, truth",
    [("two-sided", True, 0.1087363323), ("one-sided", False, 9.578759495e-4)],
)
def test_walk_truth(form, two_sided, truth):
    horizon = walk1d(form).horizon
    coarse, fine = (walk_probability(10.0, horizon, two_sided, n) for n in (200, 300))
    assert coarse == pytest.approx(fine, rel=1e-9) and fine == pytest.approx(truth, rel=1e-9)


def test_walk_likeliest_failures():
    raw = jast.replay(walk1d(), jnp.full((7,), 10 / 7 * 1.00001))
    assert bool(raw.failure) and float(raw.log_prob) == pytest.approx(-13.5754, abs=1e-3)
    by_mode = jast.replay(
        walk1d(), jnp.full((30,), 1 / 3 * 1.00001), reward=jast.rewards.standard(density="mode")
    )
    assert bool(by_mode.failure) and float(by_mode.reward) == pytest.approx(-100 / 60, abs=1e-3)


def test_walk_parameters():
    assert walk1d(horizon=5).horizon == 5 and walk1d("one-sided").horizon == 10
    below = jnp.asarray([-6.0, -6.0])
    assert bool(jast.replay(walk1d(), below).failure)
    assert not bool(jast.replay(walk1d("one-sided"), below).failure)
    assert float(jast.replay(walk1d("one-sided"), below).distance) == 10


# landing


def test_landing_truth():
    sd = np.sqrt(0.1**2 + 10 * 0.03**2)
    assert 2 * scipy.stats.norm.sf(1 / sd) == pytest.approx(4.0236721906842e-13, rel=1e-11)
    assert float(landing_probability()) == pytest.approx(4.0236721906842e-13, rel=1e-4)
    with jax.enable_x64(True):
        assert float(landing_probability()) == pytest.approx(4.0236721906842e-13, rel=1e-10)
        # by summing the start and the steps: a convolution on a grid
        x = np.linspace(-2, 2, 4001)
        density = scipy.stats.norm.pdf(x, scale=0.1)
        for _ in range(10):
            density = np.convolve(density, scipy.stats.norm.pdf(x, scale=0.03), mode="same") * (
                x[1] - x[0]
            )
        outside = np.sum(density[np.abs(x) > 0.2]) * (x[1] - x[0])
        assert outside == pytest.approx(float(landing_probability(b=0.2)), abs=3e-3)


def test_landing_likeliest_failure():
    with jax.enable_x64(True):
        x0, x = 0.01 / 0.019, 0.0009 / 0.019
        episode = jast.replay(landing(), jnp.full((10,), x * (1 + 1e-9)), x0=jnp.asarray(x0))
        assert bool(episode.failure)
        assert float(episode.states.x1[-1]) == 10
        assert float(episode.distance) == 0
        expected = scipy.stats.norm.logpdf(x0, scale=0.1) + 10 * scipy.stats.norm.logpdf(
            x, scale=0.03
        )
        assert float(episode.log_prob) == pytest.approx(expected, rel=1e-6)
        mirrored = jast.replay(landing(), -episode.disturbances, x0=-episode.x0)
        assert bool(mirrored.failure) and float(mirrored.log_prob) == float(episode.log_prob)
        passing = jast.replay(
            landing(b=0.2), jnp.asarray([0.3, -0.3] + [0.0] * 8), x0=jnp.asarray(0.0)
        )
        assert not bool(passing.failure) and float(passing.distance) == pytest.approx(0.2)


# limit states


def test_limit_state():
    sim = limit_state(plane, 4)
    hit, miss = jast.replay(sim, jnp.full((1, 4), 2.6)), jast.replay(sim, jnp.full((1, 4), 2.0))
    assert (bool(hit.failure), float(hit.distance), int(hit.length)) == (True, 0.0, 1)
    assert (bool(miss.failure), float(miss.distance)) == (False, 1.0)
    assert float(hit.log_prob) == pytest.approx(scipy.stats.norm.logpdf(2.6) * 4, rel=1e-5)
    # not asked at the origin
    assert not bool(jast.rollout(jax.random.key(0), limit_state(lambda x: x[0] ** 2, 1)).failure)
    assert sim.observe(jnp.zeros(4)).shape == (4,)
    assert limit_state(plane, 200).observe(jnp.zeros(200)).shape == (64,)


def test_limit_state_truths():
    assert scipy.stats.norm.sf(5) == pytest.approx(2.8665157188e-7, rel=1e-10)
    assert scipy.stats.norm.sf(3.5) ** 2 == pytest.approx(5.4116288413e-8, rel=1e-10)
    with jax.enable_x64(True):
        # the hyperplane, with the disturbance tilted onto it: an unbiased estimate with weights
        x = np.random.default_rng(0).normal(size=(20_000, 3)) + 5 / np.sqrt(3)
        fails = np.asarray(
            jax.vmap(lambda v: jast.replay(limit_state(plane, 3), v[None]).failure)(jnp.asarray(x))
        )
        weights = fails * np.exp(-5 / np.sqrt(3) * x.sum(1) + 12.5)
        assert abs(weights.mean() - 2.8665157188e-7) < 4 * weights.std() / np.sqrt(len(x))
        # four branches, by the conditional probability along one axis: a sum over a grid
        grid = np.linspace(-8, 8, 2001)
        cell = (grid[1] - grid[0]) ** 2
        values = jax.jit(
            jax.vmap(jax.vmap(lambda a, b: four_branch(jnp.stack([a, b])), (None, 0)), (0, None))
        )(jnp.asarray(grid), jnp.asarray(grid))
        density = scipy.stats.norm.pdf(grid)[:, None] * scipy.stats.norm.pdf(grid)
        assert np.sum(density * (np.asarray(values) <= 0)) * cell == pytest.approx(
            2.2227950662e-3, rel=2e-3
        )
        corners = jax.vmap(jax.vmap(lambda a, b: corner(jnp.stack([a, b])), (None, 0)), (0, None))(
            jnp.asarray(grid), jnp.asarray(grid)
        )
        assert np.sum(density * (np.asarray(corners) <= 0)) * cell == pytest.approx(
            5.4116288413e-8, rel=0.05
        )


@pytest.mark.slow
def test_limit_state_rate(key):
    found = jast.nominal(key, limit_state(four_branch, 2), episodes=100_000)
    assert abs(found.rate - 2.2227950662e-3) < 4 * np.sqrt(2.2227950662e-3 / 100_000)
    # fails below -2: Phi(-2)
    gaussian = jast.nominal(key, limit_state(lambda x: x[0] + 2, 1), episodes=50_000)
    assert abs(gaussian.rate - 0.0227501319) < 4 * np.sqrt(0.0227501319 / 50_000)


# bad parameters


@pytest.mark.parametrize(
    "bad, match",
    [
        (lambda: ferry(3.0), "ferry: adversary must be two numbers"),
        (lambda: ferry((1.0, 2.0, 3.0)), "ferry: adversary must be two numbers"),
        (lambda: ferry("left"), "ferry: adversary must be two numbers"),
        (lambda: walk1d("both"), "walk1d: form must .*received .both."),
        (lambda: walk1d(sigma=-1.0), "walk1d: sigma must be a positive number, received -1.0"),
        (lambda: walk1d(horizon=0), "horizon must be an int of at least 1, received 0"),
        (lambda: landing(b=0.0), "landing: b must be a positive number, received 0.0"),
        (lambda: landing(sigma_t=jnp.ones(2)), "landing: sigma_t must be a positive number"),
        (lambda: limit_state(plane, 0), "limit_state: dimension must .*received 0"),
        (lambda: limit_state(plane, 2.0), "limit_state: dimension must be an int of at least 1"),
        (lambda: limit_state(5, 2), "limit_state: g must be a function, received 5"),
        (lambda: limit_state(lambda x: x, 2), r"limit_state: g must .*received float..\[2\]"),
        (
            lambda: limit_state(lambda x: x.sum() > 0, 2),
            r"limit_state: g must return a float scalar, received bool\[\]",
        ),
        (
            lambda: limit_state(lambda x: (x.sum(), 1), 2),
            "limit_state: g must return a float scalar, received",
        ),
        (
            lambda: limit_state(lambda x: x["a"], 2),
            "limit_state: g raised TypeError on a vector of 2 numbers",
        ),
    ],
)
def test_bad_parameters(bad, match):
    with pytest.raises(ValueError, match=match):
        bad()


# compilation


def shifted(level, x):
    return level - x[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "first, second",
    [
        (lambda: ferry((16.0, 0.0)), lambda: ferry((17.0, 1.0))),
        (lambda: walk1d(sigma=1.0), lambda: walk1d(sigma=2.0, threshold=3)),
        (lambda: landing(), lambda: landing(b=0.2, sigma_i=0.3)),
        (pendulum, lambda: pendulum(0.2, 0.3, 1.0, 0.5)),
        (autoregression, lambda: autoregression(0.3, 2.0)),
        (ruin, lambda: ruin(0.45)),
        (
            lambda: limit_state(Partial(shifted, jnp.asarray(1.0)), 2),
            lambda: limit_state(Partial(shifted, jnp.asarray(2.0)), 2),
        ),
    ],
    ids=["ferry", "walk1d", "landing", "pendulum", "autoregression", "ruin", "limit_state"],
)
def test_a_second_instance_does_not_recompile(first, second, key):
    chex.clear_trace_counter()  # another case of this test counts as the same function
    play = jax.jit(chex.assert_max_traces(lambda sim: jast.rollout(key, sim), n=1))
    play(first())
    play(second())
    assert jax.tree.structure(first()) == jax.tree.structure(second())
