"""The rollout head as a policy: its histogram is a density, and its draws have it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import ring, walk

import jast
from jast import actions, heads
from jast._src.heads.train_heads import with_moments
from jast.distributions import Independent, Normal
from jast.heads import Heads, as_policy

LOGITS = jnp.asarray([[0.0, 1.0, -1.0, 0.5], [2.0, 0.0, 0.0, -2.0]], jnp.float32)


def fixed(logits, n):
    """Heads whose policy gives these logits everywhere."""
    return with_moments(Heads(policy=(logits, lambda params, seen: params)), n, logits.shape[0])


def plane():
    """Two numbers in the plane, normal steps."""
    normal = lambda s: Independent(Normal(jnp.asarray([1.0, -1.0]), jnp.asarray([0.5, 2.0])), 1)
    return jast.Simulator(
        lambda x0: jnp.zeros(2), lambda s, x: s + x, normal, lambda s: (s[0] > 3, s[0]), 3
    )


def at_start(sim, policy):
    return policy.disturbance(sim.init(()), 0)


def test_the_density_of_a_box_integrates_to_one():
    sim = walk()
    d = at_start(sim, as_policy(sim, fixed(LOGITS[:1], 1), actions.uniform(-3.0, 5.0)))
    n = 4000
    # midpoints: exact for a density constant in cells
    x = -3.0 + 8.0 * (jnp.arange(n, dtype=float) + 0.5) / n
    density = np.exp(np.asarray(jax.vmap(d.log_prob)(x), np.float64))
    assert density.mean() * 8.0 == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(
        density.reshape(4, -1),
        np.asarray(jax.nn.softmax(LOGITS[0]))[:, None] * np.full(n // 4, 4 / 8.0),
        rtol=1e-5,
    )
    assert d.log_prob(jnp.asarray(5.5)) == -jnp.inf


def test_the_density_on_quantiles_integrates_to_one():
    sim = plane()
    d = at_start(sim, as_policy(sim, fixed(LOGITS, 2), actions.samples(), power=1.5))
    n = 400
    u = (jnp.arange(n, dtype=float) + 0.5) / n
    x0, x1 = jnp.meshgrid(1 + 0.5 * 12 * (u - 0.5), -1 + 2.0 * 12 * (u - 0.5), indexing="ij")
    log_p = jax.vmap(d.log_prob)(jnp.stack([x0.ravel(), x1.ravel()], axis=1))
    cell = 0.5 * 12 / n * 2.0 * 12 / n
    # the density jumps between cells, so the midpoint rule is off by up to a jump's height times
    # half a step at each of 3 + 3 jumps
    assert float(jnp.sum(jnp.exp(log_p)) * cell) == pytest.approx(1, abs=6 * 0.5 * 12 / n)


@pytest.mark.slow
@pytest.mark.parametrize(
    "choose", [actions.samples(), actions.quantiles(), actions.uniform(-4.0, 4.0)]
)
def test_draws_have_the_density(choose):
    """E_q[p / q] = 1 over the support that q covers, within 4 standard errors of 20,000 draws."""
    sim = walk()
    d = at_start(sim, as_policy(sim, fixed(LOGITS[:1], 1), choose))
    x = jax.vmap(lambda key: d.sample(seed=key))(jax.random.split(jax.random.key(5), 20_000))
    weights = np.exp(
        np.asarray(jax.vmap(lambda x: Normal(0.0, 1.0).log_prob(x) - d.log_prob(x))(x), np.float64)
    )
    # a box of four deviations leaves 6e-5 out
    assert abs(weights.mean() - 1) < 4 * weights.std() / np.sqrt(len(weights)) + 1e-4


def test_it_is_a_policy_like_any_other():
    """A head that knows one cell keeps a rollout in it; the log probability is the system's own."""
    sim = walk(horizon=6)
    policy = as_policy(
        sim, fixed(jnp.asarray([[0.0, 40.0]], jnp.float32), 1), actions.uniform(-2.0, 2.0)
    )
    episodes = jax.vmap(lambda key: jast.rollout(key, sim, policy))(
        jax.random.split(jax.random.key(0), 50)
    )
    played = np.arange(6)[None] < np.asarray(episodes.length)[:, None]
    assert (np.asarray(episodes.disturbances)[played] >= 0).all() and episodes.failure.mean() > 0.9
    one = jast.rollout(jax.random.key(1), sim, policy)
    expected = sum(float(Normal(0.0, 1.0).log_prob(x)) for x in one.disturbances[: int(one.length)])
    assert float(one.log_prob) == pytest.approx(expected, rel=1e-5)


def test_what_cannot_be_a_policy_is_refused():
    with pytest.raises(ValueError, match="expected heads with a policy head"):
        as_policy(
            walk(),
            with_moments(Heads(value=(0.0, lambda params, x: x.sum())), 1, 1),
            actions.samples(),
        )
    with pytest.raises(ValueError, match="expected a disturbance of floats"):
        as_policy(ring(), fixed(jnp.zeros((3, 4)), 5), actions.samples())
    d = at_start(walk(), heads.as_policy(walk(), fixed(LOGITS[:1], 1), actions.samples()))
    with pytest.raises(ValueError, match="sample_shape"):
        d.sample(seed=jax.random.key(0), sample_shape=(2,))
