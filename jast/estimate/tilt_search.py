"""The search for tilts: the multi-level cross-entropy method over batches of traces.

Batches are drawn from the present mixture of the model and a few tilts; the episodes nearest to
failure, weighted back to the model, are what the next tilts are fitted to (de Boer, Kroese, Mannor
and Rubinstein 2005). Where choices are rare, nothing may lead to a failure: half of the first batch
is of a model whose rare categories are raised (failure biasing, Shahabuddin 1994).
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast.counter import generator
from jast.estimate.gaussians import effective
from jast.estimate.markov_tilts import Tilts, Trace, features, played, shape
from jast.estimate.tilt_fit import (
    Tilt,
    as_tilts,
    fit,
    frame_of,
    nothing,
    ratios,
    steps_of,
    unseen,
)
from jast.limit_state import normal_numbers

__all__ = ["TiltSeeker", "seek_tilts"]

COMPONENTS = 4
ELITE, MODEL, WIDE, HALF = 0.1, 0.1, 0.2, 0.75
LEVELS, REFITS, KEPT = 20, 5, 600


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

    def __init__(self, key: Any, sim: Any, batch: int):
        self.sim, self.rng, self.batch = sim, generator(key), batch
        self.about, self.dtype = shape(sim), normal_numbers(sim)
        frame = unseen(self.about, sim.horizon)
        zeros = np.zeros((1, self.about.seen))
        self.model = nothing(self.about, features(frame, zeros, 0.0, np).shape[1])
        self.mixture = ([self.model], [1.0], frame)
        self.batches, self.history, self.spent = [], [], 0
        self.promised, self.log_mean, self.q = 0.0, None, None
        self.ratios = {}  # of the mixture of a batch on the episodes of another

    def tilts(self, mixture: tuple) -> Tilts:
        tilts, weights, frame = mixture
        return as_tilts(tilts, weights, frame, COMPONENTS, self.dtype)

    def draw(self) -> Drawn:
        """A batch of the mixture; what is near to failure is kept."""
        n, a, horizon = self.batch, self.about, self.sim.horizon
        of = lambda v: jnp.asarray(v, self.dtype)
        normal, uniform = self.rng.standard_normal, self.rng.random
        first = of(normal((n, a.normals0))), of(uniform((n, a.choices0)))
        noise = (
            of(normal((horizon, n, a.normals), np.float32)),
            of(uniform((horizon, n, a.choices))),
        )
        q = self.tilts(self.mixture)
        o, ratio, trace = jax.device_get(played(self.sim, q, of(uniform(n)), first, noise))
        joint = ratio.astype(np.float64) + np.asarray(q.log_weights, np.float64)[None]
        top = joint.max(axis=1)
        log_w = -top - np.log(np.exp(joint - top[:, None]).sum(axis=1))
        self.spent += n
        return Drawn(self.mixture, trace, np.asarray(o.score), np.asarray(o.length), log_w, n)

    def ratio(self, i: int, j: int) -> np.ndarray:
        """log q - log p of the mixture of batch ``i`` on the episodes of batch ``j``."""
        if (i, j) not in self.ratios:
            b = self.batches[j]
            self.ratios[i, j] = (
                -b.log_weight if i == j else log_ratio(self.batches[i].mixture, b.trace, b.length)
            )
        return self.ratios[i, j]

    def serves(self, other: float) -> bool:
        """Whether a draw has more effective ones than ``other``, and than one of the model has."""
        return self.q is not None and self.promised > max(other, math.exp(min(self.log_mean, 0.0)))

    def thin(self, covered: float) -> float:
        """The part of the probability that lies where log q - log p is ``covered`` below what it is
        on the whole, by the failures of all batches.
        """
        used = together(self)
        i = next(i for i, b in enumerate(self.batches) if b.mixture is self.q)
        log_q = np.concatenate([self.ratio(i, j) for j in range(len(self.batches))])
        w = np.exp(used.log_weight - used.log_weight.max())
        return float(w[log_q < -self.log_mean - covered].sum() / w.sum())

    def until(self, b: Drawn, level: float) -> Drawn:
        """The episodes up to where they first reach ``level``: what comes after has no part in
        that.
        """
        if self.sim.episodic:
            return b
        reached = b.trace.seen[:, :, 0] <= level
        at = np.where(reached.any(axis=0), reached.argmax(axis=0), self.sim.horizon)
        length = np.minimum(b.length, at)
        return b._replace(length=length, log_weight=-log_ratio(b.mixture, b.trace, length))


def rows_of(b: Drawn, rows: np.ndarray) -> Drawn:
    first = Trace(*(a[rows] for a in b.trace[:3]), *(a[:, rows] for a in b.trace[3:]))
    return Drawn(b.mixture, first, b.score[rows], b.length[rows], b.log_weight[rows], b.size)


def together(s: TiltSeeker) -> Drawn:
    """The failures of all batches, and their weights by the balance heuristic."""
    batches = s.batches
    join = lambda axis, *a: np.concatenate(a, axis=axis)
    traces = [b.trace for b in batches]
    trace = Trace(
        *(join(0, *a) for a in zip(*(t[:3] for t in traces), strict=True)),
        *(join(1, *a) for a in zip(*(t[3:] for t in traces), strict=True)),
    )
    length = np.concatenate([b.length for b in batches])
    total = sum(b.size for b in batches)
    logs = np.stack(
        [
            np.concatenate([s.ratio(i, j) for j in range(len(batches))]) + math.log(b.size / total)
            for i, b in enumerate(batches)
        ]
    )
    return Drawn(
        None,
        trace,
        np.concatenate([b.score for b in batches]),
        length,
        -_log_sum(logs, 0),
        total,
    )


def log_ratio(mixture: tuple, trace: Trace, length: np.ndarray) -> np.ndarray:
    """log q - log p [n] of traces."""
    tilts, weights, frame = mixture
    steps = steps_of(frame, trace, length)
    with np.errstate(divide="ignore"):
        joint = ratios(tilts, steps, trace[:3], len(length)) + np.log(weights)[None]
    return _log_sum(joint, 1)


def _log_sum(a, axis):
    top = a.max(axis=axis, keepdims=True)
    return (top + np.log(np.exp(a - top).sum(axis=axis, keepdims=True))).squeeze(axis)


def seek_tilts(s: TiltSeeker, most: int) -> None:
    """Take the `TiltSeeker` ``s`` to its mixture, for at most ``most`` episodes."""
    if s.about.choices or s.about.choices0:
        floor = math.log(min(2.0 / s.sim.horizon, 0.25))
        s.mixture = ([s.model, s.model._replace(floor=floor)], [0.5, 0.5], s.mixture[2])
    level, refits, best = math.inf, 0, 0.0
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
        kept = np.flatnonzero(b.score <= level)[:KEPT]
        b_kept = rows_of(b, kept)._replace(
            size=s.batch * len(kept) // max((b.score <= level).sum(), 1)
        )
        if level > -np.inf:
            used = s.until(b_kept, level)
            log_w = used.log_weight
        else:
            own = effective(b.log_weight[b.score == -np.inf])
            s.promised, s.q = own / s.batch, s.mixture
            s.batches.append(b_kept)
            used = together(s)
            log_w = used.log_weight
            w = np.exp(log_w - log_w.max())
            s.log_mean = log_w.max() + math.log(w.sum() / used.size)
        s.history.append(
            f"tilts: level {level:.4g}, {share:.1%} fail, ESS {effective(log_w):.4g} of"
            f" {len(log_w)}"
            + (f", own {own:.4g} of {s.batch}, log p {s.log_mean:.3f}" if level == -np.inf else "")
        )
        if level == -np.inf:
            refits += 1
            if refits > REFITS or own < 1.1 * best and own > 0.05 * s.batch:
                return
            best = max(own, best)
        s.mixture = _fitted(s, used, log_w)


def _fitted(s, used, log_w):
    """The mixture of the model and the tilt of weighted traces."""
    power = _power(log_w, min(200, 0.3 * len(log_w)))
    w = np.exp(power * (log_w - log_w.max()))
    frame = frame_of(s.about, used.trace, used.length, w)
    steps = steps_of(frame, used.trace, used.length)
    one = fit(steps, used.trace[:3], w, effective(power * log_w))
    half = Tilt(*(a * HALF for a in one[:4]))
    return ([s.model, one, half], [MODEL, 1 - MODEL - WIDE, WIDE], frame)


def _power(log_w, least):
    if effective(log_w) >= least:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if effective(middle * log_w) >= least else (low, middle)
    return low
