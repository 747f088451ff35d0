"""The first proposal of a search: what its explorers come to. Draws of the model, descents by
gradients, wide noise that is cooled, mirror images of what these find, and, where all that found no
failure, a population that goes down the levels of the miss distance.
"""

import math

import numpy as np

from jast._src.estimate.gaussians.design_points import descend, distinct, explained, may_matter
from jast._src.estimate.gaussians.family import GaussianFamily, Points
from jast._src.estimate.gaussians.mixture_fit import nearest_centre, unit_gaussians
from jast._src.estimate.host_populations import bracket_boundary, cool, explore
from jast._src.estimate.proposal_search.search_state import SearchState, add_batch
from jast._src.normal_space.evaluate_points import evaluate_points

__all__ = ["draw_model", "explore_failures"]

LIFTS = 1.0, 1.05, 1.1, 1.2  # times as far out as a failure, where its mirror image is tried
FAR_POINTS = 16  # above which the least weights of design points far out fall with their number
POPULATION_PART = 100  # a population has a hundredth of the budget as points
POPULATION_LEAST = 100  # and at least so many
POPULATION_SHARE = 0.4  # of what is left, that a population may cost


def draw_model(f: GaussianFamily, state: SearchState) -> SearchState:
    """The state after a batch of the model itself."""
    batch = f.draw(f.model())
    failing = len(batch.log_weight)
    state = add_batch(f, state, batch)._replace(q=None, plain=(failing, batch.invalid, batch.size))
    state = state.note(f"draws of the model: {failing} fail", batch.size)
    f.context.keep(f, state)
    return state


def explore_failures(
    f: GaussianFamily, state: SearchState, given: np.ndarray | None, gradients: bool
) -> SearchState:
    """The state with a first proposal, of Gaussians at what each explorer found; with none where
    they all found no failure. ``given`` [m, D]: failures that came with the call.
    """
    room = f.settings.exploration_end * (f.budget - state.spent)
    found = []  # of each explorer that found failures, the nearest first

    def note(state, name, points, evaluations=0):
        norms = np.linalg.norm(points, axis=1)
        if len(points):
            found.append(points)
        ends = f" at distances {norms[0]:.3f} to {norms[-1]:.3f}" if len(points) else ""
        return state.note(f"{name}: {len(points)} points{ends}", evaluations)

    def anchors():
        return np.concatenate([np.zeros((0, f.dimension)), *found])

    if given is not None and len(given):
        state = note(state, "failures given", distinct(given.astype(float), f.directions))
    if len(state.log_weight):  # what neither distances nor gradients may lead to
        own = f.impute_unused(state.batches[0].points)
        state = note(state, "draws of the model", distinct(own, f.directions))
    if gradients:
        state = note(state, "design points by gradients", *_descend(f, room))
    cooled, evaluations = _cool(f, anchors(), state.spent, room)
    near = distinct(cooled, f.directions)
    state = note(state, "design points by cooling", near, evaluations)
    if found:
        state = note(state, "their mirror images", *_mirror(f, anchors()))
    state = state._replace(anchors=anchors(), cooled=f.context.rng.permutation(cooled))
    if not found:
        return _explore_by_population(f, state)
    for i, points in enumerate(found, 1):
        state = f.add(state, _gaussians_at(f, points), None if i == 1 else 1 / i)
    return state


def _gaussians_at(f, points):
    """Unit `Gaussians` at ``points`` [m, D], the nearest first, weighted by their densities. Those
    farther out may be what leads to more, but many of them are no more than a few.
    """
    square = np.linalg.norm(points, axis=1) ** 2
    least = f.settings.anchor_weight_least * min(1, FAR_POINTS / len(points))
    weights = np.exp(-0.5 * (square - square[0])) + least
    return unit_gaussians(points)._replace(weights=weights / weights.sum())


def _explore_by_population(f, state):
    """The state with a population that goes down the levels of the miss distance, and a proposal
    that is fitted to it.
    """
    size = max(f.budget // POPULATION_PART, POPULATION_LEAST)
    most = int(POPULATION_SHARE * (f.budget - state.spent))
    p = explore(f.context.next_key(), f.sim, size, max_evaluations=most)
    state = state.note(
        f"subset simulation: {len(p.levels)} levels, log p {p.log_mean:.2f}", p.evaluations
    )
    if not p.reached:
        return state
    state = state._replace(populations=(p,))
    return f.add(state, f.of_population(Points(p.points, p.used)), None)


def _descend(f, room):
    """Distinct design points [m, D] by gradients, and evaluations: from draws of the model, then
    from the edges of failures under wider noise that those found do not explain, for as long as
    these lead to others and fewer and fewer are left.
    """
    s, rng = f.settings, f.context.rng
    n = int(np.clip(f.budget // s.evaluations_per_descent, s.descents_least, s.descents_most))
    points, evaluations = np.zeros((0, f.dimension)), 0

    def descend_from(starts):
        """How many more points may matter."""
        nonlocal points, evaluations
        before, found = may_matter(points).sum(), descend(f.sim, starts)
        points = distinct(np.concatenate([points, found.points]), f.directions)
        evaluations += found.evaluations
        return may_matter(points).sum() - before

    first = min(n, s.descents_first)
    if descend_from(rng.standard_normal((first, f.dimension))) and n > first:
        descend_from(rng.standard_normal((n - first, f.dimension)))
    unexplained, first_round = math.inf, True
    while len(points) and evaluations < room:
        draws = s.wide_draws_first if first_round else s.wide_draws
        safe, fails, paid = bracket_boundary(f.context.next_key(), f.sim, draws * n)
        evaluations += paid
        rest = ~explained(fails, points)
        if not len(rest):
            break
        if not s.singleton_share < rest.mean() < s.unexplained_ratio * unexplained:
            break
        unexplained = math.inf if first_round else rest.mean()  # later rounds alone compare
        first_round = False
        if descend_from(safe[rest][:n]) < s.new_point_share * min(rest.sum(), n):
            break
    return points, evaluations


def _cool(f, anchors, spent, room):
    """Failures [n, D] by noise that is wide first and then cooled, and evaluations. Chains are
    started again, first from failures that those found do not explain, where more than
    `singleton_share` of them are the only one of their direction.
    """
    s = f.settings
    points, evaluations, given = anchors, 0, len(anchors)
    while evaluations < room:
        key = f.context.next_key()
        cold = cool(key, f.sim, f.chains, design_points=points, zeroing_rounds=s.reduction_tries)
        used = np.arange(f.dimension)[None] < cold.used[:, None]
        points = np.concatenate([points, np.where(used, cold.points, 0.0)])
        evaluations += cold.evaluations
        found = len(points) - given
        if not found:
            break
        owner = nearest_centre(points, distinct(points, len(points)))
        counted = may_matter(points)[given:] | (found < s.cooled_least)
        single = (np.bincount(owner) == 1)[owner[given:]]
        share = single[counted].sum() / max(counted.sum(), 1)
        if share <= max(s.singleton_share, s.singleton_count / found):
            break
        late = spent + evaluations > s.cooling_end * f.budget
        if found >= s.cooled_least and (share > s.singleton_share_most or late):
            break
    return points[given:], evaluations


def _mirror(f, anchors):
    """Failures opposite to those known: what fails to the left often fails to the right. Points,
    the nearest first, and evaluations.
    """
    lifted = -np.array(LIFTS)[:, None, None] * anchors
    failure = evaluate_points(f.sim, lifted.reshape(-1, f.dimension).astype(f.dtype)).failure
    failure = failure.reshape(lifted.shape[:2])
    points = lifted[np.argmax(failure, axis=0), np.arange(len(anchors))][failure.any(axis=0)]
    return distinct(points, f.directions), failure.size
