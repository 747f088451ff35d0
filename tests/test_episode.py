import json
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from systems import PUBLISHED
from systems import line as walk_by_steps

import jast
from jast import distributions as D
from jast import rewards
from jast._src.core import policy
from jast.simulators import ferry, landing, walk1d

# seeds -> reward, failure, steps, miss distance, log-likelihood by the mode; float64, of an
# independent implementation
FERRY = {
    "half": ([0.5] * 21, -24.20743687382041, False, 21, 24.20743687382041, 0),
    "zero": ([0.0] * 21, -33.83362424658773, False, 21, 33.83362424658773, 0),
    "one": ([1.0] * 21, -20.736188072461154, False, 21, 20.736188072461154, 0),
    "best constant": ([0.8363] * 21, -10.00753870070671, False, 21, 10.00753870070671, 0),
    "scattered": (
        [(0.37 * i) % 1 for i in range(21)],
        -41.32347477384132,
        False,
        21,
        28.35724788567899,
        -12.96622688816233,
    ),
    "paper": (PUBLISHED, 29.092054904933118, True, 20, 4.7764725102288645, -0.9079450950668829),
    "near best": (
        [0.998] * 4 + [0.9273, 0.8188, 0.7135, 0.6448] + [0.6431] * 13,
        29.627684415379345,
        True,
        19,
        4.837140795059192,
        -0.37231558462065456,
    ),
}
REWARD = rewards.standard(event_bonus=30.0, density="mode")
GOLDEN = Path(__file__).parents[2] / "shared" / "data" / "ferry" / "golden_episodes.json"


def floats(x):
    return jnp.asarray(x, jnp.zeros(()).dtype)


def within(double, single):
    return dict(rel=0, abs=double if jax.config.jax_enable_x64 else single)


@pytest.fixture(params=[False, True], ids=["float32", "float64"])
def precision(request):
    with jax.enable_x64(request.param):
        yield


# the published ferry


@pytest.mark.parametrize("name", FERRY)
def test_ferry_golden_values(name, precision):
    seeds, reward, failure, steps, distance, likelihood = FERRY[name]
    episode = jast.replay(ferry(), floats(seeds), reward=REWARD)
    close = within(1e-9, 1e-3)
    assert float(episode.reward) == pytest.approx(reward, **close)
    assert float(episode.distance) == pytest.approx(distance, **close)
    assert (bool(episode.failure), int(episode.length)) == (failure, steps)
    assert float(
        episode.reward - jnp.where(episode.failure, 30, -episode.distance)
    ) == pytest.approx(likelihood, **within(1e-9, 1e-3))


@pytest.mark.skipif(
    not GOLDEN.exists(), reason="the published ferry episodes lie outside of the repository"
)
def test_ferry_published_episodes(precision):
    episodes = json.loads(GOLDEN.read_text())["episodes"]
    assert len(episodes) == 200
    sim, failures = ferry(), 0
    padded = np.zeros((200, 21))
    for row, e in zip(padded, episodes, strict=True):
        row[: len(e["seeds"])] = e["seeds"]
    played = jax.vmap(lambda x: jast.replay(sim, x, reward=REWARD))(floats(padded))
    for i, e in enumerate(episodes):
        assert float(played.reward[i]) == pytest.approx(e["reward"], **within(1e-9, 1e-3))
        failures += int(played.failure[i])
        if played.failure[i]:
            assert int(played.length[i]) == len(e["seeds"])
    assert failures == 44


def test_raw_density_differs_from_that_by_the_mode_by_the_normalisers(x64):
    seeds = np.asarray(PUBLISHED)
    masses = [1 - ((1 - c) ** 2 + c**2) / 2 for c in seeds[:-1]]  # of the tent on [0, 1]
    episode = jast.replay(ferry(), floats(seeds), reward=REWARD)
    assert float(episode.log_prob) == pytest.approx(
        FERRY["paper"][5] - np.log(masses).sum(), abs=1e-9
    )


# replay


@pytest.mark.parametrize("make", [ferry, walk1d, landing], ids=["ferry", "walk", "landing"])
def test_replay_of_a_replay_is_identical(make, key, equal, precision):
    sim = make()
    drawn = jast.rollout(key, sim)
    once = jast.replay(sim, drawn)
    equal(once, jast.replay(sim, once))
    rows = int(drawn.length)
    equal(once, jast.replay(sim, drawn.disturbances[:rows], x0=drawn.x0))
    equal(drawn.disturbances, once.disturbances)
    equal(drawn, once)


def test_replay_of_fewer_rows_ends_there(equal):
    sim = walk1d()
    short = jast.replay(sim, floats([1.0, 2.0, 3.0]))
    assert (int(short.length), float(short.distance), bool(short.failure)) == (3, 4.0, False)
    assert float(short.reward) == pytest.approx(float(short.log_prob) - 4, rel=1e-6)
    np.testing.assert_array_equal(short.states[:5], [0, 1, 3, 6, 0])
    none = jast.replay(sim, jnp.zeros((0,)))
    assert (int(none.length), float(none.log_prob)) == (0, 0.0)
    equal(short, jast.replay(sim, short))


def test_padding_is_zero(key):
    episode = jast.replay(ferry(), floats(PUBLISHED + [0.9]))
    assert int(episode.length) == 20
    assert not np.asarray(episode.disturbances[20:]).any()
    assert not any(np.asarray(leaf[21:]).any() for leaf in episode.states)
    drawn = jax.vmap(lambda k: jast.rollout(k, walk1d(sigma=3.0)))(jax.random.split(key, 50))
    after = np.arange(30) >= np.asarray(drawn.length)[:, None]
    assert after.any()
    assert not np.asarray(drawn.disturbances)[after].any()
    assert np.asarray(drawn.disturbances)[~after].all()


@pytest.mark.parametrize(
    "bad, match",
    [
        (lambda: jast.replay(walk1d(), jnp.zeros((31,))), "between 0 and 30 rows"),
        (lambda: jast.replay(walk1d(), jnp.zeros(())), "between 0 and 30 rows"),
        (lambda: jast.replay(walk1d(), jnp.zeros((4, 2))), "disturbances must be"),
        (lambda: jast.replay(landing(), jnp.zeros((4,))), "x0 must be"),
        (lambda: jast.replay(landing(), jnp.zeros((4,)), x0=jnp.zeros((2,))), "x0 must be"),
    ],
)
def test_replay_names_what_does_not_fit(bad, match):
    with pytest.raises(ValueError, match=f"replay: .*{match}"):
        bad()


# ends

line = partial(walk_by_steps, horizon=4)


def test_a_failure_at_the_start_has_length_zero(key):
    sim = line(init=lambda x0: jnp.asarray(6.0))
    episode = jast.rollout(key, sim)
    assert (
        int(episode.length),
        bool(episode.failure),
        float(episode.distance),
        float(episode.log_prob),
    ) == (0, True, 0.0, 0.0)
    assert not np.asarray(episode.disturbances).any()
    started = line(init=lambda x0: x0, start=lambda: D.Normal(9.0, 1.0))
    episode = jast.rollout(key, started)
    assert int(episode.length) == 0
    assert float(episode.log_prob) == pytest.approx(float(D.Normal(9.0, 1.0).log_prob(episode.x0)))


def test_the_order_at_a_state_is_failure_then_terminal_then_horizon():
    both = line(is_terminal=lambda s: s >= 5)
    assert bool(jast.replay(both, floats([6.0])).failure)
    early = jast.replay(line(is_terminal=lambda s: s >= 3), floats([3.0, 3.0]))
    assert (int(early.length), bool(early.failure), float(early.distance)) == (1, False, 2.0)
    # in the step that reaches the horizon
    assert bool(jast.replay(line(), floats([2.0, 1.0, 1.0, 1.0])).failure)
    ended = jast.replay(line(is_terminal=lambda s: s >= 0), floats([6.0]))
    assert (int(ended.length), bool(ended.failure)) == (0, False)


def test_episodic_counts_the_end_only():
    passing = floats([6.0, -3.0, 0.0, 0.0])
    every, end = (
        jast.replay(line(), passing),
        jast.replay(line(episodic=True), passing),
    )
    assert (int(every.length), bool(every.failure)) == (1, True)
    assert (int(end.length), bool(end.failure), float(end.distance)) == (4, False, 2.0)
    stopped = jast.replay(line(episodic=True, is_terminal=lambda s: s >= 6), passing)
    assert (int(stopped.length), bool(stopped.failure)) == (1, True)


def test_a_failure_may_have_a_distance_and_the_least_one_counts():
    far = line(evaluate=lambda s: (s < 2, jnp.abs(s)), init=lambda x0: jnp.asarray(9.0))
    episode = jast.replay(far, floats([-5.0, 4.0, -7.0]))
    assert (int(episode.length), bool(episode.failure), float(episode.distance)) == (3, True, 1.0)
    away = jast.replay(far, floats([-5.0, 4.0]))
    assert float(away.distance) == 4.0


@pytest.mark.parametrize(
    "changes",
    [
        dict(step=lambda s, x: jnp.where(x > 2, jnp.nan, s + x)),
        dict(evaluate=lambda s: (s >= 5, jnp.where(s > 2, jnp.nan, 5 - s))),
        dict(evaluate=lambda s: (s >= 2, jnp.where(s > 2, jnp.nan, 5 - s))),
        dict(disturbance=lambda s: D.Normal(jnp.where(s > 0.5, jnp.nan, 0.0), 1.0)),
    ],
)
def test_nan_is_an_outcome(changes):
    episode = jast.replay(line(**changes), floats([1.0, 3.0, 0.0, 0.0]))
    assert (
        bool(episode.failure),
        float(episode.distance),
        float(episode.reward),
        int(episode.length),
    ) == (False, np.inf, -np.inf, 2)


def test_nan_after_the_end_is_not_counted():
    sim = line(step=lambda s, x: jnp.where(s >= 5, jnp.nan, s + x))
    episode = jast.replay(sim, floats([6.0]))
    assert bool(episode.failure)
    assert np.isfinite(episode.reward)
    assert np.isfinite(np.asarray(episode.states)).all()


def test_gradients_are_finite_where_an_ended_lane_would_give_nan(key):
    def step(s, x):
        return s + x * jnp.sqrt(5 - s) / jnp.sqrt(5.0)  # NaN beyond 5, where the episode has ended

    def reward(scale, key):
        sim = line(
            step=step,
            disturbance=Partial(lambda scale, s: D.Normal(jnp.zeros_like(scale) + 1, scale), scale),
            horizon=12,
        )
        return jast.rollout(key, sim, reward=rewards.shaped(1.0)).reward

    keys = jax.random.split(key, 20)
    gradients = jax.vmap(jax.grad(reward), (None, 0))(jnp.asarray(1.0), keys)
    assert np.isfinite(gradients).all() and (np.asarray(gradients) != 0).any()

    def tilted(shift, key):
        shifted = jast.Policy(D.Fixed, Partial(lambda shift, s, t: D.Normal(shift, 1.0), shift))
        return jast.rollout(key, line(step=step), shifted, reward=rewards.shaped(1.0)).reward

    assert np.isfinite(jax.vmap(jax.grad(tilted), (None, 0))(jnp.asarray(2.0), keys)).all()


# batches


def test_vmap_over_keys_is_a_loop(key):
    sim, keys = landing(b=0.2), jax.random.split(key, 7)
    many = jax.vmap(jast.rollout, (0, None))(keys, sim)
    for i, k in enumerate(keys):
        one = jast.rollout(k, sim)
        assert (bool(many.failure[i]), int(many.length[i])) == (bool(one.failure), int(one.length))
        np.testing.assert_allclose(many.disturbances[i], one.disturbances, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(many.log_prob[i], one.log_prob, rtol=1e-5)


def test_vmap_over_simulators_is_a_loop(key):
    xs = floats([5.0, 3.0, 1.0])
    stacked = jax.tree.map(
        lambda *a: jnp.stack(a), *(walk1d(threshold=b) for b in (4.0, 8.0, 12.0))
    )
    many = jax.vmap(lambda s: jast.replay(s, xs))(stacked)
    assert np.asarray(many.failure).tolist() == [True, True, False]
    assert np.asarray(many.length).tolist() == [1, 2, 3]
    swept = jax.vmap(lambda b: jast.rollout(key, landing(b=b)))(floats([0.01, 9.0]))
    assert np.asarray(swept.failure).tolist() == [True, False]
    ferries = jax.vmap(ferry)(floats([[16.0, 0.0], [17.0, 0.0]]))
    seeds = floats(FERRY["half"][0])
    both = jax.vmap(lambda s: jast.replay(s, seeds, reward=REWARD).reward)(ferries)
    assert float(both[1]) == pytest.approx(
        float(jast.replay(ferry((17.0, 0.0)), seeds, reward=REWARD).reward), rel=1e-5
    )


class Ring(NamedTuple):
    """The last three velocities, by a ring buffer, and a count of what was hit."""

    buffer: jax.Array
    next: jax.Array
    hits: jax.Array


def ring():
    """Disturbances that are a pytree of a float and an integer, a state with a ring buffer, an
    integer and a key's worth of memory.
    """
    return jast.Simulator(
        init=lambda x0: Ring(jnp.zeros((3, 2)), jnp.int32(0), jnp.int32(0)),
        step=lambda s, x: Ring(
            s.buffer.at[s.next].set(x["push"]),
            (s.next + 1) % 3,
            s.hits + (x["kind"] == 2).astype(jnp.int32),
        ),
        disturbance=lambda s: D.Joint(
            dict(
                push=D.MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)),
                kind=D.Categorical(probs=jnp.asarray([0.5, 0.3, 0.2])),
            )
        ),
        evaluate=lambda s: (s.hits >= 2, jnp.maximum(2 - s.hits, 0).astype(s.buffer.dtype)),
        horizon=6,
    )


def test_pytree_and_integer_disturbances_and_a_ring_buffer(key, equal):
    sim = jast.check(ring())
    keys = jax.random.split(key, 2000)
    many = jax.vmap(jast.rollout, (0, None))(keys, sim)
    assert jnp.issubdtype(many.disturbances["kind"].dtype, jnp.integer)
    assert many.disturbances["push"].shape == (2000, 6, 2)
    truth = 1 - 0.8**6 - 6 * 0.2 * 0.8**5  # two or more hits of six
    assert abs(float(many.failure.mean()) - truth) < 4 * np.sqrt(truth * (1 - truth) / 2000)
    one = jast.rollout(keys[0], sim)
    equal(one, jast.replay(sim, one))
    rows = int(one.length)
    got = np.log([0.5, 0.3, 0.2])[np.asarray(one.disturbances["kind"][:rows])].sum()
    got += (
        -0.5 * np.asarray(one.disturbances["push"][:rows], float) ** 2 - 0.5 * np.log(2 * np.pi)
    ).sum()
    assert float(one.log_prob) == pytest.approx(got, rel=1e-5)
    last = np.asarray(one.disturbances["push"][max(rows - 3, 0) : rows])
    assert np.asarray(one.states.buffer[rows]).sum() == pytest.approx(last.sum(), rel=1e-5)


def test_log_prob_counts_the_start(key):
    sim = landing()
    episode = jast.rollout(key, sim)
    expected = D.Normal(0.0, 0.1).log_prob(episode.x0) + sum(
        D.Normal(0.0, 0.03).log_prob(x) for x in episode.disturbances
    )
    assert float(episode.log_prob) == pytest.approx(float(expected), rel=1e-5)
    assert float(episode.states.x2[0]) == float(episode.x0)


# policies


def test_policies(key, equal):
    sim = ferry()
    quiet = jast.rollout(key, sim, policy.undisturbed(sim), reward=REWARD)
    assert float(quiet.reward) == pytest.approx(FERRY["half"][1], **within(1e-9, 1e-3))
    drawn = jast.replay(sim, jast.rollout(key, sim))
    rows = lambda state, t: D.Deterministic(jax.tree.map(lambda a: a[t], drawn.disturbances))
    again = jast.rollout(jax.random.fold_in(key, 1), sim, jast.Policy(sim.start, rows))
    # the true density, whatever the policy
    np.testing.assert_allclose(again.log_prob, drawn.log_prob, rtol=1e-5)
    equal(again.disturbances, drawn.disturbances)
    equal(jast.rollout(key, sim, policy.nominal_policy(sim)), jast.rollout(key, sim))


# rates


@pytest.mark.long
@pytest.mark.parametrize(
    "make, truth",
    [(walk1d, 0.1087363323), (lambda: walk1d("one-sided"), 9.578759495e-4)],
    ids=["two-sided", "one-sided"],
)
def test_walk_rate(make, truth, key):
    n = 200_000
    found = jast.nominal(key, make(), episodes=n)
    assert abs(found.rate - truth) < 4 * np.sqrt(truth * (1 - truth) / n)
    assert found.interval[0] < found.rate < found.interval[1]


@pytest.mark.slow
def test_landing_rate_depends_on_when_it_is_evaluated(key):
    n, at_end = 100_000, float(jast.simulators.landing_probability(b=0.2))
    assert at_end == pytest.approx(0.14679308730757, rel=1e-5)
    sim = landing(b=0.2)
    assert abs(jast.nominal(key, sim, episodes=n).rate - at_end) < 4 * np.sqrt(at_end / n)
    every = jast.Simulator(
        sim.init, sim.step, sim.disturbance, sim.evaluate, sim.horizon, start=sim.start
    )
    assert jast.nominal(key, every, episodes=n).rate == pytest.approx(
        0.2277, abs=4 * np.sqrt(0.2 / n) + 2e-3
    )
