"""Tilts that are fitted to the failures of populations: what they are given, where they answer, and
where they are given up.
"""

import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jast
from jast import distributions as D
from jast._src.distributions.independent_parts import parts
from jast._src.estimate.population import answer, importance, tilted
from jast._src.estimate.population.search import Answer, Kind
from jast._src.estimate.proposal_search.audit import Missing
from jast._src.estimate.tilts.recorded import failing_points
from jast._src.normal_space import transform
from jast.estimate import population

BY_DISTANCE, BY_WIDTH = Kind("distance", 5), Kind("width", 10)


def forgetful(horizon=60, one=1.0):
    """s' = .8 s + x fails beyond +-8 at any step: no Gaussian has all of these moments."""
    return jast.Simulator(
        init=lambda x0: 0.0 * jnp.asarray(one),
        step=lambda s, x: 0.8 * s + x,
        disturbance=lambda s: D.Normal(0.0 * s, one),
        evaluate=lambda s: (jnp.abs(s) >= 8, jnp.maximum(8 - jnp.abs(s), 0)),
        horizon=horizon,
    )


def log_truth(horizon=60):
    """By the density inside, on a grid of midpoints whose spacing errs by less than 1e-4."""
    edges = np.linspace(-8, 8, 1601)
    s, width = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    move = stats.norm.pdf(s[:, None] - 0.8 * s[None]) * width
    stays = stats.norm.cdf(8 - 0.8 * s) - stats.norm.cdf(-8 - 0.8 * s)
    failed, density = 2 * stats.norm.sf(8), stats.norm.pdf(s) * width
    for _ in range(horizon - 1):
        failed += density @ (1 - stays)
        density = move @ density
    return math.log(failed)


SIDES = forgetful()


def mixed():
    """A coin, a number of two components, and a normal number whose scale is the state's."""

    def noise(s):
        odd = D.MixtureSameFamily(
            D.Categorical(probs=jnp.array([0.9, 0.1])),
            D.Normal(jnp.array([0.0, 2.0]), jnp.array([1.0, 0.5])),
        )
        return D.Joint((D.Bernoulli(probs=0.3), odd, D.Normal(0.0, 1 + 0.1 * jnp.abs(s))))

    return jast.Simulator(
        init=lambda x0: x0,
        step=lambda s, x: (
            0.9 * s + 0.2 * (2.0 * x[0].astype(s.dtype) - 0.6) + 0.2 * x[1] + 0.2 * x[2]
        ),
        disturbance=noise,
        evaluate=lambda s: (s > 1.5, jnp.maximum(1.5 - s, 0.0)),
        horizon=12,
        start=lambda: D.Normal(0.0, 0.5),
    )


def test_points_are_told_by_their_choices_and_their_own_numbers(key):
    """What stands in the `Points` of a failure gives the disturbances that its point gives."""
    sim = mixed()
    z = np.asarray(jax.random.normal(key, (300, transform.dimension(sim))))
    outcomes = transform.outcomes(sim, z)
    rows = np.flatnonzero(outcomes.failure)
    assert 20 < len(rows) < 280
    points = failing_points(sim, z)
    np.testing.assert_array_equal(points.length, outcomes.length[rows])
    episodes = transform.episodes(sim, z[rows])
    np.testing.assert_allclose(points.trace.first_normals[:, 0], 2 * episodes.x0, atol=1e-5)
    for i in range(len(rows)):
        states = jast.replay(
            sim, *jax.tree.map(lambda a, i=i: a[i], (episodes.disturbances, episodes.x0))
        ).states
        for t in range(points.length[i]):
            p = parts(sim.disturbance(states[t]))
            numbers, choices = points.trace.normals[i, t], points.trace.choices[i, t]
            told = p.value(numbers, tuple(jnp.split(choices, 2)))
            own = jax.tree.map(lambda a, i=i, t=t: a[i, t], episodes.disturbances)
            assert told[0] == own[0]
            np.testing.assert_allclose(told[1:], own[1:], atol=2e-4)


@pytest.fixture(scope="module")
def sides():
    return population(jax.random.key(0), SIDES, 400_000)


@pytest.mark.slow
def test_tilts_of_the_failures_draw_the_last_part(sides):
    """It may fail on either side, at any step: populations come to 5 %."""
    truth = log_truth()
    assert sides.reliable and sides.method.endswith("then importance sampling")
    assert sides.relative_error < 0.02
    assert abs(sides.log_mean - truth) < 4 * sides.relative_error
    assert sides.evaluations <= 400_000


@pytest.mark.slow
def test_what_tilts_drew_serves_further_answers(sides, key):
    above = jast.estimate.events(SIDES, sides, {"above": lambda s: s > 0})["above"]
    low, high = above.given_interval
    assert low < 0.5 < high and high - low < 0.2
    drawn = jast.estimate.failure_samples(key, SIDES, sides, 50, moves=1)
    assert bool(drawn.failures.failure.all())


@pytest.mark.slow
def test_the_same_bits_with_a_checkpoint(sides, tmp_path):
    for _ in range(2):
        kept = population(jax.random.key(0), SIDES, 400_000, checkpoint=tmp_path)
        assert kept.log_mean == sides.log_mean and kept.interval == sides.interval


@pytest.mark.slow
def test_a_system_in_double_precision(key):
    with jax.enable_x64(True):
        found = population(key, forgetful(one=np.float64(1)), 400_000)
    assert found.reliable and found.method.endswith("then importance sampling")
    assert abs(found.log_mean - log_truth()) < 4 * found.relative_error


@pytest.mark.slow
@pytest.mark.parametrize("share, fits", [(0.1, 2), (0.3, 1)])
def test_what_stays_uncovered_leaves_the_answer_to_populations(key, monkeypatch, share, fits):
    """Little of it is taken in, once; much is not."""
    calls = []

    def missing(f, state, points, whole):
        calls.append(whole)
        return state, [Missing(share, points)]

    monkeypatch.setattr(tilted, "missing_among", missing)
    found = population(key, SIDES, 400_000)
    assert len(calls) == 2 * fits  # of two ways
    assert "importance" not in found.method
    assert any("hardly draw" in line for line in found.history)
    truth = log_truth()
    assert abs(found.log_mean - truth) < 4 * found.relative_error


@pytest.mark.slow
def test_an_interruption_of_the_fit_leaves_the_populations(key, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(importance, "fit_tilts", interrupted)
    found = population(key, SIDES, 400_000)
    assert not found.reliable and "interrupted" in found.warnings[0]
    assert abs(found.log_mean - log_truth()) < 4 * found.relative_error


@pytest.mark.parametrize(
    "by_distance, by_width, words",
    [
        ((1.1, 0.1), (0.9, 0.1), None),
        ((1.0, 0.1), (0.2, 0.1), None),  # a way that has not met what the other did
        ((1.0, 0.1), (1.6, 0.1), "against populations"),  # one that met what is not drawn
        ((0.5, 0.1), (0.5, 0.1), "against populations"),  # nothing confirms it
        ((1.3, 0.1), (1.3, 0.1), "against populations"),  # together they say more
        ((1.3, 0.1), (0.6, 0.1), None),
    ],
)
def test_a_way_that_says_more_contradicts_and_one_that_says_less_does_not(
    by_distance, by_width, words
):
    each = {
        kind: Answer(math.log(1e-4 * share), error)
        for kind, (share, error) in ((BY_DISTANCE, by_distance), (BY_WIDTH, by_width))
    }
    agree = abs(by_distance[0] - by_width[0]) < 0.4
    search = SimpleNamespace(answer=each.get, history=[], agree=lambda kinds: agree)
    exact = Answer(math.log(1e-4), 0.01)
    reasons = answer._check_by_populations(search, list(each), exact)
    assert len(search.history) == 1
    assert reasons == [] if words is None else words in reasons[0]


def test_of_few_steps_nothing_is_tilted():
    search = SimpleNamespace(sim=forgetful(29))
    assert tilted.fit_tilts(search, (BY_DISTANCE, BY_WIDTH), 10_000) is None


@pytest.mark.slow
def test_a_proposal_that_is_left_leaves_nothing_in_the_checkpoint_of_the_next(
    key, monkeypatch, tmp_path
):
    """Gaussians of a tenth of the variance, whose weights have none, are left after their pilot."""
    eye, root = np.eye(60, dtype=np.float32)[None], np.float32(0.1) ** 0.5
    narrow = transform.Latent(
        np.zeros(1, np.float32), np.full((1, 60), 0.3, np.float32), root * eye, eye / root
    )
    first = importance.FittedProposal(narrow, 20_000, 1.01 * importance.TILTS_TARGET_ERROR)
    monkeypatch.setattr(importance, "_best_proposal", lambda *args: first)
    found, kept = (population(key, SIDES, 400_000, checkpoint=c) for c in (None, tmp_path))
    assert any("a pilot of importance sampling by Gaussians" in line for line in found.history)
    assert any("a pilot of importance sampling by tilts" in line for line in found.history)
    assert kept.history == found.history and kept.log_mean == found.log_mean
