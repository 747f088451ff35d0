"""A Gaussian process on a limit state of which only the safe side is seen: the miss distance where
an episode is safe, and that it is below 0 where one fails.

On the host, in double precision. Distances are observed values, failures are half-lines; Gaussian
sites stand for these by expectation propagation (Minka 2001; Rasmussen and Williams 2006, Gaussian
processes for machine learning, ch. 3.6), so that predictions are those of a regression. The
covariance has a constant and a linear part, and Matern 5/2 with a lengthscale for each coordinate;
hyperparameters climb the likelihood with the sites held.
"""

import math
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Surrogate", "covariance", "fit", "normal_cdf", "predict"]

ROUNDS, ASCENTS, STEP = 2, 8, 0.15
SWEEPS, DAMPING, SETTLED = 12, 0.8, 0.01
JITTER, LEAST, BLOCK = 1e-8, 1e-12, 500
SHAPE = math.sqrt(5.0)
_erfc = np.frompyfunc(math.erfc, 1, 1)


class Surrogate(NamedTuple):
    """A fitted process, of distances that are warped, t = warp log(1 + y / warp), and scaled. On
    the host.
    """

    z: np.ndarray
    """[n, D]"""
    logs: np.ndarray
    """[3 + D] logarithms: the variances of the constant, the linear part and the noise, relative to
    that of the Matern part, and 1 / lengthscale of each coordinate"""
    weights: np.ndarray
    """[n]: the inverse times the targets"""
    inverse: np.ndarray
    """[n, n] of the covariance with noise and sites"""
    sites: tuple
    """Precisions [n], and these times the means [n], of what stands for the values"""
    warp: float
    """inf: none"""
    evidence: float
    """Log probability of the distances and failures, times the prior of ``logs``"""

    @property
    def noise(self) -> float:
        """Its variance."""
        return math.exp(self.logs[2])


def normal_cdf(x: np.ndarray) -> np.ndarray:
    """Phi(x), exact in the lower tail."""
    return 0.5 * _erfc(-np.asarray(x, float) / math.sqrt(2)).astype(float)


def fit(
    z: np.ndarray,
    distance: np.ndarray,
    failing: np.ndarray,
    before: Surrogate | None = None,
    warp: float = math.inf,
    rounds: int = ROUNDS,
) -> Surrogate:
    """The `Surrogate` of points ``z`` [n, D] with ``distance`` [n] where not ``failing`` [n];
    ``before``: one of the first of them, to start from.
    """
    safe, d = ~failing, z.shape[1]
    t = distance if math.isinf(warp) else warp * np.log1p(distance / warp)
    seen = t[safe] if safe.any() else np.ones(1)
    scale = max(float(seen.std()), 0.1 * float(np.abs(seen).mean()), 1e-300)
    t = np.where(failing, 0.0, t / scale)
    prior = np.concatenate([np.log([4.0, 0.1, 1e-5]), np.full(d, -math.log(3 * math.sqrt(d)))])
    spread = np.concatenate([[1.5, 2.0, 2.0], np.ones(d)])
    logs = prior if before is None else before.logs
    tau, nu = np.where(failing, 1e-6, 1.0), np.zeros(len(z))
    if before is not None:
        for new, old in zip((tau, nu), before.sites, strict=True):
            new[: len(old)] = old
    for i in range(rounds + 1):
        noise, k = math.exp(logs[2]), covariance(z, z, logs)[0]
        tau, nu = np.where(failing, tau, 1 / noise), np.where(failing, nu, t / noise)
        tau, nu = _sites(k, tau, nu, failing, noise)
        if i < rounds:
            logs = _climbed(z, nu / tau, 1 / tau, failing, logs, prior, spread)
    inverse = np.linalg.inv(_with_noise(k, 1 / tau))
    value = _evidence(k, tau, nu, failing, noise) - 0.5 * (((logs - prior) / spread) ** 2).sum()
    # densities of the distances themselves: the derivative of the warp and the scale
    bent = 0.0 if math.isinf(warp) else np.log1p(distance[safe] / warp).sum()
    value -= bent + safe.sum() * math.log(scale)
    return Surrogate(z, logs, inverse @ (nu / tau), inverse, (tau, nu), warp, float(value))


def predict(s: Surrogate, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation [m] of the scaled limit state at ``z`` [m, D]."""
    constant, linear, _ = np.exp(s.logs[:3])
    mean, known = np.empty(len(z)), np.empty(len(z))
    for i in range(0, len(z), BLOCK):  # what fits a cache
        k, _ = covariance(z[i : i + BLOCK], s.z, s.logs)
        mean[i : i + BLOCK] = k @ s.weights
        known[i : i + BLOCK] = ((k @ s.inverse) * k).sum(axis=1)
    own = constant + linear * (z**2).sum(axis=1) + 1.0
    return mean, np.sqrt(np.maximum(own - known, LEAST))


def covariance(a: np.ndarray, b: np.ndarray, logs: np.ndarray) -> tuple[np.ndarray, Any]:
    """[n, m] of the points ``a`` [n, D] and ``b`` [m, D], and what its derivatives need."""
    constant, linear, _ = np.exp(logs[:3])
    x, y = a * np.exp(logs[3:]), b * np.exp(logs[3:])
    square = (x**2).sum(axis=1)[:, None] + (y**2).sum(axis=1)[None] - 2 * x @ y.T
    r = SHAPE * np.sqrt(np.maximum(square, 0.0))
    e = np.exp(-r)
    k = (1 + r * (1 + r / 3)) * e
    k += linear * (a @ b.T) + constant
    return k, (r, e)


def _with_noise(k, noise):
    """``k`` with ``noise`` [n] on its diagonal, and what rounding needs."""
    out = k.copy()
    out[np.diag_indices(len(k))] += noise + JITTER * np.diagonal(k).mean()
    return out


def _cavities(k, tau, nu, failing):
    """Means and variances of the failing points without their own sites."""
    f = np.flatnonzero(failing)
    gain = k[f] @ np.linalg.inv(_with_noise(k, 1 / tau))
    variance = np.maximum(k[f, f] - (gain * k[f]).sum(axis=1), LEAST)
    v = 1 / np.maximum(1 / variance - tau[f], 1e-8)
    return v * (gain @ (nu / tau) / variance - nu[f]), v


def _sites(k, tau, nu, failing, noise):
    """Precisions and precision-weighted means [n], those of the failures by expectation
    propagation, all at once and damped.
    """
    if not failing.any():
        return tau, nu
    tau, nu, last = tau.copy(), nu.copy(), np.inf
    for _ in range(SWEEPS):
        m, v = _cavities(k, tau, nu, failing)
        # moments of N(m, v) below 0, seen through noise (R&W eq. 3.58)
        sd = np.sqrt(v + noise)
        h = _hazard(-m / sd)
        mean = m - v / sd * h
        variance = v * np.maximum(1 - v / sd**2 * h * (h - m / sd), 1e-9)
        new = np.clip(1 / variance - 1 / v, 1e-8, 1e8)
        tau[failing] += DAMPING * (new - tau[failing])
        nu[failing] += DAMPING * (mean / variance - m / v - nu[failing])
        if (np.abs(mean - last) < SETTLED * np.sqrt(variance)).all():
            break
        last = mean
    return tau, nu


def _evidence(k, tau, nu, failing, noise):
    """Log probability of what was seen, by the sites (R&W eq. 3.65)."""
    target, matrix = nu / tau, _with_noise(k, 1 / tau)
    value = _gaussian(target, matrix) - 0.5 * (~failing).sum() * math.log(2 * math.pi)
    if failing.any():
        m, v = _cavities(k, tau, nu, failing)
        both = v + 1 / tau[failing]
        terms = 0.5 * np.log(both) + 0.5 * (m - target[failing]) ** 2 / both
        value += (_log_cdf(-m / np.sqrt(v + noise)) + terms).sum()
    return value


def _gaussian(target, matrix):
    """Log density without its constant (R&W eq. 2.30)."""
    return -0.5 * target @ np.linalg.solve(matrix, target) - 0.5 * _log_det(matrix)


def _climbed(z, target, extra, failing, logs, prior, spread):
    """Ascents of the likelihood with its sites and the prior, by the signs of the gradient
    (Riedmiller and Braun 1993): the best of ``logs`` on the way.
    """
    d = z.shape[1]
    low, high = np.array([-9, -12, -16, *[-8] * d]), np.array([7, 4, 0, *[3] * d])
    size, last, best, top = np.full(3 + d, STEP), np.zeros(3 + d), logs, -math.inf
    for _ in range(ASCENTS):
        value, slope = _likelihood(z, target, extra, failing, logs)
        value -= 0.5 * (((logs - prior) / spread) ** 2).sum()
        slope = slope - (logs - prior) / spread**2
        if value > top:
            top, best = value, logs
        size = np.clip(
            size * np.choose(1 + np.sign(slope * last).astype(int), (0.5, 1, 1.3)), 1e-3, 1
        )
        logs, last = np.clip(logs + size * np.sign(slope), low, high), slope
    return best


def _likelihood(z, target, extra, failing, logs):
    """Log likelihood of the targets and its gradient (R&W eq. 2.30 and 5.9)."""
    constant, linear, noise = np.exp(logs[:3])
    k, (r, e) = covariance(z, z, logs)
    matrix = _with_noise(k, np.where(failing, extra, noise))
    inverse = np.linalg.inv(matrix)
    alpha = inverse @ target
    w = np.outer(alpha, alpha) - inverse
    # of Matern 5/2 by log(1 / lengthscale_i): -5/3 (1 + r) e^-r (z_i - z'_i)^2 / lengthscale_i^2
    slope = -(5 / 3) * (1 + r) * e * w
    square = 2 * (slope.sum(axis=1) @ z**2 - ((slope @ z) * z).sum(axis=0))
    gradient = (
        constant * w.sum(),
        linear * (w * (z @ z.T)).sum(),
        noise * np.diagonal(w)[~failing].sum(),
        *(square * np.exp(2 * logs[3:])),
    )
    value = -0.5 * target @ alpha - 0.5 * _log_det(matrix)
    return value, 0.5 * np.array(gradient)


def _log_det(matrix):
    return 2 * np.log(np.diagonal(np.linalg.cholesky(matrix))).sum()


def _hazard(a):
    """phi(a) / Phi(a)."""
    low = a < -12
    b, c = np.where(low, 0.0, a), np.where(low, a, -12.0)
    exact = np.exp(-0.5 * b**2) / math.sqrt(2 * math.pi) / normal_cdf(b)
    return np.where(low, -c / (1 - 1 / c**2 + 3 / c**4), exact)


def _log_cdf(a):
    """log Phi(a)."""
    low = np.minimum(a, 0.0)
    lower = -0.5 * low**2 - 0.5 * math.log(2 * math.pi) - np.log(_hazard(low))
    return np.where(a < 0, lower, np.log1p(-normal_cdf(-np.maximum(a, 0.0))))
