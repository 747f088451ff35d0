"""Latent sequences: exact where the disturbance is normal, the model itself at N(0, 1), and fitted
to those that count.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from systems import ring, walk

import jast
from jast import actions
from jast import distributions as D
from jast._src.core.signature import signature_of
from jast._src.distributions.normal_tails import normal_score
from jast._src.normal_space.sequences import (
    Steps,
    disturbance_at,
    fit,
    latent_policy,
    log_ratio,
    sample,
    standard_normal,
)


def scalar(dtype):
    return jax.ShapeDtypeStruct((), jnp.dtype(dtype))


def test_fit(dtype):
    """Mean and deviation of the episodes that reached a step; smoothed; not below the floor; kept
    where fewer than two did.
    """
    z = jnp.array([[1.0, 5.0, 9.0], [3.0, 5.0, 0.0], [100.0, 0.0, 0.0]], dtype)
    counts = jnp.array([[1, 1, 1], [1, 1, 0], [0, 0, 0]], bool)
    old = standard_normal(scalar(dtype), 3)
    for smoothing, mean, deviation in (
        (0.0, [2, 5, 0], [1, 0.2, 1]),
        (0.5, [1, 2.5, 0], [1, 0.5, 1]),
    ):
        new = fit(old, z, counts, jnp.asarray(smoothing), jnp.asarray(0.2))
        np.testing.assert_allclose(new.mean, mean)
        np.testing.assert_allclose(new.deviation, deviation, rtol=1e-6)
        assert new.mean.dtype == new.deviation.dtype == dtype


def test_fit_of_shares(dtype):
    """An episode that counts for 1.5 of 2.5: weighted moments; one of 1.9 effective episodes in all
    moves nothing.
    """
    z = jnp.array([[1.0, 1.0], [3.0, 3.0], [9.0, 9.0]], dtype)
    new = fit(
        standard_normal(scalar(dtype), 2),
        z,
        jnp.array([[1.5, 1.5], [1.0, 0.4], [0.0, 0.0]], dtype),
        jnp.asarray(0.0),
        jnp.asarray(0.1),
    )
    np.testing.assert_allclose(new.mean, [1.8, 0], rtol=1e-6)
    np.testing.assert_allclose(new.deviation, [np.sqrt(0.96), 1], rtol=1e-6)


def test_quantile_is_exact_for_normals_far_out(dtype):
    """At z = 8, where Phi(z) is 1 in float32, as anywhere."""
    loc, scale = jnp.asarray([1.0, -2.0], dtype), jnp.asarray([0.5, 3.0], dtype)
    factor = jnp.asarray([[2.0, 0.0], [1.0, 0.5]], dtype)
    z = jnp.asarray([8.0, -7.0], dtype)
    expected = [5, -23]
    np.testing.assert_allclose(D.from_normal(D.MultivariateNormalDiag(loc, scale), z), expected)
    np.testing.assert_allclose(D.from_normal(D.Independent(D.Normal(loc, scale), 1), z), expected)
    np.testing.assert_allclose(D.from_normal(D.MultivariateNormalTri(loc, factor), z), [17, 2.5])
    joint = D.from_normal(
        D.Joint({"a": D.Normal(loc[0], scale[0]), "b": D.Normal(loc[1], scale[1])}),
        {"a": z[0], "b": z[1]},
    )
    assert (float(joint["a"]), float(joint["b"])) == (5, -23)
    one, other = D.Normal(loc[0], scale[0]), D.Normal(loc[1], scale[1])
    assert [
        float(D.from_normal(D.where(jnp.asarray(p), one, other), z[0])) for p in (True, False)
    ] == [5, 22]


@pytest.mark.slow
def test_other_disturbances_by_their_quantile_function(dtype):
    z = jnp.asarray([-9.0, -1.0, 0.0, 2.0, 9.0], dtype)
    x = D.from_normal(D.Uniform(jnp.full(5, 2.0, dtype), jnp.full(5, 4.0, dtype)), z)
    np.testing.assert_allclose(x, 2 + 2 * scipy.stats.norm.cdf(np.asarray(z, float)), rtol=1e-6)
    coin = D.Bernoulli(probs=jnp.asarray(0.1, dtype))
    assert [int(D.from_normal(coin, v)) for v in z] == [0, 0, 0, 1, 1]
    box = disturbance_at(
        actions.uniform(-1.0, 1.0), D.Normal(jnp.zeros((), dtype), jnp.ones((), dtype)), z[4]
    )
    assert box.dtype == dtype and 0.999 < box <= 1


def test_log_ratio(dtype):
    """Against scipy, and where the two densities differ by little at large z."""
    m, s = (
        jnp.asarray([[0.0, 3.0], [1e-3, -2.0]], dtype),
        jnp.asarray([[1.0, 0.5], [1.0, 2.0]], dtype),
    )
    z = jnp.asarray([[20.0, 2.5], [20.0, -7.0]], dtype)
    norm = scipy.stats.norm
    expected = (
        norm.logpdf(np.asarray(z, float))
        - norm.logpdf(np.asarray(z, float), np.asarray(m, float), np.asarray(s, float))
    ).sum(axis=1)
    np.testing.assert_allclose(log_ratio(Steps(m, s), z), expected, rtol=1e-5)
    assert log_ratio(standard_normal(scalar(dtype), 3), jnp.arange(3, dtype=dtype)).tolist() == [
        0,
        0,
        0,
    ]


def test_noise_is_addressed(key):
    """z_t does not depend on the horizon, and levels are those of the offset."""
    short, long = (sample(key, standard_normal(scalar("float32"), n), 1) for n in (3, 7))
    assert short.tolist() == long[:3].tolist()
    assert sample(key, standard_normal(scalar("float32"), 2), 2).tolist() == long[1:3].tolist()


@pytest.mark.slow
@pytest.mark.parametrize("make", [walk, ring], ids=["walk", "ring"])
def test_player_at_standard_noise_is_the_model(key, make):
    """The share of failures is the nominal one within 4 standard errors of the two binomial shares;
    structures and a random start included.
    """
    sim, n = make(), 4000
    signature = signature_of(sim)
    like0, like = signature.x0, signature.x

    @jax.jit
    def shares(key):
        def one(key):
            a, b, c, d = jax.random.split(key, 4)
            z0 = (
                jax.tree.map(lambda v: v[0], sample(a, standard_normal(like0, 1), 0))
                if jax.tree.leaves(like0)
                else ()
            )
            player = latent_policy(
                sim,
                actions.quantiles(),
                z0,
                sample(b, standard_normal(like, sim.horizon), 0),
            )
            return jast.rollout(c, sim, player).failure, jast.rollout(d, sim).failure

        return jnp.stack(jax.vmap(one)(jax.random.split(key, n))).mean(axis=1)

    latent, nominal = shares(key)
    p = (latent + nominal) / 2
    assert 0.01 < p < 0.5 and abs(latent - nominal) < 4 * np.sqrt(2 * p * (1 - p) / n)


def test_latent_is_the_inverse_of_quantile(dtype):
    """z -> x -> z, far out where the distribution is normal; through vectors, choices and
    structures.
    """
    one = lambda *v: jnp.asarray(v, dtype)
    z, far, loc, scale, no = (
        one(-2.5, 1.3),
        one(-20.0, 30.0),
        one(1.0, -2.0),
        one(0.5, 3.0),
        jnp.asarray(False),
    )
    factor = jnp.stack([one(2, 0), one(1, 0.5)])

    @jax.jit
    def there_and_back():
        normal = D.Normal(loc, scale)
        normals = (
            D.MultivariateNormalDiag(loc, scale),
            D.Independent(normal, 1),
            D.MultivariateNormalTri(loc, factor),
        )
        others = (
            D.Uniform(loc, loc + scale),
            D.Laplace(loc, scale),
            D.Logistic(loc, scale),
            D.tent(one(0.3, 0.6)),
            D.where(no, normal, D.Uniform(loc, scale + 1)),
        )
        joint = D.Joint({"a": normal, "b": (others[0],)}), {"a": far, "b": (z,)}
        pairs = [*((d, far) for d in normals), *((d, z) for d in (*normals, *others)), joint]
        return [(v, D.to_normal(d, D.from_normal(d, v))) for d, v in pairs]

    for latent, found in there_and_back():
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(latent), strict=True):
            assert a.dtype == dtype
            np.testing.assert_allclose(a, b, rtol=3e-4)
    assert D.to_normal(D.Fixed(), ()) == ()


@pytest.mark.slow
def test_latent_of_whole_numbers(dtype):
    """The middle in probability of the normal numbers that give it, rare numbers last, by scipy; so
    it goes back to it.
    """
    dice = D.Categorical(probs=jnp.asarray([0.2, 0.5, 0.3], dtype))
    z = jax.jit(jax.vmap(lambda x: D.to_normal(dice, x)))(jnp.arange(3, dtype=jnp.int32))
    np.testing.assert_allclose(z, scipy.stats.norm.ppf([0.9, 0.25, 0.65]), atol=1e-4)
    assert jax.vmap(lambda z: D.from_normal(dice, z))(z).tolist() == [0, 1, 2]


def test_latent_is_finite(dtype):
    """At and beyond the ends of what a distribution can give, and at what rounds to them."""
    flat, tiny = D.Uniform(jnp.zeros((), dtype), jnp.ones((), dtype)), jnp.finfo(dtype).tiny
    z = np.asarray(
        jax.jit(lambda x: D.to_normal(flat, x))(
            jnp.asarray([-1.0, 0.0, tiny, 0.5, 1.0, 2.0], dtype)
        )
    )
    assert np.isfinite(z).all()
    assert (np.diff(z[2:]) >= 0).all()
    assert z[3] == 0
    assert z[0] == z[1] < -5 < 5 < z[4] == z[5]
    assert normal_score(jnp.asarray([0.5, 1.0], dtype)).dtype == dtype


def test_latent_names_what_has_none(dtype):
    with pytest.raises(ValueError, match="VonMises"):
        D.to_normal(
            D.VonMises(jnp.asarray(2.0, dtype), jnp.asarray(1.0, dtype)), jnp.asarray(0.3, dtype)
        )
