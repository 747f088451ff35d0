"""Failure probabilities from few calls: the surrogate against closed forms, its points of the
model, and the estimate of slow systems.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.tree_util import Partial

import jast
from benchmarks.few_calls import metaballs, signed
from jast import distributions as D
from jast._src.estimate.few_calls import active_learning, few_calls, surrogate, surrogate_pool
from jast._src.util.intervals import clopper_pearson
from jast.distributions import MultivariateNormalDiag
from jast.estimate import failure_probability
from jast.simulators import limit_state
from tests.blackboxes import branches

norm = scipy.stats.norm


@pytest.fixture
def coarse(monkeypatch):
    """Fewer points of the surrogate: a second for 50 calls."""
    monkeypatch.setattr(few_calls, "POINTS", 20_000)
    for room in (few_calls, active_learning):
        monkeypatch.setattr(room, "CANDIDATES", 1000)
    for name, value in (("POPULATION", 200), ("SAMPLE", 1000), ("FITTED", 300)):
        monkeypatch.setattr(surrogate_pool, name, value)


def _plane(beta, x):
    return beta - jnp.sum(x) / x.shape[0] ** 0.5


def _data(n=40, d=3, seed=0):
    z = np.random.default_rng(seed).standard_normal((n, d)) * 1.5
    g = 1.0 - z[:, 0] + 0.1 * z[:, 1] ** 2
    return z, np.maximum(g, 0), g <= 0


def test_the_surrogate_knows_a_linear_limit_state_from_its_safe_side():
    z, _, _ = _data()
    g = 1.0 - z[:, 0]
    s = surrogate.fit(z, np.maximum(g, 0), g <= 0)
    new = np.random.default_rng(1).standard_normal((200, 3)) * 2
    mean, sd = surrogate.predict(s, new)
    truth = (1.0 - new[:, 0]) / g[g > 0].std()
    assert np.abs(mean - truth).max() < 0.1 and sd.max() < 0.2
    assert (surrogate_pool.expected(s, new)[0] > 0.5).tolist() == (truth < 0).tolist()


def test_the_surrogate_knows_how_deep_failures_are_where_they_say_it():
    """The plane again, whose failures are values: it is known beyond the boundary as before it."""
    z, _, _ = _data()
    g = 1.0 - z[:, 0]
    s = surrogate.fit(z, g, np.zeros(len(z), bool))
    deep = np.random.default_rng(1).standard_normal((200, 3)) + [3, 0, 0]
    mean, sd = surrogate.predict(s, deep)
    assert np.abs(mean * g.std() - (1.0 - deep[:, 0])).max() < 0.05
    clamped = surrogate.fit(z, np.maximum(g, 0), g <= 0)
    assert sd.mean() * g.std() < surrogate.predict(clamped, deep)[1].mean() * g[g > 0].std()


def test_a_warp_is_odd_about_the_boundary():
    """Turned about, a plane through the origin stays the same plane."""
    z, _, _ = _data()
    none = np.zeros(len(z), bool)
    here, there = (surrogate.fit(sign * z, -z[:, 0] * sign, none, warp=0.3) for sign in (1, -1))
    np.testing.assert_allclose(here.evidence, there.evidence, rtol=1e-6)


@pytest.mark.parametrize(
    "distance, depths",
    [
        ([0.5, -1.0, -0.2, -1.0, -0.3, 0.0, 0.0, 0.5], [2, 4]),
        ([0.5, -1.0, 0.7, 0.0], []),  # may be what every failure says
        ([0.5, -0.1, -0.1, -0.4], [1, 2, 3]),  # a point that was drawn twice
    ],
)
def test_what_every_failure_says_alike_is_no_depth(distance, depths):
    z = np.arange(len(distance))[:, None]
    if len(depths) == 3:
        z[2] = z[1]
    found = active_learning._depths(z, np.array(distance))
    assert np.flatnonzero(found).tolist() == depths


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_constant_of_every_failure_is_as_good_as_none(seed, coarse):
    """-1 for each failure, or 0: the same answer."""

    def curved(x):
        return 3.8 - x[0] + 0.1 * x[1] ** 2

    def judged(constant):
        evaluate = lambda x: (curved(x) <= 0, jnp.where(curved(x) <= 0, constant, curved(x)))
        return dataclasses.replace(limit_state(curved, 2), evaluate=evaluate)

    found = [failure_probability(jax.random.key(seed), judged(c), 60) for c in (-1.0, 0.0)]
    assert found[0].mean == found[1].mean and found[0].interval == found[1].interval


@pytest.mark.slow
def test_a_signed_distance_tells_more(coarse):
    """60 calls of a curved boundary, three keys: the standard errors are smaller where the distance
    goes on below 0.
    """

    def curved(x):
        return 3.5 - x[0] + 0.1 * x[1] ** 2 - 0.05 * x[2] ** 3

    errors = [
        np.mean([failure_probability(jax.random.key(k), sim, 60).relative_error for k in range(3)])
        for sim in (limit_state(curved, 3), signed(curved, 3))
    ]
    assert errors[1] < errors[0] / 1.5


def test_depth_is_asked_of_what_is_judged_at_its_end_alone(key, coarse):
    """An episode of several steps ends where it fails, so its depth is that of one step."""

    def system(judge):
        return jast.Simulator(
            init=lambda x0: jnp.zeros(()),
            step=lambda s, x: s + x,
            disturbance=lambda s: D.Normal(0.0, 1.0),
            evaluate=lambda s: (s >= 2.0, judge(2.0 - s)),
            horizon=3,
        )

    deep, clamped = (
        failure_probability(key, system(judge), 50) for judge in (lambda d: d, jax.nn.relu)
    )
    assert deep.mean == clamped.mean and deep.relative_error == clamped.relative_error


def test_the_gradient_of_the_likelihood_is_that_of_its_differences():
    z, y, failing = _data()
    logs = np.array([0.3, -1.0, -4.0, -0.5, -0.9, -1.2])
    extra = np.linspace(0.1, 2.0, len(z))
    value = lambda logs: surrogate._likelihood(z, y, extra, failing, logs)
    step = 1e-5 * np.eye(6)
    by_differences = [(value(logs + e)[0] - value(logs - e)[0]) / 2e-5 for e in step]
    np.testing.assert_allclose(value(logs)[1], by_differences, rtol=1e-4, atol=1e-5)


def test_what_two_coordinates_do_together_becomes_an_axis():
    """A wave across the diagonal of the first two of four coordinates: after two turns an axis lies
    along it, the wave's length is read off that axis alone, and errors are a third or less.
    """
    across = np.array([1.0, -1.0, 0.0, 0.0]) / np.sqrt(2)
    wave = lambda z: 4.0 + np.sin(1.5 * z @ across) + 0.2 * z[:, 2]
    rng = np.random.default_rng(0)
    z, new, none = rng.standard_normal((80, 4)), rng.standard_normal((400, 4)), np.zeros(80, bool)
    straight = fitted = surrogate.fit(z, wave(z), none)
    for _ in range(2):
        straight = surrogate.fit(z, wave(z), none, straight)
        fitted = surrogate.fit(z, wave(z), none, surrogate.turned(fitted))
    shortest = fitted.axes[np.argmax(fitted.logs[3:])]
    assert abs(shortest @ across) > 0.99
    assert fitted.evidence > straight.evidence + 20
    truth = wave(new) / wave(z).std()
    errors = [np.abs(surrogate.predict(s, new)[0] - truth).mean() for s in (straight, fitted)]
    assert errors[1] < errors[0] / 3


def test_axes_say_nothing_where_all_lengthscales_are_equal():
    """A process that is the same in all directions is the same along other axes."""
    z, y, failing = _data()
    z, y = z[~failing], y[~failing]
    data = z, y, np.zeros(len(z), bool)
    s = surrogate.fit(*data)
    s = surrogate.fit(*data, s._replace(logs=np.r_[s.logs[:3], [-0.5] * 3]), rounds=0)
    other = surrogate.turned(s)
    assert np.abs(other.axes - np.eye(3)).max() > 0.1
    np.testing.assert_allclose(other.axes @ other.axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(other.logs, s.logs, atol=1e-12)
    other = surrogate.fit(*data, other, rounds=0)
    new = np.random.default_rng(1).standard_normal((50, 3))
    for a, b in zip(surrogate.predict(s, new), surrogate.predict(other, new), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    a, b = (surrogate.posterior_covariance(each, new) for each in (s, other))
    np.testing.assert_allclose(a, b, atol=1e-6)
    sd = surrogate.predict(s, new)[1]
    np.testing.assert_allclose(np.sqrt(np.diagonal(a)), sd, rtol=1e-6)


@pytest.mark.parametrize("n, d", [(9, 1), (1, 3), (2, 3)])
def test_few_points_and_one_coordinate_have_axes(n, d):
    """Of one point no slope varies: its axes are the coordinates."""
    z = np.random.default_rng(0).standard_normal((n, d))
    s = surrogate.turned(surrogate.fit(z, 2.0 + z[:, 0] ** 2, np.zeros(n, bool)))
    np.testing.assert_allclose(s.axes @ s.axes.T, np.eye(d), atol=1e-12)
    np.testing.assert_allclose(s.points, z @ s.axes.T, atol=1e-12)
    if n == 1 or d == 1:
        np.testing.assert_allclose(np.abs(s.axes), np.eye(d))


def test_a_system_that_is_mostly_invalid_is_answered_with_few_calls(coarse):
    """Nine tenths are NaN: with key 2 one call of the initial design is valid, or few are."""
    g = lambda x: jnp.where(x[0] <= 1.28, jnp.nan, 3.0 - x[1])
    found = failure_probability(jax.random.key(2), limit_state(Partial(g), 3), 60)
    assert found.invalid > 0 and not found.reliable


def test_the_sites_of_one_failure_match_the_moments_of_a_half_normal():
    k, failing = np.array([[4.0]]), np.array([True])
    tau, nu = surrogate._fit_sites(k, np.array([1e-6]), np.zeros(1), failing, 0.0)
    variance = 1 / (1 / 4 + tau[0])
    assert variance == pytest.approx(4 * (1 - 2 / np.pi), rel=0.05)
    assert variance * nu[0] == pytest.approx(-2 * np.sqrt(2 / np.pi), rel=0.05)
    assert surrogate._evidence(k, tau, nu, failing, 0.0) == pytest.approx(np.log(0.5), rel=0.05)


def test_points_of_the_pool_weigh_as_the_model_does(coarse):
    z, y, failing = _data()
    s = surrogate.fit(z, y, failing)
    rng = np.random.default_rng(2)
    found, _ = surrogate_pool.pool(rng, s, z[failing], None, 20_000)
    w = found.weights * (found.z[:, 0] > 1.5)
    error = w.std() / np.sqrt(len(w))
    assert abs(w.mean() - norm.sf(1.5)) < 4 * error < 0.2 * norm.sf(1.5)


@pytest.mark.slow
def test_fifty_calls_find_a_hyperplane_in_ten_dimensions(dtype, coarse):
    sim = limit_state(Partial(_plane, jnp.asarray(4.5)), 10)
    r = failure_probability(jax.random.key(0), sim, 50)
    truth = norm.sf(4.5)
    assert abs(r.mean / truth - 1) < 4 * r.relative_error < 0.4
    assert r.reliable
    assert r.evaluations == 50
    assert r.samples == 50 - 32
    assert 0 < r.failing
    assert r.proposal.means.dtype == dtype and "learning: 32 calls" in r.history[0]
    assert r.settings["budget"] == 50 and "50 evaluations" in str(r)
    assert r.unseen == pytest.approx(-np.log(0.05) / 6) and "unseen" in str(r)


@pytest.mark.slow
def test_a_key_gives_one_answer_and_another_budget_spends_all(coarse):
    sim = limit_state(Partial(_plane, jnp.asarray(3.0)), 2)
    a, b = (failure_probability(jax.random.key(0), sim, 53) for _ in range(2))
    assert a.log_mean == b.log_mean
    assert a.history == b.history
    assert a.evaluations == 53


@pytest.mark.slow
def test_a_black_box_with_workers_is_called_as_often_as_said(coarse):
    noise = MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2))
    sim = jast.blackbox.from_python(branches, horizon=1, disturbance=noise, workers=2)
    seen = []
    tell = lambda done, total, result: seen.append((done, total, result))
    r = failure_probability(jax.random.key(0), sim, 60, callback=tell)
    assert jast.blackbox.calls(sim).rows == r.evaluations == 60
    assert seen[-1] == (60, 60, None) and len(seen) > 10
    assert not r.reliable or abs(r.mean / 2.2228e-3 - 1) < 4 * r.relative_error


def test_far_modes_end_right_or_flagged(coarse):
    r = failure_probability(jax.random.key(0), limit_state(metaballs, 2), 60)
    assert not r.reliable or abs(r.mean / 1.128e-5 - 1) < 4 * r.relative_error


def test_a_system_that_never_fails_has_an_upper_bound(coarse):
    r = failure_probability(jax.random.key(0), limit_state(lambda x: 3.0 + jnp.sum(x**2), 2), 60)
    n = r.samples
    assert not r.reliable
    assert np.isnan(r.mean)
    assert n == 60 - 36
    assert r.interval == r.guaranteed == clopper_pearson(0, n) and r.evaluations == 60
    assert f"no failure in {n} episodes" in r.warnings[0]


def test_invalid_episodes_are_counted_and_teach_nothing(coarse):
    g = lambda x: jnp.where(x[1] > 0.6, jnp.nan, 2.5 - x[0])
    r = failure_probability(jax.random.key(0), limit_state(g, 2), 60)
    assert 0 < r.invalid < 36 and "episodes are invalid" in str(r)
    assert 0 < r.plain[1] <= r.invalid and r.guaranteed[1] > r.plain[1] / r.plain[2]
    truth = norm.sf(2.5) * norm.cdf(0.6)
    assert not r.reliable or abs(r.mean / truth - 1) < 4 * r.relative_error


@pytest.mark.slow
def test_known_failures_join_what_is_learned_and_cost_no_call(coarse):
    sim = limit_state(Partial(_plane, jnp.asarray(3.0)), 2)
    known = np.array([[2.2, 2.2], [2.5, 1.9]])
    r = few_calls.few_calls(jax.random.key(0), sim, 50, 0.95, known)
    assert r.evaluations == 50 and abs(r.mean / norm.sf(3.0) - 1) < 4 * r.relative_error
    common = few_calls.few_calls(jax.random.key(0), limit_state(lambda x: x[0], 2), 60, 0.95)
    k, _, n = common.plain  # every other one of the initial design
    assert n == pytest.approx(-np.log(0.05) / common.unseen)
    assert 0 < k < n
    assert common.mean <= 1


def test_an_error_above_the_mean_leaves_an_upper_end():
    assert few_calls._interval(1e-7, 1e-5, 0.95, 1e-6) == pytest.approx((0, 1.97e-5), 1e-2)
    assert few_calls._interval(-1e-7, 1e-5, 0.95, 0.3) == (0.0, 0.3)


def test_an_interruption_keeps_what_the_last_calls_have_shown(coarse):
    sim = limit_state(Partial(_plane, jnp.asarray(3.0)), 2)

    def stop(at):
        def tell(done, total, result):
            if done >= at:
                raise KeyboardInterrupt

        return tell

    r = failure_probability(jax.random.key(0), sim, 50, callback=stop(42))
    assert not r.reliable
    assert "interrupted after" in r.warnings[0]
    assert r.evaluations < 50
    with pytest.raises(KeyboardInterrupt):
        failure_probability(jax.random.key(0), sim, 50, callback=stop(12))


@pytest.mark.parametrize("budget", [39, 0, 60.5])
def test_fewer_than_forty_calls_are_refused(budget):
    with pytest.raises(ValueError, match="budget"):
        failure_probability(
            jax.random.key(0), limit_state(Partial(_plane, jnp.asarray(3.0)), 2), budget
        )


@pytest.mark.parametrize("key", [0, 2])
def test_a_failure_where_the_surrogate_was_sure_of_none_is_told(key):
    """Fails above 3, of a distance that is 1 everywhere: the answers were 6 and 15 standard errors
    too low without a flag.
    """
    sim = jast.Simulator(
        init=lambda x0: jnp.float32(0.0),
        step=lambda s, x: x,
        disturbance=lambda s: D.Normal(0.0, 1.0),
        evaluate=lambda s: (s > 3.0, jnp.float32(1.0)),
        horizon=1,
    )
    found = failure_probability(jax.random.key(key), sim, 200)
    assert not found.reliable
    assert any("the surrogate was sure" in text for text in found.warnings)
