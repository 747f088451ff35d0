"""distrax's distributions are accepted wherever a distribution is, and jast's own agree with them:
densities to the bit, draws up to the rounding of a product (jast's outermost ones are its own).
"""

import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import mark_long

import jast
from jast import distributions as D
from jast import simulators
from jast._src.distributions.distrax_loader import distrax

OWN = ["Bernoulli", "Beta", "Categorical", "Gamma", "Independent", "Joint", "Laplace", "Logistic"]
OWN += ["MultivariateNormalDiag", "MultivariateNormalTri", "Normal", "Uniform"]


def pairs(dtype):
    """name -> (jast's, distrax's)."""
    f = lambda *v: jnp.asarray(v if len(v) > 1 else v[0], dtype)
    factor = jnp.asarray([[1.0, 0.0], [0.5, 2.0]], dtype)

    def of(m):
        return {
            "normal": m.Normal(f(1.3), f(2.7)),
            "vector": m.Independent(m.Laplace(f(0, 1.1), f(1, 0.3)), 1),
            "logistic": m.Logistic(f(1.3), f(2.7)),
            "uniform": m.Uniform(f(-1.3), f(2.7)),
            "bernoulli": m.Bernoulli(probs=f(0.3)),
            "categorical": m.Categorical(logits=f(0.3, -1, 2)),
            "gamma": m.Gamma(f(1.3), f(2.7)),
            "beta": m.Beta(f(1.3), f(2.7)),
            "diag": m.MultivariateNormalDiag(f(0.3, 1.7, 2), f(1.1, 0.3, 0.7)),
            "tri": m.MultivariateNormalTri(f(0.3, 1.7), factor),
            "joint": m.Joint(
                {"a": m.Normal(f(0.1), f(1.2)), "n": m.Categorical(probs=f(0.2, 0.8))}
            ),
        }

    own, other = of(D), of(distrax)
    return {name: (own[name], other[name]) for name in own}


def close(a, b, rounding):
    """Asserts that two pytrees are the same up to ``rounding`` of numbers and of 1."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        np.testing.assert_allclose(x, y, rtol=rounding, atol=rounding)


@pytest.mark.parametrize("name", list(pairs("float32")))
def test_draws_and_densities_agree(name, dtype, equal, key):
    own, other = pairs(dtype)[name]
    keys = jax.random.split(key, 200)

    def draws_of(d):
        return jax.jit(jax.vmap(lambda key: d.sample(seed=key)))(keys)

    def densities_of(d):
        of = jax.vmap(lambda x: (d.log_prob(x), D.log_density(d, x, "mode"), D.mode(d)))
        return jax.jit(of)(draws)

    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # of distrax's
        draws = draws_of(own)
        close(draws, draws_of(other), 4 * jnp.finfo(dtype).eps)
        equal(densities_of(own), densities_of(other))
        assert own.batch_shape == other.batch_shape and own.event_shape == other.event_shape
        assert own.dtype == other.dtype


@pytest.mark.parametrize("name", [n for n in pairs("float32") if n not in ("gamma", "beta")])
def test_the_table_knows_distraxs_classes(name, dtype, equal):
    own, other = pairs(dtype)[name]
    z = jax.tree.map(lambda s: jnp.full(s.shape, -0.7, D.float_dtype(s.dtype)), D.event_like(own))
    z = jax.tree.map(lambda a: a.astype(dtype), z)
    with jax.numpy_rank_promotion("allow"):

        @jax.jit
        def all_of(z):
            x = [D.from_normal(d, z) for d in (own, other)]
            back = [D.to_normal(d, x[0]) for d in (own, other)]
            move = [
                D.tilted(d, z, jax.tree.map(jnp.ones_like, z)).log_prob(x[0]) for d in (own, other)
            ]
            return x, back, move

        for mine, theirs in all_of(z):
            equal(mine, theirs)
    assert isinstance(other, D.Distribution) and D.has_exact_tails(other)


def test_each_may_hold_the_other(key):
    mixed = D.Joint({"a": distrax.Normal(0.0, 1.0), "b": D.Normal(0.0, 1.0)})
    x = D.sample(mixed, key)
    assert D.log_density(mixed, x, "mode") == -(x["a"] ** 2 + x["b"] ** 2) / 2
    assert D.Transformed(D.Normal(0.0, 1.0), jnp.exp).sample(seed=key) > 0
    assert D.Independent(distrax.Normal(jnp.zeros(2), jnp.ones(2)), 1).event_shape == (2,)


SYSTEMS = {
    "autoregression": simulators.autoregression,
    "colav": simulators.colav,
    "ferry": simulators.ferry,
    "fms": simulators.fms,
    "landing": simulators.landing,
    "limit_state": lambda: simulators.limit_state(lambda x: 3 - x[0], 2),
    "pendulum": simulators.pendulum,
    "ruin": simulators.ruin,
    "walk1d": simulators.walk1d,
}


class Distrax(types.SimpleNamespace):
    """jast.distributions with distrax's classes in place of its own."""

    def __getattr__(self, name):
        return getattr(distrax if name in OWN else D, name)


@pytest.mark.parametrize(
    "name", mark_long(SYSTEMS, *(SYSTEMS.keys() - {"ferry", "landing", "walk1d"}))
)
def test_every_system_runs_on_either(name, key, monkeypatch):
    """Its episodes are the same up to rounding, which some of them amplify."""

    def episodes():
        jax.clear_caches()  # programs are known by their functions, which stay the same
        with (
            jax.numpy_dtype_promotion("standard"),
            jax.numpy_rank_promotion("allow"),
            jax.enable_x64(name == "fms"),
        ):
            sim = SYSTEMS[name]()
            return jax.jit(jax.vmap(lambda k: jast.rollout(k, sim)))(jax.random.split(key, 4))

    own = episodes()
    seen = []
    for module in [m for n, m in sys.modules.items() if n.startswith("jast._src.simulators")]:
        for attribute, value in list(vars(module).items()):
            if value is D:
                monkeypatch.setattr(module, attribute, Distrax())
                seen.append(attribute)
            elif attribute in OWN and value is getattr(D, attribute):
                monkeypatch.setattr(module, attribute, getattr(distrax, attribute))
                seen.append(attribute)
    assert {"D", "Normal", "Uniform", "Categorical", "MultivariateNormalDiag"} <= set(seen)
    close(own, episodes(), 1e-4)
    jax.clear_caches()


@pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.long)], indirect=True
)
def test_distributions_are_pytrees(dtype, equal, key):
    for own, _ in pairs(dtype).values():
        leaves, treedef = jax.tree.flatten(own)
        again = treedef.unflatten(leaves)
        equal(again.sample(seed=key), own.sample(seed=key))
    many = jax.vmap(lambda m: D.Normal(m, jnp.ones((), dtype)))(jnp.arange(3, dtype=dtype))
    assert jax.vmap(lambda d: d.mean())(many).tolist() == [0, 1, 2]
    assert np.asarray(jax.jit(lambda d: d.loc)(many)).tolist() == [0, 1, 2]
