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
from jast.estimate.batches import Batch, drawn, numbers
from jast.estimate.design_points import distinct
from jast.estimate.first_proposal import explored
from jast.estimate.gaussians import as_latent, effective, fit, held, together, unit
from jast.estimate.guard import guarded
from jast.estimate.next_proposal import RARE, defended, refitted, weighed
from jast.incidents import hosted

COVERED = 50.0
"""A failure is covered where its weight is at most this multiple of the mean."""
REFITTING, STALLS = (0.5, 0.65), 2
"""Of the budget, where refits end, or where they end if a poor proposal still gains by them;
proposals that stay as they were without gain, which end them too.
"""
REFITS, GUARDS = 8, 3
CHAINS, POINTS, HELD = (8, 128), 16, 0.05
"""The least and the greatest number of chains of cooled noise; directions that a proposal can hold
at the least, where many chains may lead to more; the share, over the number of directions, above
which a component counts as one of them.
"""
NEAR, GOOD, SERVES = 2, 0.2, 0.05
"""Of the proposal of a similar system: the batches that it is fitted to; effective draws of a draw
with which it is taken as it is, and with which it serves once it is fitted.
"""
ENOUGH, GAIN = 0.1, 1.15
"""Effective draws of a draw with which refits end, unless they gain by this factor."""


class Seeker:
    """What the search knows so far: a proposal, the batches and populations behind it, what they
    cost, and in words how it went.
    """

    def __init__(self, key, sim, budget, known=None, near=None):
        self.root, self.sim, self.budget = generator(key, 1), sim, budget
        self.dtype, self.dimension = latent.normal_numbers(sim), latent.dimension(sim)
        self.size, self.batch = max(budget // 100, 100), budget // 25
        self.chains = int(np.clip(budget // 800, *CHAINS))
        # directions that it can hold, each by two components, beside the model
        self.points = max(min(self.chains, (held(self.dimension) - 1) // 2), POINTS)
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
        self.plain = 0, 0, 0  # failing ones, invalid ones and all of its draws of the model

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
        new = as_latent(defended(g, low, self.rare), self.dtype)
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
        heavy = np.asarray(self.q.log_weights) > math.log(HELD / self.points)
        return distinct(np.asarray(self.q.means, np.float64)[heavy], self.points)


def seek(s, gradients=True, instead=lambda s: False):
    """Take the `Seeker` ``s`` to the end of the search: its ``q`` is the proposal, None where no
    failure was found. ``instead``: asked before each search for lost failures, ends it by True.
    """
    _look(s)
    if not _from_near(s):
        parts = explored(s, gradients and not hosted(s.sim))
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
    (b, _), own = _drawn(s, s.q), 0.0
    if b.failure.any():
        s.batches.append(b)
        own = _own(s)
        weighed(s)
    s.note(f"proposal of a similar system: {b.failure.mean():.1%} fail, ESS {own:.4g}", s.batch)
    if own > GOOD * s.batch:
        return True
    if own:
        refitted(s)
        _refine(s, NEAR)
        if _own(s) > SERVES * s.batch:
            return True
    s.q, s.anchors = None, s.anchors[:0]
    return False


def _look(s):
    """A batch of the model itself."""
    b, invalid = _drawn(s, s.model())
    s.batches.append(b)
    s.plain = int(b.failure.sum()), int(invalid.sum()), s.batch
    s.note(f"draws of the model: {b.failure.sum()} fail", s.batch)


def _drawn(s, q):
    """A `Batch` of ``q``, and which of its episodes are invalid [n]."""
    z, o, log_w, _ = drawn(s.sim, q, *numbers(s.rng, s.batch, s.dimension, s.dtype))
    return Batch(q, z, o.used, o.failure, log_w, {}), o.invalid


def _refine(s, most):
    """At most ``most`` batches, each of the mixture fitted to all before it, for as long as they
    get better.
    """
    before, stalls, limit = 0.0, 0, s.spent + most * s.batch
    while s.spent < limit:
        b, _ = _drawn(s, s.q)
        if not b.failure.any():
            s.note("batch: no failure", s.batch)
            return
        s.batches.append(b)
        own, (name, ess) = _own(s), refitted(s)
        s.note(
            f"batch: {b.failure.mean():.1%} fail, ESS {own:.4g}; of all: log p {s.log_mean:.3f},"
            f" ESS {ess:.4g}; next: {name}",
            s.batch,
        )
        good, gains, same = own > ENOUGH * s.batch, own > GAIN * before, name == "as it was"
        stalls = stalls + 1 if same and not gains else 0
        if before and (stalls == STALLS or (good and (same or not gains))):
            return
        if s.spent >= REFITTING[int(gains and not (before and good))] * s.budget:
            return
        before = own


def _own(s):
    """The effective sample size of the last batch."""
    b = s.batches[-1]
    return effective(b.log_weight[b.failure])
