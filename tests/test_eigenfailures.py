"""jast.explain.eigenfailures: the directions of linear limit states meet their closed forms."""

import math
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import Page
from test_indices import plane

import jast
from jast import explain
from jast._src.explain.eigenfailures import components
from jast.distributions import Bernoulli, Joint, Normal

PHI = NormalDist()


def above(beta):
    """Mean and variance of a standard normal number above ``beta``."""
    hazard = PHI.pdf(beta) / PHI.cdf(-beta)
    return hazard, 1 + beta * hazard - hazard**2


def drawn(rng, n, normal, beta):
    """Exact draws [n, D] of the normal distribution beyond a plane."""
    z = rng.standard_normal((n, len(normal)))
    u = np.array([PHI.inv_cdf(p) for p in PHI.cdf(-beta) * rng.random(n)])
    return z + (-u - z @ normal)[:, None] * normal


@pytest.mark.parametrize("d, n", [(2, 2000), (20, 4000), (60, 4000), (200, 100)])
def test_the_direction_of_a_plane_is_its_normal(d, n):
    """Each of the d - 1 other parts of the direction has, to first order, the variance
    v / (n (1 - v)^2), v that along the normal; of the mean, where that is the direction, 1 / n over
    the squared shift. The sum is chi-squared; 5 standard deviations above its mean.
    """
    rng = np.random.default_rng(d)
    normal = rng.standard_normal(d)
    normal /= np.linalg.norm(normal)
    shift, v = above(3.0)
    mean, variances, vectors, chance = components(drawn(rng, n, normal, 3.0), np.full(n, 1 / n), n)
    assert len(vectors) == 1
    by_mean = chance[0] < v  # too few points to tell a variance
    each = 1 / (n * shift**2) if by_mean else v / (n * (1 - v) ** 2)
    sine = 1 - (vectors[0] @ normal) ** 2
    assert sine < each * (d - 1 + 5 * math.sqrt(2 * (d - 1)))
    assert by_mean == (n == 100)
    assert abs(abs(vectors[0] @ mean) - shift) < 5 * math.sqrt(v / n) + shift * sine
    if not by_mean:  # the fourth moment of the truncated tail is near that of an exponential one
        assert abs(variances[0] - v) < 5 * v * math.sqrt(8 / n) + sine


@pytest.mark.parametrize("d, n", [(1, 50), (5, 100), (30, 1000), (60, 40)])
def test_draws_of_the_model_differ_in_nothing(d, n):
    """In at most 1 of 40 samples, where 1 in 1000 would be usual."""
    rng = np.random.default_rng(0)
    found = [
        len(components(rng.standard_normal((n, d)), np.full(n, 1 / n), n)[2]) for _ in range(40)
    ]
    assert np.count_nonzero(found) <= 1


def test_what_varies_more_is_a_direction_too():
    """Weights 4 in one half of the draws, 0 in most others: a Gaussian of variance 9 in place of
    1, by importance."""
    rng = np.random.default_rng(1)
    z = rng.standard_normal((4000, 6)) * np.array([4.0, 1, 1, 1, 1, 1])
    log_w = -(z[:, 0] ** 2) / 2 * (1 / 9 - 1 / 16)
    w = np.exp(log_w) / np.exp(log_w).sum()
    mean, variances, vectors, _ = components(z, w, 1 / (w**2).sum())
    assert len(vectors) == 1 and abs(vectors[0, 0]) > 0.99
    assert abs(variances[0] - 9) < 5 * 9 * math.sqrt(2 * (w**2).sum()) and abs(mean[0]) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("source", ["estimate", "samples"])
def test_failures_of_an_estimate(key, source):
    """Of weighted draws and of equal ones; the replays lie on the line that they are said to."""
    normal = np.array([0.8, 0.0, -0.6])
    sim = plane(normal, 3.0)
    given = jast.estimate.failure_probability(key, sim, 20_000)
    if source == "samples":
        given = jast.estimate.failure_samples(key, sim, given, 500)
    found = explain.eigenfailures(key, sim, given)
    shift, v = above(3.0)
    assert found.reliable
    assert found.ess >= 500
    assert found.directions.shape == (1, 3)
    assert 1 - abs(found.directions[0] @ normal) < 10 * 2 * v / found.ess
    assert found.shifts[0] == pytest.approx(shift, abs=5 * math.sqrt(v / found.ess))
    assert found.directions[0] @ found.mean > 0 and found.nats[0] > shift**2 / 2
    assert found.names == ("x[0]", "x[1]", "x[2]") and found.steps.tolist() == [1, 1, 1]
    move = math.sqrt(found.variances[0]) * found.directions[0]
    for e, side in ((found.minus, -1), (found.plus, 1)):
        at = found.mean + side * move
        assert e.disturbances[0, 0] == pytest.approx(at, abs=1e-5)
        assert bool(e.failure[0]) == (normal @ at >= 3.0)
    assert bool(found.middle.failure)
    assert found.evaluations == 3 + (len(given.failures.length) if source == "samples" else 0)
    lines = str(found).splitlines()
    assert "1 steps" in lines[2]
    assert lines[3].startswith("   x[0] +0.")
    assert "x[2] -0." in lines[3]


def lane(limit=4.0):
    """A sum of gusts that fails on either side; the other number does nothing."""
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x["gust"],
        disturbance=lambda s: Joint({"gust": Normal(0.0, 1.0), "idle": Normal(0.0, 1.0)}),
        evaluate=lambda s: (jnp.abs(s) >= limit, jnp.maximum(limit - jnp.abs(s), 0.0)),
        horizon=2,
    )


@pytest.mark.slow
def test_each_mode_of_a_report(key, tmp_path):
    """Two modes whose directions are opposite; together they would vary more, and not shift."""
    sim = lane()
    report = jast.stress(key, sim, 20_000)
    assert len(report.modes) == 2
    for i, mode in enumerate(report.modes):
        found = explain.eigenfailures(key, sim, report, i)
        side = np.sign(mode.failure.disturbances["gust"][0])
        way = found.directions[0]
        assert found.names == ("gust", "idle", "gust", "idle")
        assert found.steps.tolist() == [1, 1, 2, 2]
        assert side * way @ np.array([1, 0, 1, 0]) / math.sqrt(2) > 0.98
        assert found.shifts[0] > 2.5 and found.variances[0] < 0.3
    both = explain.eigenfailures(key, sim, report.probability)
    assert both.variances[0] > 5
    told = explain.cards(key, sim, report, 2000)
    first = explain.eigenfailures(key, sim, report)
    assert told[0][-1].shifts == pytest.approx(first.shifts)
    report.html(tmp_path / "report.html", explanations=told)
    words = (tmp_path / "report.html").read_text(encoding="utf-8")
    way = Page(words).data["modes"][0]["directions"][0]
    assert "at step 2; by chance variances" in words
    assert way["steps"] == [1, 2] and way["panels"][0]["name"] == "gust"
    ends = [e.disturbances["gust"][0] for e in (first.minus, first.plus)]
    np.testing.assert_allclose(way["panels"][0]["columns"], ends, rtol=1e-5)
    np.testing.assert_allclose(
        way["panels"][0]["quiet"][0], first.middle.disturbances["gust"], rtol=1e-5
    )


def test_failures_at_any_time_are_one_direction(key):
    """A gust above 2.5 fails at once: told by the last step of each, as if all came late."""
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: x,
        disturbance=lambda s: Normal(0.0, 1.0),
        evaluate=lambda s: (s >= 2.5, jnp.maximum(2.5 - s, 0.0)),
        horizon=6,
    )
    keys = jax.random.split(key, 20_000)
    many = jax.device_get(jax.vmap(jast.rollout, (0, None))(keys, sim)._replace(states=None))
    few = jax.tree.map(lambda a: a[many.failure], many)
    assert set(few.length) == {1, 2, 3, 4, 5, 6}
    found = explain.eigenfailures(key, sim, few)
    shift, v = above(2.5)
    assert found.end == 6
    assert len(found.directions) == 1
    assert found.directions[0, 5] > 0.99
    assert found.shifts[0] == pytest.approx(shift, abs=6 * math.sqrt(v / found.ess))
    assert found.middle.failure and int(found.middle.length) == 6


@pytest.mark.slow
def test_of_an_archive_and_of_choices(key):
    """Copies of one failure, three coins of probability 0.2: each is anywhere among the normal
    numbers that give it, those above 0.84, and the fourth, behind the end, as the model has it.
    """
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros((), jnp.int32),
        step=lambda s, x: s + x,
        disturbance=lambda s: Bernoulli(probs=0.2),
        evaluate=lambda s: (s >= 3, jnp.where(s >= 3, 0.0, 1.0)),
        horizon=4,
    )
    n = 2000
    found = jax.vmap(lambda _: jast.replay(sim, jnp.ones(4, jnp.int32)))(jnp.arange(n))
    told = explain.eigenfailures(key, sim, found, directions=4)
    mean, v = above(PHI.inv_cdf(0.8))
    assert np.abs(told.mean[:3] - mean).max() < 5 * math.sqrt(v / n)
    assert abs(told.mean[3]) < 5 / math.sqrt(n)
    assert told.directions.shape == (3, 4) and np.abs(told.directions[:, 3]).max() < 0.1
    assert np.abs(told.variances / v - 1).max() < told.chance[1] - 1
    assert told.ess == n
    assert told.evaluations == n + 7
    assert told.reliable
    few = explain.eigenfailures(key, sim, jax.tree.map(lambda a: a[:60], found))
    assert not few.reliable and str(few).startswith("UNRELIABLE")


@pytest.mark.slow
def test_bad_input(key):
    sim = plane((1.0, 0.0), 1.0)
    safe = jax.vmap(lambda x: jast.replay(sim, x))(jnp.zeros((30, 1, 2)))
    for given, words in (
        (safe, "failures must all fail, received 30 episodes of 30"),
        (3, "failures must be episodes"),
        (jast.estimate.monte_carlo(key, plane((1.0, 0.0), 8.0), 50), "seen a failure"),
        (jast.estimate.failure_probability(key, plane((1.0, 0, 0), 3.0), 5000), "with 3 random"),
        (jast.estimate.monte_carlo(key, sim, 40), "at least 20 effective ones of the mode"),
    ):
        with pytest.raises(ValueError, match=f"eigenfailures: .*{words}"):
            explain.eigenfailures(key, sim, given)
    with pytest.raises(ValueError, match="eigenfailures: mode must be below 1, received 1"):
        explain.eigenfailures(key, sim, jast.estimate.monte_carlo(key, sim, 500), 1)
