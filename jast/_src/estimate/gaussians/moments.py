"""A first proposal from few runs, for systems of many numbers: half-spaces of failure, one a moment
of the episode and side, each from the system linearised near to its own boundary.
"""

import numpy as np

from jast._src.estimate.gaussians import half_spaces
from jast._src.estimate.gaussians.design_points import distinct, explained
from jast._src.estimate.gaussians.family import GaussianFamily
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.host_populations import draw_wide, wide_enough
from jast._src.estimate.proposal_search.search_state import (
    SearchState,
    add_batch,
    efficiency,
    failure_log_ratios,
)
from jast._src.normal_space.moments import cost_of_slopes, distances, slopes
from jast._src.util.pytrees import index_tree

__all__ = ["FARTHER", "INSIDE", "explore_moments"]

FIRST_DRAWS = 20
"""Draws of the model, the nearest to failure of which is where linearising begins: on neither side
of a system with two."""
COMMON = 0.25
"""Share of them that fail, from which plain draws tell the probability."""
INSIDE = 0.95
"""Part of the way to a boundary at which a system is linearised: next to it, and still safe."""
HALVINGS = 4
"""Of the way to there, where it fails already."""
KNOWN = 0.15
"""Standard deviations to which the nearest boundary must be where its plane says: a probability at
four of them is then known to a factor of two, and the draws tell the rest."""
TURNED = 1.0
"""Standard deviations between where it was linearised and the normal that this led to, from which
it is done again there, unless that takes a run for each number."""
ROUNDS = 6
"""Linearisations from one start at most; what is linear or nearly so took 2 to 4."""
GIVEN = 4
"""Failures that came with the call, or of wide noise, and that no plane has, from which others
start."""
ROOTS = 3
"""Runs at most to see how deep a half-space is on the way to its own design point."""
FARTHER = 2.0
"""Standard deviations at most that one of them goes on, or back."""
OTHER = 0.5
"""Cosine below which a half-space is of another mode, and not of another moment or side of one. A
convention."""
FOLLOWED = 10
"""Failures of wide noise at most that an audit follows to where the model has them: with a chance
of .94 one comes to a quarter of the probability, and each costs 26 evaluations."""
BATCHES = 3
"""Batches that a proposal is fitted to, of a twenty-fifth of the budget each."""


def explore_moments(f: GaussianFamily, given: np.ndarray | None, gradients: bool) -> SearchState:
    """The state of a search with a proposal of the half-spaces that linearising leads to, fitted to
    a few batches; without one where it leads to none. ``given`` [m, D]: failures that came with the
    call.
    """
    state, start = _draw_model(f, SearchState())
    if start is None:
        return state
    end = f.settings.exploration_end * f.budget
    planes = half_spaces.no_planes(f.dimension)
    state, planes = _approach(f, state, planes, start, gradients, end)
    for _ in range(GIVEN if given is not None else 0):
        rest = given[~explained(given, planes.nearest, KNOWN)] if len(planes.depth) else given
        points = distinct(rest.astype(np.float64), 1)
        if not len(points):
            break
        given = rest[(rest != points[0]).any(axis=1)]
        state, planes = _approach(f, state, planes, INSIDE * points[0], gradients, end)
    if len(planes.depth):
        opposite = -INSIDE * planes.nearest[np.argmin(planes.depth)]
        state, planes = _approach(f, state, planes, opposite, gradients, end)
    if not len(planes.depth):
        return state.note("moments: no slope leads to failures")
    state, planes = _approach_wide(f, state, planes, gradients, end)
    every = planes
    state, planes = _with_mirror_images(f, state, half_spaces.that_matter(planes, f.dimension))
    every = half_spaces.likely(half_spaces.merge_planes(every, planes))
    depths = f"at {planes.depth.min():.3f} to {planes.depth.max():.3f}"
    state = state.note(f"moments: {len(planes.depth)} half-spaces {depths}")
    return _fit_batches(f, state._replace(anchors=planes.nearest, planes=every), planes)


def _draw_model(f, state):
    """The state after some draws of the model, and the safe one that came nearest to failing; None
    where failures are common, or nothing tells how near one came.
    """
    z = f.context.rng.standard_normal((FIRST_DRAWS, f.dimension)).astype(f.dtype)
    o, g = distances(f.sim, z)
    failing, invalid = int(o.failure.sum()), int(o.invalid.sum())
    state = state._replace(plain=(failing, invalid, FIRST_DRAWS))
    state = state.note(f"moments: draws of the model, {failing} fail", FIRST_DRAWS)
    far = np.where(np.isnan(g), np.inf, g).min(axis=1)
    far[np.asarray(o.failure | o.invalid)] = np.inf
    if failing > COMMON * FIRST_DRAWS or not np.isfinite(far).any():
        return state, None
    return state, z[np.argmin(far)].astype(np.float64)


def _approach(f, state, planes, start, gradients, end):
    """The state and the `Planes` after linearising from ``start`` on, each time next to the nearest
    boundary that the last one led to, until that is where it was said to be.
    """
    cost = cost_of_slopes(f.sim, f.dimension, gradients)
    last = np.zeros_like(start)
    for _ in range(ROUNDS):
        if state.spent + cost + HALVINGS > end:
            return state.note("moments: no room for more slopes"), planes
        state, start = _step_back(f, state, start, last)
        here = slopes(f.sim, start.astype(f.dtype), gradients)
        said = half_spaces.planes_of(here)
        state = state.note(f"moments: linearised at {np.linalg.norm(start):.3f}", cost)
        if not len(said.depth):
            break
        state, new = _to_their_roots(f, state, said, end)
        planes = half_spaces.merge_planes(planes, new)
        top = np.argmin(new.depth)
        turned = np.linalg.norm(start - (start @ new.normal[top]) * new.normal[top]) > TURNED
        if abs(new.depth[top] - said.depth[top]) <= KNOWN and not (turned and cost < f.dimension):
            break
        last, start = start, INSIDE * new.nearest[top]
    return state, planes


def _approach_wide(f, state, planes, gradients, end):
    """The state and the `Planes` after linearising from failures of wide noise that none of the
    ``planes`` has. Where that leads to another mode, there may be more of them: an audit is to look
    where all these failures come from.
    """
    n, least = f.settings.wide_audit, f.settings.tolerated_mass
    if state.spent + n > end:
        return state, planes
    width = wide_enough(np.logaddexp.reduce(planes.log_mass))
    failures = draw_wide(f.context.rng, f.sim, n, width)
    state = state.note(f"moments: {len(failures.z)} fail under {width:.2f} times wider noise", n)
    before, tried = planes.normal, 0
    for point in failures.z.astype(np.float64):
        if tried < GIVEN and not (planes.normal @ point > planes.depth - KNOWN).any():
            state, planes = _approach(f, state, planes, INSIDE * point, gradients, end)
            tried += 1
    now = half_spaces.likely(planes, least).normal
    if (np.abs(now @ before.T).max(axis=1) < OTHER).any():
        state = state._replace(cooled=failures.z[:FOLLOWED])
    return state, planes


def _step_back(f, state, aim, safe):
    """The state, and ``aim``, or a point between it and the ``safe`` one where it fails."""
    point = aim
    for i in range(HALVINGS + 1):
        point = (point + safe) / 2 if i else aim
        o, _ = distances(f.sim, point[None].astype(f.dtype))
        state = state._replace(spent=state.spent + 1)
        if not (o.failure[0] or o.invalid[0]):
            break
    return state, point


def _with_mirror_images(f, state, planes):
    """The state, and the ``planes`` with their mirror images where the system fails there too: what
    fails to the left often fails to the right.
    """
    images = planes._replace(normal=-planes.normal)
    k = len(planes.depth)
    each = [index_tree(images, [i]) for i in range(k)]
    images = index_tree(
        images, [len(half_spaces.merge_planes(planes, one).depth) > k for one in each]
    )
    if not len(images.depth):
        return state, planes
    beyond = (images.depth + KNOWN)[:, None] * images.normal
    failure = np.asarray(distances(f.sim, beyond.astype(f.dtype))[0].failure)
    text = f"moments: {failure.sum()} of {len(failure)} mirror images fail"
    both = zip(planes, index_tree(images, failure), strict=True)
    planes = half_spaces.that_matter(half_spaces.Planes(*map(np.concatenate, both)), f.dimension)
    return state.note(text, len(failure)), planes


def _to_their_roots(f, state, planes, end):
    """The state, and the ``planes`` as deep as the system has them on the ray to each design
    point, by the secant rule.
    """
    depth, unknown, runs = planes.depth.copy(), np.arange(len(planes.depth)), 0
    for _ in range(ROOTS):
        if not len(unknown) or state.spent + runs + len(unknown) > end:
            break
        aim = INSIDE * depth[unknown, None] * planes.normal[unknown]
        _, g = distances(f.sim, aim.astype(f.dtype))
        # where it fails before that moment a little nearer is tried
        left = np.nan_to_num(g[np.arange(len(unknown)), planes.moment[unknown]])
        new = INSIDE * depth[unknown] + np.clip(left / planes.rate[unknown], -FARTHER, FARTHER)
        runs += len(unknown)
        far = np.abs(new - depth[unknown]) > KNOWN
        depth[unknown], unknown = new, unknown[far]
    text = f"moments: {len(unknown)} of {len(depth)} boundaries not where they were said to be"
    return state.note(text, runs), planes._replace(depth=np.where(depth > 0, depth, planes.depth))


def _fit_batches(f, state, planes):
    """The state after a few batches, each of layers that are fitted to all before it."""
    first = layers = half_spaces.first_layers(planes)
    for _ in range(BATCHES):
        batch = f.draw(half_spaces.layers_as_latent(planes, layers, f.dtype))
        state = add_batch(f, state, batch)
        failing = len(batch.log_weight)
        if not failing:
            return state.note("moments: no failure", f.batch)
        ess = effective_sample_size(batch.log_weight)
        text = f"moments: {failing / batch.size:.1%} fail, ESS {ess:.4g}"
        state = state.note(f"{text}; of all: log p {state.log_mean:.3f}", f.batch)
        z = np.concatenate([b.points.z for b in state.batches])
        layers = half_spaces.fit_layers(z, state.log_weight, planes, first)
    q = half_spaces.layers_as_latent(planes, layers, f.dtype)
    fitted = efficiency(state, failure_log_ratios(f, state, q))
    return state._replace(q=q, efficiency=fitted) if fitted > state.efficiency else state
