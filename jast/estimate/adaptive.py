"""failure_probability: an estimator that looks for its own proposal, and says when it must not be believed.

Exploration by design points (gradients) and by subset simulation; mixtures of Gaussians over the latents, fitted by cross-entropy to weighted failures of all batches
(the balance heuristic, Veach and Guibas 1995); then a guard, a population that is kept out of what the proposal covers; then an independent batch under the frozen
proposal, which alone makes the estimate and its interval.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from jast._checks import whole
from jast.estimate import latent, sums
from jast.estimate.design_points import design_points, distinct
from jast.estimate.estimate import estimate, of_counts
from jast.estimate.fit import Gaussians, as_latent, fit
from jast.estimate.importance import LANES, Traces, chunks
from jast.estimate.subset import cool, explore

__all__ = ["failure_probability"]

SIZE = 40
"""Components of a proposal, unused ones included: one shape, one program."""
WIDE = 0.2
"""Share of the proposal whose covariances are nowhere narrower than the model's, so that no weight is without variance."""
COVERED = 50.0
"""A failure is covered where its weight is at most so many times the mean."""
LOST = 0.01
"""A share of the probability that the guard may find outside of what is covered."""
GUARDS, CHAINS = 3, 100


class Batch(NamedTuple):
    """Points drawn from one proposal, of which those that fail count."""

    q: latent.Latent
    z: np.ndarray
    used: np.ndarray
    failure: np.ndarray
    log_weight: np.ndarray


def failure_probability(key, sim, budget=100_000, *, level=0.95, gradients=True, progress=False, callback=None):
    budget = whole("failure_probability", "budget", budget, 2000)
    latent.check_latent("failure_probability", sim)
    key, for_rng = jax.random.split(key)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(for_rng)).astype(np.uint32).tolist())
    found = _search(key, sim, budget, rng, gradients)
    key = jax.random.fold_in(key, 0)
    n = budget - found.spent
    history = tuple(found.history)
    if found.q is None or found.crude:
        simulate = lambda i: _crude(jax.random.fold_in(key, i), sim, min(LANES, n))
        total, notes = chunks(simulate, min(LANES, n), n, progress, callback, "failure_probability")
        return of_counts("failure_probability", total, level=level, reasons=found.reasons, notes=notes, evaluations=budget, history=history)
    lanes = min(LANES, n)
    simulate = lambda i: _traces(jax.random.fold_in(key, i), sim, found.q, lanes)
    total, notes = chunks(simulate, lanes, n, progress, callback, "failure_probability")
    reasons = list(found.reasons)
    result = estimate("failure_probability", total, level=level, reasons=reasons, notes=notes, evaluations=found.spent + total.samples, proposal=found.q, history=history)
    return result


class Found(NamedTuple):
    q: Any
    crude: bool
    spent: int
    reasons: list
    history: list


def _search(key, sim, budget, rng, gradients):
    keys = iter(jax.random.split(key, 64))
    dtype, d = latent.normal_numbers(sim), latent.dimension(sim)
    size, n = max(budget // 100, 100), max(budget // 25, 300)
    spent, history, reasons, batches, q, log_mean = 0, [], [], [], None, None
    rare = True

    def propose(g, low=0.0):
        """The `Latent` of ``g``, with its share of wide components, and where failures are not rare of the model."""
        origin = Gaussians(np.ones(1), np.zeros((1, d)), np.ones((1, d)), np.eye(d)[None])
        nominal = 0.0 if rare else 0.1
        parts = [(1 - WIDE - nominal, g._replace(values=np.maximum(g.values, low))), (WIDE, g._replace(values=np.maximum(g.values, 1.0)))]
        return as_latent([*parts, (nominal, origin)] if nominal else parts, dtype, SIZE)

    def refit(most):
        """Batches, each of a mixture fitted to all before it, while the last one is better than the one before."""
        nonlocal spent, q, log_mean
        before = 0.0
        for _ in range(most):
            z, o, log_w = jax.device_get(_batch(next(keys), sim, q, n))
            b = Batch(q, z, o.used, o.failure, log_w.astype(np.float64))
            spent += n
            if not b.failure.any():
                history.append(f"batch of {n}: no failure")
                break
            batches.append(b)
            log_w = _balanced(batches)
            failing = np.concatenate([b.failure for b in batches])
            top = log_w[failing].max()
            log_mean = top + math.log(np.exp(log_w[failing] - top).sum() / (n * len(batches)))
            own = _ess(b.log_weight[b.failure])
            log_w = log_w[failing]
            power = _temper(log_w, min(max(200, 5 * d), 0.5 * len(log_w)))
            w = np.exp(power * (log_w - top))
            points = _filled(rng, np.concatenate([b.z for b in batches]), np.concatenate([b.used for b in batches]))[failing]
            g = fit(rng, points, w / w.sum(), w.sum() ** 2 / (w**2).sum())
            q = propose(g)
            # what the fit has let go
            by_q = np.concatenate([np.asarray(_log_ratio(q, b.z, b.used)) for b in batches])[failing]
            bare = by_q < -log_mean - math.log(COVERED)
            lost = np.exp(log_w - top)[bare].sum() / np.exp(log_w - top).sum()
            if lost > LOST / 2 and bare.sum() > 3:
                v = np.exp(power * (log_w[bare] - log_w[bare].max()))
                q = _together(q, propose(fit(rng, points[bare], v / v.sum(), v.sum() ** 2 / (v**2).sum(), limit=4), 0.3), max(lost, 0.05))
            history.append(
                f"batch of {n}: {b.failure.mean():.1%} fail, ESS {own:.4g}; all batches: log p {log_mean:.3f}, power {power:.2f}, {len(g.weights)} components, {lost:.2%} let go"
            )
            if own < 1.15 * before and power == 1:
                break
            before = own

    parts, known = [], []  # what the first proposal is made of; failures of independent populations

    def learn(name, s):
        nonlocal spent
        spent += s.evaluations
        history.append(f"{name}: {len(s.levels)} levels, " + (f"log p {s.log_mean:.2f}" if s.reached else "no failure") + f", {s.evaluations} evaluations")
        return s

    def fitted(s):
        n = len(s.points)
        return fit(rng, _filled(rng, s.points, s.used), np.full(n, 1 / n), n / 5, n / 20)

    def around(name, points, evaluations):
        """A unit Gaussian at each of these design points."""
        nonlocal spent
        spent, k = spent + evaluations, len(points)
        norms = np.linalg.norm(points, axis=1)
        history.append(f"{name}: {k} points" + (f", norms {norms[0]:.3f} to {norms[-1]:.3f}" if k else "") + f", {evaluations} evaluations")
        if k:
            weights = np.exp(-0.5 * (norms**2 - norms[0] ** 2)) + 0.05
            parts.append(Gaussians(weights / weights.sum(), points, np.ones((k, d)), np.broadcast_to(np.eye(d), (k, d, d))))
        return k

    by_gradient = 0
    if gradients:
        found = design_points(next(keys), sim)
        by_gradient = around("gradients", found.points, found.evaluations)
    s = cool(next(keys), sim, size // 2, CHAINS)
    points = np.where(np.arange(d)[None] < s.used[:, None], s.points, 0.0)
    around("wider noise, cooled", distinct(points, 16), s.evaluations)
    if not by_gradient:
        s = learn("subset simulation", explore(next(keys), sim, size, most=int(0.4 * budget)))
        if s.reached:
            known.append(s)
            parts.append(fitted(s))
    if not parts:
        return Found(None, False, spent, reasons, history)
    if known:
        rare = max(s.log_mean for s in known) < math.log(1e-4)
    q = propose(parts[0], 0.3)
    for i, g in enumerate(parts[1:], 2):
        q = _together(q, propose(g, 0.3), 1 / i)
    refit(5)
    for guards in range(1, GUARDS + 1):
        if log_mean is None:
            break
        covered = (q, jnp.asarray(-log_mean - math.log(COVERED), dtype))
        s = learn("guard", explore(next(keys), sim, size // 2, covered=covered, least=log_mean + math.log(LOST), most=int(0.2 * budget)))
        sets, shares = [s], [math.exp(min(s.log_mean - log_mean, 50)) if s.reached else 0.0]
        for other in known:
            bare = np.asarray(_log_ratio(q, other.points, other.used)) < float(covered[1])
            shares.append(bare.mean())
            sets.append(other._replace(points=other.points[bare], used=other.used[bare]))
        thin = _thin(batches, _balanced(batches), log_mean)
        history.append(f"guard: {', '.join(f'{v:.2%}' for v in shares)} of the probability where the proposal is thin, {thin:.2%} by its own account")
        lost = [(v, s) for v, s in zip(shares, sets, strict=True) if v > 2 * thin + 2 * LOST]
        if not lost:
            break
        if guards == GUARDS or spent + 3 * n > 0.75 * budget:
            reasons.append(f"failures that the proposal hardly draws may carry {max(shares):.0%} of what it found")
            break
        for share, s in lost:
            q = _together(q, propose(fitted(s), 0.3), min(max(share / (1 + share), 0.15), 0.85))
        refit(3)
    crude = False
    if log_mean is not None:
        p = min(math.exp(log_mean), 1.0)
        b = batches[-1]
        crude = n / max(_ess(b.log_weight[b.failure]), 1e-9) - 1 > (1 - p) / p
    return Found(q if log_mean is not None else None, crude, spent, reasons, history)


def _together(a, b, share):
    """The mixture of two `Latent`, ``share`` of the second; the least components give way."""
    weights = np.concatenate([np.asarray(a.log_weights, np.float64) + math.log1p(-share), np.asarray(b.log_weights, np.float64) + math.log(share)])
    kept = np.argsort(-weights, kind="stable")[:SIZE]
    weights = weights[kept] - np.log(np.exp(weights[kept]).sum())
    rest = [jnp.concatenate([u, v])[kept] for u, v in zip(a[1:], b[1:], strict=True)]
    return latent.Latent(jnp.asarray(weights, a.means.dtype), *rest)


def _thin(batches, log_w, log_mean):
    """The share of the estimate, by all batches, of failures whose weight is above that of a covered one."""
    failing = np.concatenate([b.failure for b in batches])
    w = np.exp(log_w[failing] - log_w[failing].max())
    return w[log_w[failing] > log_mean + math.log(COVERED)].sum() / w.sum()


def _ess(log_w):
    w = np.exp(log_w - log_w.max())
    return w.sum() ** 2 / (w**2).sum()


def _temper(log_w, least):
    """The greatest power at most 1 of the weights with an effective number of ``least``: few great weights would fit their own noise."""
    low, high = 0.0, 1.0
    if _ess(log_w) >= least:
        return 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if _ess(middle * log_w) >= least else (low, middle)
    return low


def _filled(rng, z, used):
    """The points with the numbers that decided nothing drawn anew from the model, which is what they are given the failure."""
    return np.where(np.arange(z.shape[1])[None] < used[:, None], z.astype(np.float64), rng.standard_normal(z.shape))


def _balanced(batches):
    """Log weights of all points by the balance heuristic: p over the mean of the batches' proposals."""
    logs = []
    for b in batches:
        by = np.stack([-b.log_weight if c is b else np.asarray(_log_ratio(c.q, b.z, b.used), np.float64) for c in batches])
        top = by.max(axis=0)
        logs.append(-top - np.log(np.exp(by - top).mean(axis=0)))
    return np.concatenate(logs)


@jax.jit
def _log_ratio(q, z, used):
    return logsumexp(latent.log_ratios(q, z, used) + q.log_weights[None], axis=1)


@partial(jax.jit, static_argnums=3)
def _batch(key, sim, q, n):
    z = latent.draw(key, q, n)
    o = latent.outcomes(sim, z)
    return z, o, -_log_ratio(q, z, o.used)


@partial(jax.jit, static_argnums=3)
def _traces(key, sim, q, n):
    z = latent.draw(key, q, n)
    o = latent.outcomes(sim, z)
    joint = latent.log_ratios(q, z, o.used) + q.log_weights[None]
    log_q = logsumexp(joint, axis=1)
    return Traces(-log_q, joint - log_q[:, None], o.failure, o.invalid, o.length)


@partial(jax.jit, static_argnums=2)
def _crude(key, sim, n):
    z = jax.random.normal(key, (n, latent.dimension(sim)), latent.normal_numbers(sim))
    o = latent.outcomes(sim, z)
    return Traces(jnp.zeros(n, z.dtype), jnp.zeros((n, 1), z.dtype), o.failure, o.invalid, o.length)
