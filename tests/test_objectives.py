import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from jast._src.cross_entropy.objectives import ackley, branin, paraboloid, sierra

near = st.floats(-12, 12)
AT = jax.jit(lambda f, x: f(x))  # one program for all sierras
# of the reference: place to a thousandth, value; each but the first also at minus the place
MINIMA = {
    (0, 0): -0.022002,
    (1.982, 1.975): -0.015447,
    (2.025, -2.015): -0.014235,
    (4.947, 1.206): -0.005245,
    (1.069, 5.069): -0.005127,
    (5.092, 5.059): -0.004767,
    (7.547, 1.677): -0.003631,
    (7.935, -1.749): -0.002372,
    (10.888, 4.894): -0.001699,
}


def sierra_by_the_text(
    x,
    mean=(0, 0),
    sigma=3.0,
    delta=2.0,
    eta=6.0,
    decay=1.0,
    paths=((0, 0), (1, 1), (2, 0), (3, 1), (0, 2), (1, 3)),
):
    """Component by component, in NumPy."""

    def density(centre, covariance):
        c = np.asarray(x, float) - centre
        return np.exp(-0.5 * c @ np.linalg.solve(covariance, c)) / (
            2 * np.pi * np.sqrt(np.linalg.det(covariance))
        )

    mean, whole = np.asarray(mean, float), np.diag([sigma, sigma])
    densities = [density(mean, whole / (sigma * eta))]
    for g in ((+delta, +delta), (+delta, -delta), (-delta, +delta), (-delta, -delta)):
        for i, p in enumerate(paths, 1):
            for s in (+sigma, -sigma):
                densities.append(
                    density(np.array(g) + s * np.array(p) + mean, i**decay * whole / eta)
                )
    assert len(densities) == 49
    return -sum(densities) / 49


THESIS = ((0, 0), (1, 1), (2, 0), (0, 2), (3, 1), (1, 3))


def test_sierra_at_the_origin(x64):
    assert float(AT(sierra(), jnp.zeros(2))) == pytest.approx(-0.02200237, abs=1e-8)
    assert float(AT(sierra(order="thesis"), jnp.zeros(2))) == pytest.approx(-0.02195106, abs=1e-8)


def test_sierras_minima(x64):
    f = sierra()
    value, slope, curvature = jax.jit(f), jax.jit(jax.grad(f)), jax.jit(jax.hessian(f))
    places = [np.array(p, float) * sign for p in MINIMA for sign in ((1, -1) if any(p) else (1,))]
    assert len(places) == 17
    for place in places:
        x = jnp.asarray(place)
        for _ in range(6):  # Newton's
            x = x - jnp.linalg.solve(curvature(x), slope(x))
        assert np.abs(np.asarray(x) - place).max() < 1e-3 and np.abs(slope(x)).max() < 1e-14
        assert np.linalg.eigvalsh(curvature(x))[0] > 1e-6
        assert float(value(x)) == pytest.approx(
            MINIMA[tuple(place) if tuple(place) in MINIMA else tuple(-place)], abs=1e-6
        )


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(x=st.tuples(near, near), thesis=st.booleans())
def test_sierra_is_that_of_the_text(x, thesis):
    truth = sierra_by_the_text(x, paths=THESIS) if thesis else sierra_by_the_text(x)
    with jax.enable_x64(True):
        order = "thesis" if thesis else "code"
        assert float(AT(sierra(order=order), jnp.asarray(x))) == pytest.approx(truth, rel=1e-12)
        assert float(AT(sierra(order=order, log=True), jnp.asarray(x))) == pytest.approx(
            -np.log(-truth), rel=1e-12
        )
    single = np.asarray(x, np.float32)
    truth = sierra_by_the_text(single, paths=THESIS) if thesis else sierra_by_the_text(single)
    assert float(AT(sierra(order=order), jnp.asarray(single))) == pytest.approx(truth, rel=2e-4)


@settings(max_examples=30, deadline=None)
@given(
    mean=st.tuples(near, near),
    sigma=st.floats(0.5, 5),
    delta=st.floats(0, 5),
    eta=st.floats(1, 9),
    decay=st.floats(0, 2),
    step=st.tuples(near, near),
)
def test_sierra_with_other_settings(mean, sigma, delta, eta, decay, step):
    x = np.add(mean, step)
    with jax.enable_x64(True):
        got = float(AT(sierra(mean, sigma, delta, eta, decay), jnp.asarray(x)))
    assert got == pytest.approx(sierra_by_the_text(x, mean, sigma, delta, eta, decay), rel=1e-10)


def test_another_sierra_is_no_new_program(dtype):
    traces = []

    @jax.jit
    def at(f, x):
        traces.append(1)
        return f(x)

    x = jnp.asarray([1.0, 2.0])
    for delta in (1.0, 2.0, 3.0):
        assert float(at(sierra(spacing=delta), x)) == pytest.approx(
            sierra_by_the_text(x, delta=delta), rel=1e-5
        )
    assert len(traces) == 1


def test_a_sweep_over_sierras_and_points():
    values = jnp.asarray([1.0, 2.0, 4.0])
    x = jnp.asarray([[0.0, 0.0], [1.0, -2.0]])
    got = jax.jit(jax.vmap(lambda v: jax.vmap(sierra((v, 0.0), v, v, 2 * v, v))(x)))(values)
    truth = [
        [sierra_by_the_text(p, (v, 0), v, v, 2 * v, v) for p in np.asarray(x)]
        for v in np.asarray(values)
    ]
    np.testing.assert_allclose(got, truth, rtol=1e-5)


def test_log_does_not_underflow_and_keeps_the_order():
    x = jnp.asarray(np.random.default_rng(0).normal(0, 40, (500, 2)), jnp.float32)
    batch = lambda f: jax.jit(jax.vmap(f))(x)
    plain, log = batch(sierra()), batch(sierra(log=True))
    assert (plain == 0).sum() > 50 and np.isfinite(log).all()
    exact = np.array([sierra_by_the_text(p) for p in np.asarray(x)])
    seen = np.asarray(plain) < -1e-30
    np.testing.assert_allclose(log[seen], -np.log(-exact[seen]), rtol=1e-5)
    assert len(set(np.asarray(log).tolist())) > 490
    assert np.isfinite(batch(jax.grad(sierra(log=True)))).all()
    assert np.isfinite(batch(jax.grad(sierra()))).all()


def test_branin(dtype):
    rtol = 1e-5 if dtype == "float32" else 1e-12
    for x in ([-np.pi, 12.275], [np.pi, 2.275], [3 * np.pi, 2.475]):
        x = jnp.asarray(x, dtype)
        assert branin(x).dtype == dtype
        np.testing.assert_allclose(branin(x), 5 / (4 * np.pi), rtol=rtol)
        assert np.abs(jax.grad(branin)(x)).max() < (1e-4 if dtype == "float32" else 1e-12)
    # at [0, 0]: 36 + 10 (1 - 1 / (8 pi)) + 10
    np.testing.assert_allclose(branin(jnp.zeros(2, dtype)), 56 - 10 / (8 * np.pi), rtol=rtol)


@pytest.mark.slow
@pytest.mark.parametrize("d", [1, 2, 7])
def test_ackley_and_paraboloid(d, dtype):
    origin = jnp.zeros(d, dtype)
    slope = jax.jit(jax.grad(ackley))
    assert ackley(origin) == paraboloid(origin) == 0
    assert ackley(origin).dtype == paraboloid(origin).dtype == dtype
    assert (slope(origin) == 0).all()
    value = jax.jit(ackley)
    for x in np.random.default_rng(d).normal(0, 3, (20, d)).astype(dtype):
        v = x.astype(np.float64)
        a = (
            -20 * np.exp(-0.2 * np.sqrt(np.mean(v**2)))
            - np.exp(np.mean(np.cos(2 * np.pi * v)))
            + 20
            + np.e
        )
        np.testing.assert_allclose(
            value(jnp.asarray(x)), a, rtol=2e-6 if dtype == "float32" else 1e-13
        )
        np.testing.assert_allclose(paraboloid(jnp.asarray(x)), v @ v, rtol=1e-6)
        assert value(jnp.asarray(x)) > 0 and np.isfinite(slope(jnp.asarray(x))).all()
    found = scipy.optimize.minimize(
        lambda v: float(value(jnp.asarray(v, dtype))),
        np.full(d, 0.1),
        method="Nelder-Mead",
        options=dict(xatol=1e-6),
    )
    assert found.fun < 1e-2 and np.abs(found.x).max() < 1e-2


@pytest.mark.parametrize("f", [sierra(), sierra(log=True), branin, ackley, paraboloid])
def test_of_lists_and_whole_numbers_alone_and_in_a_batch(f):
    x = jnp.asarray([[1.0, 2.0], [-3.0, 0.5], [0.0, 0.0]])
    one = jax.jit(f)
    alone = [one(p) for p in x]
    assert all(v.shape == () for v in alone)
    np.testing.assert_allclose(jax.jit(jax.vmap(f))(x), jnp.stack(alone), rtol=1e-6, atol=1e-6)
    assert f([1, 2]) == f(jnp.asarray([1.0, 2.0]))
    assert one(jnp.asarray([1, 2])) == one(jnp.asarray([1.0, 2.0]))


@pytest.mark.parametrize(
    "settings, message",
    [
        (dict(mean=(0.0,)), r"sierra: mean must be 2 finite numbers, received \(0.0,\)"),
        (dict(mean=(0.0, np.nan)), "sierra: mean must be 2 finite numbers"),
        (dict(mean=None), "sierra: mean must be 2 finite numbers, received None"),
        (dict(variance=0.0), "sierra: variance must be a number above 0, received 0.0"),
        (dict(variance=(1.0, 2.0)), "sierra: variance must be a number above 0"),
        (dict(sharpness=-1), "sierra: sharpness must be a number above 0, received -1"),
        (dict(spacing=np.inf), "sierra: spacing must be a number that is finite, received inf"),
        (dict(decay="slow"), "sierra: decay must be a number that is finite, received 'slow'"),
        (dict(order="paper"), 'sierra: order must be "code" or "thesis", received \'paper\''),
        (dict(log=1), "sierra: log must be True or False, received 1"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        sierra(**settings)


def test_points_of_another_shape():
    for f, name, expected in (
        (sierra(), "sierra", "2"),
        (branin, "branin", "2"),
        (ackley, "ackley", "one or more"),
        (paraboloid, "paraboloid", "one or more"),
    ):
        for shape in ((3, 2), (), (0,)):
            with pytest.raises(
                ValueError,
                match=f"{name}: x must be a vector of {expected} numbers, received shape",
            ):
                jax.jit(f)(jnp.zeros(shape))
    with pytest.raises(ValueError, match=r"branin: x must .*received shape \(3,\)"):
        branin(jnp.zeros(3))
