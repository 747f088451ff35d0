"""The guard of `jast.estimate.seek`: populations that the proposal was not fitted to look for
failure modes that it lost.
"""

import math

import numpy as np

from jast.estimate.batches import balanced, log_ratio
from jast.estimate.design_points import explained, likely
from jast.estimate.gaussians import as_latent, effective, unit
from jast.estimate.next_proposal import MANY
from jast.estimate.populations import LAST, QUANTILE, explore, settled

LOST = 0.005
"""A share of the probability that may lie where the proposal is thin, beyond what its own batches
see there.
"""
THIN, MET = 0.06, 10
"""A part of the probability that may lie, by all batches, where the proposal does not cover it, and
effective draws of it from which they know it.
"""
CUT = 0.3
"""How far on the way to a known mode the first population may go, as a share of the log density
ratio there.
"""
FORGOTTEN = "the proposal hardly draws some failures that wide noise led to"
MOST = 0.85
"""Of the budget, where the search ends."""
LEAST, MOVES, FEW, SLACK, SETTLED = 50, 10, 40, 0.15, 0.06
"""Points of a population, which come in as many; moves of the failures that wide noise led to; one
of as many of them, or one, may lie where the proposal does not cover it; how far before the plane
of a known design point, as a part of its distance, they count as of that one; what more moves may
cost where they have not settled, of the budget.
"""


def guarded(s, i, last):
    """Whether the search of the `Seeker` ``s`` may end. What was lost is taken into the proposal,
    or in round ``last`` becomes a reason against the estimate.

    Populations go down the levels of the miss distance, one kept far from all known modes, one from
    what the proposal covers; those of the search itself, which the proposal may have forgotten, are
    looked at again; and in the first round so are the failures that wider noise led to, wherever
    they are.
    """
    found, least = [], s.log_mean + math.log(LOST)
    # as many as can afford the levels down to there, in steps so that programs are shared
    room = max(min(0.3, MOST - s.spent / s.budget), 0) * s.budget / 2
    size = min(s.size // 2, int(room / (least / math.log(QUANTILE) + LAST + 4)) // LEAST * LEAST)
    for name, q, threshold in (("far", _unit(s), -s.log_mean * CUT), ("thin", s.q, s.thin())):
        p = (
            explore(
                s.next_key(),
                s.sim,
                size,
                covered=(q, threshold),
                least=least,
                most=int(room),
            )
            if size
            else None
        )
        if p is None or not p.complete:
            s.note(f"guard ({name}): ended by the budget", p.evaluations if p else 0)
            s.reasons.append("the budget ran out before the search for lost failure modes was over")
            break
        share = math.exp(min(p.log_mean - s.log_mean, 50)) if p.reached else 0.0
        rows = _bare(s, p.points, p.used)
        s.note(
            f"guard ({name}): {share:.2%} of the probability, {rows.mean() if len(rows) else 0:.0%}"
            " of it not covered",
            p.evaluations,
        )
        found.append((share * rows.mean() if len(rows) else 0.0, p.points[rows], p.used[rows]))
    for p in s.populations:
        rows = _bare(s, p.points, p.used)
        found.append((rows.mean(), p.points[rows], p.used[rows]))
    log_w, _ = balanced(s.batches)
    w, rows = np.exp(log_w - log_w.max()), log_w > -s.thin()
    thin = w[rows].sum() / w.sum()
    asked = s.asked = max((share for share, *_ in found), default=0.0)
    s.note(
        f"guard: {asked:.2%} of the probability where the proposal is thin, {thin:.2%} by its own"
        " batches"
    )
    found = [f for f in found if len(f[1]) and _lost(s, *f, thin)]
    if i == 0 and len(s.seeds):
        found += _forgotten(s)
    if end := i == last or s.spent + 2 * s.batch > MOST * s.budget:
        found = [f for f in found if f[0] == 0 or _unmet(s, *f) > 2 * LOST]
    if not found:
        if thin > THIN and effective(log_w[rows]) < MET:
            s.reasons.append(
                f"{thin:.0%} of the probability found lies where the proposal hardly draws"
            )
        return True
    if end:
        s.lost, worst = asked, max(share for share, *_ in found)
        s.reasons.append(
            f"failures that the proposal hardly draws may have {_share(worst)} the probability"
            " that it found"
            if worst
            else FORGOTTEN
        )
        return True
    for share, points, used in found:
        s.add(s.fitted(points, used), min(max(share / (1 + share), 0.15), 0.85))
    return False


def _lost(s, share, points, used, thin):
    """Whether the ``share`` of the probability that a population found at ``points`` is missing.
    Where the batches have met such points, they know it better: it is about ``thin``.
    """
    if not 2 * LOST < share <= 2 * (thin + LOST):
        return share > 2 * LOST
    return _unmet(s, share, points, used) > 2 * LOST


def _unmet(s, share, points, used):
    """What part of the probability, of the ``share`` at ``points``, no draw of any batch has met:
    by chance, were all of the share like each of the points (Poisson's law).
    """
    each = [log_ratio(b.q, points, used) + math.log(len(b.z)) for b in s.batches]
    expected = share * np.exp(np.logaddexp.reduce(each) + s.log_mean)
    return share * np.exp(-expected).mean()


def _share(share):
    """``share`` of a whole in words: of large ones the size is not known, only that they are."""
    if share < 1:
        return f"{share:.0%} of"
    return f"{share:.2g} times" if share < 100 else "far more than"


def _bare(s, points, used):
    """Which points the proposal does not cover: [n] bool."""
    return log_ratio(s.q, points, used) < s.thin()


def _forgotten(s):
    """Failures near the seeds, drawn from the model given failure, that the proposal does not
    cover; what they weigh is left to the next batches.
    """
    most = int(SETTLED * s.budget)
    people, chain = settled(s.next_key(), s.sim, s.seeds, MOVES, most=most)
    z, used = np.asarray(people.z), np.asarray(people.used)
    rows = _bare(s, z, used) & (np.asarray(people.score) == -np.inf)
    s.note(
        f"guard (cooled): {rows.mean():.0%} of {len(rows)} failures not covered", chain.evaluations
    )
    centres, some = s.centres(), max(len(rows) // FEW, 1)
    if likely(centres).sum() > MANY:  # each mode may have a few of them
        rows, some = rows & ~explained(z, centres, SLACK), 0
    return [(0.0, z[rows], used[rows])] if rows.sum() > some else []


def _unit(s):
    """A unit Gaussian at each distinct mean that is away from the origin: a `Latent`."""
    z = s.centres()
    z = z[np.linalg.norm(z, axis=1) > 1]
    return as_latent([(1.0, unit(z if len(z) else np.full((1, s.dimension), 1e3)))], s.dtype)
