"""Tilts as a part of `failure_probability`: when they are tried, whether they serve better than the
Gaussians, what they may have lost, and the estimate by them.
"""

import math
from typing import Any

import numpy as np

from jast.counter import generator
from jast.estimate import diagnostics
from jast.estimate.draws import drawn_by
from jast.estimate.estimate import Estimate, estimate
from jast.estimate.guard import LOST, MOVES, THIN
from jast.estimate.importance_sampling import Traces, chunks
from jast.estimate.markov_tilts import Tilts, log_weight, numbers, of_the_model, played
from jast.estimate.populations import LAST, QUANTILE, cool, explore, settled
from jast.estimate.tilt_search import TiltSeeker, from_near, only, seek_tilts
from jast.units import Ways
from jast.watch import Watch

__all__ = ["estimated", "first"]

LONG, LARGE = 30, 2e7
"""Steps from which tilts are tried before Gaussians; numbers of a batch that are held."""
SHARE, REST = 0.35, 0.3
"""Of the budget for their search; where Gaussians went before, of what is left."""
GATES = 3
"""Unit Gaussians that a normal number is drawn from one of, where one does not serve."""
SERVES = 0.02
"""Effective draws of a draw with which nothing else is tried."""
COVERED, MET, GUARD, WRONG = 50.0, 20, 0.15, 1.5
"""As in `jast.estimate.seek`, or more where so many of the last draws would meet a part of `THIN`;
what the search for lost failures may cost, of the budget; standard errors that may be lost.
"""
CHAINS, FEW = (8, 24), 3
"""Failures that wide noise leads to; of those that the tilts hardly draw, as many as are taken in.
"""


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
    t.room = int(most)
    seek_tilts(t, int(most))
    s.spent += t.spent
    s.history += t.history
    return t


def guarded(s: Any, t: TiltSeeker) -> None:
    """Look for failures that the tilts hardly draw: a population that is kept out of what they
    cover. What is found is taken in, and else becomes a reason against the estimate.
    """
    s.reasons = []  # others are about the Gaussians
    _elsewhere(s, t)
    if _lost(s, t, True):
        _lost(s, t, False)


def _elsewhere(s, t):
    """Take in failures that wide noise leads to and the tilts hardly draw: their levels of the miss
    distance may all have been on the way to one failure mode.
    """
    nothing = t.tilts(t.q), math.inf
    cold = cool(s.next_key(), s.sim, int(np.clip(s.budget // 800, *CHAINS)), covered=nothing)
    if not (n := len(cold.points)):
        return
    people, chain = settled(s.next_key(), s.sim, cold.points, MOVES, covered=nothing)
    o, log_q, trace = of_the_model(s.sim, nothing[0], people.z)
    bare = (np.asarray(o.score) == -np.inf) & (log_q < -t.log_mean - _covered(s))
    rows = np.flatnonzero(bare)
    paid = cold.evaluations + chain.evaluations
    s.note(f"guard (cooled): {len(rows)} of {n} failures not covered", paid)
    most = int(min(GUARD * s.budget, REST * (s.budget - s.spent)))
    if len(rows) >= FEW and most >= t.batch:
        _taken(s, t, only(trace, rows), np.asarray(o.length)[rows], len(rows) / n, most)


def _covered(s):
    """How far below the mean of log q - log p a failure may lie, to be covered."""
    return math.log(max(COVERED, THIN * (s.budget - s.spent) / MET))


def _taken(s, t, trace, length, share, most):
    """Take in failures that carry about ``share``, at the cost of at most ``most``."""
    before, told = t.spent, len(t.history)
    t.widen(trace, length, share, t.spent + most)
    s.spent += t.spent - before
    s.history += t.history[told:]


def _lost(s, t, takes):
    """Whether something was lost and taken in, if it is to be."""
    least = t.log_mean + math.log(LOST)
    room = int(min(GUARD * s.budget, (s.budget - s.spent) / 2))
    size = min(s.size, int(room / (least / math.log(QUANTILE) + LAST + 4)) // 50 * 50)
    if not size:
        s.reasons.append("the budget ran out before the search for lost failure modes was over")
        return False
    covered = _covered(s)
    q, threshold = t.tilts(t.q), -t.log_mean - covered
    p = explore(s.next_key(), s.sim, size, covered=(q, threshold), least=least, most=room)
    share = math.exp(min(p.log_mean - t.log_mean, 50)) if p.reached else 0.0
    thin = t.thin(covered)
    s.note(
        f"guard (tilts): {share:.2%} of the probability is not covered, {thin:.2%} by its batches",
        p.evaluations,
    )
    if not p.complete:
        s.reasons.append("the budget ran out before the search for lost failure modes was over")
    if thin > THIN:
        s.reasons.append(
            f"{thin:.0%} of the probability found lies where the proposal hardly draws"
        )
    if share <= 3 * (thin + LOST):
        return False
    most = int(min(GUARD * s.budget, REST * (s.budget - s.spent)))
    if not takes or most < t.batch:
        # what is below the standard error of the last draws does not make their interval wrong
        if share < WRONG / math.sqrt(t.promised * (s.budget - s.spent)):
            return False
        s.reasons.append(
            f"failures that the proposal hardly draws may have {share:.0%} of the probability that"
            " it found"
        )
        return False
    o, _, trace = of_the_model(s.sim, q, p.points.astype(s.dtype))
    _taken(s, t, trace, np.asarray(o.length), share, most)
    return True


def estimated(
    key: Any, s: Any, t: TiltSeeker, share: float, level: float, watch: Watch, ways: Ways
) -> Estimate:
    """The `Estimate` of what is left of the budget, ``share`` of it the model's own draws."""
    tilts, weights, frame = t.q
    weights = np.asarray(weights) * (1 - share) / (1 - weights[0])
    weights[0] = share
    q = t.tilts((tilts, weights, frame))
    shared = key, s.sim, q, t.batch, t.about, t.dtype
    total, notes, lost = chunks(_traces, shared, t.batch, watch, ways)
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
    )
    return found._replace(draws=drawn_by(found.draws, key, t.batch, q))


def _traces(shared, i, post):
    """`Traces` of chunk ``i``."""
    key, sim, q, batch, about, dtype = shared
    drawn = numbers(generator(key, 2, i), batch, about, sim.horizon, dtype)
    o, ratio, _ = played(sim, q, *drawn)
    log_w, shares = log_weight(q, ratio)
    return Traces(log_w, shares, o.failure, o.invalid, o.length, o.distance)
