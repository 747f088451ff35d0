"""The guard of `jast.estimate.tilt_estimate`: failures that the tilts hardly draw, those that came
with the call and those that populations find, are taken in, or become a reason against the
estimate.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jast.estimate.design_points import distinct
from jast.estimate.guard import FORGOTTEN, LOST, SETTLED, THIN
from jast.estimate.markov_tilts import Trace, of_the_model
from jast.estimate.populations import LAST, QUANTILE, cool, explore, settled
from jast.estimate.recorded_tilts import recorded
from jast.estimate.tilt_search import TiltSeeker, only

__all__ = ["REST", "charged", "given", "guarded", "joined"]

COVERED, MET, GUARD, TIES, WRONG = 50.0, 20, 0.15, 1.5, 1.5
"""As in `jast.estimate.seek`, or more where so many of the last draws would meet a part of `THIN`;
what the search for lost failures should cost, of the budget; how much more it may where miss
distances are few and levels fall more slowly; standard errors that may be lost.
"""
REST = 0.3
"""Of what is left of the budget, what a search after others may cost."""
CHAINS, FEW = (8, 24), 3
"""Failures that wide noise leads to; of those that the tilts hardly draw, as many as are taken in.
"""
GIVEN, PLACES = 0.05, 2
"""How many of the failures that came with the call are looked at, of the budget; how often failures
that the tilts hardly draw get a tilt of their own.
"""
SETTLING = 25
"""Markov moves, after which a failure of great norm lies among those of its mode, or on the way."""


class Given(NamedTuple):
    """Failures by their numbers of chance. On the host."""

    z: np.ndarray
    trace: Trace
    length: np.ndarray


def given(s: Any, t: TiltSeeker) -> Given | None:
    """The failures that came with the call of the `Seeker` ``s``, as far as they fail again; None
    where there are none.
    """
    if s.recorded is None or not (n := len(s.recorded.length)):
        return None
    rows = np.unique(np.linspace(0, n - 1, min(n, int(GIVEN * s.budget))).astype(int))
    z = recorded(s.sim, jax.tree.map(lambda a: a[rows], s.recorded))
    found = _failures(s, t.tilts(t.mixture), z)
    s.note(f"failures given: {len(found.z)} of {len(z)} fail again", len(z))
    return found if len(found.z) else None


def _failures(s, q, z):
    """`Given` of those of the points ``z`` that fail."""
    o, _, trace = of_the_model(s.sim, q, z)
    rows = np.flatnonzero(o.score == -np.inf)
    return Given(np.asarray(z)[rows], only(trace, rows), np.asarray(o.length)[rows])


def _around(s, t, z):
    """`Given` of failures that Markov moves lead to from ``z``, failures too, as the model has
    them.
    """
    q = t.tilts(t.mixture)
    people, chain = settled(s.next_key(), s.sim, z, SETTLING, covered=(q, math.inf))
    places = len(np.unique(z, axis=0))
    s.note(f"failures given: around {places} of them", chain.evaluations + len(z))
    return _failures(s, q, people.z)


def joined(s: Any, t: TiltSeeker, end: int) -> None:
    """Take the failures that came with the call into what the search found, until the `Seeker`
    ``s`` has spent ``end``; where it met none, begin it anew from the likeliest of them.
    """
    if not (t.batches or t.near):
        found = _around(s, t, np.repeat(distinct(t.given.z, 1), CHAINS[0], axis=0))
        most = t.spent + min(int(GUARD * s.budget), end - s.spent)
        charged(s, t, lambda: t.start(found.trace, found.length, most))
    if t.batches and (rows := _bare(s, t, t.given)).any():
        t.given = _around(s, t, distinct(t.given.z[rows], _chains(s)))
        _one_by_one(s, t, end)


def _one_by_one(s, t, end):
    """Take in the failures given that the tilts hardly draw, however few: one at a time and what is
    around it, as a tilt of its own.
    """
    done = []
    for _ in range(PLACES):
        rows = np.setdiff1d(np.flatnonzero(_bare(s, t, t.given)), done)
        if not len(rows) or end - s.spent < t.batch:
            return
        s.note(f"failures given: {len(rows)} of {len(t.given.z)} not covered")
        lead = _around(s, t, np.repeat(t.given.z[rows[:1]], CHAINS[0], axis=0))
        done.append(rows[0])
        t.widest += 2
        _taken(s, t, lead.trace, lead.length, 1.0, min(_room(s), end - s.spent))


def charged(s: Any, t: TiltSeeker, search: Callable[[], None]) -> None:
    """``search()`` by the `TiltSeeker` ``t``, which the `Seeker` ``s`` pays for and tells of."""
    before, told = t.spent, len(t.history)
    search()
    s.spent += t.spent - before
    s.history += t.history[told:]


def guarded(s: Any, t: TiltSeeker) -> None:
    """Look for failures that the tilts hardly draw: a population that is kept out of what they
    cover. What is found is taken in, and else becomes a reason against the estimate.
    """
    s.reasons = []  # others are about the Gaussians
    cold = _elsewhere(s, t)
    if _lost(s, t, True):
        s.reasons = []  # what is still wrong is said again
        _lost(s, t, False)
    if _missed(s, t, cold) >= FEW:
        s.reasons.append(FORGOTTEN)
    if missed := _missed(s, t, t.given):
        s.reasons.append(
            f"the proposal hardly draws near {missed} of {len(t.given.z)} failures given"
        )


def _bare(s, t, found):
    """Which failures [n] the proposal hardly draws."""
    return t.log_ratio(t.q, found) < -t.log_mean - _covered(s)


def _unmet(s, t, found):
    """Which failures [n] the batches of the search, all together, hardly draw."""
    total = sum(b.size for b in t.batches)
    logs = [t.log_ratio(b.mixture, found) + math.log(b.size / total) for b in t.batches]
    return np.logaddexp.reduce(logs) < -t.log_mean - _covered(s)


def _missed(s, t, found):
    """How many failures, of none where ``found`` is None, neither the proposal nor the batches of
    the search draw.
    """
    return 0 if found is None else (_bare(s, t, found) & _unmet(s, t, found)).sum()


def _elsewhere(s, t):
    """`Given` of failures that wide noise leads to, where there are any. Those that the tilts
    hardly draw are taken in, twice if need be: the levels of the miss distance may all have been on
    the way to one failure mode.
    """
    nothing = t.tilts(t.q), math.inf
    cold, most = cool(s.next_key(), s.sim, _chains(s), covered=nothing), int(SETTLED * s.budget)
    if not (n := len(z := cold.points)):
        return None
    people, chain = settled(s.next_key(), s.sim, z, SETTLING, covered=nothing, most=most)
    found, paid = _failures(s, nothing[0], people.z), cold.evaluations + chain.evaluations
    for _ in range(PLACES):
        rows = np.flatnonzero(_bare(s, t, found))
        s.note(f"guard (cooled): {len(rows)} of {n} failures not covered", paid)
        most, paid = _room(s), 0
        if len(rows) < FEW or most < t.batch:
            break
        _taken(s, t, only(found.trace, rows), found.length[rows], len(rows) / n, most)
    return found


def _chains(s):
    """How many Markov chains the budget affords."""
    return int(np.clip(s.budget // 800, *CHAINS))


def _room(s):
    """What taking in failures may cost."""
    return int(min(GUARD * s.budget, REST * (s.budget - s.spent)))


def _covered(s):
    """How far below the mean of log q - log p a failure may lie, to be covered."""
    return math.log(max(COVERED, THIN * (s.budget - s.spent) / MET))


def _taken(s, t, trace, length, share, most):
    """Take in failures that carry about ``share``, at the cost of at most ``most``."""
    charged(s, t, lambda: t.widen(trace, length, share, t.spent + most))


def _lost(s, t, takes):
    """Whether something was lost and taken in, if it is to be."""
    least = t.log_mean + math.log(LOST)
    paid, left = GUARD * s.budget, (s.budget - s.spent) / 2
    most, paid = int(min(TIES * paid, left)), int(min(paid, left))
    size = min(s.size, int(paid / (least / math.log(QUANTILE) + LAST + 4)) // 50 * 50)
    if not size:
        s.reasons.append("the budget ran out before the search for lost failure modes was over")
        return False
    covered = _covered(s)
    q, threshold = t.tilts(t.q), -t.log_mean - covered
    p = explore(s.next_key(), s.sim, size, covered=(q, threshold), least=least, most=most)
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
    most = _room(s)
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
