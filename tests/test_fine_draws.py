"""Draws in float32: rare values by all 32 bits of a word, all others JAX's to the bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats as st

from jast import distributions as D
from jast._src.distributions import fine_draws

FAMILIES = {
    "exponential": (jax.random.exponential, st.expon, 1),
    "gumbel": (jax.random.gumbel, st.gumbel_r, 1),
    "laplace": (jax.random.laplace, st.laplace, -1),  # its smallest words are its largest numbers
    "logistic": (None, st.logistic, 1),
    "normal": (jax.random.normal, st.norm, 1),
    "uniform": (jax.random.uniform, st.uniform, 1),
}
LEFT = np.unique(np.geomspace(1, 2**17, 500).astype(np.uint32)) - np.uint32(1)


def draw_words(monkeypatch, words):
    """Let the random words be ``words``."""

    def bits(key, shape, dtype):
        return jnp.broadcast_to(jnp.asarray(words, dtype), shape)

    monkeypatch.setattr(jax.random, "bits", bits)


@pytest.mark.parametrize("name", FAMILIES)
def test_numbers_far_out_are_the_quantiles_of_their_words(name, key, monkeypatch):
    _, family, sign = FAMILIES[name]
    draw_words(monkeypatch, np.concatenate([LEFT, ~LEFT]))
    x = np.asarray(getattr(fine_draws, name)(key, (2 * len(LEFT),), jnp.float32), float)
    p = (LEFT + 0.5) * 2.0**-32
    low, high = (family.ppf(p), family.isf(p))[::sign]
    # rounding: a relative 1e-6 of a number and, of the normal polynomial, what its docstring says
    np.testing.assert_allclose(x, np.concatenate([low, high]), rtol=1.2e-6, atol=1e-9)


@pytest.mark.parametrize("name", FAMILIES)
def test_all_other_numbers_are_those_of_jax(name, key):
    theirs, family, sign = FAMILIES[name]
    x = getattr(fine_draws, name)(key, (200_000,), jnp.float32)
    words = np.asarray(jax.random.bits(key, (200_000,), np.uint32))
    far = np.minimum(words, ~words) < 2**17
    assert 0 < far.sum() < 40  # of 12.2
    if theirs is not None:
        assert np.array_equal(x[~far], theirs(key, (200_000,), jnp.float32)[~far])
    quantile = family.ppf((words[far] + 0.5) * 2.0**-32)
    assert (np.abs(x[far] - sign * quantile) < 2e-2 * np.abs(quantile)).all()


def test_uniform_numbers_have_logarithms_on_either_side(key, monkeypatch):
    draw_words(monkeypatch, np.array([0, 2**32 - 1], np.uint32))
    monkeypatch.setattr(jax.random, "uniform", lambda key, shape, dtype: jnp.array([0.0, 1.0]))
    u = fine_draws.uniform(key, (2,), jnp.float32)
    assert np.isfinite(jnp.log(u)).all()
    assert np.isfinite(jnp.log1p(-u)).all()


@pytest.mark.parametrize("p", [1e-7, 1e-6, 0.3, 1 - 1e-6, 1.0])
def test_rare_successes_have_their_probability(p, key, monkeypatch):
    """Those words are a success that are below p 2^32, where JAX's are a multiple of 2^9."""
    p = np.float32(p)
    count = float(p) * 2**32
    near = np.arange(max(int(count) - 700, 0), min(int(count) + 700, 2**32), dtype=np.uint32)

    def uniform(key, shape, dtype):
        return jnp.asarray((near >> 9).astype(dtype) * dtype.type(2.0**-23)).reshape(shape)

    draw_words(monkeypatch, near)
    monkeypatch.setattr(jax.random, "uniform", uniform)
    hit = fine_draws.bernoulli(key, jnp.full(len(near), p), 1)[0]
    assert np.array_equal(hit, near + 0.5 < count)


def test_successes_that_are_not_rare_are_those_of_jax(key):
    p = jnp.float32(0.3)
    ours = D.Bernoulli(probs=p).sample(seed=key, sample_shape=10_000)
    assert np.array_equal(ours, jax.random.uniform(key, (10_000,)) < p)


def test_a_rare_category_wins_by_the_words_of_its_probability(key, monkeypatch):
    """Where the other's Gumbel number is 0, one of log odds log(p) wins by the last p 2^32 words.
    JAX's wins by a multiple of 2^9 of them.
    """
    p = 1e-6
    left = np.arange(3000, 6000, dtype=np.uint32)
    middle = np.full_like(left, 2**32 / np.e)  # -log(-log u) is 0
    draw_words(monkeypatch, np.stack([middle, ~left], axis=-1))
    logits = jnp.asarray([0.0, np.log(p)], jnp.float32)
    chosen = fine_draws.categorical(key, logits, len(left))
    assert abs(np.asarray(chosen).sum() - (p * 2**32 - 3000)) < 1.5


def test_categories_that_are_not_rare_are_those_of_jax(key):
    logits = jnp.log(jnp.asarray([0.2, 0.5, 0.3], jnp.float32))
    draws = D.Categorical(logits=logits).sample(seed=key, sample_shape=10_000)
    assert np.array_equal(draws, jax.random.categorical(key, logits, shape=(10_000,)))
