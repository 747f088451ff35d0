"""The search for a proposal: design points, populations, mixtures fitted by cross-entropy, and a
guard against failure modes that were lost.

Every failing point that a batch draws is weighted by the balance heuristic over all batches (Veach
and Guibas 1995), and the next mixture is fitted to all of them. None of these points serves the
estimate, which is made with the proposal as it stands at the end.
"""

import math

import jax
import numpy as np

from jast import limit_state as latent
from jast.counter import generator
from jast.estimate.batches import Batch, balanced, drawn, numbers, over_batches
from jast.estimate.design_points import design_points, distinct
from jast.estimate.gaussians import (
    Gaussians,
    as_latent,
    effective,
    fit,
    nearest,
    tempered,
    together,
    unit,
)
from jast.estimate.guard import guarded
from jast.estimate.populations import cool, explore
from jast.incidents import hosted
from jast.judge import judged

WIDE, MODEL = 0.2, 0.1
"""Shares of a proposal: components whose covariances are nowhere narrower than the model's, so that
no weight is without variance; where failures are not rare the model itself.
"""
COVERED = 50.0
"""A failure is covered where its weight is at most this multiple of the mean."""
REFITTING = 0.5
"""Of the budget, where refits end."""
REFITS, GUARDS, CHAINS, POINTS = 8, 3, 128, 16
ENOUGH, COOLED, ALONE = 36, 0.2, 0.25
"""Failures that wide noise is cooled to, and the share of the budget at which that ends, where more
than the last share of them are alone in their direction.
"""
LIFTS = 1.0, 1.05, 1.1, 1.2
"""How much farther out than a failure its mirror image is looked for."""
NEAR, GOOD, SERVES = 2, 0.2, 0.05
"""Of the proposal of a similar system: the batches that it is fitted to; effective draws of a draw
with which it is taken as it is, and with which it serves once it is fitted.
"""
RARE, FEW, NOTHING = math.log(1e-4), 20, 1e-6
LEAST, MINOR = 0.05, 0.2
"""Share of the draws that a direction has at least, and all of those together: what a few failures
tell of its mass is mostly too little.
"""


class Seeker:
    """What the search knows so far: a proposal, the batches and populations behind it, what they
    cost, and in words how it went.
    """

    def __init__(self, key, sim, budget, known=None, near=None):
        self.root, self.sim, self.budget = generator(key, 1), sim, budget
        self.dtype, self.dimension = latent.normal_numbers(sim), latent.dimension(sim)
        self.size, self.batch = max(budget // 100, 100), budget // 25
        self.rng = generator(self.next_key())
        self.q, self.log_mean, self.rare = None, None, True
        self.batches, self.populations = [], []
        self.anchors = np.zeros((0, self.dimension))
        # what came with the call: failures, and the proposal of a similar system
        self.known = self.anchors if known is None else known
        self.recorded = None  # the episodes of these failures, for tilts
        self.near = near
        self.seeds = self.anchors  # failures of many places, whatever their probability
        self.spent, self.reasons, self.history = 0, [], []
        self.lost = 0.0  # a share that the proposal may have lost
        self.asked = 0.0  # what the guard last saw of it, before it was taken in
        self.coarse = []  # what is wrong with the system's floats

    def next_key(self):
        words = self.root.integers(2**32, size=2, dtype=np.uint32)
        return jax.random.wrap_key_data(words, impl="threefry2x32")

    def note(self, text, evaluations=0):
        self.spent += evaluations
        self.history.append(f"{text}, {evaluations} evaluations" if evaluations else text)

    def add(self, g, share=None, low=0.3):
        """Take the `Gaussians` ``g`` into the proposal, for ``share`` of it; no variance is below
        ``low`` times the model's.
        """
        new = as_latent(_defended(g, low, self.rare), self.dtype)
        self.q = new if self.q is None or share is None else together(self.q, new, share)

    def filled(self, z, used):
        """The points with the numbers that decided nothing drawn anew from the model, which is what
        they are given the failure.
        """
        return np.where(
            np.arange(self.dimension)[None] < used[:, None],
            z.astype(np.float64),
            self.rng.standard_normal(z.shape),
        )

    def fitted(self, z, used):
        """`Gaussians` of a population, whose members are not independent: so they count for a fifth
        in all, and for a twentieth as to covariances.
        """
        n = len(z)
        return fit(self.rng, self.filled(z, used), np.full(n, 1 / n), n / 5, n / 20)

    def model(self):
        """The model itself, as a `Latent`."""
        return as_latent([(1.0, unit(np.zeros((1, self.dimension))))], self.dtype)

    def thin(self):
        """The log density ratio q / p below which a failure is not covered."""
        return -self.log_mean - math.log(COVERED)

    def centres(self):
        """The distinct means of the proposal [m, D]."""
        return distinct(
            np.asarray(self.q.means, np.float64)[np.asarray(self.q.log_weights) > math.log(0.003)],
            POINTS,
        )


def seek(s, gradients=True, instead=lambda s: False):
    """Take the `Seeker` ``s`` to the end of the search: its ``q`` is the proposal, None where no
    failure was found. ``instead``: asked before each search for lost failures, ends it by True.
    """
    _look(s)
    if not _from_near(s):
        parts = _explore(s, gradients and not hosted(s.sim))
        if not parts:
            return
        if s.populations:
            s.rare = max(p.log_mean for p in s.populations) < RARE
        for i, g in enumerate(parts, 1):
            s.add(g, 1 / i)
        _refine(s, REFITS)
    for i in range(GUARDS):
        if s.log_mean is None or instead(s) or guarded(s, i, GUARDS - 1):
            break
        _refine(s, 2)


def _from_near(s):
    """Whether the proposal of a similar system serves, once it was fitted to a few batches; if not,
    these are all that is left of it.
    """
    if not isinstance(s.near, latent.Latent):
        return False
    s.q = s.near
    s.anchors = s.centres()
    b, own = _drawn(s, s.q), 0.0
    if b.failure.any():
        s.batches.append(b)
        own = _own(s)
        _weigh(s)
    s.note(f"proposal of a similar system: {b.failure.mean():.1%} fail, ESS {own:.4g}", s.batch)
    if own > GOOD * s.batch:
        return True
    if own:
        _fit(s)
        _refine(s, NEAR)
        if _own(s) > SERVES * s.batch:
            return True
    s.q, s.anchors = None, s.known
    return False


def _explore(s, gradients):
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
            weights = np.exp(-0.5 * (norms**2 - norms[0] ** 2)) + 0.05
            parts.append(unit(points)._replace(weights=weights / weights.sum()))
        return len(points) > 0

    if len(s.known):
        around("failures given", distinct(s.known.astype(np.float64), POINTS), 0)
    if s.batches[0].failure.any():  # what no distance and no gradient need lead to
        around("draws of the model", distinct(s.filled(*_failing(s.batches[:1])), POINTS), 0)
    found = (
        design_points(s.next_key(), s.sim, int(np.clip(s.budget // 2000, 4, 48)), POINTS)
        if gradients
        else None
    )
    differentiable = found is not None and around(
        "design points by gradients", found.points, found.evaluations
    )
    points, evaluations = _cooled(s)
    around("design points by cooling", distinct(points, POINTS), evaluations)
    s.seeds = points[s.rng.permutation(len(points))]
    if len(s.anchors):
        around("their mirror images", *_mirrored(s))
    if not differentiable:
        population = explore(s.next_key(), s.sim, s.size, most=int(0.4 * s.budget))
        s.note(
            f"subset simulation: {len(population.levels)} levels, log p {population.log_mean:.2f}",
            population.evaluations,
        )
        if population.reached:
            s.populations.append(population)
            parts.append(s.fitted(population.points, population.used))
    return parts


def _cooled(s):
    """Failures [n, D] by noise that is wide first and then cooled, and evaluations. A few chains
    are started again where more than `ALONE` of them end in a direction that no other one has: so
    much of what they may lead to is still to be met (Good 1953).
    """
    points, evaluations, n = np.zeros((0, s.dimension)), 0, int(np.clip(s.budget // 800, 8, CHAINS))
    while len(points) < ENOUGH and evaluations < COOLED * s.budget:
        cold = cool(s.next_key(), s.sim, n)
        used = np.arange(s.dimension)[None] < cold.used[:, None]
        points = np.concatenate([points, np.where(used, cold.points, 0.0)])
        evaluations += cold.evaluations
        if not len(points):
            break
        owner = nearest(points, distinct(points, len(points)))
        if (np.bincount(owner) == 1).sum() <= ALONE * len(points):
            break
    return points, evaluations


def _mirrored(s):
    """Failures opposite to those known: what fails to the left often fails to the right. Points,
    the nearest first, and evaluations.
    """
    lifted = -np.array(LIFTS)[:, None, None] * s.anchors
    failure = judged(s.sim, lifted.reshape(-1, s.dimension).astype(s.dtype)).failure
    failure = failure.reshape(lifted.shape[:2])
    points = lifted[np.argmax(failure, axis=0), np.arange(len(s.anchors))][failure.any(axis=0)]
    return distinct(points, POINTS), failure.size


def _look(s):
    """A batch of the model itself."""
    b = _drawn(s, s.model())
    s.batches.append(b)
    s.note(f"draws of the model: {b.failure.sum()} fail", s.batch)


def _drawn(s, q):
    """A `Batch` of ``q``."""
    z, o, log_w, _ = drawn(s.sim, q, *numbers(s.rng, s.batch, s.dimension, s.dtype))
    return Batch(q, z, o.used, o.failure, log_w, {})


def _refine(s, most):
    """At most ``most`` batches, each of the mixture fitted to all before it, for as long as they
    get better.
    """
    before, limit = 0.0, s.spent + most * s.batch
    while s.spent < limit and (before == 0 or s.spent < REFITTING * s.budget):
        b = _drawn(s, s.q)
        if not b.failure.any():
            s.note("batch: no failure", s.batch)
            return
        s.batches.append(b)
        own, (name, ess) = _own(s), _fit(s)
        s.note(
            f"batch: {b.failure.mean():.1%} fail, ESS {own:.4g}; of all: log p {s.log_mean:.3f},"
            f" ESS {ess:.4g}; next: {name}",
            s.batch,
        )
        if before and own > 0.1 * s.batch and (own < 1.15 * before or name == "as it was"):
            return
        before = own


def _own(s):
    """The effective sample size of the last batch."""
    b = s.batches[-1]
    return effective(b.log_weight[b.failure])


def _weigh(s):
    """The log weights of the failures of all batches, which say about what the probability is."""
    log_w, _ = balanced(s.batches)
    total = np.exp(log_w - log_w.max()).sum()
    s.log_mean = log_w.max() + math.log(total / sum(len(b.z) for b in s.batches))
    s.rare = s.log_mean < RARE
    return log_w


def _fit(s):
    """The proposal becomes what promises the least variance: a mixture for all failures, one with
    parts for each mode, a sphere, or itself.
    """
    log_w = _weigh(s)
    w = np.exp(log_w - log_w.max())
    points, centres = s.filled(*_failing(s.batches)), s.centres()
    owner = nearest(points, centres)
    many = np.bincount(owner, minlength=len(centres)) >= FEW
    owner = nearest(points, centres[many]) if many.any() else np.zeros_like(owner)
    # the second moment of the weights under another proposal, by the points at hand: sum of w p / q
    variance = lambda q: np.logaddexp.reduce(log_w - over_batches(q, s.batches))
    choices = {"as it was": s.q, "modes": _by_owner(s, points, log_w, owner)}
    if owner.any():
        choices["one"] = _by_owner(s, points, log_w, np.zeros_like(owner))
    # failures in all directions: no number of Gaussians elsewhere covers a sphere in many
    # dimensions
    spread = (w @ (points**2).mean(axis=1)) / w.sum()
    choices["all around"] = as_latent(
        [
            (
                1.0,
                unit(np.zeros((1, s.dimension)))._replace(values=np.full((1, s.dimension), spread)),
            )
        ],
        s.dtype,
    )
    name = min(choices, key=lambda name: variance(choices[name]))
    s.q = choices[name]
    return name, effective(log_w)


def _failing(batches):
    """The failing points [n, D] of ``batches`` and how many numbers each has used [n]."""
    failing = np.concatenate([b.failure for b in batches])
    return tuple(np.concatenate([getattr(b, a) for b in batches])[failing] for a in ("z", "used"))


def _by_owner(s, points, log_w, owner):
    """A `Latent`: Gaussians fitted to the points of each owner apart."""
    parts, w, owners = [], np.exp(log_w - log_w.max()), np.unique(owner)
    least = min(LEAST, MINOR / len(owners))
    for i in owners:
        rows = np.flatnonzero(owner == i)
        mass = w[rows].sum() / w.sum()
        if mass < NOTHING:
            continue
        # few great weights would make a mixture fit their own noise: a power below 1 of them leads
        # the same way, in more batches
        power = tempered(log_w[rows], min(max(200, 5 * s.dimension), 0.5 * len(rows)))
        v = np.exp(power * (log_w[rows] - log_w[rows].max()))
        g = fit(
            s.rng,
            points[rows],
            v / v.sum(),
            v.sum() ** 2 / (v**2).sum(),
            limit=max(POINTS // len(owners), 2),
            anchors=s.anchors,
        )
        parts.append(g._replace(weights=g.weights * max(mass, least)))
    return as_latent(
        _defended(
            Gaussians(*(np.concatenate(each) for each in zip(*parts, strict=True))), 0.0, s.rare
        ),
        s.dtype,
    )


def _defended(g, low, rare):
    """[(share, Gaussians), ...]: ``g``, its wide copies, and where failures are not rare the
    model.
    """
    d, model = g.means.shape[1], 0.0 if rare else MODEL
    wide = g._replace(values=np.maximum(g.values, 1.0))
    parts = (
        [(1 - WIDE - model, g._replace(values=np.maximum(g.values, low))), (WIDE, wide)]
        if (g.values < 1).any()
        else [(1 - model, g)]
    )
    return [*parts, (model, unit(np.zeros((1, d))))] if model else parts
