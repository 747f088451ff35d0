"""Log odds of failure from several opinions, by a Bayesian logistic regression on what was run."""

import numpy as np

__all__ = ["fit_logistic", "sigmoid"]


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
