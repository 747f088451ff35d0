"""jast.search.falsify: a failure with few simulations."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import above

import jast
from jast.distributions import Joint, Normal, Uniform
from jast.specs import always, eventually, predicate, under
from tests.blackboxes import walk

falsify = jast.search.falsify


def held(horizon=12, **changes):
    """A level follows its input slowly: it is above .9 only where that is held near 1 for long."""
    given = dict(
        step=lambda s, x: s + 0.3 * (x - s),
        disturbance=lambda s: Uniform(0.0, 1.0),
    )
    return above(0.9, horizon, **given | changes)


@pytest.mark.slow
def test_what_must_be_held_is_found_with_few_simulations(key):
    """Of 2000 draws of the model none fails."""
    sim = held()
    assert jast.search.monte_carlo(key, sim, episodes=2000, refine=0).failing == 0
    took = []
    for k in jax.random.split(key, 5):
        found = falsify(k, sim)
        took.append(found.first_failure)
        assert found.episodes < found.first_failure + 10 and len(found.failures)
        assert bool(jast.replay(sim, found.failures.best).failure)
    assert max(took) <= 40


def test_the_same_key_gives_the_same_search(key, equal):
    one, two = (falsify(key, held(), simulations=60, stop=False) for _ in range(2))
    equal(one.failures.episodes, two.failures.episodes)
    assert one.episodes == 60 and one.failing == two.failing > 1
    assert one.history.simulations.tolist() == [10, 20, 30, 40, 50, 60]
    assert np.all(np.diff(one.history.best_reward[:, 0]) >= 0)


def test_failures_that_are_found_again_are_counted(key):
    """Most walks that are pushed one way for long fail at once: equal episodes are one failure."""
    found = falsify(
        key, jast.simulators.walk1d(threshold=3.0), simulations=100, stop=False, top=400
    )
    assert found.failures.counts.sum() == found.failures.seen == found.failing
    assert found.failures.counts.max() > 1


@pytest.mark.slow
def test_it_climbs_where_no_draw_fails(key):
    """The level must stay in a narrow band: no corner fails."""
    band = predicate(lambda s: 0.05 - jnp.abs(s - 0.6), "s in the band")
    formula = ~eventually(always(band, 0, 6), 0, 5)
    found = falsify(key, under(held(), formula), simulations=300)
    assert found.failing >= 1 and found.first_failure > 10


def test_a_random_start_and_dictionaries(key):
    sim = held(
        start=lambda: Normal(0.0, 1.0),
        init=lambda x0: -jnp.abs(x0),
        disturbance=lambda s: Joint({"a": Uniform(0.0, 1.0), "b": Normal(0.0, 1.0)}),
        step=lambda s, x: s + 0.3 * (x["a"] - 0.05 * jnp.abs(x["b"]) - s),
    )
    found = falsify(key, sim, batch=7)
    assert found.failing and bool(jast.replay(sim, found.best).failure)


def test_a_first_batch_larger_than_the_fresh_signals(key):
    found = falsify(key, held(), simulations=80, batch=40, stop=False)
    assert found.episodes == 80 and found.failing


def test_one_at_a_time_on_a_black_box(key):
    box = jast.blackbox.from_python(walk, horizon=4, disturbance=Normal(0.0, 1.0))
    found = falsify(key, box, simulations=40, batch=1)
    assert found.first_failure == found.episodes <= 40


def test_what_came_after_an_episodes_end_is_left_as_it_is():
    module = importlib.import_module("jast._src.search.falsify")
    rows = np.random.default_rng(0).uniform(size=(1, 8, 2))
    pool = module.Pool(np.ones(1), rows, np.zeros((1, 0)), np.array([3]))
    rng = np.random.default_rng(1)
    children = np.stack([module.signal(rng, pool, 99)[0] for _ in range(200)])
    assert (children[:, 3:] == rows[0, 3:]).mean() == 1
    assert ((children[:, :3] != rows[0, :3]).any(axis=(0, 2))).all()


def test_none_is_found_where_there_is_none(key):
    sim = held(evaluate=lambda s: (jnp.zeros((), bool), jnp.abs(s - 2)))
    found = falsify(key, sim, simulations=35)
    assert found.episodes == 35
    assert found.first_failure is None
    assert not len(found.failures)
    assert float(found.best.distance) == pytest.approx(-found.history.best_reward[-1, 0])


def test_bad_input_and_interrupts(key, monkeypatch):
    with pytest.raises(ValueError, match="falsify: batch"):
        falsify(key, held(), batch=0)
    seeds = held(disturbance=lambda s: jast.distributions.seeds(), step=lambda s, x: s)
    with pytest.raises(ValueError, match="falsify: disturbance: "):
        falsify(key, seeds)
    with pytest.raises(ValueError, match="falsify: cannot be traced"):
        jax.jit(lambda k: falsify(k, held()).episodes)(key)

    def stop(done, total, result):
        assert total == 100
        if done >= 20:
            raise KeyboardInterrupt

    found = falsify(key, held(), simulations=100, stop=False, callback=stop)
    assert found.episodes == 20 and found.settings["interrupted"] == "after 20 of 100 episodes"
    module = importlib.import_module("jast._src.search.falsify")
    monkeypatch.setattr(module, "signal", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):  # nothing is there yet
        falsify(key, held())
