"""Tilts fitted to weighted traces by cross-entropy: least squares for the means of normal numbers,
logistic regression for the log odds of choices.

On the host, in double precision. The cross-entropy optimum among tilts maximises the weighted
likelihood of the traces (Rubinstein and Kroese 2004), which falls apart into these regressions on
the features of each step.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from jast.estimate.batches import resampled
from jast.estimate.gaussians import log_sum
from jast.estimate.markov_tilts import (
    Block,
    Frame,
    Shape,
    Tilts,
    Trace,
    Y,
    features,
    rarity,
    surprise,
)

__all__ = ["Tilt", "as_tilts", "fit", "frame_of", "of_tilts", "ratios"]

PROJECTED, WITHIN, FAR, LITTLE = 6, 0.05, 4.0, 0.01
"""Numbers that features are made of, at most; how far beyond what was met, in parts of its span,
and from the middle, in deviations, they go; the part of a variance that is left out.
"""
RIDGE, FREE = 1.0, 0.02
"""Of a normal prior on the coefficients, in steps; of the constant's."""
DEVIATIONS = (0.4, 1.2)
TOGETHER = 10.0
"""Of that of a number's own coefficients about those of all, where there are several Gaussians."""
ITERATIONS, STEP = 25, 4.0
ROUNDS, NEWTON, BEYOND = 8, 2, 1.5
"""Of expectation maximisation, and Newton's steps in each; the normal numbers that the outer
Gaussians start from.
"""
ROWS, FEWER = 60_000, 20_000
"""That a fit looks at, at most, and one of several Gaussians."""


class Tilt(NamedTuple):
    """One tilt, on the host: as in `Tilts`."""

    first: Block
    steps: Block
    floor: float = -np.inf


class Rows(NamedTuple):
    """Draws of steps, or of x0, one a row."""

    x: np.ndarray
    """[N, F] features"""
    trace: np.ndarray
    """[N] whose step"""
    normals: np.ndarray
    choices: np.ndarray
    log_p: np.ndarray
    rare: np.ndarray
    """[N, B] as `rarity` has it"""
    own: np.ndarray
    """[N, A] the category that a normal number is of"""


def columns(about: Shape) -> int:
    """How many numbers features are made of."""
    return min(about.seen, PROJECTED)


def unseen(about: Shape, steps: int) -> Frame:
    """A `Frame` before anything was seen: all features but those of the time are 0."""
    m = columns(about)
    return Frame(np.zeros(about.seen), np.zeros((about.seen, m)), np.zeros(m), np.zeros(m))


def frame_of(about: Shape, trace: Trace, length: np.ndarray, w: np.ndarray) -> Frame:
    """The `Frame` of weighted traces: the miss distance, then the principal parts of what is left
    of the others, each of unit variance where it varies at all.
    """
    if not length.any():  # all were over at their start
        return unseen(about, len(trace.seen))
    live = np.arange(len(trace.seen))[:, None] < length[None]
    seen = trace.seen[live].astype(np.float64)
    each = np.broadcast_to(w[None], live.shape)[live]
    each = each / each.sum()
    centre = each @ seen
    gap = seen - centre
    covariance = (gap * each[:, None]).T @ gap
    deviation = np.sqrt(np.diag(covariance))
    scale = np.where(deviation > 1e-6 * (np.abs(centre) + 1e-12), deviation, np.inf)
    correlation = covariance / scale[:, None] / scale[None]
    m = columns(about)
    project = np.zeros((about.seen, m))
    first = np.zeros(about.seen)
    if np.isfinite(scale[0]):
        first[0] = 1
        project[:, 0] = first / scale
        correlation = correlation - np.outer(correlation[:, 0], correlation[0])
    values, vectors = np.linalg.eigh(correlation)
    at = int(first.any())
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if at == m or value < LITTLE:
            break
        # the part of the direction that the distance does not explain
        full = (
            vector - first * (vector @ (covariance[:, 0] / scale / scale[0]))
            if first.any()
            else vector
        )
        project[:, at] = full / scale / np.sqrt(value)
        at += 1
    y = gap @ project
    span = y.max(axis=0) - y.min(axis=0)
    low, high = y.min(axis=0) - WITHIN * span, y.max(axis=0) + WITHIN * span
    return Frame(centre, project, np.maximum(low, -FAR), np.minimum(high, FAR))


def steps_of(about: Shape, frame: Frame, trace: Trace, length: np.ndarray) -> tuple[Rows, Rows]:
    """The `Rows` of x0 and of the steps of traces of these lengths."""
    n, horizon = len(length), len(trace.seen)
    live = np.arange(horizon)[:, None] < length[None]
    t, at = np.nonzero(live)
    x = features(frame, trace.seen[live].astype(np.float64), t / horizon, np)
    first = np.ones((n, 1)), np.arange(n), *trace[:3]
    steps = x, at, trace.normals[live], trace.choices[live], trace.log_p[live]
    return _rows(about.owners0, *first), _rows(about.owners, *steps)


def _rows(owners, x, trace, normals, choices, log_p):
    log_p = log_p.astype(np.float64)
    rare = rarity(log_p, choices, np) if choices.shape[1] else np.zeros(choices.shape)
    none = np.zeros((len(x), 1), choices.dtype)
    own = np.concatenate([choices, none], axis=1)[:, np.asarray(owners, int)]
    return Rows(x, trace, normals.astype(np.float64), choices, log_p, rare, own)


def fit(rows: tuple[Rows, Rows], w: np.ndarray, count: float, like: Tilt) -> Tilt:
    """The `Tilt` of traces of the weights ``w`` [n], which count as ``count`` independent ones; of
    the shapes of ``like``.
    """
    w = w / w.sum() * count
    return Tilt(*(_fitted(r, w[r.trace], b) for r, b in zip(rows, like[:2], strict=True)))


def _fitted(rows, w, like):
    if len(w) > ROWS:
        chosen = np.linspace(0, len(w) - 1, ROWS).astype(int)
        w, rows = w[chosen] * (len(w) / ROWS), Rows(*(a[chosen] for a in rows))
    means, gates, shifts, scales = (np.zeros(a.shape) for a in like)
    for c in range(means.shape[1]):
        mine = (rows.own == c) & (w > 0)[:, None]
        common = _common(rows, w, mine, means.shape[3])
        for a in np.flatnonzero(mine.any(axis=0)):
            of = mine[:, a]
            means[:, c, a], gates[:, c, a], scales[c, a] = _gated(
                rows.x[of], rows.normals[of, a], w[of], means.shape[3], common
            )
    for j in range(shifts.shape[1]):
        x = _with_surprise(rows, j)
        shifts[:, j] = _logits(x, _one_of(rows, j), rows.log_p[:, j], w, _ridge(x.shape[1]))
    return Block(means, gates, shifts, scales)


def _ridge(size):
    ridge = np.full(size, RIDGE)
    ridge[0] = FREE
    return ridge


def _with_surprise(rows, j):
    y = rows.x[:, Y if rows.x.shape[1] > Y else 0]
    return surprise(rows.x, y, rows.rare[:, j], np)


def _one_of(rows, j):
    return np.eye(rows.log_p.shape[2])[rows.choices[:, j]]


def _common(rows, w, mine, gates):
    """What `_gated` makes of all numbers alike, which those of each shrink to; none for one
    Gaussian.
    """
    f = rows.x.shape[1]
    none = np.zeros((f, gates)), np.zeros((f, gates)), np.zeros(gates)
    if gates == 1 or mine.shape[1] == 1 or not mine.any():
        return none
    n, a = np.nonzero(mine)
    if len(n) > ROWS:
        chosen = np.linspace(0, len(n) - 1, ROWS).astype(int)
        n, a, w = n[chosen], a[chosen], w * (len(n) / ROWS)
    return _gated(rows.x[n], rows.normals[n, a], w[n], gates, none)


def _gated(x, z, w, gates, common):
    """(means [F, G], log weights [F, G], log deviations [G]) of G Gaussians by expectation
    maximisation, from the middle, the upper and the lower numbers on; they shrink to ``common``
    ones. The first is a unit Gaussian.
    """
    means, log_g, scales = common
    f = x.shape[1]
    if gates == 1:
        return _lines(x, z[:, None], w[:, None], _ridge(f)), log_g, scales
    if len(w) > FEWER:
        some = resampled(np.log(w), FEWER, 0.5)
        x, z, w = x[some], z[some], np.full(FEWER, w.sum() / FEWER)
    given = means.any()
    ridge = np.full(f, TOGETHER) if given else _ridge(f)
    if given:
        r = _parts(x, z, means, log_g, scales)
    else:
        r = np.stack([np.abs(z) < BEYOND, z >= BEYOND, z <= -BEYOND], axis=1).astype(float)
    for _ in range(ROUNDS):
        gap = z[:, None] - x @ common[0]
        means = common[0] + _lines(x, gap, w[:, None] * r, ridge)
        log_g = common[1] + _logits(x, r, x @ common[1], w, ridge, log_g - common[1])
        square = (w[:, None] * r * (z[:, None] - x @ means) ** 2).sum(axis=0)
        variance = (square + ridge[-1] * np.exp(2 * common[2])) / (w @ r + ridge[-1])
        scales = np.log(np.clip(np.sqrt(variance), *DEVIATIONS))
        scales[0] = 0.0
        r = _parts(x, z, means, log_g, scales)
    return means, log_g, scales


def _joint(x, z, means, log_g, scales):
    # [G, N] while it is computed: rows as short as G cost more than what is done with them
    gap = (z - means.T @ x.T) / np.exp(scales)[:, None]
    return (log_g.T @ x.T - scales[:, None] + (z**2 - gap**2) / 2).T


def _parts(x, z, means, log_g, scales):
    """Which part [N, G] of each number is of which Gaussian."""
    joint = _joint(x, z, means, log_g, scales)
    return np.exp(joint - log_sum(joint)[:, None])


def _lines(x, z, w, ridge):
    """Least squares [F, G] of ``z`` [N, G] by ``x`` with the weights ``w`` [N, G]."""
    return np.stack(
        [
            np.linalg.solve(x.T @ (x * v[:, None]) + np.diag(ridge), x.T @ (y * v))
            for y, v in zip(z.T, w.T, strict=True)
        ],
        axis=1,
    )


def _logits(x, target, log_p, w, ridge, start=None):
    """Coefficients [F, C] of what is added to ``log_p`` [N, C], by Newton's steps for each category
    in turn against the others; the commonest category is the one that nothing is added to.
    ``target`` [N, C]: the parts of the categories in each row.
    """
    c = log_p.shape[1]
    out = np.zeros((x.shape[1], c)) if start is None else start.copy()
    base = 0 if start is not None else np.argmax((np.exp(log_p) * w[:, None]).sum(axis=0))
    others = [k for k in range(c) if k != base and np.isfinite(log_p[:, k]).any()]
    if not others:
        return out

    def value(out):
        log_q = log_p + x @ out
        log_q = log_q - log_sum(log_q)[:, None]
        with np.errstate(invalid="ignore"):
            each = w @ np.where(target > 0, target * log_q, 0)
        return each.sum() - 0.5 * ridge @ (out**2).sum(axis=1), np.exp(log_q)

    now, p = value(out)
    for _ in range(NEWTON if start is not None else ITERATIONS * (1 if len(others) == 1 else 2)):
        before = now
        for k in others:
            slope = x.T @ (w * (target[:, k] - p[:, k])) - ridge * out[:, k]
            bend = x.T @ (x * (w * p[:, k] * (1 - p[:, k]))[:, None]) + np.diag(ridge)
            step = np.linalg.solve(bend, slope)
            step *= min(1.0, STEP / max(np.abs(x @ step).max(), 1e-12))
            for _ in range(8):  # Newton's step may go too far
                tried = out.copy()
                tried[:, k] += step
                then, q = value(tried)
                if then >= now:
                    out, now, p = tried, then, q
                    break
                step /= 4
        if now - before < 1e-3:
            break
    return out


def ratios(tilts: list[Tilt], rows: tuple[Rows, Rows], n: int) -> np.ndarray:
    """log q_k - log p [n, K] of ``n`` traces under each of ``tilts``."""
    each = lambda t: sum(
        np.bincount(r.trace, _ratio(b, r, t.floor), minlength=n)
        for r, b in zip(rows, t[:2], strict=True)
    )
    return np.stack([each(t) for t in tilts], axis=1)


def _ratio(block, rows, floor):
    out = np.zeros(len(rows.x))
    for a in range(rows.normals.shape[1]):
        for c in range(block.means.shape[1]):
            mine = rows.own[:, a] == c
            x, z, gates = rows.x[mine], rows.normals[mine, a], block.gates[:, c, a]
            of = block.means[:, c, a], gates, block.scales[c, a]
            out[mine] += log_sum(_joint(x, z, *of)) - log_sum(x @ gates)
    for j in range(rows.choices.shape[1]):
        log_p = rows.log_p[:, j]
        log_q = np.where(log_p > -np.inf, np.maximum(log_p, floor), -np.inf)
        log_q = log_q + _with_surprise(rows, j) @ block.shifts[:, j]
        at = lambda a: np.take_along_axis(a, rows.choices[:, j, None], axis=1)[:, 0]  # noqa: B023
        out += at(log_q) - log_sum(log_q) - at(log_p)
    return out


def nothing(about: Shape, count: int, gates: int) -> Tilt:
    """The model as a `Tilt` of ``count`` features."""

    def block(f, normals, choices, categories, owners):
        owned = categories if any(o >= 0 for o in owners) else 1
        numbers = np.zeros((f, owned, normals, gates))
        return Block(numbers, numbers, np.zeros((f + 3, choices, categories)), numbers[0])

    return Tilt(
        block(1, about.normals0, about.choices0, about.categories0, about.owners0),
        block(count, about.normals, about.choices, about.categories, about.owners),
    )


def scaled(tilt: Tilt, by: float) -> Tilt:
    """A tilt that moves ``by`` of the way."""
    some = lambda b: Block(by * b.means, b.gates, by * b.shifts, 0 * b.scales)
    return Tilt(some(tilt.first), some(tilt.steps))


def of_tilts(q: Tilts) -> tuple[list[Tilt], np.ndarray, Frame]:
    """What `as_tilts` made ``q`` of: those of its components that are used, their weights, and the
    `Frame`; in double precision.
    """
    q = jax.tree.map(lambda a: np.asarray(a, np.float64), q)
    weights = np.exp(q.log_weights)
    one = lambda k: Tilt(*jax.tree.map(lambda a: a[k], (q.first, q.steps)), q.floors[k])
    used = np.flatnonzero(weights)
    return [one(k) for k in used], weights[used], q.frame


def as_tilts(tilts: list[Tilt], weights: Any, frame: Frame, size: int, dtype: Any) -> Tilts:
    """The `Tilts` of these, the first of which is the model; of ``size`` components, so that
    programs are compiled once.
    """
    spare = size - len(tilts)
    tilts = [*tilts, *[tilts[0]] * spare]
    with np.errstate(divide="ignore"):
        log_weights = np.log(np.concatenate([np.asarray(weights, float), np.zeros(spare)]))
    stack = lambda *a: np.stack(a)
    arrays = (
        log_weights,
        stack(*(t.floor for t in tilts)),
        jax.tree.map(stack, *(t.first for t in tilts)),
        jax.tree.map(stack, *(t.steps for t in tilts)),
        frame,
    )
    return Tilts(*jax.tree.map(lambda a: np.asarray(a, dtype), arrays))
