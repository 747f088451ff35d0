"""More answers from the draws of one estimate, against closed forms within standard errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from blackboxes import walk as host_walk
from jax.tree_util import Partial

import jast
from jast import distributions as D
from jast._src.estimate import weighted_draws
from jast._src.estimate.importance_sampling import Traces
from jast._src.estimate.weighted_draws import moments_of_weights, scaled_weights, share_interval
from jast.estimate import (
    distance_quantile,
    events,
    exceedance,
    failure_probability,
    failure_times,
    given_start,
    importance,
    monte_carlo,
    subset_simulation,
    trace_proposal,
)
from jast.simulators import walk1d

norm = scipy.stats.norm
BETA = 4.0
UP, DOWN = 1.0, -1.0


def _unit():
    return D.Normal(jnp.zeros(()), jnp.ones(()))


def _steps(s):
    return D.MultivariateNormalDiag(jnp.zeros(3), jnp.ones(3))


def _plane(beta, s):
    gap = beta - jnp.abs(s.sum()) / 2
    return gap <= 0, gap


def _begin(x0):
    return jnp.full(4, 0.0).at[0].set(x0)


def _step(s, x):
    return jnp.concatenate([s[:1], x])


def plane():
    """Four normal numbers, one of them the start; fails where the size of half of their sum is
    above 4: the distance goes on below 0. P(distance <= u) = 2 Phi(-(4 - u)).
    """
    beta = Partial(_plane, jnp.asarray(BETA, jnp.zeros(()).dtype))
    return jast.Simulator(_begin, _step, _steps, beta, 1, start=_unit, episodic=True)


@pytest.fixture(scope="module")
def found():
    return failure_probability(jax.random.key(3), plane(), 20_000)


def first_passage(threshold=10.0, steps=30, n=2001):
    """Probability that the walk leaves the band at each step, by quadrature."""
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = threshold * x, threshold * w
    kernel = norm.pdf(x[:, None] - x[None]) * w[None]
    density, out = norm.pdf(x), [0.0, 2 * norm.sf(threshold)]
    for _ in range(steps - 1):
        leaves = norm.sf(threshold - x) + norm.sf(threshold + x)
        out.append(float(w @ (density * leaves)))
        density = kernel @ density
    return np.array(out)


def within(value, interval, truth, level=0.95, errors=4.0):
    """Whether the truth is within so many standard errors of an answer, by its interval."""
    half = max(interval[1] - value, value - interval[0])
    return abs(truth - value) <= errors / norm.ppf((1 + level) / 2) * half


@pytest.mark.slow
def test_the_curve_is_that_of_the_plane(found):
    u = np.array([-0.8, -0.4, 0.0, 0.3, 0.6, 4.0])
    c = exceedance(found, u)
    truth = np.minimum(2 * norm.cdf(u - BETA), 1)
    assert c.reliable[[1, 2, 3, 5]].all()
    known = np.isfinite(c.probability)
    assert known.sum() >= 5
    for row in np.flatnonzero(known):
        assert within(c.probability[row], (c.low[row], c.high[row]), truth[row])
    assert c.probability[2] == pytest.approx(found.mean, rel=1e-6)
    assert (c.low[2], c.high[2]) == pytest.approx(found.interval, rel=1e-6)
    default = exceedance(found)
    assert 0 in default.thresholds and (np.diff(default.probability[default.reliable]) >= 0).all()
    assert exceedance(found, u, level=0.5).high[2] < c.high[2]


@pytest.mark.slow
def test_nothing_is_said_of_what_few_draws_tell(found):
    c = exceedance(found, [-60.0, -3.0])
    assert np.isnan(c.probability).all() and not c.reliable.any()


def test_the_distance_of_a_probability(found):
    for p in (2 * norm.sf(BETA + 0.5), 2 * norm.sf(BETA - 0.4)):
        u, ends = distance_quantile(found, p)
        assert within(u, ends, BETA - norm.isf(p / 2))
        assert ends[0] < u < ends[1]
    assert np.isnan(distance_quantile(found, 1e-30)[0])


def test_a_clipped_distance_says_nothing_beyond_the_failure(key):
    e = monte_carlo(key, walk1d(threshold=5.0), 4000)
    assert np.isnan(distance_quantile(e, e.mean / 2)[0])
    u, ends = distance_quantile(e, min(1.2 * e.mean, 0.99))
    assert 0 < u and ends[0] <= u <= ends[1]
    c = exceedance(e, [0.0])
    assert (c.low[0], c.high[0]) == e.interval and c.reliable[0]


def test_modes_have_intervals(found):
    each = norm.sf(BETA)
    assert found.mode_intervals.shape == (2, 2)
    for share_, ends in zip(found.modes, found.mode_intervals, strict=True):
        assert within(share_ * found.mean, ends, each)
        assert ends[0] < share_ * found.mean < ends[1]


def test_events_of_the_end_and_of_the_start(found, key):
    sim = plane()
    above = lambda s: s.sum() > 0
    named = {"up": above, "down": lambda s: ~above(s), "never": lambda s: s[0] > 1e3}
    out = events(sim, found, named)
    assert within(out["up"].probability, out["up"].interval, norm.sf(BETA))
    assert within(out["up"].given_failure, out["up"].given_interval, 0.5)
    both = out["up"], out["down"]
    assert sum(e.given_failure for e in both) == pytest.approx(1)
    assert sum(e.failing for e in both) == found.failing
    assert sum(e.probability for e in both) == pytest.approx(found.mean, rel=1e-5)
    assert all(e.reliable for e in both)
    nothing = out["never"]
    assert nothing.probability == 0
    assert not nothing.reliable
    assert nothing.interval[1] > 0
    # x0 given a failure on the upper side, by quadrature
    x = np.linspace(-6, 10, 8001)
    joint = norm.pdf(x) * norm.sf((2 * BETA - x) / np.sqrt(3))
    truth = 2 * (joint * (x > 1)).sum() * (x[1] - x[0])
    inside = {"beyond 1": lambda s: jnp.abs(s[0]) > 1}
    # those that fail on the side away from their start are fewer by e^-8
    other = norm.pdf(x) * norm.sf((2 * BETA + x) / np.sqrt(3))
    truth += 2 * (other * (x > 1)).sum() * (x[1] - x[0])
    e = events(sim, found, inside, of="start")["beyond 1"]
    assert within(e.probability, e.interval, truth)
    g = given_start(key, sim, found, inside, draws=100_000)["beyond 1"]
    assert within(g.start, g.start_interval, 2 * norm.sf(1))
    assert within(g.probability, g.interval, truth / (2 * norm.sf(1))) and g.reliable
    assert g.together == e


def test_first_passage_times(key):
    truth = first_passage()
    assert truth.sum() == pytest.approx(0.1087363323, rel=1e-6)
    e = monte_carlo(key, walk1d(), 20_000)
    t = failure_times(e)
    n = len(t.probability)
    error = np.sqrt(truth * (1 - truth) / 20_000)
    assert (abs(t.probability - truth[:n]) < 4 * error[:n] + 1e-9).all()
    assert t.probability.sum() == pytest.approx(e.mean)
    assert t.given_failure.sum() == pytest.approx(1)
    assert np.mean((t.low <= truth[:n]) & (truth[:n] <= t.high)) >= 0.8
    cdf = np.cumsum(truth) / truth.sum()
    for q, (_, low, high) in t.quantiles.items():
        assert low - 1 <= np.searchsorted(cdf, q) <= high + 1
    mean = truth @ np.arange(31) / truth.sum()
    assert abs(t.mean - mean) < 4 * 6 / np.sqrt(e.failing)


@pytest.mark.slow
def test_episodes_of_drawn_policies_are_made_again(key):
    """The sides of the walk, and what a whole episode shows, of plain draws and of a proposal."""
    sim, up = walk1d(threshold=5.0), {"up": lambda s: s > 0}
    e = monte_carlo(key, sim, 3000)
    out = events(sim, e, up)["up"]
    assert within(out.given_failure, out.given_interval, 0.5)
    whole = {"up": lambda e: e.failure & (e.states[e.length] > 0)}
    assert events(sim, e, whole, of="episode")["up"].failing == out.failing
    failure = jax.jit(lambda k: jast.rollout(k, sim))(jax.random.key(2))
    proposal = trace_proposal(sim, failure)
    weighed = importance(key, sim, proposal, 3000)
    again = events(sim, weighed, {"out": lambda s: jnp.abs(s) >= 5.0}, proposal=proposal)["out"]
    assert again.failing == weighed.failing
    assert again.probability == pytest.approx(weighed.mean, rel=1e-5)
    with pytest.raises(ValueError, match="events: proposal must be the one"):
        events(sim, weighed, up)


def test_a_black_box_is_not_called_again(key):
    sim = jast.blackbox.from_python(host_walk, horizon=4, disturbance=D.Normal(0.0, 1.0))
    e = monte_carlo(key, sim, 2000)
    before = jast.blackbox.calls(sim)
    out = events(sim, e, {"all": lambda s: s.disturbances.sum() >= 3.999})["all"]
    assert jast.blackbox.calls(sim) == before
    assert out.failing == e.failing and out.interval == pytest.approx(e.interval)
    assert exceedance(e, [1.0]).probability[0] == pytest.approx(norm.sf(1.5), abs=0.03)


def test_memory_is_bounded(monkeypatch):
    """Failures are thinned and count for more, of the others the nearest stay."""
    monkeypatch.setattr(weighted_draws, "MAX_KEPT", 100)
    rng = np.random.default_rng(0)
    kept, n, log_w = weighted_draws.empty_draws(), 4000, []
    for _ in range(8):
        distance = rng.random(n).astype(np.float32)
        failure = distance < 0.25
        log_w.append(np.where(failure, rng.normal(size=n) - 20, 0.0).astype(np.float32))
        none = np.zeros(n, bool)
        kept = weighted_draws.add_draws(
            kept, Traces(log_w[-1], None, failure, none, none.astype(np.int32), distance)
        )
    assert kept.failure.sum() <= 100 and (~kept.failure).sum() <= 200
    assert kept.samples == 8 * n and kept.every == 128
    assert (kept.distance[~kept.failure] <= kept.reach).all()
    assert (~kept.failure).sum() >= 100 and kept.row.max() < 8 * n
    m = moments_of_weights(kept.log_weight[kept.failure], kept.samples)
    truth = 0.25 * np.exp(-20 + 0.5)
    assert abs(np.exp(m.log_mean) / truth - 1) < 4 * m.relative


@pytest.mark.long
def test_shares_cover():
    """The interval of a ratio of weighted sums, of weights as uneven as those of estimates are."""
    rng, hits, runs = np.random.default_rng(1), 0, 2000
    for _ in range(runs):
        log_w, a = rng.normal(size=400), rng.random(400) < 0.2
        w, whole = scaled_weights(log_w, False)
        _, (low, high) = share_interval(whole, w[a].sum(), (w[a] ** 2).sum(), int(a.sum()), 0.95)
        hits += low <= 0.2 <= high
    assert abs(hits / runs - 0.95) < 0.02


def test_what_holds_no_draws_says_so(key, found):
    e = subset_simulation(key, plane(), 100, replicates=3)
    for call in (exceedance, failure_times, lambda e: distance_quantile(e, 0.1)):
        with pytest.raises(ValueError, match="must have kept its weighted draws.*subset"):
            call(e)
    sim = plane()
    with pytest.raises(ValueError, match="events: sim must be the simulator"):
        events(walk1d(), found, {"up": lambda s: s > 0})
    with pytest.raises(ValueError, match="events: named must be a dict"):
        events(sim, found, [lambda s: s])
    with pytest.raises(ValueError, match="events: up must return a bool scalar, received float32"):
        events(sim, found, {"up": lambda s: jnp.zeros((), jnp.float32)})
    with pytest.raises(ValueError, match="events: of must be one of"):
        events(sim, found, {"up": lambda s: s > 0}, of="end")
    with pytest.raises(ValueError, match="exceedance: thresholds must be finite"):
        exceedance(found, [np.nan])
    with pytest.raises(ValueError, match="exceedance: estimate must be a jast.estimate.Estimate"):
        exceedance(0.5)
    with pytest.raises(ValueError, match="distance_quantile: probability must be a number above 0"):
        distance_quantile(found, 2.0)


def test_saved_and_loaded_the_answers_are_the_same(found, tmp_path):
    path = tmp_path / "estimate.zip"
    jast.save(path, found)
    again, named = jast.load(path), {"up": lambda s: s.sum() > 0}
    assert events(plane(), again, named) == events(plane(), found, named)
    u = [0.0, 0.3]
    np.testing.assert_array_equal(exceedance(again, u).high, exceedance(found, u).high)
