"""The first proposal of a search: what its explorers come to. Draws of the model, descents by
gradients, wide noise that is cooled, mirror images of what these find, and, where all that found no
failure, a population that goes down the levels of the miss distance.
"""

import math

import numpy as np

from jast.estimate.design_points import descended, distinct, explained, likely
from jast.estimate.gaussian_family import GaussianFamily, Points, rare
from jast.estimate.gaussians import nearest, unit
from jast.estimate.populations import bracket_boundary, cool, explore
from jast.estimate.search_state import State, taken
from jast.judge import judged

__all__ = ["explored", "looked"]

LIFTS = 1.0, 1.05, 1.1, 1.2
"""How much farther out than a failure its mirror image is looked for."""


def looked(f: GaussianFamily, state: State) -> State:
    """The state after a batch of the model itself."""
    batch = f.draw(f.model())
    failing = len(batch.log_weight)
    state = taken(f, state, batch)._replace(q=None, plain=(failing, batch.invalid, batch.size))
    state = state.noted(f"draws of the model: {failing} fail", batch.size)
    f.chance.latest[:] = [(f, state)]
    return state


def explored(f: GaussianFamily, state: State, known: np.ndarray | None, gradients: bool) -> State:
    """The state with a first proposal, of Gaussians at what each explorer found; with none where
    they all found no failure. ``known`` [m, D]: failures that came with the call.
    """
    parts, anchors = [], np.zeros((0, f.dimension))
    least, room = f.settings.anchor_least, f.settings.cooled_share * (f.budget - state.spent)

    def around(state, name, points, evaluations):
        nonlocal anchors
        norms = np.linalg.norm(points, axis=1)
        ends = f" at distances {norms[0]:.3f} to {norms[-1]:.3f}" if len(points) else ""
        if len(points):
            anchors = np.concatenate([anchors, points])
            # those farther out may be what leads to more, but many of them are no more than a few
            weights = np.exp(-0.5 * (norms**2 - norms[0] ** 2)) + least * min(1, 16 / len(points))
            parts.append(unit(points)._replace(weights=weights / weights.sum()))
        return state.noted(f"{name}: {len(points)} points{ends}", evaluations)

    if known is not None and len(known):
        state = around(state, "failures given", distinct(known.astype(float), f.directions), 0)
    if len(state.log_weight):  # what no distance and no gradient need lead to
        own = f.filled(state.batches[0].points)
        state = around(state, "draws of the model", distinct(own, f.directions), 0)
    if gradients:
        state = around(state, "design points by gradients", *_descended(f, room))
    points, evaluations = _cooled(f, anchors, state.spent, room)
    near = distinct(points, f.directions)
    state = around(state, "design points by cooling", near, evaluations)
    if len(anchors):
        state = around(state, "their mirror images", *_mirrored(f, anchors))
    state = state._replace(anchors=anchors, cooled=f.chance.rng.permutation(points))
    if not len(anchors):
        state, parts = _population(f, state)
    for i, g in enumerate(parts, 1):
        state = f.added(state, g, None if i == 1 else 1 / i, rare(f, state))
    return state


def _population(f, state):
    """The state with a population that goes down the levels of the miss distance, and a list of the
    `Gaussians` that are fitted to it.
    """
    size, most = max(f.budget // 100, 100), int(0.4 * (f.budget - state.spent))
    p = explore(f.chance.next_key(), f.sim, size, max_evaluations=most)
    state = state.noted(
        f"subset simulation: {len(p.levels)} levels, log p {p.log_mean:.2f}", p.evaluations
    )
    if not p.reached:
        return state, []
    state = state._replace(populations=(p,))
    return state, [f.of_population(Points(p.points, p.used))]


def _descended(f, room):
    """Distinct design points [m, D] by gradients, and evaluations: from draws of the model, then
    from the edges of failures under wider noise that those found do not explain, for as long as
    these lead to others and fewer and fewer are left.
    """
    s = f.settings
    n = int(np.clip(f.budget // s.descent_of, s.descents_least, s.descents))
    first, left = True, math.inf
    points, evaluations = np.zeros((0, f.dimension)), 0

    def go(starts):
        nonlocal points, evaluations
        before, found = likely(points).sum(), descended(f.sim, starts)
        points = distinct(np.concatenate([points, found.points]), f.directions)
        evaluations += found.evaluations
        return likely(points).sum() - before

    if (
        go(f.chance.rng.standard_normal((min(n, s.descents_tried), f.dimension)))
        and n > s.descents_tried
    ):
        go(f.chance.rng.standard_normal((n - s.descents_tried, f.dimension)))
    while len(points) and evaluations < room:
        safe, fails, paid = bracket_boundary(
            f.chance.next_key(), f.sim, (s.wide_first if first else s.wide) * n
        )
        evaluations += paid
        rest = ~explained(fails, points)
        if not len(rest) or not s.alone < rest.mean() < s.slow * left:
            break
        left, first = math.inf if first else rest.mean(), False
        if go(safe[rest][:n]) < s.new * min(rest.sum(), n):
            break
    return points, evaluations


def _cooled(f, anchors, spent, room):
    """Failures [n, D] by noise that is wide first and then cooled, and evaluations. Chains are
    started again, first from failures that those found do not explain, where more than `alone` of
    them end in a direction that no other one has: so much of what they may lead to is still to be
    met (Good 1953).
    """
    s = f.settings
    known, evaluations, given = anchors, 0, len(anchors)
    while evaluations < room:
        cold = cool(
            f.chance.next_key(), f.sim, f.chains, design_points=known, zeroing_rounds=s.rests
        )
        used = np.arange(f.dimension)[None] < cold.used[:, None]
        known = np.concatenate([known, np.where(used, cold.points, 0.0)])
        evaluations += cold.evaluations
        found = len(known) - given
        if not found:
            break
        owner = nearest(known, distinct(known, len(known)))
        count = likely(known)[given:] | (found < s.cooled_least)
        alone = (np.bincount(owner) == 1)[owner[given:]][count].sum() / max(count.sum(), 1)
        late = found >= s.cooled_least and (
            alone > s.endless or spent + evaluations > s.cooled_late * f.budget
        )
        if late or alone <= max(s.alone, s.alone_met / found):
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
