"""The Gaussian process against scikit-learn's, and the least-squares surrogates against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jast._src.cross_entropy import surrogates
from jast._src.cross_entropy.surrogates import (
    JITTER,
    KERNELS,
    LENGTHSCALES,
    fit_process,
    predict_process,
)


def data(n, d, dtype=np.float64, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, d)).astype(dtype)
    return x, (np.sin(2 * x[:, 0]) + 0.5 * (x**2).sum(1)).astype(dtype)


def sklearn_process(kernel, x, y, lengthscale, noise, variance):
    pytest.importorskip("sklearn")
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern

    shape = (
        RBF(lengthscale)
        if kernel == "squared exponential"
        else Matern(lengthscale, nu={"matern12": 0.5, "matern32": 1.5, "matern52": 2.5}[kernel])
    )
    return GaussianProcessRegressor(
        ConstantKernel(variance) * shape, alpha=noise * variance, optimizer=None
    ).fit(x, y)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_posterior_and_likelihood_are_those_of_scikit_learn(kernel, x64):
    x, y = data(25, 3)
    new = data(40, 3, seed=1)[0]
    fitted = fit_process(
        jnp.asarray(x), jnp.asarray(y), jnp.ones(25, bool), (0.7,), (1e-3,), kernel
    )
    noise, variance = float(fitted.noise), float(fitted.variance)
    assert noise == pytest.approx(1e-3 + JITTER)
    peer = sklearn_process(kernel, x, y, 0.7, noise, variance)
    mean, deviation = peer.predict(new, return_std=True)
    ours, spread = predict_process(fitted, jnp.asarray(new), variance=True)
    # sqrt(r^2 + tiny) and the Cholesky factors differ in the last digits; condition about 1e3 x 25
    np.testing.assert_allclose(ours, mean, atol=1e-8)
    np.testing.assert_allclose(spread, deviation**2, atol=1e-8 * variance)
    np.testing.assert_allclose(predict_process(fitted, jnp.asarray(new)), ours)
    assert float(fitted.log_likelihood) == pytest.approx(
        peer.log_marginal_likelihood_value_, abs=1e-7
    )


def test_the_variance_is_the_likeliest(x64):
    x, y = data(25, 2)
    fitted = fit_process(jnp.asarray(x), jnp.asarray(y), jnp.ones(25, bool), (0.9,), (1e-3,))
    best = float(fitted.log_likelihood)
    for factor in (0.9, 0.99, 1.01, 1.1):
        peer = sklearn_process(
            "squared exponential", x, y, 0.9, float(fitted.noise), factor * float(fitted.variance)
        )
        assert peer.log_marginal_likelihood_value_ < best


@pytest.mark.long
def test_the_grid_gives_its_likeliest_point(x64):
    x, y = data(30, 2)
    lengthscales, noises = (0.1, 0.4, 1.0, 3.0), (1e-4, 1e-2, 1.0)
    fit = lambda a, b: fit_process(jnp.asarray(x), jnp.asarray(y), jnp.ones(30, bool), a, b)
    each = {(a, b): float(fit((a,), (b,)).log_likelihood) for a in lengthscales for b in noises}
    chosen = fit(lengthscales, noises)
    a, b = max(each, key=each.get)
    assert (float(chosen.lengthscale), float(chosen.noise)) == (
        pytest.approx(a),
        pytest.approx(b + JITTER),
    )
    assert float(chosen.log_likelihood) == pytest.approx(each[a, b])
    noisy = np.random.default_rng(3).normal(size=30)  # white noise: the most noise
    assert float(
        fit_process(
            jnp.asarray(x), jnp.asarray(noisy), jnp.ones(30, bool), lengthscales, noises
        ).noise
    ) == pytest.approx(1 + JITTER)


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.long)])
def test_masked_rows_do_nothing(dtype, x64):
    x, y = data(20, 2, dtype)
    new = jnp.asarray(data(15, 2, dtype, 1)[0])
    whole = fit_process(jnp.asarray(x), jnp.asarray(y), jnp.ones(20, bool), LENGTHSCALES)
    at = np.sort(np.random.default_rng(0).permutation(29)[:20])
    padded, values, mask = (
        np.full((29, 2), np.nan, dtype),
        np.full(29, np.inf, dtype),
        np.zeros(29, bool),
    )
    padded[at], values[at], mask[at] = x, y, True
    part = fit_process(jnp.asarray(padded), jnp.asarray(values), jnp.asarray(mask), LENGTHSCALES)
    assert (part.lengthscale, part.noise) == (whole.lengthscale, whole.noise)
    # the weights carry the condition of the matrix, 1e4 to 1e6 here, times the rounding
    tolerance = 2e-2 if dtype == np.float32 else 1e-9
    np.testing.assert_allclose(
        predict_process(part, new),
        predict_process(whole, new),
        atol=tolerance,
    )
    assert np.isfinite(predict_process(part, new)).all()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_points_are_finite(n):
    x, y = data(3, 2, np.float32)
    fitted = fit_process(jnp.asarray(x), jnp.asarray(y), jnp.arange(3) < n, LENGTHSCALES)
    mean, variance = predict_process(fitted, jnp.asarray(x), variance=True)
    assert np.isfinite(mean).all() and np.isfinite(variance).all()
    np.testing.assert_allclose(mean[:n], y[:n], rtol=0.05, atol=1e-3)
    if n == 0:
        np.testing.assert_array_equal(mean, 0)


def test_equal_points_and_equal_values_are_finite():
    x = jnp.zeros((8, 2))
    for y in (jnp.zeros(8), jnp.ones(8), jnp.arange(8.0)):
        fitted = fit_process(x, y, jnp.ones(8, bool), LENGTHSCALES)
        np.testing.assert_allclose(predict_process(fitted, x[:1]), y.mean(), rtol=0.02, atol=1e-6)


@pytest.mark.long
def test_it_vmaps():
    x, y = data(12, 2, np.float32)
    xs, ys = jnp.stack([x, 2 * x]), jnp.stack([y, -y])
    both = jax.vmap(
        lambda x, y: predict_process(
            fit_process(x, y, jnp.ones(12, bool), LENGTHSCALES), x[:3] + 0.1
        )
    )(xs, ys)
    for i in range(2):
        one = predict_process(
            fit_process(xs[i], ys[i], jnp.ones(12, bool), LENGTHSCALES),
            xs[i, :3] + 0.1,
        )
        # float32, condition up to 1e4
        np.testing.assert_allclose(both[i], one, rtol=2e-2, atol=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, detail",
    [
        ("linear", 1),
        ("polynomial", 2),
        ("polynomial", 3),
        ("radial basis", "gaussian"),
        ("radial basis", "linear"),
        ("radial basis", "squared"),
        ("radial basis", "multiquadratic"),
    ],
)
def test_least_squares_are_those_of_numpy(kind, detail, x64):
    x, y = data(40, 2)
    frame = surrogates.Frame(jnp.zeros(2), jnp.eye(2))
    r2 = lambda a, b: (a[None] - x[:, :1]) ** 2 + (b[None] - x[:, 1:]) ** 2
    second = lambda a, b: [a**0, a, b, a * a, a * b, b * b]
    features = {
        ("linear", 1): lambda a, b: np.stack([a**0, a, b]),
        ("polynomial", 2): lambda a, b: np.stack(second(a, b)),
        ("polynomial", 3): lambda a, b: np.stack([*second(a, b), a**3, a * a * b, a * b * b, b**3]),
        ("radial basis", "gaussian"): lambda a, b: np.exp(-r2(a, b) / 4),
        ("radial basis", "linear"): lambda a, b: np.sqrt(r2(a, b)),
        ("radial basis", "squared"): r2,
        ("radial basis", "multiquadratic"): lambda a, b: np.sqrt(r2(a, b) + 1),
    }[kind, detail]
    m = features(*x.T).T
    normal = m.T @ m
    weights = np.linalg.solve(
        normal + surrogates.RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal)), m.T @ y
    )
    new = data(30, 2, seed=2)[0]
    mask = jnp.arange(45) < 40
    padded = (
        jnp.asarray(np.concatenate([x, np.full((5, 2), np.nan)])),
        jnp.asarray(np.concatenate([y, np.full(5, np.nan)])),
    )
    fitted = surrogates.fit(kind, *padded, mask, frame, detail)
    np.testing.assert_allclose(fitted(jnp.asarray(new)), features(*new.T).T @ weights, rtol=2e-4)


@pytest.mark.slow
def test_a_polynomial_finds_a_paraboloid(x64):
    x = jnp.asarray(data(30, 3)[0])
    f = lambda x: (x[:, 0] - 1) ** 2 + x[:, 1] * x[:, 2] + 3
    mask = jnp.ones(30, bool)
    frame = surrogates.whitening_frame(x, mask)
    new = jnp.asarray(data(10, 3, seed=1)[0])
    np.testing.assert_allclose(
        surrogates.fit("polynomial", x, f(x), mask, frame, 2)(new),
        f(new),
        atol=0.02,
    )


FINITE = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)


@pytest.mark.long
@settings(deadline=None, max_examples=30)
@given(
    st.lists(FINITE | st.sampled_from([np.nan, np.inf, -np.inf]), min_size=1, max_size=12),
    st.integers(0, 4),
)
def test_ranks_are_normal_scores(values, padding):
    from scipy.stats import norm, rankdata

    y = np.array(values + [0.0] * padding, np.float32)
    mask = np.arange(len(y)) < len(values)
    scores, kept = surrogates.warp_values("rank", jnp.asarray(y), jnp.asarray(mask))
    real = np.where(np.isfinite(y), y, np.inf)[mask]  # what is not finite is the worst
    expected = norm.ppf(np.clip((rankdata(real) - 0.5) / len(real), 1e-4, 1 - 1e-4))
    np.testing.assert_array_equal(kept, mask)
    np.testing.assert_allclose(np.asarray(scores)[mask], expected, rtol=2e-4, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(scores)[~mask], 0)


def test_other_warps_leave_out_what_is_not_finite():
    y, mask = (
        jnp.array([1.0, -4.0, jnp.nan, 2.0, jnp.inf, 9.0]),
        jnp.array([True, True, True, True, True, False]),
    )
    raw, kept = surrogates.warp_values("raw", y, mask)
    np.testing.assert_array_equal(kept, [True, True, False, True, False, False])
    np.testing.assert_allclose(raw[kept], [0.25, -1, 0.5])
    standard, _ = surrogates.warp_values("standard", y, mask)
    used = np.array([1.0, -4.0, 2.0])
    np.testing.assert_allclose(standard[kept], (used - used.mean()) / used.std(), rtol=1e-5)
    for warp in surrogates.WARPS:
        scores, _ = surrogates.warp_values(warp, jnp.full(4, 3.0), jnp.ones(4, bool))
        assert np.isfinite(scores).all()
        scores, _ = surrogates.warp_values(warp, jnp.full(4, jnp.nan), jnp.ones(4, bool))
        assert np.isfinite(scores).all()


def test_no_monotone_change_alters_the_ranks():
    y = jnp.asarray(data(20, 2, np.float32)[1])
    mask = jnp.ones(20, bool)
    np.testing.assert_array_equal(
        surrogates.warp_values("rank", y, mask)[0],
        surrogates.warp_values("rank", jnp.exp(3 * y) - 5, mask)[0],
    )


def test_a_frame_whitens(x64):
    rng = np.random.default_rng(0)
    x = jnp.asarray(
        rng.multivariate_normal([5, -3, 1], [[4, 1.5, 0], [1.5, 1, 0], [0, 0, 1e-6]], size=200)
    )
    f = surrogates.whitening_frame(x, jnp.ones(200, bool))
    z = np.linalg.solve(f.factor, (np.asarray(x) - np.asarray(f.centre)).T)
    np.testing.assert_allclose(z.mean(1), 0, atol=1e-9)
    # a tenth of the identity is kept: between 1 / (0.9 + 0.1 / l) for the eigenvalues l of the
    # correlation
    values = np.linalg.eigvalsh(np.cov(z, bias=True))
    correlation = np.linalg.eigvalsh(np.corrcoef(x.T))
    np.testing.assert_allclose(
        np.sort(values), np.sort(correlation / (0.9 * correlation + 0.1)), rtol=1e-6
    )


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_a_frame_of_few_points_is_sound(rows):
    x = jnp.array([[1.0, 2.0], [1.0, 5.0], [jnp.nan, 0.0]])
    f = surrogates.whitening_frame(x, jnp.arange(3) < rows)
    assert np.isfinite(f.factor).all() and (np.diagonal(f.factor) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, detail",
    [*zip(surrogates.SURROGATES, ("squared exponential", 1, 2, "gaussian"), strict=True)],
)
@pytest.mark.parametrize("n", [0, 1, 3])
def test_surrogates_of_few_points_are_finite(kind, detail, n):
    x, y = (jnp.asarray(a) for a in data(3, 4, np.float32))
    mask = jnp.arange(3) < n
    fitted = surrogates.fit(kind, x, y, mask, surrogates.whitening_frame(x, mask), detail)
    assert np.isfinite(fitted(x + 1)).all()
