"""A key that is none is named at every public call that takes one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast.simulators import walk1d

E, C, S = jast.estimate, jast.cross_entropy, jast.search
CALLS = {
    "nominal": lambda key: jast.nominal(key, walk1d(), episodes=1),
    "rollout": lambda key: jast.rollout(key, walk1d()),
    "monte_carlo": lambda key: S.monte_carlo(key, walk1d(), episodes=1),
    "forest": lambda key: S.forest(key, walk1d(), trees=1, prunes=1, simulations=1),
    "falsify": lambda key: S.falsify(key, walk1d()),
    "mcts": lambda key: S.mcts(key, walk1d(), simulations=1),
    "cem": lambda key: S.cem(key, walk1d(), samples=2, elites=1, iterations=1),
    "ce_method": lambda key: C.ce_method(key, jnp.sum, (jnp.zeros(1), jnp.eye(1))),
    "ce_surrogate": lambda key: C.ce_surrogate(key, jnp.sum, (jnp.zeros(1), jnp.eye(1))),
    "ce_mixture": lambda key: C.ce_mixture(key, jnp.sum, (jnp.zeros(1), jnp.eye(1))),
    "start": lambda key: C.start(key, (jnp.zeros(1), jnp.eye(1))),
    "ppo": lambda key: jast.policies.ppo(key, walk1d()),
    "sac": lambda key: jast.policies.sac(key, walk1d()),
    "q_learning": lambda key: jast.policies.q_learning(key, walk1d()),
    "importance": lambda key: E.importance(key, walk1d(), None),
    "log_weights": lambda key: E.log_weights(key, walk1d(), None, 2),
    "failure_probability": lambda key: E.failure_probability(key, walk1d()),
    "splitting": lambda key: E.splitting(key, walk1d()),
    "subset_simulation": lambda key: E.subset_simulation(key, walk1d()),
    "adaptive_cross_entropy": lambda key: E.adaptive_cross_entropy(key, walk1d()),
    "failure_proposal": lambda key: E.failure_proposal(key, walk1d()),
    "failure_samples": lambda key: E.failure_samples(key, walk1d(), None),
    "validate": lambda key: jast.weakness.validate(key, np.sign, np.eye(2), np.array([0, 1])),
    "influence": lambda key: jast.weakness.influence(key, None, None, None),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_number_for_a_key_is_named(name):
    with pytest.raises(ValueError) as error:
        CALLS[name](0)
    said = f"{name}: key must be a jax.random.key: jax.random.key(0), received int 0"
    assert str(error.value) == said


@pytest.mark.parametrize(
    "key, received",
    [
        (None, "received NoneType None"),
        (jnp.zeros(2), r"received float32\[2\]|received float64\[2\]"),
        (jax.random.split(jax.random.key(0), 3), r"received key<fry>\[3\]"),
        (jnp.zeros((2, 2), jnp.uint32), r"received uint32\[2, 2\]"),
    ],
)
def test_what_else_is_no_key(key, received):
    with pytest.raises(ValueError, match=f"nominal: key must be a jax.random.key, {received}"):
        jast.nominal(key, walk1d(), episodes=1)


def test_keys_are_taken_of_every_kind_and_traced(equal):
    raw = jax.random.PRNGKey(3)
    equal(jast.rollout(raw, walk1d()).disturbances, jast.rollout(jax.random.key(3), walk1d())[1])
    keys = jax.random.split(jax.random.key(0), 2)
    assert jax.vmap(lambda k: jast.rollout(k, walk1d()).log_prob)(keys).shape == (2,)
    assert jast.rollout(jax.random.key(1, impl="rbg"), walk1d()).length > 0
