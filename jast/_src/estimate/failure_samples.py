"""The failure distribution p(x | failure): independent failures as they would happen, which is what
a user looks at.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.policy import Policy
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PathLike, PRNGKey
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.host_populations import equilibrate
from jast._src.estimate.importance_sampling import draw_episodes
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.estimate.proposals import Proposal, as_proposal
from jast._src.estimate.redraw import dimension_of, redraw
from jast._src.estimate.tilts.tilts import Tilts, shape
from jast._src.io.data_frames import dataset
from jast._src.normal_space import transform
from jast._src.runtime.checkpoints import answer_once, keep_answers, open_checkpoint
from jast._src.runtime.memory import require_episodes
from jast._src.util import display
from jast._src.util.checks import check_random_key, whole_number, wrong
from jast._src.util.pytrees import index_tree

__all__ = ["FailureSamples", "failure_samples"]

DRAWS_PER_SAMPLE = 10
"""Episodes that are drawn for each failure, so that few of them are copies."""


@display.result_class("ess")
class FailureSamples(NamedTuple):
    """Failures drawn from p(x | failure).

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing()
        >>> proposal = jast.estimate.failure_proposal(key, sim, samples=200).policy
        >>> drawn = jast.estimate.failure_samples(key, sim, proposal, 50)
        >>> drawn.failures.disturbances.shape, 1 <= drawn.distinct <= 50
        ((50, 10), True)
    """

    failures: Episode
    """A batch, leading axis [n]; without states (`jast.replay` gives them)"""
    ess: float
    """Effective number of the weighted failures that they were resampled from"""
    distinct: int
    """How many different failures the resampling took; the Markov chain then moves the copies
    apart"""
    accepted: float
    """Share of the last Markov moves that was accepted"""
    evaluations: int
    """Episodes simulated in all"""

    def to_xarray(self) -> Any:
        """The failures as `jast.Episode.to_xarray` has them; ``ess``, ``distinct`` and ``accepted``
        are attributes. Copies of one failure are neighbours, apart by the Markov moves alone.
        """
        numbers = dict(ess=self.ess, distinct=self.distinct, accepted=self.accepted)
        return dataset(self.failures, **numbers)

    @display.Former
    def episodes(self) -> Episode:
        """Deprecated: ``failures``."""
        return display.renamed(self, "episodes", "failures")

    def __str__(self) -> str:
        e = self.failures
        return (
            f"{len(e.length)} failures from {self.distinct} distinct ones (ESS {self.ess:.4g}),"
            f" {self.accepted:.0%} of the last moves accepted; {np.min(e.length)} to"
            f" {np.max(e.length)} steps, log p {np.min(e.log_prob):.4g} to"
            f" {np.max(e.log_prob):.4g}"
        )


def failure_samples(
    key: PRNGKey,
    sim: Simulator,
    source: Estimate | Proposal | Policy,
    samples: int = 1000,
    *,
    moves: int = 20,
    checkpoint: PathLike | None = None,
) -> FailureSamples:
    """Failures drawn nearly from p(x | failure): weighted failures of a proposal are resampled, and
    each then makes Markov moves.

    The moves change the latent normal numbers (conditional sampling) and keep p(x | failure). They
    bring in no failure mode that the proposal lacks, and the shares of modes are those of the
    weights.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        source: an `Estimate` of `failure_probability` or `population`, a `Proposal`, or a
            `jast.Policy` with densities; ``10 * samples`` episodes are drawn from it. The failures
            of populations are taken as they are.
        samples: failures to return.
        moves: Markov moves of each.
        checkpoint: a folder that keeps what the system answered. The same call then goes on where
            it was stopped, to the same result (docs/scale.md).

    Returns:
        `FailureSamples`.

    Raises:
        ValueError: for a source without a proposal or without a failure among its episodes, a count
            below 1, disturbances without a quantile function, and a checkpoint of another call.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing()
        >>> proposal = jast.estimate.failure_proposal(key, sim, samples=200).policy
        >>> drawn = jast.estimate.failure_samples(key, sim, proposal, 50)
        >>> bool(drawn.failures.failure.all())
        True
    """
    name = "failure_samples"
    check_random_key(name, key)
    samples, moves = whole_number(name, "samples", samples), whole_number(name, "moves", moves, 0)
    transform.check(name, sim)
    q = source.proposal if isinstance(source, Estimate) else source
    if q is None and isinstance(source, Estimate):
        must = "hold a proposal"
        raise wrong(name, "source", must, f"an estimate by {source.method} without one")
    require_episodes(name, sim, DRAWS_PER_SAMPLE * samples)
    about = dict(sim=sim, source=q, samples=samples, moves=moves)
    with open_checkpoint(name, checkpoint, key, **about) as store, keep_answers(store):
        return _draw_failures(name, key, sim, q, samples, moves)


def _draw_failures(name, key, sim, q, samples, moves):
    key, for_draws, for_rows = jax.random.split(key, 3)
    n = DRAWS_PER_SAMPLE * samples
    _check_source(name, sim, q)
    if isinstance(q, Sample):  # they are failures, which nobody has to look for
        z, log_w = q.points, q.log_weight
        failure, n = np.ones(len(z), bool), 0
    elif isinstance(q, transform.Latent | Tilts):
        z, o, log_w = redraw(for_draws, sim, q, n)
        failure = o.failure
    else:
        q, key_data = as_proposal(name, sim, q), jax.random.key_data(for_draws)
        e, log_w = answer_once(lambda _: draw_episodes(for_draws, sim, q, n), key_data)
        z, failure = transform.normal_of(sim, e), e.failure
    log_w = np.where(failure & np.isfinite(log_w), log_w, -np.inf).astype(np.float64)
    if not np.isfinite(log_w).any():
        must = "be a proposal under which failures are frequent"
        raise wrong(name, "source", must, f"one with no failure in {n} episodes")
    rows = resample(log_w, samples, float(jax.random.uniform(for_rows)))
    moved, sampler = equilibrate(key, sim, z[rows], moves)
    episodes = answer_once(partial(transform.episodes, sim), moved.z)
    # numbers that decided nothing are no part of an episode; and rounding differs between compiled
    # programs, so an episode on the edge of failure may not fail again
    episodes = index_tree(episodes, episodes.failure)
    return FailureSamples(
        failures=episodes,
        ess=effective_sample_size(log_w),
        distinct=len(np.unique(rows)),
        accepted=sampler.accepted,
        evaluations=n + sampler.evaluations,
    )


def _check_source(name, sim, q):
    """ValueError where ``q`` is of a simulator with other numbers."""
    if isinstance(q, Tilts):
        received, expected = q.frame.centre.shape[0], shape(sim).seen
        words = f"whose states show {expected} numbers, received one of a simulator that shows"
    else:
        received, expected = dimension_of(q), transform.dimension(sim)
        words = f"with {expected} random numbers in an episode, received one with"
    if received not in (None, expected):
        raise ValueError(f"{name}: source must be of this simulator, {words} {received}")
