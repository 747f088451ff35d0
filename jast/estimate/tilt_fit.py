"""Tilts fitted to weighted traces by cross-entropy: least squares for the means of normal numbers,
logistic regression for the log odds of choices.

On the host, in double precision. The cross-entropy optimum among tilts maximises the weighted
likelihood of the traces (Rubinstein and Kroese 2004), which falls apart into these regressions on
the features of each step.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast.estimate.markov_tilts import Frame, Shape, Tilts, Trace, features

__all__ = ["Tilt", "as_tilts", "fit", "frame_of", "ratios"]

PROJECTED, WITHIN = 6, 0.05
RIDGE, FREE = 1.0, 0.02
"""Of a normal prior on the coefficients, in steps; of the constant's."""
ITERATIONS, STEP = 25, 4.0
ROWS = 60_000


class Tilt(NamedTuple):
    """One tilt, on the host: as in `Tilts`."""

    first_means: np.ndarray
    first_shifts: np.ndarray
    means: np.ndarray
    shifts: np.ndarray
    floor: float = -np.inf


class Steps(NamedTuple):
    """The steps of traces, one a row."""

    x: np.ndarray
    """[N, F] features"""
    trace: np.ndarray
    """[N] whose step"""
    normals: np.ndarray
    choices: np.ndarray
    log_p: np.ndarray


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
        if at == m or value < 1e-4:
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
    return Frame(centre, project, y.min(axis=0) - WITHIN * span, y.max(axis=0) + WITHIN * span)


def steps_of(frame: Frame, trace: Trace, length: np.ndarray) -> Steps:
    """The `Steps` of traces of these lengths."""
    horizon = len(trace.seen)
    live = np.arange(horizon)[:, None] < length[None]
    t, at = np.nonzero(live)
    x = features(frame, trace.seen[live].astype(np.float64), t / horizon, np)
    return Steps(
        x,
        at,
        trace.normals[live].astype(np.float64),
        trace.choices[live],
        trace.log_p[live].astype(np.float64),
    )


def fit(steps: Steps, first: tuple, w: np.ndarray, count: float) -> Tilt:
    """The `Tilt` of traces of the weights ``w`` [n], which count as ``count`` independent ones;
    ``first``: their normals, choices and log probabilities of x0.
    """
    w = w / w.sum() * count
    each = w[steps.trace]
    if len(each) > ROWS:
        rows = np.linspace(0, len(each) - 1, ROWS).astype(int)
        each, steps = each[rows] * (len(each) / ROWS), Steps(*(a[rows] for a in steps))
    x = steps.x
    ridge = np.full(x.shape[1], RIDGE)
    ridge[0] = FREE
    gram = x.T @ (x * each[:, None])
    means = np.linalg.solve(gram + np.diag(ridge), x.T @ (steps.normals * each[:, None]))
    b, c = steps.log_p.shape[1:]
    shifts = np.zeros((x.shape[1], b, c))
    for j in range(b):
        shifts[:, j] = _logits(x, steps.choices[:, j], steps.log_p[:, j], each, ridge)
    z0, i0, log_p0 = first
    first_means = w @ z0 / (count + 1)
    first_shifts = np.zeros(log_p0.shape[1:])
    for j in range(log_p0.shape[1]):
        one = np.ones((len(w), 1))
        first_shifts[j] = _logits(one, i0[:, j], log_p0[:, j], w, np.array([FREE]))[0]
    return Tilt(first_means, first_shifts, means, shifts)


def _logits(x, chosen, log_p, w, ridge):
    """Coefficients [F, C] of what is added to ``log_p`` [N, C], by Newton's steps for each category
    in turn against the others; the commonest category is the one that nothing is added to.
    """
    c = log_p.shape[1]
    out = np.zeros((x.shape[1], c))
    with np.errstate(divide="ignore", over="ignore"):
        base = np.argmax((np.exp(log_p) * w[:, None]).sum(axis=0))
    others = [k for k in range(c) if k != base and np.isfinite(log_p[:, k]).any()]
    for _ in range(ITERATIONS if len(others) == 1 else ITERATIONS * 2):
        greatest = 0.0
        for k in others:
            log_q = log_p + x @ out
            top = log_q.max(axis=1, keepdims=True)
            q = np.exp(log_q - top)
            p = q[:, k] / q.sum(axis=1)
            slope = x.T @ (w * ((chosen == k) - p)) - ridge * out[:, k]
            bend = x.T @ (x * (w * p * (1 - p))[:, None]) + np.diag(ridge)
            step = np.linalg.solve(bend, slope)
            size = np.abs(x @ step).max()
            step *= min(1.0, STEP / max(size, 1e-12))
            out[:, k] += step
            greatest = max(greatest, size)
        if greatest < 1e-3:
            break
    return out


def ratios(tilts: list[Tilt], steps: Steps, first: tuple, n: int) -> np.ndarray:
    """log q_k - log p [n, K] of ``n`` traces under each of ``tilts``."""
    return np.stack([_ratio(t, steps, first, n) for t in tilts], axis=1)


def _ratio(t, steps, first, n):
    each = np.zeros(len(steps.x))
    means = steps.x @ t.means
    each += (means * (steps.normals - means / 2)).sum(axis=1)
    if steps.log_p.shape[1]:
        shifts = np.einsum("nf,fbc->nbc", steps.x, t.shifts)
        each += _gain(steps.log_p, shifts, steps.choices, t.floor)
    z0, i0, log_p0 = first
    start = (t.first_means * (z0 - t.first_means / 2)).sum(axis=1)
    if log_p0.shape[1]:
        start = start + _gain(log_p0, t.first_shifts[None], i0, t.floor)
    return np.bincount(steps.trace, each, minlength=n) + start


def _gain(log_p, shifts, chosen, floor):
    """What tilted choices add to log q - log p: [N]."""
    log_q = np.where(log_p > -np.inf, np.maximum(log_p, floor), -np.inf) + shifts
    top = log_q.max(axis=-1, keepdims=True)
    log_q = log_q - top - np.log(np.exp(log_q - top).sum(axis=-1, keepdims=True))
    at = lambda a: np.take_along_axis(a, chosen[..., None], axis=-1)[..., 0]
    return (at(log_q) - at(log_p)).sum(axis=1)


def nothing(about: Shape, count: int) -> Tilt:
    """The model as a `Tilt` of ``count`` features."""
    return Tilt(
        np.zeros(about.normals0),
        np.zeros((about.choices0, about.categories0)),
        np.zeros((count, about.normals)),
        np.zeros((count, about.choices, about.categories)),
    )


def as_tilts(tilts: list[Tilt], weights: Any, frame: Frame, size: int, dtype: Any) -> Tilts:
    """The `Tilts` of these, the first of which is the model; of ``size`` components, so that
    programs are compiled once.
    """
    spare = size - len(tilts)
    tilts = [*tilts, *[tilts[0]] * spare]
    with np.errstate(divide="ignore"):
        log_weights = np.log(np.concatenate([np.asarray(weights, float), np.zeros(spare)]))
    stack = lambda name: np.stack([np.asarray(getattr(t, name)) for t in tilts])
    arrays = (
        log_weights,
        stack("floor"),
        stack("first_means"),
        stack("first_shifts"),
        stack("means"),
        stack("shifts"),
        frame,
    )
    return Tilts(*jax.tree.map(lambda a: jnp.asarray(a, dtype), arrays))
