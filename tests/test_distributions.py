import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

import jast
from jast import distributions as D
from jast._src.distributions import normal_tails

unit = st.floats(0.0, 1.0, width=32)


def tolerance(dtype, single, double):
    return single if dtype == "float32" else double


def supported(dtype):
    """(distribution, its quantile function by SciPy or None) for each class that `quantile`
    knows.
    """
    f = lambda v: jnp.asarray(v, dtype)
    chol = np.array([[1.0, 0.0], [0.5, 2.0]])
    u2 = np.array([0.2, 0.9])
    return {
        "uniform": (D.Uniform(f(-1), f(3)), lambda u: -1 + 4 * u),
        "normal": (D.Normal(f(1), f(2)), lambda u: scipy.stats.norm.ppf(u, 1, 2)),
        "diag": (
            D.MultivariateNormalDiag(f([0, 1]), f([1, 3])),
            lambda u: scipy.stats.norm.ppf(u2, [0, 1], [1, 3]),
        ),
        "tri": (
            D.MultivariateNormalTri(f([0, 1]), f(chol)),
            lambda u: np.array([0, 1]) + chol @ scipy.stats.norm.ppf(u2),
        ),
        "logistic": (D.Logistic(f(1), f(0.5)), lambda u: scipy.stats.logistic.ppf(u, 1, 0.5)),
        "laplace": (D.Laplace(f(1), f(0.5)), lambda u: scipy.stats.laplace.ppf(u, 1, 0.5)),
        "bernoulli": (D.Bernoulli(probs=f(0.3)), lambda u: scipy.stats.bernoulli.ppf(u, 0.3)),
        "categorical": (
            D.Categorical(probs=f([0.2, 0.5, 0.3])),
            lambda u: scipy.stats.rv_discrete(values=([0, 1, 2], [0.2, 0.5, 0.3])).ppf(u),
        ),
        "independent": (
            D.Independent(D.Normal(f([0, 1]), f([1, 3])), 1),
            lambda u: scipy.stats.norm.ppf(u2, [0, 1], [1, 3]),
        ),
        "exp": (
            D.Transformed(D.Normal(f(0), f(1)), jnp.exp),
            lambda u: scipy.stats.lognorm.ppf(u, 1),
        ),
        "tent": (D.tent(f(0.5)), lambda u: scipy.stats.triang.ppf(0.125 + u * 0.75, 0.5, -0.5, 2)),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", list(supported("float32")))
def test_quantile_is_scipys(name, dtype):
    d, truth = supported(dtype)[name]
    like = D.event_like(d)
    assert D.has_quantile(d)
    for u in (0.03, 0.25, 0.5, 0.71, 0.97):
        x = D.quantile(d, jnp.asarray(u if not like.shape else [0.2, 0.9], dtype))
        assert (x.shape, x.dtype) == (like.shape, like.dtype)
        np.testing.assert_allclose(
            x, truth(u), rtol=tolerance(dtype, 2e-5, 1e-9), atol=tolerance(dtype, 1e-6, 1e-12)
        )


@pytest.mark.slow
def test_quantiles_of_a_joint(dtype):
    d = D.Joint(
        (
            D.Normal(jnp.asarray(0, dtype), jnp.asarray(1, dtype)),
            D.Categorical(probs=jnp.asarray([0.5, 0.5], dtype)),
        )
    )
    x, n = D.quantile(d, (jnp.asarray(0.975, dtype), jnp.asarray(0.7, dtype)))
    assert float(x) == pytest.approx(1.959964, rel=1e-5) and int(n) == 1
    u, v = D.cdf(d, (x, n))
    assert float(u) == pytest.approx(0.975, rel=1e-5)
    assert float(v) == 0.75
    assert u.dtype == v.dtype == dtype


@pytest.mark.parametrize("bijector, truth", [("neg", 1.2), ("pos", -1.2)])
def test_quantile_of_a_decreasing_transform(bijector, truth):
    sign = -1.0 if bijector == "neg" else 1.0
    d = D.Transformed(D.Normal(0.0, 1.0), lambda x: sign * x)
    u = float(scipy.stats.norm.cdf(-1.2))
    # symmetric: the same value, from the other end
    assert float(D.quantile(d, jnp.asarray(u))) == pytest.approx(-1.2, rel=1e-4)
    assert float(
        D.quantile(D.Transformed(D.Uniform(0.0, 1.0), lambda x: sign * x), jnp.asarray(0.2))
    ) == pytest.approx(0.2 if sign > 0 else -0.8, rel=1e-5)


def test_parameters_of_two_precisions_and_masks_are_taken():
    single, double = jnp.float32(0.7), np.array(0.7)
    for low, high in ((single, double), (double, single)):
        assert D.Uniform(low, high).high == high
        assert D.Uniform(low + 1e-4, high + 1).high == high + 1
        with pytest.raises(ValueError, match="Uniform: high must be at least"):
            D.Uniform(low + 1, high)
    assert D.Categorical(probs=jnp.array([True, False, True])).probs.tolist() == [0.5, 0, 0.5]


def test_value_errors_name_the_distribution():
    shares = D.Dirichlet(jnp.asarray([2.0, 3.0]))
    with pytest.raises(ValueError, match="quantile: Dirichlet has no quantile function"):
        D.quantile(shares, jnp.asarray([0.5, 0.5]))
    with pytest.raises(ValueError, match="Seeds has neither a mode nor a median"):
        D.mode(D.seeds())
    assert not D.has_quantile(shares)
    assert not D.has_mode(D.seeds())
    assert D.has_mode(D.Fixed())


# cdf


def supported_too(dtype):
    """`supported`'s distributions, and more that `cdf` inverts."""
    f = lambda v: jnp.asarray(v, dtype)
    return {name: d for name, (d, _) in supported(dtype).items()} | {
        "upper": D.MultivariateNormalTri(f([0, 1]), f([[1, 0.5], [0, 2]]), is_lower=False),
        "wide tent": D.tent(f(2), f(5), f(-1), f(4)),
        "narrow tent": D.tent(f(0.9), f(0.3)),
        "logits": D.Categorical(logits=f([0.3, -2, 1])),
        "rolls": D.Independent(D.Categorical(probs=f([[0.2, 0.5, 0.3], [0.6, 0, 0.4]])), 1),
        "bool": D.Bernoulli(probs=f(0.3), dtype=bool),
        "decreasing": D.Transformed(D.Normal(f(0), f(1)), lambda x: jnp.exp(-x)),
        "affine": D.Transformed(D.Uniform(f(0), f(2)), lambda x: 3 - 2 * x),
        "vector of exp": D.Independent(D.Transformed(D.Normal(f([0, 1]), f([1, 0.5])), jnp.exp), 1),
        "where": D.where(False, D.Normal(f(0), f(1)), D.tent(f(0.2))),
        "where of ints": D.where(
            True, D.Categorical(probs=f([0.5, 0.5])), D.Bernoulli(probs=f(0.1))
        ),
        "joint": D.Joint(
            {
                "n": D.Categorical(probs=f([0.1, 0.9])),
                "v": D.Independent(D.Normal(f([0, 0, 1]), f([1, 2, 3])), 1),
                "x": D.Uniform(f(0), f(1)),
            }
        ),
    }


def points(d, n, low=0.0, high=1.0):
    """n points [n, ...] of [low, high]^d: an even grid in each coordinate, in an order of its
    own.
    """
    leaves, treedef = jax.tree.flatten(D.event_like(d))
    rng = np.random.default_rng(0)
    grids = [
        np.stack(
            [rng.permutation(np.linspace(low, high, n)) for _ in range(int(np.prod(s.shape)))], 1
        ).reshape(n, *s.shape)
        for s in leaves
    ]
    return treedef.unflatten(
        [jnp.asarray(g, D.float_dtype(s.dtype)) for g, s in zip(grids, leaves)]
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", list(supported_too("float32")))
def test_cdf_inverts_quantile(name, dtype):
    d = supported_too(dtype)[name]
    assert D.has_cdf(d) and D.has_quantile(d)

    @jax.jit
    @jax.vmap
    def there_and_back(u):
        x = D.quantile(d, u)
        again = D.cdf(d, x)
        return x, again, D.quantile(d, again)

    u = points(d, 501)
    x, again, x_again = there_and_back(u)
    assert jax.tree.structure(again) == jax.tree.structure(x)
    for leaves in zip(*map(jax.tree.leaves, (u, again, x, x_again)), strict=True):
        u, v, a, b = map(np.asarray, leaves)
        assert (v.shape, v.dtype) == (a.shape, u.dtype) and ((v >= 0) & (v <= 1)).all()
        if not np.issubdtype(a.dtype, np.floating):
            np.testing.assert_array_equal(a, b)
            continue
        np.testing.assert_allclose(v, u, rtol=0, atol=tolerance(dtype, 2e-6, 1e-14))
        inner = (u > 0.02) & (u < 0.98)  # nearer to the ends a number u has many x
        np.testing.assert_allclose(
            b[inner],
            a[inner],
            rtol=tolerance(dtype, 1e-4, 1e-12),
            atol=tolerance(dtype, 1e-5, 1e-13),
        )


@pytest.mark.slow
def test_cdf_of_arrays_is_elementwise(dtype):
    f = lambda v: jnp.asarray(v, dtype)
    tosses = D.Independent(D.Bernoulli(probs=f([[0.5, 0.2], [0.9, 0.0]])), 2)
    u = D.cdf(tosses, jnp.asarray([[1, 0], [1, 0]]))
    np.testing.assert_allclose(u, [[0.75, 0.4], [0.55, 0.5]], rtol=1e-6)
    with jax.numpy_rank_promotion("allow"):  # distrax's Bernoulli, asked for its dtype, draws
        assert u.dtype == dtype and D.quantile(tosses, u).tolist() == [[1, 0], [1, 0]]
    tents, x = D.tent(f([0.1, 2.0, 4.0]), f(5), f(-1), f(4)), f([0.5, -0.9, 3.9])
    np.testing.assert_allclose(D.quantile(tents, D.cdf(tents, x)), x, rtol=1e-4)
    assert D.cdf(tents, f([-2, 4.1, np.inf])).tolist() == [0, 1, 1]


def closed_forms():
    """SciPy's distribution function for each of `supported`; of integers, the middle of its
    step.
    """
    middle = lambda d: lambda x: (d.cdf(x - 1) + d.cdf(x)) / 2
    chol = np.array([[1.0, 0.0], [0.5, 2.0]])
    return {
        "uniform": lambda x: scipy.stats.uniform.cdf(x, -1, 4),
        "normal": lambda x: scipy.stats.norm.cdf(x, 1, 2),
        "diag": lambda x: scipy.stats.norm.cdf(x, [0, 1], [1, 3]),
        "tri": lambda x: scipy.stats.norm.cdf((x - np.array([0, 1])) @ np.linalg.inv(chol).T),
        "logistic": lambda x: scipy.stats.logistic.cdf(x, 1, 0.5),
        "laplace": lambda x: scipy.stats.laplace.cdf(x, 1, 0.5),
        "bernoulli": middle(scipy.stats.bernoulli(0.3)),
        "categorical": middle(scipy.stats.rv_discrete(values=([0, 1, 2], [0.2, 0.5, 0.3]))),
        "independent": lambda x: scipy.stats.norm.cdf(x, [0, 1], [1, 3]),
        "exp": lambda x: scipy.stats.lognorm.cdf(x, 1),
        "tent": lambda x: (scipy.stats.triang.cdf(x, 0.5, -0.5, 2) - 0.125) / 0.75,
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", list(supported("float32")))
def test_cdf_is_scipys(name, dtype):
    d, _ = supported(dtype)[name]
    x = jax.jit(jax.vmap(lambda u: D.quantile(d, u)))(points(d, 200, 0.01, 0.99))
    u = jax.jit(jax.vmap(lambda x: D.cdf(d, x)))(x)
    x = np.asarray(x, np.float64 if x.dtype == dtype else x.dtype)
    np.testing.assert_allclose(
        u,
        closed_forms()[name](x),
        rtol=tolerance(dtype, 1e-5, 1e-9),
        atol=tolerance(dtype, 1e-6, 1e-12),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in supported_too("float32") if name not in ("joint", "tri", "upper")]
)
def test_cdf_never_falls_and_ends_at_0_and_1(name, dtype):
    """From far below the support, infinity included, to far above it. Coordinates that are not
    independent are below.
    """
    d = supported_too(dtype)[name]
    like = D.event_like(d)
    if jnp.issubdtype(like.dtype, jnp.integer):
        ends, x = (0, 1), np.arange(-4, 8)
    elif like.dtype == bool:
        ends, x = (0.35, 0.85), np.array([False, True])
    else:
        ends, x = (
            (0, 1),
            np.concatenate(
                [[-np.inf, -1e30, -300], np.linspace(-12, 12, 2001), [300, 1e30, np.inf]]
            ),
        )
    x = jnp.asarray(
        np.broadcast_to(x.reshape(-1, *[1] * len(like.shape)), (x.size, *like.shape)), like.dtype
    )
    u = np.asarray(jax.jit(jax.vmap(lambda v: D.cdf(d, v)))(x))
    assert np.isfinite(u).all() and (np.diff(u, axis=0) >= -tolerance(dtype, 2e-7, 1e-15)).all()
    np.testing.assert_allclose(u[0], ends[0], rtol=1e-6)
    np.testing.assert_allclose(u[-1], ends[1], rtol=1e-6)


@pytest.mark.parametrize("name", ["tri", "upper"])
def test_cdf_of_dependent_coordinates_is_no_nan(name, dtype):
    d = supported_too(dtype)[name]
    for far in ([np.inf, 0], [0, -np.inf], [np.inf, np.inf], [-1e30, 1e30]):
        u = D.cdf(d, jnp.asarray(far, dtype))
        assert ((u >= 0) & (u <= 1)).all()
    independent = D.MultivariateNormalTri(jnp.zeros(2, dtype), 0.5 * jnp.eye(2, dtype=dtype))
    assert D.cdf(independent, jnp.asarray([np.inf, 0], dtype)).tolist() == [1, 0.5]


def test_cdf_outside_of_the_range_of_a_bijector(dtype):
    f = lambda v: jnp.asarray(v, dtype)
    above, below = (
        D.Transformed(D.Normal(f(0), f(1)), jnp.exp),
        D.Transformed(D.Normal(f(0), f(1)), lambda x: -jnp.exp(x)),
    )
    assert [float(D.cdf(above, f(x))) for x in (-2, 0, 1)] == [0, 0, 0.5]
    assert [float(D.cdf(below, f(x))) for x in (-1, 0, 2)] == [0.5, 1, 1]
    # on [1/2, 1], and the inverse of -1 is below 1
    inverse = D.Transformed(D.Uniform(f(1), f(2)), lambda x: 1 / x)
    assert [float(D.cdf(inverse, f(x))) for x in (-1, 0, 0.4, 0.5, 0.8, 1, 9)] == pytest.approx(
        [0, 0, 0, 0, 0.75, 1, 1], rel=1e-6
    )


def test_cdf_where_there_is_no_spread(dtype):
    f = lambda v: jnp.asarray(v, dtype)
    x = f([1, 2, 3])
    for d in (
        D.Normal(f([2, 2, 2]), f([0, 0, 0])),
        D.Laplace(f([2, 2, 2]), f([0, 0, 0])),
        D.MultivariateNormalDiag(f([2, 2, 2]), f([0, 0, 0])),
    ):
        assert D.cdf(d, x).tolist() == [0, 0.5, 1]
    assert D.cdf(D.Uniform(f(2), f(2)), f(2)) == 0.5


@jax.jit
def integers_again(weights):
    """Each of the integers by `cdf` and `quantile` of a Categorical, and of a Bernoulli by its
    first two weights; the probabilities of both.
    """
    again = lambda d: lambda x: D.quantile(d, D.cdf(d, x))
    die, coin = D.Categorical(probs=weights), D.Bernoulli(probs=weights[0])
    return (
        jax.vmap(again(die))(jnp.arange(weights.size)),
        die.probs,
        jax.vmap(again(coin))(jnp.arange(2)),
        jnp.stack([1 - coin.probs, coin.probs]),
    )


@settings(max_examples=100, deadline=None)
@given(
    weights=st.lists(
        st.one_of(st.just(0.0), st.floats(2.0**-20, 1.0, width=32)), min_size=9, max_size=9
    ).filter(any),
    double=st.booleans(),
)
def test_cdf_of_every_integer_leads_back_to_it(weights, double):
    with jax.enable_x64(double):
        rolls, die, tosses, coin = map(
            np.asarray, integers_again(jnp.asarray(weights, jnp.zeros(()).dtype))
        )
    assert (rolls == np.arange(9))[die > 0].all() and (tosses == np.arange(2))[coin > 0].all()


def test_cdf_of_an_integer_with_one_number_for_itself():
    eps = 2.0**-24
    d = D.Categorical(probs=jnp.asarray([0.5, 2 * eps, 0.5 - 2 * eps], jnp.float32))
    assert [int(D.quantile(d, D.cdf(d, jnp.asarray(i)).astype(jnp.float32))) for i in range(3)] == [
        0,
        1,
        2,
    ]
    assert [float(D.cdf(D.Categorical(probs=jnp.ones(1)), jnp.asarray(i))) for i in (-1, 0, 1)] == [
        0,
        0.5,
        1,
    ]


@settings(max_examples=60, deadline=None)
@given(center=unit, a=unit, b=unit)
def test_tent_cdf_rises_and_inverts_its_quantile(center, a, b):
    d = D.tent(jnp.float32(center))
    low, high = (float(d.cdf(jnp.float32(v))) for v in sorted((a, b)))
    assert 0 <= low <= high + 1e-6 and high <= 1
    assert float(d.cdf(d.quantile(jnp.float32(a)))) == pytest.approx(a, abs=2e-6)


def test_cdf_of_the_users_own(key):
    class Square(D.Distribution):  # x = u^2, so that cdf(x) = sqrt(x)
        event_shape = ()

        def _sample_n(self, key, n):
            return self.quantile(jax.random.uniform(key, (n,)))

        def log_prob(self, x):
            return -jnp.log(x) / 2

        def quantile(self, u):
            return u * u

    class Inverted(Square):
        def cdf(self, x):
            return jnp.sqrt(x)

    class Shifted(D.Normal):  # distrax's cdf is still that of the normal one
        def quantile(self, u):
            return D.quantile(D.Normal(1.0, 1.0), u)

    assert D.has_cdf(Inverted()) and D.cdf(Inverted(), jnp.asarray(0.25)) == 0.5
    assert D.cdf(
        D.Joint([Inverted(), D.Uniform(0.0, 2.0)]), [jnp.asarray(0.25), jnp.asarray(0.5)]
    ) == [0.5, 0.25]
    for d in (Square(), Shifted(0.0, 1.0)):
        assert D.has_quantile(d) and not D.has_cdf(d)
        with pytest.raises(
            ValueError, match=f"cdf: {type(d).__name__} has a method quantile, but no method cdf"
        ):
            D.cdf(d, jnp.asarray(0.25))


@pytest.mark.parametrize("d", [D.Normal(0.0, 1.0), D.Poisson(3.0), D.Gamma(2.0, 1.0)])
def test_quantile_takes_a_plain_number(d):
    assert D.quantile(d, 0.5) == D.quantile(d, jnp.asarray(0.5))


def test_quantile_of_a_joint_takes_plain_numbers():
    both = D.Joint({"a": D.Normal(0.0, 1.0), "b": D.Uniform(0.0, 1.0)})
    assert D.quantile(both, {"a": 0.5, "b": 0.25}) == {"a": 0, "b": 0.25}


def test_cdf_names_the_distribution_that_has_no_quantile():
    one = jnp.asarray(1.0)
    for d in (D.Dirichlet(jnp.stack([one, one])), D.seeds()):
        assert not D.has_cdf(d)
        for e in (d, D.where(True, d, d)) + (
            (D.Joint([D.Normal(0.0, 1.0), d]),) if d.event_shape == () else ()
        ):
            x = D.sample(d, jax.random.key(0))
            with pytest.raises(ValueError, match=f"cdf: {type(d).__name__} has no quantile"):
                D.cdf(e, [one, x] if isinstance(e, D.Joint) else x)
    twice = D.Transformed(D.Normal(0.0, 1.0), lambda x: x + jnp.exp(x))
    assert D.has_quantile(twice) and not D.has_cdf(twice)
    with pytest.raises(ValueError, match="cdf: Transformed has a bijector without inverse"):
        D.cdf(twice, one)


# tent


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_far_out_a_tent_still_has_a_density(dtype):
    """Its foot has none, and a search that came there would call the simulator's numbers bad."""
    with jax.enable_x64(dtype == "float64"):
        for center in (0.0, 0.3, 1.0):
            d = D.tent(jnp.asarray(center, dtype))
            x = D.quantile(d, jnp.asarray([0.0, 1e-30, 0.5, 1.0], dtype))
            assert jnp.isfinite(d.log_prob(x)).all() and jnp.isfinite(d.log_prob_from_mode(x)).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "center, width, low, high",
    [(0.5, 1, 0, 1), (0.0, 1, 0, 1), (1.0, 1, 0, 1), (0.9, 0.3, 0, 1), (2.0, 5, -1, 4)],
)
def test_tent(center, width, low, high, dtype, key):
    d = D.tent(*(jnp.asarray(v, dtype) for v in (center, width, low, high)))
    grid = jnp.linspace(low, high, 200_001, dtype=dtype)
    p = np.exp(np.asarray(jax.vmap(d.log_prob)(grid), np.float64))
    x = np.asarray(grid, np.float64)
    assert np.trapezoid(p, x) == pytest.approx(1, rel=tolerance(dtype, 1e-5, 1e-8))
    # the mode-normalised log density is the published step reward, with no normaliser in between
    inside = np.abs(x - center) < width * 0.999
    expected = np.log(1 - np.abs(x - center)[inside] / width)
    np.testing.assert_allclose(
        np.asarray(jax.vmap(lambda v: D.log_density(d, v, "mode"))(grid))[inside],
        expected,
        rtol=1e-3,
        atol=tolerance(dtype, 1e-3, 1e-10),
    )
    np.testing.assert_allclose(
        D.log_density(d, grid[7], "raw") - D.log_mode(d),
        D.log_density(d, grid[7], "mode"),
        rtol=1e-4,
        atol=1e-4,
    )
    u = jnp.linspace(0, 1, 101, dtype=dtype)
    q = np.asarray(jax.vmap(d.quantile)(u), np.float64)
    assert (np.diff(q) >= 0).all()
    assert q[0] >= low
    assert q[-1] <= high
    cdf = np.interp(q, x, np.concatenate([[0], np.cumsum((p[1:] + p[:-1]) / 2 * np.diff(x))]))
    np.testing.assert_allclose(cdf, u, atol=tolerance(dtype, 2e-4, 1e-6))
    mean, second = np.trapezoid(p * x, x), np.trapezoid(p * x * x, x)
    draws = np.asarray(d.sample(seed=key, sample_shape=(20_000,)), np.float64)
    assert abs(draws.mean() - mean) < 4 * np.sqrt((second - mean**2) / 20_000)
    assert float(D.mode(d)) == pytest.approx(center)


@settings(max_examples=60, deadline=None)
@given(center=unit, a=unit)
def test_tent_by_the_mode_is_the_papers_reward(center, a):
    got = float(D.log_density(D.tent(jnp.float32(center)), jnp.float32(a), "mode"))
    gap = np.float32(1) - np.abs(np.float32(a) - np.float32(center))
    assert got == (-np.inf if gap <= 0 else pytest.approx(np.log(gap), rel=1e-5, abs=1e-6))


@settings(max_examples=60, deadline=None)
@given(center=unit, u=unit)
def test_tent_quantile_stays_in_the_support(center, u):
    assert 0 <= float(D.tent(jnp.float32(center)).quantile(jnp.float32(u))) <= 1


def test_tent_outside_of_its_support_is_impossible_and_its_gradient_finite():
    d = D.tent(jnp.asarray(0.5))
    assert float(d.log_prob(jnp.asarray(1.2))) == -np.inf
    assert np.isfinite(jax.grad(lambda x: D.tent(x).log_prob(jnp.asarray(1.2)))(jnp.asarray(0.5)))


# where, seeds, Fixed, Deterministic


def test_where_is_the_chosen_one(key, dtype):
    a, b = D.Uniform(jnp.asarray(0, dtype), jnp.asarray(1, dtype)), D.tent(jnp.asarray(0.2, dtype))
    x, u = jnp.asarray(0.6, dtype), jnp.asarray(0.3, dtype)
    for pred, chosen in ((True, a), (False, b)):
        d = D.where(pred, a, b)
        assert d.sample(seed=key) == chosen.sample(seed=key)
        assert d.log_prob(x) == chosen.log_prob(x)
        assert D.mode(d) == D.mode(chosen)
        assert D.quantile(d, u) == D.quantile(chosen, u)
        assert D.log_density(d, x, "mode") == D.log_density(chosen, x, "mode")
        assert d.sample(seed=key, sample_shape=(3,)).shape == (3,) and d.log_prob(x).dtype == dtype


def test_where_under_vmap_and_jit(key):
    @jax.jit
    def draw(pred, key):
        d = D.where(pred, D.tent(jnp.asarray(0.9)), D.Normal(0.0, 1.0))
        x = D.sample(d, key)
        return x, d.log_prob(x)

    keys, preds = jax.random.split(key, 6), jnp.arange(6) % 2 == 0
    x, log_p = jax.vmap(draw)(preds, keys)
    for i in range(6):
        one = D.tent(jnp.asarray(0.9)) if preds[i] else D.Normal(0.0, 1.0)
        assert x[i] == pytest.approx(float(one.sample(seed=keys[i])), rel=1e-5)
        assert log_p[i] == pytest.approx(float(one.log_prob(x[i])), rel=1e-4)


def test_seeds(key):
    d = D.seeds((3,))
    x = d.sample(seed=key)
    assert (x.shape, x.dtype, float(d.log_prob(x))) == ((3,), jnp.uint32, 0.0)
    assert D.log_density(d, x, "mode") == 0
    assert len({int(v) for v in D.seeds().sample(seed=key, sample_shape=(1000,))}) > 990


def test_fixed_and_deterministic(key):
    assert D.Fixed().sample(seed=key) == ()
    assert D.mode(D.Fixed()) == ()
    assert D.Fixed().log_prob(()) == 0
    assert D.quantile(D.Fixed(), ()) == ()
    assert D.has_cdf(D.Fixed()) and D.cdf(D.Fixed(), ()) == ()
    d = D.Deterministic((jnp.ones(2), jnp.int32(3)))
    assert D.sample(d, key)[1] == 3 and d.log_prob(D.mode(d)) == 0
    assert D.log_density(d, D.mode(d), "mode") == 0


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_what_is_recorded_may_stand_beside_what_is_drawn(key, shape):
    recorded = D.Deterministic(jnp.arange(3.0))
    both = D.Joint({"recorded": recorded, "drawn": D.Normal(0.0, 1.0)})
    x = both.sample(seed=key, sample_shape=shape)
    assert x["drawn"].shape == shape and x["recorded"].shape == (*shape, 3)
    np.testing.assert_array_equal(x["recorded"], np.broadcast_to(np.arange(3.0), (*shape, 3)))


# densities


@pytest.mark.slow
@pytest.mark.parametrize("name", list(supported("float32")))
def test_log_density_is_raw_or_less_that_of_the_mode(name, dtype, key):
    d, _ = supported(dtype)[name]
    x = D.sample(d, key)
    # distrax's Bernoulli multiplies whole numbers and floats
    with jax.numpy_dtype_promotion("standard"):
        raw, by_mode, top = D.log_density(d, x), D.log_density(d, x, "mode"), D.log_mode(d)
        at_mode = D.log_density(d, D.mode(d), "mode")
    assert raw.shape == by_mode.shape == () and raw.dtype == by_mode.dtype == dtype
    np.testing.assert_allclose(raw - top, by_mode, rtol=1e-4, atol=tolerance(dtype, 1e-4, 1e-9))
    if name != "exp":  # its "mode" is the median
        assert by_mode <= 1e-5 and abs(float(at_mode)) < 1e-5


def test_joint_and_independent(key):
    d = D.Joint(
        {
            "a": D.Normal(0.0, 1.0),
            "n": D.Categorical(probs=jnp.asarray([0.1, 0.9])),
            "v": D.Independent(D.Normal(jnp.zeros(3), jnp.ones(3)), 1),
        }
    )
    x = D.sample(d, key)
    assert x["v"].shape == (3,) and jnp.issubdtype(x["n"].dtype, jnp.integer)
    parts = (
        scipy.stats.norm.logpdf(x["a"])
        + np.log([0.1, 0.9])[int(x["n"])]
        + scipy.stats.norm.logpdf(x["v"]).sum()
    )
    assert float(D.log_density(d, x)) == pytest.approx(parts, rel=1e-5)
    top = scipy.stats.norm.logpdf(0) * 4 + np.log(0.9)
    assert float(D.log_mode(d)) == pytest.approx(top, rel=1e-5)
    assert float(D.log_density(d, x, "mode")) == pytest.approx(parts - top, rel=1e-4)
    assert D.mode(d)["n"] == 1 and (D.mode(d)["v"] == 0).all()


def test_a_distribution_of_the_users_own_need_be_no_pytree(key):
    class Own:
        def sample(self, seed):
            return jax.random.normal(seed)

        def log_prob(self, x):
            return -x * x

    assert D.event_like(Own()).shape == ()
    assert not D.has_mode(Own())
    assert not D.has_quantile(Own())
    assert not D.has_cdf(Own())


@settings(max_examples=40, deadline=None)
@given(
    loc=st.floats(-10, 10, width=32),
    scale=st.floats(0.125, 8, width=32),
    u=st.floats(0.015625, 0.984375, width=32),
)
def test_normal_quantile_inverts_the_distribution_function(loc, scale, u):
    x = D.quantile(D.Normal(jnp.float32(loc), jnp.float32(scale)), jnp.float32(u))
    assert scipy.stats.norm.cdf(float(x), loc, scale) == pytest.approx(u, abs=1e-5)


def test_quantiles_of_uniform_numbers_are_draws(key):
    for name in ("tent", "bernoulli", "laplace"):
        d, _ = supported("float32")[name]
        u = jax.random.uniform(key, (20_000,), jnp.float32)
        x = np.asarray(jax.jit(jax.vmap(lambda v, d=d: D.quantile(d, v)))(u), np.float64)
        other = np.asarray(
            d.sample(seed=jax.random.fold_in(key, 1), sample_shape=(20_000,)), np.float64
        )
        assert abs(x.mean() - other.mean()) < 4 * np.sqrt((x.var() + other.var()) / 20_000)


@pytest.mark.slow
def test_slopes_of_the_normal_distribution_function_and_of_its_inverse(dtype):
    z = np.linspace(-5, 5, 41).astype(dtype)
    p = scipy.stats.norm.cdf(z).astype(dtype)
    density = scipy.stats.norm.pdf(z.astype(float))
    rtol = 1e-5 if dtype == "float32" else 1e-12
    slope = jax.vmap(jax.grad(normal_tails.ndtr))(z)
    np.testing.assert_allclose(slope, density, rtol=rtol)
    inverse = jax.vmap(jax.grad(normal_tails.ndtri))(p[z < 0])
    of_p = 1 / scipy.stats.norm.pdf(scipy.stats.norm.ppf(p[z < 0].astype(float)))
    np.testing.assert_allclose(inverse, of_p, rtol=30 * rtol)  # z itself is rounded, to z^2 eps


def test_a_certain_part_is_a_number_that_decides_nothing(key):
    """The sum of two normal numbers, each twice as large: P(Z > 12 / 8 ** .5)."""
    parts = D.Joint((D.Deterministic(jnp.array([1, 2])), D.Normal(0.0, 1.0)))
    sim = jast.Simulator(
        init=lambda x0: 0.0 * x0,
        step=lambda s, x: s + x[0][1].astype(s.dtype) * x[1],
        start=lambda: D.Deterministic(jnp.array(3.0)),
        disturbance=lambda s: parts,
        evaluate=lambda s: (s > 12.0, 12.0 - s),
        horizon=2,
        episodic=True,
    )
    z = (jnp.array([0.3, -0.2]), jnp.array(1.5))
    x = D.from_normal(parts, z)
    assert x[0].tolist() == [1, 2] and float(x[1]) == pytest.approx(1.5, rel=1e-6)
    assert D.to_normal(parts, x)[0].tolist() == [0.0, 0.0]
    assert D.cdf(D.Deterministic(2.0), jnp.array(1.9)) == 0
    assert D.cdf(D.Deterministic(2.0), jnp.array(2.0)) == 1
    found = jast.estimate.failure_probability(key, sim, 6000)
    assert found.reliable
    truth = scipy.stats.norm.sf(12 / 8**0.5)
    assert abs(found.mean - truth) < 4 * found.standard_error  # by chance one in 16,000


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: D.Tent(0.5, -1.0), "Tent: width must be at least 0"),
        (lambda: D.Tent(2.0), "Tent: center must lie between"),
        (lambda: D.Tent(0.5, 1.0, 1.0, 0.0), "Tent: center must lie between"),
        (lambda: D.Normal(0.0, float("nan")), "Normal: scale must be at least 0, received nan"),
        (lambda: D.Bernoulli(probs=float("nan")), "Bernoulli: probs must lie between"),
    ],
)
def test_parameters_that_make_no_distribution(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize("given", [dict(probs=0.2), dict(logits=-1.0), dict(probs=0.0)])
def test_a_coin_shows_nothing_but_0_and_1(given):
    coin = D.Bernoulli(**given)
    others = jnp.asarray([-5, -1, 2, 7])
    np.testing.assert_array_equal(coin.log_prob(others), -np.inf)
    both = jnp.exp(coin.log_prob(jnp.asarray([0, 1])))
    np.testing.assert_allclose(both.sum(), 1, rtol=1e-6)
