"""Go-Explore: it finds what whole episodes do not, its failures replay, and its counts are of new
steps alone.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import archive_replays
from systems import ring
from trees import large_copies

import jast
from benchmarks import stress_systems
from jast import rewards
from jast._src.core.counter_prng import tree_keys
from jast._src.search.best_episodes import BestEpisodes, standard_reward
from jast._src.search.go_explore.archive import empty_cells, features
from jast._src.search.go_explore.go_explore import go_explore
from jast._src.search.go_explore.phases import Plan, explore
from jast._src.search.monte_carlo import monte_carlo
from jast.distributions import Normal, seeds

RELATIVE = rewards.standard(density="mode")


def climb(steps=24):
    """Fails on the eighth stair, each of which takes a push above 1.2; one below falls back."""
    return jast.Simulator(_ground, _stair, _push, _height, steps)


def _ground(x0):
    return jnp.int32(0)


def _stair(s, x):
    return jnp.where(x > 1.2, s + 1, jnp.maximum(s - 1, 0))


def _push(s):
    return Normal(0.0, 1.0)


def _height(s):
    return s >= 8, jnp.maximum(8 - s, 0).astype(float)


SMALL = dict(episodes=1500, refine=0)


def test_finds_a_sparse_failure_that_chance_does_not(key, equal):
    """At equal steps; the likeliest is 1.88 four times."""
    sim = stress_systems.latch()
    r = go_explore(key, sim, **SMALL)
    plain = monte_carlo(key, sim, episodes=-(-r.steps // sim.horizon))
    assert r.failing_per_tree.all() and not plain.failing_per_tree.any()
    assert archive_replays(sim, r, RELATIVE, equal) == 64
    assert -9 < r.best.reward <= -2 * 1.88**2 and r.best.length >= 4
    assert r.settings["method"] == "go_explore" and r.settings["length"] == 7
    assert r.episodes == r.history.simulations[-1] == 1500


@pytest.mark.long
def test_steps_are_those_that_are_new(key):
    """A run takes at most ``length`` of them, and without the second phase nothing else is
    simulated.
    """
    sim = climb()
    r = go_explore(key, sim, **SMALL, backward=0.0)
    assert r.steps <= 4500 and r.best.length > 3


@pytest.mark.long
def test_the_second_phase_makes_failures_likelier(key):
    sim = climb()
    first, both = (go_explore(key, sim, **SMALL, backward=b) for b in (0.0, 0.5))
    assert both.best.reward > first.best.reward + 0.2
    assert -0.5 * 8 * 1.2**2 > both.best.reward > -0.5 * 8 * 1.2**2 - 5


@pytest.mark.long
@pytest.mark.parametrize("make", [stress_systems.slips, jast.simulators.landing])
def test_kinds_of_disturbances(key, equal, make):
    """Whole-numbered disturbances, random starts, episodic systems."""
    sim = make()
    r = go_explore(key, sim, episodes=4000, refine=0)
    assert r.failing_per_tree.all() and archive_replays(sim, r, standard_reward(sim), equal)


@pytest.mark.long
def test_joint_disturbances(key, equal):
    test_kinds_of_disturbances(key, equal, ring)


@pytest.mark.long
def test_seeds_of_unknown_density(key, equal):
    """Six seeds must fall into their own quarter one after another."""
    sim = jast.Simulator(
        lambda x0: jnp.int32(0),
        lambda s, x: jnp.where((x >> 30) == (s % 4).astype(jnp.uint32), s + 1, 0),
        lambda s: seeds(),
        lambda s: (s >= 6, jnp.where(s >= 6, 0.0, 1.0)),
        30,
    )
    r = go_explore(key, sim, **SMALL)
    assert archive_replays(sim, r, rewards.standard(), equal)


@pytest.mark.long
def test_cells_of_the_user(key):
    sim = stress_systems.latch()
    r = go_explore(key, sim, **SMALL, cell=lambda run: run)
    assert r.failing_per_tree.all()
    words = "go_explore: cell raised ValueError on a state: no"

    def refuse(state):
        raise ValueError("no")

    with pytest.raises(ValueError, match=words):
        go_explore(key, sim, cell=refuse)
    with pytest.raises(ValueError, match="go_explore: cell must return numbers"):
        go_explore(key, sim, cell=lambda state: ())


@pytest.mark.slow
def test_nan_is_counted_and_never_best(key):
    sim = climb()
    broken = jast.Simulator(
        sim.init,
        sim.step,
        sim.disturbance,
        lambda s: (s >= 5, jnp.where(s >= 3, jnp.nan, (5 - s).astype(float))),
        sim.horizon,
    )
    r = go_explore(key, broken, **SMALL)
    assert r.invalid > 0
    assert not r.failing
    assert r.best.distance == 3


@pytest.mark.long
def test_where_nothing_fails_the_nearest_is_best(key):
    sim = climb(6)
    r = go_explore(key, sim, **SMALL)
    assert not r.best.failure
    assert r.failures.size == 0
    assert r.first_failure is None
    assert 2 <= r.best.distance <= 4 and np.isfinite(r.best.reward)


@pytest.mark.long
def test_the_same_key_gives_the_same(key, equal):
    sim = climb()
    a, b = (go_explore(key, sim, **SMALL, top=3) for _ in range(2))
    equal(a.failures, b.failures)
    assert len(a.failures) == 3


@pytest.mark.long
def test_is_watched_and_interrupted(key):
    seen = []

    def stop(done, total, result):
        seen.append((done, total, result))
        if len(seen) == 3:
            raise KeyboardInterrupt

    r = go_explore(key, climb(), **SMALL, callback=stop)
    assert seen[0][1:] == (1500, None) and r.episodes == seen[-1][0] < 1500
    assert "interrupted" in r.settings


@pytest.mark.long
def test_a_black_box(key, equal):
    class Walk:
        def initialize(self):
            self.at = 0.0

        def transition(self, x):
            self.at += float(x)

        def miss_distance(self):
            return max(6.0 - self.at, 0.0)

        def is_event(self):
            return self.at >= 6

    sim = jast.blackbox.from_python(Walk, horizon=6, disturbance=Normal(0.0, 1.0))
    r = go_explore(key, sim, episodes=400)
    assert archive_replays(sim, r, RELATIVE, equal)


@pytest.mark.long
def test_the_archive_is_not_copied(key):
    """Within the loop: the disturbances of all slots, the largest array, are written in place."""
    sim = climb(200)
    plan = Plan(lanes=64, length=4, traces=4)
    mark = jax.eval_shape(lambda: features(sim, jnp.int32(0)))
    archives = empty_cells(sim, 2048), BestEpisodes.none(sim, 64, mark)
    args = tree_keys(key, 1)[0], sim, standard_reward(sim), None, plan, *archives
    text = explore.lower(*args, jnp.int32(0), jnp.int32(64)).compile().as_text()
    assert "[2048,200]" in text and not large_copies(text, 2048 * 200)


@pytest.mark.parametrize(
    "bad, words",
    [
        (dict(episodes=0), "go_explore: episodes must be a whole number"),
        (dict(top=1.5), "go_explore: top must be a whole number"),
        (dict(length=0), "go_explore: length must be a whole number of at least 1"),
        (dict(backward=1.0), "go_explore: backward must be a number from 0 to below 1"),
        (dict(cell=3), "go_explore: cell must be a function of a state"),
    ],
)
def test_bad_settings(key, bad, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        go_explore(key, climb(), **bad)


def test_cannot_be_traced(key):
    with pytest.raises(ValueError, match="go_explore: cannot be traced"):
        jax.jit(lambda key: go_explore(key, climb(), episodes=10).steps)(key)
