"""The estimate by draws of a mixture of Gaussians, and its failure modes: the groups of components
that lie in the same direction.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jast import limit_state as latent
from jast.estimate import batches, diagnostics
from jast.estimate.batches import of_chunk, picks
from jast.estimate.draws import drawn_by
from jast.estimate.estimate import Estimate, estimate
from jast.estimate.importance_sampling import Traces, chunks
from jast.simulator import Simulator
from jast.units import Ways
from jast.watch import Watch

__all__ = ["estimated"]

APART = 0.6
"""Cosine of the angle between two means below which they are two modes."""


def estimated(
    key: jax.Array,
    sim: Simulator,
    q: latent.Latent,
    lanes: int,
    watch: Watch,
    ways: Ways,
    *,
    spent: int,
    reasons: Sequence[str],
    share: float = 0.0,
    drawn: int = 0,
    **about: Any,
) -> Estimate:
    """The `Estimate` of as many draws of ``q`` as ``watch`` has, ``lanes`` at a time, after
    ``spent`` evaluations. A ``share`` of them are the model's own, of which ``drawn`` stand beside
    them; ``about``: of `jast.estimate.estimate.estimate`.
    """
    modes = _by_direction(q)
    member = np.eye(len(q.means))[_owner(modes, len(q.means))]
    model = latent.of_the_model(q)
    plain = lambda i: model[latent.component(q, picks(key, i, lanes, q.means.dtype))]
    shared = key, sim, q, member, lanes, watch.total
    total, notes, lost = chunks(_traces, shared, lanes, watch, ways, plain)
    found = estimate(
        watch.name,
        total,
        notes=notes,
        evaluations=spent + total.samples,
        groups=_groups(q, modes, total) if total.first > 0 else [],
        proposal=q,
        reasons=[*reasons, *lost],
        control=int(share * total.samples) + drawn,
        **about,
    )
    return found._replace(draws=drawn_by(found.draws, key, lanes, q))


def _groups(q, modes, total):
    """The ``modes`` as `estimate` has them, by number; what the model's own draws carry is one of
    its own where it matters, and else counts with the greatest.
    """
    groups, share = (
        [[i] for i in range(len(modes))],
        lambda g: total.by_component[g[0]] / total.first,
    )
    central = lambda g: not np.asarray(q.means)[modes[g[0]]].any()
    plain = [g for g in groups if central(g) and share(g) < diagnostics.MATTERS]
    others = sorted((g for g in groups if g not in plain), key=share)
    return [*others[:-1], sum(plain, others[-1])] if others else groups


def _owner(modes, components):
    """[K] number of the mode of each component; those that are not used have the last place."""
    owner = np.full(components, components - 1)
    for i, group in enumerate(modes):
        owner[group] = i
    return owner


def _by_direction(q):
    """Groups of the components whose means point the same way: failure modes, as lists of
    numbers.
    """
    means, left, out = (
        np.asarray(q.means, np.float64),
        list(np.flatnonzero(np.isfinite(np.asarray(q.log_weights)))),
        [],
    )
    ways = latent.unit(means)
    while left:
        group, grown = {left[0]}, True
        while grown:
            new = {
                j
                for j in left
                if j not in group and max(float(ways[i] @ ways[j]) for i in group) > APART
            }
            group, grown = group | new, bool(new)
        out.append(sorted(group))
        left = [i for i in left if i not in group]
    return out


def _traces(shared, i, post):
    """`Traces` of chunk ``i`` of a mixture ``q``; ``member`` [K, K]: the mode of each component, of
    which are shares.
    """
    key, sim, q, member, lanes, samples = shared
    n = min(lanes, samples - i * lanes)
    _, o, log_w, shares = batches.drawn(sim, q, *of_chunk(key, i, n, q))
    with np.errstate(divide="ignore"):
        shares = np.log(np.exp(shares) @ member)
    return Traces(log_w, shares, o.failure, o.invalid, o.length, o.distance)
