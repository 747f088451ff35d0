"""What a process may hold: programs of dead simulators go, and what does not fit says so first."""

import gc
import weakref

import jax
import numpy as np
import pytest
from systems import above

import jast
from jast._src.core.policy import nominal_policy
from jast._src.runtime import memory
from jast._src.search.tree import memory as of_trees

maps = pytest.mark.skipif(not memory._MAPS.exists(), reason="only Linux tells of mappings")


def counted():
    return memory._MAPS.read_bytes().count(b"\n")


def fresh():
    """A system with a step function of its own, which no program knows."""
    return above(3.0, 3, step=lambda s, x: 0.5 * s + x)


def met(calls, monkeypatch, work, room):
    """Mappings after each of so many calls with fresh simulators, of which there may be ``room``
    more than now, and how many of their step functions are still there.
    """
    limit = counted() + room
    monkeypatch.setattr(memory, "MAPS", limit)
    seen, steps = [], []
    for i in range(calls):
        sim = fresh()
        work(jax.random.key(i), sim)
        seen.append(counted() - limit)
        steps.append(weakref.ref(sim.step.func))
        del sim
    gc.collect()
    return seen, sum(step() is not None for step in steps)


@pytest.mark.slow
@maps
def test_programs_of_dead_simulators_go(monkeypatch, key):
    work = lambda key, sim: jast.nominal(key, sim, 16)
    seen, alive = met(1, monkeypatch, work, 10**6)
    assert alive == 1  # as JAX holds it
    one = max(1, seen[0] + 10**6)
    seen, alive = met(6, monkeypatch, work, one)
    assert max(seen) <= 2 * one and alive < 6
    assert min(seen[1:]) < 0  # they went


@maps
@pytest.mark.long
def test_thirty_calls_with_fresh_simulators_do_not_grow(monkeypatch):
    """At most what one call makes beyond the limit, as a call begins with the look. What stays
    after programs went does not grow; how far the limit is passed in between is up to its phase.
    """

    def work(key, sim):
        jast.nominal(key, sim, 16)
        jast.search.monte_carlo(key, sim, episodes=100, refine=0)

    seen, _ = met(1, monkeypatch, work, 10**6)
    one = seen[0] + 10**6
    seen, alive = met(30, monkeypatch, work, one)
    assert max(seen) <= 1.5 * one
    assert min(seen[20:]) <= min(seen[:20]) + 0.5 * one
    assert alive < 30


CALLS = {
    "monte_carlo": lambda key: jast.search.monte_carlo(key, fresh(), episodes=5000, record=True),
    "cem": lambda key: jast.search.cem(key, fresh(), samples=5000, elites=10, iterations=1),
    "go_explore": lambda key: jast.search.go_explore(key, fresh(), episodes=5000),
    "validate": lambda key: jast.weakness.validate(
        key, lambda x: np.zeros(len(x), int), np.zeros((2000, 10)), np.arange(2000) % 3
    ),
    "ppo": lambda key: jast.policies.ppo(key, fresh(), episodes=2000, lanes=64),
    "sac": lambda key: jast.policies.sac(key, fresh(), episodes=100, lanes=4, buffer=100_000),
    "subset_simulation": lambda key: jast.estimate.subset_simulation(key, fresh(), samples=5000),
    "failure_proposal": lambda key: jast.estimate.failure_proposal(key, fresh(), samples=5000),
    "log_weights": lambda key: jast.estimate.log_weights(
        key, fresh(), nominal_policy(fresh()), 5000
    ),
    "forest": lambda key: jast.search.forest(
        key, fresh(), trees=50, prunes=2, simulations=50, available=10**10
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_what_does_not_fit_says_so_before_it_starts(name, monkeypatch, key):
    monkeypatch.setattr(memory, "available", lambda: 50_000)
    with pytest.raises(ValueError, match=rf"{name}: .* need at least .*B, and 50 kB are free; use"):
        CALLS[name](key)


def test_failure_samples_that_do_not_fit(monkeypatch, key):
    monkeypatch.setattr(memory, "available", lambda: 50_000)
    q = nominal_policy(fresh())
    with pytest.raises(ValueError, match="failure_samples: 10000 episodes at once .* 50 kB"):
        jast.estimate.failure_samples(key, fresh(), q, 1000)


def test_what_is_free(monkeypatch, tmp_path):
    free = memory.available()
    assert free is None or free > 2**20
    monkeypatch.setattr(memory, "_GROUP", tmp_path)
    for name, text in dict(
        max="3000000", current="2500000", stat="anon 1\ninactive_file 500000\n"
    ).items():
        (tmp_path / f"memory.{name}").write_text(text)
    assert memory.available() == 1_000_000
    (tmp_path / "memory.max").write_text("max\n")  # no limit
    assert memory._free_in_container() is None


def test_what_is_not_known_hinders_nothing(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: None)
    memory.require("function", 2**80, "arrays", "use fewer")
    of_trees.require_rewards("forest", fresh(), 2**60, True)


def test_bytes_for_people():
    assert [memory.readable(n) for n in (12, 3400, 5.6e10)] == ["12 B", "3.4 kB", "56 GB"]
