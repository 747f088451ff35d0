"""Q-learning on a discretised state: the likeliest way out, cells of the user's, importance
sampling, numbers that are not finite, errors.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import walk

import jast
from jast import distributions as D
from jast.policies import q_learning

KEY = jax.random.key(3)
TWO_STEPS = jast.Simulator(
    lambda x0: x0,
    lambda s, x: s + x,
    lambda s: D.Normal(jnp.zeros_like(s), 1.0),
    lambda s: (jnp.abs(s) > 5.0, jnp.maximum(5.0 - jnp.abs(s), 0.0)),
    2,
    start=lambda: D.Normal(jnp.zeros(()), 1.0),
    episodic=True,
)
"""x0 + x1 + x2 beyond +-5: P = 2 Phi(-5 / sqrt 3) = .0038924, by thirds of 5, 1.67."""
SMALL = dict(episodes=4000, lanes=16)


@pytest.fixture(scope="module")
def learned():
    return q_learning(KEY, TWO_STEPS, **SMALL)


@pytest.mark.slow
def test_it_shares_the_way_evenly_on_both_sides(learned):
    # half a column of the table, .25, and half a cell, at most .2, beside the best
    for side in (-1.0, 1.0):
        s = jnp.asarray(side * 5 / 3)
        first = D.mode(learned.disturbance(s, jnp.int32(0)))
        second = D.mode(learned.disturbance(s + first, jnp.int32(1)))
        assert abs(side * first - 5 / 3) <= 0.5
        assert abs(5 - side * (s + first + second)) <= 0.7
    tilt = learned.learned.tilt
    middles = np.asarray(tilt.means[:, 0])[np.asarray(tilt.weights) > 0.1]
    assert middles.min() < -1 and middles.max() > 1
    assert "lambda" in str(learned) and learned.episodes >= 4000


@pytest.mark.slow
def test_importance_sampling_by_it_agrees_with_the_truth(learned):
    proposal = jast.estimate.policy_proposal(TWO_STEPS, learned)
    found = jast.estimate.importance(jax.random.key(5), TWO_STEPS, proposal, 20_000)
    truth = 0.0038924
    assert found.relative_error < 0.1
    assert abs(found.mean - truth) < 4 * found.standard_error


@pytest.mark.long
def test_a_table_of_two_latents_and_ranges_that_are_given():
    system = jast.Simulator(
        lambda x0: jnp.zeros(2),
        lambda s, x: s + x,
        lambda s: D.Independent(D.Normal(jnp.zeros_like(s), 1.0), 1),
        lambda s: (s[0] + s[1] > 6, jnp.maximum(6 - s[0] - s[1], 0)),
        2,
    )
    policy = q_learning(
        KEY, system, episodes=3000, cells=10, ranges=[[-2, 4]] * 2, values=5, widen=1.0
    )
    table = policy.learned.actor
    assert table.q.shape == (2 * 10 * 10, 25) and policy.learned.tilt == ()
    np.testing.assert_array_equal(table.low, [-2, -2])
    np.testing.assert_array_equal(table.actions[0], [0, 0])
    # the way straight to the corner is the likeliest: both numbers go up, in both steps
    x = D.mode(policy.disturbance(jnp.zeros(2), jnp.int32(0)))
    assert np.all(np.asarray(x) > 0)


def test_it_goes_on_from_a_checkpoint_to_the_same_bits(learned, tmp_path):
    def stop(done, total, history):
        if done > total / 2:
            raise KeyboardInterrupt

    half = q_learning(KEY, TWO_STEPS, **SMALL, callback=stop, checkpoint=tmp_path)
    assert half.episodes < learned.episodes
    whole = q_learning(KEY, TWO_STEPS, **SMALL, checkpoint=tmp_path)
    jax.tree.map(np.testing.assert_array_equal, whole.learned, learned.learned)


@pytest.mark.slow
def test_cells_of_the_users_own_and_numbers_that_are_not_finite():
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: jnp.where(x > 0.5, jnp.nan, s + x),
        lambda s: D.Normal(jnp.zeros_like(s), 1.0),
        lambda s: (s < -4, jnp.maximum(s + 4, 0)),
        2,
    )
    cell = lambda seen, t: jnp.where(seen[0] > 0, 1, 0) + 2 * t
    policy = q_learning(KEY, sim, episodes=64, cells=4, cell=cell, values=3)
    q = np.asarray(policy.learned.actor.q)
    assert q.shape == (4, 3)
    assert np.all(np.isfinite(q))
    assert np.all(q <= 0)
    assert np.any(q < 0)
    assert policy.invalid > 0
    # a push up ends the episode in NaN, so nothing was learned of it
    assert policy.learned.actor.actions[-1] == 3 and np.all(q[:, -1] == 0)


@pytest.mark.parametrize(
    "settings, said",
    [
        (dict(episodes=2), "episodes must be at least 4 for each lane"),
        (dict(cells=(3, 4)), "cells must be a whole number or 1 of them"),
        (dict(cells=0), "cells must be a whole number of at least 1"),
        (dict(values=1), "values must be a whole number of at least 2"),
        (dict(reach=0.0), "reach must be a number above 0"),
        (dict(epsilon=1.5), "epsilon must be a number of 0 to 1"),
        (dict(learning_rate=0.0), "learning_rate must be a number above 0 and at most 1"),
        (dict(ranges=[[1, 0]]), r"ranges must be \"auto\" or \[1, 2\]"),
        (dict(cell=lambda seen, t: seen), "cell must return one whole number"),
        (dict(cells=10**9, values=99), "use fewer cells or values"),
    ],
)
def test_errors_name_the_setting(settings, said):
    with pytest.raises(ValueError, match=f"q_learning: .*{said}"):
        q_learning(KEY, walk(), **settings)


def test_it_has_no_file(learned, tmp_path):
    with pytest.raises(ValueError, match="save: a policy of q_learning has no file"):
        jast.save(tmp_path / "policy.npz", learned)
