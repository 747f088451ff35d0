import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast import rewards


def play(sim, xs, reward):
    return float(jast.replay(sim, jnp.asarray(xs, jnp.zeros(()).dtype), reward=reward).reward)


def log_normal(xs):
    return float(np.sum(-0.5 * np.asarray(xs) ** 2 - 0.5 * np.log(2 * np.pi)))


def test_standard_on_an_episode():
    walk = jast.simulators.walk1d("one-sided")
    hit, miss = [6.0, 5.0], [1.0] * 10
    assert play(walk, hit, rewards.standard()) == pytest.approx(log_normal(hit), rel=1e-5)
    assert play(walk, hit, rewards.standard(event_bonus=30.0)) == pytest.approx(
        log_normal(hit) + 30, rel=1e-5
    )
    assert play(walk, hit, rewards.standard(density="mode")) == pytest.approx(
        -0.5 * (36 + 25), rel=1e-5
    )
    miss[-1] = -1.0
    assert play(walk, miss, rewards.standard(event_bonus=30.0)) == pytest.approx(
        log_normal(miss) - 1, rel=1e-5
    )  # the closest, 9, not the last, 8


def test_episodic():
    reward = rewards.episodic(bonus=100.0)
    log_p = jnp.asarray(-2.0)
    assert reward(log_p, False, jnp.asarray(3.0), True) == -5  # log p - d
    assert reward(log_p, False, jnp.asarray(3.0), False) == -2
    assert reward(log_p, True, jnp.asarray(0.0), True) == -2
    # a deeper failure counts more
    assert reward(log_p, True, jnp.asarray(-0.5), True) == pytest.approx(-2 + 0.5 + 99 * 0.5)
    assert reward(log_p, True, jnp.asarray(-1e-3), True) > reward(
        log_p, False, jnp.asarray(1e-3), True
    )  # no cliff, as the printed equation has


def test_shaped_telescopes():
    walk = jast.simulators.walk1d("one-sided")
    miss, hit = [1.0, -2.0, 3.0] + [0.0] * 7, [6.0, 5.0]
    assert play(walk, miss, rewards.shaped(2.0)) == pytest.approx(
        log_normal(miss) + 2 * (10 - 8), rel=1e-5
    )
    assert play(walk, hit, rewards.shaped(2.0, event_bonus=7.0)) == pytest.approx(
        log_normal(hit) + 2 * 10 + 7, rel=1e-5
    )
    # one number does not move the order of two episodes with equal ends
    a, b = [3.0] * 4, [6.0, 5.0]
    gap = [
        play(walk, a, rewards.shaped(scale)) - play(walk, b, rewards.shaped(scale))
        for scale in (0.0, 5.0)
    ]
    assert gap[0] == pytest.approx(gap[1], rel=1e-4)


def test_the_last_step_counts():
    """Unlike the printed thesis eq. 3.1: an unlikely final step is paid for."""
    walk = jast.simulators.walk1d("one-sided")
    assert play(walk, [9.0, 1.0], rewards.standard()) > play(walk, [1.0, 9.5], rewards.standard())


@pytest.mark.parametrize(
    "make",
    [
        lambda d: rewards.standard(density=d),
        lambda d: rewards.episodic(density=d),
        lambda d: rewards.shaped(1.0, density=d),
    ],
)
def test_density_is_checked(make):
    assert rewards.density_of(make("mode")) == "mode"
    with pytest.raises(ValueError, match=r"rewards\.\w+: density must .*received .log."):
        make("log")


def test_weights_are_traced_and_any_function_is_a_reward():
    walk = jast.simulators.walk1d("one-sided")
    sweep = jax.vmap(
        lambda bonus: (
            jast.replay(walk, jnp.asarray([6.0, 5.0]), reward=rewards.standard(bonus)).reward
        )
    )(jnp.asarray([0.0, 10.0]))
    assert float(sweep[1] - sweep[0]) == pytest.approx(10, rel=1e-5)

    def own(log_p, event, distance, terminal, approach):
        return jnp.where(event, 1.0, 0.0).astype(log_p.dtype)

    assert play(walk, [6.0, 5.0], own) == 1
    assert play(walk, [6.0, 5.0], jax.tree_util.Partial(own)) == 1
    assert float(jast.rollout(jax.random.key(0), walk, reward=own).reward) in (0, 1)

    def normalised(log_p, event, distance, terminal, approach):
        return log_p

    normalised.density = "mode"
    assert play(walk, [6.0, 5.0], normalised) == pytest.approx(-30.5)
