"""Tilts fitted to weighted traces by cross-entropy: least squares for the means of normal numbers,
logistic regression for the log odds of choices.

On the host, in double precision. The cross-entropy optimum among tilts maximises the weighted
likelihood of the traces (Rubinstein and Kroese 2004), which falls apart into these regressions on
the features of each step.
"""

from operator import itemgetter
from typing import NamedTuple

import jax
import numpy as np
from jax.typing import DTypeLike

from jast._src.estimate.gaussians.mixture_fit import log_sum, with_log_shares
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.estimate.tilts.tilts import (
    FIRST_STATE_FEATURE,
    Block,
    Frame,
    Shape,
    Tilts,
    Trace,
    count_rare_before,
    features,
)

__all__ = [
    "Tilt",
    "as_tilts",
    "fit_tilt",
    "frame_of",
    "log_ratios",
    "model_tilt",
    "of_tilts",
    "scale_tilt",
    "steps_of",
    "unseen_frame",
]

PROJECTED = 6  # numbers that features are made of, at most
MARGIN = 0.05  # of the range of what was seen, that features go beyond it
FARTHEST = 4.0  # deviations from the middle that features go to, at most
LITTLE = 0.01  # part of a variance that is left out of the principal parts
ROUNDING = 1e-6  # part of a mean, below which a deviation is rounding
RIDGE = 1.0  # precision of the normal prior of a coefficient, in steps
RIDGE_OF_CONSTANT = 0.02  # the same of the constant's
RIDGE_OF_COMMON = 10.0  # the same of a number's coefficients about those of all numbers
DEVIATIONS = (0.4, 1.2)  # range of those of several Gaussians
EM_ITERATIONS = 8  # of expectation maximisation; a convention
EM_NEWTON_STEPS = 2  # in each of these
OUTER = 1.5  # normal number beyond which the outer Gaussians start
NEWTON_STEPS = 25  # for each category in turn: twice as many of several
FARTHEST_STEP = 4.0  # change of log odds in one of Newton's steps
QUARTERINGS = 8  # of one of Newton's steps, which may go too far
GAIN = 1e-3  # of the log likelihood, below which Newton's steps end
ROWS = 60_000  # that a fit looks at, at most
ROWS_OF_SEVERAL = 20_000  # the same of a fit of several Gaussians


class Tilt(NamedTuple):
    """One tilt, on the host: as in `Tilts`."""

    first: Block
    steps: Block
    floor: float = -np.inf
    kept: float = 0.0


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
    """[N, B] as `count_rare_before` has it"""
    own: np.ndarray
    """[N, A] the category that a normal number is of"""


def unseen_frame(about: Shape) -> Frame:
    """A `Frame` before anything was seen: all features but those of the time are 0."""
    m = min(about.seen, PROJECTED)
    return Frame(np.zeros(about.seen), np.zeros((about.seen, m)), np.zeros(m), np.zeros(m))


def frame_of(about: Shape, trace: Trace, length: np.ndarray, w: np.ndarray) -> Frame:
    """The `Frame` of weighted traces: the miss distance, then the principal parts of what is left
    of the others, each of unit variance where it varies at all.
    """
    if not length.any():  # all were over at their start
        return unseen_frame(about)
    at, t = _live_steps(trace, length)
    seen, each = trace.seen[at, t].astype(np.float64), w[at] / w[at].sum()
    centre = each @ seen
    gap = seen - centre
    covariance = (gap * each[:, None]).T @ gap
    deviation = np.sqrt(np.diag(covariance))
    scale = np.where(deviation > ROUNDING * (np.abs(centre) + 1e-12), deviation, np.inf)
    correlation = covariance / scale[:, None] / scale[None]
    m = min(about.seen, PROJECTED)
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
        if first.any():
            vector = vector - first * (vector @ (covariance[:, 0] / scale / scale[0]))
        project[:, at] = vector / scale / np.sqrt(value)
        at += 1
    y = gap @ project
    span = y.max(axis=0) - y.min(axis=0)
    low, high = y.min(axis=0) - MARGIN * span, y.max(axis=0) + MARGIN * span
    return Frame(centre, project, np.maximum(low, -FARTHEST), np.minimum(high, FARTHEST))


def _live_steps(trace, length):
    """Which trace [N], and which step of it, each step before an end is."""
    t, at = np.nonzero(np.arange(trace.seen.shape[1])[:, None] < length)
    return at, t


def steps_of(
    about: Shape, frame: Frame, trace: Trace, length: np.ndarray, dtype: DTypeLike = np.float64
) -> tuple[Rows, Rows]:
    """The `Rows` of x0 and of the steps of traces of these lengths, in so many bits."""
    n, (at, t) = len(length), _live_steps(trace, length)
    frame, tau = Frame(*(a.astype(dtype) for a in frame)), (t / trace.seen.shape[1]).astype(dtype)
    x = features(frame, trace.seen[at, t].astype(dtype), tau, np)
    first = np.ones((n, 1), dtype), np.arange(n), *trace[:3]
    steps = x, at, *(a[at, t] for a in (trace.normals, trace.choices, trace.log_p))
    return _rows(about.first.owners, *first), _rows(about.steps.owners, *steps)


def _rows(owners, x, trace, normals, choices, log_p):
    log_p = log_p.astype(x.dtype)
    rare = count_rare_before(log_p, choices, np) if choices.shape[1] else np.zeros(choices.shape)
    none = np.zeros((len(x), 1), choices.dtype)
    own = np.concatenate([choices, none], axis=1)[:, np.asarray(owners, int)]
    return Rows(
        x=x,
        trace=trace,
        normals=normals.astype(x.dtype),
        choices=choices,
        log_p=log_p,
        rare=rare,
        own=own,
    )


def fit_tilt(rows: tuple[Rows, Rows], w: np.ndarray, count: float, like: Tilt) -> Tilt:
    """The `Tilt` of traces of the weights ``w`` [n], which count as ``count`` independent ones; of
    the shapes of ``like``.
    """
    w = w / w.sum() * count
    return Tilt(*(_fit_block(r, w[r.trace], count, b) for r, b in zip(rows, like[:2], strict=True)))


def _fit_block(rows, w, count, like):
    """The `Block` of weighted rows, which count as those of ``count`` traces; of the shapes of
    ``like``.
    """
    if (chosen := _evenly(len(w))) is not None:
        w, rows = w[chosen] * (len(w) / ROWS), Rows(*(a[chosen] for a in rows))
    means, gates, shifts, scales = (np.zeros(a.shape) for a in like)
    for c in range(means.shape[1]):
        mine = (rows.own == c) & (w > 0)[:, None]
        common = _common(rows, w, mine, means.shape[3])
        for a in np.flatnonzero(mine.any(axis=0)):
            of = mine[:, a]
            means[:, c, a], gates[:, c, a], scales[c, a] = _fit_gaussians(
                rows.x[of], rows.normals[of, a], w[of], means.shape[3], common
            )
    for j in range(shifts.shape[1]):
        x = _choice_features(rows, j)
        log_p = rows.log_p[:, j]
        p = np.exp(log_p - log_sum(log_p)[:, None])
        target = np.eye(p.shape[1])[rows.choices[:, j]]
        if p.shape[1] > 2:  # one more trace, of the model, so that a few do not rule out the rest
            target = (count * target + p) / (count + 1)
        shifts[:, j] = _fit_log_odds(x, target, log_p, w, _ridge(x.shape[1]))
    return Block(means, gates, shifts, scales)


def _evenly(n):
    """At most `ROWS` numbers of ``n`` rows, evenly; None for all."""
    return None if n <= ROWS else np.linspace(0, n - 1, ROWS).astype(int)


def _ridge(size):
    ridge = np.full(size, RIDGE)
    ridge[0] = RIDGE_OF_CONSTANT
    return ridge


def _choice_features(rows, j):
    """Features [N, F + 3] of choice ``j``, as `Block` has them."""
    y = rows.x[:, FIRST_STATE_FEATURE if rows.x.shape[1] > FIRST_STATE_FEATURE else 0, None]
    r = rows.rare[:, j, None]
    return np.concatenate([rows.x, r, r * r, r * y], axis=-1)


def _common(rows, w, mine, size):
    """What `_fit_gaussians` makes of all numbers alike, which those of each shrink to; zeros for
    one Gaussian.
    """
    f = rows.x.shape[1]
    none = np.zeros((f, size)), np.zeros((f, size)), np.zeros(size)
    if size == 1 or mine.shape[1] == 1 or not mine.any():
        return none
    n, a = np.nonzero(mine)
    if (chosen := _evenly(len(n))) is not None:
        w = w * (len(n) / ROWS)
        n, a = n[chosen], a[chosen]
    return _fit_gaussians(rows.x[n], rows.normals[n, a], w[n], size, none)


def _fit_gaussians(x, z, w, size, common):
    """(means [F, G], log weights [F, G], log deviations [G]) of G Gaussians by expectation
    maximisation, from the middle, the upper and the lower numbers on; they shrink to ``common``
    ones. The first is a unit Gaussian.
    """
    means, log_g, scales = common
    if size == 1:
        return _least_squares(x, z[:, None], w[:, None], _ridge(x.shape[1])), log_g, scales
    if len(w) > ROWS_OF_SEVERAL:
        some = resample(np.log(w), ROWS_OF_SEVERAL, 0.5)
        x, z, w = x[some], z[some], np.full(ROWS_OF_SEVERAL, w.sum() / ROWS_OF_SEVERAL)
    if means.any():
        ridge = np.full(x.shape[1], RIDGE_OF_COMMON)
        shares = _shares(x, z, means, log_g, scales)
    else:
        ridge = _ridge(x.shape[1])
        shares = np.stack([np.abs(z) < OUTER, z >= OUTER, z <= -OUTER], axis=1).astype(float)
    for _ in range(EM_ITERATIONS):
        gap = z[:, None] - x @ common[0]
        means = common[0] + _least_squares(x, gap, w[:, None] * shares, ridge)
        offset = x @ common[1]
        log_g = common[1] + _fit_log_odds(x, shares, offset, w, ridge, log_g - common[1])
        square = (w[:, None] * shares * (z[:, None] - x @ means) ** 2).sum(axis=0)
        variance = (square + ridge[-1] * np.exp(2 * common[2])) / (w @ shares + ridge[-1])
        scales = np.log(np.clip(np.sqrt(variance), *DEVIATIONS))
        scales[0] = 0.0
        shares = _shares(x, z, means, log_g, scales)
    return means, log_g, scales


def _joint(x, z, means, log_g, scales):
    """log of weight_g q_g over p [N, G], but for the sum of the weights."""
    # [G, N] while it is computed: rows as short as G cost more than what is done with them
    gap = (z - means.T @ x.T) / np.exp(scales)[:, None]
    return (log_g.T @ x.T - scales[:, None] + (z**2 - gap**2) / 2).T


def _shares(x, z, means, log_g, scales):
    """Which part [N, G] of each number is of which Gaussian."""
    return np.exp(with_log_shares(_joint(x, z, means, log_g, scales))[1])


def _least_squares(x, z, w, ridge):
    """Least squares [F, G] of ``z`` [N, G] by ``x`` with the weights ``w`` [N, G]."""
    columns = [
        np.linalg.solve(x.T @ (x * v[:, None]) + np.diag(ridge), x.T @ (y * v))
        for y, v in zip(z.T, w.T, strict=True)
    ]
    return np.stack(columns, axis=1)


def _fit_log_odds(x, target, log_p, w, ridge, start=None):
    """Coefficients [F, C] of what is added to ``log_p`` [N, C], by Newton's steps for each category
    in turn against the others; the commonest category is the one that nothing is added to.
    ``target`` [N, C]: the parts of the categories in each row. ``start``: the first coefficients,
    of which a few steps are enough.
    """
    c = log_p.shape[1]
    if start is None:
        out, steps = np.zeros((x.shape[1], c)), NEWTON_STEPS
        base = np.argmax((np.exp(log_p) * w[:, None]).sum(axis=0))
    else:
        out, steps, base = start.copy(), EM_NEWTON_STEPS, 0
    others = [k for k in range(c) if k != base and np.isfinite(log_p[:, k]).any()]
    if not others:
        return out
    if start is None and len(others) > 1:
        steps *= 2

    def value(out):
        log_q = log_p + x @ out
        log_q = log_q - log_sum(log_q)[:, None]
        with np.errstate(invalid="ignore"):
            each = w @ np.where(target > 0, target * log_q, 0)
        return each.sum() - 0.5 * ridge @ (out**2).sum(axis=1), np.exp(log_q)

    now, p = value(out)
    for _ in range(steps):
        before = now
        for k in others:
            slope = x.T @ (w * (target[:, k] - p[:, k])) - ridge * out[:, k]
            bend = x.T @ (x * (w * p[:, k] * (1 - p[:, k]))[:, None]) + np.diag(ridge)
            step = np.linalg.solve(bend, slope)
            step *= min(1.0, FARTHEST_STEP / max(np.abs(x @ step).max(), 1e-12))
            for _ in range(QUARTERINGS):
                tried = out.copy()
                tried[:, k] += step
                then, q = value(tried)
                if then >= now:
                    out, now, p = tried, then, q
                    break
                step /= 4
        if now - before < GAIN:
            break
    return out


def log_ratios(tilts: list[Tilt], rows: tuple[Rows, Rows], n: int) -> np.ndarray:
    """log q_k - log p [n, K] of ``n`` traces under each of ``tilts``; of each step in the precision
    of its `Rows`, summed in double.
    """
    tilts = jax.tree.map(lambda a: np.asarray(a, rows[1].x.dtype), tilts)

    def of_tilt(tilt):
        each = zip(rows, tilt[:2], strict=True)
        ratios = ((r.trace, _log_ratio(b, r, tilt.floor, tilt.kept)) for r, b in each)
        return sum(np.bincount(trace, ratio, minlength=n) for trace, ratio in ratios)

    return np.stack([of_tilt(tilt) for tilt in tilts], axis=1)


def _log_ratio(block, rows, floor, kept):
    """log q - log p [N] of each row."""
    out = np.zeros(len(rows.x), rows.x.dtype)
    for a in range(rows.normals.shape[1]):
        for c in range(block.means.shape[1]):
            mine = rows.own[:, a] == c if block.means.shape[1] > 1 else slice(None)
            x, z, gates = rows.x[mine], rows.normals[mine, a], block.gates[:, c, a]
            of = block.means[:, c, a], gates, block.scales[c, a]
            out[mine] += log_sum(_joint(x, z, *of)) - log_sum(x @ gates)
    for j in range(rows.choices.shape[1]):
        log_p = rows.log_p[:, j]
        log_q = np.where(log_p > -np.inf, np.maximum(log_p, floor), -np.inf)
        log_q = log_q + _choice_features(rows, j) @ block.shifts[:, j]
        at = np.arange(len(log_p)), rows.choices[:, j]
        gain = log_q[at] - log_sum(log_q) - log_p[at]
        with np.errstate(divide="ignore"):
            out += np.logaddexp(np.log1p(-kept) + gain, np.log(kept))
    return out


def model_tilt(about: Shape, components_each: int) -> Tilt:
    """The model as a `Tilt` of so many Gaussians for each number."""
    count = features(unseen_frame(about), np.zeros((1, about.seen)), 0.0, np).shape[1]

    def block(f, numbers):
        normals, choices, categories, owners = numbers
        owning = categories if any(o >= 0 for o in owners) else 1
        none = np.zeros((f, owning, normals, components_each))
        return Block(none, none, np.zeros((f + 3, choices, categories)), none[0])

    return Tilt(block(1, about.first), block(count, about.steps))


def scale_tilt(tilt: Tilt, by: float) -> Tilt:
    """A tilt that moves ``by`` of the way."""
    blocks = (Block(by * b.means, b.gates, by * b.shifts, 0 * b.scales) for b in tilt[:2])
    return Tilt(*blocks, kept=tilt.kept)


def of_tilts(q: Tilts) -> tuple[list[Tilt], np.ndarray, Frame]:
    """What `as_tilts` made ``q`` of: those of its components that are used, their weights, and the
    `Frame`; in double precision.
    """
    q = jax.tree.map(lambda a: np.asarray(a, np.float64), q)
    weights = np.exp(q.log_weights)
    used = np.flatnonzero(weights)
    components = Tilt(q.first, q.steps, q.floors, np.broadcast_to(q.kept, q.floors.shape))
    return [jax.tree.map(itemgetter(int(k)), components) for k in used], weights[used], q.frame


def as_tilts(
    tilts: list[Tilt], weights: list[float], frame: Frame, size: int, dtype: DTypeLike
) -> Tilts:
    """The `Tilts` of these, the first of which is the model; of ``size`` components, so that
    programs are compiled once.
    """
    spare = size - len(tilts)
    with np.errstate(divide="ignore"):
        log_weights = np.log(np.pad(np.asarray(weights, float), (0, spare)))
    stacked = jax.tree.map(lambda *a: np.stack(a), *tilts, *[tilts[0]] * spare)
    q = Tilts(
        log_weights=log_weights,
        floors=stacked.floor,
        first=stacked.first,
        steps=stacked.steps,
        frame=frame,
        kept=stacked.kept,
    )
    return jax.tree.map(lambda a: np.asarray(a, dtype), q)
