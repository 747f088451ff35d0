"""Importance sampling after populations: where it serves it is exact, where it does not it is left,
and populations check it.
"""

import math
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jast
from jast import distributions as D
from jast._src.estimate.population import descents, importance
from jast._src.estimate.population.failure_sample import Sample
from jast._src.normal_space.transform import Latent
from jast.estimate import population
from jast.simulators import limit_state

PLANE = limit_state(lambda u: 4.0 - jnp.sum(u) / 20**0.5, 20)  # P = Phi(-4)
ANY = limit_state(lambda u: 4.5 - jnp.max(jnp.abs(u)), 200)  # 400 modes


@pytest.fixture(scope="module")
def plane():
    return population(jax.random.key(3), PLANE, 300_000)


@pytest.mark.slow
def test_gaussians_of_the_failures_draw_the_last_part(plane):
    """A half-space is what one Gaussian fits: some 1 % by less than 300,000 evaluations, where
    populations come to 4 %.
    """
    assert plane.reliable and plane.method.endswith("then importance sampling")
    assert abs(plane.log_mean - stats.norm.logsf(4)) < 4 * plane.relative_error < 4 * 0.01
    assert plane.evaluations <= 300_000 and plane.k_hat < 0.7
    assert plane.interval[0] < stats.norm.sf(4) < plane.interval[1]


@pytest.mark.slow
def test_what_populations_left_stays(plane, key):
    """Their failures, as a `Sample`; the draws, which further answers use, are those of Gaussians;
    the model's own draws guarantee an interval.
    """
    assert isinstance(plane.proposal, Sample) and isinstance(plane.draws.source, Latent)
    failing, _, drawn = plane.plain
    assert failing <= drawn < plane.evaluations and plane.unseen > 0
    drawn = jast.estimate.failure_samples(key, PLANE, plane, 50, moves=1)
    assert bool(drawn.failures.failure.all())


def test_the_same_bits_with_a_checkpoint(plane, tmp_path):
    for _ in range(2):
        kept = population(jax.random.key(3), PLANE, 300_000, checkpoint=tmp_path)
        assert kept.log_mean == plane.log_mean and kept.interval == plane.interval


@pytest.mark.slow
@pytest.mark.parametrize("v, serves", [(0.1, False), (0.8, True)])
def test_weights_without_a_variance_are_left_after_a_pilot(key, monkeypatch, v, serves):
    """The model over N(m, v I) has the Pareto shape 1 - v where m is the likeliest failure of a
    half-space: no variance for .1, one for .8.
    """
    sim = limit_state(lambda u: 4.0 - u[0], 2)
    root = np.sqrt(v, dtype=np.float32)
    one, two = np.eye(2, dtype=np.float32)[None], np.array([[4.0, 0.0]], np.float32)
    q = Latent(np.zeros(1, np.float32), two, root * one, one / root)
    promise = importance.FittedProposal(q, 80_000, 1e-3)
    monkeypatch.setattr(importance, "_fit_proposal", lambda *_: promise)
    found = population(key, sim, 300_000)
    assert ("importance sampling" in found.method) == serves
    assert any("no variance" in line for line in found.history) != serves
    assert any("a pilot" in line and "10000 draws" in line for line in found.history)
    assert abs(found.log_mean - stats.norm.logsf(4)) < 4 * found.relative_error


@pytest.mark.slow
def test_where_no_gaussians_serve_populations_answer(key):
    """Any of 200 numbers is great: 400 modes, P = 1 - (1 - 2 Phi(-4.5))^200."""
    found = population(key, ANY, 400_000)
    truth = np.log(-np.expm1(200 * np.log1p(-2 * stats.norm.sf(4.5))))
    assert "importance" not in found.method
    assert abs(found.log_mean - truth) < 4 * found.relative_error


@pytest.mark.slow
@pytest.mark.parametrize("factor, words", [(0.5, "against populations"), (1.0, None)])
def test_populations_check_it(key, monkeypatch, factor, words):
    """Half the probability, as where a mode were missing, is flagged."""
    weighted = importance.importance_estimate

    def wrong(*args):
        found = weighted(*args)
        return found._replace(log_mean=found.log_mean + np.log(factor))

    monkeypatch.setattr(
        sys.modules["jast._src.estimate.population.population"], "importance_estimate", wrong
    )
    found = population(key, PLANE, 300_000)
    assert found.reliable == (words is None)
    assert words is None or words in found.warnings[0]


def test_weights_that_speak_against_themselves_are_left(key, monkeypatch):
    drawn = importance.draw_estimate
    doubted = lambda *args, **more: drawn(*args, **more)._replace(
        reliable=False, warnings=("a doubt",)
    )
    monkeypatch.setattr(importance, "draw_estimate", doubted)
    found = population(key, PLANE, 300_000)
    assert "importance" not in found.method and any("a doubt" in line for line in found.history)


def test_an_interruption_of_the_draws_leaves_the_populations(key, monkeypatch):
    def interrupted(*args, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(importance, "draw_estimate", interrupted)
    found = population(key, PLANE, 300_000)
    assert not found.reliable and "interrupted" in found.warnings[0]
    assert abs(found.log_mean - stats.norm.logsf(4)) < 4 * found.relative_error


def test_an_interruption_of_the_pilot_is_the_end_of_the_draws(key, monkeypatch):
    drawn, calls = importance.draw_estimate, []

    def partly(*args, **more):
        calls.append(1)
        found = drawn(*args, **more)
        return found._replace(samples=found.samples // 2)

    monkeypatch.setattr(importance, "draw_estimate", partly)
    found = population(key, PLANE, 300_000)
    assert len(calls) == 1 and "importance" not in found.method
    assert not found.reliable and "interrupted" in found.warnings[0]


@pytest.mark.slow
def test_the_first_population_by_width_costs_as_much_as_it_may(key):
    """In 400 numbers the way from width 2 to 1 has some 24 widths; the guess of their number is
    right to a fifth.
    """
    sim = limit_state(lambda u: 24.0 - jnp.linalg.norm(u), 400)  # P = P(chi2_400 > 576) = 1.5e-8
    whole = descents.by_width(key, sim, 1024, 10, 1024)
    less = descents.by_width(key, sim, 1024, 10, 1024, max_evaluations=60_000)
    assert whole.size == 1024 and 128 <= less.size < 512
    assert less.evaluations < 1.3 * (60_000 + 2 * 1024) < whole.evaluations


def test_the_width_where_failures_are_least_rare(key):
    """A ball about a point two standard deviations away: noise that is wider misses it."""
    sim = limit_state(lambda u: jnp.where(jnp.sum((u - 1.2) ** 2) < 0.3, -1.0, 1.0), 3)
    run = descents.by_width(key, sim, 8192, 10, 8192)
    truth = stats.ncx2.cdf(0.3, 3, 3 * 1.2**2)
    assert run.levels[0] < 3
    assert abs(float(run.log_mean) - np.log(truth)) < 4 * np.sqrt(run.variance)


def test_where_no_way_leads_to_failures_the_rest_is_plain_draws(key, monkeypatch):
    lost = lambda key, sim, n, moves, capacity, **_: (
        descents._ParticlePopulation(key, sim, n, moves, capacity)
        .without_failures()
        ._replace(plain=np.array([0, 0, n]), evaluations=np.int64(n))
    )
    monkeypatch.setitem(descents.DESCENTS, "distance", lost)
    monkeypatch.setitem(descents.DESCENTS, "width", lost)
    found = population(key, PLANE, 200_000)
    assert "plain draws" in found.method and found.evaluations == 200_000


@pytest.mark.slow
@pytest.mark.parametrize("beta, drawn", [(4.0, "then importance sampling"), (1.5, "plain draws")])
def test_sensitivities_are_told_by_what_drew(beta, drawn, key):
    """d log P / d mean of 20 numbers N(m, 1), P = Phi(sqrt(20) m - beta), m = 0."""
    noise = jax.tree_util.Partial(lambda m, s: D.Normal(m, 1.0), jnp.zeros(()))
    gap = lambda s: beta - s / 20**0.5
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, w: s + w,
        disturbance=noise,
        evaluate=lambda s: (gap(s) <= 0, jnp.maximum(gap(s), 0.0)),
        horizon=20,
        episodic=True,
    )
    found = population(key, sim, 300_000)
    assert found.method.endswith(drawn)
    told = jast.explain.sensitivity(sim, found)
    truth = 20**0.5 * stats.norm.pdf(beta) / stats.norm.sf(beta)
    row = next(r for r in told.rows if r[1] == 0)
    assert told.reliable and abs(row[2] - truth) < 4 * row[3] < 0.1 * truth


@pytest.mark.slow
@pytest.mark.parametrize("budget", [50_000, 1_000_000])
def test_choices_are_weighted_where_populations_can_check_it(key, budget):
    """A chain of four states whose miss distance says nothing. What a population of few points did
    not meet of its choices the Gaussians that were fitted to it leave out.
    """
    steps = np.array([[0.97, 0.03, 0, 0], [0.6, 0.37, 0.03, 0], [0.2, 0.5, 0.27, 0.03]])
    p = jnp.maximum(jnp.asarray([*steps, [0, 0, 0, 1]], jnp.float32), 1e-30)
    chain = jast.Simulator(
        init=lambda x0: jnp.zeros((), jnp.int32),
        step=lambda s, x: x.astype(jnp.int32),
        disturbance=lambda s: D.Categorical(probs=p[s]),
        evaluate=lambda s: (s >= 3, jnp.where(s >= 3, 0.0, 1.0)),
        horizon=10,
    )
    found = population(key, chain, budget)
    truth = np.linalg.matrix_power([*steps, [0, 0, 0, 1]], 10)[0, 3]
    assert ("importance" in found.method) == (budget == 1_000_000)
    # within 4 standard errors, as is one of 15,000 by chance
    assert abs(found.log_mean - math.log(truth)) < 4 * found.relative_error
