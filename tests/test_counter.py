"""Statistics of the counter keys. Seeds are fixed; bounds are 5 standard errors (or chi-square at
about that level), so that a sound hash passes.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jast._src.core.counter_prng import COUNTER, tree_keys

N = 1 << 16
SEEDS = [0, 1, 12345]


def root(seed=0):
    return jax.random.key(seed, impl=COUNTER)


def words(keys):
    """One 32-bit word of each key."""
    return np.asarray(
        jax.vmap(lambda k: jax.random.bits(k, (), jnp.uint32))(keys.reshape(-1))
    ).reshape(keys.shape)


def addressed(seed, simulations=1024, steps=64):
    """The key of (simulation, step), as searches make it."""
    fold = lambda i, t: jax.random.fold_in(jax.random.fold_in(root(seed), i), t)
    return jax.vmap(jax.vmap(fold, (None, 0)), (0, None))(
        jnp.arange(simulations), jnp.arange(steps)
    )


def streams(seed):
    """Words by the four ways of getting them: one long stream, folded keys, split keys, keys
    addressed by (i, t).
    """
    yield np.asarray(jax.random.bits(root(seed), (N,), jnp.uint32))
    yield words(jax.vmap(lambda i: jax.random.fold_in(root(seed), i))(jnp.arange(N)))
    yield words(jax.random.split(root(seed), N))
    yield words(addressed(seed).reshape(-1))


def bits(word):
    return ((word[..., None] >> np.arange(32, dtype=np.uint32)) & 1).astype(np.int8)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_bits_and_bytes_are_uniform(seed):
    for word in streams(seed):
        share = bits(word).mean(axis=0)  # each of 32 bits: standard error .5 / sqrt(N)
        assert np.abs(share - 0.5).max() < 5 * 0.5 / np.sqrt(N)
        for byte in word.view(np.uint8).reshape(-1, 4).T:
            assert scipy.stats.chisquare(np.bincount(byte, minlength=256)).pvalue > 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_neighbouring_words_are_uncorrelated(seed):
    for word in streams(seed):
        u = word / 2.0**32 - 0.5
        for lag in (1, 2, 3, 63, 64, 65, 1024):  # 64: the same step of the next simulation
            assert abs(np.mean(u[:-lag] * u[lag:]) * 12) < 5 / np.sqrt(N - lag)
        b = 2.0 * bits(word) - 1
        # every bit with every bit of the neighbour: 1024 correlations
        cross = b[:-1].T @ b[1:] / (N - 1)
        assert np.abs(cross).max() < 5.5 / np.sqrt(N)
        within = b.T @ b / N - np.eye(32)
        assert np.abs(within).max() < 5.5 / np.sqrt(N)


def test_words_of_neighbouring_keys_are_uncorrelated():
    keys = jax.vmap(lambda i: jax.random.fold_in(root(3), i))(jnp.arange(4096))
    word = np.asarray(jax.vmap(lambda k: jax.random.bits(k, (16,), jnp.uint32))(keys))
    u = (word / 2.0**32 - 0.5) * np.sqrt(12)
    assert np.abs(np.corrcoef(u.T) - np.eye(16)).max() < 5 / np.sqrt(4096)  # words of one key
    # the same word of neighbours
    assert np.abs(np.mean(u[:-1] * u[1:], axis=0)).max() < 5 / np.sqrt(4095)
    assert len(np.unique(word)) > word.size - 10  # 2^16 of 2^32: half a collision expected


def test_pairs_fill_the_square():
    u = words(addressed(7))  # [simulation, step]
    cells = (u[:, :-1] >> 28).astype(int) * 16 + (u[:, 1:] >> 28)
    assert scipy.stats.chisquare(np.bincount(cells.ravel(), minlength=256)).pvalue > 1e-6
    maxima = (u / 2.0**32).max(axis=1)  # of 64 uniform numbers
    assert scipy.stats.kstest(maxima**64, "uniform").pvalue > 1e-6


def test_keys_are_distinct():
    data = lambda keys: np.asarray(jax.random.key_data(keys)).reshape(-1, 2)
    split, folded = (
        data(jax.random.split(root(), N)),
        data(jax.vmap(lambda i: jax.random.fold_in(root(), i))(jnp.arange(N))),
    )
    everything = np.concatenate([split, folded, data(addressed(0))])
    assert len(np.unique(everything, axis=0)) == len(everything)
    seeds = data(jax.vmap(lambda s: jax.random.key(s, impl=COUNTER))(jnp.arange(N)))
    assert len(np.unique(seeds, axis=0)) == N


@pytest.mark.parametrize("what", ["data", "first", "second"])
def test_avalanche(what):
    """Flipping any one bit of the folded number, or of the key, flips half of the output bits."""
    flips = jnp.uint32(1) << jnp.arange(32, dtype=jnp.uint32)
    numbers = jax.random.bits(jax.random.key(5), (512, 3), jnp.uint32)

    def word(first, second, number):
        key = jax.random.wrap_key_data(jnp.stack([first, second]), impl=COUNTER)
        return jax.random.bits(jax.random.fold_in(key, number), (), jnp.uint32)

    def flipped(n):
        base = dict(first=n[0], second=n[1], number=n[2])
        name = "number" if what == "data" else what
        return jax.vmap(lambda f: word(**(base | {name: base[name] ^ f})))(flips) ^ word(**base)

    moved = bits(np.asarray(jax.vmap(flipped)(numbers)))  # [512, flipped bit, output bit]
    assert abs(moved.mean() - 0.5) < 5 * 0.5 / np.sqrt(moved.size)
    # one output word is 32 bits of one hash, so a pair of bits has 512 trials: 1024 pairs, 5.5
    # standard errors
    assert np.abs(moved.mean(axis=0) - 0.5).max() < 5.5 * 0.5 / np.sqrt(512)


def test_vmap_and_jit_agree():
    draw = lambda i: jax.random.normal(jax.random.fold_in(root(2), i), (3,))
    many = jax.vmap(draw)(jnp.arange(5))
    for i in range(5):
        np.testing.assert_array_equal(
            jax.random.key_data(jax.random.fold_in(root(2), i)),
            jax.jit(lambda i: jax.random.key_data(jax.random.fold_in(root(2), i)))(i),
        )
        np.testing.assert_allclose(many[i], draw(i), rtol=1e-6)
    np.testing.assert_array_equal(
        words(jax.random.split(root(), 6)).reshape(2, 3),
        words(jax.random.split(root(), (2, 3)).reshape(-1)).reshape(2, 3),
    )
    assert jax.random.split(root(), 0).shape == (0,)


def test_distributions_of_jax_random():
    n = 20_000
    assert scipy.stats.kstest(np.asarray(jax.random.normal(root(1), (n,))), "norm").pvalue > 1e-6
    assert (
        scipy.stats.kstest(np.asarray(jax.random.uniform(root(2), (n,))), "uniform").pvalue > 1e-6
    )
    keys = jax.vmap(lambda i: jax.random.fold_in(root(9), i))(jnp.arange(n))
    assert scipy.stats.kstest(np.asarray(jax.vmap(jax.random.normal)(keys)), "norm").pvalue > 1e-6
    p = np.array([0.1, 0.2, 0.3, 0.4])
    counts = np.bincount(
        np.asarray(jax.random.categorical(root(3), jnp.log(jnp.asarray(p)), shape=(n,))),
        minlength=4,
    )
    assert scipy.stats.chisquare(counts, n * p).pvalue > 1e-6
    assert np.sort(np.asarray(jax.random.permutation(root(4), 10))).tolist() == list(range(10))
    for dtype, width in ((jnp.uint8, 8), (jnp.uint16, 16), (jnp.uint32, 32)):
        mean = np.asarray(jax.random.bits(root(5), (n,), dtype), np.float64).mean() / 2.0**width
        assert abs(mean - 0.5) < 5 / np.sqrt(12 * n)


def test_64_bit_words(x64):
    word = np.asarray(jax.random.bits(root(6), (N,), jnp.uint64))
    assert word.dtype == np.uint64 and len(np.unique(word)) == N
    share = ((word[:, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)).mean(axis=0)
    assert np.abs(share - 0.5).max() < 5 * 0.5 / np.sqrt(N)
    assert (
        scipy.stats.kstest(np.asarray(jax.random.uniform(root(8), (N,))), "uniform").pvalue > 1e-6
    )


def test_tree_keys(key):
    five, nine = tree_keys(key, 5), tree_keys(key, 9)
    np.testing.assert_array_equal(jax.random.key_data(five), jax.random.key_data(nine)[:5])
    assert len(np.unique(np.asarray(jax.random.key_data(tree_keys(key, 1000))), axis=0)) == 1000
