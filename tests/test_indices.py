"""jast.explain.indices: the variance-based indices of a failure meet their closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from systems import dice, hyperplane, walk

import jast
from jast import explain
from jast.distributions import Categorical, Joint, Normal


def _plane(a, beta, x):
    return beta - a @ x


def plane(a, beta):
    return jast.simulators.limit_state(Partial(_plane, jnp.asarray(a), jnp.asarray(beta)), len(a))


def truth(a, beta):
    """(P, first order, total) of each number of a plane: E[P(F | z_i)^2] by quadrature, P(F | z_i)
    = Phi((a_i z - beta) / sqrt(1 - a_i^2)) (Papaioannou and Straub, 2021).
    """
    from statistics import NormalDist

    phi = np.vectorize(NormalDist().cdf)
    z = np.linspace(-9, 9, 4001)
    weight = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) * (z[1] - z[0])
    p = float(phi(-beta))
    square = lambda r: float(weight @ phi((r * z - beta) / np.sqrt(1 - r * r)) ** 2)
    first = [(square(r) - p * p) / (p - p * p) for r in a]
    total = [1 - (square(np.sqrt(1 - r * r)) - p * p) / (p - p * p) for r in a]
    return p, first, total


@pytest.mark.slow
@pytest.mark.parametrize("a, beta", [((0.9, 0.4, 0.19**0.5 * 0.4), 3.0), ((0.8, 0.6), 4.0)])
def test_indices_of_a_plane(key, a, beta):
    a = np.array(a) / np.linalg.norm(a)
    p, first, total = truth(a, beta)
    sim = plane(a, beta)
    estimate = jast.estimate.failure_probability(key, sim, 20_000)
    found = explain.indices(jax.random.key(7), sim, estimate, draws=1000, level=0.999)
    assert found.reliable and found.evaluations == 1000 * len(a)
    assert found.probability == pytest.approx(p, rel=0.05)
    for row, s, t in zip(found.rows, first, total, strict=True):
        assert row.first_interval[0] <= s <= row.first_interval[1]
        assert row.total_interval[0] <= t <= row.total_interval[1]
        assert row.first == pytest.approx(s, rel=0.2) and row.total == pytest.approx(t, abs=0.08)
        assert (row.name, row.step) == (f"x[{found.rows.index(row)}]", 1)
    assert str(found).splitlines()[1].startswith("x[0]") and "first order" in str(found)


@pytest.mark.slow
def test_a_number_that_does_nothing_has_none(key):
    sim = plane((1.0, 0.0), 2.5)
    estimate = jast.estimate.failure_probability(key, sim, 10_000)
    alone, idle = explain.indices(key, sim, estimate, draws=200).rows
    assert alone.first == pytest.approx(1, abs=0.15) and alone.total > 0.98
    assert idle.total == 0
    assert abs(idle.first) < 1e-3
    assert abs(idle.mean) < 0.1
    without = explain.indices(key, sim, estimate, draws=0)
    assert without.evaluations == 0 and np.isnan(without.rows[0].total)
    assert without.rows[0].first == pytest.approx(1, abs=0.15) and " - " in str(without)


def coins():
    """Fails where the start and the first step both come out as 1, each with probability 0.1: first
    order 0.0009 / 0.0099, total 0.009 / 0.0099 each; all else does nothing.
    """
    coin = lambda: Categorical(probs=jnp.array([0.05, 0.1, 0.85]))
    return jast.Simulator(
        init=lambda x0: (x0["coin"] == 1, jnp.zeros((), bool), jnp.int32(0)),
        step=lambda s, x: (s[0], jnp.where(s[2] == 0, x["coin"] == 1, s[1]), s[2] + 1),
        disturbance=lambda s: Joint({"coin": coin(), "noise": Normal(0.0, 1.0)}),
        evaluate=lambda s: (
            s[0] & s[1],
            2.0 - jnp.where(s[0], 1.0, 0.0) - jnp.where(s[1], 1.0, 0.0),
        ),
        horizon=2,
        start=lambda: Joint({"coin": coin()}),
    )


@pytest.mark.long
def test_indices_of_choices(key):
    sim = coins()
    estimate = jast.estimate.failure_probability(key, sim, 10_000)
    found = explain.indices(key, sim, estimate, draws=500, level=0.999)
    assert [(r.name, r.step) for r in found.rows[:3]] == [("coin", 0), ("coin", 1), ("noise", 1)]
    for row in found.rows[:2]:
        assert row.first_interval[0] <= 1 / 11 <= row.first_interval[1]
        assert row.total_interval[0] <= 10 / 11 <= row.total_interval[1]
    for row in found.rows[2:]:
        assert row.total == 0 and row.first_interval[0] <= 0 <= row.first_interval[1]
    assert found.evaluations > 500 * 5  # tilts are drawn again


@pytest.mark.slow
def test_a_walk_that_ends_early_has_the_model_behind_its_end(key):
    """What comes after the end decides nothing: total 0 where no failure takes so long."""
    sim = walk(fails=lambda s: s > 1.5, horizon=2)
    estimate = jast.estimate.failure_probability(key, sim, 5000)
    one, two = explain.indices(key, sim, estimate, draws=300).rows
    assert 0 < two.total < one.total and 0 < two.first < one.first


def test_plain_draws_serve(key):
    """Four numbers of a sum count alike; of 400 failures the totals are some .1 apart."""
    sim = hyperplane(1.0)
    estimate = jast.estimate.monte_carlo(key, sim, 2000)
    totals = [row.total for row in explain.indices(key, sim, estimate).rows]
    assert len(totals) == 4 and max(totals) - min(totals) < 0.3 * max(totals)


@pytest.mark.slow
def test_what_indices_refuse(key):
    sim = hyperplane()
    good = jast.estimate.failure_probability(key, sim, 5000)
    of_policy = good._replace(draws=good.draws._replace(source="policy"))
    cases = [
        (lambda: explain.indices(0, sim, good), "indices: key"),
        (lambda: explain.indices(key, sim, 3.0), "indices: estimate must be a jast.estimate"),
        (lambda: explain.indices(key, sim, good, draws=-1), "indices: draws"),
        (lambda: explain.indices(key, sim, good, level=2), "indices: level"),
        (lambda: explain.indices(key, hyperplane(4.0, 5), good), "indices: sim must be .* with 4"),
        (lambda: explain.indices(key, dice(), good), "indices: disturbance: .*no quantile"),
        (lambda: explain.indices(key, sim, of_policy), "indices: estimate must have drawn normal"),
        (
            lambda: explain.indices(key, sim, good._replace(draws=None)),
            "indices: estimate must have kept its weighted draws",
        ),
    ]
    for call, words in cases:
        with pytest.raises((ValueError, TypeError), match=words):
            call()
