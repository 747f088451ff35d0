"""The first proposal of a search: what its explorers come to. Draws of the model, descents by
gradients, wide noise that is cooled, mirror images of what these find, and, where all that found no
failure, a population that goes down the levels of the miss distance.
"""

import math

import numpy as np

from jast.estimate.design_points import descended, distinct, explained, likely
from jast.estimate.gaussian_family import GaussianFamily, Points, rare
from jast.estimate.gaussians import nearest, unit
from jast.estimate.populations import cool, edges, explore
from jast.estimate.search_state import State, taken
from jast.judge import judged

__all__ = ["explored", "looked"]

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


def looked(f: GaussianFamily, state: State) -> State:
    """The state after a batch of the model itself."""
    batch = f.draw(f.model())
    failing = len(batch.log_weight)
    state = taken(f, state, batch)._replace(q=None, plain=(failing, batch.invalid, batch.size))
    return state.noted(f"draws of the model: {failing} fail", batch.size)


def explored(f: GaussianFamily, state: State, known: np.ndarray | None, gradients: bool) -> State:
    """The state with a first proposal, of Gaussians at what each explorer found; with none where
    they all found no failure. ``known`` [m, D]: failures that came with the call.
    """
    parts, anchors = [], np.zeros((0, f.dimension))

    def around(state, name, points, evaluations):
        nonlocal anchors
        norms = np.linalg.norm(points, axis=1)
        ends = f" at distances {norms[0]:.3f} to {norms[-1]:.3f}" if len(points) else ""
        if len(points):
            anchors = np.concatenate([anchors, points])
            # those farther out may be what leads to more, but many of them are no more than a few
            weights = np.exp(-0.5 * (norms**2 - norms[0] ** 2)) + min(0.05, 0.8 / len(points))
            parts.append(unit(points)._replace(weights=weights / weights.sum()))
        return state.noted(f"{name}: {len(points)} points{ends}", evaluations)

    if known is not None and len(known):
        state = around(state, "failures given", distinct(known.astype(float), f.directions), 0)
    if len(state.log_weight):  # what no distance and no gradient need lead to
        own = f.filled(state.batches[0].points)
        state = around(state, "draws of the model", distinct(own, f.directions), 0)
    if gradients:
        state = around(state, "design points by gradients", *_descended(f))
    points, evaluations = _cooled(f, anchors, state.spent)
    near = distinct(points, f.directions)
    state = around(state, "design points by cooling", near, evaluations)
    if len(anchors):
        state = around(state, "their mirror images", *_mirrored(f, anchors))
    state = state._replace(anchors=anchors, cooled=f.chance.rng.permutation(points))
    if not len(anchors):
        state, parts = _population(f, state)
    for i, g in enumerate(parts, 1):
        state = f.added(state, g, None if i == 1 else 1 / i, rare(state))
    return state


def _population(f, state):
    """The state with a population that goes down the levels of the miss distance, and a list of the
    `Gaussians` that are fitted to it.
    """
    size, most = max(f.budget // 100, 100), int(0.4 * f.budget)
    p = explore(f.chance.next_key(), f.sim, size, most=most)
    state = state.noted(
        f"subset simulation: {len(p.levels)} levels, log p {p.log_mean:.2f}", p.evaluations
    )
    if not p.reached:
        return state, []
    state = state._replace(populations=(p,))
    return state, [f.of_population(Points(p.points, p.used))]


def _descended(f):
    """Distinct design points [m, D] by gradients, and evaluations: from draws of the model, then
    from the edges of failures under wider noise that those found do not explain, for as long as
    these lead to others and fewer and fewer are left.
    """
    n, first, left = int(np.clip(f.budget // 2000, *STARTS)), True, math.inf
    points, evaluations = np.zeros((0, f.dimension)), 0

    def go(starts):
        nonlocal points, evaluations
        before, found = likely(points).sum(), descended(f.sim, starts)
        points = distinct(np.concatenate([points, found.points]), f.directions)
        evaluations += found.evaluations
        return likely(points).sum() - before

    if go(f.chance.rng.standard_normal((min(n, TRIED), f.dimension))) and n > TRIED:
        go(f.chance.rng.standard_normal((n - TRIED, f.dimension)))
    while len(points) and evaluations < COOLED * f.budget:
        safe, fails, paid = edges(f.chance.next_key(), f.sim, WIDER[0 if first else 1] * n)
        evaluations += paid
        rest = ~explained(fails, points)
        if not len(rest) or not ALONE < rest.mean() < SLOW * left:
            break
        left, first = math.inf if first else rest.mean(), False
        if go(safe[rest][:n]) < NEW * min(rest.sum(), n):
            break
    return points, evaluations


def _cooled(f, anchors, spent):
    """Failures [n, D] by noise that is wide first and then cooled, and evaluations. Chains are
    started again, first from failures that those found do not explain, where more than `ALONE` of
    them end in a direction that no other one has: so much of what they may lead to is still to be
    met (Good 1953).
    """
    known, evaluations, given = anchors, 0, len(anchors)
    while evaluations < COOLED * f.budget:
        cold = cool(f.chance.next_key(), f.sim, f.chains, known=known, rests=RESTS)
        used = np.arange(f.dimension)[None] < cold.used[:, None]
        known = np.concatenate([known, np.where(used, cold.points, 0.0)])
        evaluations += cold.evaluations
        found = len(known) - given
        if not found:
            break
        owner = nearest(known, distinct(known, len(known)))
        count = likely(known)[given:] | (found < ENOUGH)
        alone = (np.bincount(owner) == 1)[owner[given:]][count].sum() / max(count.sum(), 1)
        late = found >= ENOUGH and (alone > ENDLESS or spent + evaluations > LATE * f.budget)
        if late or alone <= max(ALONE, MET / found):
            break
    return known[given:], evaluations


def _mirrored(f, anchors):
    """Failures opposite to those known: what fails to the left often fails to the right. Points,
    the nearest first, and evaluations.
    """
    lifted = -np.array(LIFTS)[:, None, None] * anchors
    failure = judged(f.sim, lifted.reshape(-1, f.dimension).astype(f.dtype)).failure
    failure = failure.reshape(lifted.shape[:2])
    points = lifted[np.argmax(failure, axis=0), np.arange(len(anchors))][failure.any(axis=0)]
    return distinct(points, f.directions), failure.size
