"""A Gaussian process on a limit state of which mostly the safe side is seen: the miss distance of
safe episodes; of a failure how far below 0 it is, or only that it is below.

On the host, in double precision. Distances are observed values, failures without a depth (hidden
ones) are half-lines; Gaussian sites stand for these by expectation propagation (Minka 2001;
Rasmussen and Williams 2006, Gaussian processes for machine learning, ch. 3.6), so that predictions
are those of a regression. The covariance has a constant and a linear part, and Matern 5/2 with a
lengthscale for each axis; hyperparameters climb the likelihood with the sites held. The axes are
the coordinates, or turned to where the slope of a process fitted before varies most, as those of
active subspaces (Constantine 2015): a combination of coordinates can then be one axis.
"""

import math
from typing import NamedTuple

import numpy as np

__all__ = [
    "Surrogate",
    "fit",
    "posterior_covariance",
    "predict",
    "probability_below_zero",
    "turned",
]

ROUNDS = 2  # hyperparameters and sites are fitted in turn; a round costs `ASCENTS` inverses
ASCENTS = 8  # steps of the hyperparameters in a round
FIRST_STEP = 0.15  # of the logarithm of each hyperparameter
STEP_RANGE = 1e-3, 1.0  # least and greatest step
SIGN_CHANGED = 0.5  # factor on a step whose gradient changed its sign (Riedmiller and Braun 1993)
SIGN_KEPT = 1.3  # factor on a step whose gradient did not
SWEEPS = 12  # of expectation propagation, at most
DAMPING = 0.8  # part of the way to its new value that a site goes: moved at once, they overshoot
CONVERGED = 0.01  # change of all means, in standard deviations, that ends the sweeps
PRECISIONS = 1e-8, 1e8  # of sites: beyond these, matrices are singular in double precision
UNSEEN_PRECISION = 1e-6  # of the first site of a hidden failure: nothing is known of its value
JITTER = 1e-8  # part of the mean variance, added to a diagonal against rounding
LEAST_VARIANCE = 1e-12  # a smaller difference of variances is rounding
BLOCK = 500  # points of a prediction at a time, whose covariances fit a cache
MATERN_SCALE = math.sqrt(5.0)  # of a scaled distance in the Matern 5/2 covariance


class Prior(NamedTuple):
    """Independent normal prior of the logarithms of the hyperparameters, and their range."""

    mean: np.ndarray
    """[3 + D]"""
    deviation: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def log_density(self, logs: np.ndarray) -> float:
        """Without its constant."""
        return -0.5 * (((logs - self.mean) / self.deviation) ** 2).sum()


def _prior(dimension):
    """The `Prior`: weak; lengthscales are in proportion to the norm of a normal vector."""
    lengthscale = (-math.log(3 * math.sqrt(dimension)), 1.0, -8.0, 3.0)
    rows = [
        (math.log(4.0), 1.5, -9.0, 7.0),  # variance of the constant, the Matern part's being 1
        (math.log(0.1), 2.0, -12.0, 4.0),  # of the linear part
        (math.log(1e-5), 2.0, -16.0, 0.0),  # of the noise
    ]
    return Prior(*np.array([*rows, *[lengthscale] * dimension]).T)


class Surrogate(NamedTuple):
    """A fitted process, of distances y that are warped, t = sign(y) warp log(1 + |y| / warp), and
    scaled. On the host.
    """

    points: np.ndarray
    """[n, D] along the axes"""
    axes: np.ndarray
    """[D, D]: an orthonormal axis a row"""
    logs: np.ndarray
    """[3 + D] logarithms: the variances of the constant, the linear part and the noise, relative to
    that of the Matern part, and 1 / lengthscale along each axis"""
    weights: np.ndarray
    """[n]: the inverse times the targets"""
    inverse: np.ndarray
    """[n, n] of the covariance with noise and sites"""
    sites: tuple[np.ndarray, np.ndarray]
    """Precisions [n], and these times the means [n], of what stands for the values"""
    warp: float
    """inf: none"""
    evidence: float
    """Log probability of the distances and failures, times the prior of ``logs``; of turned
    axes less log(n) / 2 for each of their D (D - 1) / 2 angles (BIC, Schwarz 1978)"""

    @property
    def noise(self) -> float:
        """Its variance."""
        return math.exp(self.logs[2])


def probability_below_zero(mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """The probability that a normal number is below 0."""
    from scipy.special import ndtr  # here: slow to import

    return ndtr(-mean / deviation)


def fit(
    z: np.ndarray,
    distance: np.ndarray,
    hidden: np.ndarray,
    before: Surrogate | None = None,
    warp: float = math.inf,
    rounds: int = ROUNDS,
) -> Surrogate:
    """The `Surrogate` of points ``z`` [n, D] with ``distance`` [n] where not ``hidden`` [n], which
    failed without saying how deep. ``before``: of the first of them, which gives the axes, and the
    hyperparameters and sites to start from.
    """
    n, d = z.shape
    axes = np.eye(d) if before is None else before.axes
    z = z @ axes.T
    seen = ~hidden
    size = np.abs(distance)
    t = distance if math.isinf(warp) else np.sign(distance) * warp * np.log1p(size / warp)
    values = t[seen] if seen.any() else np.ones(1)
    scale = max(float(values.std()), 0.1 * float(np.abs(values).mean()), 1e-300)
    t = np.where(hidden, 0.0, t / scale)
    prior = _prior(d)
    logs = prior.mean if before is None else before.logs
    tau, nu = np.where(hidden, UNSEEN_PRECISION, 1.0), np.zeros(n)
    if before is not None:
        for new, old in zip((tau, nu), before.sites, strict=True):
            new[: len(old)] = old
    for i in range(rounds + 1):
        noise, k = math.exp(logs[2]), _covariance(z, z, logs)[0]
        tau, nu = np.where(hidden, tau, 1 / noise), np.where(hidden, nu, t / noise)
        tau, nu = _fit_sites(k, tau, nu, hidden, noise)
        if i < rounds:
            logs = _climb(z, nu / tau, 1 / tau, hidden, logs, prior)
    inverse = np.linalg.inv(_with_noise(k, 1 / tau))
    value = _evidence(k, tau, nu, hidden, noise) + prior.log_density(logs)
    # densities of the distances themselves: the derivative of the warp and the scale
    log_slope = 0.0 if math.isinf(warp) else np.log1p(size[seen] / warp).sum()
    value -= log_slope + seen.sum() * math.log(scale)
    if (axes != np.eye(d)).any():
        value -= d * (d - 1) / 2 * math.log(n) / 2
    return Surrogate(
        points=z,
        axes=axes,
        logs=logs,
        weights=inverse @ (nu / tau),
        inverse=inverse,
        sites=(tau, nu),
        warp=warp,
        evidence=float(value),
    )


def predict(surrogate: Surrogate, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation [m] of the scaled limit state at ``z`` [m, D]."""
    constant, linear, _ = np.exp(surrogate.logs[:3])
    z = z @ surrogate.axes.T
    mean, explained = np.empty(len(z)), np.empty(len(z))
    for i in range(0, len(z), BLOCK):
        k, _ = _covariance(z[i : i + BLOCK], surrogate.points, surrogate.logs)
        mean[i : i + BLOCK] = k @ surrogate.weights
        explained[i : i + BLOCK] = ((k @ surrogate.inverse) * k).sum(axis=1)
    own = constant + linear * (z**2).sum(axis=1) + 1.0
    return mean, np.sqrt(np.maximum(own - explained, LEAST_VARIANCE))


def posterior_covariance(surrogate: Surrogate, z: np.ndarray) -> np.ndarray:
    """[m, m] of the scaled limit state at ``z`` [m, D]."""
    z = z @ surrogate.axes.T
    k, _ = _covariance(z, surrogate.points, surrogate.logs)
    return _covariance(z, z, surrogate.logs)[0] - k @ surrogate.inverse @ k.T


def turned(surrogate: Surrogate) -> Surrogate:
    """A start for `fit` with other axes: the eigenvectors of the covariance of the surrogate's
    slopes, with the lengthscales as they were along these. It is no fit itself.
    """
    z, scale = surrogate.points, np.exp(surrogate.logs[3:])
    _, (r, e) = _covariance(z, z, surrogate.logs)
    # of Matern 5/2 by z_i: -5/3 (1 + r) e^-r (z_i - z'_i) / lengthscale_i^2
    by = -(5 / 3) * (1 + r) * e * surrogate.weights
    slopes = (by.sum(axis=1)[:, None] * z - by @ z) * scale**2
    slopes -= slopes.mean(axis=0)
    _, columns = np.linalg.eigh(slopes.T @ slopes)
    logs = np.concatenate([surrogate.logs[:3], 0.5 * np.log(scale**2 @ columns**2)])
    return surrogate._replace(points=z @ columns, axes=columns.T @ surrogate.axes, logs=logs)


def _covariance(a, b, logs):
    """[n, m] of the points ``a`` [n, D] and ``b`` [m, D], and what its derivatives need."""
    constant, linear, _ = np.exp(logs[:3])
    x, y = a * np.exp(logs[3:]), b * np.exp(logs[3:])
    square = (x**2).sum(axis=1)[:, None] + (y**2).sum(axis=1)[None] - 2 * x @ y.T
    r = MATERN_SCALE * np.sqrt(np.maximum(square, 0.0))
    e = np.exp(-r)
    k = (1 + r * (1 + r / 3)) * e
    k += linear * (a @ b.T) + constant
    return k, (r, e)


def _with_noise(k, noise):
    """``k`` with ``noise`` [n] on its diagonal, and what rounding needs."""
    out = k.copy()
    out[np.diag_indices(len(k))] += noise + JITTER * np.diagonal(k).mean()
    return out


def _cavities(k, tau, nu, hidden):
    """Means and variances of the hidden points without their own sites."""
    f = np.flatnonzero(hidden)
    gain = k[f] @ np.linalg.inv(_with_noise(k, 1 / tau))
    variance = np.maximum(k[f, f] - (gain * k[f]).sum(axis=1), LEAST_VARIANCE)
    v = 1 / np.maximum(1 / variance - tau[f], PRECISIONS[0])
    return v * (gain @ (nu / tau) / variance - nu[f]), v


def _fit_sites(k, tau, nu, hidden, noise):
    """Precisions and precision-weighted means [n], those of hidden ones by expectation
    propagation, all at once and damped.
    """
    if not hidden.any():
        return tau, nu
    tau, nu, last = tau.copy(), nu.copy(), np.inf
    for _ in range(SWEEPS):
        m, v = _cavities(k, tau, nu, hidden)
        # moments of N(m, v) below 0, seen through noise (R&W eq. 3.58)
        sd = np.sqrt(v + noise)
        h = _hazard(-m / sd)
        mean = m - v / sd * h
        variance = v * np.maximum(1 - v / sd**2 * h * (h - m / sd), 1e-9)
        new = np.clip(1 / variance - 1 / v, *PRECISIONS)
        tau[hidden] += DAMPING * (new - tau[hidden])
        nu[hidden] += DAMPING * (mean / variance - m / v - nu[hidden])
        if (np.abs(mean - last) < CONVERGED * np.sqrt(variance)).all():
            break
        last = mean
    return tau, nu


def _evidence(k, tau, nu, hidden, noise):
    """Log probability of what was seen, by the sites (R&W eq. 3.65)."""
    target, matrix = nu / tau, _with_noise(k, 1 / tau)
    value = -0.5 * target @ np.linalg.solve(matrix, target) - 0.5 * _log_det(matrix)
    value -= 0.5 * (~hidden).sum() * math.log(2 * math.pi)
    if hidden.any():
        from scipy.special import log_ndtr  # here: slow to import

        m, v = _cavities(k, tau, nu, hidden)
        both = v + 1 / tau[hidden]
        terms = 0.5 * np.log(both) + 0.5 * (m - target[hidden]) ** 2 / both
        value += (log_ndtr(-m / np.sqrt(v + noise)) + terms).sum()
    return value


def _climb(z, target, extra, hidden, logs, prior):
    """Ascents of the likelihood with its sites and the prior, by the signs of the gradient
    (Riedmiller and Braun 1993): the best of ``logs`` on the way.
    """
    step, last = np.full(len(logs), FIRST_STEP), np.zeros(len(logs))
    best, highest = logs, -math.inf
    for _ in range(ASCENTS):
        value, slope = _likelihood(z, target, extra, hidden, logs)
        value += prior.log_density(logs)
        slope = slope - (logs - prior.mean) / prior.deviation**2
        if value > highest:
            highest, best = value, logs
        turn = np.sign(slope * last).astype(int)
        step = np.clip(step * np.choose(1 + turn, (SIGN_CHANGED, 1, SIGN_KEPT)), *STEP_RANGE)
        logs, last = np.clip(logs + step * np.sign(slope), prior.low, prior.high), slope
    return best


def _likelihood(z, target, extra, hidden, logs):
    """Log likelihood of the targets and its gradient (R&W eq. 2.30 and 5.9)."""
    constant, linear, noise = np.exp(logs[:3])
    k, (r, e) = _covariance(z, z, logs)
    matrix = _with_noise(k, np.where(hidden, extra, noise))
    inverse = np.linalg.inv(matrix)
    alpha = inverse @ target
    w = np.outer(alpha, alpha) - inverse
    # of Matern 5/2 by log(1 / lengthscale_i): -5/3 (1 + r) e^-r (z_i - z'_i)^2 / lengthscale_i^2
    slope = -(5 / 3) * (1 + r) * e * w
    square = 2 * (slope.sum(axis=1) @ z**2 - ((slope @ z) * z).sum(axis=0))
    gradient = (
        constant * w.sum(),
        linear * (w * (z @ z.T)).sum(),
        noise * np.diagonal(w)[~hidden].sum(),
        *(square * np.exp(2 * logs[3:])),
    )
    value = -0.5 * target @ alpha - 0.5 * _log_det(matrix)
    return value, 0.5 * np.array(gradient)


def _log_det(matrix):
    return 2 * np.log(np.diagonal(np.linalg.cholesky(matrix))).sum()


def _hazard(a):
    """phi(a) / Phi(a)."""
    from scipy.special import erfcx  # here: slow to import

    return math.sqrt(2 / math.pi) / erfcx(-a / math.sqrt(2))
