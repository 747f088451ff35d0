"""Draws of an estimate made again, and more draws of its proposal."""

from typing import Any

import jax
import numpy as np

from jast import distributions as D
from jast._src.core.counter_prng import numpy_generator
from jast._src.core.episode import rollout
from jast._src.core.policy import Policy
from jast._src.distributions.independent_parts import parts
from jast._src.estimate.population.failure_sample import Sample, steps_of
from jast._src.estimate.proposal_search.mixture_draws import (
    draw_mixture,
    numbers_of_chunk,
    plain_chunk,
    random_numbers,
    resample,
)
from jast._src.estimate.tilts import tilts
from jast._src.estimate.weighted_draws import Draws, source_key
from jast._src.normal_space import transform
from jast._src.normal_space.transform import Outcomes
from jast._src.runtime._jax import jit

__all__ = [
    "dimension_of",
    "is_proposal_of",
    "redraw",
    "redraw_chunk",
    "redraw_failures",
    "sample_of_draws",
]


def redraw(key: Any, sim: Any, q: Any, n: int) -> tuple[np.ndarray, Outcomes, np.ndarray]:
    """``n`` episodes of ``q``, a `Latent`, `Tilts` or `Sample`: (points z [n, D], `Outcomes`,
    log p - log q). On the host.

    A choice that was made without a normal number has the middle of its interval as one. Of a
    `Sample` its own failures come back, chosen by weight, and nothing is run.
    """
    if isinstance(q, Sample):
        return _choose_failures(key, sim, q, n)
    if isinstance(q, tilts.Tilts):
        o, log_w, _, trace = tilts.draw_tilts(sim, q, key, n, n)
        return transform.normal_of(sim, _episodes_of_traces(sim, trace)), o, log_w
    return draw_mixture(sim, q, *random_numbers(key, n, q.means.shape[1], q.means.dtype))[:3]


def is_proposal_of(sim: Any, q: Any) -> bool:
    """Whether ``q`` is a proposal of `jast.estimate.failure_probability` for this simulator."""
    if (d := dimension_of(q)) is not None:
        return d == transform.dimension(sim)
    if not isinstance(q, tilts.Tilts):
        return False
    about = tilts.shape(sim)

    def sizes(block):
        return block.means.shape[3], *block.shifts.shape[2:]

    received = sizes(q.first), sizes(q.steps), q.frame.centre.shape[0]
    return received == (about.first[:3], about.steps[:3], about.seen)


def dimension_of(q: Any) -> int | None:
    """Random numbers of an episode of the system that ``q`` is of, where it is a mixture of
    Gaussians or a `Sample`; else None.
    """
    if isinstance(q, transform.Latent):
        return q.means.shape[1]
    return q.points.shape[1] if isinstance(q, Sample) else None


def redraw_chunk(key: Any, i: int, sim: Any, q: Any, n: int, lanes: int) -> np.ndarray:
    """The first ``n`` points, or more, of the ``lanes`` of chunk ``i`` of an estimate with the
    draws of ``q``, which may be "model". On the host.
    """
    if isinstance(q, str):
        return plain_chunk(key, i, n, sim)
    if isinstance(q, Sample):
        return q.points[i * lanes : i * lanes + n]
    if isinstance(q, tilts.Tilts):
        return redraw(numpy_generator(key, 2, i), sim, q, lanes)[0]
    return transform.place(q, *numbers_of_chunk(key, i, n, q))


def redraw_failures(
    sim: Any, draws: Draws, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The failing draws that an estimate kept, at most ``most``, evenly taken: (points z [m, D],
    log p - log q [m], steps [m], evaluations). Only tilts, which look at states, evaluate, and
    nothing is judged again. On the host.
    """
    kept = np.flatnonzero(draws.failure)
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, min(most, len(kept))).astype(int))]
    key, rows = source_key(draws), draws.row[kept]
    points, chunks = [], np.unique(rows // draws.lanes)
    for i in chunks:
        lanes = rows[rows // draws.lanes == i] % draws.lanes
        n = int(lanes.max()) + 1
        points.append(redraw_chunk(key, int(i), sim, draws.source, n, draws.lanes)[lanes])
    spent = len(chunks) * draws.lanes * isinstance(draws.source, tilts.Tilts)
    log_w = draws.log_weight[kept].astype(np.float64)
    return np.concatenate(points), log_w, draws.length[kept], spent


def sample_of_draws(sim: Any, draws: Draws, most: int) -> Sample:
    """The `Sample` of the failing draws that `redraw_failures` makes again, each by itself."""
    points, log_w, length, _ = redraw_failures(sim, draws, most)
    return Sample(
        points=points,
        used=transform.used_numbers(sim, length).astype(np.int32),
        distance=np.zeros(len(points), points.dtype),
        log_weight=log_w,
        group=np.arange(len(points), dtype=np.int32),
    )


def _choose_failures(key, sim, sample, n):
    rows = resample(sample.log_weight, n, numpy_generator(key).random())
    used = sample.used[rows]
    o = Outcomes(
        failure=np.ones(n, bool),
        distance=sample.distance[rows],
        used=used,
        length=steps_of(sim, used),
        invalid=np.zeros(n, bool),
    )
    return sample.points[rows], o, np.zeros(n)


@jit
def _episodes_of_traces(sim, trace):
    """The `jast.Episode` of each of these traces, without states."""

    def one(trace):
        def start():
            x0 = tilts.assemble(parts(sim.start()), trace.first_normals, trace.first_choices)
            return D.Deterministic(x0)

        def disturbance(s, t):
            z, i = trace.normals[t], trace.choices[t]
            return D.Deterministic(tilts.assemble(parts(sim.disturbance(s)), z, i))

        policy = Policy(start, disturbance)
        return rollout(jax.random.key(0), sim, policy)._replace(states=None)

    return jax.vmap(one)(trace)
