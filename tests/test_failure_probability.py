"""Proposals that are found: closed forms within their standard errors, lost modes, what the search
is made of, and failures as they would happen.
"""

import importlib
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from checks import check_estimate, compiled
from jax.scipy.special import ndtri
from jax.tree_util import Partial
from scipy.special import logsumexp
from systems import mark_long

import jast
from benchmarks import limit_states
from benchmarks.limit_states import walk_probability
from jast import distributions as D
from jast._src.estimate.estimate import MAX_RELATIVE_ERROR, flag_imprecise
from jast._src.estimate.failure_probability import MIN_BUDGET
from jast._src.estimate.gaussians import exploration
from jast._src.estimate.gaussians.design_points import design_points, distinct
from jast._src.estimate.gaussians.family import GaussianFamily, defensive_parts
from jast._src.estimate.gaussians.mixture_fit import (
    Gaussians,
    as_latent,
    fit_mixture,
    mix,
    shrink_eigenvalues,
    unit_gaussians,
)
from jast._src.estimate.host_populations import cool, equilibrate, explore
from jast._src.estimate.proposal_search import adapt, by_proposal
from jast._src.estimate.proposal_search.mixture_draws import log_ratio, random_numbers
from jast._src.estimate.proposal_search.search_state import SearchState, search_context
from jast._src.normal_space import transform as L
from jast.estimate import (
    adaptive_cross_entropy,
    failure_probability,
    failure_samples,
    subset_simulation,
    trace_proposal,
)
from jast.simulators import landing, limit_state

norm = scipy.stats.norm
BUDGET, FAR = 50_000, 60.0
SIZE = BUDGET // 100  # of a population, as the search has it, so that few programs are compiled
DIAGONAL = np.full(4, 0.5)


class Sum(NamedTuple):
    total: jax.Array
    steps: jax.Array
    lost: jax.Array


def _step(sight, s, x):
    return Sum(s.total + x, s.steps + 1, s.lost | (x > sight))


def _evaluate(beta, early, s):
    along = s.total / 2
    counts, gap = early | (s.steps == 4), jnp.minimum(beta[0] - along, beta[1] + along)
    return counts & (gap <= 0), jnp.where(
        s.lost, jnp.nan, jnp.where(counts, jnp.maximum(gap, 0), 100)
    )


def _start(x0):
    return Sum(jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.zeros((), bool))


def _normal(s):
    return D.Normal(jnp.zeros_like(s.total), jnp.ones_like(s.total))


def planes(up=FAR, down=FAR, sight=FAR, early=False):
    """Four normal steps, failure where half of their sum is beyond ``up`` or below -``down``: P =
    Phi(-up) + Phi(-down). NaN after a step above ``sight``; ``early``: a failure at any step
    counts. One program serves all.
    """
    beta, sight = (
        jnp.asarray([up, down], jnp.zeros(()).dtype),
        jnp.asarray(sight, jnp.zeros(()).dtype),
    )
    return jast.Simulator(
        _start, Partial(_step, sight), _normal, Partial(_evaluate, beta, jnp.asarray(early)), 4
    )


@pytest.fixture(scope="module")
def two():
    """(simulator, truth, estimate): two modes, the farther one with a tenth of the probability."""
    sim = planes(4.0, 4.5)
    return sim, norm.sf(4) + norm.sf(4.5), failure_probability(jax.random.key(5), sim, BUDGET)


@pytest.mark.long
def test_two_modes(two):
    sim, truth, found = two
    check_estimate(found, truth, budget=BUDGET)
    assert found.method == "failure_probability"
    assert len(found.modes) == 2
    assert found.modes.sum() == pytest.approx(1)
    assert abs(found.modes[1] - norm.sf(4.5) / truth) < 4 * 2 * np.sqrt(0.1 / found.ess)
    assert found.evaluations > 0.95 * BUDGET
    assert BUDGET // 10 <= found.samples < found.evaluations
    assert len(found.history) > 3


@pytest.mark.parametrize("gradients", [pytest.param(True, marks=pytest.mark.long), False])
def test_one_mode(key, gradients):
    """With gradients and as a black box: P = 2.9e-7."""
    found = failure_probability(key, planes(5.0), BUDGET, gradients=gradients)
    check_estimate(found, norm.sf(5), budget=BUDGET)


@pytest.mark.slow
def test_black_box_finds_both(key):
    found = failure_probability(key, planes(4.0, 4.0), BUDGET, gradients=False)
    check_estimate(found, 2 * norm.sf(4), budget=BUDGET)
    assert abs(found.modes[0] - 0.5) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("up", mark_long([-1.0, 0.0, 1.0], -1.0, 1.0))
def test_where_failures_are_common(key, up):
    """P = .84, .5 and .16: not worse than counting the same number of episodes."""
    found = failure_probability(key, planes(up), BUDGET)
    truth = norm.sf(up)
    check_estimate(found, truth, budget=BUDGET)
    assert found.relative_error < 1.1 * np.sqrt((1 - truth) / truth / found.samples)


@pytest.mark.slow
def test_the_draws_of_the_model_guarantee_an_interval(key):
    """P = 1.35e-3, beside a proposal: the first batch and a tenth or more of the last draws; a flag
    puts them before the estimate.
    """
    found = failure_probability(key, planes(3.0), BUDGET)
    (k, _, n), truth = found.plain, norm.sf(3)
    assert found.chernoff is None and BUDGET // 25 + found.samples // 10 < n < found.evaluations
    assert abs(k - n * truth) < 4 * np.sqrt(n * truth)
    assert found.guaranteed[0] < truth < found.guaranteed[1] and "plain draws" not in str(found)
    q = found.draws.source
    model, u = L.is_model(q), np.random.default_rng(0).random(100_000)
    share = np.exp(q.log_weights[model].astype(float)).sum()
    assert model.any() and abs(model[L.component(q, u)].mean() - share) < 0.01
    lines = str(flag_imprecise(found._replace(relative_error=2 * MAX_RELATIVE_ERROR))).splitlines()
    assert lines[2].startswith("probability    between ") and lines[3].startswith("doubtful ")


@pytest.mark.slow
def test_plain_draws_where_no_proposal_serves(key, monkeypatch):
    """Then subset simulation answers, flagged, and its guarantee is of the first batch and of the
    first draws of its populations.
    """
    monkeypatch.setattr(by_proposal.Search, "suffices", property(lambda s: False))
    found = failure_probability(key, planes(4.0), BUDGET)
    assert "subset simulation" in str(found.warnings)
    assert found.plain == (0, 0, BUDGET // 25 + found.samples)
    lines = str(found).splitlines()
    i = next(i for i, line in enumerate(lines) if line.startswith("probability    between 0 and"))
    assert lines[i + 1].startswith("doubtful ") and lines[0].startswith("UNRELIABLE: ")


@pytest.mark.slow
def test_walk_that_often_fails(key):
    """At any step, on either side, so that episodes use one to four numbers: P = .068, by
    quadrature.
    """
    found = failure_probability(key, planes(2.0, 2.0, early=True), BUDGET)
    check_estimate(found, walk_probability(4.0, 4, True), budget=BUDGET)
    assert found.steps < 4 * found.samples


def test_invalid_episodes(key):
    """NaN where a step is above 2.2: counted, no failures, and the rest as in NumPy by importance
    sampling of 400,000 (4 of both standard errors).
    """
    found = failure_probability(key, planes(3.5, sight=2.2), BUDGET)
    z = np.random.default_rng(0).normal(1.75, 1, size=(400_000, 4))
    w = np.where(
        (z.sum(axis=1) >= 7) & (z <= 2.2).all(axis=1),
        np.exp((1.75**2 / 2 - 1.75 * z).sum(axis=1)),
        0,
    )
    truth, error = w.mean(), w.std() / np.sqrt(len(w))
    assert abs(found.mean - truth) < 4 * np.hypot(error, found.standard_error)
    assert found.relative_error < 0.05
    assert not found.reliable and any("if they failed" in w for w in found.warnings)
    assert found.invalid > 0 and "invalid" in found.warnings[-1], str(found)
    _, invalid, n = found.plain
    assert 0 < invalid / n < found.guaranteed[1]  # all of them may have failed


@pytest.mark.slow
def test_below_the_least_double(key):
    """2 Phi(-60), a number of 783 digits behind the point: as a logarithm, within 4 standard errors
    of scipy's.
    """
    found = failure_probability(key, planes(60.0, 60.0), BUDGET)
    assert abs(found.log_mean - np.log(2) - norm.logsf(60)) < 4 * found.relative_error < 0.2
    assert found.mean == 0
    assert "doubtful       10^-783." in str(found)  # flagged: no budget is left for a guard


def test_no_failure(key):
    """Every episode is invalid: neither a number nor trust; the upper bounds are those of what was
    drawn of the model.
    """
    sim = planes(sight=-FAR)
    found = failure_probability(key, sim, BUDGET)
    assert np.isnan(found.mean)
    assert not found.reliable
    assert found.failing == 0
    assert found.proposal is None
    assert found.evaluations <= BUDGET
    assert found.interval[0] == 0 < found.interval[1] < 1e-3
    assert str(found).startswith("UNRELIABLE: no failure in")
    assert "if no invalid episode fails" in str(found)
    assert found.invalid >= found.samples
    with pytest.raises(ValueError, match="failure_samples: source must hold a proposal, received"):
        failure_samples(key, sim, found)
    assert len(design_points(key, sim).points) == 0


@pytest.mark.long
def test_the_least_budget_is_kept(key):
    """Gradients included; and it is enough for one near plane."""
    found = failure_probability(key, planes(3.0), MIN_BUDGET)
    assert found.evaluations <= MIN_BUDGET, found.history
    assert abs(found.log_mean - norm.logsf(3)) < 4 * found.relative_error, found.history


@pytest.mark.slow
def test_interrupts_keep_whole_chunks(two):
    seen = []

    def stop(done, total, _):
        seen.append((done, total))
        raise KeyboardInterrupt

    sim, truth, whole = two
    found = failure_probability(jax.random.key(5), sim, BUDGET, callback=stop)
    done, total = seen[0]
    assert len(seen) == 1
    assert found.samples == done < total == whole.samples
    assert found.history == whole.history
    assert whole.evaluations - found.evaluations == total - done
    assert found.warnings == (f"interrupted after {done} of {total} episodes",)
    assert abs(found.log_mean - np.log(truth)) < 4 * found.relative_error


@pytest.mark.parametrize("raised", [KeyboardInterrupt, jax.errors.JaxRuntimeError])
def test_interrupted_in_its_search_it_gives_what_it_has(raised, monkeypatch):
    fit, fits = adapt.refit, []

    def interrupted(family, state):
        fits.append(state.spent + family.batch)
        if len(fits) == 2:
            raise raised("INTERNAL: CpuCallback error: KeyboardInterrupt: ")
        return fit(family, state)

    monkeypatch.setattr(adapt, "refit", interrupted)
    found = failure_probability(jax.random.key(5), planes(4.0, 4.5), BUDGET)
    [why] = [w for w in found.warnings if "interrupted" in w]
    assert why.startswith(f"interrupted after {fits[1]} of {BUDGET} evaluations")
    assert not found.reliable and found.evaluations == fits[1] < BUDGET / 2
    assert found.samples == 3 * (BUDGET // 25) >= found.failing > 100  # one of the model
    truth = norm.sf(4) + norm.sf(4.5)
    assert abs(found.log_mean - np.log(truth)) < 4 * found.relative_error < 1


def test_points_that_are_all_anchors_leave_other_directions_to_the_model():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((31, 180)) + 0.4
    g = fit_mixture(rng, points, np.full(31, 1 / 31), 15.5, anchors=points)
    assert g.values.max() >= 1 and (g.values > 1e-5).all()
    assert np.isfinite(as_latent([(1.0, g)], np.float32).factors).all()


def test_interrupted_before_any_batch_there_is_nothing(monkeypatch):
    for error in (KeyboardInterrupt(), jax.errors.JaxRuntimeError("... KeyboardInterrupt: ...")):

        def stop(*_, error=error):
            raise error

        monkeypatch.setattr(by_proposal, "draw_model", stop)
        with pytest.raises(KeyboardInterrupt):
            failure_probability(jax.random.key(5), planes(4.0), BUDGET)
    monkeypatch.setattr(by_proposal, "draw_model", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        failure_probability(jax.random.key(5), planes(4.0), BUDGET)


def test_subset_simulation(key):
    """The estimate is within 4 of the standard errors that its ten replicates have, of at most 30
    %; each population is counted.
    """
    found = subset_simulation(key, planes(4.0), SIZE)
    assert abs(found.mean - norm.sf(4)) < 4 * found.standard_error
    assert found.relative_error < 0.3
    assert found.reliable
    assert "k-hat" not in str(found) and "ESS" in str(found)  # its weights have no tail to fit
    assert found.samples == found.failing == 5000
    assert found.evaluations == sum(int(h.split()[-2]) for h in found.history)
    assert found.interval[0] < found.mean < found.interval[1]
    with pytest.raises(ValueError, match="subset_simulation: replicates must .*received 2"):
        subset_simulation(key, planes(4.0), SIZE, replicates=2)


@pytest.mark.slow
def test_adaptive_cross_entropy(key):
    found = adaptive_cross_entropy(key, planes(3.5), BUDGET)
    check_estimate(found, norm.sf(3.5), budget=BUDGET)
    assert found.method == "adaptive_cross_entropy"
    assert found.evaluations == BUDGET
    assert found.samples == BUDGET * 4 // 5


@pytest.mark.slow
def test_an_interrupted_cross_entropy_counts_what_it_ran(key, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    importance = partial(jast.estimate.importance, callback=stop)
    module = importlib.import_module(adaptive_cross_entropy.__module__)
    monkeypatch.setattr(module, "importance", importance)
    found = adaptive_cross_entropy(key, planes(3.5), BUDGET)
    assert found.warnings[0].startswith("interrupted after")
    assert found.episodes == found.samples + BUDGET // 5 < BUDGET


def _gamma(s):
    return D.VonMises(jnp.asarray(2.0), jnp.asarray(1.0))


@pytest.mark.parametrize("method", [failure_probability, subset_simulation])
def test_no_quantile_function(key, method):
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        _gamma,
        lambda s: (s > 9, jnp.maximum(9 - s, 0)),
        2,
    )
    with pytest.raises(
        ValueError, match=f"{method.__name__}: disturbance: VonMises has no quantile"
    ):
        method(key, sim)
    start = jast.Simulator(
        lambda x0: x0,
        lambda s, x: s + x,
        lambda s: D.Normal(s, 1.0),
        lambda s: (s > 9, jnp.maximum(9 - s, 0)),
        2,
        start=lambda: _gamma(0),
    )
    with pytest.raises(
        ValueError, match=f"{method.__name__}: start: VonMises has no quantile function"
    ):
        method(key, start)


@pytest.mark.parametrize(
    "make, match",
    [
        (
            lambda key: failure_probability(key, planes(), 39),
            "failure_probability: budget must .*received 39",
        ),
        (
            lambda key: failure_probability(key, planes(), level=1.0),
            "failure_probability: level must .*received 1.0",
        ),
        (
            lambda key: failure_probability(key, planes(), failures=[jax.random.key(0)]),
            "failure_probability: failures must be an archive of jast.failures, .* received list",
        ),
        (
            lambda key: adaptive_cross_entropy(key, planes(), 10),
            "adaptive_cross_entropy: budget must .*received 10",
        ),
        (
            lambda key: subset_simulation(key, planes(), 99),
            "subset_simulation: samples must .*received 99",
        ),
        (
            lambda key: subset_simulation(key, planes(), level=0),
            "subset_simulation: level must .*received 0",
        ),
        (
            lambda key: failure_samples(key, planes(), "x"),
            "failure_samples: proposal must .*received str",
        ),
        (
            lambda key: failure_samples(key, planes(), None),
            "failure_samples: (source|proposal) must",
        ),
        (
            lambda key: failure_samples(key, planes(), "x", 0),
            "failure_samples: samples must .*received 0",
        ),
        (lambda key: failure_probability(key, "x"), "sim must be a jast.Simulator, received str"),
    ],
)
def test_bad_arguments(key, make, match):
    with pytest.raises(ValueError, match=match):
        make(key)


# What the search is made of


def test_design_points(key):
    """The points of the two planes, by rising norm, within 2 % and next to the boundary; all are
    failures.
    """
    found = design_points(key, planes(4.0, 4.5))
    np.testing.assert_allclose(found.points, [4 * DIAGONAL, -4.5 * DIAGONAL], atol=0.05)
    assert L.outcomes(
        planes(4.0, 4.5), jnp.asarray(found.points, jnp.zeros(()).dtype)
    ).failure.all()
    assert found.evaluations > 0


def test_distinct_points():
    """By rising norm, none nearer to a kept one than half of its norm."""
    points = np.array([[0.0, 5.0], [3.0, 0.1], [3.0, 0.0], [-3.5, 0.0], [3.0, 1.4], [3.0, 1.6]])
    np.testing.assert_array_equal(
        distinct(points, 9), [[3.0, 0.0], [3.0, 1.6], [-3.5, 0.0], [0.0, 5.0]]
    )
    assert distinct(points, 2).shape == (2, 2) and distinct(np.zeros((0, 3)), 4).shape == (0, 3)


def test_populations_estimate(key):
    """P = 3.17e-5 by 12 populations of 500: a population's relative error is about sqrt(levels (1 -
    p) / (p n) (1 + gamma)) = .42 with p = .25, 7.5 levels and gamma = 3 (Au and Beck 2001); the
    mean is within 4 of the standard errors from that, and the deviation is not above twice it.
    """
    found = [explore(k, planes(4.0), SIZE) for k in jax.random.split(key, 12)]
    p = np.exp([f.log_mean for f in found])
    expected = np.sqrt(-np.log(norm.sf(4)) / np.log(4) * 3 / SIZE * 4)
    assert abs(p.mean() / norm.sf(4) - 1) < 4 * expected / np.sqrt(12)
    assert p.std() / norm.sf(4) < 2 * expected
    for f in found:
        assert f.points.shape == (SIZE, 4)
        assert (f.points.sum(axis=1) / 2 > 4).all()
        assert (np.diff(f.levels) < 0).all()
        assert f.evaluations == SIZE * (len(f.levels) + 6)


def test_populations_kept_out(key):
    """What a proposal covers is left out: only the other side is found, and the estimate is of it
    alone.
    """
    q = as_latent([(1.0, unit_gaussians(4 * DIAGONAL[None]))], jnp.zeros(()).dtype)
    covered = q, jnp.asarray(0.0, jnp.zeros(()).dtype)
    found = [
        explore(k, planes(4.0, 4.5), SIZE // 2, covered=covered) for k in jax.random.split(key, 6)
    ]
    assert all((f.points.sum(axis=1) / 2 < -4.5).all() and f.reached for f in found)
    assert abs(
        np.mean(np.exp([f.log_mean for f in found])) / norm.sf(4.5) - 1
    ) < 4 * 1.03 / np.sqrt(6)
    assert not explore(
        key, planes(4.0), SIZE // 2, covered=covered, min_log_probability=-15.0
    ).reached


def test_populations_give_up(key):
    """At the evaluations or the probability they are given."""
    found = explore(key, planes(12.0), SIZE, max_evaluations=3000)
    assert not found.reached
    assert found.log_mean == -np.inf
    assert found.evaluations <= 3000
    assert found.points.shape == (0, 4)
    assert len(explore(key, planes(12.0), SIZE, min_log_probability=-5.0).levels) <= 5


def test_populations_that_only_estimate_leave_out_the_last_moves(key):
    long, short = explore(key, planes(4.0), SIZE), explore(key, planes(4.0), SIZE, final_moves=0)
    assert short.log_mean == long.log_mean and short.reached
    assert long.evaluations - short.evaluations == 5 * SIZE


def test_populations_wait_where_no_level_falls(key):
    """A distance of whole numbers: of 12 points hardly one moves at each level."""

    def g(z):
        return jnp.ceil(4 * (4.0 - jnp.sum(z) / 6)) / 4

    keys = jax.random.split(key, 10)
    hasty, patient = (
        [explore(k, limit_state(g, 36), 12, patience=n).reached for k in keys] for n in (0, 5)
    )
    assert sum(hasty) < 5 < sum(patient)
    stuck = explore(key, limit_state(lambda z: 1.0 + 0 * z[0], 4), SIZE, patience=5)
    assert not stuck.reached and stuck.evaluations == SIZE * (1 + 1 + 5)


def test_first_draws_of_a_population_are_plain_draws(key):
    found = explore(key, limit_state(lambda z: jnp.where(z[1] > 2, jnp.nan, -z[0]), 2), SIZE)
    # 4 standard errors of binomial counts
    for count, p in zip(found.plain[:2], (0.5 * norm.cdf(2), norm.sf(2)), strict=True):
        assert abs(count - p * SIZE) < 4 * np.sqrt(p * (1 - p) * SIZE)
    assert found.plain[2] == SIZE


def test_an_efficiency_of_few_effective_draws_is_not_believed():
    f = GaussianFamily(planes(4.0), BUDGET, search_context(jax.random.key(0)))
    for log_weight, known in ((np.zeros(20), True), (np.r_[0.0, np.full(19, -9.0)], False)):
        state = SearchState(q=0, efficiency=0.5, log_mean=-9.0, log_weight=log_weight)
        assert by_proposal.Search(f, state).suffices == known


def test_cooling_keeps_every_mode(key):
    """The farther of two modes, 1.2e-4 of the probability, has its share of the chains, most near
    the least norm of their plane.
    """
    points = cool(key, planes(4.0, 5.5), 128).points
    along, norms = points.sum(axis=1) / 2, np.linalg.norm(points, axis=1)
    assert (along > 4).sum() > 10
    assert (along < -5.5).sum() > 10
    assert np.median(np.where(along > 0, norms / 4, norms / 5.5)) < 1.2
    assert not cool(key, planes(), 128).reached


def test_failures_of_great_norm_move_until_they_have_settled(key):
    """Of 100 numbers beyond a plane at 3 the squares have the mean 110; of 24 failures theirs has a
    standard error of 2.9, and the chains stop where a block of moves takes less than a twentieth.
    """
    sim = limit_state(lambda x: 3.0 - x[0], 100)
    noise = jax.random.normal(key, (24, 100))
    points = (3.0 * noise).at[:, 0].set(4.0 + 3.0 * jnp.abs(noise[:, 0]))
    left, found = [], []
    for most in (0, 600, 20_000):
        moved, sampler = equilibrate(key, sim, points, 10, max_evaluations=most)
        assert (moved.z[:, 0] >= 3).all() and sampler.evaluations <= max(most, 11 * 24)
        left.append((moved.z**2).sum(axis=1).mean())
        found.append(sampler.evaluations)
    assert left[0] > left[1] > left[2] and 110 - 12 < left[2] < 110 + 12 + 0.05 * 110
    assert found[2] < 10_000  # it stops by itself
    again = equilibrate(key, sim, moved.z, 10, max_evaluations=20_000)[1]
    assert again.evaluations == 11 * 24  # what has settled moves once


def test_a_rough_estimate_says_so(key):
    """Where nothing else does, the standard error speaks against it; the numbers stay."""
    counted = jast.estimate.monte_carlo(key, planes(1.0), 2000)
    assert counted.reliable and counted.relative_error > MAX_RELATIVE_ERROR
    rough = flag_imprecise(counted)
    assert not rough.reliable and rough.mean == counted.mean
    assert rough.warnings[0].startswith(f"relative standard error {counted.relative_error:.2g}")
    fine = counted._replace(relative_error=MAX_RELATIVE_ERROR)
    assert flag_imprecise(fine) is fine
    flagged = counted._replace(reliable=False, warnings=("another reason",))
    assert flag_imprecise(flagged) is flagged


def test_log_ratios(key):
    """Against scipy's multivariate normal, over the used numbers only: their marginal."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(2, 4, 4)))[0]
    g = Gaussians(
        np.array([0.7, 0.3]),
        rng.normal(size=(2, 4)),
        np.array([[0.5, 1, 2, 0.1], [1, 1, 3, 0.7]]),
        basis,
    )
    q = as_latent([(1.0, g)], jnp.zeros(()).dtype)
    z, used = rng.normal(size=(40, 4)) * 2, np.arange(40) % 5
    covariances = np.einsum("kij,kj,klj->kil", basis, g.values, basis)
    mvn = scipy.stats.multivariate_normal
    expected = np.array(
        [
            [
                mvn.logpdf(x[:m], mean[:m], c[:m, :m]) - norm.logpdf(x[:m]).sum() if m else 0.0
                for mean, c in zip(g.means, covariances, strict=True)
            ]
            for x, m in zip(z, used, strict=True)
        ]
    )
    z, used = jnp.asarray(z, q.means.dtype), jnp.asarray(used, jnp.int32)
    np.testing.assert_allclose(
        L.log_ratios(q, np.asarray(z), np.asarray(used))[:, :2], expected, rtol=1e-3, atol=1e-3
    )
    np.testing.assert_allclose(np.exp(q.log_weights[:2]), [0.7, 0.3], rtol=1e-5)


def test_draws_of_a_mixture(key):
    """Moments of 20,000 draws, within 4.5 standard errors of each; unused components never drawn;
    shares of a mixture of two.
    """
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(1, 4, 4)))[0]
    g = Gaussians(np.ones(1), np.array([[3.0, 0, 0, -1]]), np.array([[0.2, 1, 2, 0.5]]), basis)
    dtype, n = jnp.zeros(()).dtype, 20_000
    q = mix(
        as_latent([(1.0, unit_gaussians(np.full((1, 4), -20.0)))], dtype),
        as_latent([(1.0, g)], dtype),
        0.25,
    )
    z = np.asarray(L.place(q, *random_numbers(key, n, 4, dtype)), float)
    near = z.sum(axis=1) < -40
    assert abs(near.mean() - 0.75) < 4 * np.sqrt(0.1875 / n)
    assert logsumexp(q.log_weights) == pytest.approx(0, abs=1e-5)
    other, covariance = z[~near], basis[0] @ np.diag(g.values[0]) @ basis[0].T
    assert (
        abs(other.mean(axis=0) - g.means[0]) < 4.5 * np.sqrt(np.diag(covariance) / len(other))
    ).all()
    assert abs(np.cov(other.T) - covariance).max() < 4.5 * 2 * np.sqrt(2 / len(other))


def test_shrunk():
    """Noise about I, by the spectrum of 80 points in 20 dimensions, is flat; a spike of 12 stays;
    of many points each eigenvalue is its own.
    """
    rng = np.random.default_rng(0)
    values = np.linalg.eigvalsh(np.cov(rng.normal(size=(20, 80)), bias=True))
    found = shrink_eigenvalues(values, 80)
    assert values.max() / values.min() > 5
    assert np.ptp(found) == 0
    assert found[0] == pytest.approx(values.mean())
    x = rng.normal(size=(20, 80)) * np.array([12.0**0.5] + [1.0] * 19)[:, None]
    values = np.linalg.eigvalsh(np.cov(x, bias=True))
    found = shrink_eigenvalues(values, 80)
    assert found[-1] == values[-1] > 8
    assert np.ptp(found[:-1]) == 0
    assert 0.8 < found[0] < 1.1
    different = np.array([0.1, 0.5, 1.0, 3.0])
    np.testing.assert_allclose(shrink_eigenvalues(different, 1e6), different)
    assert shrink_eigenvalues(np.array([0.3]), 1).tolist() == [0.3]
    assert (shrink_eigenvalues(different, 0.5) == different.mean()).all()


@pytest.mark.parametrize("points", [60, 2000])
def test_noise_in_many_dimensions_is_not_fitted(points):
    """Beyond a plane in 100 dimensions, x_0 = 5 + an exponential of rate 5: what was fitted gives
    a fresh point at most .5 nats less than the true density does, and what the noise of a mean of
    100 numbers costs twice, 100 / n; fewer points than dimensions once left variances of 0.
    """
    rng = np.random.default_rng(0)

    def drawn(n):
        x = rng.normal(size=(n, 100))
        x[:, 0] = 5 + rng.exponential(0.2, n)
        return x

    x, fresh = drawn(points), drawn(1000)
    g = fit_mixture(rng, x, np.full(points, 1 / points), points, anchors=np.eye(100)[:1] * 5)
    truth = norm.logpdf(fresh[:, 1:]).sum(axis=1) + np.log(5) - 5 * (fresh[:, 0] - 5)
    ratio = log_ratio(as_latent([(1.0, g)], float), fresh, np.full(1000, 100))
    fitted = ratio + norm.logpdf(fresh).sum(axis=1)
    assert (truth - fitted).mean() < 0.5 + 100 / points
    np.testing.assert_allclose(np.median(g.values), 1.0, atol=4 * np.sqrt(2 / points / 100))


def test_fit_of_two_components():
    """Means, shares and variances of 3000 points with unequal weights, within .15, .05 and .15; one
    cloud stays one component.
    """
    rng = np.random.default_rng(0)
    far = rng.random(3000) < 0.7
    z = np.where(
        far[:, None],
        rng.normal([3, 0, 0], [0.5, 1, 1], (3000, 3)),
        rng.normal([-3, 1, 0], 1.0, (3000, 3)),
    )
    w = np.where(far, 0.3 / 0.7, 1.0) * rng.uniform(0.5, 1.5, 3000)  # so that both weigh the same
    g = fit_mixture(rng, z, w / w.sum(), w.sum() ** 2 / (w**2).sum(), limit=2)
    order = np.argsort(g.means[:, 0])
    assert len(order) == 2
    np.testing.assert_allclose(g.weights[order], [0.5, 0.5], atol=0.05)
    np.testing.assert_allclose(g.means[order], [[-3, 1, 0], [3, 0, 0]], atol=0.15)
    covariance = g.vectors[order[1]] @ np.diag(g.values[order[1]]) @ g.vectors[order[1]].T
    np.testing.assert_allclose(covariance, np.diag([0.25, 1, 1]), atol=0.15)
    assert (
        len(fit_mixture(rng, rng.normal(size=(2000, 3)), np.full(2000, 1 / 2000), 2000).weights)
        == 1
    )


# Failures as they would happen


LANDING = landing()


def to_landing(sign):
    return jast.replay(LANDING, jnp.full(10, sign * 0.04737), x0=jnp.asarray(sign * 0.5265))


@pytest.fixture(scope="module")
def proposal():
    return trace_proposal(LANDING, [to_landing(1.0), to_landing(-1.0)])


@pytest.mark.parametrize("moves", [0, pytest.param(20, marks=pytest.mark.long)])
def test_samples_of_landing(key, proposal, moves):
    """E|s0| = .536 and its deviation, .0689, in closed form (4 standard errors); both signs; every
    one of them replays to a failure.
    """
    found = failure_samples(key, LANDING, proposal, 500, moves=moves)
    e = found.failures
    n = len(e.length)
    assert 480 < n <= 500
    assert e.failure.all()
    assert e.states is None
    assert found.ess > 300
    assert found.distinct > 200
    # s0 given the end y, |y| > 1: mean 10/19 y; y beyond 1 by sigma / beta = .019, so that E|y| =
    # 1.0184
    truth, size = (
        10 / 19 * np.sqrt(0.019) * norm.pdf(1 / np.sqrt(0.019)) / norm.sf(1 / np.sqrt(0.019)),
        min(found.ess, n),
    )
    assert truth == pytest.approx(0.536, abs=5e-4)
    assert abs(abs(e.x0).mean() - truth) < 4 * 0.069 / np.sqrt(size)
    assert abs(e.x0.std() ** 2 + e.x0.mean() ** 2 - truth**2 - 0.069**2) < 0.02
    assert abs((e.x0 > 0).mean() - 0.5) < 4 * 0.5 / np.sqrt(size) and e.log_prob.shape == (n,)
    assert (abs(e.x0 + e.disturbances.sum(axis=1, dtype=float)) > 1 - 1e-6).all()
    assert all(jast.replay(LANDING, jax.tree.map(lambda a, i=i: a[i], e)).failure for i in range(3))
    if moves:
        assert 0.1 < found.accepted < 0.9 and len(np.unique(e.x0)) > found.distinct


@pytest.mark.slow
def test_samples_of_an_estimate(key, two):
    """Both modes by their shares; on the failing side of the planes; nearest ones likeliest."""
    sim, truth, estimate = two
    found = failure_samples(key, sim, estimate, 500)
    along = found.failures.disturbances.sum(axis=1) / 2
    assert ((along > 4) | (along < -4.5)).all()
    assert abs((along < 0).mean() - norm.sf(4.5) / truth) < 4 * np.sqrt(0.1 / min(found.ess, 500))
    # beyond the plane by 1 / beta, and N(0, I) along it
    assert abs(along[along > 0].mean() - norm.pdf(4) / norm.sf(4)) < 4 * 0.24 / np.sqrt(300)
    assert "500 failures from" in str(found)


@pytest.mark.long
def test_samples_without_a_failure(key, proposal):
    with pytest.raises(
        ValueError, match="failure_samples: source must .*no failure in 5000 episodes"
    ):
        failure_samples(key, landing(50.0), proposal, 500)


@pytest.mark.parametrize("rare", [True, False])
@pytest.mark.parametrize("values", [(1.5, 2.0), (0.5, 2.0)], ids=["wide", "narrow"])
def test_the_shares_of_a_defended_proposal_are_those_of_a_mixture(rare, values):
    """Its wide copies and, unless failures are rare, a share of the model, which sum to 1."""
    g = Gaussians(np.ones(1), np.zeros((1, 2)), np.array([values]), np.eye(2)[None])
    parts = defensive_parts(g, 0.0, rare)
    assert np.isclose(sum(share for share, _ in parts), 1.0)
    assert len(parts) == 1 + (min(values) < 1) + (not rare)


# --- the model's own draws, and what is left where no proposal serves
# ----------------------------------------------------------------------------


def _hidden(share, x):
    """Fails beyond 4.5 in one number, and in a band of the other, of which no distance knows."""
    lost = (x[1] > 0) & (x[1] < ndtri(0.5 + share))
    return (x[0] >= 4.5) | lost, jnp.where(lost, 0, jnp.maximum(4.5 - x[0], 1e-3))


def hidden(share):
    return jast.Simulator(
        init=lambda x0: jnp.zeros(2),
        step=lambda s, x: x,
        disturbance=lambda s: D.MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)),
        evaluate=Partial(_hidden, share),
        horizon=1,
    )


@pytest.mark.slow
def test_a_defect_that_no_distance_knows_of_is_not_silent(key):
    """P = 2e-3 beside 3.4e-6: a twentieth of the budget meets it five times."""
    found = failure_probability(key, hidden(2e-3), BUDGET)
    truth = 2e-3 + (1 - 2e-3) * norm.sf(4.5)
    assert not found.reliable or abs(found.log_mean - np.log(truth)) < 4 * found.relative_error


@pytest.mark.slow
def test_what_nothing_led_to_has_a_bound(key):
    """A batch of the search and at least a tenth of the last draws are the model's own."""
    found = failure_probability(key, planes(5.0), BUDGET)
    least = BUDGET // 25 + found.samples // 10
    assert -np.log(0.05) / BUDGET < found.unseen <= -np.log(0.05) / least
    assert "unseen" in str(found) and "unseen" not in str(found._replace(unseen=None))
    assert found.modes.sum() == pytest.approx(1)


@pytest.mark.slow
def test_a_proposal_that_lost_failures_is_given_up(key, monkeypatch):
    """Then plain draws answer where they see enough failures, and else subset simulation, which is
    not believed.
    """

    lost = lambda f, state: state._replace(missing=9.0, reasons=("lost",))
    monkeypatch.setattr(by_proposal, "audit_proposal", lost)
    gaussians = (by_proposal._search_gaussians,)
    monkeypatch.setattr(by_proposal, "_families", lambda request: gaussians)  # tilts serve here
    plain = failure_probability(key, planes(1.5), BUDGET)
    assert plain.reliable and plain.chernoff is not None
    assert plain.interval[0] < norm.sf(1.5) < plain.interval[1]
    levels = failure_probability(key, planes(4.0), BUDGET)
    assert not levels.reliable and levels.warnings[0] == "lost"
    assert "answer of subset simulation" in levels.warnings[1]
    assert levels.evaluations <= BUDGET
    assert abs(levels.log_mean - np.log(norm.sf(4))) < 4 * levels.relative_error


def _along(beta, x):
    return beta - x.sum() / jnp.sqrt(jnp.asarray(x.shape[0], x.dtype))


@pytest.mark.slow
def test_another_budget_and_parameter_compile_nothing(key):
    """Also where tilts are tried after the Gaussians, as with the least budget here."""
    plane = lambda beta: limit_state(Partial(_along, jnp.asarray(beta, jnp.zeros(()).dtype)), 20)

    with compiled() as programs:
        failure_probability(key, plane(4.0), 30_000)
        failure_probability(key, plane(4.0), 8000)
    assert programs
    for beta, budget in ((4.0, 20_001), (3.5, 30_000), (3.5, 9000)):
        sim = plane(beta)
        with compiled() as programs:
            found = failure_probability(key, sim, budget)
        error = abs(found.log_mean - np.log(norm.sf(beta)))
        assert not programs and error < 5 * found.relative_error


LOST = [("walks", 16), ("walks", 32), ("scaled", 25), ("union", 33), ("branches", 22)]


@pytest.mark.long
@pytest.mark.parametrize("family, seed", LOST)
def test_no_mode_is_lost_in_silence_with_few_evaluations(family, seed):
    """These lost a half to a twentieth of the probability at 10,000 evaluations, and said nothing:
    a side of a walk, of two planes, of eight, one of four branches.
    """
    _, sim, truth = limit_states.draw(family, 50_000 + seed)
    r = failure_probability(jax.random.key(10_000 + seed), sim, 10_000)
    assert not r.reliable or abs(r.mean / truth - 1) < 4 * r.relative_error


def test_mirror_images_of_failures(key):
    """Of two planes the other one is found a tenth farther out, not where it is out of reach."""
    for down, lifts in ((4.4, [1.1]), (8.0, [])):
        f = GaussianFamily(planes(4.0, down), BUDGET, search_context(key))
        anchors = np.full((1, 4), 2.001)
        points, evaluations = exploration._mirror(f, anchors)
        assert evaluations == len(exploration.LIFTS) and len(points) == len(lifts)
        assert np.allclose(points, [-lift * anchors[0] for lift in lifts] or points)
