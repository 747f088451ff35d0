"""What loses failures in silence is told; what only looks like it is not."""

import dataclasses
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import pytest
from jax.tree_util import Partial
from systems import dice, line, ring, walk

import jast
from jast import distributions as D
from jast._src.core import traps as T
from jast._src.core.probe import probe


def traps(sim):
    return T.traps(sim, probe(sim).resolution)


def told(sim, words):
    """Whether the one thing that `traps` tells of ``sim`` has these ``words``."""
    [text] = traps(sim)
    return words in text


@pytest.mark.slow
def test_good_systems_have_none():
    for sim in (line(), ring(), dice(), walk(), jast.simulators.ruin(), jast.simulators.pendulum()):
        assert traps(sim) == []


def test_an_episode_that_is_over_before_it_begins_is_told():
    sim = dataclasses.replace(walk(), is_terminal=lambda s: jnp.ones((), bool))
    assert any(text.startswith("is_terminal: holds at the start") for text in traps(sim))


def pole(resets, at_random=False):
    """The cart-pole of Barto, Sutton and Anderson under bang-bang control by noisy readings, and a
    count of its steps; one in some hundred episodes ends. ``resets``: as many environments do, it
    starts again then, ``at_random`` in a box.
    """

    def init(x0):
        return jnp.full(4, 0.01), jnp.zeros((), jnp.int32)

    def step(s, w):
        (x, v, a, b), n = s
        push = jnp.where(a + 0.5 * b + 0.1 * x + 0.2 * v + 0.16 * w > 0, 10.0, -10.0)
        inner = (push + 0.05 * b**2 * jnp.sin(a)) / 1.1
        turn = 9.8 * jnp.sin(a) - jnp.cos(a) * inner
        turn = turn / (0.5 * (4 / 3 - 0.1 * jnp.cos(a) ** 2 / 1.1))
        pushed = inner - 0.05 * turn * jnp.cos(a) / 1.1
        new = jnp.stack([x + 0.02 * v, v + 0.02 * pushed, a + 0.02 * b, b + 0.02 * turn])
        if not resets:
            return new, n + 1
        again = jnp.full(4, 0.01)
        if at_random:
            shaken = jax.random.fold_in(jax.random.key(1), (1e6 * w).astype(jnp.int32))
            again = jax.random.uniform(shaken, (4,), minval=-0.05, maxval=0.05)
        done = (jnp.abs(new[2]) > 0.2095) | (jnp.abs(new[0]) > 2.4)
        return jnp.where(done, again, new), jnp.where(done, 0, n + 1)

    gap = lambda s: 0.2095 - jnp.abs(s[0][2])
    return line(init=init, step=step, evaluate=lambda s: (gap(s) < 0, gap(s)), horizon=200)


@pytest.mark.slow
@pytest.mark.parametrize("at_random", [False, True])
def test_a_state_that_jumps_back_to_its_start(at_random):
    assert told(pole(True, at_random), "jumps back to its start")
    assert traps(pole(False)) == []


def test_a_counter_may_go_back_to_zero():
    """As of a failure that takes six bad steps one after another, beside a slow number."""
    step = lambda s, x: (jnp.where(x > -1, s[0] + 1, 0.0), 0.9 * s[1] + 0.1 * x)
    sim = line(
        init=lambda x0: (jnp.zeros(()), jnp.zeros(())),
        step=step,
        evaluate=lambda s: (s[0] > 99, 99 - s[0]),
        horizon=60,
    )
    assert traps(sim) == []


def far(origin, dtype):
    """Twenty steps of 0.05 from ``origin``; a failure is 0.5 away."""
    at = lambda: jnp.asarray(origin, dtype)
    gap = lambda s: 0.5 - jnp.abs(s - at())
    return jast.Simulator(
        init=lambda x0: at(),
        step=lambda s, x: s + jnp.asarray(0.05, dtype) * x,
        disturbance=lambda s: D.Normal(jnp.zeros((), dtype), jnp.ones((), dtype)),
        evaluate=lambda s: (gap(s) < 0, gap(s)),
        horizon=20,
    )


def test_a_disturbance_that_is_rounded_away():
    """In float32 numbers near 1e7 have steps of 1; in float64 there is nothing to tell."""
    assert told(far(1e7, jnp.float32), "no disturbance changes a number of the state")
    with jax.enable_x64(True):
        assert traps(far(1e7, jnp.float64)) == []


def test_a_disturbance_that_is_not_used():
    unused = line(step=lambda s, x: s + 0.1)
    assert told(unused, "step does not use its second argument")
    seldom = line(
        disturbance=lambda s: D.Bernoulli(probs=1e-9), step=lambda s, x: s + x.astype(s.dtype)
    )
    assert traps(seldom) == []  # it is the same in all of the episodes that were looked at


def stopped(s, x):
    return jax.lax.stop_gradient(s + x)


@pytest.mark.slow
def test_a_miss_distance_without_slopes():
    assert told(line(step=stopped), "its gradient is 0 everywhere")
    beside = lambda s, x: jax.lax.stop_gradient(s) + x  # the disturbance of a step gets through
    once = lambda s, x: jax.jit(stopped)(s, x)
    late = line(  # after two steps, which the sum of forces takes
        init=lambda x0: (jnp.zeros(()), jnp.zeros(())),
        step=lambda s, x: (s[0] + s[1], jax.lax.stop_gradient(s[1]) + x),
        evaluate=lambda s: (s[0] > 9, 9 - s[0]),
    )
    assert traps(line(step=beside)) == traps(late) == [] and traps(line(step=once))
    assert traps(line(step=lambda s, x: jnp.round(s + x))) == []  # its nature, not a mistake


def keyed(start=False, fold=False):
    """Noise of the simulator's own, from a key in its state that the start or each step changes."""

    def init(x0):
        return jnp.zeros(()), jax.random.key_data(jax.random.key(x0 if start else 0))

    def step(s, x):
        key = jax.random.wrap_key_data(s[1])
        key = jax.random.fold_in(key, (1e6 * x).astype(jnp.int32) if fold else 1)
        return s[0] + x + jax.random.normal(key, dtype=s[0].dtype), jax.random.key_data(key)

    more = dict(start=D.seeds) if start else {}
    return line(init=init, step=step, evaluate=lambda s: (s[0] > 9, 9 - s[0]), **more)


@pytest.mark.slow
def test_a_key_in_the_state():
    assert told(keyed(), "init: state leaf [1] looks like a random key that no disturbance reaches")
    assert traps(keyed(start=True)) == traps(keyed(fold=True)) == []


def test_whole_numbers_that_are_no_key():
    """A cell of a grid beside a key that a disturbance reaches, in a jitted step and in a loop."""

    @jax.jit
    def move(s, x):
        def once(i, s):
            at, cell, key = s
            key = jax.random.fold_in(jax.random.wrap_key_data(key), i)
            return at + jax.random.normal(key), cell + jnp.uint32(0), jax.random.key_data(key)

        at, cell, key = jax.lax.fori_loop(0, 2, once, s)
        return at + x + cell[0].astype(x.dtype), cell, key

    key = jax.random.key_data(jax.random.key(0))
    start = jnp.zeros(()), jnp.array([0, 3], jnp.uint32), key
    gap = lambda s: 9 - s[0]
    sim = line(init=lambda x0: start, step=move, evaluate=lambda s: (gap(s) < 0, gap(s)))
    assert told(sim, "init: state leaf [2] looks like a random key")


@pytest.mark.slow
def test_a_step_that_is_large(monkeypatch):
    """What is in a loop counts once, what a loop of Python writes down counts each time."""

    def many(s, x, n):
        for i in range(n):
            s = jnp.where(s > i, s * 0.5, s)
        return s + x

    def looped(s, x):
        return jax.lax.fori_loop(0, 1000, lambda i, s: jnp.where(s > i, s * 0.5, s), s) + x

    monkeypatch.setattr(T, "EQUATIONS", 60)
    assert told(line(step=partial(many, n=30)), "operations of JAX take minutes to compile")
    assert traps(line(step=partial(many, n=3))) == traps(line(step=looped)) == []


@pytest.mark.slow
def test_check_tells_them():
    for sim in (line(step=stopped), far(1e7, jnp.float32), keyed(), pole(True)):
        with pytest.warns(UserWarning, match="check: (step|init): "):
            assert jast.check(sim) is sim
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jast.check(walk())


@jax.tree_util.register_pytree_node_class
class Net:
    """A network as equinox writes one: weights and an activation, all of them leaves."""

    def __init__(self, weight, activation):
        self.weight, self.activation = weight, activation

    def tree_flatten(self):
        return (self.weight, self.activation), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        return cls(*leaves)


def steered(net, s, x, gain=1.0):
    return s - 0.1 * gain * net.activation(net.weight * s) + 0.5 * x


BASE = line()


def under(net, **keywords):
    return dataclasses.replace(BASE, step=Partial(steered, net, **keywords))


@pytest.mark.slow
def test_functions_among_the_leaves_of_an_argument(key, traced):
    """They are static beside the weights, which are traced."""
    bound = under(Net(jnp.ones(()), jnp.tanh), gain=2.0)
    closed = line(step=lambda s, x: s - 0.2 * jnp.tanh(s) + 0.5 * x)
    assert jast.check(bound) is bound
    assert jast.rollout(key, bound).distance == pytest.approx(
        float(jast.rollout(key, closed).distance), abs=1e-5
    )
    traced.clear()
    other = under(Net(jnp.ones(()) * 2, jnp.tanh), gain=3.0)
    jast.rollout(key, other)
    assert "_rollout" not in traced  # one program for all weights
    jast.rollout(key, under(Net(jnp.ones(()), jnp.sin), gain=2.0))
    assert "_rollout" in traced
    both = jax.tree.map(lambda *a: jnp.stack(a), bound, other)
    assert jax.vmap(lambda s: jast.rollout(key, s).distance)(both).shape == (2,)
