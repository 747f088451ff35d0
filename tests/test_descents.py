"""What populations are made of, by references of their own: moves by exact draws, genealogies by
all pairs, chains by closed forms; and how their search ends, is stopped and goes on.
"""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import compiled
from scipy import stats

import jast
from jast import distributions as D
from jast._src.core.counter_prng import counter_key
from jast._src.estimate import budgets
from jast._src.estimate import failure_probability as adaptive
from jast._src.estimate.estimate import MAX_RELATIVE_ERROR
from jast._src.estimate.population import descents, search
from jast._src.estimate.population.descents import DESCENTS, by_distance, by_width
from jast._src.estimate.population.particle_moves import (
    AFTER,
    DIFFERENCE,
    SMALL,
    WINDOW,
    Particles,
    Steering,
    allocate_particles,
    draw_particles,
    initial_steering,
    move_particles,
    record_crossings,
)
from jast._src.estimate.population.search import Answer, answer_of
from jast._src.normal_space.transform import episodes, outcomes
from jast._src.stress_testing import stress_test
from jast._src.util.intervals import clopper_pearson
from jast.estimate import failure_probability, population
from jast.simulators import limit_state, walk1d

norm = stats.norm
N = 1024
HALF = limit_state(lambda u: 3.0 - jnp.sum(u) / 4**0.5, 4)  # P = Phi(-3)
SIDES = limit_state(lambda u: 3.0 - jnp.abs(u[0]), 2)  # P = 2 Phi(-3)
SPHERE = limit_state(lambda u: 5.0 - jnp.sqrt(jnp.sum(u**2)), 5)
CHANCE = 1e-4
"""Of a test of a distribution to fail by chance, if its key were another one."""


def as_particles(sim, z):
    """Points [n, D] as a population has them."""
    o = jax.device_get(outcomes(sim, jnp.asarray(z)))
    p = allocate_particles(sim, len(z))
    own = np.arange(z.shape[1]) < o.used[:, None]
    square = (z**2 * own).sum(axis=1)
    given = z.astype(p.z.dtype), o.score, o.used, square.astype(p.z.dtype), o.distance
    return Particles(*map(jnp.asarray, given), p.reached)


# --- moves


@pytest.mark.parametrize("kinds", [(SMALL, SMALL), (SMALL, WINDOW)])
@pytest.mark.parametrize("width", [1.0, 2.0])
def test_moves_among_failures_keep_what_is_normal_there(key, width, kinds):
    """Exact draws of N(0, w^2 I) given x.e >= 3: after 40 moves x.e is still normal, truncated, and
    what is at right angles normal, by Kolmogorov and Smirnov. Each point moved.
    """
    rng, e = np.random.default_rng(0), np.full(4, 0.5)
    along = width * stats.truncnorm(3 / width, np.inf).rvs(N, random_state=rng)
    z = width * rng.standard_normal((N, 4))
    z = (z + np.outer(along - z @ e, e)).astype(np.float32)
    z += np.maximum(3 + 1e-5 - z @ e, 0)[:, None].astype(np.float32)
    start = as_particles(HALF, z)
    assert (np.asarray(start.score) == -np.inf).all()
    after, _, _ = move_particles(
        HALF,
        start,
        counter_key(key, 1),
        np.arange(N),
        initial_steering(),
        moves=40,
        level=-np.inf,
        width=width,
        kinds=kinds,
    )
    new = np.asarray(after.z, np.float64)
    truncated = stats.truncnorm(3 / width, np.inf).cdf
    assert stats.kstest(new @ e / width, truncated).pvalue > CHANCE
    across = new @ [0.5, -0.5, 0.5, -0.5] / width
    assert stats.kstest(across, norm.cdf).pvalue > CHANCE
    assert (new != z).any(axis=1).mean() > 0.99
    # what is nearly independent has a correlation of 1 / sqrt(n)
    assert abs(np.corrcoef(across, z @ [0.5, -0.5, 0.5, -0.5])[0, 1]) < 0.5


def test_a_window_draws_neighbours_anew(key):
    """Three of ten numbers, which are neighbours in a ring; each begins a window as often as
    another (chi-square). The small move beside it has a size of 0 and changes no bit.
    """
    sim = limit_state(lambda u: 99.0 - u[0], 10)
    z = np.random.default_rng(0).standard_normal((N, 10)).astype(np.float32)
    still = Steering(np.array([0, 0.3], np.float32), np.zeros(2, np.float32))
    after, steering, _ = move_particles(
        sim, as_particles(sim, z), counter_key(key, 1), np.arange(N), still, moves=2, level=np.inf
    )
    changed = np.asarray(after.z) != z
    begin = changed & ~np.roll(changed, 1, axis=1)
    assert (changed.sum(axis=1) == 3).all() and (begin.sum(axis=1) == 1).all()
    assert stats.chisquare(begin.sum(axis=0)).pvalue > CHANCE
    assert stats.kstest(np.asarray(after.z)[changed], norm.cdf).pvalue > CHANCE
    assert (steering.accepted == 1).all()


@pytest.mark.parametrize("live", [1, 2, 3, 200])
def test_a_difference_is_one_of_points_that_live_and_leaves_the_norm(live, key):
    """One move of the first of 256 points, more than a block of 128 side by side or less: each ends
    in the span of itself and a difference of two others of its block. Where no two others are to be
    had, every bit stays.
    """
    sim = limit_state(lambda u: 99.0 - u[0], 6)
    z = np.random.default_rng(0).standard_normal((256, 6)).astype(np.float32)
    after, steering, _ = move_particles(
        sim,
        as_particles(sim, z),
        counter_key(key, 1),
        np.arange(live),
        Steering(np.array([0.4, 0.4], np.float32), np.zeros(2, np.float32)),
        moves=1,
        level=np.inf,
        kinds=(DIFFERENCE, DIFFERENCE),
    )
    new, z = np.asarray(after.z)[:live], z[:live]
    assert steering.accepted[0] == 1
    np.testing.assert_allclose(np.linalg.norm(new, axis=1), np.linalg.norm(z, axis=1), rtol=1e-5)
    if live < 3:
        return np.testing.assert_array_equal(new, z)
    for block in np.split(np.arange(live), [128]):
        for i in block:
            # new = a (z_i + .4 (z_j - z_k)), by all pairs
            pairs = z[block][:, None] - z[block][None]
            along = z[i] + 0.4 * pairs.reshape(-1, 6)
            along *= np.linalg.norm(z[i]) / np.linalg.norm(along, axis=1, keepdims=True)
            assert np.abs(along - new[i]).max(axis=1).min() < 1e-5


def test_what_comes_after_a_level_is_drawn_anew(key):
    """Walks of ten steps from 0 with 3 - |s| as the distance, those that came to 1 but did not
    fail: until then no bit changes, later all numbers do and are normal (Kolmogorov-Smirnov); no
    draw is refused. The moment is that of a loop in NumPy.
    """
    sim, rng = walk1d(threshold=3.0, horizon=10), np.random.default_rng(0)
    z = rng.standard_normal((4 * N, 10)).astype(np.float32)
    start = as_particles(sim, z)
    rows = np.flatnonzero((np.asarray(start.score) <= 1) & (np.asarray(start.score) > -np.inf))
    for_looks, for_moves = counter_key(key, 1), counter_key(key, 2)
    looked = record_crossings(sim, start, for_looks, rows, 1.0)
    path = np.cumsum(z[rows], axis=1)
    reached = [next(t for t, s in enumerate(p, 1) if 3 - abs(s) <= 1) for p in path]
    assert (np.asarray(looked.reached)[: len(rows)] == reached).all() and len(rows) > N
    after, steering, _ = move_particles(
        sim,
        looked,
        for_moves,
        np.arange(len(rows)),
        initial_steering(),
        moves=1,
        level=1.0,
        kinds=(AFTER, AFTER),
    )
    new = np.asarray(after.z)[: len(rows)]
    later = np.arange(10) >= np.asarray(reached)[:, None]
    assert ((new != z[rows]) == later).all() and steering.accepted[0] == 1
    assert stats.kstest(new[later], norm.cdf).pvalue > CHANCE


def test_small_changes_are_steered_to_a_third_of_acceptance(key):
    """40 moves among failures, a thousandth of all: a share of .2 to .5 is taken at last."""
    run = by_distance(key, HALF, N, 4, N)
    start = as_particles(HALF, run.points)
    after, steering, _ = move_particles(
        HALF, start, counter_key(key, 1), np.arange(N), initial_steering(), moves=40, level=-np.inf
    )
    assert 0.2 < steering.accepted[0] < 0.5
    assert (0.02 <= steering.size).all() and (steering.size <= 1).all()


def test_a_key_tells_every_bit(key, equal):
    one, other = jax.random.split(key)
    runs = [by_width(k, SIDES, 256, 4, 256) for k in (one, one, other)]
    equal(tuple(runs[0]), tuple(runs[1]))
    assert runs[0].log_mean != runs[2].log_mean


# --- genealogy


@pytest.mark.parametrize("way", ["distance", "width"])
def test_the_variance_of_a_chain_is_that_of_all_pairs(key, way, monkeypatch):
    """With the rows of every resampling and the last weights: 1 - n / (n - 1) times the weight of
    all pairs of points that have no common ancestor (Lee and Whiteley 2018, without the noise that
    systematic resampling has not); and where weights are 0 and 1 the estimate is the product of
    their means.
    """
    chosen, real = [], descents.resample

    def record(log_w, size, shift):
        rows = real(log_w, size, shift)
        chosen.append((np.exp(log_w - log_w.max()), rows))
        return rows

    monkeypatch.setattr(descents, "resample", record)
    n = 256
    run = DESCENTS[way](key, HALF, n, 4, n)
    *before, (w, _) = chosen  # the last resampling is of failures, after the estimate
    ancestor = list(range(n))
    for _, rows in before:
        ancestor = [ancestor[i] for i in rows]
    pairs = [(i, j) for i in range(n) for j in range(n) if ancestor[i] != ancestor[j]]
    apart = sum(w[i] * w[j] for i, j in pairs) / w.sum() ** 2
    assert len(before) >= 2
    assert run.variance == pytest.approx(1 - n / (n - 1) * apart, rel=1e-9)
    if way == "distance":
        means = [w.mean() for w, _ in chosen]
        assert run.log_mean == pytest.approx(np.log(means).sum(), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["distance", "width"])
def test_variances_are_those_of_repeated_populations(key, way):
    """The mean of 60 told variances over the variance of 60 estimates. The latter has a relative
    standard error of sqrt(2 / 59) = .18 if they are normal, some .3 as they are: half to double.
    """
    runs = [DESCENTS[way](k, HALF, 512, 10, 512) for k in jax.random.split(key, 60)]
    p = np.exp([r.log_mean for r in runs]) / norm.sf(3)
    assert 0.5 < np.mean([r.variance for r in runs]) / p.var(ddof=1) < 2
    assert abs(p.mean() - 1) < 4 * p.std() / 60**0.5


def test_levels_are_quantiles_and_evaluations_are_counted(key):
    """Each level keeps ceil(n / 5) points, so the estimate is that share to their number times j /
    n; an evaluation is a draw or a move.
    """
    n, moves = 512, 6
    run = by_distance(key, HALF, n, moves, n)
    kept = np.ceil(0.2 * n) / n
    j = np.exp(run.log_mean) / kept ** len(run.levels) * n
    assert j == pytest.approx(round(j), rel=1e-9) and 0.2 * n <= round(j) < n
    assert (np.diff(run.levels) < 0).all() and (run.levels > 0).all()
    assert run.evaluations == n * (1 + moves * (len(run.levels) + 1))
    assert run.plain[2] == n and run.size == n


def test_several_populations_are_one_answer():
    """The mean of those of 100 and 300 points, a lost one among them as 0; of four and more the
    spread counts, where it is greater.
    """
    about = dict.fromkeys(descents.Descent._fields, None)
    run = lambda p, size=100, v=0.01: descents.Descent(
        **{**about, "log_mean": np.log(p) if p else -np.inf, "variance": v, "size": size}
    )
    a = answer_of([run(0.1), run(0.2, 300, 0.04)])
    assert np.exp(a.log_mean) == pytest.approx(0.175)
    expected = (0.25 * 0.1) ** 2 * 0.01 + (0.75 * 0.2) ** 2 * 0.04
    assert a.relative == pytest.approx(expected**0.5 / 0.175)
    lost = answer_of([run(0.1), run(0.0, v=np.nan)])
    assert np.exp(lost.log_mean) == pytest.approx(0.05) and lost.relative == pytest.approx(1)
    p = np.array([0.1, 0.2, 0.3, 0.4])
    four = answer_of([run(v) for v in p])
    assert four.relative == pytest.approx(p.std(ddof=1) / 2 / p.mean())
    assert answer_of([run(0.0)]) is None
    assert Answer(0.0, 0.3).apart(Answer(1.0, 0.4)) == pytest.approx(2)


# --- chains, by closed forms


def start_and_steps():
    """A random start of deviation 2 and four steps of 1: the sum has a deviation of sqrt 8."""
    return jast.Simulator(
        init=lambda x0: x0,
        step=lambda s, x: s + x,
        disturbance=lambda s: D.Normal(jnp.zeros(()), 1.0),
        evaluate=lambda s: (s >= 9.0, jnp.maximum(9.0 - s, 0.0)),
        horizon=4,
        start=lambda: D.Normal(jnp.zeros(()), 2.0),
        episodic=True,
    )


def wheel():
    """Eight turns of a wheel that shows 0, 1 or 4, in .6, .3 and .1 of all; 22 and more fail."""
    value = jnp.asarray([0.0, 1.0, 4.0])
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + value[x],
        disturbance=lambda s: D.Categorical(probs=jnp.asarray([0.6, 0.3, 0.1]), dtype=jnp.int32),
        evaluate=lambda s: (s >= 22, jnp.maximum(22 - s, 0.0)),
        horizon=8,
        episodic=True,
    )


def turned():
    """P of `wheel`, by convolution."""
    one, total = np.array([0.6, 0.3, 0, 0, 0.1]), np.ones(1)
    for _ in range(8):
        total = np.convolve(total, one)
    return total[22:].sum()


def latch():
    """A number above 3 of the first five opens a latch, at a distance of 1, where none else is
    nearer; behind it the last of five more fails above 1.5.
    """

    def step(s, x):
        opened, t, _ = s
        return jnp.where((t < 5) & (x > 3), 1.0, opened), t + 1, x

    def evaluate(s):
        opened, t, x = s
        failure = (opened > 0) & (t == 10) & (x > 1.5)
        return failure, jnp.where(failure, 0.0, jnp.where(opened > 0, 1.0, 5 - jnp.minimum(x, 3)))

    return jast.Simulator(
        init=lambda x0: (jnp.zeros(()), jnp.zeros(()), jnp.zeros(())),
        step=step,
        disturbance=lambda s: D.Normal(jnp.zeros(()), 1.0),
        evaluate=evaluate,
        horizon=10,
    )


def lossy(limit):
    """Six normal numbers, of which each is lost in .2 of all; a sum at the ``limit`` fails."""
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + jnp.where(x[1] > 0, 0.0, x[0]),
        disturbance=lambda s: D.Joint((D.Normal(0.0, 1.0), D.Bernoulli(probs=0.2))),
        evaluate=lambda s: (s >= limit, jnp.maximum(limit - s, 0.0)),
        horizon=6,
        episodic=True,
    )


def lossy_probability(limit):
    """By the number of those that arrive."""
    arrive = np.arange(1, 7)
    return stats.binom(6, 0.8).pmf(arrive) @ norm.sf(limit / arrive**0.5)


def alarms():
    """Six alarms of .02, beside normal numbers that decide nothing; four of them fail."""
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x[1].astype(s.dtype),
        disturbance=lambda s: D.Joint((D.Normal(0.0, 1.0), D.Bernoulli(probs=0.02))),
        evaluate=lambda s: (s >= 4, jnp.maximum(4.0 - s, 0.0)),
        horizon=6,
        episodic=True,
    )


@pytest.mark.parametrize("sim, widened", [(lossy(7.5), [True, False]), (alarms(), [True, True])])
def test_choices_are_widened_only_where_failures_need_it(key, sim, widened, monkeypatch):
    """Numbers that are lost have to be larger, whatever is lost; alarms have to be more."""
    seen = []

    def drawn(*args, wide, width):
        seen.append((width, wide))
        return draw_particles(*args, wide=wide, width=width)

    monkeypatch.setattr(descents, "draw_particles", drawn)
    DESCENTS["width"](key, sim, N, 2, N)
    width, wide = seen[-1]
    assert width > 1
    np.testing.assert_array_equal(wide, np.tile(widened, 6))


@pytest.mark.slow
@pytest.mark.parametrize("way", ["distance", "width"])
@pytest.mark.parametrize(
    "sim, truth",
    [
        (SPHERE, stats.chi2(5).sf(25)),
        (start_and_steps(), norm.sf(9 / 8**0.5)),
        (wheel(), turned()),
        (latch(), (1 - norm.cdf(3) ** 5) * norm.sf(1.5)),
        (lossy(7.5), lossy_probability(7.5)),
        (alarms(), stats.binom(6, 0.02).sf(3)),
    ],
    ids=["sphere", "start", "wheel", "latch", "lossy", "alarms"],
)
def test_chains_tell_closed_forms(key, way, sim, truth):
    """1.4e-4, 7.3e-4, 1.5e-4, 4.5e-4, 4.7e-4 and 2.3e-6, from four populations."""
    runs = [DESCENTS[way](k, sim, N, 10, N) for k in jax.random.split(key, 4)]
    a = answer_of(runs)
    assert abs(a.log_mean - np.log(truth)) < 4 * a.relative < 4 * search.MAX_WITNESS_ERROR
    assert bool(outcomes(sim, jnp.asarray(runs[0].points)).failure.all())


def test_the_failures_of_a_population_are_those_of_the_model(key):
    """x.e of a half-space is a truncated normal number, by both ways. As many points as the
    genealogy's variance says are independent: Kolmogorov's distance below 2 / sqrt(1 / variance).
    """
    for way in DESCENTS.values():
        run = way(key, HALF, N, 10, N)
        along = run.points.astype(np.float64) @ np.full(4, 0.5)
        gap = stats.kstest(along, stats.truncnorm(3, np.inf).cdf).statistic
        assert gap < 2 * run.variance**0.5


def test_numbers_that_an_episode_did_not_use_are_the_models(key):
    """A walk that ended has numbers left over, which had the width of the noise: at the end they
    have a variance of 1. Of two populations it has a standard error of .01 (over keys); a width of
    1.17 that stays until two moves before the end makes 1.19 of it.
    """
    sim = walk1d("one-sided", threshold=6.0)
    runs = [by_width(k, sim, 4096, 2, 4096) for k in jax.random.split(key)]
    unused = np.concatenate([r.points[np.arange(10) >= r.used[:, None]] for r in runs])
    assert len(unused) > 4_000 and abs(unused.var() - 1) < 0.12


@pytest.mark.slow
def test_nothing_but_invalid_episodes_ends_without_an_answer(key):
    sim = limit_state(lambda u: jnp.nan * u[0], 2)
    for way in DESCENTS.values():
        run = way(key, sim, 256, 2, 256)
        assert run.log_mean == -np.inf and run.points.shape == (0, 2)
        assert run.invalid == run.evaluations
    found = population(key, sim, 20_000, particles=256)
    assert np.isnan(found.mean)
    assert not found.reliable
    assert found.interval == (0, found.interval[1])
    assert any("invalid" in w for w in found.warnings)


# --- the search


def test_plain_draws_have_the_interval_of_their_counts(key):
    found = population(key, limit_state(lambda u: 1.0 - u[0], 2), 60_000, particles=N, level=0.9)
    k, _, n = found.plain
    assert found.samples == n <= 60_000
    assert found.failing == k
    assert found.mean == k / n
    assert found.interval == clopper_pearson(k, n, 0.9)


@pytest.mark.slow
def test_a_few_invalid_episodes_are_counted_and_do_no_harm(key):
    """NaN in 3e-6 of all, .1 % of P: less than the hundredth that matters."""
    sim = limit_state(lambda u: jnp.where(u[1] > 4.5, jnp.nan, 3.0 - jnp.abs(u[0])), 2)
    found = population(key, sim, 300_000, particles=N)
    truth = 2 * norm.sf(3)
    assert found.invalid > 0
    assert found.reliable
    assert found.interval[0] < found.mean
    assert found.mean < found.interval[1]
    assert abs(found.log_mean - np.log(truth)) < 4 * found.relative_error


def stop_at(number):
    """A callback that interrupts at its call of this number, once."""
    calls = []

    def callback(done, total, result):
        calls.append(done)
        if len(calls) == number:
            raise KeyboardInterrupt

    return callback, calls


@pytest.mark.parametrize("number", [1, 2, 3])
def test_an_interruption_ends_the_call_at_once(key, number):
    """No population begins after it; the estimate says so and is not reliable."""
    callback, calls = stop_at(number)
    found = population(key, SIDES, 400_000, particles=N, callback=callback)
    assert len(calls) == number
    assert not found.reliable and any("interrupted" in w for w in found.warnings)


def test_an_interruption_before_plain_draws_ends_the_call(key):
    callback, calls = stop_at(1)
    found = population(
        key, limit_state(lambda u: 1.0 - u[0], 2), 400_000, particles=N, callback=callback
    )
    assert len(calls) == 1 and found.evaluations < 100_000
    assert any("interrupted" in w for w in found.warnings)


def test_an_interruption_before_anything_is_raised(key, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setitem(DESCENTS, "distance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        population(key, SIDES, 200_000, particles=N)


def test_a_stopped_call_goes_on_from_its_checkpoint(key, tmp_path, equal, monkeypatch):
    """To the bits of one that was not stopped; a third call runs no population."""
    call = lambda **more: population(key, SIDES, 200_000, particles=N, **more)
    call(checkpoint=tmp_path, callback=stop_at(3)[0])
    found, alone = call(checkpoint=tmp_path), call()
    for name in DESCENTS:
        monkeypatch.setitem(DESCENTS, name, None)  # which nobody can call
    for one in (found, call(checkpoint=tmp_path)):
        assert one.log_mean == alone.log_mean and one.interval == alone.interval
        assert one.history == alone.history and one.evaluations == alone.evaluations
        equal(tuple(one.proposal), tuple(alone.proposal))


@pytest.mark.slow
def test_stress_compiles_few_programs_and_hardly_more_with_a_second_key(key, small):
    """A walk that fails on either side, at any of its last steps; 26 were measured. A key whose
    first look meets a failure compiles two to play it.
    """
    one, other = jax.random.split(key)
    sim = walk1d(threshold=16.0)
    with compiled() as programs:
        jast.stress(one, sim, 150_000)
    assert len(programs) <= 45
    with compiled() as programs:
        jast.stress(other, sim, 150_000)
    assert len(programs) <= 2


def test_another_budget_and_other_parameters_compile_nothing(key):
    population(key, walk1d("one-sided", threshold=9.0), 60_000, particles=N)
    other = walk1d("one-sided", threshold=9.5)
    with compiled() as programs:
        population(key, other, 80_000, particles=N)
    assert not programs


# --- who asks for populations


@pytest.mark.parametrize("seconds", [0, -1.0, float("nan"), float("inf"), "1", True])
def test_seconds_that_are_no_time_are_refused(key, seconds):
    with pytest.raises(ValueError, match="failure_probability: seconds must be a number above 0"):
        failure_probability(key, SIDES, seconds=seconds)


def test_known_failures_and_neighbours_lead_a_proposal(key, monkeypatch):
    """Known failures are for a proposal, whatever the budget; a neighbour whose answer is of
    populations has nothing to draw from, and changes nothing.
    """
    asked = []

    def by_populations(name, key, sim, budget, **_):
        asked.append(budget)
        return known

    def sought(wanted):
        asked.append("proposal")
        return known

    known = jast.estimate.monte_carlo(key, walk1d(), 2000)
    near = population(key, SIDES, 40_000, particles=256)
    monkeypatch.setattr(adaptive, "by_populations", by_populations)
    monkeypatch.setattr(adaptive, "estimate_by_proposal", sought)
    monkeypatch.setattr(budgets, "episodes_a_second", lambda key, sim: 2e6)
    failures = jast.failures.collect(
        SIDES, jast.rewards.likelihood(SIDES), episodes_of(SIDES, near.proposal.points[:10])
    )
    failure_probability(key, SIDES, 400_000, failures=failures)
    failure_probability(key, SIDES, failures=failures)
    failure_probability(key, SIDES, 400_000, near=near)
    failure_probability(key, SIDES)
    assert asked == ["proposal", "proposal", 400_000, 3 * 2**21]


def episodes_of(sim, z):
    return jax.device_get(episodes(sim, jnp.asarray(z)))


def test_a_black_box_keeps_the_thrifty_way(key, monkeypatch):
    """Its rate is of the clock; 100 calls a second in 2 s are 192."""
    slow = jast.blackbox.from_python(
        lambda x: (bool(x[0] > 2), float(max(2 - x[0], 0))),
        horizon=1,
        disturbance=D.Normal(0.0, 1.0),
    )
    monkeypatch.setattr(budgets, "_episodes_a_second_on_host", lambda key, sim: 100.0)
    seen = []
    few = lambda key, sim, budget, *_: (
        seen.append(budget) or jast.estimate.monte_carlo(key, sim, 50)
    )
    monkeypatch.setattr(adaptive.few_calls, "few_calls", few)
    found = failure_probability(key, slow, seconds=2.0)
    assert seen == [192] and found.settings["budget"] == 192
    assert budgets.measure_budget("f", key, slow, None, 50) == budgets.DEFAULT_BUDGET


@pytest.fixture
def small(monkeypatch):
    """Populations in `jast.stress` from 50,000 evaluations on, with little to polish."""
    monkeypatch.setattr(budgets, "MIN_POPULATION_BUDGET", 50_000)
    monkeypatch.setattr(stress_test, "MIN_POPULATION_BUDGET", 50_000)
    monkeypatch.setattr(stress_test, "REFINE_EVALUATIONS", 6000)


@pytest.mark.slow
def test_stress_where_failures_are_frequent(key, small):
    """P = .16: plain draws, and the likeliest failure at e^-.5."""
    report = jast.stress(key, limit_state(lambda u: 1.0 - u[0], 2), 120_000)
    p = report.probability
    assert "plain draws" in p.method and p.reliable
    assert abs(p.mean - norm.sf(1)) < 4 * p.standard_error
    assert float(report.failures.best.reward) == pytest.approx(-0.5, abs=0.05)
    assert [m.share for m in report.modes] == [1.0] and report.episodes <= 120_000


@pytest.mark.slow
def test_stress_of_a_rare_failure(key, small):
    """The half-space at 4: its design point, e^-8, and all of the probability in one mode. The
    plain draws of the first look are among those that guarantee an interval.
    """
    report = jast.stress(key, limit_state(lambda u: 4.0 - jnp.sum(u) / 3**0.5, 3), 150_000)
    p = report.probability
    assert "populations" in p.method
    assert [t.name for t in report.tried][:3] == [
        "nominal",
        "populations",
        "cooled",
    ]
    assert abs(p.log_mean - norm.logsf(4)) < 4 * p.relative_error < 4 * search.MAX_WITNESS_ERROR
    assert p.plain[-1] > report.nominal.episodes and p.guaranteed[0] < norm.sf(4) < p.guaranteed[1]
    assert float(report.failures.best.reward) == pytest.approx(-8, abs=0.05)
    assert [m.share for m in report.modes] == [1.0]


@pytest.mark.slow
@pytest.mark.parametrize("coarse", [False, True])
def test_what_the_estimate_left_cools_where_no_slope_leads_to_the_likeliest(
    coarse, key, small, monkeypatch
):
    """The half-space at 4, whose distance is told in whole numbers or not: its likeliest failure
    has e^-8 either way.
    """
    by_populations = stress_test.by_populations
    few = lambda name, key, sim, budget, **how: by_populations(name, key, sim, 60_000, **how)
    monkeypatch.setattr(stress_test, "by_populations", few)

    def distance(u):
        d = 4.0 - jnp.sum(u) / 3**0.5
        return jnp.ceil(d) if coarse else d

    report = jast.stress(key, limit_state(distance, 3), 300_000)
    spent = {t.name: t.evaluations for t in report.tried}
    assert ("cooled slowly" in spent) == coarse
    assert spent.get("cooled slowly", 0) > stress_test.COOLING_SHARE * 300_000 or not coarse
    assert report.episodes <= 300_000
    assert float(report.failures.best.reward) == pytest.approx(-8, abs=0.05)


@pytest.mark.slow
def test_a_default_stress_is_made_again_where_a_known_budget_would_do(key, small, monkeypatch):
    monkeypatch.setattr(budgets, "measure_budget", lambda *args: 50_000)
    more = lambda found, budget: 60_000 if budget == 50_000 else None
    monkeypatch.setattr(budgets, "next_budget", more)
    sim = limit_state(lambda u: 1.0 - u[0], 2)
    report, again = jast.stress(key, sim), jast.stress(key, sim, 60_000)
    assert report.settings["budget"] == 60_000
    assert report.probability.interval == again.probability.interval
    assert str(report) == str(again) and report.tried == again.tried


@pytest.mark.slow
def test_an_interrupted_second_stress_keeps_the_first_answer(key, small, monkeypatch):
    """The first has only the probability by which it is made again: it cools nothing."""
    called = []

    def once(name, key, sim, budget, **how):
        called.append(budget)
        if len(called) == 2:
            raise KeyboardInterrupt
        return by_populations(name, key, sim, budget, **how)

    by_populations = stress_test.by_populations
    monkeypatch.setattr(budgets, "measure_budget", lambda *args: 50_000)
    monkeypatch.setattr(budgets, "next_budget", lambda found, budget: 2 * budget)
    monkeypatch.setattr(stress_test, "by_populations", once)
    report = jast.stress(key, limit_state(lambda u: 1.0 - u[0], 2))
    assert len(called) == 2 and report.probability.mean > 0
    assert [t.name for t in report.tried] == ["nominal", "populations"]
    assert "100000" in report.settings["interrupted"] and "interrupted" in str(report)


@pytest.mark.long
@pytest.mark.parametrize(
    "sim, truth", [(SIDES, 2 * norm.sf(3)), (HALF, norm.sf(3)), (SPHERE, stats.chi2(5).sf(25))]
)
def test_intervals_hold_the_truth_as_often_as_they_say(key, sim, truth):
    """60 calls: at 95 % 9 or more miss in 1 of 500; the errors in their standard errors have a
    deviation of about 1, and none is beyond 4.5.
    """
    found = [population(k, sim, 200_000) for k in jax.random.split(key, 60)]
    missed = sum(not f.interval[0] <= truth <= f.interval[1] for f in found)
    z = np.array([(f.log_mean - np.log(truth)) / f.relative_error for f in found])
    assert missed < 9 and np.abs(z).max() < 4.5
    assert 0.6 < z.std() < 1.4 and abs(z.mean()) < 0.8
    # two ways part by chance once in 370
    assert sum(f.reliable != (f.relative_error <= MAX_RELATIVE_ERROR) for f in found) <= 2


def counted_box():
    """A black box that counts its calls: a sum of three numbers."""
    calls = []

    def run(x):
        calls.append(1)
        gap = 3.0 - float(x.sum()) / 3**0.5
        return gap <= 0, max(gap, 0.0)

    return jast.blackbox.from_python(run, horizon=3, disturbance=D.Normal(0.0, 1.0)), calls


@pytest.mark.slow
def test_stress_goes_on_where_it_was_stopped(key, tmp_path):
    """A second run of the same call asks a black box for the first look alone and what it
    replays.
    """
    sim, calls = counted_box()
    whole = jast.stress(key, sim, 600)
    stop, _ = stop_at(4)
    cut = jast.stress(key, sim, 600, checkpoint=tmp_path / "kept", callback=stop)
    assert "interrupted" in cut.settings
    again = jast.stress(key, sim, 600, checkpoint=tmp_path / "kept")
    calls.clear()
    last = jast.stress(key, sim, 600, checkpoint=tmp_path / "kept")
    assert str(last) == str(again) == str(whole) and len(calls) < 300


@pytest.mark.slow
def test_refine_goes_on_where_it_was_stopped(key, tmp_path):
    sim, calls = counted_box()
    found = jast.search.monte_carlo(key, sim, episodes=2000, refine=0).failures
    whole = jast.search.refine(key, sim, found, budget=600)
    kept = [jast.search.refine(key, sim, found, budget=600, checkpoint=tmp_path) for _ in range(2)]
    assert {str(each) for each in kept} == {str(whole)}
    calls.clear()
    jast.search.refine(key, sim, found, budget=600, checkpoint=tmp_path)
    assert len(calls) < 150
    with pytest.raises(ValueError, match="refine: .*checkpoint"):
        jast.search.refine(key, sim, found, budget=700, checkpoint=tmp_path)


@pytest.mark.slow
def test_stress_is_the_same_wherever_its_populations_run(key, small):
    sim = limit_state(lambda u: 3.5 - jnp.sum(u) / 3**0.5, 3)
    with ThreadPoolExecutor(2) as pool:
        elsewhere = jast.stress(key, sim, 150_000, executor=pool)
    assert str(elsewhere) == str(jast.stress(key, sim, 150_000))
