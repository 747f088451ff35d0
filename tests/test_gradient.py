"""Multistart by gradients: it ends at the likeliest failures of systems in closed form, and says so
where there is nothing to follow.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import archive_replays

import jast
from benchmarks import stress_systems
from jast import rewards
from jast._src.search.gradient import gradient
from jast.distributions import Normal

RELATIVE = rewards.standard(density="mode")
SMALL = dict(starts=16, refine=0.5)
BRANCHES = stress_systems.branches(3.0)
STEPS = dict(starts=8, refine=0)


def test_ends_at_the_likeliest_failures(key, equal):
    """Four branches; the nearest is three deviations away."""
    r = gradient(key, BRANCHES, **SMALL)
    assert archive_replays(BRANCHES, r, RELATIVE, equal)
    assert r.best.reward == pytest.approx(-4.5, abs=1e-3)
    assert r.settings["useful_gradients"] > 0.8 and r.settings["method"] == "gradient"
    assert r.episodes == 1920 == r.history.simulations[-1] and 1920 < r.evaluations <= 2880
    assert len({tuple(np.sign(e.disturbances[0]).astype(int)) for e in r.failures}) > 1


@pytest.mark.long
def test_counts_of_the_descents(key):
    """Each episode has one step: 12 gradients, at 4 each, and 12 x 6 more."""
    r = gradient(key, BRANCHES, **STEPS)
    assert r.episodes == r.steps == 8 * (48 + 72) and 0 < r.failing < r.episodes
    assert r.first_failure <= 8 * 10 and r.failures.size >= 2


@pytest.mark.long
def test_a_linear_system(key, equal):
    case = stress_systems.CASES["linear-50-two"]
    r = gradient(key, case.make(), starts=16, refine=2.0)
    assert archive_replays(case.make(), r, RELATIVE, equal)
    assert case.optimum - 0.01 < r.best.reward <= case.optimum + 1e-3
    assert len({float(np.sign(e.disturbances.sum())) for e in r.failures}) == 2


@pytest.mark.long
def test_a_random_start(key, equal):
    """The last distance alone counts; the optimum in closed form: two modes, -1 / (2 x .019)."""
    sim = jast.simulators.landing()
    r = gradient(key, sim, **SMALL)
    assert archive_replays(sim, r, RELATIVE, equal)
    assert r.best.reward == pytest.approx(-0.5 / 0.019, abs=0.01)


def test_a_flat_distance_gives_no_failure_and_says_why(key):
    sim = stress_systems.latch(10)
    r = gradient(key, sim, **SMALL)
    assert not r.failing
    assert r.failures.size == 0
    assert r.first_failure is None
    assert r.settings["useful_gradients"] == 0
    assert not r.best.failure
    assert r.best.distance == 1
    assert r.episodes == 1920
    # the episode that came nearest has the reward of the search, wherever it is told
    nearest = jast.replay(sim, r.best, reward=RELATIVE).reward
    assert float(r.best.reward) == pytest.approx(float(nearest), rel=1e-6)
    assert float(r.best_reward_per_tree[0]) == float(r.best.reward)


def test_nan_is_counted_and_never_best(key):
    broken = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: Normal(0.0, 1.0),
        lambda s: (s >= 3, jnp.where(s > 1, jnp.nan, 3 - s)),
        2,
    )
    r = gradient(key, broken, **STEPS)
    assert r.invalid
    assert not r.failing
    assert 2 <= r.best.distance < 4


@pytest.mark.long
def test_the_same_key_gives_the_same_and_is_watched(key, equal):
    seen = []
    a = gradient(key, BRANCHES, **SMALL, top=2)
    b = gradient(key, BRANCHES, **SMALL, top=2, callback=lambda *three: seen.append(three))
    equal(a.failures, b.failures)
    assert len(a.failures) == 2 and seen == [(1920, 1920, None)]


@pytest.mark.parametrize(
    "bad, words",
    [
        (dict(starts=0), "gradient: starts must be a whole number"),
        (dict(top=0), "gradient: top must be a whole number"),
        (dict(refine=-1), "gradient: refine must be a number of at least 0"),
    ],
)
def test_bad_settings(key, bad, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        gradient(key, BRANCHES, **bad)


def test_bad_systems(key):
    run = lambda x: (False, 1.0)
    host = jast.blackbox.from_python(run, horizon=3, disturbance=Normal(0.0, 1.0))
    with pytest.raises(ValueError, match="gradient: sim runs on the host and has no gradients"):
        gradient(key, host)
    with pytest.raises(ValueError, match="gradient: cannot be traced"):
        jax.jit(lambda key: gradient(key, BRANCHES, starts=2).steps)(key)
