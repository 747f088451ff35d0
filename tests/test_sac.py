"""Soft actor-critic: what is learned, the start by the critics, reproducibility, numbers that are
not finite, errors, files and interruptions.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import (
    check_key_decides,
    check_rows,
    check_training_goes_on,
    weighted_episodes,
    whole_training,
)
from scipy import integrate, stats
from systems import walk

import jast
from jast import distributions as D
from jast.policies import FailurePolicy, load, sac, save

TINY = dict(episodes=256, lanes=8, hidden=(16,), batch=32, updates=1)
SMALL = dict(episodes=2000, lanes=16, hidden=(32, 32), batch=128, learning_rate=3e-3, updates=15)


def _start():
    return D.Normal(jnp.zeros(()), 1.0)


def _init(x0):
    return x0


def _step(s, x):
    return s + x


def _disturbance(s):
    return D.Normal(jnp.zeros_like(s), 1.0)


def _evaluate(s):
    return jnp.abs(s) > 5.0, jnp.maximum(5.0 - jnp.abs(s), 0.0)


TWO_SIDES = jast.Simulator(_init, _step, _disturbance, _evaluate, 2, start=_start, episodic=True)
"""x0 + x1 + x2 beyond +-5: P = 2 Phi(-5 / sqrt 3) = .0038924, given which x0 is about +-1.8."""
ONE_WAY_OR_THE_OTHER = jast.Simulator(
    lambda x0: jnp.zeros(()),
    _step,
    _disturbance,
    lambda s: (jnp.abs(s) > 4.0, jnp.maximum(4.0 - jnp.abs(s), 0.0)),
    1,
)
"""P = 2 Phi(-4) = 6.334e-5, both ways out of the one start."""
WALK = walk()


@pytest.fixture(scope="module")
def learned():
    return sac(jax.random.key(1), TWO_SIDES, **SMALL)


@pytest.mark.long
def test_a_learned_policy_fails_on_both_sides_and_its_weights_give_the_probability(learned, key):
    """2 Phi(-5 / sqrt 3) = .0038924 within 4 SE of 4000 episodes, SE below 4 % (crude Monte Carlo:
    25 %), half of it on each side.
    """
    log_w, x0, _ = weighted_episodes(key, TWO_SIDES, learned, 4000)
    w = np.exp(np.float64(log_w))
    se = w.std() / np.sqrt(len(w))
    truth = 2 * stats.norm.sf(5 / np.sqrt(3))
    assert abs(w.mean() - truth) < 4 * se < 0.16 * truth
    assert 0.4 < w[np.asarray(x0) > 0].sum() / w.sum() < 0.6
    assert np.mean(w > 0) > 0.4


@pytest.mark.long
def test_the_start_is_what_the_critics_say_of_the_true_value(learned):
    """p(x0) exp(V_true) given failure, by quadrature: at +-1.74 on average (V not freed of lambda
    d(s0) would draw it to 0), deviation about .8.
    """
    x = np.linspace(-6, 6, 1201)
    given = stats.norm.pdf(x) * (
        stats.norm.sf((5 - x) / np.sqrt(2)) + stats.norm.sf((5 + x) / np.sqrt(2))
    )
    given /= integrate.simpson(given, x=x)
    wanted = integrate.simpson(given * np.abs(x), x=x)
    density = np.exp(
        np.float64(jax.vmap(learned.start().log_prob)(jnp.asarray(x, jnp.zeros(()).dtype)))
    )
    np.testing.assert_allclose(integrate.simpson(density, x=x), 1, atol=5e-3)
    own = (density - 0.05 * stats.norm.pdf(x)) / 0.95
    assert abs(integrate.simpson(own * np.abs(x), x=x) - wanted) < 0.35
    assert integrate.simpson(np.minimum(own, given), x=x) > 0.75
    assert abs(integrate.simpson(own * (x > 0), x=x) - 0.5) < 0.1


@pytest.mark.long
def test_two_ways_out_of_one_state_are_both_taken(key):
    """From a fixed start: the probability within 4 SE, SE below 4 %, half of it on each side; a
    policy of one component leaves a side out.
    """
    policy = sac(key, ONE_WAY_OR_THE_OTHER, **SMALL | dict(updates=30))
    log_w, _, sides = weighted_episodes(key, ONE_WAY_OR_THE_OTHER, policy, 4000)
    w, truth = np.exp(np.float64(log_w)), 2 * stats.norm.sf(4)
    assert abs(w.mean() - truth) < 4 * w.std() / np.sqrt(len(w)) < 0.16 * truth
    assert 0.4 < w[np.asarray(sides) > 0].sum() / w.sum() < 0.6


@pytest.mark.long
def test_the_mode_is_a_deterministic_policy_that_pushes_outwards(learned):
    for side in (-1.0, 1.0):
        state = jnp.asarray(side * 3.0)
        dist = learned.disturbance(state, jnp.int32(1))
        assert 1.0 < side * float(D.mode(dist)) < 3.5  # 2 and a little more get there
        np.testing.assert_allclose(D.mode(dist), dist.means[jnp.argmax(dist.weights), 0], rtol=1e-5)


@pytest.mark.long
def test_the_curve_tells_what_was_learned(learned):
    h = learned.history
    assert h.episodes[-1] >= SMALL["episodes"] - SMALL["lanes"]
    assert np.all(np.diff(h.episodes) >= 0)
    assert h.invalid[-1] == 0
    assert h.failing_share[-1] > 0.4 and h.critic_loss[-1] < h.critic_loss[0]
    text = str(learned)
    assert "lambda" in text
    assert "start" in text
    assert len(text.splitlines()) < 14


@pytest.mark.long
def test_a_policy_goes_through_jit_and_vmap(learned, key):
    keys = jax.random.split(key, 3)
    play = jax.jit(
        jax.vmap(lambda k, policy: jast.rollout(k, TWO_SIDES, policy).log_prob, (0, None))
    )
    given = play(keys, learned)
    assert given.shape == (3,) and bool(jnp.all(jnp.isfinite(given)))


def train(number, **settings):
    return sac(jax.random.key(number), WALK, **TINY, **settings)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    return whole_training(train, tmp_path_factory.mktemp("sac") / "whole.jast")


@pytest.mark.slow
def test_the_callback_gets_the_rows_of_the_history(whole_run):
    check_rows(*whole_run[:2])


def test_the_same_key_gives_the_same_policy(whole_run, equal):
    check_key_decides(train, whole_run[0], equal)


def test_an_interrupted_training_goes_on_to_the_same_bits(whole_run, equal, tmp_path):
    check_training_goes_on(train, whole_run[0], tmp_path / "run.jast", equal)


@pytest.mark.slow
def test_a_checkpoint_of_another_training_is_refused(whole_run):
    path = whole_run[2]
    with pytest.raises(
        ValueError, match="sac: checkpoint .* belongs to another call: rates.polyak is"
    ):
        sac(jax.random.key(3), WALK, **TINY, polyak=0.5, checkpoint=path)
    with pytest.raises(ValueError, match="sac: checkpoint .* belongs to another call: key is"):
        sac(jax.random.key(4), WALK, **TINY, checkpoint=path)


def test_an_interruption_before_anything_was_learned_is_raised(monkeypatch):
    from jast._src.policies import soft_actor_critic_training

    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(soft_actor_critic_training, "train", stop)
    with pytest.raises(KeyboardInterrupt):
        sac(jax.random.key(3), WALK, **TINY)


def test_a_saved_policy_is_the_same(learned, equal, tmp_path, key):
    path = tmp_path / "policy.npz"
    save(path, learned)
    again = load(path, TWO_SIDES)
    assert isinstance(again, FailurePolicy)
    equal(again.learned, learned.learned)
    equal(again.history, learned.history)
    equal(jast.rollout(key, TWO_SIDES, again), jast.rollout(key, TWO_SIDES, learned))


@pytest.mark.slow
def test_a_file_that_does_not_fit_is_refused(learned, whole_run, tmp_path):
    path = tmp_path / "policy.npz"
    save(path, learned)
    with pytest.raises(ValueError, match="does not fit sim: its horizon is 2, expected 6"):
        load(path, WALK)
    with pytest.raises(ValueError, match="does not fit sim: the start has the structure .*Tilt"):
        load(path, walk(horizon=2))
    two = jast.Simulator(
        lambda x0: jnp.stack([x0, x0]),
        _step,
        lambda s: D.Normal(s.sum() * 0, 1.0),
        lambda s: (s[0] > 3, 3 - s[0]),
        2,
        start=_start,
    )
    with pytest.raises(ValueError, match="does not fit sim: actor"):
        load(path, two)
    with pytest.raises(ValueError, match="is not a file of jast.save but a folder"):
        load(whole_run[2], WALK)


@pytest.mark.long
def test_what_is_not_finite_is_counted_and_never_learned_from():
    """A tenth of the episodes and more come to a state that is NaN: every parameter stays finite,
    and failures are still found.
    """
    nan = walk(step=lambda s, x: jnp.where(s + x < -2.0, jnp.nan, s + x))
    policy = sac(jax.random.key(5), nan, **TINY)
    assert policy.history.invalid[-1] > 20
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(policy.learned))
    assert np.isfinite(policy.history.mean_return).all() and policy.history.failing_share[-1] > 0.2
    assert "not finite" in str(policy)


@pytest.mark.long
def test_lambda_is_raised_while_too_few_fail():
    """A system that no episode of so few makes fail, with a distance that tells the model nothing
    new: lambda rises, at most to where three quarters are.
    """
    far = walk(fails=lambda s: s > 1e6)
    h = sac(jax.random.key(6), far, **TINY).history
    steps = h.scale[1:] / h.scale[:-1]
    assert set(np.round(steps, 3)) == {1.0, 1.5} and 8 <= np.sum(steps > 1.2) <= 12
    assert steps[0] == 1.0 and steps[-1] == 1.0
    fixed = sac(jax.random.key(6), far, **TINY, scale=2.0, alpha=0.5).history
    np.testing.assert_allclose(fixed.scale, 2.0)
    np.testing.assert_allclose(fixed.alpha, 0.5, rtol=1e-6)


@pytest.mark.long
def test_the_temperature_follows_the_entropy():
    """A wanted entropy that no policy of deviations up to e^2 has draws alpha up, one far below
    draws it down.
    """
    high, low = (
        sac(jax.random.key(7), WALK, **TINY, alpha="auto", entropy=e).history.alpha
        for e in (3.0, -3.0)
    )
    assert np.all(np.diff(high) > 0) and np.all(np.diff(low) < 0)


@pytest.mark.parametrize(
    "setting, value, words",
    [
        ("episodes", 0, "episodes must be a whole number of at least 1, received 0"),
        ("episodes", 30, "episodes must be at least 4 for each lane, 32, received 30"),
        ("lanes", 1.5, "lanes must be a whole number of at least 1, received 1.5"),
        ("batch", -1, "batch must be a whole number"),
        ("buffer", "big", "buffer must be a whole number"),
        ("hidden", (), "hidden must be the widths of one or more layers"),
        ("hidden", (3, 0), "hidden must be a whole number of at least 1, received 0"),
        ("scale", -1.0, "scale must be a number above 0"),
        ("scale", "large", "scale must be a number above 0"),
        ("alpha", 0.0, "alpha must be a number above 0"),
        ("entropy", float("nan"), "entropy must be a number that is finite"),
        ("bonus", float("inf"), "bonus must be a number that is finite"),
        ("shaping", "never", 'shaping must be "auto", "steps" or "end", received \'never\''),
        ("widen", 0.5, "widen must be a number of at least 1, received 0.5"),
        ("learning_rate", 0, "learning_rate must be a number above 0"),
        ("updates", 0, "updates must be a whole number of at least 1, received 0"),
        ("polyak", 1.5, "polyak must be a number above 0 and at most 1"),
    ],
)
def test_settings_out_of_range_are_named(setting, value, words):
    with pytest.raises(ValueError, match=f"sac: {words}"):
        sac(jax.random.key(0), WALK, **(TINY | {setting: value}))


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_landing_without_a_word_about_its_modes(seed):
    """P = 4.0236721906842e-13: 100,000 episodes of the policy as it draws and of its start give it
    within 10 %, with an SE below 2 %, half on each side.
    """
    sim = jast.simulators.landing()
    policy = sac(jax.random.key(seed), sim)
    log_w, x0, _ = weighted_episodes(jax.random.key(100 + seed), sim, policy, 100_000)
    w = np.exp(np.float64(log_w))
    assert abs(w.mean() / 4.0236721906842e-13 - 1) < 0.1
    assert w.std() / w.mean() / np.sqrt(len(w)) < 0.02
    assert 0.3 < w[np.asarray(x0) > 0].sum() / w.sum() < 0.7
