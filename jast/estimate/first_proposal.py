"""The first proposal of a search: what its explorers come to. Draws of the model, descents by
gradients, wide noise that is cooled, mirror images of what these find, and, where neither gradients
nor failures that came with the call lead there, a population that goes down the levels of the miss
distance.
"""

import math

import numpy as np

from jast.estimate.design_points import descended, distinct, explained, likely
from jast.estimate.gaussians import nearest, unit
from jast.estimate.next_proposal import failing
from jast.estimate.populations import cool, edges, explore
from jast.judge import judged

__all__ = ["explored"]

STARTS, TRIED, WIDER = (4, 48), 12, (4, 12)
"""Descents of a round; those that are tried before others; draws of wider noise for each of them,
in a first round and in others.
"""
ENOUGH, COOLED, LATE, RESTS = 36, 0.2, 0.3, 18
"""Failures that wide noise is cooled to at the least; the share of the budget at which cooling
ends, and at which descents do; the share that is spent in all, above which cooling looks for no
more than that least number; and how often a failure is tried without some of its numbers.
"""
ALONE, MET, ENDLESS, SLOW, NEW = 0.03, 3, 0.5, 0.85, 0.25
"""When the search for more directions ends. `ALONE`: where at most this part of the failures lies
in a direction of its own, or is explained by nothing known; or `MET` of them. `ENDLESS`: where more
than this part is alone even so, as more chains would not change it. `SLOW`: where a round of
descents leaves more than this part unexplained of what was before it. `NEW`: where less than this
part of its descents come to new points.
"""
LIFTS = 1.0, 1.05, 1.1, 1.2
"""How much farther out than a failure its mirror image is looked for."""


def explored(s, gradients):
    """What the first proposal is made of: a list of `Gaussians`, one for each explorer that found
    failures.
    """
    parts = []

    def around(name, points, evaluations):
        norms = np.linalg.norm(points, axis=1)
        s.note(
            f"{name}: {len(points)} points"
            + (f" at distances {norms[0]:.3f} to {norms[-1]:.3f}" if len(points) else ""),
            evaluations,
        )
        if len(points):
            s.anchors = np.concatenate([s.anchors, points])
            # those farther out may be what leads to more, but many of them are no more than a few
            weights = np.exp(-0.5 * (norms**2 - norms[0] ** 2)) + min(0.05, 0.8 / len(points))
            parts.append(unit(points)._replace(weights=weights / weights.sum()))
        return len(points) > 0

    if len(s.known):
        around("failures given", distinct(s.known.astype(np.float64), s.points), 0)
    if s.batches[0].failure.any():  # what no distance and no gradient need lead to
        around("draws of the model", distinct(s.filled(*failing(s.batches[:1])), s.points), 0)
    differentiable = gradients and around("design points by gradients", *_descended(s))
    points, evaluations = _cooled(s)
    around("design points by cooling", distinct(points, s.points), evaluations)
    s.seeds = points[s.rng.permutation(len(points))]
    if len(s.anchors):
        around("their mirror images", *_mirrored(s))
    if not (differentiable or len(s.known)):
        population = explore(s.next_key(), s.sim, s.size, most=int(0.4 * s.budget))
        s.note(
            f"subset simulation: {len(population.levels)} levels, log p {population.log_mean:.2f}",
            population.evaluations,
        )
        if population.reached:
            s.populations.append(population)
            parts.append(s.fitted(population.points, population.used))
    return parts


def _descended(s):
    """Distinct design points [m, D] by gradients, and evaluations: from draws of the model, then
    from the edges of failures under wider noise that those found do not explain, for as long as
    these lead to others and fewer and fewer are left.
    """
    n, first, left = int(np.clip(s.budget // 2000, *STARTS)), True, math.inf
    points, evaluations = np.zeros((0, s.dimension)), 0

    def go(starts):
        nonlocal points, evaluations
        before, found = likely(points).sum(), descended(s.sim, starts)
        points = distinct(np.concatenate([points, found.points]), s.points)
        evaluations += found.evaluations
        return likely(points).sum() - before

    if go(s.rng.standard_normal((min(n, TRIED), s.dimension))) and n > TRIED:
        go(s.rng.standard_normal((n - TRIED, s.dimension)))
    while len(points) and evaluations < COOLED * s.budget:
        safe, fails, paid = edges(s.next_key(), s.sim, WIDER[0 if first else 1] * n)
        evaluations += paid
        rest = ~explained(fails, points)
        if not len(rest) or not ALONE < rest.mean() < SLOW * left:
            break
        left, first = math.inf if first else rest.mean(), False
        if go(safe[rest][:n]) < NEW * min(rest.sum(), n):
            break
    return points, evaluations


def _cooled(s):
    """Failures [n, D] by noise that is wide first and then cooled, and evaluations. Chains are
    started again, first from failures that those found do not explain, where more than `ALONE` of
    them end in a direction that no other one has: so much of what they may lead to is still to be
    met (Good 1953).
    """
    known, evaluations, given = s.anchors, 0, len(s.anchors)
    while evaluations < COOLED * s.budget:
        cold = cool(s.next_key(), s.sim, s.chains, known=known, rests=RESTS)
        used = np.arange(s.dimension)[None] < cold.used[:, None]
        known = np.concatenate([known, np.where(used, cold.points, 0.0)])
        evaluations += cold.evaluations
        found = len(known) - given
        if not found:
            break
        owner = nearest(known, distinct(known, len(known)))
        count = likely(known)[given:] | (found < ENOUGH)
        alone = (np.bincount(owner) == 1)[owner[given:]][count].sum() / max(count.sum(), 1)
        late = found >= ENOUGH and (alone > ENDLESS or s.spent + evaluations > LATE * s.budget)
        if late or alone <= max(ALONE, MET / found):
            break
    return known[given:], evaluations


def _mirrored(s):
    """Failures opposite to those known: what fails to the left often fails to the right. Points,
    the nearest first, and evaluations.
    """
    lifted = -np.array(LIFTS)[:, None, None] * s.anchors
    failure = judged(s.sim, lifted.reshape(-1, s.dimension).astype(s.dtype)).failure
    failure = failure.reshape(lifted.shape[:2])
    points = lifted[np.argmax(failure, axis=0), np.arange(len(s.anchors))][failure.any(axis=0)]
    return distinct(points, s.points), failure.size
