"""The estimate by draws of a proposal, a mixture of Gaussians or tilts, and its failure modes: the
groups of Gaussians that lie in the same direction; of tilts all but the model.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.estimate import diagnostics
from jast._src.estimate.estimate import Estimate, estimate_from_weights
from jast._src.estimate.importance_sampling import Traces, chunks
from jast._src.estimate.proposal_search.mixture_draws import (
    component_numbers,
    draw_mixture,
    numbers_of_chunk,
)
from jast._src.estimate.tilts.tilts import Tilts, draw_tilts
from jast._src.estimate.weighted_draws import with_source
from jast._src.normal_space import transform
from jast._src.runtime.progress_bar import Watch
from jast._src.runtime.work import Placement

__all__ = ["draw_estimate"]

APART = 0.6  # cosine of the angle between two means below which they are two modes
TILTS = 2  # address of the random numbers of tilts


def draw_estimate(
    key: jax.Array,
    sim: Simulator,
    q: transform.Latent | Tilts,
    lanes: int,
    watch: Watch,
    placement: Placement,
    *,
    spent: int,
    reasons: Sequence[str],
    share: float = 0.0,
    drawn: int = 0,
    **about: Any,
) -> Estimate:
    """The `Estimate` of as many draws of ``q`` as ``watch`` has, ``lanes`` at a time, after
    ``spent`` evaluations. A ``share`` of them are the model's own, of which ``drawn`` stand beside
    them; ``about``: of `estimate.estimate.estimate_from_weights`.
    """
    modes, model, at_model = _modes(q)

    def plain(i):
        numbers = component_numbers(key, i, lanes, q.log_weights.dtype)
        return model[transform.component(q, numbers)]

    shared = key, sim, q, _members(modes, len(model)), lanes, watch.total
    total, notes, lost = chunks(_traces, shared, lanes, watch, placement, plain)
    central = [i for i, mode in enumerate(modes) if at_model[mode].all()]
    found = estimate_from_weights(
        watch.name,
        total,
        notes=notes,
        evaluations=spent + total.samples,
        groups=_groups(len(modes), central, total) if total.first > 0 else [],
        proposal=q,
        reasons=[*reasons, *lost],
        control=int(share * total.samples) + drawn,
        **about,
    )
    return found._replace(draws=with_source(found.draws, key, lanes, q))


def _modes(q):
    """Of the components [K] of ``q``: groups of those that are used, as lists of numbers; which are
    the model itself; and which lie where it does.
    """
    if isinstance(q, Tilts):
        model = np.arange(len(q.log_weights)) == 0
        return [[0], list(range(1, int(np.isfinite(q.log_weights).sum())))], model, model
    return _by_direction(q), transform.is_model(q), ~np.asarray(q.means).any(axis=1)


def _members(modes, components):
    """[K, K] the mode of each component, as 0 and 1; of those that are not used the last place."""
    owner = np.full(components, components - 1)
    for i, mode in enumerate(modes):
        owner[mode] = i
    return np.eye(components)[owner]


def _groups(modes, central, total):
    """So many modes as `estimate_from_weights` has them, by number; what the ``central`` ones
    carry, in which the model's own draws lie, is a mode of its own where it matters, and else
    counts with the greatest.
    """
    share = total.by_component / total.first
    plain = [i for i in central if share[i] < diagnostics.MIN_MODE_SHARE]
    others = sorted((i for i in range(modes) if i not in plain), key=lambda i: share[i])
    groups = [[i] for i in others]
    return [*groups[:-1], [*groups[-1], *plain]] if groups else [[i] for i in range(modes)]


def _by_direction(q):
    """Groups of the components whose means point the same way: failure modes, as lists of
    numbers.
    """
    used = np.flatnonzero(np.isfinite(np.asarray(q.log_weights)))
    ways = transform.unit(np.asarray(q.means, np.float64)[used])
    near = (ways @ ways.T > APART) | np.eye(len(used), dtype=bool)
    label, last = np.arange(len(used)), None
    while not np.array_equal(label, last):  # each takes the least label of those near to it
        label, last = np.where(near, label, len(used)).min(axis=1), label
    return [used[label == i].tolist() for i in np.unique(label)]


def _traces(shared, i, context):
    """`Traces` of chunk ``i`` of ``q``; ``members`` [K, K]: of which modes the shares are."""
    key, sim, q, members, lanes, samples = shared
    n = min(lanes, samples - i * lanes)
    if isinstance(q, Tilts):
        o, log_w, shares, _ = draw_tilts(sim, q, numpy_generator(key, TILTS, i), lanes, n)
    else:
        _, o, log_w, shares = draw_mixture(sim, q, *numbers_of_chunk(key, i, n, q))
    with np.errstate(divide="ignore"):
        shares = np.log(np.exp(shares) @ members)
    return Traces(
        log_weight=log_w,
        shares=shares,
        failure=o.failure,
        invalid=o.invalid,
        length=o.length,
        distance=o.distance,
    )
