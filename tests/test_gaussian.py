import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from jast import distributions as D
from jast._src.cross_entropy.gaussian import (
    Gaussian,
    as_gaussian,
    fit,
    is_definite,
    log_prob,
    normal,
    sample,
)

MEAN, COVARIANCE = (
    np.array([1.0, -2.0, 0.5]),
    np.array([[4.0, 1.0, 0.5], [1.0, 2.0, -0.3], [0.5, -0.3, 0.5]]),
)
FIT, SCORE, DRAW, DEFINITE = (
    jax.jit(fit),
    jax.jit(log_prob),
    jax.jit(sample, static_argnums=2),
    jax.jit(is_definite, static_argnums=2),
)


def three(dtype):
    return normal(jnp.asarray(MEAN, dtype), jnp.asarray(COVARIANCE, dtype))


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


# normal, as_gaussian


def test_what_a_covariance_may_be(dtype):
    mean = jnp.zeros(2, dtype)
    for given_, expected in (
        (3, [[3, 0], [0, 3]]),
        (jnp.asarray([1.0, 2.0], dtype), [[1, 0], [0, 2]]),
        ([[2.0, 1.0], [1.0, 2.0]], [[2, 1], [1, 2]]),
    ):
        g = normal(mean, given_)
        assert g.mean.dtype == g.covariance.dtype == dtype and g.covariance.tolist() == expected
        assert same(jax.jit(normal)(mean, given_), g)
    assert normal([0, 0], 200).covariance.dtype == jnp.zeros(()).dtype
    assert (
        normal([5], [2.0]).covariance.tolist()
        == normal([5], [[2.0]]).covariance.tolist()
        == [[2.0]]
    )


def test_a_gaussian_by_many_names(dtype):
    g = three(dtype)
    factor = jnp.linalg.cholesky(g.covariance)
    for proposal in (
        g,
        (g.mean, g.covariance),
        [MEAN.astype(dtype), COVARIANCE.astype(dtype)],
        D.MultivariateNormalTri(g.mean, factor),
    ):
        got = as_gaussian(proposal)
        assert isinstance(got, Gaussian) and got.mean.dtype == got.covariance.dtype == dtype
        np.testing.assert_allclose(got.mean, MEAN)
        np.testing.assert_allclose(got.covariance, COVARIANCE, rtol=1e-6, atol=1e-6)
    got = as_gaussian(
        D.MultivariateNormalDiag(jnp.asarray([1.0, 2.0], dtype), jnp.asarray([3.0, 0.5], dtype))
    )
    assert got.mean.tolist() == [1, 2] and got.covariance.tolist() == [[9, 0], [0, 0.25]]


def test_a_sweep_over_starts(dtype):
    v = jnp.asarray([1.0, 2.0], dtype)
    assert jax.vmap(lambda c: as_gaussian(([c, 0.0], c)))(v).covariance.tolist() == [
        [[1, 0], [0, 1]],
        [[2, 0], [0, 2]],
    ]


@pytest.mark.parametrize(
    "mean, covariance, message",
    [
        (0.0, 1.0, r"mean must be a vector of one or more numbers, received shape \(\)"),
        ([], 1.0, r"mean must be a vector of one or more numbers, received shape \(0,\)"),
        ([0.0, np.nan], 1.0, "mean must be finite in float"),
        ("here", 1.0, "mean must be numbers, received 'here'"),
        (
            [0.0, 0.0],
            [1.0, 1.0, 1.0],
            r"covariance must be a number, 2 variances or a 2 x 2 matrix, received shape \(3,\)",
        ),
        ([0.0, 0.0], np.ones((1, 2)), "covariance must be a number, 2 variances or a 2 x 2 matrix"),
        ([0.0, 0.0], [1.0, np.inf], "covariance must be finite in float"),
        ([0.0, 0.0], 0.0, "covariance must be positive, received 0.0"),
        ([0.0, 0.0], [1.0, -1.0], "covariance must be positive, received"),
        ([0.0, 0.0], [[1.0, 0.5], [0.0, 1.0]], "covariance must be symmetric, received"),
        ([0.0, 0.0], [[1.0, 1.0], [1.0, 1.0]], "covariance must be positive definite, received"),
        ([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]], "covariance must be positive definite, received"),
        ([0.0, 0.0], [[0.0, 0.0], [0.0, 1.0]], "covariance must be positive definite, received"),
    ],
)
def test_bad_starts(mean, covariance, message, dtype):
    with pytest.raises(ValueError, match=f"normal: {message}"):
        normal(mean, covariance)
    with pytest.raises(ValueError, match=f"proposal: {message}"):
        as_gaussian((mean, covariance))


def test_what_is_no_start():
    for proposal in (None, 3.0, jnp.zeros((2, 2)), D.Normal(0.0, 1.0), (1, 2, 3)):
        with pytest.raises(ValueError, match="proposal: expected a Gaussian, .*, received"):
            as_gaussian(proposal)
    with pytest.raises(ValueError, match="normal: covariance must be a number, 2 variances"):
        jax.jit(normal)(jnp.zeros(2), jnp.ones(3))


# sample, log_prob


def test_log_prob_is_scipys(dtype):
    x = np.random.default_rng(0).normal(0, 3, (4, 5, 3))
    got = SCORE(three(dtype), jnp.asarray(x, dtype))
    assert got.dtype == dtype and got.shape == (4, 5)
    truth = scipy.stats.multivariate_normal(MEAN, COVARIANCE).logpdf(x)
    np.testing.assert_allclose(got, truth, rtol=1e-5 if dtype == "float32" else 1e-12)
    one = SCORE(three(dtype), jnp.asarray(x[0, 0], dtype))
    assert one.shape == () and float(one) == pytest.approx(truth[0, 0], rel=1e-5)


def test_samples_have_the_moments(dtype, key):
    n = 40_000
    x = np.asarray(DRAW(key, three(dtype), n))
    assert x.shape == (n, 3) and x.dtype == dtype
    assert (np.abs(x.mean(0) - MEAN) < 4.5 * np.sqrt(np.diag(COVARIANCE) / n)).all()
    # the variance of a product of two normal numbers: s_ii s_jj + s_ij^2
    error = np.sqrt((np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)) + COVARIANCE**2) / n)
    assert (np.abs(np.cov(x.T, bias=True) - COVARIANCE) < 4.5 * error).all()
    # and the squared Mahalanobis distances are chi-squared of three degrees
    r2 = np.einsum("nd,de,ne->n", x - MEAN, np.linalg.inv(COVARIANCE), x - MEAN)
    assert scipy.stats.kstest(r2, scipy.stats.chi2(3).cdf).pvalue > 1e-3


@pytest.mark.slow
def test_under_jit_and_vmap(dtype, key):
    def all_of_it(key, w):
        x = sample(key, three(dtype), 20)
        return (
            x,
            log_prob(three(dtype), x),
            fit(three(dtype), x, w),
            is_definite(*three(dtype)[::-1], 20),
        )

    keys, w = jax.random.split(key, 4), jax.random.uniform(key, (4, 20), dtype)
    got, alone = jax.jit(jax.vmap(all_of_it))(keys, w), jax.jit(all_of_it)(keys[2], w[2])
    np.testing.assert_allclose(log_prob(three(dtype), alone[0]), alone[1], rtol=1e-4)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(alone), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(
            a[2],
            b,
            rtol=1e-4 if dtype == "float32" else 1e-11,
            atol=1e-5 if dtype == "float32" else 1e-11,
        )


# fit


def test_fit_is_of_greatest_likelihood(dtype):
    rng = np.random.default_rng(1)
    x, w = (
        rng.normal(0, 2, (40, 3)) @ np.linalg.cholesky(COVARIANCE).T + MEAN,
        rng.uniform(0, 1, 40),
    )
    got = FIT(normal(jnp.zeros(3, dtype), 1.0), jnp.asarray(x, dtype), jnp.asarray(w, dtype))
    tolerance = dict(rtol=2e-5, atol=2e-5) if dtype == "float32" else dict(rtol=1e-12)
    assert got.mean.dtype == got.covariance.dtype == dtype
    np.testing.assert_allclose(got.mean, np.average(x, axis=0, weights=w), **tolerance)
    np.testing.assert_allclose(got.covariance, np.cov(x.T, aweights=w, ddof=0), **tolerance)
    assert (got.covariance == got.covariance.T).all()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), double=st.booleans(), scale=st.integers(-10, 10))
def test_weights_are_ratios_and_multiplicities(seed, double, scale):
    rng = np.random.default_rng(seed)
    x, w = rng.normal(0, 1, (12, 2)), rng.integers(0, 4, 12)
    w[:4] = np.maximum(w[:4], 1)
    repeated = np.repeat(x, w, axis=0)
    # a row without weight may hold anything
    x[w == 0] = rng.choice([np.nan, np.inf, -np.inf, 1e30, 0.0])
    with jax.enable_x64(double):
        dtype = jnp.zeros(()).dtype
        old = normal(jnp.zeros(2), 1.0)
        got = FIT(old, jnp.asarray(x, dtype), jnp.asarray(w, dtype))
        assert np.isfinite(got.covariance).all() and not same(got, old)
        np.testing.assert_allclose(got.mean, repeated.mean(0), atol=1e-5)
        np.testing.assert_allclose(got.covariance, np.cov(repeated.T, bias=True), atol=2e-5)
        again = FIT(
            old,
            jnp.asarray(x, dtype),
            jnp.asarray(w * 2.0 ** (scale * (100 if double else 10)), dtype),
        )
        assert same(got, again)


def test_weights_may_be_a_mask(dtype):
    x = jnp.asarray(np.random.default_rng(2).normal(size=(10, 2)), dtype)
    mask = jnp.arange(10) < 6
    old = normal(jnp.zeros(2, dtype), 1.0)
    assert same(FIT(old, x, mask), FIT(old, x, mask.astype(dtype)))
    np.testing.assert_allclose(
        FIT(old, x, mask).covariance, np.cov(np.asarray(x)[:6].T, bias=True), rtol=1e-4
    )


@pytest.mark.parametrize(
    "x, w",
    [
        (np.eye(2), np.ones(2)),  # two points span a line
        ([[1.0, 2.0]] * 5, np.ones(5)),
        ([[0.0, 0.0], [1.0, 3.0], [2.0, 6.0], [0.1, 0.3]], np.ones(4)),
        ([[0.0, 1.0], [0.5, 1.0], [2.0, 1.0]], np.ones(3)),
        (np.random.default_rng(0).normal(size=(5, 2)), np.zeros(5)),
        (np.random.default_rng(0).normal(size=(5, 2)), [1.0, 1.0, 0.0, 0.0, 0.0]),
        ([[0.0, 1.0], [np.nan, 2.0], [3.0, 3.0], [1.0, 0.0]], np.ones(4)),
        ([[0.0, 1.0], [np.inf, 2.0], [3.0, 3.0], [1.0, 0.0]], np.ones(4)),
        ([[0.0, 1.0], [1.0, 2.0], [3.0, 3.0], [1.0, 0.0]], [1.0, 1.0, np.inf, 1.0]),
        (np.zeros((0, 2)), np.zeros(0)),
    ],
)
def test_the_old_one_stays_where_there_is_no_new_one(x, w, dtype):
    old = normal(jnp.asarray([7.0, 8.0], dtype), jnp.asarray([[2.0, 0.5], [0.5, 1.0]], dtype))
    assert same(FIT(old, jnp.asarray(x, dtype), jnp.asarray(w, dtype)), old)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    d=st.sampled_from([2, 5]),
    double=st.booleans(),
    enough=st.booleans(),
)
def test_elites_that_do_not_span_the_space(seed, d, double, enough):
    """Thirty points in a random subspace of d - 1 dimensions, or d points alone, far from the
    origin or not; and d dimensions in truth.
    """
    rng, rows = np.random.default_rng(seed), 30
    with jax.enable_x64(double):
        dtype = jnp.zeros(()).dtype
        offset = rng.choice([0.0, 1000.0]) * rng.normal(size=d)
        scales = 10 ** rng.uniform(-3, 3, d)
        x = rng.normal(size=(rows, d)) * scales
        if enough:
            w = np.ones(rows)
        elif rng.random() < 0.5:
            w = np.arange(rows) < rng.integers(1, d + 1)  # too few
            x = x + offset
        else:
            x[:, -1] = x[:, :-1] @ rng.normal(size=d - 1)
            w = np.ones(rows)
        old = normal(jnp.zeros(d), 1.0)
        got = FIT(old, jnp.asarray(x, dtype), jnp.asarray(w, dtype))
        assert same(got, old) is not enough
        if enough:
            assert np.isfinite(SCORE(got, got.mean))
            assert np.isfinite(DRAW(jax.random.key(seed), got, 3)).all()


def test_the_spread_of_points_far_from_the_origin(dtype):
    """Points a thousand spreads away: the covariance is that of the points as they are stored, to
    the last digits.
    """
    x = (1000 + np.random.default_rng(3).normal(size=(50, 2))).astype(dtype)
    got = FIT(normal(jnp.zeros(2, dtype), 1.0), jnp.asarray(x), jnp.ones(50, dtype))
    np.testing.assert_allclose(
        got.covariance,
        np.cov(x.astype(np.float64).T, bias=True),
        rtol=2e-5 if dtype == "float32" else 1e-11,
    )


def test_is_definite(dtype):
    eps = float(jnp.finfo(dtype).eps)
    good = lambda a, mean=(0.0, 0.0): bool(
        DEFINITE(jnp.asarray(a, dtype), jnp.asarray(mean, dtype), 1)
    )
    assert good([[1e-8, 0.0], [0.0, 1e8]])  # units do not matter
    for gap, expected in ((100 * eps, True), (eps, False), (0.0, False), (-0.5, False)):
        assert good([[1.0, 1 - gap], [1 - gap, 1.0]]) is expected
    for a in (
        [[0.0, 0.0], [0.0, 1.0]],
        [[-1.0, 0.0], [0.0, 1.0]],
        [[1.0, np.nan], [np.nan, 1.0]],
        [[np.inf, 0.0], [0.0, 1.0]],
    ):
        assert not good(a)
    # of rank two: the second pivot is so small that the rounding errors of the third are far above
    # eps
    v = np.array([[1.0, 1.0, 0.3], [0.0, 0.003, 1.0]])
    assert not good(v.T @ v, np.zeros(3)) and good(v.T @ v + 1e-2 * np.eye(3), np.zeros(3))
    # no number near a thousand is stored finer than this
    for spread, expected in ((1e4 * eps, True), (1e3 * eps, False)):
        assert good([[1.0, 0.0], [0.0, spread**2]], (0.0, -1000.0)) is expected


@settings(max_examples=60, deadline=None)
@given(
    value=st.floats(-1e6, 1e6, width=32),
    w=st.lists(st.floats(2.0**-10, 1, width=32), min_size=7, max_size=7),
    double=st.booleans(),
)
def test_one_point_many_times_has_no_spread(value, w, double):
    """In one dimension too, where no correlation tells."""
    with jax.enable_x64(double):
        old = normal(jnp.asarray([3.0]), 2.0)
        assert same(FIT(old, jnp.full((7, 1), value), jnp.asarray(w)), old)
