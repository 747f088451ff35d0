"""Small systems that several tests search."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest
from jax.tree_util import Partial

import jast
from jast._src.core.rewards import STANDARD
from jast.distributions import Categorical, Independent, Joint, Normal, seeds

PUBLISHED = [
    0.9795401687709587,
    0.931634727796635,
    0.9182992945295753,
    0.9875367896498295,
    0.9540570304688828,
    0.8771477273691892,
    0.862390861979752,
    0.8795539869456118,
    0.8453253347665413,
    0.8486280841264486,
    0.6894060333380425,
    0.6295909310314968,
    0.41676262118668805,
    0.4127368211497019,
    0.41815086583326605,
    0.4188880550807259,
    0.4833180771470985,
    0.4700646283098928,
    0.44995750050640954,
    0.454360642513824,
]
"""The best failure published for the ferry: reward 29.092054904933118, collision at step 20."""
TOLD = dict(reward=STANDARD, actions=jast.actions.samples())
"""What a search needs no episodes before it for, so that its counts are exact."""

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


def _dice_init(x0):
    return jnp.zeros((), jnp.int32)


def _dice_step(s, x):
    return s + (x % 6).astype(jnp.int32)


def _dice_disturbance(s):
    return seeds()


def _dice_evaluate(s):
    return s >= 30, jnp.maximum(30 - s, 0).astype(jnp.zeros(()).dtype)


def dice():
    """Eight throws from seeds, whose density is unknown; fails at 30 points."""
    return jast.Simulator(_dice_init, _dice_step, _dice_disturbance, _dice_evaluate, 8)


def _gap(beta, x):
    return beta - x.sum() / jnp.sqrt(x.size).astype(x.dtype)


def hyperplane(beta=4.0, dimension=4):
    """P(failure) = Phi(-beta)."""
    return jast.simulators.limit_state(Partial(_gap, jnp.asarray(beta)), dimension)


def line(**changes):
    """A walk by given steps, as a simulator to be bent."""
    fields = dict(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x,
        disturbance=lambda s: Normal(0.0, 1.0),
        evaluate=lambda s: (s >= 5, jnp.maximum(5 - s, 0)),
        horizon=10,
    )
    return jast.Simulator(**(fields | changes))


def above(limit, horizon, **changes):
    """A sum of standard normal steps that fails from ``limit`` on; new functions at every call."""
    evaluate = lambda s: (s >= limit, jnp.maximum(limit - s, 0.0))
    return line(**dict(evaluate=evaluate, horizon=horizon) | changes)


def mark_long(cases, *long):
    """The cases of a parametrization. Those of ``long`` run with the long tests: others make the
    same claim of another system, method or precision.
    """
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=pytest.mark.long if case in long else (),
        )
        for case in cases
    ]
