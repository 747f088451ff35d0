"""Systems with many failure modes: what finds them, and a proposal that holds them all."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from benchmarks.markov_systems import CASES
from jast._src.estimate import host_populations
from jast._src.estimate.diagnostics import mode_warnings
from jast._src.estimate.gaussians.design_points import explained
from jast._src.estimate.gaussians.exploration import explore_failures
from jast._src.estimate.gaussians.family import GaussianFamily, _fit_sparse
from jast._src.estimate.gaussians.mixture_fit import (
    _greatest,
    _with_factors,
    most_components,
    shrink_to_anchors,
)
from jast._src.estimate.host_populations import PopulationSampler, bracket_boundary, cool
from jast._src.estimate.proposal_search.search_state import SearchState, search_context
from jast._src.normal_space import transform as L
from jast.estimate import failure_probability, monte_carlo
from jast.simulators import limit_state

FLOAT = jnp.zeros(()).dtype


def _two(z):
    return 3.0 - jnp.minimum(z[0], z[1])


def _sum(z):
    return 3.0 - jnp.sum(z) / math.sqrt(z.shape[0])


def corner():
    """Fails where both of the first two of eight numbers are above 3."""
    return limit_state(_two, 8)


def test_numbers_that_a_failure_does_not_need_are_zeroed():
    """All stay failures, none moves out, and nearly all of the six others come to 0: each is tried
    12 times together with half or a quarter of the others, and a try with neither of the first two
    in it succeeds, so a number is left at the most with (1 - 1/8)^9 (1 - 9/64)^9 = .08.
    """
    sim, z = corner(), np.random.default_rng(0).normal(size=(40, 8)).astype(FLOAT)
    z[:, :2] = 3.5
    sampler = PopulationSampler(np.random.default_rng(0), sim, 40)
    rested = sampler.zero_unneeded(sampler.simulate(z), 18)
    assert (rested.score == -np.inf).all() and (rested.z[:, :2] == 3.5).all()
    left = (rested.z[:, 2:] != 0).mean()
    assert left < 0.08 + 4 * math.sqrt(0.08 * 0.92 / 240) and sampler.evaluations == 40 * 19


def test_what_needs_all_its_numbers_is_left_alone():
    """No try succeeds, so there are only a few."""
    z = np.full((20, 8), 3.0 / math.sqrt(8) + 1e-3, FLOAT)
    sampler = PopulationSampler(np.random.default_rng(0), limit_state(_sum, 8), 20)
    population = sampler.simulate(z)
    assert (sampler.zero_unneeded(population, 18).z == z).all() and sampler.evaluations == 20 * 5


def test_cooled_failures_without_unneeded_numbers_are_nearer(key):
    """In the corner the least norm is 4.243."""
    far, near = (
        np.median(np.linalg.norm(cool(key, corner(), 40, zeroing_rounds=rounds).points, axis=1))
        for rounds in (0, 18)
    )
    assert 4.24 < near < 4.5 < far


def test_edges_are_on_both_sides_of_the_boundary(key):
    """Each failing point is a 64th of its way farther out than the safe one, in the mean."""
    sim = limit_state(_sum, 8)
    safe, fails, evaluations = bracket_boundary(key, sim, 64)
    assert len(fails) >= 6 and evaluations >= 64 + 6 * len(fails)
    assert L.outcomes(sim, fails).failure.all() and not L.outcomes(sim, safe).failure.any()
    gap = np.linalg.norm(fails - safe, axis=1) / np.linalg.norm(fails, axis=1)
    assert (gap < 0.05).all()


def test_a_known_design_point_explains_what_lies_beyond_its_plane():
    known = np.array([[3.0, 0.0], [0.0, -2.0]])
    points = np.array([[3.1, 9.0], [2.9, 9.0], [0.0, -2.5], [-4.0, 4.0]])
    assert explained(points, known).tolist() == [True, False, True, False]
    assert explained(points, known, 0.05).tolist() == [True, True, True, False]
    assert not explained(points, known[:0]).any()


def test_chains_start_where_nothing_known_explains_a_failure(key, monkeypatch):
    """Half of 64 draws fail, beyond one of two planes of which one is known; all that fail by the
    other alone are among the 16 that chains start from, and there are fewer of these without.
    """
    monkeypatch.setattr(host_populations, "COOLING_STEPS", 0)
    sim = limit_state(Partial(_either, jnp.asarray([0.5, 0.5])), 2)
    of = lambda known: (cool(key, sim, 16, design_points=known).points[:, 0] < 0.5).sum()
    failures, *_ = host_populations.draw_wide_failures(key, sim, 64)
    others = (failures.z[:, 0] < 0.5).sum()
    assert of(np.array([[0.5, 0.0]])) == min(others, 16) > of(None)


def _either(beta, z):
    return jnp.min(beta - z)


def test_a_mean_is_shrunk_to_its_design_point_by_what_may_be_noise():
    """All the way where its gap is that of noise, hardly where it is far greater (James and Stein
    1961: by (D - 2) / (n gap^2)); not at all in two dimensions.
    """
    anchors, mean = np.zeros((1, 12)), np.full(12, 0.5)
    np.testing.assert_allclose(shrink_to_anchors(mean, 2.0, anchors), anchors[0], atol=1e-12)
    np.testing.assert_allclose(shrink_to_anchors(mean, 1000.0, anchors), mean * (1 - 10 / 3000))
    np.testing.assert_array_equal(shrink_to_anchors(mean[:2], 2.0, anchors[:, :2]), mean[:2])


def test_a_proposal_holds_as_many_components_as_memory_allows(key):
    """256 in few dimensions, 40 in many, the greatest of them; and no more directions than it has
    two components for, beside the model.
    """
    rising = np.arange(300.0)
    for d, most, directions in ((2, 256, 125), (300, 186, 92), (400, 104, 51), (1000, 40, 19)):
        assert most_components(d) == most
        np.testing.assert_array_equal(_greatest(rising, d), np.arange(299, 299 - most, -1))
        f = GaussianFamily(limit_state(_sum, d), 100_000, search_context(key))
        assert f.directions == directions
    assert _greatest(np.array([0.0, 2.0, 0.0]), 2).tolist() == [1]


def test_a_sparse_proposal_differs_from_the_model_in_the_numbers_that_matter(key):
    """Of 18 modes, each a number above 4: the mean of a mode is 4.22 in its own number, exactly 0
    in the others, and it is narrower in its own alone.
    """
    d = 18
    f = GaussianFamily(limit_state(_sum, d), 100_000, search_context(key))
    anchors = 4.0 * np.eye(d)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(d * 50, d))
    mine = np.repeat(np.arange(d), 50)
    points[np.arange(len(points)), mine] = 4 + rng.exponential(0.22, size=len(points))
    state = SearchState(anchors=anchors, log_weight=np.zeros(len(points)))
    q = _with_factors(_fit_sparse(f, state, points, anchors))
    own = np.argmax(np.asarray(q.means), axis=1)
    narrow = np.asarray([f[i, i] < 0.9 for f, i in zip(q.factors, own, strict=True)])
    assert len(q.means) == 2 * d and narrow.sum() == d
    for mean, factor, i in zip(*(np.asarray(a)[narrow] for a in q[1:3]), own[narrow], strict=True):
        # 50 points: a mean within 4 of .22 / sqrt(50)
        assert abs(mean[i] - 4.22) < 0.125 and np.count_nonzero(mean) == 1
        others = np.delete(np.arange(d), i)
        np.testing.assert_allclose(factor[np.ix_(others, others)], np.eye(d - 1), atol=1e-6)


def test_all_of_sixty_turned_modes_are_found(key):
    """48 descents from draws of the model come to 33 of 60 equal modes; those from failures that
    these do not explain to nearly all others.
    """
    f = GaussianFamily(CASES["series 60, turned"][0](), 100_000, search_context(key))
    found = explore_failures(f, SearchState(), None, True).anchors
    assert (np.linalg.norm(found, axis=1) < 5.1).sum() >= 57


@pytest.mark.slow
@pytest.mark.parametrize("name", ["2 of 10", "series 60"])
def test_many_modes_are_answered(name):
    """Forty-five corners and sixty planes: within 4 standard errors, of 3 % at the most."""
    make, truth = CASES[name]
    found = failure_probability(jax.random.key(0), make(), 100_000)
    assert found.reliable and found.relative_error < 0.03
    assert abs(found.mean / truth - 1) < 4 * found.relative_error


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_sixty_modes_without_an_axis_are_answered_or_flagged(seed):
    """A mode that is lost in silence has a sixtieth of the probability."""
    make, truth = CASES["series 60, turned"]
    found = failure_probability(jax.random.key(seed), make(), 100_000)
    assert not found.reliable or abs(found.mean / truth - 1) < 4 * found.relative_error


def test_a_small_mode_known_by_few_draws_counts_by_what_it_does_to_the_whole():
    """A share of 2.5 % by 20 effective draws is uncertain by .56 %: much beside an error of .6 %,
    little beside one of 2 %.
    """
    shares, sizes = np.array([0.975, 0.025]), np.array([5000.0, 20.0])
    assert len(mode_warnings(shares, sizes, 0.006)) == 1 and not mode_warnings(shares, sizes, 0.02)


def test_a_count_of_few_failures_is_not_believed():
    """1.35e-3 of the episodes fail."""
    sim = limit_state(_sum, 8)
    found = [monte_carlo(jax.random.key(0), sim, n) for n in (2000, 40_000)]
    few, many = found
    assert 0 < few.failing < 10
    assert not few.reliable
    assert many.failing > 10
    assert many.reliable
    assert few.warnings == (f"{few.failing} failures are too few: only the interval is known",)
