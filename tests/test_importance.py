"""Importance resampling: densities against NumPy, known probabilities within their standard errors,
and what must not be believed is not.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal
import scipy.stats
from jax.tree_util import Partial
from scipy.special import logsumexp
from systems import walk

import jast
from benchmarks.limit_states import walk_probability
from jast import distributions as D
from jast._src.core.policy import Policy, nominal_policy
from jast._src.distributions.mixtures import blend
from jast._src.estimate.importance_sampling import LANES, chunk_size, chunks, draw_episodes
from jast._src.runtime.progress_bar import Watch
from jast.estimate import (
    chernoff,
    clopper_pearson,
    double_loop,
    importance,
    jeffreys,
    log_weights,
    monte_carlo,
    policy_proposal,
    trace_proposal,
)
from jast.simulators import landing, landing_probability, walk1d

norm = scipy.stats.norm
VARIANCE, MU = 0.019, 4.0236721906842e-13
START, SHIFT = 0.01 / VARIANCE, 0.0009 / VARIANCE  # of the most probable failure at b = 1
N = 5000
MORE = 20_000  # two chunks, the second one not whole
SIM, WALK = landing(), walk1d("one-sided")
UP = jast.replay(WALK, jnp.full(7, 1.45))  # fails at its seventh step


def most_probable(sign=1.0, b=1.0):
    """Landing's most probable failure on one side, a little beyond the boundary so that rounding
    does not decide.
    """
    return jast.replay(
        landing(b),
        jnp.full(10, sign * b * SHIFT * 1.0001),
        x0=jnp.asarray(sign * b * START * 1.0001),
    )


def recorded(disturbances):
    """A policy that plays back ``disturbances`` [T]; the last one stays."""
    return Policy(
        D.Fixed, lambda s, t: D.Deterministic(disturbances[jnp.minimum(t, len(disturbances) - 1)])
    )


BOTH = [most_probable(), most_probable(-1.0)]
CENTRES = np.array([[s * START] + [s * SHIFT] * 10 for s in (1.0001, -1.0001)])
SCALES = np.array([0.1] + [0.03] * 10)


def _steer(state, t):
    """The mean shift of least norm from here to the nearer side."""
    side = jnp.where(state.x2 < 0, -1.0, 1.0).astype(state.x2.dtype)
    return D.Normal(
        (side - state.x2) / (10 - t).astype(state.x2.dtype), jnp.asarray(0.03, state.x2.dtype)
    )


def _sides():
    one = lambda v: D.Normal(jnp.asarray(v), jnp.asarray(0.1))
    return blend(jnp.asarray([0.5, 0.5]), one(START), one(-START))


STEER = Policy(_sides, _steer)


def rows(e):
    """x0 and the disturbances of landing's episodes: [n, 11]."""
    return np.concatenate(
        [np.asarray(e.x0, float)[:, None], np.asarray(e.disturbances, float)], axis=1
    )


def log_p(x, centre=0.0):
    return norm.logpdf(x, centre, SCALES)


def within(found, truth, times=4):
    """Of its own standard error, in logarithms."""
    return abs(found.log_mean - np.log(truth)) < times * found.relative_error


# Densities, against NumPy


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [0.05, 0.6])
def test_weights_of_several_traces(key, epsilon):
    """Algorithm 1 in each component, p / (eps p + (1 - eps) p(x - x*)) a step, start included, and
    eq. 20 over the components.
    """
    e, log_w = draw_episodes(key, SIM, trace_proposal(SIM, BOTH, epsilon), N)
    x = rows(e)
    log_q = np.stack(
        [
            np.logaddexp(np.log(epsilon) + log_p(x), np.log1p(-epsilon) + log_p(x, c)).sum(axis=1)
            for c in CENTRES
        ]
    )
    np.testing.assert_allclose(
        log_w, log_p(x).sum(axis=1) - (logsumexp(log_q, axis=0) - np.log(2)), atol=3e-3
    )
    # a component once a trace: half of them on either side
    assert abs((x.sum(axis=1) > 0).mean() - 0.5) < 4 * 0.5 / np.sqrt(N)


def test_weights_of_whole_traces(key):
    """mixing="trace": q = eps p + (1 - eps) / 2 (q_1 + q_2); no weight is above 1 / eps, and their
    mean over all episodes is 1 within 4 standard errors.
    """
    q = trace_proposal(SIM, BOTH, 0.1, mixing="trace")
    np.testing.assert_allclose(np.exp(q.log_weights), [0.45, 0.45, 0.1], rtol=1e-6)
    t = log_weights(key, SIM, q, LANES)
    w = np.exp(np.asarray(t.log_weight, float))
    assert w.max() < 10.01 and abs(w.mean() - 1) < 4 * w.std() / np.sqrt(LANES)
    np.testing.assert_allclose(logsumexp(t.shares, axis=1), 0, atol=1e-4)
    # the mean over q of the share of a component is its weight
    assert (abs(np.exp(t.shares).mean(axis=0) - [0.45, 0.45, 0.1]) < 4 * 0.5 / np.sqrt(LANES)).all()


def test_weights_of_a_policy(key):
    """Algorithm 2: the model moved to the policy's mode in the state at hand, eps mixed in at each
    step; the start of the policy's, mixed likewise.
    """
    e, log_w = draw_episodes(key, SIM, policy_proposal(SIM, STEER), N)
    x = rows(e)
    before = np.cumsum(x, axis=1)[:, :-1]
    aim = (np.where(before < 0, -1, 1) - before) / (10 - np.arange(10))
    log_q = np.logaddexp(
        np.log(0.05) + log_p(x)[:, 1:], np.log(0.95) + norm.logpdf(x[:, 1:], aim, 0.03)
    ).sum(axis=1)
    start = 0.05 * norm.pdf(x[:, 0], 0, 0.1) + 0.475 * (
        norm.pdf(x[:, 0], START, 0.1) + norm.pdf(x[:, 0], -START, 0.1)
    )
    np.testing.assert_allclose(log_w, log_p(x).sum(axis=1) - log_q - np.log(start), atol=5e-3)


def test_one_step_exactly(key):
    """x recovered from the log weight: whether the episode failed follows from it, and x has the
    density of the proposal (Kolmogorov and Smirnov).
    """
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: x,
        lambda s: D.Normal(jnp.zeros(()), 1.0),
        lambda s: (s > 2.5, jnp.maximum(2.5 - s, 0)),
        1,
        episodic=True,
    )
    t = log_weights(key, sim, trace_proposal(sim, jast.replay(sim, jnp.asarray([3.0])), 0.3), 4096)
    x = (
        np.log(np.maximum((np.exp(-np.asarray(t.log_weight, float)) - 0.3) / 0.7, 1e-300)) + 4.5
    ) / 3
    sure = abs(x - 2.5) > 1e-3
    assert (t.failure[sure] == (x > 2.5)[sure]).all()
    assert 0.3 < t.failure.mean() < 0.7
    assert (t.length == 1).all()
    assert not t.invalid.any()
    inside = x > -1  # below, the weight is flat in x
    cdf = lambda x: 0.3 * norm.cdf(x) + 0.7 * norm.cdf(x, 3)
    assert (
        scipy.stats.kstest(cdf(x[inside]), scipy.stats.uniform(cdf(-1), 1 - cdf(-1)).cdf).pvalue
        > 1e-3
    )


@pytest.mark.long  # of rounding, which is the compiler's
def test_to_the_end_and_to_the_horizon(key):
    """A walk that fails early: both weights are unbiased (4 standard errors), of the same episodes;
    those of Algorithm 1 in NumPy to the horizon are distributed as the paper's (Kolmogorov and
    Smirnov).
    """
    q, truth = trace_proposal(WALK, UP), walk_probability(10.0, 10, False)
    end, paper = importance(key, WALK, q, MORE), importance(key, WALK, q, MORE, mode="paper")
    assert truth == pytest.approx(9.578759495e-4, rel=1e-8)
    assert within(end, truth)
    assert within(paper, truth)
    assert max(end.relative_error, paper.relative_error) < 0.08
    assert end.failing == paper.failing and end.steps == paper.steps < 10 * MORE
    t, p = log_weights(key, WALK, q, LANES), log_weights(key, WALK, q, LANES, mode="paper")
    same = np.asarray(t.length) == 10
    assert (t.failure == p.failure).all()
    assert (t.length == p.length).all()
    assert 0.05 < same.mean() < 0.95
    np.testing.assert_allclose(t.log_weight[same], p.log_weight[same], atol=1e-4)
    # the proposal's last three steps are the model's: only steps before them are weighed
    apart = np.abs(np.asarray(t.log_weight) - np.asarray(p.log_weight)) > 1e-4
    assert (apart == (np.asarray(t.length) < 7)).mean() > 0.99

    rng, centre = np.random.default_rng(1), np.array([1.45] * 7 + [0.0] * 3)
    x = rng.normal(size=(LANES, 10)) + np.where(rng.random((LANES, 10)) < 0.05, 0, centre)
    log_w = -np.logaddexp(np.log(0.05), np.log(0.95) + norm.logpdf(x, centre) - norm.logpdf(x)).sum(
        axis=1
    )
    fails = (np.cumsum(x, axis=1) >= 10).any(axis=1)
    p_values = [
        scipy.stats.ks_2samp(a, b).pvalue
        for a, b in (
            (log_w, p.log_weight),
            (log_w[fails], np.asarray(p.log_weight)[np.asarray(p.failure)]),
        )
    ]
    assert min(p_values) > 1e-3
    assert abs(fails.mean() - np.asarray(t.failure).mean()) < 4 * np.sqrt(0.5 / LANES)


# Landing: the published problem


@pytest.mark.long
def test_two_traces(key):
    """1e5 episodes: within 3 standard errors, of at most 1.05 % (theory .92 % without eps), and
    half of it on each side.
    """
    found = importance(key, SIM, trace_proposal(SIM, BOTH))
    assert float(landing_probability()) == pytest.approx(MU, rel=1e-4)
    assert within(found, MU, 3)
    assert 0.009 < found.relative_error < 0.0105
    assert found.reliable
    assert found.warnings == ()
    assert abs(found.modes - 0.5).max() < 4 * 0.5 * 0.015 and found.modes.sum() == pytest.approx(1)
    assert (found.samples, found.evaluations, found.steps, found.invalid) == (
        100_000,
        100_000,
        1_000_000,
        0,
    )
    assert found.k_hat < 0.7
    assert found.interval[0] < MU * 1.03
    assert found.interval[1] > MU * 0.97
    assert found.standard_error == pytest.approx(found.mean * found.relative_error)


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [-30, -100])
def test_any_range(key, exponent):
    """Probabilities of 1e-30 and 1e-100, whatever the precision of the suite: within 3 standard
    errors of scipy's, as logarithms.
    """
    b = scipy.optimize.brentq(
        lambda b: norm.logsf(b / np.sqrt(VARIANCE)) + np.log(2) - exponent * np.log(10), 1, 4
    )
    found = importance(
        key, landing(b), trace_proposal(landing(b), [most_probable(s, b) for s in (1.0, -1.0)])
    )
    assert abs(found.log10_mean - exponent) < 3 * found.relative_error / np.log(10)
    assert found.relative_error < 0.025
    assert found.reliable
    assert found.mean > 0 and found.interval[0] > 0


def test_a_lost_mode_is_half(key):
    """One trace, twice: half of the probability within 3 standard errors, and nothing in the
    weights shows it: said so in the documentation.
    """
    found = importance(key, SIM, trace_proposal(SIM, [BOTH[0]] * 2), MORE)
    assert within(found, MU / 2, 3) and found.reliable


@pytest.mark.slow
def test_policy_with_a_tilted_start(key):
    """1e5 episodes, standard error at most 1 %."""
    found = importance(key, SIM, policy_proposal(SIM, STEER))
    assert within(found, MU, 3)
    assert found.relative_error < 0.01
    assert found.reliable
    assert found.k_hat < 0.7


@pytest.mark.long
def test_algorithm_2_verbatim_is_unreliable():
    """The best of policies with the start of the model: of 20 seeds all are flagged, and say why
    before any number.
    """
    q = policy_proposal(SIM, STEER, tilt_start=False)
    for seed in range(20):
        found = importance(jax.random.key(seed), SIM, q, MORE)
        assert not found.reliable
        assert found.ess < 100
        assert found.k_hat > 0.7 or found.max_share > 0.05
        assert str(found).startswith("UNRELIABLE: ") and found.failing > 100


# Disturbances of other kinds


def _boxes(s):
    z = jnp.zeros_like(s)
    return D.Joint(
        {
            "tent": D.tent(z + 0.3),
            "flat": D.Uniform(z, z + 1),
            "coin": D.Categorical(probs=jnp.stack([z + 0.9, z + 0.1])),
        }
    )


BOXES = jast.Simulator(
    lambda x0: jnp.zeros(()),
    lambda s, x: s + x["tent"] + x["flat"] + x["coin"].astype(s.dtype),
    _boxes,
    lambda s: (s > 5.2, jnp.maximum(5.2 - s, 0)),
    2,
    episodic=True,
)


def boxes_probability(h=2e-4):
    """P(two steps of tent + uniform + coin > 5.2), by convolution on a grid of midpoints."""
    u = np.arange(h / 2, 1, h)
    tent = 1 - abs(u - 0.3)
    one = np.convolve(tent / tent.sum(), np.full(len(u), 1 / len(u)))
    two = scipy.signal.fftconvolve(one, one)
    tail = lambda c: two[(np.arange(len(two)) + 2) * h > c].sum()
    return sum(scipy.stats.binom.pmf(k, 2, 0.1) * tail(5.2 - k) for k in range(3))


@pytest.mark.long
def test_bounded_disturbances(key):
    """Tent, uniform and whole numbers in one disturbance, moved within their bounds: within 4
    standard errors of a convolution.
    """
    e = jast.replay(
        BOXES, {"tent": jnp.full(2, 0.8), "flat": jnp.full(2, 0.9), "coin": jnp.ones(2, jnp.int32)}
    )
    found, truth = importance(key, BOXES, trace_proposal(BOXES, e), MORE), boxes_probability()
    assert within(found, truth), (found.mean, truth)
    assert found.reliable, (found.mean, truth)
    assert found.relative_error < 0.05 < np.sqrt(1 / truth / MORE) / 4, (found.mean, truth)


def test_a_batch_and_a_list_are_the_same_proposal():
    one, batch = (
        trace_proposal(SIM, BOTH),
        trace_proposal(SIM, jax.device_get(jax.tree.map(lambda *a: jnp.stack(a), *BOTH))),
    )
    assert jax.tree.structure(one) == jax.tree.structure(batch)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(batch), strict=True):
        np.testing.assert_array_equal(a, b)


# What must not be believed, and what must not matter


class Odd(D.Normal):
    """A unit normal whose density above ``cut`` is ``value``, and which draws nothing above
    ``most``.
    """

    def __init__(self, like, cut, value, most):
        super().__init__(jnp.zeros_like(like), jnp.ones_like(like))
        self.odd = cut, value, most

    def _sample_n(self, key, n):
        return jnp.minimum(super()._sample_n(key, n), self.odd[2])

    def log_prob(self, value):
        return jnp.where(value > self.odd[0], self.odd[1], super().log_prob(value))


def _odd_step(odd, s, t):
    return Odd(s, *odd)


def odd(cut=np.inf, value=0.0, most=np.inf):
    return Policy(
        WALK.start,
        Partial(_odd_step, tuple(jnp.asarray(v, jnp.zeros(()).dtype) for v in (cut, value, most))),
    )


@pytest.mark.slow
def test_all_of_the_model_is_plain(key):
    """epsilon = 1, or a policy that is the model: every weight is 1; standard error and effective
    sample size are the binomial ones.
    """
    t = log_weights(key, SIM, trace_proposal(SIM, BOTH, 1), LANES)
    np.testing.assert_allclose(t.log_weight, 0, atol=1e-5)
    found = importance(key, WALK, odd(), 10 * MORE)
    k, n = found.failing, found.samples
    assert found.mean == pytest.approx(k / n)
    assert found.ess == pytest.approx(k)
    assert within(found, 9.578759495e-4)
    assert found.reliable
    assert found.relative_error == pytest.approx(np.sqrt((1 - k / n) / k), rel=1e-4)
    assert found.k_hat == -np.inf


@pytest.mark.slow
def test_a_proposal_that_does_not_cover(key):
    """Steps above 2.2 cannot be drawn: flagged, though the weights look fine."""
    found = importance(key, WALK, odd(2.2, -np.inf, 2.2), 10 * MORE)
    assert not found.reliable
    assert "density 0 on" in found.warnings[0]
    assert "of the model's own episodes" in found.warnings[0]
    assert found.failing > 100


@pytest.mark.slow
def test_weights_that_are_nan(key):
    """They count for nothing, and the estimate is not to be believed; neither are infinite ones."""
    for value in (np.nan, -np.inf):
        found = importance(key, WALK, odd(2.5, value), 10 * MORE)
        assert not found.reliable
        assert any(
            "failing episodes have a weight that is NaN or infinite" in w for w in found.warnings
        )
        assert np.isfinite(found.log_mean)


@pytest.mark.slow
def test_invalid_episodes(key):
    """A step of more than 3.2 gives NaN: no failure then, as in NumPy (400,000 episodes) within 4
    of both standard errors; counted, and said.
    """
    sim = walk(step=lambda s, x: jnp.where(x > 3.2, jnp.nan, s + x))
    found = importance(key, sim, trace_proposal(sim, jast.replay(sim, jnp.full(3, 1.2))), MORE)
    x = np.random.default_rng(0).normal(size=(400_000, 6))
    above, bad = np.cumsum(x, axis=1) > 3, x > 3.2
    first = np.where(above.any(axis=1), above.argmax(axis=1), 6)
    truth = (above.any(axis=1) & ~(bad & (np.arange(6) <= first[:, None])).any(axis=1)).mean()
    assert abs(found.mean - truth) < 4 * np.hypot(np.sqrt(truth / 400_000), found.standard_error)
    assert 0 < found.invalid < MORE - found.failing
    assert any("are invalid" in w for w in found.warnings)


def test_no_failure(key):
    """A NaN, not a 0; nothing is known, so it says that and is not reliable."""
    found = importance(key, landing(50.0), trace_proposal(SIM, BOTH), MORE)
    assert np.isnan(
        [found.mean, found.log_mean, found.relative_error, found.standard_error, found.log10_mean]
    ).all()
    assert found.interval == (0.0, 1.0)
    assert not found.reliable
    assert found.failing == 0
    assert found.warnings == ("no failure was seen",)
    assert found.ess == 0
    assert found.modes is None
    assert str(found).startswith("UNRELIABLE: no failure was seen\n")
    assert "nothing is known" in str(found)


# Chunks


def test_chunks_are_those_of_log_weights(key):
    """Chunk i is ``log_weights`` of ``fold_in(key, i)``; of the last one the first episodes count;
    the answer is the mean of exp(log w) over them.
    """
    q = trace_proposal(SIM, BOTH)
    seen = []
    found = importance(
        key, SIM, q, MORE, callback=lambda done, total, _: seen.append((done, total))
    )
    own, _ = jax.random.split(key)
    parts = [
        jax.device_get(log_weights(jax.random.fold_in(own, i), SIM, q, chunk_size(MORE)))
        for i in (0, 1)
    ]
    log_w, failure, shares = (
        np.concatenate([getattr(p, f) for p in parts])[:MORE]
        for f in ("log_weight", "failure", "shares")
    )
    w = np.where(failure, np.exp(log_w.astype(float)), 0)
    assert found.mean == pytest.approx(w.mean(), rel=1e-10)
    assert found.standard_error == pytest.approx(w.std(ddof=1) / np.sqrt(MORE), rel=1e-8)
    assert found.ess == pytest.approx(w.sum() ** 2 / (w**2).sum())
    assert found.max_share == pytest.approx(w.max() / w.sum())
    assert found.failing == failure.sum()
    np.testing.assert_allclose(
        np.sort(found.modes), np.sort((w @ np.exp(shares.astype(float))) / w.sum()), rtol=1e-6
    )
    assert seen == [(chunk_size(MORE), MORE), (MORE, MORE)]
    assert str(importance(key, SIM, q, MORE)) == str(found)


def test_interrupts_keep_whole_chunks(key, capsys):
    """The first chunk is the estimate, with a word on it; before any, there is none to give."""

    def stop(done, total, _):
        raise KeyboardInterrupt

    q = trace_proposal(SIM, BOTH)
    found, first = (
        importance(key, SIM, q, MORE, callback=stop, progress=True),
        importance(key, SIM, q, chunk_size(MORE)),
    )
    assert found.samples == found.evaluations == chunk_size(MORE)
    assert found.mean == first.mean
    assert found.relative_error == first.relative_error
    assert found.warnings == (f"interrupted after {chunk_size(MORE)} of {MORE} episodes",)
    assert found.reliable
    assert "importance" in capsys.readouterr().err
    watch = Watch("importance", MORE, "episode", False, None)
    with pytest.raises(KeyboardInterrupt):
        chunks(lambda shared, i, post: stop(0, 0, None), None, LANES, watch)


# Refusals


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: trace_proposal(SIM, BOTH, 0.0), "trace_proposal: epsilon must .*received 0.0"),
        (lambda: trace_proposal(SIM, BOTH, 1.1), "trace_proposal: epsilon must be"),
        (lambda: policy_proposal(SIM, STEER, np.nan), "policy_proposal: epsilon must be"),
        (
            lambda: trace_proposal(SIM, BOTH, mixing="both"),
            "trace_proposal: mixing must .*received 'both'",
        ),
        (lambda: trace_proposal(SIM, []), "trace_proposal: episodes must be"),
        (lambda: trace_proposal(SIM, STEER), "trace_proposal: episodes must be"),
        (lambda: trace_proposal(WALK, BOTH), "x0 must be"),
        (
            lambda: policy_proposal(SIM, BOTH),
            "policy_proposal: policy must be a jast.Policy, received list",
        ),
        (
            lambda: importance(jax.random.key(0), SIM, "x"),
            "importance: proposal must .*received str",
        ),
        (
            lambda: importance(jax.random.key(0), WALK, recorded(jnp.ones(10))),
            "importance: proposal must .*received a policy that plays one value",
        ),
        (
            lambda: log_weights(jax.random.key(0), WALK, recorded(jnp.ones(10)), 5),
            "log_weights: proposal must .*received a policy that plays one value",
        ),
        (
            lambda: importance(jax.random.key(0), SIM, STEER, 1),
            "importance: samples must .*received 1",
        ),
        (
            lambda: importance(jax.random.key(0), SIM, STEER, mode="thesis"),
            "importance: mode must .*received 'thesis'",
        ),
        (
            lambda: log_weights(jax.random.key(0), SIM, STEER, 5, mode="thesis"),
            "log_weights: mode must .*received 'thesis'",
        ),
        (lambda: monte_carlo(jax.random.key(0), SIM, 0), "monte_carlo: samples must .*received 0"),
        (
            lambda: monte_carlo(jax.random.key(0), SIM, 5, level=1.0),
            "monte_carlo: level must .*received 1.0",
        ),
    ],
)
def test_bad_arguments(make, match):
    with pytest.raises(ValueError, match=match):
        make()


def test_a_bad_level_is_told_before_anything_is_simulated(key):
    seen = []
    with pytest.raises(ValueError, match="importance: level must .*received 95"):
        importance(
            key, SIM, trace_proposal(SIM, BOTH), MORE, level=95, callback=lambda *a: seen.append(a)
        )
    assert not seen


@pytest.mark.parametrize("mixing", ["step", "trace"])
def test_disturbances_that_cannot_be_moved_are_named(mixing):
    """A VonMises has no quantile function here."""
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: D.VonMises(jnp.asarray(2.0), jnp.asarray(3.0)),
        lambda s: (s > 1, 1 - s),
        2,
    )
    e = jast.replay(sim, jnp.full(2, 0.6))
    with pytest.raises(ValueError, match="trace_proposal: disturbance: .*VonMises"):
        trace_proposal(sim, e, mixing=mixing)
    with pytest.raises(ValueError, match="policy_proposal: disturbance: .*VonMises"):
        policy_proposal(sim, recorded(jnp.full(2, 0.6)), mixing=mixing)


def _beta_start():
    return D.VonMises(jnp.asarray(2.0), jnp.asarray(2.0))


def test_a_start_that_cannot_be_moved(key):
    """tilt_start=False leaves it to the model, whatever its distribution."""
    sim = walk(lambda x0: x0, start=_beta_start)
    e = jast.replay(sim, jnp.full(2, 1.5), x0=jnp.asarray(0.5))
    q = trace_proposal(sim, e, tilt_start=False)
    assert isinstance(jax.tree.map(lambda a: a[0], q.policies).start(), D.VonMises)


def test_a_start_of_one_value(key):
    """Monte Carlo asks nothing of the distributions: a start that is `Deterministic` draws what it
    draws.
    """
    sim = walk(lambda x0: x0, start=lambda: D.Deterministic(jnp.asarray(1.0)))
    found = monte_carlo(key, jast.check(sim), MORE)
    truth = walk_probability(2.0, 6, False)
    assert abs(found.mean - truth) < 4 * np.sqrt(truth / MORE)


def test_monte_carlo(key):
    """Counts, an exact interval, and the bounds of the paper also where nothing was seen."""
    found = monte_carlo(key, WALK, 10 * MORE)
    k, n = found.failing, 10 * MORE
    assert found.reliable
    assert found.mean == k / n
    assert within(found, 9.578759495e-4)
    assert found.samples == found.evaluations == n
    assert found.interval == pytest.approx(clopper_pearson(k, n), rel=1e-6)
    assert (found.jeffreys, found.chernoff) == pytest.approx(
        (jeffreys(k, n), chernoff(k, n)), rel=1e-6
    )
    none = monte_carlo(key, walk1d("one-sided", threshold=100.0), MORE, level=0.9)
    assert np.isnan(none.mean)
    assert not none.reliable
    assert none.interval[0] == 0
    assert none.chernoff == pytest.approx(-np.expm1(np.log(0.1) / MORE), rel=1e-5)
    assert "UNRELIABLE: no failure in 20000 episodes" in str(none) and "Chernoff" in str(none)


def test_a_double_loop_is_unbiased_and_as_sure_as_its_starts(key):
    """P(abs(s0) > .2) = 4.55 % is decided by the start: as many traces from fewer starts know less.
    Bounds: 4 standard errors of a share of 400 starts, and a fifth of its own spread.
    """
    sim = jast.simulators.landing(b=0.2, sigma_t=1e-6)
    policy = nominal_policy(sim)
    found = double_loop(key, sim, policy, starts=400, samples=5)
    truth = float(jast.simulators.landing_probability(b=0.2, sigma_t=1e-6))
    error = np.sqrt(truth * (1 - truth) / 400)
    assert abs(found.mean - truth) < 4 * error
    assert found.standard_error == pytest.approx(error, rel=0.5)
    assert (found.samples, found.evaluations) == (400, 2000)
    for bad, match in (
        (dict(starts=1), "starts must be a whole number of at least 2"),
        (dict(samples=20_000), "samples must be at most 16384"),
        (dict(level=2.0), "double_loop: level must be"),
    ):
        with pytest.raises(ValueError, match=match):
            double_loop(key, sim, policy, **bad)
