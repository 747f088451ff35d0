"""Log odds of failure from several opinions, by a Bayesian logistic regression on what was run; and
what these opinions miss, by a Gaussian process over inputs of one label on top of their log odds
(Laplace's approximation).

Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), algorithms 3.1 and 3.2.
"""

import itertools

import numpy as np

from jast._src.weakness.features import squared_distances

__all__ = ["fit_logistic", "residual_log_odds", "sigmoid"]

MOST_POINTS = 500  # of a label: the fit costs their cube
NEIGHBOUR = 5  # the fifth nearest, whose distance is the unit of length; a convention
VARIANCES = (1.0, 4.0, 16.0)  # of the process, tried: deviations of 1, 2 and 4 in log odds
LENGTHS = (1.0, 2.0)  # of the process, tried, in that unit
MARGIN = 1.0  # of log evidence, by which it must be better than nothing


def sigmoid(x):
    return 1 / (1 + np.exp(-np.clip(x, -40, 40)))


def fit_logistic(rows, failed, mean, precision):
    """[p]: the most probable coefficients for ``rows`` [m, p] and ``failed`` [m] bool under
    independent normal priors, by Newton's method with halved steps.
    """
    target = failed.astype(float)

    def cost(b):
        out = rows @ b
        return np.sum(np.logaddexp(0, out)) - target @ out + 0.5 * precision @ (b - mean) ** 2

    b = np.array(mean, float)
    now = cost(b)
    for _ in range(100):
        p = sigmoid(rows @ b)
        slope = rows.T @ (p - target) + precision * (b - mean)
        move = np.linalg.solve((rows * (p * (1 - p))[:, None]).T @ rows + np.diag(precision), slope)
        step = 1.0
        while (new := cost(b - step * move)) > now and step > 1e-8:
            step /= 2
        b = b - step * move
        if now - new < 1e-9 * (1 + abs(now)):
            break
        now = new
    return b


def residual_log_odds(rng, close, labels, odds, seen):
    """[n]: what to add to ``odds`` [n], the log odds of failure, by what was seen near each input
    with its label; 0 where there is no evidence for it.

    ``close`` [n, c]: coordinates. One amplitude and one length, in units of the usual distance to a
    neighbour, for all labels: those of greatest evidence.
    """
    out, groups = np.zeros(len(labels)), []
    for label in np.unique(labels):
        every = np.flatnonzero(labels == label)
        known = every[seen.tried[every]]
        if len(known) > MOST_POINTS:
            known = np.sort(rng.choice(known, MOST_POINTS, replace=False))
        if len(known) > 1:
            groups.append((every, known))
    if not groups:
        return out
    unit = np.median([_spacing(rng, close[every]) for every, _ in groups])
    data = [
        (squared_distances(close[at], close[at]), seen.failed[at].astype(float), odds[at])
        for _, at in groups
    ]
    best, choice = sum(np.sum(t * m - np.logaddexp(0, m)) for _, t, m in data) + MARGIN, None
    for variance, length in itertools.product(VARIANCES, LENGTHS):
        fits = [_laplace(_kernel(d2, unit, variance, length), t, m) for d2, t, m in data]
        total = sum(evidence for evidence, _ in fits)
        if total > best:
            best, choice = total, (variance, length, [slope for _, slope in fits])
    if choice is not None:
        variance, length, slopes = choice
        for (every, known), slope in zip(groups, slopes, strict=True):
            d2 = squared_distances(close[every], close[known])
            out[every] = _kernel(d2, unit, variance, length) @ slope
    return out


def _spacing(rng, x):
    """The usual squared distance to the fifth nearest other."""
    some = x if len(x) <= MOST_POINTS else x[rng.choice(len(x), MOST_POINTS, replace=False)]
    d2 = np.sort(squared_distances(some, x), axis=1)
    return max(np.median(d2[:, min(NEIGHBOUR, d2.shape[1] - 1)]), 1e-12)


def _kernel(d2, unit, variance, length):
    return variance * np.exp(-0.5 * d2 / (unit * length**2))


def _laplace(kernel, target, mean):
    """(log evidence, slope [m]) of failures ``target`` [m] with log odds mean + f, f ~ N(0,
    kernel): the mode of f at other points is their kernel @ slope.
    """
    m = len(target)

    def log_posterior(f, a):
        return -0.5 * a @ f + np.sum(target * (mean + f) - np.logaddexp(0, mean + f))

    f, a = np.zeros(m), np.zeros(m)
    now = log_posterior(f, a)
    for _ in range(50):
        p = sigmoid(mean + f)
        w = np.maximum(p * (1 - p), 1e-10)
        root = np.sqrt(w)
        b = w * f + target - p
        scaled = np.eye(m) + root[:, None] * kernel * root
        aim = b - root * np.linalg.solve(scaled, root * (kernel @ b))
        step = 1.0
        while True:
            new_a = a + step * (aim - a)
            new_f = kernel @ new_a
            new = log_posterior(new_f, new_a)
            if new >= now or step < 1e-6:
                break
            step /= 2
        done = abs(new - now) < 1e-6
        f, a, now = new_f, new_a, new
        if done:
            break
    p = sigmoid(mean + f)
    root = np.sqrt(np.maximum(p * (1 - p), 1e-10))
    return now - 0.5 * np.linalg.slogdet(np.eye(m) + root[:, None] * kernel * root)[1], target - p
