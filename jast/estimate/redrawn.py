"""More episodes of the proposal that an estimate was made with."""

from typing import Any

import jax
import numpy as np

from jast import distributions as D
from jast import limit_state as latent
from jast.distributions.parts import parts
from jast.episode import rollout
from jast.estimate import markov_tilts as tilts
from jast.estimate.batches import drawn, numbers
from jast.policy import Policy

__all__ = ["fits", "redrawn"]


def redrawn(key: Any, sim: Any, q: Any, n: int) -> tuple[np.ndarray, Any, np.ndarray]:
    """``n`` episodes of ``q``, a `Latent` or `Tilts`: (points z [n, D], `Outcomes`, log p - log q).
    On the host.

    A choice that was made without a normal number has the middle of its interval as one.
    """
    if isinstance(q, latent.Latent):
        return drawn(sim, q, *numbers(key, n, q.means.shape[1], q.means.dtype))[:3]
    about, dtype = tilts.shape(sim), latent.normal_numbers(sim)
    chance = tilts.numbers(key, n, about, sim.horizon, dtype)
    o, ratio, trace = tilts.played(sim, q, *chance)
    z = latent.normal_of(sim, _episodes(sim, trace))
    return z, o, tilts.log_weight(q, ratio)[0]


def fits(sim: Any, q: Any) -> bool:
    """Whether ``q`` is a proposal of `jast.estimate.failure_probability` for this simulator."""
    if isinstance(q, latent.Latent):
        return q.means.shape[1] == latent.dimension(sim)
    return isinstance(q, tilts.Tilts) and q.frame.centre.shape[0] == tilts.shape(sim).seen


@jax.jit
def _episodes(sim, trace):
    """The `jast.Episode` of each of these traces, without states."""

    def one(first, steps):
        z, i = steps.normals, steps.choices
        policy = Policy(
            lambda: D.Deterministic(
                tilts.assembled(parts(sim.start()), first.first_normals, first.first_choices)
            ),
            lambda s, t: D.Deterministic(tilts.assembled(parts(sim.disturbance(s)), z[t], i[t])),
        )
        return rollout(jax.random.key(0), sim, policy)._replace(states=None)

    rows = tilts.Trace(*(0,) * 3, *(1,) * 4)
    return jax.vmap(one, (rows, rows))(trace, trace)
