"""How many programs each public call compiles: none for another key, few for another budget.

What a call does may depend on what it finds, so each is asked with systems and budgets on which it
goes the same way each time; a way that is gone for the first time compiles its programs then.
"""

import dataclasses
import importlib
import inspect
from typing import NamedTuple

import jax
import numpy as np
import pytest
from checks import compiled

import jast
from jast import cross_entropy, estimate, explain, policies, search
from jast.simulators import walk1d

FAILS, RARE = walk1d(threshold=6.0), walk1d()
FEW = 2
"""Programs that another budget may compile."""


class Call(NamedTuple):
    """A public function by a key and a budget."""

    run: object
    budget: int
    other: int
    more: int = FEW
    """Programs that ``other`` may compile."""


@pytest.fixture(scope="module")
def given():
    """What some calls go on from: failures, and an estimate."""
    key = jax.random.key(99)
    return (
        search.monte_carlo(key, FAILS, episodes=4096).failures,
        estimate.failure_probability(key, FAILS, 30_000),
    )


def _names(prefix, room):
    """The public functions of a room that take a key first."""
    functions = ((name, getattr(room, name)) for name in room.__all__)
    return {
        f"{prefix}{name}"
        for name, f in functions
        if inspect.isfunction(f) and next(iter(inspect.signature(f).parameters), "") == "key"
    }


def _swept(key, budget):
    return jast.sweep(
        key,
        lambda threshold: walk1d(threshold=threshold),
        {"threshold": [5.5, 6.0, 6.5]},
        budget=budget,
    )


def _objective(x):
    return x[..., 0] ** 2 + (x[..., 1] - 1) ** 2


def _ce(method):
    start = np.zeros(2, np.float32), np.diag(np.full(2, 4, np.float32))
    return lambda k, b, _: method(k, _objective, start, samples=b, elites=10, iterations=3)


CALLS = {
    "nominal": Call(lambda k, b, _: jast.nominal(k, FAILS, episodes=b), 1000, 2000),
    "rollout": Call(lambda k, b, _: jast.rollout(k, FAILS), 0, 0),
    # trees have the size of their simulations, batches of cem that of their samples
    "stress": Call(lambda k, b, _: jast.stress(k, FAILS, b), 150_000, 250_000, 6),
    "sweep": Call(lambda k, b, _: _swept(k, b), 30_000, 45_000),
    "cross_entropy.ce_method": Call(_ce(cross_entropy.ce_method), 100, 150),
    "cross_entropy.ce_surrogate": Call(_ce(cross_entropy.ce_surrogate), 30, 40),
    "cross_entropy.ce_mixture": Call(_ce(cross_entropy.ce_mixture), 30, 40),
    "estimate.adaptive_cross_entropy": Call(
        lambda k, b, _: estimate.adaptive_cross_entropy(k, FAILS, b), 20_000, 30_000
    ),
    "estimate.failure_probability": Call(
        lambda k, b, _: estimate.failure_probability(k, RARE, b), 20_000, 30_000
    ),
    "estimate.failure_proposal": Call(
        lambda k, b, _: estimate.failure_proposal(k, FAILS, samples=b, iterations=3), 500, 900
    ),
    "estimate.failure_samples": Call(
        lambda k, b, g: estimate.failure_samples(k, FAILS, g[1], samples=b), 500, 800
    ),
    "estimate.importance": Call(
        lambda k, b, g: estimate.importance(
            k, FAILS, estimate.trace_proposal(FAILS, g[0].episodes), samples=b
        ),
        2000,
        5000,
    ),
    "estimate.log_weights": Call(
        lambda k, b, g: estimate.log_weights(
            k, FAILS, estimate.trace_proposal(FAILS, g[0].episodes), samples=b
        ),
        2000,
        5000,
    ),
    "estimate.monte_carlo": Call(lambda k, b, _: estimate.monte_carlo(k, FAILS, b), 2000, 5000),
    "estimate.population": Call(
        lambda k, b, _: estimate.population(k, FAILS, b, particles=512), 60_000, 80_000
    ),
    "estimate.splitting": Call(lambda k, b, _: estimate.splitting(k, FAILS, b, runs=3), 100, 150),
    "estimate.subset_simulation": Call(
        lambda k, b, _: estimate.subset_simulation(k, FAILS, b, replicates=4), 500, 700
    ),
    "explain.cards": Call(
        lambda k, b, g: explain.cards(k, FAILS, search.modes(FAILS, g[0]), b), 10_000, 15_000
    ),
    "explain.criticality": Call(
        lambda k, b, g: explain.criticality(k, FAILS, g[0][0], draws=b), 100, 150
    ),
    "explain.differential": Call(
        lambda k, b, _: explain.differential(k, FAILS, RARE, budget=b), 20_000, 22_000
    ),
    "explain.eigenfailures": Call(
        lambda k, b, g: explain.eigenfailures(k, FAILS, g[1], directions=b), 1, 3
    ),
    "explain.indices": Call(
        lambda k, b, g: explain.indices(k, FAILS, g[1], draws=b), 10_000, 15_000
    ),
    "policies.ppo": Call(lambda k, b, _: policies.ppo(k, FAILS, episodes=b), 256, 512),
    "policies.q_learning": Call(
        lambda k, b, _: policies.q_learning(k, FAILS, episodes=b), 256, 512
    ),
    "policies.sac": Call(
        lambda k, b, _: policies.sac(k, FAILS, episodes=b, hidden=(8,), batch=16), 64, 96
    ),
    "search.cem": Call(lambda k, b, _: search.cem(k, FAILS, samples=b, iterations=3), 500, 800),
    "search.chain": Call(lambda k, b, _: search.chain(k, FAILS, episodes=b), 5000, 8000),
    "search.falsify": Call(lambda k, b, _: search.falsify(k, FAILS, simulations=b), 300, 500),
    "search.forest": Call(
        lambda k, b, _: search.forest(k, FAILS, trees=4, simulations=b), 300, 500, 4
    ),
    "search.go_explore": Call(lambda k, b, _: search.go_explore(k, FAILS, episodes=b), 3000, 5000),
    "search.gradient": Call(lambda k, b, _: search.gradient(k, FAILS, starts=b), 16, 32),
    "search.mcts": Call(lambda k, b, _: search.mcts(k, FAILS, trees=4, simulations=b), 300, 500, 4),
    "search.monte_carlo": Call(
        lambda k, b, _: search.monte_carlo(k, FAILS, episodes=b), 3000, 5000
    ),
    "search.refine": Call(lambda k, b, g: search.refine(k, FAILS, g[0], budget=b), 3000, 5000),
}


def test_every_public_call_with_a_key_is_here():
    """But networks of given sizes and the static data of `jast.weakness`, whose arrays have the
    user's shapes, `start` of loops that are the user's own, and estimators of two kinds of draws,
    which need systems of their own.
    """
    rooms = "cross_entropy", "estimate", "explain", "heads", "policies", "search", "weakness"
    named = _names("", jast)
    for room in rooms:
        named |= _names(f"{room}.", importlib.import_module(f"jast.{room}"))
    apart = {
        "cross_entropy.start",
        "estimate.double_loop",
        "estimate.given_start",
        "heads.make_head",
        "weakness.influence",
        "weakness.validate",
    }
    assert named - apart == set(CALLS)


@pytest.mark.long
@pytest.mark.parametrize("name", CALLS)
def test_a_second_key_compiles_nothing_and_another_budget_little(name, given):
    call = CALLS[name]
    first, *others = jax.random.split(jax.random.key(0), 3)
    for key in (first, others[0]):  # what the first found may have compiled less
        call.run(key, call.budget, given)
    with compiled() as programs:
        call.run(others[1], call.budget, given)
    assert not programs
    with compiled() as programs:
        call.run(first, call.other, given)
    assert len(programs) <= call.more


@pytest.mark.slow
def test_a_stress_of_few_evaluations_compiles_the_step_five_times(key, tmp_path):
    """The check, batches of points, their episodes, one episode again, the derivative. It is traced
    four times: for all of them, for its contract, and twice to be compared.
    """
    named, traced = jax.named_scope("of the user")(RARE.step), []

    def step(s, x):
        traced.append(s)
        return named(s, x)

    sim = dataclasses.replace(RARE, step=step)
    jax.config.update("jax_dump_ir_to", str(tmp_path))
    try:
        jast.stress(key, sim, 5000)
    finally:
        jax.config.update("jax_dump_ir_to", None)
    assert sum("of the user" in text.read_text() for text in tmp_path.iterdir()) == 5
    assert len(traced) == 4
