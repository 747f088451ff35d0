"""The search for tilts: the multi-level cross-entropy method over batches of traces.

Batches are drawn from the present mixture of the model and a few tilts; the episodes nearest to
failure, weighted back to the model, are what the next tilts are fitted to (de Boer, Kroese, Mannor
and Rubinstein 2005). Where choices are rare, nothing may lead to a failure: half of the first batch
is of a model whose rare categories are raised (failure biasing, Shahabuddin 1994).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from jast.counter import generator
from jast.estimate.gaussians import effective, tempered
from jast.estimate.markov_tilts import Tilts, Trace, features, played, shape
from jast.estimate.tilt_fit import (
    Tilt,
    as_tilts,
    fit,
    frame_of,
    nothing,
    of_tilts,
    ratios,
    scaled,
    steps_of,
    unseen,
)
from jast.limit_state import normal_numbers

__all__ = ["TiltSeeker", "from_near", "only", "seek_tilts"]

COMPONENTS = (3, 5, 9)
"""How many a mixture is made up to, so that programs are compiled once."""
ELITE, MODEL, WIDE, HALF = 0.1, 0.1, 0.2, 0.75
REFITS, NEAR, KEPT = 8, 1, 1200
ENOUGH = 0.2
"""Effective draws of a draw of which no better ones are looked for twice."""


class Drawn(NamedTuple):
    """The episodes of a batch that count. On the host."""

    mixture: tuple
    """(list of `Tilt`, weights, `Frame`) that drew them"""
    trace: Trace
    score: np.ndarray
    length: np.ndarray
    log_weight: np.ndarray
    size: int
    """Episodes of the batch"""


class TiltSeeker:
    """What the search for tilts knows: the mixture, the batches behind it, how it went."""

    def __init__(self, key: Any, sim: Any, batch: int, gates: int = 1):
        self.sim, self.rng, self.batch = sim, generator(key), batch
        self.about, self.dtype = shape(sim), normal_numbers(sim)
        self.model = self.untilted(gates)
        self.mixture = ([self.model], [1.0], unseen(self.about, sim.horizon))
        self.batches, self.history, self.spent = [], [], 0
        self.promised, self.log_mean, self.q = 0.0, None, None
        self.near = False  # the mixture is that of a similar system
        self.widest = COMPONENTS[1]  # components, beyond which no tilt is added
        self.given = None  # failures that came with the call
        self.ratios = {}  # of the mixture of a batch on the episodes of another

    @property
    def gates(self) -> int:
        """Gaussians that a normal number is drawn from one of."""
        return self.model.steps.means.shape[-1]

    def untilted(self, gates: int) -> Tilt:
        """The model as a tilt, of ``gates`` Gaussians a normal number."""
        frame, seen = unseen(self.about, self.sim.horizon), np.zeros((1, self.about.seen))
        return nothing(self.about, features(frame, seen, 0.0, np).shape[1], gates)

    def tilts(self, mixture: tuple) -> Tilts:
        tilts, weights, frame = mixture
        size = next(c for c in COMPONENTS if c >= len(tilts))
        return as_tilts(tilts, weights, frame, size, self.dtype)

    def draw(self) -> Drawn:
        """A batch of the mixture; what is near to failure is kept."""
        n, a, horizon = self.batch, self.about, self.sim.horizon
        of = lambda v: np.asarray(v, self.dtype)
        normal, uniform = self.rng.standard_normal, self.rng.random
        chance = lambda a, b, *size: (
            of(normal((*size, a), np.float32)),
            of(uniform((*size, a), np.float32)),
            of(uniform((*size, b))),
        )
        first = chance(a.normals0, a.choices0, n)
        noise = chance(a.normals, a.choices, horizon, n)
        q = self.tilts(self.mixture)
        o, ratio, trace = played(self.sim, q, of(uniform(n)), first, noise)
        joint = ratio.astype(np.float64) + np.asarray(q.log_weights, np.float64)[None]
        top = joint.max(axis=1)
        log_w = -top - np.log(np.exp(joint - top[:, None]).sum(axis=1))
        self.spent += n
        return Drawn(self.mixture, trace, np.asarray(o.score), np.asarray(o.length), log_w, n)

    def ratio(self, i: int, j: int) -> np.ndarray:
        """log q - log p of the mixture of batch ``i`` on the episodes of batch ``j``."""
        if (i, j) not in self.ratios:
            b = self.batches[j]
            other = self.batches[i].mixture
            self.ratios[i, j] = -b.log_weight if i == j else self.log_ratio(other, b)
        return self.ratios[i, j]

    def serves(self, other: float) -> bool:
        """Whether a draw has more effective ones than ``other``, and than one of the model has."""
        return self.q is not None and self.promised > max(other, math.exp(min(self.log_mean, 0.0)))

    def note(self, b: Drawn, text: str, log_w: np.ndarray) -> None:
        failing = np.mean(b.score == -np.inf)
        self.history.append(
            f"tilts: {text}, {failing:.1%} fail, ESS {effective(log_w):.4g} of {len(log_w)}"
        )

    def take(self, b: Drawn) -> float:
        """Take in the failures of a batch; the next mixture is fitted to those of all. How many
        effective ones the batch has.
        """
        own, used = self.weigh(b)
        self.mixture = mixture_of(self, used, used.log_weight, self.groups(used))
        return own

    def weigh(self, b: Drawn) -> tuple[float, Drawn]:
        """Take in the failures of a batch: how many effective ones it has, and those of all."""
        own = effective(b.log_weight[b.score == -np.inf])
        self.batches.append(rows_of(b, -np.inf))
        used = together(self)
        log_w = used.log_weight
        self.log_mean = np.logaddexp.reduce(log_w) - math.log(used.size)
        # what a draw of each mixture would be worth, by the second moment of its weights
        second = [np.logaddexp.reduce(log_w - self.over(i)) for i in range(len(self.batches))]
        best = int(np.argmin(second))
        self.q = self.batches[best].mixture
        self.promised = math.exp(2 * self.log_mean - second[best] + math.log(used.size))
        self.note(b, f"log p {self.log_mean:.3f}, own ESS {own:.4g}", used.log_weight)
        return own, used

    def refit(self, most: int, times: int) -> None:
        """Batches, at most ``times``, for as long as they get better."""
        best, stalls = 0.0, 0
        for _ in range(times):
            if not self.batches or self.spent + self.batch > most:
                return
            b = self.draw()
            if not (b.score == -np.inf).any():
                return
            own = self.take(b)
            stalls = 0 if own > 1.1 * best else stalls + 1
            if stalls and (own > ENOUGH * self.batch or stalls == 3):
                return
            best = max(own, best)

    def gated(self, gates: int, most: int) -> None:
        """Go on with ``gates`` Gaussians a normal number, fitted to the failures found."""
        used = together(self)
        groups, self.model = self.groups(used), self.untilted(gates)
        self.mixture = mixture_of(self, used, used.log_weight, groups)
        self.refit(most, REFITS)

    def groups(self, used: Drawn) -> np.ndarray | None:
        """Which part [n, M] of each episode belongs to each group of the mixture's tilts."""
        tilts, weights, frame = self.mixture
        if len(tilts) <= 3:
            return None
        rows = steps_of(self.about, frame, used.trace, used.length)
        joint = (ratios(tilts, rows, len(used.length)) + np.log(weights)[None])[:, 1:]
        r = np.exp(joint - joint.max(axis=1, keepdims=True))
        r = r.reshape(len(r), -1, 2).sum(axis=2)
        return r / r.sum(axis=1, keepdims=True)

    def start(self, trace: Trace, length: np.ndarray, most: int) -> None:
        """Begin the search anew from failures, for at most ``most`` episodes in all."""
        self.mixture = mixture_of(self, Drawn(None, trace, None, length, None, 0), 0.0 * length)
        if self.spent + self.batch <= most and ((b := self.draw()).score == -np.inf).any():
            self.take(b)
            self.refit(most, REFITS)

    def widen(self, trace: Trace, length: np.ndarray, share: float, most: int) -> None:
        """Take in failures that the mixture hardly draws, which carry ``share`` of what it found,
        as a tilt of their own.
        """
        used, n = together(self), len(length)
        w = used.log_weight - np.logaddexp.reduce(used.log_weight)
        both = used._replace(
            trace=joined([used.trace, trace]), length=np.concatenate([used.length, length])
        )
        log_w = np.concatenate([w, np.full(n, math.log(share / n))])
        if len(self.mixture[0]) < self.widest:
            before = self.groups(used)
            before = np.ones((len(w), 1)) if before is None else before
            own = np.repeat([[0.0], [1.0]], [len(w), n], axis=0)
            of = np.concatenate([np.pad(before, ((0, n), (0, 0))), own], axis=1)
            self.mixture = mixture_of(self, both, log_w, of)
        self.refit(most, 3)

    def thin(self, covered: float) -> float:
        """The part of the probability that lies where log q - log p is ``covered`` below what it is
        on the whole, by the failures of all batches.
        """
        used = together(self)
        i = next(i for i, b in enumerate(self.batches) if b.mixture is self.q)
        log_q = self.over(i)
        w = np.exp(used.log_weight - used.log_weight.max())
        return float(w[log_q < -self.log_mean - covered].sum() / w.sum())

    def over(self, i: int) -> np.ndarray:
        """log q - log p of the mixture of batch ``i`` on the failures of all batches."""
        return np.concatenate([self.ratio(i, j) for j in range(len(self.batches))])

    def log_ratio(self, mixture: tuple, b: Drawn) -> np.ndarray:
        """log q - log p [n] of the episodes of ``b``."""
        tilts, weights, frame = mixture
        rows = steps_of(self.about, frame, b.trace, b.length)
        with np.errstate(divide="ignore"):
            joint = ratios(tilts, rows, len(b.length)) + np.log(weights)[None]
        return _log_sum(joint, 1)

    def until(self, b: Drawn, level: float) -> Drawn:
        """The episodes up to where they first reach ``level``: what comes after has no part in
        that.
        """
        if self.sim.episodic:
            return b
        reached = b.trace.seen[:, :, 0] <= level
        at = np.where(reached.any(axis=0), reached.argmax(axis=0), self.sim.horizon)
        length = np.minimum(b.length, at)
        return b._replace(
            length=length, log_weight=-self.log_ratio(b.mixture, b._replace(length=length))
        )


def rows_of(b: Drawn, level: float) -> Drawn:
    """Those of the episodes that come to ``level``, at most `KEPT`."""
    near = np.flatnonzero(b.score <= level)
    rows = near[:KEPT]
    trace = only(b.trace, rows)
    size = b.size * len(rows) // max(len(near), 1)
    return Drawn(b.mixture, trace, b.score[rows], b.length[rows], b.log_weight[rows], size)


def only(trace: Trace, rows: np.ndarray) -> Trace:
    """The traces of ``rows``."""
    return Trace(*(a[rows] for a in trace[:3]), *(a[:, rows] for a in trace[3:]))


def joined(traces: list[Trace]) -> Trace:
    """The traces of all."""
    join = lambda axis, *a: np.concatenate(a, axis=axis)
    return Trace(
        *(join(0, *a) for a in zip(*(t[:3] for t in traces), strict=True)),
        *(join(1, *a) for a in zip(*(t[3:] for t in traces), strict=True)),
    )


def together(s: TiltSeeker) -> Drawn:
    """The failures of all batches, and their weights by the balance heuristic."""
    batches = s.batches
    trace = joined([b.trace for b in batches])
    length = np.concatenate([b.length for b in batches])
    total = sum(b.size for b in batches)
    logs = np.stack([s.over(i) + math.log(b.size / total) for i, b in enumerate(batches)])
    return Drawn(
        None,
        trace,
        np.concatenate([b.score for b in batches]),
        length,
        -_log_sum(logs, 0),
        total,
    )


def _log_sum(a, axis):
    top = a.max(axis=axis, keepdims=True)
    return (top + np.log(np.exp(a - top).sum(axis=axis, keepdims=True))).squeeze(axis)


def from_near(key: Any, sim: Any, q: Tilts) -> TiltSeeker:
    """The `TiltSeeker` that goes on from the proposal of a similar system."""
    tilts, weights, frame = of_tilts(q)
    s = TiltSeeker(key, sim, 0, gates=q.steps.means.shape[-1])
    weights *= (1 - MODEL) / weights[1:].sum()
    weights[0] = MODEL
    s.mixture, s.near = (tilts, list(weights), frame), True
    return s


def seek_tilts(s: TiltSeeker, most: int) -> None:
    """Take the `TiltSeeker` ``s`` to its mixture, for at most ``most`` episodes."""
    if s.near:
        b = s.draw()
        if np.mean(b.score == -np.inf) <= ELITE / 2:
            return
        own, used = s.weigh(b)
        if own < ENOUGH * s.batch:
            s.mixture = mixture_of(s, used, used.log_weight, s.groups(used))
            s.refit(most, NEAR)
        return
    if s.about.choices or s.about.choices0:
        floor = math.log(min(2.0 / s.sim.horizon, 0.25))
        s.mixture = ([s.model, s.model._replace(floor=floor)], [0.5, 0.5], s.mixture[2])
    level = math.inf
    while s.spent + s.batch <= most:
        b = s.draw()
        share = np.mean(b.score == -np.inf)
        ranked = np.sort(b.score)
        new = ranked[max(int(ELITE * s.batch) - 1, 0)]
        if share * s.batch >= 50 and level > -np.inf:
            new = -np.inf if share > ELITE / 2 else new
        if new >= level and level > -np.inf:  # no further by the quantile: what is nearest
            below = ranked[ranked < level]
            if len(below) < 10:
                s.history.append(f"tilts: no episode below {level:.3g}")
                return
            new = below[min(len(below) - 1, int(ELITE * s.batch))]
        level = min(new, level)
        if level == -np.inf:
            s.take(b)
            break
        used = s.until(rows_of(b, level), level)
        if not used.length.any():
            s.history.append(f"tilts: every start is as near as {level:.3g}")
            continue
        s.note(b, f"level {level:.4g}", used.log_weight)
        s.mixture = mixture_of(s, used, used.log_weight)
    s.refit(most, REFITS)


def mixture_of(s: TiltSeeker, used: Drawn, log_w: np.ndarray, of: Any = None) -> tuple:
    """The mixture of the model and a tilt for each group of weighted traces; ``of`` [n, M]: what
    part of each trace belongs to each group.
    """
    of = np.ones((len(log_w), 1)) if of is None else of
    w = np.exp(log_w - log_w.max())
    frame = frame_of(s.about, used.trace, used.length, np.sqrt(w))
    rows = steps_of(s.about, frame, used.trace, used.length)
    masses = np.maximum(w @ of / w.sum(), 0.1)
    tilts, weights = [s.model], [MODEL]
    for part, mass in zip(of.T, masses / masses.sum(), strict=True):
        with np.errstate(divide="ignore"):
            own = np.maximum(log_w + np.log(part), log_w.max() - 500)
        power = tempered(own, min(200, 0.3 * part.sum()))
        v = np.exp(power * (own - own.max()))
        one = fit(rows, v, effective(power * own), s.model)
        tilts += [one, scaled(one, HALF)]
        weights += [mass * (1 - MODEL - WIDE), mass * WIDE]
    return tilts, weights, frame
