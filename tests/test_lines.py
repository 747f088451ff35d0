"""Lines to half-spaces of failure: unbiased against closed forms, exact where a boundary is flat,
and not believed against draws that say otherwise.
"""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, norm

import jast
from benchmarks.few_calls import SlowLane, diffusion, plane, planes, slow_lane
from jast._src.estimate.estimate import estimate_from_mean
from jast._src.estimate.gaussians import lines
from jast._src.estimate.gaussians.family import GaussianFamily
from jast._src.estimate.gaussians.half_spaces import Planes
from jast._src.estimate.proposal_search import by_proposal, final_lines
from jast._src.estimate.proposal_search.final_lines import Lines, add_lines, draw_half_by_lines
from jast._src.estimate.proposal_search.search_state import SearchState, search_context
from jast.simulators import limit_state

AXES = np.eye(3)


def half_spaces(*depths, axes=AXES):
    k = len(depths)
    return Planes(axes[:k], np.array(depths), np.zeros(k, int), np.ones(k))


def total(planes, values):
    return np.exp(planes.log_mass).sum() * values


def believed(planes, g, n=4000, dtype=np.float64, dimension=3):
    """(mean, standard error, runs of a line) of the probability that g <= 0."""
    sim = limit_state(g, dimension)
    values, _, _, runs = lines.draw_lines(np.random.default_rng(0), sim, planes, n, dtype)
    assert values.shape == (n,) and np.isfinite(values).all()
    found = total(planes, values)
    return found.mean(), found.std() / n**0.5, runs / n


def test_a_plane_is_told_exactly_by_each_line_in_four_runs(dtype):
    known = half_spaces(3.5)
    sim = limit_state(lambda x: 3.5 - x[0], 3)
    values, _, invalid, runs = lines.draw_lines(np.random.default_rng(0), sim, known, 50, dtype)
    assert runs == 4 * 50 and invalid == 0
    # float32: a root of 3.5 is known to 1e-6, its tail to 4e-6
    np.testing.assert_allclose(total(known, values), norm.sf(3.5), rtol=2e-5)


@pytest.mark.parametrize("depth", [2.6, 3.0, 3.6])
def test_a_plane_elsewhere_than_it_was_said_to_be_is_found(depth):
    mean, error, runs = believed(half_spaces(depth), lambda x: 3.0 - x[0], 200)
    assert mean == pytest.approx(norm.sf(3.0), rel=1e-6) and runs < 6


def test_a_union_counts_what_fails_twice_once():
    at = 2.0, 2.3, 2.5
    truth = 1 - np.prod(norm.cdf(at))
    mean, error, _ = believed(half_spaces(*at), lambda x: jnp.min(jnp.asarray(at) - x))
    # sharing by hand: the parts of the half-spaces sum to one at each point, so 4 standard errors
    assert abs(mean - truth) < 4 * error and error < 0.01 * truth


@pytest.mark.parametrize("signed", [True, False])
def test_a_round_boundary_against_chi_square(signed):
    # outside of a ball of radius 4 on two sides of an axis, and lines along that axis only
    def g(x):
        left = 4.0 - jnp.linalg.norm(x)
        return left if signed else jnp.maximum(left, 0.0)

    axes = np.concatenate([AXES, -AXES])
    known = half_spaces(*[4.0] * 6, axes=axes)
    mean, error, _ = believed(known, g, 20_000)
    truth = chi2.sf(16.0, 3)
    assert abs(mean - truth) < 4 * error and error < 0.05 * truth


def test_a_line_that_is_safe_again_farther_on_is_corrected():
    def g(x):  # fails in a slab only
        return jnp.maximum(2.5 - x[0], x[0] - 2.8)

    mean, error, _ = believed(half_spaces(2.5), g, 20_000)
    truth = norm.sf(2.5) - norm.sf(2.8)
    assert abs(mean - truth) < 4 * error and error < 0.02 * truth


def test_a_line_that_fails_nearer_than_its_root_is_corrected():
    def g(x):  # a thin slab before the boundary, which no root search sees
        return jnp.where(jnp.abs(x[0] - 2.0) < 0.05, 0.0, 3.0 - x[0])

    mean, error, _ = believed(half_spaces(3.0), g, 20_000)
    truth = norm.sf(3.0) + norm.sf(1.95) - norm.sf(2.05)
    assert abs(mean - truth) < 4 * error and error < 0.15 * truth


def test_a_distance_that_tells_nothing_is_bracketed():
    def g(x):
        return jnp.where(x[0] + 0.1 * x[1] > 3.0, 0.0, 1.0)

    mean, error, runs = believed(half_spaces(3.0), g, 20_000)
    truth = norm.sf(3.0 / math.hypot(1, 0.1))
    assert abs(mean - truth) < 4 * error and error < 0.15 * truth
    assert runs <= 7


def test_nan_on_the_way_is_no_failure_and_counted():
    def g(x):
        return jnp.where(x[0] < 2.95, jnp.nan, 3.0 - x[0])

    sim = limit_state(g, 3)
    drawn = lines.draw_lines(np.random.default_rng(0), sim, half_spaces(3.0), 200, np.float64)
    assert np.isfinite(drawn.values).all()
    # the first run of each line, short of 3, and last runs before the root
    assert 200 < drawn.invalid < drawn.runs and drawn.if_invalid_fail.sum() > 0


def test_invalid_episodes_that_would_add_much_if_they_failed_are_said(drawn):
    values = np.linspace(0.9, 1.1, 100)
    few = add_lines(drawn, Lines(math.log(1e-4), values, 0.9, 3, 0.5))
    assert few.reliable and few.invalid == 3
    many = add_lines(drawn, Lines(math.log(1e-4), values, 0.9, 3, 50.0))
    assert not many.reliable and "3 episodes are invalid" in many.warnings[0]
    assert "0.5 times" in many.warnings[0]


def test_an_interruption_among_lines_keeps_what_they_cost(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(by_proposal, "_draw_proposal", interrupt)
    found = jast.estimate.failure_probability(jax.random.key(0), plane(100), 1200)
    assert f"interrupted after {found.episodes} of 1200" in found.warnings[0]
    costs = re.findall(r"(\d+) evaluations$", "\n".join(found.history), re.MULTILINE)
    assert found.history[-1].endswith(f" more, {costs[-1]} evaluations")
    assert found.episodes >= sum(map(int, costs))


@pytest.fixture
def drawn():
    """An `Estimate` of draws."""
    about = dict(ess=100.0, failing=200, samples=400, episodes=600, invalid=0)
    return estimate_from_mean(
        "draws", math.log(1e-4), 0.1, 0.95, (8e-5, 1.2e-4), reliable=True, warnings=(), **about
    )


def test_lines_and_draws_are_weighed_as_they_were_said_to_be_exact(drawn):
    values = 1 + 0.1 * np.random.default_rng(0).standard_normal(100)
    values += 1 - values.mean()
    found = add_lines(drawn, Lines(math.log(1.1e-4), values, 0.8))
    assert found.mean == pytest.approx(0.8 * 1.1e-4 + 0.2 * 1e-4)
    of_lines = 1.1e-4 * math.hypot(values.std(ddof=1) / 10, 1 / 100)
    error = math.hypot(0.8 * of_lines, 0.2 * 1e-5)
    assert found.standard_error == pytest.approx(error)
    assert found.interval[0] < found.mean < found.interval[1] and found.reliable


@pytest.mark.parametrize(
    "scale, values, word",
    [
        (2e-4, np.linspace(0.9, 1.1, 100), "draws"),
        (1e-4, np.r_[np.full(99, 0.8), 20.8], "one line carries"),
        (1e-4, np.full(20, -1.0), "both"),
    ],
)
def test_what_lines_and_draws_contradict_is_not_believed(drawn, scale, values, word):
    found = add_lines(drawn, Lines(math.log(scale), values, 0.9))
    assert not found.reliable and word in found.warnings[0]


@pytest.mark.slow
def test_planes_and_diffusions_to_a_few_per_cent():
    # rms of 200 keys 0.0, 0.3, 2.3 % (`benchmarks.few_calls`): 4 of these
    for sim, truth, error in [
        (plane(100), 2.3262908e-4, 1e-3),
        (planes(3.5, 3.6, 3.7), 4.9945816e-4, 0.02),
        (diffusion(4.0, 50), 2.346e-8, 0.1),
    ]:
        found = jast.estimate.failure_probability(jax.random.key(0), sim, 1200)
        assert found.reliable and found.mean == pytest.approx(truth, rel=error)
        assert any(line.startswith("lines: ") for line in found.history)
        assert found.episodes <= 1200 and found.draws is not None


@pytest.mark.slow
def test_lines_of_a_black_box_stay_within_its_budget():
    SlowLane.runs = 0
    found = jast.estimate.failure_probability(jax.random.key(0), slow_lane(), 1000)
    assert any(line.startswith("lines: ") and " more" in line for line in found.history)
    assert SlowLane.runs <= 1000 and found.episodes <= 1000


def test_lines_that_can_afford_no_more_are_the_first_ones(drawn, monkeypatch):
    monkeypatch.setattr(final_lines, "draw_lines", lambda *_: first)
    ones = np.ones(final_lines.FIRST_LINES)
    first = lines.LineValues(ones, 0 * ones, 0, 7 * len(ones))
    f = GaussianFamily(limit_state(lambda x: 3.5 - x[0], 3), 150, search_context(jax.random.key(0)))
    state, found = draw_half_by_lines(f, SearchState(planes=half_spaces(3.5), efficiency=0.4))
    assert len(found.values) == len(ones) and state.spent == 7 * len(ones)


def test_intervals_of_modes_move_with_the_mean(drawn):
    two = drawn._replace(modes=np.array([0.6, 0.4]), mode_intervals=np.array([[5e-5, 7e-5]] * 2))
    found = add_lines(two, Lines(math.log(1.2e-4), np.linspace(0.9, 1.1, 100), 1.0))
    np.testing.assert_allclose(found.mode_intervals, 1.2 * two.mode_intervals)
