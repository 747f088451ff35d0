"""What `jast.check` asks of objects that are judged at the end only: whether failures are lost by
that.
"""

import warnings

import jax
import jax.numpy as jnp
from jax import lax

from jast import distributions as D
from jast._src.core.simulator import Simulator, first_state, next_state
from jast._src.runtime.host_errors import hosts_of
from jast._src.util.pytrees import select

__all__ = ["EPISODES", "warn_of_lost_failures"]

EPISODES = 16  # half of them drawn from the model, half from its tails, where failures are
TAIL = 0.02  # the probability of both tails together


def warn_of_lost_failures(sim: Simulator) -> None:
    """Warn (UserWarning) where episodes of ``sim``, whose objects are judged at the end only, fail
    on the way and no longer at the end.

    Runs `EPISODES` more episodes, looked at after every disturbance. An ``is_event`` that raises
    before the end is not compared.
    """
    for host in hosts_of(sim):
        if host.spec.run or not host.spec.episodic:
            continue
        drawn = jax.device_get(_draw(jax.random.key(2), sim))
        if not (lost := host.lost(*map(jax.tree.leaves, drawn))):
            continue
        warnings.warn(
            f"from_python: in {lost} of {EPISODES} episodes is_event() is True during the episode"
            " and False at its end; with episodic=True these do not count as failures. If"
            " is_event says whether the system fails now, leave episodic out: every state is"
            " judged then. If it means something only at the end, all is well",
            stacklevel=3,
        )


@jax.jit
def _draw(key, sim):
    """x0 [EPISODES, ...] and disturbances [EPISODES, horizon, ...]."""

    def episode(key, wild):
        def choose(key, dist):
            drawn = D.sample(dist, key)
            if not D.has_quantile(dist):
                return drawn
            u = jax.tree.map(
                lambda s: _in_tails(jax.random.uniform(key, s.shape, D.float_dtype(s.dtype))),
                D.event_like(dist),
            )
            return select(wild, D.quantile(dist, u), drawn)

        def step(state, t):
            x = choose(jax.random.fold_in(key, t), sim.disturbance(state))
            return next_state(sim, state, x), x

        x0 = choose(key, sim.start())
        return x0, lax.scan(step, first_state(sim, x0), jnp.arange(1, sim.horizon + 1))[1]

    return jax.vmap(episode)(jax.random.split(key, EPISODES), jnp.arange(EPISODES) >= EPISODES // 2)


def _in_tails(u):
    """``u`` in [0, 1) moved into the tails: below TAIL / 2 or above 1 - TAIL / 2."""
    return jnp.where(u < 0.5, TAIL * u, 1 - TAIL * (1 - u))
