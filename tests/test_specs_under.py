"""jast.specs.under: simulators whose failure is the violation of a formula."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import line

import jast
from jast.distributions import Normal
from jast.simulators import autoregression
from jast.specs import (
    always,
    eventually,
    goes_on,
    implies,
    parts,
    predicate,
    robustness,
    trace_of,
    under,
)
from tests.blackboxes import Walk

S = jast.search
HORIZON = 8


def gusts(level=0.0, horizon=HORIZON, **changes):
    """Each state is its gust, N(0, 1); the first is 0. It never fails by itself."""
    given = dict(
        step=lambda s, x: x + 0 * s,
        evaluate=lambda s: (jnp.zeros((), bool), jnp.ones(())),
        horizon=horizon,
    )
    return line(**given | changes)


def high(level):
    return predicate(lambda s: s - level, f"x > {level:g}")


CALM = always(eventually(high(-1.0), 0, 2), 0, HORIZON - 2)
"""Violated by three gusts below -1 in a row."""
FORMULAS = {
    "always": always(high(-2.5)),
    "recurrence": CALM,
    "response": always(implies(~high(-1.5), eventually(high(0.5), 1, 2)), 0, HORIZON - 2),
    "eventually": eventually(always(high(0.2), 0, 1), 0, 5),
    "either": eventually(high(1.5), 0, 4) | ~eventually(high(1.5), 5, 8),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMULAS)
def test_an_episode_ends_where_the_violation_is_certain(name, key):
    """Against the whole trace, drawn by the system alone; and the bound of all shorter ones."""
    formula = FORMULAS[name]
    sim = jast.check(under(gusts(), formula))
    x = jax.random.normal(key, (200, HORIZON))
    assert sim.episodic == (name != "always")
    episode = jax.jit(jax.vmap(lambda x: jast.replay(sim, x)))(x)
    trace = jnp.concatenate([jnp.zeros((200, 1)), x], axis=1)
    whole = jax.vmap(lambda t: robustness(formula, t, 1.0))(trace)
    np.testing.assert_array_equal(episode.failure, whole < 0)
    assert 0 < int(episode.failure.sum()) < 200
    np.testing.assert_array_equal(episode.distance, np.maximum(whole, 0))
    for n in range(1, HORIZON + 2):
        bound = jax.vmap(lambda t, n=n: robustness(formula, t[:n], 1.0, goes_on=True))(trace)
        ended = np.asarray(episode.failure & (episode.length < n))
        if n <= HORIZON:
            np.testing.assert_array_equal(ended, bound < 0)


def test_always_of_a_predicate_is_the_system_that_one_writes_by_hand(key):
    sim = autoregression(threshold=2.0, horizon=30)
    watched = under(sim, always(predicate(lambda s: 2.0 - s, "s < 2")))
    keys = jax.random.split(key, 50)
    one, two = (jax.vmap(lambda k, s=s: jast.rollout(k, s))(keys) for s in (sim, watched))
    np.testing.assert_array_equal(one.failure, two.failure)
    np.testing.assert_array_equal(one.length, two.length)
    np.testing.assert_allclose(one.distance, two.distance, atol=1e-6)
    assert 0 < int(one.failure.sum()) < 50


SEARCHES = {
    "monte_carlo": lambda key, sim: S.monte_carlo(key, sim, episodes=500),
    "cem": lambda key, sim: S.cem(key, sim, samples=50, elites=10, iterations=4),
    "forest": lambda key, sim: S.forest(key, sim, trees=4, prunes=2, simulations=40),
    "mcts": lambda key, sim: S.mcts(key, sim, simulations=300),
    "stress": lambda key, sim: jast.stress(key, sim, 1500),
}


LONG = ("forest", "stress")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long) if n in LONG else n for n in SEARCHES]
)
def test_what_a_search_finds_violates_the_whole_trace(name, key):
    sim = under(gusts(), CALM)
    found = SEARCHES[name](key, sim).failures
    assert len(found)
    for episode in list(found)[:5]:
        again = jast.replay(sim, episode)
        assert bool(again.failure) and float(again.distance) == 0
        rest = jast.replay(gusts(), jnp.asarray(episode.disturbances))
        assert float(robustness(CALM, rest.states, 1.0)) < 0
        rows = parts(CALM, trace_of(again), 1.0, goes_on=True).rows
        assert rows[0].value < 0 and rows[-1].value < 0


def runs(p, first, length, n):
    """P(``length`` low samples in a row among ``n`` + 1, each low with probability ``p``, the first
    as given): a Markov chain of the present run.
    """
    state = np.zeros(length + 1)
    state[int(first)] = 1
    for _ in range(n):
        moved = np.zeros(length + 1)
        moved[0] = (1 - p) * state[:length].sum()
        moved[1:] = p * state[:length]
        moved[length] += state[length]
        state = moved
    return state[length]


def test_the_probability_is_that_of_a_markov_chain(key):
    """4 standard errors of the count."""
    p = math.erfc(1 / math.sqrt(2)) / 2
    truth, n = runs(p, False, 3, HORIZON), 4000
    found = jast.estimate.monte_carlo(key, under(gusts(), CALM), n)
    assert abs(float(found.mean) - truth) < 4 * math.sqrt(truth * (1 - truth) / n)


@pytest.mark.long
def test_a_rare_violation_is_estimated(key):
    """Four gusts below -1.5 in a row within 20."""
    formula = always(eventually(high(-1.5), 0, 3), 0, 17)
    truth = runs(math.erfc(1.5 / math.sqrt(2)) / 2, False, 4, 20)
    found = jast.estimate.failure_probability(key, under(gusts(horizon=20), formula), 50_000)
    assert found.interval[0] / 1.2 < truth < found.interval[1] * 1.2


def test_the_distance_has_a_gradient(key):
    sim = under(gusts(), CALM)
    x = jax.random.normal(key, (HORIZON,))
    slope = jax.grad(lambda x: jast.replay(sim, x).distance)(x)
    trace = lambda x: jnp.concatenate([jnp.zeros(1), x])
    expected = jax.grad(lambda x: robustness(CALM, trace(x), 1.0))(x)
    np.testing.assert_array_equal(slope, expected)


class Free(Walk):
    """`Walk` without an end of its own."""

    def is_terminal(self):
        return False


@pytest.mark.slow
def test_a_black_box_takes_a_formula(key):
    """It must be back above -1 within two steps; its own failure plays no part."""
    box = jast.blackbox.from_python(Free, horizon=6, disturbance=Normal(0.0, 1.0))
    back = lambda height: always(eventually(predicate(height, "s > -1"), 0, 2), 0, 4)
    sim = under(box, back(lambda s: s.seen[0] + 1))
    found = S.monte_carlo(key, sim, episodes=60)
    assert 0 < found.failing < 60
    for episode in found.failures:
        gone = episode.disturbances[: int(episode.length)]
        trace = np.cumsum(np.concatenate([[0.0], gone])).astype(np.float32)
        assert float(robustness(back(lambda s: s + 1), trace, 1.0, goes_on=True)) < 0


@pytest.mark.slow
def test_steps_of_several_samples(key):
    """Two gusts a step, a sample each: as one gust a step."""
    two = jast.Simulator(
        init=lambda x0: jnp.zeros(2),
        step=lambda s, x: x + 0 * s,
        disturbance=lambda s: jast.distributions.MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)),
        evaluate=lambda s: (jnp.zeros((), bool), jnp.ones(())),
        horizon=HORIZON // 2,
    )
    x = jax.random.normal(key, (100, HORIZON))
    for name in ("always", "recurrence", "response"):
        one = under(gusts(), FORMULAS[name])
        pair = under(two, FORMULAS[name], samples=lambda s: s)
        a = jax.vmap(lambda x, sim=one: jast.replay(sim, x))(x)
        b = jax.vmap(lambda x, sim=pair: jast.replay(sim, x))(x.reshape(100, -1, 2))
        np.testing.assert_array_equal(a.failure, b.failure)
        np.testing.assert_array_equal(a.distance, b.distance)
        np.testing.assert_array_equal((a.length + 1) // 2, b.length)
    episode = jast.replay(pair, x[0].reshape(-1, 2))
    n = 1 + 2 * int(episode.length)
    trace = np.concatenate([[0], x[0]])[:n]
    np.testing.assert_array_equal(trace_of(episode, samples=lambda s: s), trace)


def test_a_system_that_ends_early_has_a_shorter_trace():
    """It ends above 3: windows are clipped there."""
    sim = gusts(is_terminal=lambda s: s > 3)
    x = jnp.array([-2.0, 4.0, 0, 0, 0, 0, 0, 0])
    low, end = always(high(-5.0), 4, 6), eventually(high(5.0), 0, 6)
    for formula, event, distance in [(low, False, 1e19), (end, True, 0)]:
        e = jast.replay(under(sim, formula), x)
        assert (int(e.length), bool(e.failure)) == (2, event)
        assert float(e.distance) >= distance and not goes_on(e)
    calm = under(sim, always(high(-1.0), 0, 6))
    certain, whole = jast.replay(calm, x), jast.replay(calm, 0 * x)
    assert goes_on(certain)
    assert int(certain.length) == 1
    assert not goes_on(whole)
    with pytest.raises(ValueError, match="goes_on: episode must be a jast.replay"):
        goes_on(jast.replay(sim, x))


def test_the_parts_of_an_episode_that_ended_before_a_window_began():
    """It ends at 2 s, so nothing of what is inside of a window from 4 s on was asked."""
    sim = gusts(is_terminal=lambda s: s > 3)
    late, never = always(high(-5.0), 4, 6), eventually(high(-5.0), 4, 6)
    for formula, most in [(late, np.inf), (never, -np.inf), (high(1.0) & late, -1.0)]:
        e = jast.replay(under(sim, formula), jnp.array([-2.0, 4.0, 0, 0, 0, 0, 0, 0]))
        found = parts(formula, trace_of(e), 1.0, goes_on=goes_on(e))
        assert found.rows[0].value == e.states.robustness[int(e.length)] == most
        assert found.rows[0].held == (not e.failure)
        assert math.isnan(found.rows[-1].time) and str(found).splitlines()[-1].endswith("-")


def test_numbers_that_are_none_make_an_episode_invalid():
    root = predicate(lambda s: jnp.sqrt(s + 1), "root")
    for formula in (always(root), eventually(root)):
        e = jast.replay(under(gusts(), formula), jnp.array([-2.0] + [0.0] * 7))
        assert not e.failure and e.distance == np.inf


@pytest.mark.parametrize(
    "formula, said",
    [
        (always(high(0), 0, 9), r"under: always\[0, 9\] \(x > 0\): the window is longer"),
        (
            always(always(high(0), 5), 0, 8),
            r"under: always\[5, end\] \(x > 0\): the formula around",
        ),
        (always(predicate(lambda s: s.gap, "gap")), "under: gap: the predicate raised Attrib"),
        (always(predicate(lambda s: s > 0, "b")), "under: b: .*received bool"),
        ("always", "under: formula must be"),
    ],
)
def test_errors_name_the_part(formula, said):
    with pytest.raises(ValueError, match=said):
        under(gusts(), formula)


def test_other_errors():
    with pytest.raises(ValueError, match="under: dt"):
        under(gusts(), CALM, dt=-1.0)
    with pytest.raises(ValueError, match="under: samples must return"):
        under(gusts(), CALM, samples=lambda s: s)
    with pytest.raises(ValueError, match="under: samples must be"):
        under(gusts(), CALM, samples=3)
    with pytest.raises(ValueError, match="trace_of: episode"):
        trace_of(jast.replay(gusts(), jnp.zeros(HORIZON)))
