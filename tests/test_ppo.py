"""Proximal policy optimisation: advantages and the clipped objective against closed values, what is
learned, reproducibility, files, interruptions, numbers that are not finite, errors.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import check_key_decides, check_rows, check_training_goes_on, whole_training
from scipy import stats
from systems import ring, walk

import jast
from jast._src.policies import proximal_training
from jast._src.policies.actor import entropy_term, latent_mixture, make_networks
from jast._src.policies.failure_policy import assemble
from jast.estimate import importance, policy_proposal
from jast.policies import FailurePolicy, ppo, sac

TINY = dict(episodes=256, lanes=8, hidden=(8,), batch=16, epochs=2)
SMALL = dict(episodes=2000, lanes=32, hidden=(32, 32), batch=64, learning_rate=3e-3)
WALK = walk()
ONE_SIDED = jast.simulators.walk1d("one-sided")
"""Ten standard normal steps; to be at 10 or beyond after one of them: P = 9.578759495e-4."""


def plain(reward, value, done, valid, trace):
    """Generalised advantages of one lane by their definition, a sum for each step."""
    steps, out = len(reward), np.zeros(len(reward))
    for t in range(steps):
        weight = 1.0
        for u in range(t, steps):
            if not valid[u]:
                break
            out[t] += weight * (reward[u] + (0 if done[u] else value[u + 1]) - value[u])
            if done[u]:
                break
            weight *= trace
    return out


@pytest.mark.parametrize("trace", [0.0, 0.9, 1.0])
def test_advantages_are_the_sums_that_define_them(trace, dtype):
    """Lanes with episodes that end, break off at a step that is not valid, or go on."""
    draw = np.random.default_rng(3)
    reward, value = draw.normal(size=(40, 5)), draw.normal(size=(41, 5))
    done, valid = draw.random((40, 5)) < 0.1, draw.random((40, 5)) > 0.1
    given = proximal_training.advantages(
        *map(jnp.asarray, (reward.astype(dtype), value.astype(dtype))), done, valid, trace
    )
    assert given.dtype == dtype
    assert (done & valid).any()
    assert (~valid).any()
    expected = np.stack(
        [plain(*(a[:, i] for a in (reward, value, done, valid)), trace) for i in range(5)], 1
    )
    tolerance = 1e-5 if dtype == "float32" else 1e-12
    np.testing.assert_allclose(given, expected, rtol=tolerance, atol=tolerance)


def test_the_advantage_of_a_whole_return_needs_no_value_but_its_own():
    """Trace 1: what an episode pays from here on, less the value here."""
    reward, value = jnp.array([1.0, 2.0, 4.0]), jnp.array([10.0, 20.0, 30.0, 99.0])
    given = proximal_training.advantages(
        reward, value, jnp.array([False, False, True]), jnp.ones(3, bool), 1.0
    )
    np.testing.assert_allclose(given, [7 - 10, 6 - 20, 4 - 30])


@pytest.mark.parametrize(
    "ratio, advantage, value, slope",
    [
        (1.0, 2.0, 2.0, 2.0),
        (1.1, 2.0, 2.2, 2.2),
        (1.5, 2.0, 2.4, 0.0),  # gained enough
        (0.5, 2.0, 1.0, 1.0),  # lost: all the way back
        (0.5, -2.0, -1.6, 0.0),
        (1.5, -2.0, -3.0, -3.0),
    ],
)
def test_the_clipped_objective_and_its_slope(ratio, advantage, value, slope, dtype):
    """min(r A, clip(r, .8, 1.2) A); its slope in log r is r A, or 0 where clipping wins."""
    log_ratio, advantage = jnp.log(jnp.asarray(ratio, dtype)), jnp.asarray(advantage, dtype)
    given = jax.value_and_grad(proximal_training.surrogate)(log_ratio, advantage, 0.2)
    np.testing.assert_allclose(given, (value, slope), rtol=1e-6)


def drawn(key, n=64):
    """A learner, its functions, rates and a batch of ``n`` draws of a policy of one component."""
    rates = proximal_training.Rates(*(jnp.float32(v) for v in (0.01, 0.2, 0.95, 1.0, 0.0, 100.0)))
    _, applies = make_networks(2, (8,), 1)
    new = proximal_training.init_learner(key, 1, 2, (8,), 1, rates.alpha)
    for_inputs, for_z, for_numbers = jax.random.split(key, 3)
    inputs = jax.random.normal(for_inputs, (n, 3), jnp.float32)
    z = jax.random.normal(for_z, (n, 2), jnp.float32)
    log_pi = jax.vmap(lambda i, z: entropy_term(z, *latent_mixture(applies[0], new.actor, i)))(
        inputs, z
    )
    advantage, goal = jax.random.normal(for_numbers, (2, n), jnp.float32)
    return (
        new,
        applies,
        rates,
        proximal_training.Batch(inputs, z, log_pi, advantage, goal, jnp.ones(n, jnp.float32)),
    )


@pytest.mark.slow
def test_an_update_goes_along_the_gradients(key):
    """Adam's first step is the rate in the sign of each gradient: of the critic's squares, and for
    the actor, whose ratio is still 1, of the mean of A log pi.
    """
    old, applies, rates, batch = drawn(key)
    new, loss = jax.jit(proximal_training.update, static_argnums=1)(
        old, applies, rates, jnp.float32(0.01), batch
    )

    def gain(actor):
        out = jax.vmap(applies[0], (None, 0))(actor, batch.inputs)[:, 0]
        mean, deviation = out[:, 1:3], jnp.exp(2 * jnp.tanh(out[:, 3:] / 2))
        log_pi = jnp.sum(jax.scipy.stats.norm.logpdf(batch.z, mean, deviation), axis=1)
        return jnp.mean(batch.advantage * log_pi)

    misses = lambda critic: jnp.mean(
        (jax.vmap(applies[1], (None, 0))(critic, batch.inputs) - batch.target) ** 2
    )
    np.testing.assert_allclose(loss, misses(old.critic), rtol=1e-5)
    for name, f, sign in (("actor", gain, 1), ("critic", misses, -1)):
        before, after = getattr(old, name), getattr(new, name)
        for slope, a, b in zip(
            *map(jax.tree.leaves, (jax.grad(f)(before), before, after)), strict=True
        ):
            clear = np.abs(slope) > 1e-5
            assert clear.any()
            np.testing.assert_allclose(
                (b - a)[clear], 0.01 * sign * np.sign(slope[clear]), rtol=1e-2
            )


def test_a_step_of_weight_0_is_not_learned_from(key, equal):
    old, applies, rates, batch = drawn(key)
    half = jnp.arange(64) < 32
    spoilt = batch._replace(
        advantage=jnp.where(half, batch.advantage, 1e6),
        target=jnp.where(half, batch.target, -1e6),
        weight=half.astype(jnp.float32),
    )
    clean = spoilt._replace(
        advantage=jnp.where(half, batch.advantage, 0), target=jnp.where(half, batch.target, 0)
    )
    step = jax.jit(proximal_training.update, static_argnums=1)
    one, other = (step(old, applies, rates, jnp.float32(0.01), b) for b in (spoilt, clean))
    equal(one, other)


@pytest.fixture(scope="module")
def learned():
    return ppo(jax.random.key(1), ONE_SIDED, **SMALL)


def shares(key, policy, sim=ONE_SIDED, n=4000):
    """Share of failures in ``n`` episodes, and its standard error."""
    play = jax.jit(jax.vmap(lambda k, policy: jast.rollout(k, sim, policy).failure, (0, None)))
    share = float(jnp.mean(play(jax.random.split(key, n), policy)))
    return share, np.sqrt(share * (1 - share) / n)


@pytest.mark.long
def test_a_learned_policy_fails_far_more_often_than_one_that_learned_nothing(learned, key):
    """By .3 and 4 standard errors of the difference; the model itself fails in one of 1044."""
    n, apply = 1, learned.disturbance.args[1]
    new = proximal_training.init_learner(key, n, n, SMALL["hidden"], 2, jnp.float32(1)).actor
    nothing = assemble(ONE_SIDED, apply, True, learned.learned._replace(actor=new), learned.history)
    for_new, for_learned = jax.random.split(key)
    untrained, error = shares(for_new, nothing)
    share, own = shares(for_learned, learned)
    assert untrained < 0.1
    assert share - untrained > 0.3 + 4 * np.hypot(error, own)


@pytest.mark.long
def test_its_weights_give_the_probability(learned, key):
    """9.578759495e-4 within 4 SE of 20,000 episodes, SE below 4 % (crude Monte Carlo: 23 %)."""
    r = importance(key, ONE_SIDED, policy_proposal(ONE_SIDED, learned), 20_000)
    assert r.reliable
    assert abs(r.mean / 9.578759495e-4 - 1) < 4 * r.relative_error < 0.16


@pytest.mark.long
def test_two_modes_from_a_random_start_that_is_far_from_both():
    """Landing, P = 4.0236721906842e-13: within 4 SE and 10 %, SE below 4 %, both modes."""
    sim = jast.simulators.landing()
    policy = ppo(jax.random.key(0), sim)
    r = importance(jax.random.key(100), sim, policy_proposal(sim, policy), 20_000)
    error = abs(r.mean / 4.0236721906842e-13 - 1)
    assert r.reliable
    assert r.relative_error < 0.04
    assert error < min(0.1, 4 * r.relative_error)
    means = np.asarray(policy.learned.tilt.means)[:, 0]
    up = np.asarray(policy.learned.tilt.weights)[means > 0].sum()
    assert 0.3 < up < 0.7


@pytest.mark.long
def test_a_reward_at_the_end_alone_is_learned_from(key):
    """An episodic system that is judged after its last step, where the model fails in Phi(-3 /
    sqrt 6) = .110 of the episodes: by 4 standard errors, the policy in more than twice as many.
    """
    sim = walk(episodic=True)
    policy = ppo(jax.random.key(2), sim, **SMALL, shaping="end")
    share, error = shares(key, policy, sim)
    assert not policy.disturbance.args[2]
    assert share - 4 * error > 2 * stats.norm.sf(3 / np.sqrt(6))


def train(number, **settings):
    return ppo(jax.random.key(number), WALK, **TINY, **settings)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    return whole_training(train, tmp_path_factory.mktemp("ppo") / "whole.jast")


@pytest.mark.long
def test_the_callback_gets_the_rows_of_the_history(whole_run):
    check_rows(*whole_run[:2])


@pytest.mark.long
def test_the_same_key_gives_the_same_policy(whole_run, equal):
    check_key_decides(train, whole_run[0], equal)


@pytest.mark.long
def test_an_interrupted_training_goes_on_to_the_same_bits(whole_run, equal, tmp_path):
    check_training_goes_on(train, whole_run[0], tmp_path / "run.jast", equal)


@pytest.mark.long
def test_a_checkpoint_of_another_training_is_refused(whole_run):
    path = whole_run[2]
    with pytest.raises(ValueError, match="ppo: checkpoint .* another call: rates.clip is"):
        ppo(jax.random.key(3), WALK, **TINY, clip=0.1, checkpoint=path)
    with pytest.raises(
        ValueError, match="sac: .* another call: function is 'ppo' there, 'sac' here"
    ):
        sac(jax.random.key(3), WALK, episodes=256, lanes=8, checkpoint=path)


def test_an_interruption_before_anything_was_learned_is_raised(monkeypatch):
    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(proximal_training, "train", stop)
    with pytest.raises(KeyboardInterrupt):
        ppo(jax.random.key(3), WALK, **TINY)


@pytest.mark.long
def test_a_saved_policy_is_the_same(whole_run, equal, tmp_path, key):
    policy, path = whole_run[0], tmp_path / "policy.npz"
    jast.save(path, policy)
    again = jast.load(path, WALK)
    assert isinstance(again, FailurePolicy)
    equal(again.learned, policy.learned)
    equal(again.history, policy.history)
    equal(jast.rollout(key, WALK, again), jast.rollout(key, WALK, policy))
    with pytest.raises(ValueError, match="does not fit sim: its horizon is 6, expected 7"):
        jast.load(path, walk(horizon=7))


@pytest.mark.long
def test_a_saved_start_is_the_same(equal, tmp_path):
    sim = jast.simulators.landing()
    policy = ppo(jax.random.key(0), sim, **TINY)
    jast.save(tmp_path / "policy", policy)
    equal(jast.load(tmp_path / "policy", sim).learned, policy.learned)


@pytest.mark.slow
def test_what_is_not_finite_is_counted_and_never_learned_from():
    """A tenth of the episodes and more come to a state that is NaN: every parameter stays finite,
    and failures are still found.
    """
    nan = walk(step=lambda s, x: jnp.where(s + x < -2.0, jnp.nan, s + x))
    policy = ppo(jax.random.key(5), nan, **TINY)
    assert policy.invalid > 20 and "not finite" in str(policy)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(policy.learned))
    assert np.isfinite(policy.history.mean_return).all()


@pytest.mark.parametrize(
    "setting, value, words",
    [
        ("episodes", 0, "episodes must be a whole number of at least 1, received 0"),
        ("episodes", 30, "episodes must be at least 4 for each lane, 32, received 30"),
        ("lanes", 1.5, "lanes must be a whole number of at least 1, received 1.5"),
        ("batch", -1, "batch must be a whole number"),
        ("epochs", 0, "epochs must be a whole number of at least 1, received 0"),
        ("steps", "all", "steps must be a whole number of at least 1, received 'all'"),
        ("components", None, "components must be a whole number"),
        ("hidden", 3, "hidden must be the widths of one or more layers, received 3"),
        ("scale", 0, "scale must be a number above 0"),
        ("alpha", "auto", "alpha must be a number above 0, received 'auto'"),
        ("bonus", float("nan"), "bonus must be a number that is finite"),
        ("shaping", "never", 'shaping must be "auto", "steps" or "end", received \'never\''),
        ("widen", 0.5, "widen must be a number of at least 1, received 0.5"),
        ("learning_rate", -1, "learning_rate must be a number above 0"),
        ("clip", 1.0, "clip must be a number above 0 and below 1, received 1.0"),
        ("trace", 1.1, "trace must be a number of 0 to 1, received 1.1"),
    ],
)
def test_settings_out_of_range_are_named(setting, value, words):
    with pytest.raises(ValueError, match=f"ppo: {words}"):
        ppo(jax.random.key(0), WALK, **(TINY | {setting: value}))


def test_disturbances_that_are_not_floats_are_named():
    with pytest.raises(ValueError, match="ppo: disturbance: expected floats, received float.*int"):
        ppo(jax.random.key(0), ring(), **TINY)
