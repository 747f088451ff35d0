import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jast._src.cross_entropy import gaussian, mixture
from jast._src.cross_entropy.gaussian import Gaussian
from jast._src.cross_entropy.mixture import Mixture, em, log_prob, responsibilities, sample

WEIGHTS = np.array([0.5, 0.3, 0.2])
MEANS = np.array([[0.0, 0.0], [4.0, 1.0], [-3.0, 5.0]])
COVARIANCES = np.array(
    [[[1.0, 0.5], [0.5, 2.0]], [[0.3, 0.0], [0.0, 0.5]], [[2.0, -1.0], [-1.0, 1.0]]]
)
EM = jax.jit(em, static_argnames="iterations")


def log_likelihood(m, x, weights):
    """The sum of weights times log densities; a row of weight 0 may hold anything."""
    weights = weights.astype(x.dtype)
    values = log_prob(m, jnp.where(weights[:, None] > 0, x, 0))
    return jnp.sum(jnp.where(weights > 0, weights * values, 0))


SCORE, DENSITY, PARTS = jax.jit(log_likelihood), jax.jit(log_prob), jax.jit(responsibilities)
DRAW = jax.jit(sample, static_argnums=2)


def three(dtype):
    return Mixture(*(jnp.asarray(a, dtype) for a in (WEIGHTS, MEANS, COVARIANCES)))


def start(x, k, seed):
    """k components at points of x, wide and of one weight each."""
    rng = np.random.default_rng(seed)
    spread = np.cov(x.T) + 0.1 * np.eye(x.shape[1])
    return Mixture(
        np.full(k, 1 / k),
        x[rng.choice(len(x), k, replace=False)],
        np.broadcast_to(spread, (k, *spread.shape)).copy(),
    )


def data(seed, n=120):
    rng = np.random.default_rng(seed)
    which = rng.choice(3, n, p=WEIGHTS)
    return MEANS[which] + np.einsum(
        "nde,ne->nd", np.linalg.cholesky(COVARIANCES)[which], rng.normal(size=(n, 2))
    )


def put(m, dtype):
    return Mixture(*(jnp.asarray(a, dtype) for a in m))


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def scipys(m, x):
    """Weight times density [n, k]."""
    return np.stack(
        [
            w * scipy.stats.multivariate_normal(mean, c).pdf(x)
            for w, mean, c in zip(*m, strict=True)
        ],
        axis=-1,
    )


# sample, log_prob, responsibilities


def test_densities_are_scipys(dtype):
    x = np.random.default_rng(0).normal(0, 3, (4, 5, 2))
    joint, rtol = scipys((WEIGHTS, MEANS, COVARIANCES), x), 2e-5 if dtype == "float32" else 1e-11
    got, parts = (
        DENSITY(three(dtype), jnp.asarray(x, dtype)),
        PARTS(three(dtype), jnp.asarray(x, dtype)),
    )
    assert got.dtype == parts.dtype == dtype
    assert got.shape == (4, 5)
    assert parts.shape == (4, 5, 3)
    np.testing.assert_allclose(got, np.log(joint.sum(-1)), rtol=rtol)
    np.testing.assert_allclose(
        parts, joint / joint.sum(-1, keepdims=True), rtol=rtol * 10, atol=1e-30
    )
    one = jnp.asarray(x[0, 0], dtype)
    assert DENSITY(three(dtype), one).shape == () and PARTS(three(dtype), one).shape == (3,)


def test_samples_have_the_moments(dtype, key):
    n = 40_000
    x = np.asarray(DRAW(key, three(dtype), n), np.float64)
    mean = WEIGHTS @ MEANS
    c = MEANS - mean
    covariance = np.einsum("k,kde->de", WEIGHTS, COVARIANCES) + np.einsum(
        "k,kd,ke->de", WEIGHTS, c, c
    )
    assert (np.abs(x.mean(0) - mean) < 4.5 * np.sqrt(np.diag(covariance) / n)).all()
    squares = np.einsum("nd,ne->nde", x - mean, x - mean)
    assert (np.abs(squares.mean(0) - covariance) < 4.5 * squares.std(0) / np.sqrt(n)).all()
    # the coordinates one by one, by their distribution functions
    for i in range(2):
        cdf = lambda v, i=i: sum(
            w * scipy.stats.norm.cdf(v, m[i], np.sqrt(s[i, i]))
            for w, m, s in zip(WEIGHTS, MEANS, COVARIANCES, strict=True)
        )
        assert scipy.stats.kstest(x[:, i], cdf).pvalue > 1e-3


def test_far_from_everything_no_component_is_a_number(dtype):
    far = jnp.asarray(
        [[1e30 if dtype == "float32" else 1e200, 0.0], [np.inf, 0.0], [np.nan, 0.0], [0.0, 0.0]],
        dtype,
    )
    parts = np.asarray(PARTS(three(dtype), far))
    np.testing.assert_allclose(parts[:3], np.broadcast_to(WEIGHTS, (3, 3)), rtol=1e-6)
    np.testing.assert_allclose(parts.sum(1), 1, rtol=1e-6)


def test_a_component_without_weight_makes_nothing(key, dtype):
    m = three(dtype)._replace(weights=jnp.asarray([0.0, 1.0, 0.0], dtype))
    x = jnp.asarray(MEANS, dtype)
    truth = scipy.stats.multivariate_normal(MEANS[1], COVARIANCES[1]).logpdf(MEANS)
    np.testing.assert_allclose(DENSITY(m, x), truth, rtol=1e-5)
    assert PARTS(m, x).tolist() == [[0, 1, 0]] * 3
    # six standard deviations of the second one
    assert np.abs(DRAW(key, m, 200) - x[1][None]).max() < 5


# em


@pytest.mark.parametrize("regularisation", [0.0, 1e-6, 0.1])
@pytest.mark.parametrize("k", [1, 3, 5])
def test_em_is_that_of_scikit_learn(k, regularisation, x64):
    peers = pytest.importorskip("sklearn.mixture")
    x = data(k)
    m = start(x, k, 1)
    peer = peers.GaussianMixture(
        k,
        covariance_type="full",
        tol=0,
        reg_covar=regularisation,
        max_iter=10,
        weights_init=m.weights,
        means_init=m.means,
        precisions_init=np.linalg.inv(m.covariances),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "did not converge": ten iterations are asked for
        peer.fit(x)
    got = EM(put(m, "float64"), jnp.asarray(x), jnp.ones(len(x)), 10, regularisation, 0.0)
    for a, b in zip(got, (peer.weights_, peer.means_, peer.covariances_), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)
    assert float(SCORE(got, jnp.asarray(x), jnp.ones(len(x)))) == pytest.approx(
        peer.score(x) * len(x), rel=1e-10
    )


def test_em_by_the_text(dtype):
    """One iteration in NumPy, Bishop eq. 9.23 to 9.27, with weights."""
    x, w, m = data(0, 50), np.random.default_rng(1).uniform(0, 2, 50), (WEIGHTS, MEANS, COVARIANCES)
    joint = scipys(m, x)
    r = w[:, None] * joint / joint.sum(1, keepdims=True)
    means = r.T @ x / r.sum(0)[:, None]
    covariances = [
        (r[:, k, None] * (x - means[k])).T @ (x - means[k]) / r[:, k].sum() for k in range(3)
    ]
    got = EM(three(dtype), jnp.asarray(x, dtype), jnp.asarray(w, dtype), 1)
    assert all(a.dtype == dtype for a in got)
    tolerance = dict(rtol=1e-4, atol=1e-4) if dtype == "float32" else dict(rtol=1e-10)
    for a, b in zip(got, (r.sum(0) / r.sum(), means, covariances), strict=True):
        np.testing.assert_allclose(a, b, **tolerance)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), double=st.booleans(), least=st.sampled_from([0.0, 2.0, 30.0])
)
def test_no_iteration_lowers_the_likelihood(seed, double, least):
    with jax.enable_x64(double):
        dtype = jnp.zeros(()).dtype
        x, w = data(seed, 40), jnp.asarray(np.random.default_rng(seed).uniform(0, 2, 40), dtype)
        m, x = put(start(x, 4, seed), dtype), jnp.asarray(x, dtype)
        values = [float(SCORE(m, x, w))]
        for _ in range(15):
            m = EM(m, x, w, 1, 0.0, least)
            values.append(float(SCORE(m, x, w)))
    assert (
        np.diff(values).min() >= -1e-11 * abs(values[0])
        if double
        else np.diff(values).min() >= -1e-4 * abs(values[0])
    )


def test_iterations_add_up(dtype):
    x, w, m = jnp.asarray(data(2), dtype), jnp.ones(120, dtype), three(dtype)
    assert same(EM(m, x, w, 0), m)
    for a, b in zip(EM(m, x, w), EM(EM(m, x, w, 4), x, w, 6), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), double=st.booleans(), least=st.sampled_from([0.0, 3.0]))
@example(seed=5138, double=False, least=0.0)
def test_a_weight_is_a_number_of_rows(seed, double, least):
    rng = np.random.default_rng(seed)
    x, w = data(seed, 30), rng.integers(0, 4, 30)
    repeated = np.repeat(x, w, axis=0)
    m = start(repeated, 3, seed)
    # a row without weight may hold anything
    x[w == 0] = rng.choice([np.nan, np.inf, -np.inf, 1e30])
    with jax.enable_x64(double):
        dtype = jnp.zeros(()).dtype
        padded = np.zeros((90, 2))  # one shape for all, so one program
        padded[: len(repeated)] = repeated
        m, ones = put(m, dtype), np.arange(90) < len(repeated)
        rows, all_rows = (
            (jnp.asarray(x, dtype), jnp.asarray(w, dtype)),
            (jnp.asarray(padded, dtype), jnp.asarray(ones)),
        )
        # where a component collapses, float32's rounding grows from one iteration to the next
        times = 5 if double else 1
        got, expected = EM(m, *rows, times, 0.0, least), EM(m, *all_rows, times, 0.0, least)
        for a, b in zip(got, expected, strict=True):
            np.testing.assert_allclose(
                a, b, rtol=1e-8 if double else 1e-4, atol=1e-8 if double else 1e-4
            )
        assert float(SCORE(got, *rows)) == pytest.approx(
            float(SCORE(got, *all_rows)), rel=1e-8 if double else 1e-4
        )


def test_padding_is_nothing(dtype):
    x = data(4, 60)
    exact = EM(three(dtype), jnp.asarray(x, dtype), jnp.ones(60, dtype))
    padded = np.concatenate([x[:20], np.full((15, 2), np.nan), x[20:]])
    got = EM(three(dtype), jnp.asarray(padded, dtype), jnp.asarray(~np.isnan(padded[:, 0])))
    for a, b in zip(got, exact, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4 if dtype == "float32" else 1e-10, atol=1e-5)


@pytest.mark.slow
def test_a_small_component_keeps_its_covariance(dtype):
    """The third component has two points: fewer than three keep their covariance, and it takes two
    by default (d).
    """
    x = jnp.asarray(
        np.concatenate(
            [np.random.default_rng(0).normal(size=(40, 2)), [[50.0, 50.0], [51.0, 52.0]]]
        ),
        dtype,
    )
    m = Mixture(
        jnp.asarray([0.9, 0.1], dtype),
        jnp.asarray([[0.0, 0.0], [50.0, 50.0]], dtype),
        jnp.asarray([np.eye(2), 4 * np.eye(2)], dtype),
    )
    for least in (3.0, 2.5):
        got = EM(m, x, jnp.ones(42, dtype), least=least)
        assert got.covariances[1].tolist() == [[4, 0], [0, 4]]
        np.testing.assert_allclose(got.means[1], [50.5, 51], rtol=1e-6)
        np.testing.assert_allclose(got.weights, [40 / 42, 2 / 42], rtol=1e-5)
        assert not np.array_equal(got.covariances[0], m.covariances[0])
    # two points span a line, so the new covariance is refused, save with a regularisation: a
    # quarter and a half of the differences' products
    assert EM(m, x, jnp.ones(42, dtype)).covariances[1].tolist() == [[4, 0], [0, 4]]
    got = EM(m, x, jnp.ones(42, dtype), regularisation=0.1, least=1.5).covariances[1]
    np.testing.assert_allclose(got, [[0.35, 0.5], [0.5, 1.1]], rtol=1e-4)
    # the rule of the default is a count below d = 2, and scaled weights are other counts
    three_points = jnp.concatenate([x, jnp.asarray([[49.0, 53.0]], dtype)])
    assert EM(m, three_points, jnp.ones(43, dtype)).covariances[1].tolist() != [[4, 0], [0, 4]]
    assert EM(m, three_points, jnp.full(43, 0.5, dtype)).covariances[1].tolist() == [[4, 0], [0, 4]]


def test_a_component_that_no_point_belongs_to_stays(dtype):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(30, 2)), dtype)
    far = 1e6 if dtype == "float32" else 1e8
    m = Mixture(
        jnp.full(2, 0.5, dtype),
        jnp.asarray([[0.0, 0.0], [far, far]], dtype),
        jnp.asarray([np.eye(2)] * 2, dtype),
    )
    got = EM(m, x, jnp.ones(30, dtype))
    assert got.means[1].tolist() == [far, far] and got.covariances[1].tolist() == [[1, 0], [0, 1]]
    assert 0 < got.weights[1] < 1e-30 and np.isfinite(jnp.log(got.weights)).all()
    np.testing.assert_allclose(got.means[0], np.mean(x, axis=0), atol=1e-6)


@pytest.mark.parametrize(
    "x, w",
    [
        (np.random.default_rng(0).normal(size=(9, 2)), np.zeros(9)),
        (np.full((9, 2), np.nan), np.ones(9)),
        (np.full((9, 2), 3.0), np.ones(9)),
        (np.outer(np.arange(9.0), [1, 2]), np.ones(9)),
        (np.full((9, 2), np.inf), np.ones(9)),
        (np.concatenate([np.zeros((8, 2)), [[np.nan, 0.0]]]), np.ones(9)),
        (np.random.default_rng(0).normal(size=(9, 2)), np.full(9, np.inf)),
        (1e30 * np.random.default_rng(0).normal(size=(9, 2)), np.ones(9)),
        (1e-30 * np.random.default_rng(0).normal(size=(9, 2)), np.ones(9)),
        (np.random.default_rng(0).normal(size=(9, 2)), np.full(9, 1e-37)),
        (np.zeros((0, 2)), np.zeros(0)),
    ],
)
def test_em_never_returns_nan(x, w, dtype):
    for regularisation in (0.0, 1e-3):
        got = EM(three(dtype), jnp.asarray(x, dtype), jnp.asarray(w, dtype), 5, regularisation, 0.0)
        assert all(np.isfinite(a).all() for a in got)
        np.testing.assert_allclose(np.sum(got.weights), 1, rtol=1e-5)
        assert np.isfinite(np.linalg.cholesky(np.asarray(got.covariances, np.float64))).all()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    double=st.booleans(),
    least=st.sampled_from([0.0, 2.0]),
    exponent=st.integers(-12, 12),
)
def test_em_never_returns_nan_either(seed, double, least, exponent):
    """More components than the points are good for, some of them the same, at any scale."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(12, 2)) * 10.0**exponent
    x[rng.integers(12, size=4)] = x[0]
    m = start(x, 8, seed)
    m = m._replace(covariances=m.covariances * 100.0 ** rng.integers(-3, 3, (8, 1, 1)))
    with jax.enable_x64(double):
        dtype = jnp.zeros(()).dtype
        got = EM(
            put(m, dtype),
            jnp.asarray(x, dtype),
            jnp.asarray(rng.integers(0, 3, 12), dtype),
            30,
            0.0,
            least,
        )
        assert all(np.isfinite(a).all() for a in got)
        assert np.isfinite(jnp.linalg.cholesky(got.covariances)).all()
        assert np.isfinite(np.asarray(DENSITY(got, jnp.asarray(x, dtype)))).all()


def test_a_component_does_not_fall_into_a_point(dtype):
    """Many times the same point, and others: what rounding leaves of the spread about it is no
    covariance.
    """
    x = np.concatenate(
        [np.random.default_rng(1).normal(size=(20, 2)), np.full((9, 2), [100 / 3, -200 / 7])]
    )
    m = Mixture(
        np.full(2, 0.5), np.array([[0.0, 0.0], [33.0, -28.0]]), np.array([np.eye(2), np.eye(2)])
    )
    got = EM(put(m, dtype), jnp.asarray(x, dtype), jnp.ones(29, dtype), 10, 0.0, 0.0)
    assert got.covariances[1].tolist() == [[1, 0], [0, 1]]
    np.testing.assert_allclose(got.means[1], [100 / 3, -200 / 7], rtol=1e-6)


@pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.long)], indirect=True
)
def test_under_jit_and_vmap(dtype, key):
    x = jnp.stack([jnp.asarray(data(i, 50), dtype) for i in range(3)])
    w, reg = jax.random.uniform(key, (3, 50), dtype), jnp.asarray([0.0, 0.1, 1.0], dtype)

    def all_of_it(key, x, w, r):
        m = em(three(dtype), x, w, regularisation=r, least=r)
        return (
            m,
            log_prob(m, x),
            responsibilities(m, x),
            log_likelihood(m, x, w),
            sample(key, m, 10),
        )

    keys = jax.random.split(key, 3)
    got = jax.jit(jax.vmap(all_of_it))(keys, x, w, reg)
    alone = jax.jit(all_of_it)(keys[1], x[1], w[1], reg[1])
    np.testing.assert_allclose(log_prob(three(dtype), x[0]), DENSITY(three(dtype), x[0]), rtol=1e-5)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(alone), strict=True):
        assert a.dtype == b.dtype == dtype
        np.testing.assert_allclose(
            a[1],
            b,
            rtol=1e-3 if dtype == "float32" else 1e-9,
            atol=1e-4 if dtype == "float32" else 1e-9,
        )


def test_one_component_is_a_gaussian(dtype, key):
    x, w = jnp.asarray(data(5, 30), dtype), jax.random.uniform(key, (30,), dtype)
    g = Gaussian(jnp.zeros(2, dtype), jnp.eye(2, dtype=dtype))
    got, fitted = (
        EM(Mixture(jnp.ones(1, dtype), g.mean[None], g.covariance[None]), x, w, 1),
        jax.jit(gaussian.fit)(g, x, w),
    )
    np.testing.assert_allclose(got.means[0], fitted.mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(got.covariances[0], fitted.covariance, rtol=1e-4, atol=1e-5)


def test_a_soft_count_of_exactly_the_least_is_enough(dtype):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(6, 2)), dtype)
    one = Mixture(jnp.ones(1, dtype), jnp.zeros((1, 2), dtype), 9 * jnp.eye(2, dtype=dtype)[None])
    weights = jnp.ones(6, dtype)
    moved, kept = (em(one, x, weights, 1, least=least) for least in (6.0, 6.01))
    np.testing.assert_allclose(moved.covariances[0], np.cov(np.asarray(x).T, bias=True), rtol=1e-5)
    np.testing.assert_array_equal(kept.covariances, one.covariances)
    np.testing.assert_allclose(kept.means[0], np.mean(x, axis=0), rtol=1e-5, atol=1e-6)


def test_weights_of_a_proposal_are_shares():
    m = mixture.as_mixture(([1.0, 3.0], np.zeros((2, 1)), np.ones((2, 1, 1))))
    assert m.weights.tolist() == [0.25, 0.75]
    far = mixture.responsibilities(m._replace(weights=m.weights * 8), jnp.full((1,), 1e30))
    assert far.tolist() == [0.25, 0.75]
