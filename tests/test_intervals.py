"""Bounds and intervals of a probability: against scipy, against what they promise to cover, and at
their ends.
"""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from jast._src.util import intervals
from jast._src.util.intervals import log_normal
from jast.estimate import chernoff, clopper_pearson, jeffreys

beta = scipy.stats.beta
CASES = [
    (0, 1),
    (1, 1),
    (0, 7),
    (3, 7),
    (7, 7),
    (0, 10**6),
    (1, 10**6),
    (40, 10**6),
    (999_999, 10**6),
    (5 * 10**7, 10**8),
    (3, 10**9),
]
LEVELS = [0.5, 0.9, 0.95, 0.999]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("k, n", CASES)
def test_jeffreys_is_a_quantile_of_beta(k, n, level):
    assert jeffreys(k, n, level) == pytest.approx(
        beta.ppf(level, k + 0.5, n - k + 0.5), rel=1e-6 if n < 10**8 else 1e-4, abs=0
    )


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("k, n", CASES)
def test_chernoff_solves_its_equation(k, n, level):
    """n KL(k/n || u) = log(1 / (1 - level)) above k/n; in closed form at k = 0."""
    u, bound = chernoff(k, n, level), -np.log1p(-level)
    if k == n:
        assert u == 1
        return
    kl = k * np.log(max(k, 1) / (n * u)) + (n - k) * np.log1p((u - k / n) / (1 - u))
    assert k / n < u < 1 and kl == pytest.approx(bound, rel=1e-4 if n > 10**6 else 1e-6)
    if n < 10:
        assert kl == pytest.approx(
            n * scipy.stats.entropy([k / n, 1 - k / n], [u, 1 - u]), rel=1e-9
        )
    if k == 0:
        assert u == pytest.approx(-np.expm1(np.log1p(-level) / n), rel=1e-9)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_order_of_the_bounds(data):
    """k/n < Jeffreys <= Clopper and Pearson one-sided <= Chernoff: the exact bound is between the
    Bayesian and the simple one (level of at least .5).
    """
    n = data.draw(st.integers(1, 5000))
    k = data.draw(st.integers(0, n))
    level = data.draw(st.floats(0.51, 0.9999))
    exact = 1.0 if k == n else beta.ppf(level, k + 1, n - k)
    assert jeffreys(k, n, level) <= exact * (1 + 1e-9)
    assert exact <= chernoff(k, n, level) * (1 + 1e-9)
    assert chernoff(k, n, level) > k / n or k == n
    # the interval is two one-sided ones
    assert clopper_pearson(k, n, 2 * level - 1)[1] == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("level", [0.8, 0.95])
def test_coverage(level):
    """P(bound >= p), summed over the binomial: Chernoff's at least the level for every p; Jeffreys'
    on average over p, and not everywhere.
    """
    n = 30
    p = np.linspace(0.001, 0.999, 500)
    mass = scipy.stats.binom.pmf(np.arange(n + 1)[:, None], n, p[None])
    cover = lambda bound: (
        mass * (np.array([bound(k, n, level) for k in range(n + 1)])[:, None] >= p[None])
    ).sum(axis=0)
    assert cover(chernoff).min() >= level
    assert cover(jeffreys).min() < level and abs(cover(jeffreys).mean() - level) < 0.02


def test_no_failure_in_a_million():
    """The published numbers: 3.00e-6 and 1.92e-6; the rule of three, and Chernoff's bound is the
    exact one at k = 0.
    """
    assert jeffreys(0, 10**6) == pytest.approx(1.92e-6, abs=0.005e-6)
    assert chernoff(0, 10**6) == pytest.approx(3.00e-6, abs=0.005e-6)
    assert chernoff(0, 10**6) == pytest.approx(clopper_pearson(0, 10**6, 0.9)[1], rel=1e-9)


def test_log_normal():
    """Quantiles of scipy's log-normal distribution about the mean; symmetric in logarithms, above
    0, at most 1, and at any size.
    """
    for log_mean, relative, level in (
        (np.log(1e-6), 0.02, 0.95),
        (np.log(1e-6), 3.0, 0.9),
        (-500.0, 0.5, 0.999),
    ):
        low, high = log_normal(log_mean, relative, level)
        s = np.sqrt(np.log1p(relative**2))
        expected = log_mean + s * scipy.stats.norm.ppf([(1 - level) / 2, (1 + level) / 2])
        np.testing.assert_allclose(np.log([low, high]), expected, rtol=1e-9)
        assert 0 < low < math.exp(log_mean) < high < 1
    low, high = log_normal(np.log(0.9), 0.5)
    assert high == 1 and 0 < low < 0.9
    assert log_normal(-3.0, 0.0) == pytest.approx((math.exp(-3), math.exp(-3)))
    low, high = log_normal(np.log(0.01), 0.01)  # of a small error, the normal interval
    assert (low, high) == pytest.approx((0.01 * (1 - 0.0196), 0.01 * (1 + 0.0196)), rel=3e-4)


@pytest.mark.parametrize("bound", [chernoff, jeffreys])
@pytest.mark.parametrize(
    "bad, match",
    [
        ((1, 0), "n must be"),
        ((5, 4), "k must be"),
        ((-1, 4), "k must be"),
        ((1, 4, 1.0), "level must"),
        ((1, 4, 0.0), "level must"),
        ((0.5, 4), "k must"),
    ],
)
def test_bad_counts(bound, bad, match):
    with pytest.raises(ValueError, match=f"{bound.__name__}: {match}"):
        bound(*bad)


def test_the_intervals_as_printed():
    """Eq. 15 to 17 of Lipkis and Agogino."""
    low, high = intervals.normal(3.0, 2.0, 0.9)
    assert low < 0 and (low + high) / 2 == pytest.approx(3.0)
    assert high == pytest.approx(3.0 + 2.0 * 1.6448536269514722)
    delta = intervals.delta_bound(3, 100) - 0.03
    assert np.exp(-100 * delta**2) == pytest.approx(0.05)
    assert intervals.delta_bound(3, 100) > intervals.chernoff(3, 100)
    assert intervals.delta_bound(100, 100) == 1
    for bad, match in (
        (lambda: intervals.delta_bound(3, 2), "delta_bound: k must be a whole number"),
        (lambda: intervals.normal(np.nan, 1.0), "normal: mean must be"),
        (lambda: intervals.normal(1.0, -1.0), "normal: standard_error must be"),
        (lambda: intervals.normal(1.0, 1.0, 1.0), "normal: level must be"),
    ):
        with pytest.raises(ValueError, match=match):
            bad()
