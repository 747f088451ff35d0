"""Plain draws: by normal numbers where these are as cheap as draws, else by keys."""

import jax
import numpy as np
import pytest
from checks import compiled
from scipy import stats
from systems import line

from jast import distributions as D
from jast._src.core.signature import signature_of
from jast._src.estimate.proposal_search.mixture_draws import plain_chunk
from jast.estimate import events, monte_carlo

SAMPLES = 20_000


def above(disturbance, threshold, steps=1):
    """It fails where the sum of so many disturbances is above a threshold."""
    return line(
        disturbance=lambda s: disturbance,
        evaluate=lambda s: (s > threshold, threshold - s),
        horizon=steps,
        episodic=True,
    )


CASES = {
    "Normal": (lambda: D.Normal(0.0, 1.0), stats.norm(), True),
    "Exponential": (lambda: D.Exponential(1.0), stats.expon(), True),
    "Logistic": (lambda: D.Logistic(0.0, 1.0), stats.logistic(), False),
    "StudentT": (lambda: D.StudentT(4.0, 0.0, 1.0), stats.t(4.0), False),
}


@pytest.mark.slow
@pytest.mark.parametrize("family", CASES)
def test_the_probability(family):
    """Of a failure above 2: the count is binomial, and |z| < 4.5 but once in 150,000."""
    make, exact, closed = CASES[family]
    sim, p = above(make(), 2.0), exact.sf(2.0)
    assert signature_of(sim).closed == closed
    found = monte_carlo(jax.random.key(3), sim, SAMPLES)
    assert found.samples == found.evaluations == SAMPLES
    assert abs(found.failing - p * SAMPLES) < 4.5 * np.sqrt(p * (1 - p) * SAMPLES)
    assert found.plain == (found.failing, found.invalid, SAMPLES)


@pytest.mark.parametrize("family", ["Normal", "Logistic"])
def test_failing_draws_are_found_again(family):
    """By their numbers: each of them fails, and those above the middle of the failures are as many
    as the distances say.
    """
    sim = above(CASES[family][0](), 2.0)
    found = monte_carlo(jax.random.key(0), sim, SAMPLES)
    named = {"fails": lambda s: s > 2.0, "far": lambda s: s > 2.5}
    out = events(sim, found, named)
    assert out["fails"].failing == found.failing
    far = found.draws.distance[found.draws.failure] < 2.0 - 2.5
    assert out["far"].failing == far.sum() > 0


def test_points_of_a_chunk_are_standard_normal_and_do_not_depend_on_their_number(key):
    sim = above(D.Normal(0.0, 1.0), 2.0, steps=30)
    z = plain_chunk(key, 0, 5000, sim)
    np.testing.assert_array_equal(z[:100], plain_chunk(key, 0, 100, sim))
    assert not np.array_equal(z, plain_chunk(key, 1, 5000, sim))
    # of 150,000 numbers the statistic of Kolmogorov and Smirnov is above .005 once in 1000
    assert stats.kstest(z.ravel(), "norm").statistic < 0.005
    correlations = np.corrcoef(z.T)[np.triu_indices(30, 1)]
    assert np.abs(correlations).max() < 5 / np.sqrt(5000)


@pytest.mark.parametrize("family", ["Normal", "Logistic"])
def test_another_key_or_number_compiles_nothing(family):
    sim = above(CASES[family][0](), 2.0)
    monte_carlo(jax.random.key(0), sim, 1000)
    with compiled() as programs:
        monte_carlo(jax.random.key(1), sim, SAMPLES)
    assert not programs


def test_more_than_fits_one_chunk_is_the_same_start(key):
    """The first draws do not depend on how many there are."""
    sim = above(D.Normal(0.0, 1.0), 2.0)
    few, many = (monte_carlo(key, sim, n).draws for n in (5000, SAMPLES))
    mine = many.row < 5000
    np.testing.assert_array_equal(few.row[few.failure], many.row[many.failure & mine])


def test_events_of_another_simulator_are_refused(key):
    """Its failures do not fail in this one; and an event that cannot be asked is named."""
    noise = D.Normal(0.0, 1.0)
    sim, longer, harder = above(noise, 1.5), above(noise, 1.5, 3), above(noise, 4.0)
    found = monte_carlo(key, sim, SAMPLES)
    words = "events: sim must be the simulator .* one in which [0-9]+ of [0-9]+ do"
    for other in (longer, harder):
        with pytest.raises(ValueError, match=words):
            events(other, found, {"any": lambda s: s > 0})
    with pytest.raises(ValueError, match="named: odd: raised AttributeError"):
        events(sim, found, {"odd": lambda s: s.speed > 0})
