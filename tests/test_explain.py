"""jast.explain: planted causes are found, closed forms are met, sums are what they must be."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from systems import line

import jast
from benchmarks.stress_systems import slips
from jast import distributions as D
from jast import explain
from jast._src.search.refine.modes import Mode
from jast.distributions import Joint, Normal, Uniform


def sums(weights, limit, **changes):
    """Fails where the weighted sum of the steps' disturbances reaches the limit, at the end."""
    weights = jnp.asarray(weights)
    horizon = len(weights)

    def step(s, x):
        total, t = s
        return total + weights[t] * x, t + 1

    given = dict(
        init=lambda x0: (jnp.zeros(()), jnp.zeros((), jnp.int32)),
        step=step,
        disturbance=lambda s: Normal(0.0, 1.0),
        evaluate=lambda s: (s[0] >= limit, jnp.maximum(limit - s[0], 0.0)),
        horizon=horizon,
        episodic=True,
    )
    return jast.Simulator(**given | changes)


def planted(steps, length=50):
    """Fails where the gusts at ``steps`` are above 1 each, and 6 together; others do nothing."""
    weights = np.zeros(length)
    weights[steps] = 1.0
    return sums(weights, 6.0)


@pytest.mark.slow
def test_minimal_finds_the_planted_steps(key):
    steps = [6, 7, 30]
    sim = planted(steps)
    for seed in range(5):
        x = jax.random.normal(jax.random.key(seed), 50).at[jnp.array(steps)].set(2.5)
        m = explain.minimal(sim, jast.replay(sim, x))
        assert np.flatnonzero(m.needed).tolist() == steps and m.needed.shape == (50,)
        # the smallest that fail: 6 in all, each hardly larger than it was
        values = np.asarray(m.episode.disturbances)
        assert values.sum() == pytest.approx(6, abs=0.02) and (values <= 1.1 * 2.5 + 1e-6).all()
        assert bool(jast.replay(sim, m.episode).failure) and m.numbers == 50
    assert "3 of 50 disturbances are needed: steps 7 to 8, 31" in str(m)


def test_minimal_spares_what_another_order_needs():
    """One great gust or eight small ones: the great one alone is enough, though the small ones are
    put back first in the order of size.
    """
    sim = sums(np.ones(9), 4.0)
    m = explain.minimal(sim, jast.replay(sim, jnp.array([0.5] * 8 + [4.1])))
    assert np.flatnonzero(m.needed).tolist() == [8]


@pytest.mark.slow
def test_minimal_of_choices():
    sim = slips()
    x = jnp.array([0, 2, 0, 2, 1, 1, 1], jnp.int32)
    m = explain.minimal(sim, jast.replay(sim, x))
    assert [(step, value) for step, _, value, _ in m.parts] == [(5, 1), (6, 1), (7, 1)]


def test_minimal_of_a_black_box_counts_its_calls():
    calls = []

    def run(x):
        calls.append(1)
        near = 3.0 - float(x["gust"][2])
        return near <= 0, max(near, 0.0)

    sim = jast.blackbox.from_python(
        run, horizon=4, disturbance=Joint(dict(gust=Normal(0.0, 1.0), noise=Normal(0.0, 0.1)))
    )
    x = dict(gust=jnp.array([0.5, -1.0, 3.5, 0.2]), noise=jnp.full(4, 0.1))
    e = jast.replay(sim, x)
    calls.clear()
    m = explain.minimal(sim, e, orders=1)
    assert [(step, name) for step, name, *_ in m.parts] == [(3, "gust")]
    assert float(m.episode.disturbances["gust"][2]) == pytest.approx(3, abs=0.01)
    # of points that come by more than once one is run; the answer is played, replayed and checked
    assert m.evaluations - 20 < len(calls) <= m.evaluations + 3


def test_minimal_tells_what_was_tried_from_what_was_not():
    """Where the budget of a black box ends, what it was not asked about is not called needed."""

    def run(x):
        near = 4.6 - float(x[2]) - float(x[5])
        return near <= 0, max(near, 0.0)

    sim = jast.blackbox.from_python(run, horizon=10, disturbance=Normal(0.0, 1.0))
    x = jnp.full(10, 0.3).at[jnp.array([2, 5, 7])].set(jnp.array([2.5, 2.2, 1.0]))
    e = jast.replay(sim, x)
    few, more, all_ = (explain.minimal(sim, e, budget=b) for b in (10, 14, 500))
    # the smallest go first, and what is left is not known to be needed
    assert [part[0] for part in few.parts] == [3, 6, 8, 9, 10] and few.untried == (0, 1, 2, 3, 4)
    assert str(few).startswith("0 of 10 disturbances are needed: none\n5 of 10 disturbances are")
    assert [more.parts[i][0] for i in more.untried] == [3] and not more.complete
    assert "1 of 10 disturbances is perhaps needed, not tried: step 3\n" in str(more)
    assert [part[0] for part in all_.parts] == [3, 6] and all_.untried == () and all_.complete
    assert "perhaps" not in str(all_)


@pytest.mark.parametrize("hosted", [False, True])
def test_long_explanations_have_a_bar(key, capsys, hosted):
    sim = sums(np.ones(4), 3.0)
    if hosted:
        run = lambda x: (float(x.sum()) >= 3.0, max(3.0 - float(x.sum()), 0.0))
        sim = jast.blackbox.from_python(run, horizon=4, disturbance=Normal(0.0, 1.0))
    e = jast.replay(sim, jnp.ones(4))
    for name, call in [
        ("minimal", lambda **bar: explain.minimal(sim, e, budget=100, **bar)),
        ("criticality", lambda **bar: explain.criticality(key, sim, e, draws=20, **bar)),
        ("attribution", lambda **bar: explain.attribution(sim, e, permutations=4, **bar)),
    ]:
        quiet = str(call())
        assert capsys.readouterr().err == ""
        assert str(call(progress=True)) == quiet
        said = capsys.readouterr().err
        assert f"{name}: compiling" in said and f"{name}: 100%" in said


def test_criticality_of_a_walk(key):
    """P(fail | s_t) = Phi((s_t - limit) / sqrt(T - t)), within 4 standard errors of 2000 draws at
    every step; the last step decides.
    """
    x = jnp.array([0.5, 1.0, -0.5, 2.0, 1.5])
    sim = sums(np.ones(5), 4.0)
    c = explain.criticality(key, sim, jast.replay(sim, x), draws=2000)
    sums_so_far = np.concatenate([[0.0], np.cumsum(x)])
    truth = np.array(
        [math.erfc((4 - s) / math.sqrt(2 * (5 - t))) / 2 for t, s in enumerate(sums_so_far[:-1])]
        + [1.0]
    )
    error = np.sqrt(truth * (1 - truth) / 2000)
    assert (np.abs(c.probability - truth) <= 4 * error + 1e-9).all()
    assert c.point_of_no_return == 5 and c.steepest == int(np.argmax(np.diff(truth))) + 1
    assert c.last_below_half == int(np.flatnonzero(truth < 0.5)[-1])
    assert c.evaluations >= 6 * 2000 and "raised it most" in str(c)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["shapley", "integrated", "gradient"])
def test_attribution_of_a_sum(method):
    """A linear system: every number has its own share, whatever the method."""
    weights = np.array([0.5, 0.0, 2.0, 1.0])
    x = np.array([1.0, 3.0, 1.5, -0.5])
    sim = sums(weights, 2.5)
    a = explain.attribution(sim, jast.replay(sim, jnp.asarray(x)), method, permutations=40)
    if method == "gradient":
        np.testing.assert_allclose(a.values, weights * np.sign(x), atol=1e-4)
        return
    # beyond the limit the distance is flat, so that what is left of the sum is shared
    assert a.total == pytest.approx(2.5, abs=1e-5)
    left_out = 1e-5 if method == "shapley" else 0.05
    assert np.asarray(a.values).sum() == pytest.approx(2.5, abs=left_out)
    assert a.parts[0][0] == 3 and a.values[1] == pytest.approx(0, abs=1e-6)


def test_shapley_values_of_two_that_need_one_another():
    """Both of two gusts are needed: each has half, with no error; one that does nothing has 0."""

    def evaluate(s):
        both = jnp.minimum(s[0], s[2])
        return both >= 1, jnp.maximum(1 - both, 0.0)

    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(3),
        step=lambda s, x: jnp.concatenate([s[1:], x[None]]),
        disturbance=lambda s: Normal(0.0, 1.0),
        evaluate=evaluate,
        horizon=3,
        episodic=True,
    )
    a = explain.attribution(sim, jast.replay(sim, jnp.array([1.5, 1.5, 1.5])), permutations=10)
    np.testing.assert_allclose(a.values, [0.5, 0, 0.5], atol=1e-6)
    np.testing.assert_allclose(a.error, 0, atol=1e-6)
    assert abs(a.residual) < 1e-6 and "50.0%" in str(a)


def walk(below):
    """Of two steps; fails beyond 5, and where ``below`` is given, below minus that, at the end."""

    def evaluate(s):
        near = jnp.maximum(5.0 - s, 0.0)
        if below is not None:
            near = jnp.minimum(near, jnp.maximum(s + below, 0.0))
        return near <= 0, near

    return line(evaluate=evaluate, horizon=2, episodic=True)


@pytest.mark.slow
def test_a_regression_is_where_the_new_version_alone_fails():
    both = explain.regression(walk(None), walk(4.0))
    for x, expected in (([-2.0, -2.5], True), ([3.0, 2.5], False), ([0.0, 1.0], False)):
        e = jast.replay(both, jnp.array(x))
        assert bool(e.failure) == expected
        assert (float(e.distance) == 0) == expected and float(e.distance) >= 0
    jast.check(both)


@pytest.mark.parametrize("disturbance", [Normal(0.0, 1.0), None], ids=["normal", "seeds"])
def test_functions_in_python_that_both_fail_are_valid(key, disturbance):
    def version(limit):
        return jast.blackbox.from_python(
            lambda x: (bool(x.sum() > limit), float(max(limit - x.sum(), 0.0))),
            horizon=2,
            disturbance=disturbance,
        )

    sims = (version(1.0), version(0.5)) if disturbance else (version(2.0**32), version(2.0**31))
    both = explain.regression(*sims)
    e = jast.replay(both, jnp.full(2, 2**31 + 1, jnp.uint32 if disturbance is None else float))
    assert not bool(e.failure) and 0 < float(e.distance) < np.inf
    found = jast.nominal(key, both, episodes=50)
    assert found.invalid == 0 and found.failing > 0


@pytest.mark.long
def test_the_likeliest_regression_and_its_probability(key):
    """P = Phi(-4.7534) = 1e-6 on the branch that regressed; the likeliest costs 4.7534^2 / 2. The
    failures that both versions share are likelier and must not count.
    """
    below = 4.753424 * math.sqrt(2)
    report = explain.differential(key, walk(None), walk(below), 60_000)
    assert float(report.failures.best.reward) == pytest.approx(-(4.753424**2) / 2, abs=0.1)
    p = report.probability
    assert p.reliable and abs(p.mean / 1e-6 - 1) < 4 * p.relative_error
    for e in report.failures:
        assert bool(jast.replay(walk(below), e.disturbances).failure)
        assert not bool(jast.replay(walk(None), e.disturbances).failure)


@pytest.mark.slow
def test_sensitivity_of_the_landing(key):
    """The derivatives of 2 Phi(-b / sqrt(si^2 + 10 st^2)) to both, within 4 standard errors."""
    sim = jast.simulators.landing()
    found = explain.sensitivity(sim, jast.estimate.failure_probability(key, sim, 20_000))
    spread = math.sqrt(0.1**2 + 10 * 0.03**2)
    beta = 1 / spread
    hazard = math.exp(-(beta**2) / 2) / math.sqrt(2 * math.pi) / (math.erfc(beta / 2**0.5) / 2)
    truth = {
        "start[0]": hazard * beta * 0.1 / spread**2,
        "disturbance[0]": hazard * beta * 10 * 0.03 / spread**2,
    }
    assert {name for name, *_ in found.rows} == truth.keys() and found.reliable
    for name, value, slope, error, (low, high) in found.rows:
        assert abs(slope - truth[name]) < 4 * error and error < 0.02 * slope
        assert low < slope < high and value in (pytest.approx(0.1), pytest.approx(0.03))
    assert "elasticity" in str(found)


@pytest.mark.slow
def test_sensitivity_of_a_long_system(key):
    """Thirty steps are drawn by tilts: of a sum of normals P = Phi(-limit / (s sqrt(30))), so that
    d log P / d s is hazard * beta / s. Within 4 standard errors.
    """
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x,
        disturbance=Partial(lambda spread, s: Normal(jnp.zeros_like(s), spread), jnp.asarray(1.0)),
        evaluate=lambda s: (s >= 20.0, jnp.maximum(20.0 - s, 0.0)),
        horizon=30,
        episodic=True,
    )
    found = explain.sensitivity(sim, jast.estimate.failure_probability(key, sim, 20_000))
    beta = 20 / math.sqrt(30)
    hazard = math.exp(-(beta**2) / 2) / math.sqrt(2 * math.pi) / (math.erfc(beta / 2**0.5) / 2)
    ((_, _, slope, error, _),) = found.rows
    assert abs(slope - hazard * beta) < 4 * error and error < 0.05 * slope


@pytest.mark.slow
def test_bad_input(key):
    sim = sums(np.ones(3), 4.0)
    failing = jast.replay(sim, jnp.full(3, 2.0))
    with pytest.raises(ValueError, match="minimal: episode must fail"):
        explain.minimal(sim, jast.replay(sim, jnp.zeros(3)))
    with pytest.raises(ValueError, match="minimal: episode must be a jast.Episode"):
        explain.minimal(sim, jnp.zeros(3))
    with pytest.raises(ValueError, match="one episode, received a batch"):
        explain.minimal(sim, jax.tree.map(lambda a: a[None], failing))
    with pytest.raises(ValueError, match="attribution: method"):
        explain.attribution(sim, failing, "lime")
    with pytest.raises(ValueError, match="criticality: draws"):
        explain.criticality(key, sim, failing, draws=0)
    with pytest.raises(ValueError, match="regression: sim must be"):
        explain.regression(walk(4.0), None)
    with pytest.raises(ValueError, match="regression: disturbance"):
        explain.regression(sim, slips())
    with pytest.raises(ValueError, match="sensitivity: estimate"):
        explain.sensitivity(sim, jast.estimate.monte_carlo(key, sim, 1000))
    with pytest.raises(ValueError, match="received functions without parameters"):
        explain.sensitivity(sim, jast.estimate.failure_probability(key, sim, 50))
    flat = sums(np.ones(3), 4.0, evaluate=lambda s: (s[0] >= 4, jnp.where(s[0] >= 4, 0.0, 1.0)))
    with pytest.raises(ValueError, match="no finite gradient"):
        explain.attribution(flat, failing, "integrated")


def test_a_random_start_is_told_apart(key):
    """A start that alone leads to the failure: step 0."""
    sim = sums(
        np.ones(3),
        4.0,
        init=lambda x0: (x0, jnp.zeros((), jnp.int32)),
        start=Partial(lambda high: Uniform(0.0, high), jnp.asarray(5.0)),
    )
    e = jast.replay(sim, jnp.array([0.1, -0.2, 0.1]), jnp.asarray(4.9))
    m = explain.minimal(sim, e)
    assert [(step, name) for step, name, *_ in m.parts] == [(0, "x0")]
    assert bool(m.needed_start) and not m.needed.any()


def test_cards_of_modes(key):
    """A small budget leaves criticality out."""
    sim = planted([2, 4], 8)
    x = jnp.zeros(8).at[jnp.array([2, 4])].set(3.5)
    one = Mode(jast.replay(sim, x), 1, 1.0)
    ((m, c),) = explain.cards(key, sim, [one], 4000)
    assert m.needed.sum() == 2 and c.draws == 2000 // 9
    ((alone,),) = explain.cards(key, sim, [one], 200)
    assert alone.needed.sum() == 2
    assert explain.cards(key, sim, []) == []


@pytest.mark.slow
def test_a_failure_at_the_edge_is_explained(key):
    """The way to normal numbers and back may round it to the other side."""
    law = Uniform(0.0, 1.0)
    x = np.linspace(0.6, 0.9, 500, dtype=np.float32)
    there_and_back = jax.vmap(lambda a: D.from_normal(law, D.to_normal(law, a)))(x)
    edge = x[np.flatnonzero(np.asarray(there_and_back) < x)[0]]
    sim = jast.Simulator(
        init=lambda x0: jnp.float32(0),
        step=lambda s, x: jnp.maximum(s, x),
        disturbance=lambda s: Uniform(jnp.float32(0), jnp.float32(1)),
        evaluate=lambda s: (s >= edge, jnp.maximum(edge - s, 0)),
        horizon=2,
    )
    below = jnp.asarray([0.1, np.nextafter(edge, np.float32(0))], jnp.float32)
    failing = jast.replay(sim, jnp.asarray([0.1, edge], jnp.float32))
    assert bool(failing.failure) and not bool(jast.replay(sim, below).failure)
    assert np.asarray(explain.minimal(sim, failing).needed).tolist() == [False, True]
    with pytest.raises(ValueError, match="must fail when it is replayed"):
        explain.minimal(sim, jast.replay(sim, below))


@pytest.mark.slow
def test_a_failure_at_its_far_edge_is_explained():
    """There it fails again a little nearer to the mode."""
    law = Uniform(0.0, 1.0)
    x = np.linspace(0.6, 0.9, 500, dtype=np.float32)
    there_and_back = jax.vmap(lambda a: D.from_normal(law, D.to_normal(law, a)))(x)
    edge = x[np.flatnonzero(np.asarray(there_and_back) > x)[0]]
    sim = jast.Simulator(
        init=lambda x0: jnp.float32(0),
        step=lambda s, x: jnp.maximum(s, x),
        disturbance=lambda s: Uniform(jnp.float32(0), jnp.float32(1)),
        evaluate=lambda s: ((s >= 0.55) & (s <= edge), jnp.where(s < 0.55, 0.55 - s, s)),
        horizon=2,
    )
    failing = jast.replay(sim, jnp.asarray([0.1, edge], jnp.float32))
    assert bool(failing.failure)
    assert np.asarray(explain.minimal(sim, failing).needed).tolist() == [False, True]
