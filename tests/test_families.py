"""Families exact in both tails, with SciPy as the oracle: 1e-8 in float64 out to probabilities of
1e-12, monotone in float32 out to |z| = 7; and a user's own, by one row.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats as st
from systems import mark_long

import jast
from jast import distributions as D
from jast._src.distributions.normal_tails import log_one_less, log_tails, normal_of_log_tails

Z = np.concatenate([-np.geomspace(7.1, 0.01, 60), np.geomspace(0.01, 7.1, 60)])


ENDED = {"cut", "beta", "beta below 1"}
"""With an end that is no zero, which hides what is nearer than rounding."""


class HalfNormal:
    """SciPy's loses what is below 1e-16 of 1 / 2; its chi-square does not."""

    def ppf(self, q):
        return 1.3 * np.sqrt(st.chi2(1).ppf(q))

    def isf(self, q):
        return 1.3 * np.sqrt(st.chi2(1).isf(q))

    def support(self):
        return 0.0, np.inf

    def logpdf(self, x):
        return st.halfnorm(scale=1.3).logpdf(x)


def floats(dtype):
    """name -> (distribution, SciPy's)."""
    f = lambda v: jnp.asarray(v, dtype)
    return {
        "lognormal": (D.LogNormal(f(0.3), f(0.7)), st.lognorm(0.7, scale=np.exp(0.3))),
        "exponential": (D.Exponential(f(1.7)), st.expon(scale=1 / 1.7)),
        "gumbel": (D.Gumbel(f(0.3), f(0.7)), st.gumbel_r(0.3, 0.7)),
        "weibull": (D.Weibull(f(1.7), f(0.6)), st.weibull_min(1.7, scale=0.6)),
        "half": (D.TruncatedNormal(f(0), f(1.3), f(0), f(np.inf)), HalfNormal()),
        "cut": (
            D.TruncatedNormal(f(0.3), f(1.3), f(-1), f(2)),
            st.truncnorm(-1, 1.7 / 1.3, 0.3, 1.3),
        ),
        "cauchy": (D.StudentT(f(1), f(0.3), f(0.7)), st.t(1, 0.3, 0.7)),
        "t": (D.StudentT(f(4.5), f(0.3), f(0.7)), st.t(4.5, 0.3, 0.7)),
        "gamma": (D.Gamma(f(2.7), f(1.7)), st.gamma(2.7, scale=1 / 1.7)),
        "gamma below 1": (D.Gamma(f(0.5), f(1.7)), st.gamma(0.5, scale=1 / 1.7)),
        "beta": (D.Beta(f(1.3), f(2.7)), st.beta(1.3, 2.7)),
        "beta below 1": (D.Beta(f(0.3), f(0.4)), st.beta(0.3, 0.4)),
        "of exp": (
            D.Transformed(D.Normal(f(0.3), f(0.7)), jnp.exp),
            st.lognorm(0.7, scale=np.exp(0.3)),
        ),
    }


def counts(dtype):
    f = lambda v: jnp.asarray(v, dtype)
    return {
        "geometric": (D.Geometric(f(0.03)), st.geom(0.03, loc=-1)),
        "poisson": (D.Poisson(f(3.4)), st.poisson(3.4)),
        "rare": (D.Poisson(f(1e-5)), st.poisson(1e-5)),
        "binomial": (D.Binomial(20, f(0.3)), st.binom(20, 0.3)),
    }


def truth(scipys, z):
    """By the tail in which z is."""
    z = np.asarray(z, np.float64)
    return np.where(z < 0, scipys.ppf(st.norm.cdf(z)), scipys.isf(st.norm.sf(z)))


@pytest.mark.parametrize("name", [n for n in floats("float32") if n != "of exp"])
def test_nothing_lies_outside_of_the_support(name, dtype):
    """But what distrax's own density says of its transformed numbers."""
    d, scipys = floats(dtype)[name]
    for end, outwards, below in zip(scipys.support(), (-1, 1), (0, 1), strict=True):
        if np.isfinite(end):
            x = jnp.asarray(end + outwards, dtype)
            assert float(d.log_prob(x)) == -np.inf
            assert float(D.cdf(d, x)) == below


def mapped(function, values):
    return np.asarray(jax.jit(jax.vmap(function))(values))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", mark_long(floats("float32"), "half", "gamma below 1", "beta below 1", "cauchy")
)
def test_floats_are_scipys_in_both_tails(name, x64, key):
    d, scipys = floats("float64")[name]
    x = mapped(lambda z: D.from_normal(d, z), jnp.asarray(Z))
    np.testing.assert_allclose(x, truth(scipys, Z), rtol=1e-8)
    np.testing.assert_allclose(
        mapped(d.log_prob, jnp.asarray(x)), scipys.logpdf(x), rtol=1e-8, atol=1e-8
    )
    if name not in ENDED:
        inner = np.abs(Z) < (6 if name == "half" else 7)
        z = mapped(lambda x: D.to_normal(d, x), jnp.asarray(x))
        np.testing.assert_allclose(z[inner], Z[inner], rtol=1e-3, atol=1e-6)
    u = mapped(lambda u: D.cdf(d, D.quantile(d, u)), jnp.asarray([0.01, 0.3, 0.9]))
    np.testing.assert_allclose(u, [0.01, 0.3, 0.9], rtol=1e-9)
    draws = np.asarray(d.sample(seed=key, sample_shape=(4000,)))
    below = np.mean(draws <= scipys.ppf(0.3))
    assert abs(below - 0.3) < 4 * np.sqrt(0.21 / 4000) and D.has_exact_tails(d)


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(floats("float32"), "gamma below 1", "beta below 1"))
def test_floats_rise_in_float32(name):
    d, scipys = floats("float32")[name]
    z = jnp.arange(-7, 7.005, 0.01, dtype=jnp.float32)
    x = mapped(lambda z: D.from_normal(d, z), z)
    assert x.dtype == np.float32 and np.isfinite(x).all()
    steps = np.diff(x)
    # at an end that is no zero neighbours are one float, as those of the uniform are
    assert (steps >= 0).all() if name in ENDED else (steps > 0).all()
    far = np.abs(np.asarray(z)) > 0.1
    np.testing.assert_allclose(x[far], truth(scipys, z)[far], rtol=1e-3, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(counts("float32"), "poisson", "binomial"))
def test_counts_are_scipys_in_both_tails(name, x64, key):
    d, scipys = counts("float64")[name]
    k = mapped(lambda z: D.from_normal(d, z), jnp.asarray(Z))
    np.testing.assert_array_equal(k, truth(scipys, Z))
    seen = np.unique(k)
    np.testing.assert_allclose(
        mapped(d.log_prob, jnp.asarray(seen)), scipys.logpmf(seen), rtol=1e-8
    )
    back = mapped(lambda k: D.from_normal(d, D.to_normal(d, k)), jnp.asarray(seen))
    np.testing.assert_array_equal(back, seen)
    again = mapped(lambda k: D.quantile(d, D.cdf(d, k)), jnp.asarray(seen[scipys.pmf(seen) > 1e-6]))
    np.testing.assert_array_equal(again, seen[scipys.pmf(seen) > 1e-6])
    draws = np.asarray(d.sample(seed=key, sample_shape=(4000,)))
    assert np.issubdtype(draws.dtype, np.integer)
    assert abs(draws.mean() - scipys.mean()) < 4 * scipys.std() / np.sqrt(4000) + 1e-3
    assert D.mode(d) == seen[np.argmax(scipys.pmf(seen))]
    # tilted: a proper distribution, and the model itself at N(0, 1)
    tilt = lambda m, s: D.tilted(d, jnp.asarray(m), jnp.asarray(s)).log_prob
    every = jnp.arange(1500)
    assert np.exp(mapped(tilt(1.3, 0.7), every)).sum() == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(
        mapped(tilt(0.0, 1.0), jnp.asarray(seen)), scipys.logpmf(seen), rtol=1e-8
    )


@pytest.mark.parametrize(
    "dtype", [pytest.param("float32", marks=pytest.mark.long), "float64"], indirect=True
)
def test_a_mixture_is_exact_in_both_tails(dtype, key):
    f = lambda *v: jnp.asarray(v, dtype)
    d = D.MixtureSameFamily(D.Categorical(probs=f(0.99, 0.01)), D.Normal(f(0, 1), f(1, 6)))
    x = mapped(lambda z: D.from_normal(d, z), jnp.asarray(Z, dtype))
    wide = x.astype(np.float64)
    below = 0.99 * st.norm.cdf(wide) + 0.01 * st.norm.cdf(wide, 1, 6)
    above = 0.99 * st.norm.sf(wide) + 0.01 * st.norm.sf(wide, 1, 6)
    ratio = np.where(Z < 0, below / st.norm.cdf(Z), above / st.norm.sf(Z))
    np.testing.assert_allclose(ratio, 1, rtol=1e-4 if dtype == "float32" else 1e-8)
    assert (np.diff(x) > 0).all() and x.dtype == dtype
    density = 0.99 * st.norm.pdf(0.4) + 0.01 * st.norm.pdf(0.4, 1, 6)
    assert float(d.log_prob(jnp.asarray(0.4, dtype))) == pytest.approx(np.log(density), rel=1e-5)
    draws = np.asarray(d.sample(seed=key, sample_shape=(8000,)))
    share, expected = np.mean(np.abs(draws) > 4), 0.01 * (st.norm.sf(0.5) + st.norm.cdf(-5 / 6))
    assert abs(share - expected) < 4 * np.sqrt(expected / 8000)


def test_the_mode_of_a_mixture_is_the_likeliest_of_its_parts():
    """So no value is much likelier than it: its median, where parts lie apart, is among the least
    likely.
    """
    weights = jnp.asarray([[0.3, 0.7], [0.8, 0.2]])
    each = D.Normal(jnp.asarray([[-2.0, 1.0]] * 2), jnp.asarray([[0.5, 1.0], [0.5, 0.2]]))
    d = D.MixtureSameFamily(D.Categorical(probs=weights), each)
    np.testing.assert_array_equal(D.mode(d), [1.0, -2.0])
    x = jnp.linspace(-5.0, 5.0, 1001)
    gain = jax.vmap(lambda x: D.log_density(d, jnp.full(2, x), "mode"))(x)
    assert gain.max() < 0.01


def _pair(mean):
    pair = D.Normal(jnp.stack([0.0 * mean, mean]), jnp.asarray([1.0, 0.5]))
    return D.MixtureSameFamily(D.Categorical(probs=jnp.asarray([0.7, 0.3])), pair)


@pytest.mark.long
@pytest.mark.parametrize(
    "make, parameter",
    [
        (lambda scale: D.StudentT(3.0, 0.2, scale), 1.3),
        (_pair, 3.0),
        (lambda top: D.TruncatedNormal(0.0, 1.0, -1.0, top), jnp.inf),
        (lambda shape: D.Gamma(shape, 1.0), 2.7),
        (lambda rate: D.Gamma(2.7, rate), 1.7),
        (lambda scale: D.Transformed(D.Beta(1.3, 2.7), lambda x: scale * x), 1.7),
    ],
)
def test_derivatives_are_those_of_the_inverse(make, parameter, x64):
    """By central differences: what is solved by steps has derivatives in z, twice, and in the
    parameters, forwards and backwards.
    """
    at = lambda z, p: D.from_normal(make(p), z)
    z, p = jnp.asarray([-3.0, 0.3, 2.0]), jnp.asarray(parameter)
    in_z, in_p = jax.grad(at), jax.grad(at, 1)

    def difference(f, h=1e-5):
        return (mapped(f, z + h) - mapped(f, z - h)) / (2 * h)

    np.testing.assert_allclose(
        mapped(lambda z: in_z(z, p), z), difference(lambda z: at(z, p)), rtol=1e-5
    )
    np.testing.assert_allclose(
        mapped(lambda z: jax.jvp(lambda z: in_z(z, p), (z,), (1.0,))[1], z),
        difference(lambda z: in_z(z, p)),
        rtol=1e-4,
        atol=1e-7,
    )
    if np.isfinite(parameter):
        ends = [mapped(lambda z, p=p: at(z, p), z) for p in (parameter + 1e-5, parameter - 1e-5)]
        np.testing.assert_allclose(
            mapped(lambda z: in_p(z, p), z), (ends[0] - ends[1]) / 2e-5, 1e-5, 1e-9
        )


SOLVED = "t", "cauchy", "gamma", "gamma below 1", "beta", "beta below 1"
COUNTED = "poisson", "rare", "binomial"


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVED + COUNTED)
def test_shapes_that_are_known_need_no_solver(name):
    """A table serves where they are; what passed through a transformation is solved for, to the
    same values. Tables are right beyond what the functions of float32 can tell, too.
    """
    d, scipys = (floats("float32") | counts("float32"))[name]
    z = jnp.asarray(np.concatenate([np.linspace(-11, 11, 801), Z]), jnp.float32)
    by_table = jax.vmap(lambda z: D.from_normal(d, z))
    by_solver = lambda z: jax.vmap(D.from_normal, (None, 0))(jax.tree.map(jnp.asarray, d), z)
    for function, solves in ((by_table, False), (by_solver, True)):
        text = str(jax.make_jaxpr(function)(z))
        assert ("igamma" in text or "regularized_incomplete_beta" in text) == solves
    found, middle = np.asarray(jax.jit(by_table)(z)), np.abs(z) < 7
    solved = np.asarray(jax.jit(by_solver)(z))
    if name in COUNTED:  # where one number ends and another begins, rounding decides
        assert np.mean((found != solved)[middle]) < 0.01
        upper, z = found[z > 0], np.asarray(z[z > 0], float)
        assert (scipys.sf(upper) <= st.norm.sf(z) * 1.0001).all()
        assert (scipys.sf(upper - 1) >= st.norm.sf(z) * 0.9999).all()
        return
    right = truth(scipys, z)  # near 0, and below the least float, as they are
    assert (np.abs(found - right) <= 3e-5 * np.abs(right) + 1e-7 * middle + 1e-37).all()
    np.testing.assert_allclose(found[middle], solved[middle], rtol=2e-4, atol=1e-5)
    slopes = [
        jax.jit(jax.vmap(jax.grad(lambda z, f=f: f(z[None])[0])))(z) for f in (by_table, by_solver)
    ]
    np.testing.assert_allclose(*(np.asarray(s)[middle] for s in slopes), rtol=3e-3, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    mark_long(floats("float32") | counts("float32"), *floats("float32"), "geometric"),
)
def test_every_family_is_a_disturbance(name, key):
    """Of one step that fails where its number is rare; by populations, whose keys are not
    Threefry's.
    """
    d, scipys = (floats("float32") | counts("float32"))[name]
    # in float32 a thousandth of the numbers of "beta below 1" are 1
    edge = float(scipys.isf(0.1 if name == "beta below 1" else 1e-3))
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda state, x: jnp.asarray(x, jnp.float32),
        disturbance=lambda state: d,
        evaluate=lambda state: (state > edge, jnp.maximum(edge - state, 0.0)),
        horizon=1,
    )
    sim = jast.check(sim)
    found = jast.estimate.population(key, sim, 20_000)
    # of the tails that SciPy has; HalfNormal is its chi-square's
    truth = scipys.sf(edge) if name in counts("float32") or name == "beta below 1" else 1e-3
    assert found.interval[0] / 1.3 < truth < found.interval[1] * 1.3
    assert jast.estimate.monte_carlo(key, sim, 1000).invalid == 0


def test_counts_beyond_what_floats_can_tell_apart():
    """Neighbours among floats of 1e9 are 64 apart; the search for the number ends all the same."""
    k = jax.jit(jax.vmap(lambda z: D.from_normal(D.Poisson(1e9), z)))(jnp.asarray([-2.0, 0.0, 3.0]))
    np.testing.assert_allclose(k, 1e9 + 1e9**0.5 * np.asarray([-2, 0, 3]), atol=2000)


def test_few_degrees_of_freedom_go_on_where_the_square_is_no_float():
    """SciPy's, to some hundred units of rounding of float32, where values are 1e23 to 1e32; with
    degrees of freedom that are traced, so that no table serves.
    """
    truth, z = st.t(0.7), np.array([-10.0, 8.5, 9.0, 10.0])
    t = np.sign(z) * truth.isf(st.norm.sf(np.abs(z)))
    df, of_z, of_t = jnp.float32(0.7), jnp.float32(z), jnp.float32(t)
    there = jax.jit(lambda df, z: D.from_normal(D.StudentT(df), z))(df, of_z)
    np.testing.assert_allclose(there, t, rtol=1e-4)
    np.testing.assert_allclose(D.StudentT(df).log_prob(of_t), truth.logpdf(t), rtol=1e-6)
    back, slope = jax.vmap(jax.value_and_grad(lambda x: D.to_normal(D.StudentT(df), x)))(of_t)
    np.testing.assert_allclose(back, z, rtol=1e-6)
    expected = np.exp(truth.logpdf(t) - st.norm.logpdf(z))
    np.testing.assert_allclose(slope / expected, 1, rtol=1e-4)


@pytest.mark.parametrize("rate", [100.0, 205.0, 1e4, 1e5, 1e6])
def test_large_counts_are_scipys_in_float32_too(rate):
    """Out to |z| = 7; with a rate that is traced, so that no table serves. 1e-4: of the incomplete
    gamma function at 100, below what is large.
    """
    z = np.linspace(-7, 7, 57)
    d, of_z = st.poisson(rate), jnp.float32(z)
    place = jax.jit(lambda rate, z: D.from_normal(D.Poisson(rate), z))
    k = np.asarray(place(jnp.float32(rate), of_z))
    assert k.tolist() == np.where(z < 0, d.ppf(st.norm.cdf(z)), d.isf(st.norm.sf(z))).tolist()
    half, near = d.pmf(k) / 2, 1e-4 if rate < 200 else 3e-5
    below, above = d.cdf(k - 1) + half, d.sf(k) + half
    middle = np.where(below < above, st.norm.ppf(below), st.norm.isf(above))
    np.testing.assert_allclose(D.to_normal(D.Poisson(jnp.float32(rate)), k), middle, atol=near)
    np.testing.assert_allclose(D.Poisson(rate).log_prob(k), d.logpmf(k), atol=near)
    slope = jax.grad(lambda rate: D.Poisson(rate).log_prob(k[40]))(jnp.float32(rate))
    np.testing.assert_allclose(slope, k[40] / rate - 1, rtol=1e-4)


@pytest.mark.parametrize("kind", [D.Gamma, D.Weibull])
def test_a_shape_of_one_is_the_exponential(kind, dtype):
    """At 0, too, where the log of the number is infinite; slopes as well."""
    x = jnp.asarray([0.0, 0.3, 2.0], dtype)
    d, same = kind(jnp.ones((), dtype), jnp.ones((), dtype)), D.Exponential(jnp.ones((), dtype))
    np.testing.assert_allclose(d.log_prob(x), same.log_prob(x), atol=1e-6)
    np.testing.assert_allclose(D.log_density(d, x, "mode"), -x, atol=2e-6)
    np.testing.assert_allclose(jax.vmap(jax.grad(d.log_prob))(x), -jnp.ones(3), atol=1e-6)
    assert float(D.mode(d)) == 0


@pytest.mark.parametrize(
    "d",
    [
        D.Gamma(0.5, 2.0),
        D.Beta(0.5, 2.0),
        D.Beta(2.0, 0.5),
        D.Beta(0.5, 0.5),
        D.Beta(1.0, 1.0),
        D.Weibull(0.7, 2.0),
    ],
    ids=lambda d: f"{d.name} {d.mean() if hasattr(d, 'mean') else ''}",
)
def test_where_a_density_has_no_maximum_there_is_a_middle(d):
    """The undisturbed episode needs a value, and log p relative to it a density."""
    middle = D.mode(d)
    assert 0.1 < float(D.cdf(d, middle)) < 0.9
    assert np.isfinite(D.log_mode(d)) and np.isfinite(D.log_density(d, 0.3, "mode"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "d, scipys",
    [
        (D.Poisson(0.2), st.poisson(0.2)),
        (D.Poisson(500.0), st.poisson(500)),
        (D.Binomial(1000, 0.01), st.binom(1000, 0.01)),
        (D.Binomial(5, 0.999), st.binom(5, 0.999)),
        (D.Binomial(0, 0.5), st.binom(0, 0.5)),
    ],
)
def test_counts_are_found_from_far_and_near(d, scipys, x64):
    """From a guess that is good in the middle, and far off in the tails of few."""
    k = mapped(lambda z: D.from_normal(jax.tree.map(jnp.float64, d), z), jnp.asarray(Z))
    np.testing.assert_allclose(k, truth(scipys, Z), atol=1e-9)


def test_tails_below_the_least_float_have_their_normal_numbers(dtype):
    log_p = np.append(-np.linspace(0.7, 708, 5001), -np.inf).astype(dtype)
    z = normal_of_log_tails(jnp.array(log_p), log_one_less(jnp.array(log_p)))
    known = np.where(np.isinf(log_p), np.log(np.finfo(dtype).tiny), log_p)  # 0 may be rounded
    theirs = scipy.special.ndtri_exp(known.astype(float))
    np.testing.assert_allclose(z, theirs, rtol=max(4 * np.finfo(dtype).eps, 1e-11))


@pytest.mark.slow
def test_the_logs_of_the_tails_invert(dtype):
    z = jnp.linspace(-12, 12, 241, dtype=dtype)
    below, above = log_tails(z)
    np.testing.assert_allclose(below, st.norm.logcdf(np.asarray(z, float)), rtol=2e-5)
    np.testing.assert_allclose(above, st.norm.logsf(np.asarray(z, float)), rtol=2e-5)
    np.testing.assert_allclose(normal_of_log_tails(below, above), z, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.long)], indirect=True
)
def test_a_family_of_the_users_own_is_one_row(dtype, key):
    class Rayleigh(D.Distribution):
        event_shape = ()

        def __init__(self, scale):
            self.scale = scale

        def _sample_n(self, key, n):
            u = jax.random.uniform(key, (n,), self.scale.dtype)
            return self.scale * jnp.sqrt(-2 * jnp.log1p(-u))

        def log_prob(self, x):
            return jnp.log(x / self.scale**2) - (x / self.scale) ** 2 / 2

    d = Rayleigh(jnp.asarray(2.0, dtype))
    z = jnp.asarray(6.5, dtype)
    assert not D.has_quantile(d) and not D.has_exact_tails(d)
    tails = lambda d, x: (jnp.log(-jnp.expm1(-((x / d.scale) ** 2) / 2)), -((x / d.scale) ** 2) / 2)
    D.register(
        Rayleigh,
        quantile=lambda d, u: d.scale * jnp.sqrt(-2 * jnp.log1p(-u)),
        cdf=lambda d, x: -jnp.expm1(-((x / d.scale) ** 2) / 2),
        from_normal=lambda d, z: d.scale * jnp.sqrt(-2 * log_tails(z)[1]),
        to_normal=lambda d, x: normal_of_log_tails(*tails(d, x)),
    )
    assert D.has_quantile(d)
    assert D.has_cdf(d)
    assert D.has_exact_tails(d)
    x = D.from_normal(d, z)
    assert float(x) == pytest.approx(2 * np.sqrt(-2 * st.norm.logsf(6.5)), rel=1e-5)
    assert float(D.to_normal(d, x)) == pytest.approx(6.5, rel=1e-5)
    moved = D.tilted(D.Joint((d,)), (z,), (jnp.ones_like(z),))
    assert float(moved.sample(seed=key)[0]) > float(D.from_normal(d, z - 5))
    with pytest.raises(ValueError, match="register: 'ppf' is no function of a row"):
        D.register(Rayleigh, ppf=lambda d, u: u)
    with pytest.raises(ValueError, match="register: cdf: expected a function, received 3"):
        D.register(Rayleigh, cdf=3)
    with pytest.raises(ValueError, match='register: expected a class or "package:Class"'):
        D.register("Rayleigh", cdf=lambda d, x: x)


def test_counts_at_the_edge_of_their_parameters(dtype):
    """All of the probability is at one number."""
    for d, all_at, none_at in (
        (D.Poisson(0.0), 0, 1),
        (D.Geometric(1.0), 0, 1),
        (D.Binomial(5.0, 1.0), 5, 4),
        (D.Binomial(5.0, 0.0), 0, 1),
    ):
        assert abs(d.log_prob(all_at)) < 1e-6 and d.log_prob(none_at) == -jnp.inf
        below, above = d.log_tails(jnp.asarray([-1.0, all_at]))
        assert below.tolist() == [-np.inf, 0] and above.tolist() == [0, -np.inf]
        x = D.from_normal(d, jnp.linspace(-4, 4, 9))
        assert (x == all_at).all()


def test_a_mixture_of_counts_has_no_quantile_function():
    """Newton's rule would come to numbers between whole ones, whose probability is 0."""
    each = D.Poisson(jnp.array([2.0, 20.0]))
    d = D.MixtureSameFamily(D.Categorical(probs=jnp.array([0.5, 0.5])), each)
    assert not D.has_quantile(d) and jnp.isfinite(d.log_prob(3))
    with pytest.raises(ValueError, match="quantile: MixtureSameFamily has no quantile function"):
        D.quantile(d, jnp.array(0.5))


def test_whole_numbers_are_settings_of_a_tent_and_seeds_of_a_choice():
    assert D.tent(0, 0.5).log_prob(0.1) == D.tent(0.0, 0.5).log_prob(0.1) > 0
    assert 0 <= D.tent(0, 0.5).sample(seed=3) < 0.5
    d = D.where(True, D.Normal(0.0, 1.0), D.Normal(1.0, 1.0))
    assert d.sample(seed=3) == D.Normal(0.0, 1.0).sample(seed=3)


@pytest.mark.parametrize("count", [0.0, 1.0, 2.0])
def test_next_to_no_counts_of_a_large_mean(count):
    """1e8 less what a count of one or two adds; (1 + t) log(1 + t) is 0 where t rounds to -1."""
    d = D.Poisson(1e8)
    low, high = d.log_tails(jnp.float32(count))
    assert float(d.log_prob(jnp.float32(count))) == pytest.approx(-1e8, rel=1e-5)
    assert float(low) < -1e7 and float(high) == pytest.approx(0, abs=1e-6)
