"""The draws of an estimate, and more of its proposal."""

from typing import Any

import jax
import numpy as np

from jast import distributions as D
from jast import limit_state as latent
from jast._jax import jit
from jast.counter import numpy_generator
from jast.distributions.parts import parts
from jast.episode import rollout
from jast.estimate import markov_tilts as tilts
from jast.estimate.batches import drawn, numbers, of_chunk, plain_chunk, resampled
from jast.estimate.draws import Draws, key_of
from jast.estimate.sample import Sample
from jast.limit_state import Outcomes
from jast.outline import outline
from jast.policy import Policy
from jast.pytrees import count_numbers

__all__ = ["failing", "fits", "numbers_of", "points", "redrawn"]


def redrawn(key: Any, sim: Any, q: Any, n: int) -> tuple[np.ndarray, Any, np.ndarray]:
    """``n`` episodes of ``q``, a `Latent`, `Tilts` or `Sample`: (points z [n, D], `Outcomes`,
    log p - log q).
    On the host.

    A choice that was made without a normal number has the middle of its interval as one. Of a
    `Sample` its own failures come back, chosen by weight, and nothing is run.
    """
    if isinstance(q, Sample):
        rows = resampled(q.log_weight, n, numpy_generator(key).random())
        steps = (q.used - count_numbers(outline(sim).x0)) // max(count_numbers(outline(sim).x), 1)
        some = Outcomes(np.ones(n, bool), *(a[rows] for a in (q.distance, q.used, steps)), None)
        return q.points[rows], some._replace(invalid=np.zeros(n, bool)), np.zeros(n)
    if isinstance(q, latent.Latent):
        return drawn(sim, q, *numbers(key, n, q.means.shape[1], q.means.dtype))[:3]
    about, dtype = tilts.shape(sim), latent.normal_numbers(sim)
    chance = tilts.numbers(key, n, about, sim.horizon, dtype)
    o, ratio, trace = tilts.played(sim, q, *chance)
    z = latent.normal_of(sim, _episodes(sim, trace))
    return z, o, tilts.log_weight(q, ratio)[0]


def fits(sim: Any, q: Any) -> bool:
    """Whether ``q`` is a proposal of `jast.estimate.failure_probability` for this simulator."""
    if (d := numbers_of(q)) is not None:
        return d == latent.dimension(sim)
    if not isinstance(q, tilts.Tilts):
        return False
    about = tilts.shape(sim)
    sizes = lambda block: (block.means.shape[3], *block.shifts.shape[2:])
    return (
        q.frame.centre.shape[0] == about.seen
        and sizes(q.steps) == (about.normals, about.choices, about.categories)
        and sizes(q.first) == (about.normals0, about.choices0, about.categories0)
    )


def numbers_of(q: Any) -> int | None:
    """Random numbers of an episode of the system that ``q`` is of, where it is a mixture of
    Gaussians or a `Sample`; else None.
    """
    if isinstance(q, latent.Latent):
        return q.means.shape[1]
    return q.points.shape[1] if isinstance(q, Sample) else None


def points(key: Any, i: int, sim: Any, q: Any, n: int, lanes: int) -> np.ndarray:
    """The first ``n`` points, or more, of the ``lanes`` of chunk ``i`` of an estimate with the
    draws of ``q``. On the host.
    """
    if isinstance(q, str):
        return plain_chunk(key, i, n, sim)
    if isinstance(q, Sample):
        return q.points[i * lanes : i * lanes + n]
    if isinstance(q, tilts.Tilts):
        return redrawn(numpy_generator(key, 2, i), sim, q, lanes)[0]
    return latent.place(q, *of_chunk(key, i, n, q))


def failing(sim: Any, draws: Draws, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The failing draws that an estimate kept, at most ``most``, evenly taken: (points z [m, D],
    log p - log q [m], steps [m], evaluations). Only tilts, which look at states, evaluate, and
    nothing is judged again. On the host.
    """
    kept = np.flatnonzero(draws.failure)
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, min(most, len(kept))).astype(int))]
    rows, key, out = draws.row[kept], key_of(draws), []
    chunks = np.unique(rows // draws.lanes)
    for i in chunks:
        lanes = rows[rows // draws.lanes == i] % draws.lanes
        made = points(key, int(i), sim, draws.source, int(lanes.max()) + 1, draws.lanes)
        out.append(made[lanes])
    spent = len(chunks) * draws.lanes * isinstance(draws.source, tilts.Tilts)
    log_w, length = draws.log_weight[kept].astype(np.float64), draws.length[kept]
    return np.concatenate(out), log_w, length, spent


@jit
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
