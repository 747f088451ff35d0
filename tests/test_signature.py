"""The outline of a simulator: right for every kind of system, traced once, and without tracers."""

from collections import Counter

import blackboxes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from systems import ring, walk

import jast
from jast import distributions as D
from jast._src.core.rewards import STANDARD
from jast._src.core.signature import Offer, ask, signature_of
from jast._src.core.transition import begin
from jast._src.util.pytrees import count_numbers

NAMES = ("start", "init", "step", "disturbance", "evaluate", "is_terminal", "observe")


def default() -> np.dtype:
    """The float dtype of this run."""
    return jnp.zeros(()).dtype


def watched(sim: jast.Simulator) -> tuple[jast.Simulator, Counter]:
    """``sim`` with functions of its own, and how often each was called from Python."""
    calls = Counter()

    def count(name, function):
        def call(*args):
            calls[name] += 1
            return function(*args)

        return call

    fields = {name: count(name, getattr(sim, name)) for name in NAMES}
    return jast.Simulator(**fields, horizon=sim.horizon, episodic=sim.episodic), calls


def test_of_a_walk():
    signature = signature_of(walk())
    assert (signature.x0, signature.random_start) == ((), False)
    assert (signature.x.shape, signature.x.dtype) == ((), default())
    assert (signature.state.shape, signature.state.dtype) == ((), default())
    assert signature.dtype == default() and signature.observation == (1,)
    assert signature.start == Offer("Fixed", True, "", frozenset({"Fixed"}))
    assert signature.disturbance.quantile


def test_of_a_tree_of_disturbances_and_a_random_start():
    sim = ring()
    signature = signature_of(sim)
    episode = jast.rollout(jax.random.key(0), sim)
    assert signature.random_start
    for like, value in (
        (signature.x0, episode.x0),
        (signature.x, jax.tree.map(lambda a: a[0], episode.disturbances)),
        (signature.state, jax.tree.map(lambda a: a[0], episode.states)),
    ):
        assert jax.tree.map(lambda s: (s.shape, s.dtype), like) == jax.tree.map(
            lambda a: (a.shape, a.dtype), value
        )
    assert signature.dtype == episode.log_prob.dtype
    assert (count_numbers(signature.x0), count_numbers(signature.x), signature.observation) == (
        2,
        3,
        (5,),
    )
    assert signature.start == signature.disturbance
    assert signature.start == Offer("Joint", True, "", frozenset({"Categorical", "Normal"}))


def test_what_distributions_do_not_offer():
    seeds = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + 1,
        lambda s: D.Joint([D.Normal(s, 1.0), D.Independent(D.seeds(), 0)]),
        lambda s: (s > 3, s),
        3,
        start=lambda: D.seeds((2,)),
    )
    signature = signature_of(seeds)
    assert signature.start == Offer("Seeds", False, "Seeds", frozenset({"Seeds"}))
    assert signature.disturbance == Offer("Joint", False, "Seeds", frozenset({"Normal", "Seeds"}))
    assert not signature.disturbance.quantile and not signature.closed
    assert (signature.x0.shape, signature.x0.dtype) == ((2,), jnp.uint32)


class Odd(D.Normal):
    """What it has beside draws and densities raises."""

    def mode(self):
        raise RuntimeError("no mode today")

    def quantile(self, u):
        raise TypeError("no quantile today")


@pytest.mark.slow
def test_what_raises_is_not_offered_and_not_missed(key):
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: Odd(jnp.zeros(()), 1.0),
        lambda s: (s > 3, 3 - s),
        3,
        observe=lambda s: s.nothing,
    )
    signature = signature_of(sim)
    families = frozenset({f"{Odd.__module__}.Odd"})
    assert signature.disturbance == Offer("Odd", False, "Odd", families)
    assert signature.observation is None and not signature.closed
    assert jast.search.monte_carlo(key, sim, episodes=10).episodes == 10
    with pytest.raises(ValueError, match="observe: raised AttributeError"):
        jast.search.forest(key, sim, trees=2, prunes=1, simulations=2, heads="value")
    with pytest.raises(ZeroDivisionError):
        signature_of(walk(init=lambda x0: 1 / 0))


def test_of_a_black_box_without_a_run(monkeypatch):
    def system(disturbances):
        raise AssertionError("it was run")

    signature = signature_of(
        jast.blackbox.from_python(system, horizon=4, disturbance=D.Normal(0.0, 1.0))
    )
    assert not signature.random_start and signature.x.shape == ()
    assert signature.disturbance == Offer("Normal", True, "", frozenset({"Normal"}))
    assert signature.disturbance.mode_is_median and signature.closed
    sim = jast.blackbox.from_python(blackboxes.walk, horizon=4)
    assert signature_of(sim).disturbance == Offer("Seeds", False, "Seeds", frozenset({"Seeds"}))


def _drift(drift, s, x):
    return s + drift + x


def _drawn(scale, s):
    return D.Normal(jnp.zeros_like(scale), scale)


def _far(limit, s):
    return s > limit, limit - s


def of(scale, limit, calls=None):
    """A walk whose parameters are those of its Partials."""

    def init(x0):
        if calls is not None:
            calls["init"] += 1
        return jnp.zeros_like(scale)

    return jast.Simulator(
        init, Partial(_drift, 0.1), Partial(_drawn, scale), Partial(_far, limit), 4
    )


@pytest.mark.slow
@pytest.mark.parametrize("transform", [jax.vmap, jax.jit, lambda f: jax.jit(jax.vmap(f)), jax.grad])
def test_of_a_traced_simulator(transform):
    """The same as outside, traced once for all of a kind, and nothing of the trace is left."""
    calls, found = Counter(), []
    one = of(jnp.ones(()), jnp.full((), 3.0), calls)

    def look(scale):
        sim = jax.tree.unflatten(jax.tree.structure(one), [0.1, scale, jnp.full((), 3.0)])
        found.append(signature_of(sim))
        return scale * 2

    value = jnp.ones(()) if transform in (jax.jit, jax.grad) else jnp.ones(3)
    with jax.checking_leaks():
        transform(look)(value)
    assert found == [signature_of(one)] and calls["init"] == 1
    leaves = jax.tree.leaves(found)
    assert leaves and not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def test_another_value_is_no_other_outline_but_another_shape_is():
    calls = Counter()
    kind = jax.tree.structure(of(jnp.ones(()), jnp.ones(()), calls))
    at = lambda *leaves: signature_of(jax.tree.unflatten(kind, [jnp.full((), 0.1), *leaves]))
    one, two = (at(jnp.full((), v), jnp.ones(())) for v in (1.0, 2.0))
    assert one == two and calls["init"] == 1
    assert at(jnp.ones((2,)), jnp.ones(())).x.shape == (2,) and calls["init"] == 2


def test_precision():
    """It knows of a change of precision, and a start of weak type is one of explicit type."""
    sim = walk(init=lambda x0: 0.0)
    for on, dtype in ((False, "float32"), (True, "float64"), (False, "float32")):
        with jax.enable_x64(on):
            signature = signature_of(sim)
            assert (signature.dtype, signature.x.dtype, signature.state.dtype) == (dtype,) * 3
            assert not signature.state.weak_type
            began = jax.eval_shape(lambda: begin(sim, STANDARD, ()))
            assert {a.dtype for a in began[:4]} == {jnp.dtype(dtype)}


def test_ask():
    asked = ask(ring(), lambda start, state, dist: (type(start).__name__, state.at.dtype, dist))
    assert asked[:2] == ("Joint", jnp.int32) and isinstance(asked[2], D.Joint)
    with pytest.raises(ValueError, match="as asked"):
        ask(ring(), lambda start, state, dist: _refuse())


def _refuse():
    raise ValueError("as asked")


MOST = 24
"""Calls of a user's function from Python in one search: the user waits for each."""


@pytest.mark.parametrize(
    "search",
    [
        lambda key, sim: jast.search.forest(key, sim, trees=4, prunes=3, simulations=20),
        pytest.param(
            lambda key, sim: jast.search.mcts(key, sim, trees=2, simulations=20),
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda key, sim: jast.search.cem(key, sim, samples=20, elites=4, iterations=2),
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda key, sim: jast.search.monte_carlo(key, sim, episodes=200), marks=pytest.mark.long
        ),
        pytest.param(lambda key, sim: jast.nominal(key, sim, episodes=200), marks=pytest.mark.long),
    ],
    ids=["forest", "mcts", "cem", "monte_carlo", "nominal"],
)
def test_a_users_functions_are_called_few_times(key, search):
    jax.clear_caches()
    start = lambda: D.Normal(jnp.zeros(()), 1.0)
    sim, calls = watched(walk(init=lambda x0: x0, start=start))
    search(key, sim)
    assert 0 < min(calls[name] for name in NAMES[:-1]) and max(calls.values()) <= MOST, calls
