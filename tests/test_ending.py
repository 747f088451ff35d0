"""Every search ends with a refinement of its failures, and what the search did itself stays told
apart.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import archive_replays, reward_of
from systems import TOLD, dice

import jast
from benchmarks.stress_systems import linear
from jast import actions
from jast._src.core import rewards
from jast._src.search.refine import final
from jast.distributions import Normal, Weibull
from jast.search import cem, chain, forest, go_explore, mcts, monte_carlo

SIM = linear(10, beta=3.0)
SEARCHES = {
    "cem": lambda key, sim, **of: cem(key, sim, samples=200, elites=40, iterations=6, **of),
    "mcts": lambda key, sim, **of: mcts(key, sim, simulations=1500, **of),
    "forest": lambda key, sim, **of: forest(
        key, sim, trees=3, prunes=5, simulations=100, lanes=3, threads=1, **of
    ),
    "monte_carlo": lambda key, sim, **of: monte_carlo(key, sim, episodes=3000, **of),
    "go_explore": lambda key, sim, **of: go_explore(key, sim, episodes=1500, **of),
    "chain": lambda key, sim, **of: chain(key, sim, episodes=1500, **of),
}
COUNTS = "episodes", "steps", "failing_share", "first_failure", "failing", "invalid"


def likeliest(sim, result):
    """log p relative to the mode of the likeliest failure that was archived."""
    return max(
        float(jast.replay(sim, e, reward=rewards.likelihood(sim)).reward) for e in result.failures
    )


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "cem" else pytest.mark.long) for n in SEARCHES],
)
def test_it_pays_and_leaves_the_search_as_it_was(key, name, equal, tmp_path):
    search = SEARCHES[name]
    off, on = search(key, SIM, refine=0), search(key, SIM)
    assert off.refined is None and off.evaluations == off.episodes
    assert off.settings == on.settings | dict(refine=0.0) and on.settings["refine"] == 0.1
    for field in COUNTS:
        assert getattr(on, field) == getattr(off, field), field
    equal(on.history, off.history)
    equal(on.best_reward_per_tree, off.best_reward_per_tree)
    assert 100 <= on.refined.episodes <= 0.1 * on.episodes
    assert on.evaluations == on.episodes + on.refined.episodes

    standard = rewards.standard(density="mode")
    reward = standard if name in ("go_explore", "chain") else reward_of(on)
    assert archive_replays(SIM, on, reward, equal) <= 64
    before, after = likeliest(SIM, off), likeliest(SIM, on)
    assert after > before + 0.05 and after <= -(3.0**2) / 2 + 1e-3
    assert float(on.refined.failures.best.reward) == after
    assert on.refined.settings["likeliest"] == before
    assert f"evaluations, log p relative to the mode {before:.2f} -> {after:.2f}" in str(on)

    # the refined ones say so, and the others are as they were
    mine = on.failures.tree == final.REFINED
    assert mine.any() and on.failures.seen == off.failures.seen
    for e, row in zip(on.failures.episodes.disturbances[mine], on.failures.simulation[mine]):
        equal(e, on.refined.failures[int(row)].disturbances)
    rest, n = jax.tree.map(lambda a: a[~mine], on.failures.episodes), int((~mine).sum())
    equal(rest, off.failures[:n].episodes)

    jast.save(tmp_path / "found", on)
    again = jast.load(tmp_path / "found", SIM)
    equal(again.refined.failures, on.refined.failures)
    assert str(again) == str(on) and again.evaluations == on.evaluations


@pytest.mark.slow
def test_a_reward_of_ones_own_and_what_is_published_have_none(key):
    few = dict(samples=200, elites=40, iterations=6)
    own = dict(reward=rewards.standard(event_bonus=30.0, density="mode"))
    wide = dict(actions=actions.wide(2.0))
    found = cem(key, SIM, **few, **own, **wide)
    assert found.failing
    assert found.refined is None
    assert found.settings["refine"] == 0
    # asked for, the best is the best by that reward, and no more are kept than were to be
    asked = cem(key, SIM, **few, **own, **wide, refine=0.2, top=2)
    assert len(asked.failures) == 2 and asked.best.reward == asked.failures.best.reward
    assert asked.best.reward > found.best.reward and asked.best.states is not None
    assert asked.failures.tree[0] == final.REFINED


@pytest.mark.slow
def test_where_it_is_off(key):
    """Few episodes, disturbances without a quantile function, log p of another density, a traced
    search.
    """
    few = SEARCHES["cem"](key, SIM, refine=0.05)
    assert few.failing
    assert few.refined is None
    assert few.episodes * 0.05 < 100
    relative, raw = (rewards.lexicographic(1.0, 5.0, density=d) for d in ("mode", "raw"))
    assert final.default_share(SIM, relative) == 0.1
    assert final.default_share(SIM, raw) == 0 == final.default_share(SIM, rewards.STANDARD)
    share_of = final.with_refine_share
    assert share_of("", None, SIM, {}, 0.1)["refine"] == 0.1
    assert share_of("", None, dice(), {}, 0.1)["refine"] == 0
    assert share_of("", None, SIM, None, 0.1) is None
    traced = jax.jit(lambda key: monte_carlo(key, SIM, episodes=2000))(key)
    assert traced.refined is None and traced.failing > 0


class Unbounded(Weibull):
    """Of a concentration below 1, with its mode where the density is infinite."""

    def mode(self):
        return jnp.zeros_like(self.scale)


@pytest.mark.parametrize("family, refined", [(Unbounded, False), (Weibull, True)])
def test_a_density_without_a_maximum(family, refined, key):
    """Where that of the mode is infinite nothing is likelier than anything else, and so nothing is
    refined. Where a middle stands for the mode failures are.
    """
    sim = jast.Simulator(
        SIM.init, SIM.step, lambda s: family(0.5, 1.0), lambda s: (s > 4, jnp.maximum(4 - s, 0)), 2
    )
    found = monte_carlo(key, sim, episodes=500, reward=rewards.STANDARD, refine=0.5)
    assert found.failing
    assert (found.refined is not None) == refined
    if refined:
        best = found.refined.failures.best
        assert bool(best.failure) and np.isfinite(best.reward)


@pytest.mark.long
@pytest.mark.parametrize("mode, share", [("paper", 0), ("thesis", 0), ("episodic", 0.1)])
def test_published_modes_have_none(key, mode, share):
    """Whatever the reward."""
    asked = dict(mode=mode, reward=rewards.lexicographic(1.0, 5.0), actions=actions.samples())
    assert mcts(key, SIM, simulations=2, **asked).settings["refine"] == share


@pytest.mark.parametrize("search", [cem, mcts, monte_carlo])
@pytest.mark.parametrize("share", [-0.1, np.nan, np.inf, "much", True])
def test_bad_shares(key, search, share):
    name = search.__name__
    words = f"{name}: refine must be a number of at least 0, a share of the episodes, received"
    with pytest.raises(ValueError, match=re.escape(words)):
        search(key, SIM, refine=share, **TOLD)


def test_what_was_asked_for_in_vain_is_refused(key):
    with pytest.raises(ValueError, match="refine must be 0, since Seeds .*received 0.1"):
        monte_carlo(key, dice(), refine=0.1, reward=rewards.STANDARD)
    with pytest.raises(ValueError, match="monte_carlo: refine must be 0 inside of jax.jit"):
        jax.jit(lambda key: monte_carlo(key, SIM, episodes=100, refine=0.1).episodes)(key)


@pytest.mark.slow
def test_a_system_on_the_host(key):
    """An invalid run is no failure, and is an incident once, however often it is asked for."""

    def run(x):
        if x[0] > 1.9:
            raise RuntimeError("too much")
        total = float(x.sum())
        return total >= 3.5, max(3.5 - total, 0.0)

    sim = jast.blackbox.from_python(run, horizon=2, disturbance=Normal(0.0, 1.0))
    found = cem(key, sim, samples=60, elites=10, iterations=4, refine=0.5)
    assert found.refined is not None and np.isnan(found.refined.residual).all()
    best, before = found.refined.failures.best, found.refined.settings["likeliest"]
    assert before <= float(best.reward) <= -(3.5**2) / 4 + 1e-3
    assert found.best.failure and found.best.reward == found.failures.best.reward
    [incident] = found.incidents
    assert 0 < incident.count <= found.invalid + found.refined.invalid > found.invalid
    for e in found.failures:
        assert bool(jast.replay(sim, e).failure) and e.disturbances[0] <= 1.9


@pytest.mark.slow
def test_an_interruption_leaves_what_was_found(key, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    search = SEARCHES["cem"]
    monkeypatch.setattr(final, "refine", interrupted)
    found = search(key, SIM)
    assert found.refined is None and found.failures.size == 64
    assert found.settings["interrupted"] == f"while refining, after all {found.episodes} episodes"

    def stop(done, total, result):
        if done >= 1000:
            raise KeyboardInterrupt

    monkeypatch.undo()
    found = search(key, SIM, callback=stop)
    assert found.failing
    assert found.refined is None
    assert "interrupted" in found.settings


@pytest.mark.slow
def test_nothing_found_nothing_refined(key):
    found = monte_carlo(key, linear(10, beta=9.0), episodes=2000)
    assert found.refined is None and found.settings["refine"] == 0.1
    assert "refined" not in str(found)
