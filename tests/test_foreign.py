"""Distributions of scipy.stats and NumPyro are disturbances: of the same law, in both tails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jast
from jast import distributions as D
from jast._src.distributions.containers import accepted
from jast._src.distributions.scipy_and_numpyro import OF_NUMPYRO, OF_SCIPY

FROZEN = {
    "bernoulli": (0.3,),
    "beta": (2.0, 3.0),
    "binom": (7.0, 0.4),
    "chi2": (3.0, 0.0, 2.0),
    "expon": (0.0, 2.0),
    "gamma": (1.7, 0.0, 0.5),
    "gumbel_r": (1.0, 2.0),
    "laplace": (1.0, 2.0),
    "logistic": (1.0, 2.0),
    "lognorm": (0.8, 0.0, 3.0),
    "norm": (1.0, 2.0),
    "poisson": (3.5,),
    "t": (5.0, 1.0, 2.0),
    "truncnorm": (-1.0, 2.5, 1.0, 2.0),
    "uniform": (1.0, 2.0),
    "weibull_min": (1.5, 0.0, 2.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_SCIPY)
def test_a_frozen_distribution_is_of_the_same_law(name):
    """Densities, and quantiles at z from -4 to 4, against scipy's own."""
    frozen = getattr(stats, name)(*FROZEN[name])
    z = np.array([-4.0, -1.2, 0.3, 1.1, 4.0])
    with jax.enable_x64(True):
        d = accepted(frozen)
        assert type(d).__module__.startswith("jast.")
        if name == "uniform":
            assert (float(d.low), float(d.high)) == (1.0, 3.0)
        continuous = isinstance(frozen.dist, stats.rv_continuous)
        x = np.where(z < 0, frozen.ppf(stats.norm.cdf(z)), frozen.isf(stats.norm.cdf(-z)))
        if continuous:
            mine = [float(D.from_normal(d, jnp.asarray(v))) for v in z]
            np.testing.assert_allclose(mine, x, rtol=1e-6)
            log_p = [float(d.log_prob(jnp.asarray(v))) for v in x]
            np.testing.assert_allclose(log_p, frozen.logpdf(x), rtol=1e-6, atol=1e-9)
        else:  # rare numbers lie in the upper tail: no order of quantiles
            whole = np.arange(8 if name != "bernoulli" else 2)
            log_p = [float(d.log_prob(jnp.asarray(v))) for v in whole]
            np.testing.assert_allclose(log_p, frozen.logpmf(whole), rtol=1e-6)


def test_shapes_may_come_by_name_and_from_the_state():
    d = jax.jit(lambda s: accepted(stats.lognorm(s=0.5, scale=s)))(jnp.float32(2.0))
    assert float(d.median()) == pytest.approx(2.0)
    with pytest.raises(ValueError, match=r"scipy.stats.gamma: loc must be 0 here, received 2.0"):
        accepted(stats.gamma(2.0, loc=2.0))
    with pytest.raises(ValueError, match="scipy.stats.expon: loc must be 0 here"):
        jax.jit(lambda s: accepted(stats.expon(s)))(1.0)
    with pytest.raises(ValueError, match="scipy.stats.beta: scale must be 1 here, received 3.0"):
        accepted(stats.beta(2.0, 2.0, scale=3.0))
    for other in (stats.genextreme(0.1), stats.multivariate_normal([0.0, 0.0])):
        with pytest.raises(ValueError, match=r"no counterpart that JAX can trace.*bernoulli, beta"):
            accepted(other)


def test_plain_numbers_of_scipys_need_no_solver():
    text = str(jax.make_jaxpr(lambda z: D.from_normal(accepted(stats.t(5.0, 1.0, 2.0)), z))(0.3))
    assert "regularized_incomplete_beta" not in text


def walk(disturbance, start=None):
    """A sum of 5 gusts, 3 standard deviations of it."""
    fields = {} if start is None else {"start": start}
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()) if start is None else x0,
        step=lambda s, x: s + x,
        disturbance=disturbance,
        evaluate=lambda s: (s >= 3 * 5**0.5, jnp.maximum(3 * 5**0.5 - s, 0.0)),
        horizon=5,
        **fields,
    )


def test_a_system_with_scipys_is_that_with_jasts(equal, key):
    theirs = walk(lambda s: stats.norm(0.0, 1.0), lambda: stats.norm(scale=0.5))
    own = walk(lambda s: D.Normal(0.0, 1.0), lambda: D.Normal(0.0, 0.5))
    equal(jast.rollout(key, jast.check(theirs)), jast.rollout(key, own))
    assert "disturbance=<lambda>" in repr(theirs)
    box = jast.blackbox.from_python(
        lambda x: (bool(x.sum() > 3), float(max(3 - x.sum(), 0))),
        horizon=2,
        disturbance=stats.norm(0.0, 1.0),
    )
    assert jast.nominal(key, box, 50).episodes == 50
    parts = D.Joint({"gust": stats.norm(0.0, 1.0), "late": stats.bernoulli(0.2)})
    assert sorted(parts.sample(seed=0)) == ["gust", "late"]
    assert D.Independent(stats.norm(jnp.zeros(3), 1.0), 1).event_shape == (3,)


def numpyros():
    n = pytest.importorskip("numpyro.distributions")
    f = lambda *v: jnp.asarray(v)
    return {
        "BernoulliLogits": n.Bernoulli(logits=jnp.asarray(0.3)),
        "BernoulliProbs": n.Bernoulli(0.3),
        "Beta": n.Beta(2.0, 3.0),
        "BinomialProbs": n.Binomial(7, 0.4),
        "CategoricalLogits": n.Categorical(logits=f(0.1, 2.0)),
        "CategoricalProbs": n.Categorical(f(0.1, 0.9)),
        "Exponential": n.Exponential(0.5),
        "Gamma": n.Gamma(1.7, 2.0),
        "GeometricProbs": n.Geometric(0.4),
        "Gumbel": n.Gumbel(1.0, 2.0),
        "Laplace": n.Laplace(1.0, 2.0),
        "LogNormal": n.LogNormal(0.3, 0.8),
        "Logistic": n.Logistic(1.0, 2.0),
        "MultivariateNormal": n.MultivariateNormal(
            f(0.0, 1.0), f(2.0, 0.6, 0.6, 1.0).reshape(2, 2)
        ),
        "Normal": n.Normal(1.0, 2.0),
        "Poisson": n.Poisson(3.5),
        "StudentT": n.StudentT(5.0, 1.0, 2.0),
        "Uniform": n.Uniform(1.0, 3.0),
        "Weibull": n.Weibull(2.0, 1.5),
        # of no family here
        "Cauchy": n.Cauchy(1.0, 2.0),
        "HalfNormal": n.HalfNormal(2.0),
        "VonMises": n.VonMises(0.0, 1.0),
        "Independent": n.Normal(jnp.zeros(3), 1.0).to_event(1),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", [*OF_NUMPYRO, "Cauchy", "HalfNormal", "VonMises", "Independent"])
def test_numpyros_are_of_the_same_law(name, key):
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs = numpyros()[name]
        d = accepted(theirs)
        assert isinstance(d, D.Distribution)
        assert (type(d).__name__ == "NumPyro") == (name in ("Cauchy", "HalfNormal", "VonMises"))
        for k in jax.random.split(key, 5):
            x = d.sample(seed=k)
            assert x.shape == theirs.shape()
            np.testing.assert_allclose(d.log_prob(x), theirs.log_prob(x), rtol=2e-5, atol=1e-6)
        assert D.has_quantile(d) == (name != "VonMises")
        if name in ("Cauchy", "HalfNormal", "Normal", "Gumbel", "LogNormal"):
            for u in (0.01, 0.5, 0.9):
                x = D.quantile(d, jnp.asarray(u))
                assert float(x) == pytest.approx(float(theirs.icdf(jnp.asarray(u))), rel=1e-4)
                assert float(D.cdf(d, x)) == pytest.approx(u, rel=1e-4)


@pytest.mark.slow
def test_a_system_with_numpyros(key):
    """The probability of jast's normal distribution; and of a family that jast does not have."""
    n = pytest.importorskip("numpyro.distributions")
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        found = jast.estimate.failure_probability(key, walk(lambda s: n.Normal(0.0, 1.0)), 10_000)
        low, high = found.interval
        # any of five states: at least that of the last, at most twice that (Levy's inequality)
        assert found.reliable
        assert low < 2 * 0.00134990
        assert high > 0.00134990
        half = jast.check(walk(lambda s: n.HalfNormal(1.0)))
        p = jast.estimate.monte_carlo(key, half, 20_000)
        draws = np.abs(np.random.default_rng(0).standard_normal((200_000, 5))).sum(axis=1)
        truth = (draws >= 3 * 5**0.5).mean()
        assert abs(p.mean - truth) < 5 * np.sqrt(truth / 20_000)
