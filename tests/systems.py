"""Small systems that several tests search."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

import jast
from jast.distributions import Categorical, Independent, Joint, Normal

S0 = dict(
    reward=jast.rewards.standard(event_bonus=30.0, density="mode"),
    actions=jast.actions.uniform(0.0, 1.0),
)
"""The reward and the actions of the published ferry."""


class Ring(NamedTuple):
    """The last three gusts, in a ring buffer, and where the next one goes."""

    gusts: jax.Array
    at: jax.Array
    hits: jax.Array


def _ring_start():
    return Joint({"gust": Normal(0.0, 1.0), "hit": Categorical(probs=jnp.array([0.5, 0.5]))})


def _ring_init(x0):
    return Ring(jnp.zeros(3).at[0].set(x0["gust"]), jnp.int32(1), x0["hit"].astype(jnp.int32))


def _ring_step(s, x):
    return Ring(
        s.gusts.at[s.at % 3].set(x["gust"].sum()), s.at + 1, s.hits + x["hit"].astype(jnp.int32)
    )


def _ring_disturbance(s):
    hit = jnp.where(s.hits > 2, 0.2, 0.4)
    return Joint(
        {
            "gust": Independent(Normal(jnp.zeros(2), 0.5), 1),
            "hit": Categorical(probs=jnp.stack([1 - hit, hit])),
        }
    )


def _ring_evaluate(s):
    return (s.gusts.sum() > 3.0) & (s.hits >= 2), jnp.maximum(3.0 - s.gusts.sum(), 0) + jnp.maximum(
        2 - s.hits, 0
    ).astype(s.gusts.dtype)


def ring():
    """A memory of three steps with integers in state, start and disturbance; fails now and then."""
    return jast.Simulator(
        _ring_init, _ring_step, _ring_disturbance, _ring_evaluate, 8, start=_ring_start
    )


def walk(
    init=lambda x0: jnp.zeros(()),
    step=lambda s, x: s + x,
    fails=lambda s: s > 3.0,
    horizon=6,
    **fields,
):
    """A random walk of standard normal steps: what a test changes is all it says."""
    evaluate = lambda s: (fails(s), jnp.maximum(3.0 - s, 0.0))
    return jast.Simulator(
        init, step, lambda s: Normal(jnp.zeros(()), 1.0), evaluate, horizon, **fields
    )


def two_densities():
    """Breaks the contract: a disturbance of two numbers that has a density each."""
    return jast.Simulator(
        lambda x0: jnp.zeros(2),
        lambda s, x: s + x,
        lambda s: Normal(s, 1.0),
        lambda s: (s[0] > 1, s[0]),
        3,
    )


def _plane_init(x0):
    return jnp.zeros(2)


def _plane_step(s, x):
    return s + x


def _plane_disturbance(s):
    return Independent(Normal(jnp.zeros_like(s), 1.0), 1)


def _plane_evaluate(threshold, s):
    gone = (s[0] + s[1]) / jnp.sqrt(2.0).astype(s.dtype)
    return gone > threshold, jnp.maximum(threshold - gone, 0)


def _plane_observe(sight, s):
    return jnp.where(jnp.abs(s[0]) <= sight, s, jnp.nan)


def plane(threshold=3.0, sight=jnp.inf):
    """Five normal steps in two dimensions that fail ``threshold`` up the diagonal; ``observe``
    shows NaN where the first coordinate is out of ``sight``.
    """
    threshold, sight = (jnp.asarray(v, jnp.zeros(()).dtype) for v in (threshold, sight))
    evaluate, observe = Partial(_plane_evaluate, threshold), Partial(_plane_observe, sight)
    return jast.Simulator(
        _plane_init, _plane_step, _plane_disturbance, evaluate, 5, observe=observe
    )
