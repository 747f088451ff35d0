"""The cross-entropy method for rare events: frozen proposals estimate known probabilities, tilted
distributions are proper, bad episodes do not mislead it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from checks import weighted_episodes
from systems import hyperplane, ring, walk

import jast
from jast import distributions as D
from jast.distributions import Tilted, tilted
from jast.estimate import failure_proposal

SEEDS = 3
SMALL = dict(samples=400, iterations=6)


def corner():
    """Two uniform numbers, one step each: P(u1 + u2 > 2 - a) = a^2 / 2 = 5e-5 with a = .01. Not
    normal, bounded, and mass at the very end of the support.
    """
    return jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: D.Uniform(jnp.zeros(()), jnp.ones(())),
        lambda s: (s > 1.99, jnp.maximum(1.99 - s, 0)),
        2,
    )


def sides():
    """One normal number; failure above 3.5 or below -4: P = 2.6430e-4, of which the far side is 12
    %.
    """
    return jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: x,
        lambda s: D.Normal(jnp.zeros(()), 1.0),
        lambda s: ((s > 3.5) | (s < -4), jnp.maximum(jnp.minimum(3.5 - s, 4 + s), 0)),
        1,
        episodic=True,
    )


def estimates(key, sim, n=10_000, **settings):
    """Of ``SEEDS`` proposals: (mean [seeds], its standard error [seeds], the proposals)."""

    def run(key):
        to_find, to_estimate = jax.random.split(key)
        found = failure_proposal(to_find, sim, **settings)
        return weighted_episodes(to_estimate, sim, found.policy, n)[0], found

    log_w, found = jax.jit(jax.vmap(run))(jax.random.split(key, SEEDS))
    w = np.exp(np.asarray(log_w, float))
    return w.mean(axis=1), w.std(axis=1, ddof=1) / np.sqrt(n), found


CASES = {
    "hyperplane": (hyperplane, scipy.stats.norm.sf(4.0), 0.05),
    "walk": (lambda: jast.simulators.walk1d("one-sided"), 9.578759495e-4, 0.05),
    "corner": (corner, 5e-5, 0.05),
}


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_known_probabilities(key, name, precision):
    """Fresh samples under the frozen proposal: within 4 standard errors (6e-5 a seed to be outside,
    if normal), each at most 5 % where crude Monte Carlo of all 20,000 episodes, finding included,
    has 1 / sqrt(20,000 P): 126 %, 23 % and 100 %.
    """
    with jax.enable_x64(precision == "float64"):
        make, truth, bound = CASES[name]
        mean, error, found = estimates(key, make())
        assert found.reached.all()
        assert (found.levels[:, -1] == 0).all()
        assert (found.invalid == 0).all()
        assert (found.evaluations == 10_000).all()
        assert (abs(mean - truth) < 4 * error).all(), (mean / truth, error / truth)
        assert (error / truth < bound).all() and bound < 1 / np.sqrt(20_000 * truth) / 4
        assert (found.levels[:, 0] > 0).all() and (found.failing[:, -1] > 200).all()


@pytest.mark.long
def test_unequal_sides(key):
    """One Gaussian finds the nearer side: an estimate is that side's probability or more, never
    above the whole, within 4 standard errors.
    """
    mean, error, found = estimates(key, sides())
    near, whole = scipy.stats.norm.sf(3.5), scipy.stats.norm.sf(3.5) + scipy.stats.norm.sf(4.0)
    assert found.reached.all()
    assert (mean > near - 4 * error).all()
    assert (mean < whole + 4 * error).all()
    assert (error < 0.1 * near).all()


@pytest.mark.slow
def test_random_start_is_tilted(key):
    """Landing at b = .6, two equal modes: the estimate is between one mode's probability,
    Phi(-4.353), and that of both, within 4 standard errors.
    """
    sim, whole = jast.simulators.landing(b=0.6), 2 * scipy.stats.norm.sf(0.6 / np.sqrt(0.019))
    mean, error, found = estimates(key, sim)
    assert found.reached.all()
    assert found.start.mean.shape == (SEEDS, 1)
    assert (abs(found.start.mean) > 0.5).all()
    assert (mean > whole / 2 - 4 * error).all() and (mean < whole + 4 * error).all()


@pytest.mark.long
def test_integers_and_structures(key):
    """Joint of normal and categorical, random start: the same probability as 50,000 crude episodes,
    within 4 of both standard errors.
    """
    sim, n = ring(), 50_000
    mean, error, found = estimates(key, sim)
    p = float(jax.vmap(lambda k: jast.rollout(k, sim).failure)(jax.random.split(key, n)).mean())
    assert found.reached.all() and (abs(mean - p) < 4 * np.sqrt(error**2 + p * (1 - p) / n)).all()


# The tilted distributions


def shapes(dtype):
    one = lambda v: jnp.asarray(v, dtype)
    return {
        "tent": (D.tent(one(0.3)), np.linspace(0, 1, 20_001)),
        "uniform": (D.Uniform(one(-1.0), one(2.0)), np.linspace(-1, 2, 20_001)),
        "laplace": (D.Laplace(one(1.0), one(0.5)), np.linspace(-12, 14, 20_001)),
        "normal": (D.Normal(one(1.0), one(2.0)), np.linspace(-30, 32, 20_001)),
        "either": (
            D.where(jnp.asarray(True), D.tent(one(0.6)), D.Uniform(one(0.0), one(1.0))),
            np.linspace(0, 1, 20_001),
        ),
    }


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", ["tent", "uniform", "laplace", "normal", "either"])
def test_tilted_density(key, name, precision):
    """It integrates to 1 (trapezoidal rule, 20,001 points), and 40,000 draws fall into ten equal
    bins of it: chi^2, 9 degrees, below its 1 - 1e-6 quantile.
    """
    with jax.enable_x64(precision == "float64"):
        dist, grid = shapes(precision)[name]
        q = tilted(dist, jnp.asarray(1.2, precision), jnp.asarray(0.7, precision))
        density = np.exp(
            np.asarray(jax.jit(jax.vmap(q.log_prob))(jnp.asarray(grid, precision)), float)
        )
        density = np.nan_to_num(density, posinf=0)
        below = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(grid))])
        assert below[-1] == pytest.approx(1, abs=2e-3)
        x = np.asarray(jax.jit(jax.vmap(lambda k: D.sample(q, k)))(jax.random.split(key, 40_000)))
        assert x.dtype == precision
        assert grid[0] <= x.min()
        assert x.max() <= grid[-1]
        edges = np.interp(np.linspace(0, below[-1], 11), below, grid)
        observed = np.histogram(x, bins=edges)[0]
        assert scipy.stats.chisquare(
            observed, np.full(10, observed.sum() / 10)
        ).statistic < scipy.stats.chi2.isf(1e-6, 9)
        assert np.isneginf(q.log_prob(jnp.asarray(grid[0] - 100, precision))) or name in (
            "laplace",
            "normal",
        )


def test_tilted_generic_agrees_with_the_shifted_normal():
    """What a Normal gets in closed form is what its quantile function gives, as far as 1 - Phi(4) =
    3e-5 is known in float32 (z to 5e-4).
    """
    d, m, s = D.Normal(jnp.asarray(1.0), 2.0), jnp.asarray(1.5), jnp.asarray(0.6)
    x = jnp.linspace(-3.0, 9.0, 13)
    np.testing.assert_allclose(
        jax.vmap(Tilted(d, m, s).log_prob)(x), jax.vmap(tilted(d, m, s).log_prob)(x), atol=1e-3
    )


@pytest.mark.slow
def test_tilted_vectors_and_structures(key):
    """Log densities are sums over the parts, and draws have the moments."""
    m, s = jnp.array([1.0, -1.0]), jnp.array([0.5, 2.0])
    factor = jnp.array([[2.0, 0.0], [1.0, 0.5]])
    q = tilted(D.MultivariateNormalTri(jnp.zeros(2), factor), m, s)
    z = jnp.array([0.3, 0.7])
    expected = scipy.stats.norm.logpdf(z, m, s).sum() - np.log(np.diag(factor)).sum()
    assert float(q.log_prob(factor @ z)) == pytest.approx(float(expected), rel=1e-5)
    inner = D.Uniform(jnp.zeros(2), jnp.ones(2))
    q = tilted(D.Independent(inner, 1), m, s)
    x = jnp.array([0.2, 0.6])
    assert q.log_prob(x).shape == ()
    assert float(q.log_prob(x)) == pytest.approx(
        float(tilted(inner, m, s).log_prob(x).sum()), rel=1e-6
    )
    q = tilted(
        D.Joint({"a": D.tent(jnp.asarray(0.5)), "b": D.Uniform(jnp.zeros(()), jnp.ones(()))}),
        {"a": m[0], "b": m[1]},
        {"a": s[0], "b": s[1]},
    )
    draws = jax.jit(jax.vmap(lambda k: D.sample(q, k)))(jax.random.split(key, 2000))
    # the median of u is Phi(m): of 2000 draws within 4 standard errors, .5 / sqrt(2000) = .0112 in
    # probability each
    assert abs(np.mean(draws["b"] < scipy.stats.norm.cdf(-1.0)) - 0.5) < 0.045


@pytest.mark.parametrize("mean, deviation", [(0.0, 1.0), (1.5, 0.5), (-6.0, 1.0), (6.0, 0.3)])
def test_tilted_whole_numbers(mean, deviation):
    """The mass of N(mean, deviation) in each cell, rare numbers last, by scipy in float64; at (0,
    1) the model itself.
    """
    mean, deviation = jnp.asarray(mean), jnp.asarray(deviation)
    probs = np.array([0.2, 0.5, 0.0, 0.3])
    edges = scipy.stats.norm.ppf([0, 0.5, 0.8, 1])
    sorted_cells = np.diff(scipy.stats.norm.cdf((edges - float(mean)) / float(deviation)))
    expected = np.array([sorted_cells[2], sorted_cells[0], 0, sorted_cells[1]])
    q = tilted(D.Categorical(probs=jnp.asarray(probs)), mean, deviation)
    np.testing.assert_allclose(q.probs, expected, rtol=1e-3, atol=1e-7)
    q = tilted(D.Bernoulli(probs=jnp.asarray(0.1)), mean, deviation)
    np.testing.assert_allclose(
        q.probs,
        scipy.stats.norm.sf((scipy.stats.norm.isf(0.1) - float(mean)) / float(deviation)),
        rtol=1e-3,
    )


# What must not mislead it


def test_invalid_episodes_are_counted_and_never_elite(key):
    """A step of more than 1.5 gives NaN; the level is still reached by smaller ones."""
    sim = walk(step=lambda s, x: jnp.where(x > 1.5, jnp.nan, s + x))
    found = failure_proposal(key, sim, **SMALL)
    assert found.reached
    assert 0 < found.invalid < 2400
    assert np.isfinite(found.levels).all()
    found = failure_proposal(key, walk(step=lambda s, x: s + jnp.nan), **SMALL)
    assert not found.reached
    assert found.invalid == 2400
    assert np.isinf(found.levels).all()
    assert (found.ess == 0).all()
    assert (found.steps.mean == 0).all() and (found.steps.deviation == 1).all()


def test_what_cannot_fail_and_what_always_does(key):
    found = failure_proposal(key, walk(fails=lambda s: s > 1e9), **SMALL)
    assert not found.reached and (found.failing == 0).all()
    # at the start: no step is ever taken
    found = failure_proposal(key, walk(fails=lambda s: s < 1e9), **SMALL)
    assert found.reached
    assert (found.failing == 400).all()
    assert (found.levels == 0).all()
    assert (found.steps.mean == 0).all() and (found.steps.deviation == 1).all()


def test_failures_with_a_distance(key):
    """A failure that is not at distance 0 is below every level all the same."""
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: D.Normal(jnp.zeros(()), 1.0),
        lambda s: (s > 6, jnp.maximum(10 - s, 0)),
        6,
    )
    found = failure_proposal(key, sim)
    assert found.reached
    assert found.levels[-1] == 0
    assert found.failing[-1] > 100


@pytest.mark.slow
def test_jit_vmap_and_text(key):
    sims = jax.vmap(hyperplane)(jnp.array([2.0, 3.0]))
    many = jax.vmap(lambda sim: failure_proposal(key, sim, **SMALL))(sims)
    one = failure_proposal(key, hyperplane(2.0), **SMALL)
    np.testing.assert_allclose(many.steps.mean[0], one.steps.mean, rtol=1e-4, atol=1e-4)
    assert str(many) == "2 runs of 2400 evaluations: 2 reached failures"
    assert "iteration" in str(one) and len(str(one).splitlines()) == 7
    assert str(one._replace(reached=False)).endswith(
        "the last elites do not fail: more iterations, or more samples"
    )
    e = jast.rollout(key, hyperplane(2.0), one.policy)
    assert e.disturbances.shape == (1, 4) and np.isfinite(e.log_prob)


@pytest.mark.parametrize(
    "settings, message",
    [
        (dict(samples=1), "samples must be a whole number of at least 2, received 1"),
        (dict(iterations=True), "iterations must be .* received True"),
        (dict(quantile=0), "quantile must be a number above 0 and below 1, received 0"),
        (dict(smoothing=1.0), "smoothing must be a number from 0 to below 1, received 1.0"),
        (dict(floor=0.0), "floor must be a number above 0, received 0.0"),
        (dict(floor="x"), "floor must be .* received 'x'"),
    ],
)
def test_bad_settings(key, settings, message):
    with pytest.raises(ValueError, match=message):
        failure_proposal(key, walk(), **settings)


@pytest.mark.slow
def test_bad_disturbances(key):
    angle = D.VonMises(jnp.asarray(2.0), jnp.asarray(3.0))
    for dist, name in ((D.seeds(), "Seeds"), (angle, "VonMises")):
        sim = jast.Simulator(
            lambda x0: jnp.zeros(()),
            lambda s, x: s,
            lambda s, d=dist: d,
            lambda s: (s > 1, 1 - s),
            2,
        )
        with pytest.raises(
            ValueError, match=f"failure_proposal: disturbance: {name} cannot be tilted"
        ):
            failure_proposal(key, sim)
    start = jast.Simulator(
        lambda x0: x0,
        lambda s, x: s + x,
        lambda s: D.Normal(jnp.zeros(()), 1.0),
        lambda s: (s > 4, jnp.maximum(4 - s, 0)),
        2,
        start=lambda: D.VonMises(jnp.asarray(2.0), jnp.asarray(2.0)),
    )
    # one that cannot is drawn from its own distribution
    found = failure_proposal(key, start, **SMALL)
    assert found.start == ()
    assert found.reached
    assert isinstance(found.policy.start(), D.VonMises)
