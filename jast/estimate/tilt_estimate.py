"""Tilts as a part of `failure_probability`: when they are tried, whether they serve better than the
Gaussians, and the estimate by them.
"""

from typing import Any

import numpy as np

from jast.counter import generator
from jast.estimate import diagnostics
from jast.estimate.batches import picks
from jast.estimate.draws import drawn_by
from jast.estimate.estimate import Estimate, estimate
from jast.estimate.importance_sampling import Traces, chunks
from jast.estimate.markov_tilts import Tilts, log_weight, numbers, played
from jast.estimate.tilt_guard import REST, charged, given, joined
from jast.estimate.tilt_search import TiltSeeker, from_near, seek_tilts
from jast.units import Ways
from jast.watch import Watch

__all__ = ["estimated", "first"]

LONG, LARGE = 30, 2e7
"""Steps from which tilts are tried before Gaussians; numbers of a batch that are held."""
SHARE, MORE = 0.35, 1.5
"""Of the budget for their search; how much longer it may be where failures came with the call."""
GATES, GATED, GOOD = 3, 0.25, 0.1
"""Gaussians that a normal number is drawn from one of, where one does not serve; what the search
for them costs at most, of the budget; effective draws of a draw with which one does.
"""
SERVES = 0.02
"""Effective draws of a draw with which nothing else is tried."""


def first(s: Any) -> TiltSeeker | None:
    """The `TiltSeeker` of a system of many steps or with choices, after its search; None for
    another system. ``s``: the `Seeker`, which pays.
    """
    if isinstance(s.near, Tilts):
        t = _sought(s, from_near(s.next_key(), s.sim, s.near), SHARE * s.budget)
        if t.serves(SERVES):
            return t
    t = TiltSeeker(s.next_key(), s.sim, 0)
    if not (t.about.choices or t.about.choices0 or s.sim.horizon >= LONG):
        return None
    return _sought(s, t, SHARE * s.budget)


def after(s: Any) -> TiltSeeker:
    """The `TiltSeeker` after its search with a part of what is left to the `Seeker` ``s``."""
    return _sought(s, TiltSeeker(s.next_key(), s.sim, 0, GATES), REST * (s.budget - s.spent))


def _sought(s, t, most):
    about = t.about
    a_step = about.seen + about.normals + about.choices * (1 + about.categories)
    t.batch = int(
        min(max(s.budget // 50, min(s.budget // 20, 2000)), LARGE / (a_step * s.sim.horizon) + 100)
    )
    t.given, end = given(s, t), s.spent + int(MORE * most)
    charged(s, t, lambda: seek_tilts(t, int(most)))
    if t.batches and t.gates == 1 and about.normals and t.promised < GOOD:
        before = s.spent
        charged(s, t, lambda: t.gated(GATES, t.spent + int(GATED * s.budget)))
        end += s.spent - before
    if t.given is not None:
        joined(s, t, end)
    return t


def estimated(
    key: Any, s: Any, t: TiltSeeker, share: float, level: float, watch: Watch, ways: Ways
) -> Estimate:
    """The `Estimate` of what is left of the budget, ``share`` of it the model's own draws."""
    tilts, weights, frame = t.q
    weights = np.asarray(weights) * (1 - share) / (1 - weights[0])
    weights[0] = share
    q = t.tilts((tilts, weights, frame))
    shared = key, s.sim, q, t.batch, t.about, t.dtype
    plain = lambda i: picks(key, i, t.batch, t.dtype) < np.exp(q.log_weights[0])
    total, notes, lost = chunks(_traces, shared, t.batch, watch, ways, plain)
    groups = [list(range(1, len(tilts)))] if total.first > 0 else []
    if groups and total.by_component[0] / total.first >= diagnostics.MATTERS:
        groups.append([0])
    elif groups:
        groups[0].append(0)
    found = estimate(
        watch.name,
        total,
        level=level,
        reasons=[*s.coarse, *s.reasons, *lost],
        notes=notes,
        evaluations=s.spent + total.samples,
        groups=groups,
        proposal=q,
        history=tuple(s.history),
        control=int(share * total.samples),
        plain=s.plain,
    )
    return found._replace(draws=drawn_by(found.draws, key, t.batch, q))


def _traces(shared, i, post):
    """`Traces` of chunk ``i``."""
    key, sim, q, batch, about, dtype = shared
    drawn = numbers(generator(key, 2, i), batch, about, sim.horizon, dtype)
    o, ratio, _ = played(sim, q, *drawn)
    log_w, shares = log_weight(q, ratio)
    return Traces(log_w, shares, o.failure, o.invalid, o.length, o.distance)
