"""Objectives to minimise, where a search of each starts, and its budget.

They are written once for two array libraries: in NumPy, where they share no code with jast, or with
``np=jax.numpy``. Each takes ``x [..., d]``.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

__all__ = ["CASES", "Case"]


def _sierra():
    """Centres [49, 2] and isotropic variances [49], in the order of the published code."""
    sigma, delta, eta, decay = 3.0, 2.0, 6.0, 1.0
    centres, variances = [(0.0, 0.0)], [1 / eta]
    for g in ((delta, delta), (delta, -delta), (-delta, delta), (-delta, -delta)):
        for i, p in enumerate(((0, 0), (1, 1), (2, 0), (3, 1), (0, 2), (1, 3)), 1):
            for s in (sigma, -sigma):
                centres.append((g[0] + s * p[0], g[1] + s * p[1]))
                variances.append(i**decay * sigma / eta)
    return np.array(centres), np.array(variances)


_CENTRES, _VARIANCES = _sierra()


def sierra(x, np=np):
    """Minus the mean of 49 Gaussian densities in the plane; -0.02200237 at 0."""
    square = np.sum((x[..., None, :] - _CENTRES) ** 2, -1)
    return -np.mean(np.exp(-0.5 * square / _VARIANCES) / (2 * np.pi * _VARIANCES), -1)


def branin(x, np=np):
    """0.397887 wherever x[0] is pi plus a multiple of 2 pi and x[1] on the parabola: no single
    minimiser on the whole plane.
    """
    u, v = x[..., 0], x[..., 1]
    return (
        (v - 5.1 / (4 * np.pi**2) * u**2 + 5 / np.pi * u - 6) ** 2
        + 10 * (1 - 1 / (8 * np.pi)) * np.cos(u)
        + 10
    )


def ackley(x, np=np):
    """0 at 0."""
    return (
        20
        - 20 * np.exp(-0.2 * np.sqrt(np.mean(x**2, -1)))
        + np.e
        - np.exp(np.mean(np.cos(2 * np.pi * x), -1))
    )


def paraboloid(x, np=np):
    """0 at 0."""
    return np.sum(x**2, -1)


def rastrigin(x, np=np):
    """0 at 0."""
    return np.sum(x**2 - 10 * np.cos(2 * np.pi * x) + 10, -1)


def rosenbrock(x, np=np):
    """0 at 1."""
    return np.sum(100 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1 - x[..., :-1]) ** 2, -1)


_HEIGHTS = np.array([1.0, 1.2, 3.0, 3.2])
_RATES = np.array(
    [
        [10, 3, 17, 3.5, 1.7, 8],
        [0.05, 10, 17, 0.1, 8, 14],
        [3, 3.5, 1.7, 10, 17, 8],
        [17, 8, 0.05, 10, 0.1, 14],
    ]
)
_PEAKS = 1e-4 * np.array(
    [
        [1312, 1696, 5569, 124, 8283, 5886],
        [2329, 4135, 8307, 3736, 1004, 9991],
        [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ]
)
_HARTMANN6 = np.array([0.20168952, 0.15001069, 0.47687398, 0.27533243, 0.31165162, 0.65730053])


def hartmann6(x, np=np):
    """-3.322368 in the unit cube; all its stationary points lie in the hull of the four peaks, so
    the minimum holds without bounds.
    """
    return -np.exp(-np.sum(_RATES * (x[..., None, :] - _PEAKS) ** 2, -1)) @ _HEIGHTS


def levy(x, np=np):
    """0 at 1."""
    w = 1 + (x - 1) / 4
    head, body, last = w[..., 0], w[..., :-1], w[..., -1]
    middle = np.sum((body - 1) ** 2 * (1 + 10 * np.sin(np.pi * body + 1) ** 2), -1)
    return (
        np.sin(np.pi * head) ** 2 + middle + (last - 1) ** 2 * (1 + np.sin(2 * np.pi * last) ** 2)
    )


def _axes(d):
    return np.linalg.qr(np.random.default_rng(20240601 + d).standard_normal((d, d)))[0]


def ellipsoid(x, np=np, condition=1e4):
    """A quadratic of this condition number along fixed random axes; 0 at 0."""
    d = x.shape[-1]
    axes = np.asarray(_axes(d))
    return np.sum(condition ** (np.arange(d) / (d - 1)) * (x @ axes) ** 2, -1)


class Case(NamedTuple):
    """An objective, where the search starts, what is known of the minimum, and the budget (samples
    a round, rounds).
    """

    objective: Callable
    dimension: int
    mean: np.ndarray
    sd: np.ndarray
    minimum: float
    minimiser: np.ndarray | None
    budgets: tuple[int, int]

    def distances(self, x):
        """[n], from points [n, d] to the minimiser; None where there is none."""
        away = None if self.minimiser is None else np.asarray(x) - self.minimiser
        return None if away is None else np.linalg.norm(away, axis=-1)


def _case(objective, d, mean, sd, minimum, minimiser, budgets):
    def fill(value):
        return None if value is None else np.broadcast_to(np.asarray(value, float), (d,)).copy()

    return Case(objective, d, fill(mean), fill(sd), minimum, fill(minimiser), budgets)


_BUDGETS = {2: (10, 10), 5: (20, 10), 10: (40, 10)}
_SIERRA = float(sierra(np.zeros(2)))

CASES = {
    "sierra 1A": _case(sierra, 2, 0, 200**0.5, _SIERRA, 0, (10, 10)),
    "sierra 1B": _case(sierra, 2, -50, 2000**0.5, _SIERRA, 0, (10, 10)),
    "sierra 1C": _case(sierra, 2, 0, 200**0.5, _SIERRA, 0, (5, 10)),
    "branin": _case(branin, 2, (2.5, 7.5), 5, 0.39788735772973816, None, (10, 10)),
    "paraboloid 2": _case(paraboloid, 2, 3, 5, 0.0, 0, (10, 10)),
    "rastrigin 2": _case(rastrigin, 2, 2.5, 3, 0.0, 0, (10, 10)),
    "hartmann6": _case(hartmann6, 6, 0.5, 0.3, -3.322368011415515, _HARTMANN6, (20, 10)),
    **{f"ackley {d}": _case(ackley, d, 5, 10, 0.0, 0, _BUDGETS[d]) for d in (2, 5, 10)},
    **{f"rosenbrock {d}": _case(rosenbrock, d, -1, 2, 0.0, 1, _BUDGETS[d]) for d in (2, 5)},
    **{f"levy {d}": _case(levy, d, -2, 5, 0.0, 1, _BUDGETS[d]) for d in (5, 10)},
    **{f"ellipsoid {d}": _case(ellipsoid, d, 3, 3, 0.0, 0, _BUDGETS[d]) for d in (5, 10)},
}
