"""Few runs of many numbers: the half-spaces of each moment of an episode against closed forms and
NumPy, and the answers that they lead to.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal, norm, truncnorm

import jast
from benchmarks.few_calls import SlowLane, any_far, energy, of_40, plane, planes, slow_lane
from benchmarks.first_minute import lane
from jast._src.estimate.gaussians import half_spaces
from jast._src.estimate.gaussians.family import GaussianFamily
from jast._src.estimate.gaussians.mixture_fit import (
    as_latent,
    latent_along,
    mix,
    unit_gaussians,
)
from jast._src.estimate.gaussians.moments import explore_moments
from jast._src.estimate.host_populations import draw_wide, wide_enough
from jast._src.estimate.proposal_search import by_proposal
from jast._src.estimate.proposal_search.audit import FORGOTTEN, audit_proposal
from jast._src.estimate.proposal_search.mixture_draws import random_numbers
from jast._src.estimate.proposal_search.search_state import SearchState, search_context
from jast._src.estimate.proposal_search.settings import FEW_RUNS
from jast._src.normal_space import transform
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.moments import distances, slopes
from jast.blackbox import from_python
from jast.distributions import MultivariateNormalDiag, Normal
from jast.estimate import failure_probability
from jast.simulators import limit_state

BOUND, STEPS = 1.4, 30


def offsets(z):
    """The lane of the README in NumPy: offsets [n, steps] for gusts ``z`` [n, steps]."""
    offset = speed = np.zeros(len(z))
    out = []
    for gust in z.T:
        speed = 0.8 * speed - 0.3 * offset + 0.1 * gust
        offset = offset + speed
        out.append(offset)
    return np.stack(out, axis=1)


def probability_of_lane(draws=200_000):
    """(P, standard error) that the lane fails, by the importance sampling of Owen, Maximov and
    Chertkov (2019): its offsets are linear in the gusts.
    """
    rng = np.random.default_rng(0)
    response = offsets(np.eye(STEPS)).T  # [moment, gust]
    size = np.linalg.norm(response, axis=1)
    normals = np.concatenate([response, -response]) / np.tile(size, 2)[:, None]
    depth = BOUND / np.tile(size, 2)
    mass = norm.sf(depth)
    chosen = rng.choice(len(mass), draws, p=mass / mass.sum())
    z = rng.standard_normal((draws, STEPS))
    beyond = norm.isf(rng.random(draws) * mass[chosen])
    along = (z * normals[chosen]).sum(axis=1)
    z += (beyond - along)[:, None] * normals[chosen]
    count = (z @ normals.T >= depth - 1e-9).sum(axis=1)
    weight = mass.sum() / count
    return weight.mean(), weight.std() / draws**0.5


def test_distances_at_each_moment_are_those_of_numpy(dtype):
    z = np.random.default_rng(1).standard_normal((40, STEPS)).astype(dtype)
    z[:5] *= 5  # these fail
    o, g = distances(lane(), z)
    y = np.abs(offsets(z.astype(float)))
    assert g.shape == (40, STEPS + 1) and g[0, 0] == pytest.approx(BOUND)
    out = np.maximum.accumulate(y, axis=1) >= BOUND
    assert out[:5, -1].all() and (np.asarray(o.failure) == out[:, -1]).all()
    assert (np.isnan(g[:, 1:]) == out).all()
    np.testing.assert_allclose(g[:, 1:][~out], (BOUND - y)[~out], atol=1e-5)


def test_slopes_are_the_responses_to_each_gust(dtype):
    point = np.random.default_rng(2).standard_normal(STEPS).astype(dtype)
    y = offsets(point[None].astype(float))[0]
    assert np.abs(y).max() < BOUND
    here = slopes(lane(), point, gradients=True)
    sure = np.abs(y) > 0.1  # the others may change sides within a step
    expected = -np.sign(y)[:, None] * offsets(np.eye(STEPS)).T
    tolerance = 100 * float(jnp.finfo(dtype).eps)  # of a difference of distances over a tenth
    np.testing.assert_allclose(here.slope[1:][sure], expected[sure], atol=tolerance)
    assert sure.sum() > STEPS / 2


@pytest.mark.slow
def test_a_gradient_is_that_of_the_differences(dtype):
    point = np.full(100, 0.1).astype(dtype)
    by_gradient = slopes(plane(100), point, gradients=True)
    by_differences = slopes(plane(100), point, gradients=False)
    for here in (by_gradient, by_differences):
        np.testing.assert_allclose(here.slope, np.full((1, 100), -0.1), atol=1e-4)
        assert here.distance == pytest.approx(3.5 - 1.0, abs=1e-4)


@pytest.mark.slow
def test_the_lane_is_answered_with_two_thousand_runs(dtype):
    truth, error = probability_of_lane()
    assert truth == pytest.approx(5.0355e-5, rel=0.01) and error < 0.005 * truth
    p = failure_probability(jax.random.key(3), lane(), 2000)
    assert p.reliable and p.evaluations == 2000
    assert abs(p.mean - truth) < 4 * p.standard_error < 0.4 * truth


@pytest.mark.slow
def test_a_black_box_runs_as_often_as_it_says():
    SlowLane.runs = 0
    p = failure_probability(jax.random.key(0), slow_lane(), 1500)
    assert 1490 < SlowLane.runs <= p.evaluations == 1500  # what is known is not run again
    assert p.reliable and abs(p.mean / 5.0355e-5 - 1) < 4 * p.relative_error < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    "budget, gradients, error", [(1200, True, 0.06), (1200, False, 0.06), (300, True, 0.15)]
)
def test_a_plane_of_a_hundred_numbers(budget, gradients, error):
    p = failure_probability(jax.random.key(1), plane(100), budget, gradients=gradients)
    assert p.reliable and p.evaluations == budget
    assert abs(p.mean / norm.sf(3.5) - 1) < 4 * p.relative_error < 4 * error


def test_wide_noise_has_a_tenth_of_failures_beyond_a_plane():
    """Within 4 standard errors of a binomial share of 2000 draws."""
    rng = np.random.default_rng(0)
    width = wide_enough(norm.logsf(3.5))
    failures = draw_wide(rng, planes(3.5), 2000, width)
    assert width == pytest.approx(3.5 / norm.isf(0.1)) and (failures.used == 60).all()
    assert abs(len(failures.z) / 2000 - 0.1) < 4 * np.sqrt(0.1 * 0.9 / 2000)


def test_the_audit_by_wide_noise_tells_of_another_plane():
    f = GaussianFamily(planes(3.5), 400, search_context(jax.random.key(0)), FEW_RUNS, "moments")
    state = explore_moments(f, None, True)
    assert not audit_proposal(f, state).reasons
    other = f._replace(sim=planes(3.5, 3.6))
    found = audit_proposal(other, state)
    assert found.reasons == (FORGOTTEN,) and found.spent - state.spent < 0.5 * f.budget


@pytest.mark.slow
def test_planes_behind_another_are_found_or_missed_aloud():
    """What is believed lies within a factor of 1.5, or 4 of its standard errors."""
    depths = 3.5, 3.6, 3.7
    truth = 1 - np.prod(norm.cdf(depths))
    answers = [failure_probability(jax.random.key(k), planes(*depths), 600) for k in range(6)]
    believed = [p for p in answers if p.reliable]
    assert len(believed) >= 2
    for p in believed:
        assert abs(p.log_mean - np.log(truth)) < max(4 * p.relative_error, np.log(1.5)), str(p)


def _one_of_two(z):
    """Fails beyond either of two planes that stand square on one another."""
    return jnp.minimum(3.6 - z[0], 3.8 - jnp.sum(z[1:17]) / 4)


def _either_side(z):
    return 3.7 - jnp.abs(jnp.sum(z[:25]) / 5 + 0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "g, truth",
    [
        (_one_of_two, 1 - norm.cdf(3.6) * norm.cdf(3.8)),
        (_either_side, norm.sf(3.5) + norm.sf(3.9)),
    ],
)
def test_two_half_spaces_are_both_found_or_missed_aloud(g, truth):
    p = failure_probability(jax.random.key(0), limit_state(g, 40), 3000)
    assert not p.reliable or abs(p.mean / truth - 1) < max(4 * p.relative_error, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "g, numbers, truth",
    [
        (energy, 40, chi2.sf(88.0, 40)),
        (any_far, 300, -np.expm1(300 * np.log1p(-2 * norm.sf(5.0)))),
    ],
)
def test_where_half_spaces_do_not_serve_populations_tell_about(g, numbers, truth):
    """Never believed. Each key within a factor of 20, the mean of logarithms within 3: a level of
    30 points is wrong by .3 in the logarithm (a binomial share of .25), eight of them by .9, more
    where points are alike; three populations by half of it.
    """
    sim = limit_state(g, numbers)
    found = [failure_probability(jax.random.key(k), sim, 3000) for k in range(4)]
    apart = np.array([p.log_mean for p in found]) - np.log(truth)
    assert not any(p.reliable for p in found) and max(p.evaluations for p in found) <= 3000
    assert np.abs(apart).max() < np.log(20) and abs(apart.mean()) < np.log(3)
    assert all("subset simulation" in " ".join(p.warnings) for p in found)
    assert all(p.plain[2] >= 60 and p.guaranteed[1] > truth for p in found)
    for p in found:  # their failures are kept
        assert evaluate_points(sim, p.proposal.points).failure.all() and len(p.proposal.points)


@pytest.mark.slow
@pytest.mark.parametrize("bound, budget", [(52.0, 600), (52.0, 2000), (60.0, 2000)])
def test_common_failures_are_left_to_plain_draws(bound, budget):
    """Failures of a tenth and of a fiftieth, which no half-space tells: once a population or the
    first draws say so, what is left of the budget, half of it at least, is drawn plainly.
    """
    truth = chi2.sf(bound, 40)
    sim = of_40(energy, bound)
    found = [failure_probability(jax.random.key(k), sim, budget) for k in range(4)]
    plain = [p for p in found if p.samples == p.plain[2] >= budget / 2]
    assert len(plain) >= 3 and all(p.reliable for p in plain)
    assert all(abs(p.mean / truth - 1) < 4 * p.relative_error < 1.3 for p in plain)
    assert all(p.evaluations <= budget for p in found)


@pytest.mark.slow
def test_populations_are_made_once_and_their_draws_counted_once():
    """Where no failure was seen, half of what is left is for them, whatever they see."""
    sim = of_40(energy, 63.7)
    f = GaussianFamily(sim, 2000, search_context(jax.random.key(0)), FEW_RUNS, "moments")
    request = by_proposal.Request("few", jax.random.key(0), sim, 2000)
    search = by_proposal.Search(f, SearchState(spent=100, plain=(0, 0, 30)))
    p = by_proposal._draw_few(request, search, [])
    populations = [h for h in p.history if h.startswith("population")]
    assert len(populations) == 3 and p.evaluations == 2000
    sizes = re.search(r"populations of (\d+), (\d+), (\d+)", " ".join(p.warnings)).groups()
    of_populations = sum(int(re.search(r"(\d+) evaluations", h).group(1)) for h in populations)
    last = 2000 - 100 - of_populations
    assert p.plain[2] == 30 + sum(map(int, sizes)) + last


@pytest.mark.slow
def test_the_bar_of_a_black_box_moves_with_all_of_its_runs(capsys):
    def run(z):
        left = 52.0 - float(np.sum(z**2))
        return left <= 0, max(left, 0.0)

    sim = from_python(run, horizon=40, disturbance=Normal(0.0, 1.0))
    failure_probability(jax.random.key(0), sim, 400, progress=True)
    bars = capsys.readouterr().err.split("\r")
    shown = [int(m.group(1)) for b in bars if (m := re.search(r"(\d+)/400 .*failures=\d", b))]
    assert len(shown) > 2 and min(shown) < 100 and 300 < max(shown) <= 400


@pytest.mark.slow
@pytest.mark.parametrize("bound", [88.0, 300.0])
def test_populations_of_a_black_box_stay_within_its_budget(bound):
    """Also where none reaches a failure, and plain draws follow."""
    runs = []

    def counted(z):
        runs.append(0)
        left = bound - float(np.sum(z**2))
        return left <= 0, max(left, 0.0)

    noise = MultivariateNormalDiag(jnp.zeros(40), jnp.ones(40))
    p = failure_probability(
        jax.random.key(0), from_python(counted, horizon=1, disturbance=noise), 700
    )
    assert 650 < len(runs) <= p.evaluations == 700 and not p.reliable


@pytest.mark.slow
@pytest.mark.parametrize("numbers, budget", [(40, 1200), (40, 3000), (100, 5000), (300, 3000)])
def test_many_modes_of_which_few_are_found_are_told(numbers, budget):
    """Failure beyond +-5 in any number: a search finds ten of these modes, of which draws and lines
    tell the same. Three of eight keys believed an eighth of the truth.
    """
    truth = -np.expm1(numbers * np.log1p(-2 * norm.sf(5.0)))
    for k in range(4):
        p = failure_probability(jax.random.key(k), limit_state(any_far, numbers), budget)
        assert not p.reliable or abs(p.mean / truth - 1) < max(4 * p.relative_error, 0.1), str(p)


def test_another_mode_has_its_failures_followed_and_another_moment_has_not():
    for sim, others in ((limit_state(any_far, 40), True), (lane(), False)):
        f = GaussianFamily(sim, 3000, search_context(jax.random.key(0)), FEW_RUNS, "moments")
        assert (explore_moments(f, None, True).cooled is not None) == others


@pytest.mark.slow
def test_where_no_slope_leads_plain_draws_answer():
    p = failure_probability(jax.random.key(0), limit_state(lambda z: 3.0 + 0 * z[0], 30), 400)
    assert not p.reliable and np.isnan(p.mean) and p.evaluations == 400
    assert p.plain == (0, 0, p.samples) and "no failure in" in p.warnings[0]
    often = failure_probability(jax.random.key(0), limit_state(lambda z: -z[0], 30), 1000)
    assert often.reliable and abs(often.mean - 0.5) < 4 * often.standard_error


@pytest.mark.slow
def test_stress_tells_the_probability_of_the_lane_from_two_thousand_runs():
    report = jast.stress(jax.random.key(1), lane(), 2000)
    p = report.probability
    assert report.episodes <= 2000
    assert p.reliable and abs(p.mean / 5.0355e-5 - 1) < 4 * p.relative_error < 0.6


@pytest.mark.parametrize("at, nearer", [(3.0, True), (4.22, False)])
def test_layers_come_nearer_where_failures_lie_before_them(at, nearer):
    """Failures drawn a standard deviation before the plane, or beyond it. What is crowded there
    makes the narrow layer as narrow as the model beyond the plane, and not the wide one.
    """
    one = np.ones(1)
    planes = half_spaces.Planes(np.eye(3)[:1], 4 * one, np.zeros(1, int), one)
    first = half_spaces.first_layers(planes)
    z = np.random.default_rng(0).standard_normal((300, 3))
    z[:, 0] = at + 0.1 * z[:, 0]
    layers = half_spaces.fit_layers(z, np.zeros(300), planes, first)
    moved = (layers.mean - first.mean).min()
    assert (moved < -0.3) == nearer
    ratio = layers.variance / first.variance
    assert ratio[0] >= 1 / half_spaces.SPREAD - 1e-12 and ratio[1] >= 1
    assert nearer or ratio[0] < 0.6
    assert layers.share.sum() == pytest.approx(1)


def test_a_fit_to_the_model_beyond_a_plane_has_its_variance():
    """Exact draws of a normal number above 4, of variance .0532: the factor on it is given up."""
    one = np.ones(1)
    planes = half_spaces.Planes(np.eye(2)[:1], 4 * one, np.zeros(1, int), one)
    first = half_spaces.first_layers(planes)
    z = np.random.default_rng(0).standard_normal((2000, 2))
    z[:, 0] = truncnorm(4.0, np.inf).rvs(2000, random_state=1)
    layers = half_spaces.fit_layers(z, np.zeros(2000), planes, first)
    assert layers.variance[0] == pytest.approx(truncnorm(4.0, np.inf).var(), rel=0.1)


@pytest.fixture
def along(dtype):
    """A `Latent` of three Gaussians of four numbers, the last of which is the model, and what it is
    made of.
    """
    rng = np.random.default_rng(2)
    ways = np.linalg.qr(rng.standard_normal((4, 4)))[0][:3]
    means, variances = np.array([[3.0, 0, -1, 1], [0, 2, 0, -2], [0, 0, 0, 0]]), [0.2, 4.0, 1.0]
    covariances = [np.eye(4) + (v - 1) * np.outer(a, a) for a, v in zip(ways, variances)]
    q = latent_along(np.array([5.0, 3.0, 2.0]), means, ways, np.array(variances), dtype)
    return q, means, covariances


def test_densities_of_one_direction_are_those_of_scipy(along, dtype):
    """Over the used numbers alone, their marginal; and so are those of a mixture that has other
    Gaussians beside them, which are factored.
    """
    q, means, covariances = along
    z = 2 * np.random.default_rng(3).standard_normal((40, 4)).astype(dtype)
    used = np.arange(40) % 5
    expected = [
        [
            multivariate_normal.logpdf(x[:m], mean[:m], c[:m, :m]) - norm.logpdf(x[:m]).sum()
            if m
            else 0.0
            for mean, c in zip(means, covariances)
        ]
        for x, m in zip(z, used)
    ]
    close = 1e-4 if dtype == "float32" else 1e-9
    np.testing.assert_allclose(transform.log_ratios(q, z, used), expected, atol=close)
    unit = unit_gaussians(np.ones((1, 4)))
    assert as_latent([(1.0, unit)], dtype).factors is None
    other = as_latent([(1.0, unit._replace(values=2 * unit.values))], dtype)
    both = mix(q, other, 0.1)
    assert both.directions is None and both.means.dtype == dtype
    np.testing.assert_allclose(np.exp(both.log_weights), [0.45, 0.27, 0.18, 0.1], rtol=1e-5)
    np.testing.assert_allclose(transform.log_ratios(both, z, used)[:, :3], expected, atol=close)
    same = mix(q, q, 0.5)
    assert same.factors is None and len(same.means) == 6


def test_draws_of_one_direction_have_its_moments(along, dtype):
    """20,000 draws, within 4.5 standard errors of each."""
    q, means, covariances = along
    assert transform.is_model(q).tolist() == [False, False, True]
    np.testing.assert_allclose(np.exp(q.log_weights), [0.5, 0.3, 0.2], rtol=1e-6)
    u, e = random_numbers(jax.random.key(0), 20_000, 4, dtype)
    z, own = transform.place(q, u, e), transform.component(q, u)
    assert z.dtype == dtype and (z[own == 2] == e[own == 2]).all()
    for k in range(3):
        mine, n = z[own == k].astype(float), (own == k).sum()
        size = np.sqrt(np.diag(covariances[k]))
        assert (abs(mine.mean(axis=0) - means[k]) < 4.5 * size / n**0.5).all()
        apart = abs(np.cov(mine.T) - covariances[k])
        assert (apart < 4.5 * (2 / n) ** 0.5 * np.outer(size, size)).all()
