"""Simulators made to have their failure probability estimated, and the limit states of the
benchmarks: each truth is derived again by other means.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from systems import mark_long

import jast
from benchmarks import limit_states
from benchmarks.limit_states import autoregression_probability
from jast._src.simulators.pendulum import PendulumState
from jast.simulators import autoregression, pendulum, ruin, ruin_probability

ALL = {"pendulum": pendulum, "autoregression": autoregression, "ruin": ruin}
# parameters unlike the defaults, by position
LIKE_NUMBERS = {"pendulum": (0.2, 0.3, 1.0, 0.5), "autoregression": (0.3, 2.0), "ruin": (0.45,)}


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(ALL, "autoregression"))
def test_sweep_and_gradient(name, key):
    """A batch of parameters gives the episodes of each, and every gradient is finite, after the end
    of an episode too.
    """
    make = ALL[name]
    batch = [jnp.asarray([0.9, 1.0]) * p for p in LIKE_NUMBERS[name]]
    swept = jax.vmap(lambda *p: jast.rollout(key, make(*p)))(*batch)
    one = jast.rollout(key, make(*(b[1] for b in batch)))
    assert float(swept.log_prob[1]) == pytest.approx(float(one.log_prob), rel=1e-4)
    assert int(swept.length[1]) == int(one.length)

    def score(p, key):
        episode = jast.rollout(key, make(*p))
        return episode.log_prob + episode.distance

    gradient = jax.jit(jax.vmap(jax.grad(score), (None, 0)))(
        [b[1] for b in batch], jax.random.split(key, 50)
    )
    assert all(bool(jnp.all(jnp.isfinite(g))) and bool(jnp.any(g != 0)) for g in gradient)


@pytest.mark.parametrize(
    "bad, match",
    [
        (lambda: pendulum(noise=0.0), "pendulum: noise must be a positive number, received 0.0"),
        (lambda: pendulum(limit=np.ones(2)), "pendulum: limit must be a positive number"),
        (lambda: autoregression(rate=-0.1), "autoregression: rate must .*received -0.1"),
        (lambda: autoregression(horizon=0), "horizon must be an int of at least 1, received 0"),
        (lambda: ruin(up=1.0), "ruin: up must be a number between 0 and 1, received 1.0"),
        (lambda: ruin(start=0), "ruin: start must be a whole number of at least 1, received 0"),
        (lambda: ruin(start=3, goal=3), "ruin: goal must be above start = 3, received 3"),
        (
            lambda: ruin_probability(0.4, 5, 3),
            "ruin_probability: goal must be above start = 5, received 3",
        ),
        (
            lambda: ruin_probability(0.4, 0, 3, horizon=10),
            "ruin_probability: start must be a whole number of at least 1",
        ),
        (
            lambda: ruin_probability(up="even"),
            "ruin_probability: up must be a number between 0 and 1",
        ),
    ],
)
def test_bad_parameters(bad, match):
    with pytest.raises(ValueError, match=match):
        bad()


# pendulum


def in_numpy(rng, episodes):
    theta, omega = rng.normal(0, np.pi / 32, episodes), rng.normal(0, 0.5, episodes)
    failed = np.abs(theta) >= np.pi / 4
    for _ in range(40):
        seen = rng.normal([theta, omega], 0.1)
        omega = omega + 0.05 * (
            15 * np.sin(theta) + 3 * np.clip(-15 * seen[0] - 8 * seen[1], -2, 2)
        )
        theta, omega = theta + 0.05 * omega, np.clip(omega, -8, 8)
        failed |= np.abs(theta) >= np.pi / 4
    return failed


@pytest.mark.long
def test_pendulum_truth(key):
    n, truth = 100_000, 8.169e-3
    error = np.sqrt(truth / n)
    found = jast.nominal(key, pendulum(), n)
    assert abs(found.rate - truth) < 4 * error
    assert not found.undisturbed.failure
    assert found.invalid == 0
    assert abs(in_numpy(np.random.default_rng(0), n).mean() - truth) < 4 * error


def test_pendulum_step():
    with jax.enable_x64(True):
        s = pendulum().step(
            PendulumState(jnp.asarray(0.3), jnp.asarray(7.99)), jnp.asarray([0.1, -0.2])
        )  # torque at its bound
        omega = 7.99 + 0.05 * (15 * np.sin(0.3) - 6)
        assert float(s.theta) == pytest.approx(0.3 + 0.05 * omega, rel=1e-12)
        assert float(s.omega) == pytest.approx(min(omega, 8), rel=1e-12)
        fast = pendulum().step(
            PendulumState(jnp.asarray(0.7), jnp.asarray(7.99)), jnp.asarray([-2.0, -2.0])
        )
        # moved before its speed was cut
        assert float(fast.omega) == 8 and float(fast.theta) > 0.7 + 0.05 * 8
    start = jast.replay(pendulum(), jnp.zeros((1, 2)), x0=jnp.asarray([-0.8, 0.0]))
    assert bool(start.failure)
    assert int(start.length) == 0
    assert float(start.distance) == 0


# autoregression


@pytest.mark.slow
def test_autoregression_truth(key):
    coarse, fine = (autoregression_probability(0.1, 5.0, 100, n) for n in (150, 220))
    assert coarse == pytest.approx(fine, rel=1e-9)
    assert fine == pytest.approx(1.7438880336e-5, rel=1e-9)
    p, n = autoregression_probability(0.2, 2.5, 100), 20_000
    assert abs(jast.nominal(key, autoregression(0.2, 2.5), n).rate - p) < 4 * np.sqrt(
        p * (1 - p) / n
    )


# ruin


@pytest.mark.slow
def test_ruin_truth(key):
    step = np.diag(np.full(30, 0.4), 1) + np.diag(np.full(30, 0.6), -1)
    step[0], step[30] = np.eye(31)[0], np.eye(31)[30]
    within = np.linalg.matrix_power(step, 371)[1, 30]
    assert within == pytest.approx(2.6049921451e-6, rel=1e-9)
    closed = (1.5 - 1) / (1.5**30 - 1)
    assert closed == pytest.approx(2.6075611241e-6, rel=1e-9) and 0 < 1 - within / closed < 1e-3
    # the default is the shortest
    assert np.linalg.matrix_power(step, 369)[1, 30] < (1 - 1e-3) * closed
    with jax.enable_x64(True):
        assert float(ruin_probability()) == pytest.approx(closed, rel=1e-12)
        assert float(ruin_probability(horizon=371)) == pytest.approx(within, rel=1e-10)
        fair, good = jax.jit(jax.vmap(lambda up: ruin_probability(up, 3, 12)))(
            jnp.asarray([0.5, 0.6])
        )
        assert float(fair) == 0.25
        assert float(good) == pytest.approx(((2 / 3) ** 3 - 1) / ((2 / 3) ** 12 - 1), rel=1e-12)
    # 1e-70: nothing overflows to NaN
    assert float(jax.jit(ruin_probability, static_argnums=(1, 2))(jnp.float32(0.3), 10, 200)) == 0
    p, n = float(ruin_probability(0.45, 2, 6, horizon=30)), 20_000
    assert abs(jast.nominal(key, ruin(0.45, 2, 6, horizon=30), n).rate - p) < 4 * np.sqrt(
        p * (1 - p) / n
    )


def test_ruin_ends():
    won = jast.replay(ruin(goal=3), jnp.asarray([1, 1], jnp.int32))
    assert (bool(won.failure), int(won.length), float(won.distance)) == (True, 2, 0.0)
    assert float(won.log_prob) == pytest.approx(2 * np.log(0.4), rel=1e-6)
    lost = jast.replay(ruin(), jnp.asarray([1, 0, 0, 1], jnp.int32))
    assert (bool(lost.failure), int(lost.length), float(lost.distance)) == (False, 3, 28.0)
    assert lost.disturbances.dtype == jnp.int32


# the limit states of the benchmarks


def test_fixed_truths():
    l = limit_states
    truth = {c.name: c.truth for c in l.cases()}
    assert truth["four-branch"] == pytest.approx(l.four_branch_probability(7.0, 3.0), rel=1e-9)
    assert truth["walk1d one-sided"] == pytest.approx(l.walk_probability(10.0, 10, False), rel=1e-8)
    assert truth["walk1d two-sided"] == pytest.approx(l.walk_probability(10.0, 30, True), rel=1e-8)
    assert truth["autoregression"] == pytest.approx(
        l.autoregression_probability(0.1, 5.0, 100), rel=1e-8
    )
    assert truth["ruin"] == pytest.approx(l.ruin_probability(0.4, 1, 30, 371), rel=1e-9)
    a, beta, slope = l.LIMITS["landing, static"].parameters
    assert (
        truth["landing, static"]
        == truth["landing"]
        == pytest.approx(scipy.stats.norm.sf(beta).sum(), rel=1e-9)
    )
    x = np.random.default_rng(0).normal(size=(5, 11))
    np.testing.assert_allclose(
        l.LIMITS["landing, static"].batch(x),
        1 - np.abs(0.1 * x[:, 0] + 0.03 * x[:, 1:].sum(1)),
        rtol=1e-12,
    )


def test_curved_truths_by_closed_forms():
    l, chi2 = limit_states, scipy.stats.chi2
    assert l.sphere_probability(0.0, 6.0, 1, 5) == pytest.approx(chi2.sf(36, 5), rel=1e-9)
    assert l.sphere_probability(0.0, 1.0, -1, 5) == pytest.approx(chi2.cdf(1, 5), rel=1e-9)
    assert l.sphere_probability(3.0, 2.0, -1, 2) == pytest.approx(
        scipy.stats.ncx2.cdf(4, 2, 9), rel=1e-6
    )
    assert l.parabola_probability(4.0, 0.0, 3) == pytest.approx(scipy.stats.norm.sf(4), rel=1e-9)
    # far out, the curvature's factor of second-order reliability (Breitung)
    assert l.parabola_probability(8.0, 0.05, 2) == pytest.approx(
        scipy.stats.norm.sf(8) / (1 + 2 * 0.05 * 8), rel=0.02
    )


@pytest.mark.slow
@pytest.mark.parametrize("family", limit_states.FAMILIES)
def test_family(family):
    drawn = [limit_states.draw(family, seed) for seed in range(4)]
    assert all(0.99e-12 < c.truth < 1.1e-2 for c in drawn) and len({c.truth for c in drawn}) == 4
    again = limit_states.draw(family, 0)
    assert again.truth == drawn[0].truth
    assert jax.tree.structure(again.simulator) == jax.tree.structure(drawn[0].simulator)
    shapes = lambda sim: (jax.tree.structure(sim), *(a.shape for a in jax.tree.leaves(sim)))
    assert len({shapes(limit_states.draw(family, seed).simulator) for seed in range(12)}) <= 8
    limit = limit_states.limit(family, 0)
    if isinstance(limit, limit_states.Limit):
        assert all(abs(score) < 4.5 for score in limit_states.check(family, 0, n=50_000))
        x = np.random.default_rng(0).normal(size=limit.dimension)  # the same in both libraries
        distance = limit.simulator().evaluate(jnp.asarray(x))[1]
        assert float(distance) == pytest.approx(
            max(float(limit.batch(x[None])[0]), 0), rel=1e-3, abs=1e-4
        )
