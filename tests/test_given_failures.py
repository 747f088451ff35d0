"""Failures that come with the call where the proposal is made of tilts: none is lost, and none is
counted.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import check_estimate
from jax.tree_util import Partial

import jast
from benchmarks.limit_states import ruin_probability
from jast import distributions as D
from jast.estimate import failure_probability
from jast.simulators import ruin

UP, CHATTERS, STEPS = 0.3, 16, 40


class Relay(NamedTuple):
    net: jax.Array
    last: jax.Array
    run: jax.Array
    """Switches since the start; below 0 once it did not switch"""


def _step(s, x):
    run = jnp.where(x == s.last, -STEPS, s.run + 1)
    return Relay(s.net + 2 * x - 1, x, run)


def _evaluate(goal, s):
    chatters = s.run >= CHATTERS
    gap = jnp.maximum(goal - s.net, 0).astype(jnp.zeros(()).dtype)
    return chatters | (s.net >= goal), jnp.where(chatters, 0, gap)


def relay(goal):
    """A coin a step. Failure where heads lead by ``goal``, which the miss distance tells, or where
    the first `CHATTERS` coins alternate, of which it tells nothing.
    """
    start = Relay(*(jnp.asarray(v, jnp.int32) for v in (0, 1, 0)))
    return jast.Simulator(
        init=Partial(lambda start, x0: start, start),
        step=_step,
        disturbance=Partial(lambda p, s: D.Bernoulli(probs=p, dtype=jnp.int32), jnp.asarray(UP)),
        evaluate=Partial(_evaluate, jnp.asarray(goal, jnp.int32)),
        horizon=STEPS,
        observe=lambda s: 2.0 * s.last.reshape(1) - 1,
    )


def leads(goal):
    """P(heads lead by ``goal`` at some time), by the hitting time theorem."""
    at = range(goal, STEPS + 1, 2)
    path = lambda n, up: math.comb(n, up) * UP**up * (1 - UP) ** (n - up)
    return sum(goal / n * path(n, (n + goal) // 2) for n in at)


def archive(sim, *rows):
    """Those of the episodes of these disturbances that fail, as a user hands them over."""
    e = jax.vmap(lambda x: jast.replay(sim, x))(jnp.asarray(rows, jnp.int32))
    return jast.failures.collect(sim, jast.rewards.standard(), e)


# with no goal in reach the search meets no failure, and begins with what is given
@pytest.mark.slow
@pytest.mark.parametrize("goal", [14, 1000])
def test_a_mode_that_the_search_loses_is_found_with_a_failure_of_it(key, goal):
    sim = relay(goal)
    chattering = (UP * (1 - UP)) ** (CHATTERS // 2)
    known = archive(sim, np.arange(STEPS) % 2)
    found = failure_probability(key, sim, 8000, failures=known)
    check_estimate(found, chattering + leads(goal))
    assert found.episodes <= 8000
    if goal == 14:
        without = failure_probability(key, sim, 8000)
        check_estimate(without, leads(goal))


@pytest.mark.slow
def test_failures_given_lead_and_are_not_counted(key):
    """What the tilts cover changes nothing but the number of draws, however often it is given."""
    sim = ruin(goal=15, horizon=60)
    one = archive(sim, np.ones(60))
    many = one._replace(episodes=jax.tree.map(lambda a: np.repeat(a, 50, axis=0), one.episodes))
    with_it, without = (failure_probability(key, sim, 12_000, failures=f) for f in (many, None))
    check_estimate(with_it, ruin_probability(0.4, 1, 15, 60))
    a, b = with_it.draws, without.draws
    assert a.samples == b.samples - 50
    rows = b.row < a.samples
    np.testing.assert_array_equal(a.row, b.row[rows])
    np.testing.assert_array_equal(a.log_weight, b.log_weight[rows])
