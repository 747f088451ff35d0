"""Problems of the structural reliability benchmark (Rozsas and Slomski, "Structural reliability
benchmark", TNO 2019; numbers and constants as in otbenchmark 0.2), with the distributions they are
stated in: `PROBLEMS`.

Published reference probabilities are of crude Monte Carlo or rounded. The truths here are computed:
given all inputs but one the probability is a closed form, and it is averaged over the others, by
quadrature where that is one number, else over 2^20 points of a Sobol sequence.
"""

from collections.abc import Callable
from functools import cached_property, partial

import jax.numpy as jnp
import numpy as np
from scipy import stats

import jast
from jast import distributions as D

__all__ = ["PROBLEMS", "Problem"]

POINTS = 200_001  # of a quadrature
REACH = 9.0  # standard deviations to either side of it
SOBOL = 20  # the binary logarithm of the points of a sequence


def normal(mean=0.0, sd=1.0):
    return stats.norm(mean, sd), D.Normal(mean, sd)


def log_normal(mean, sd):
    variance = np.log1p((sd / mean) ** 2)
    loc, scale = np.log(mean) - variance / 2, np.sqrt(variance)
    return stats.lognorm(scale, scale=np.exp(loc)), D.LogNormal(loc, scale)


def gumbel(mean, sd):
    scale = sd * np.sqrt(6) / np.pi
    loc = mean - np.euler_gamma * scale
    return stats.gumbel_r(loc, scale), D.Gumbel(loc, scale)


def uniform(low, high):
    return stats.uniform(low, high - low), D.Uniform(low, high)


def exponential():
    return stats.expon(), D.Exponential(1.0)


class Problem:
    """Inputs that are independent of each other, and ``g``, which fails below 0."""

    def __init__(self, inputs: list, g: Callable, truth: Callable):
        """``g(x, np)``: of as many arrays as there are ``inputs``, with either array library.
        ``truth``: of the problem itself.
        """
        self.known, self.noise = zip(*inputs, strict=True)
        self.g, self._truth = g, truth

    @property
    def dimension(self) -> int:
        return len(self.known)

    def simulator(self) -> jast.Simulator:
        """One step, whose disturbance is a tuple of the inputs."""
        return jast.Simulator(
            init=lambda x0: tuple(0.0 * d.mean() for d in self.noise),
            step=lambda s, x: tuple(x),
            disturbance=lambda s: D.Joint(self.noise),
            evaluate=self._evaluated,
            horizon=1,
            episodic=True,
        )

    def _evaluated(self, s):
        value = self.g(s, jnp)
        return value < 0, jnp.maximum(value, 0.0)

    def batch(self, u: np.ndarray) -> np.ndarray:
        """g of normal numbers ``u`` [n, d]: [n]."""
        return self.g(self.inputs_of(u), np)

    def inputs_of(self, u):
        """From the nearer tail: the other one is rounded."""
        pairs = zip(self.known, np.asarray(u, float).T, strict=True)
        low, high = stats.norm.cdf, stats.norm.sf
        return [np.where(z < 0, d.ppf(low(z)), d.isf(high(z))) for d, z in pairs]

    @cached_property
    def truth(self) -> float:
        return float(self._truth(self))


def averaged(inputs: list, g: Callable, given: Callable, last: int = 0) -> Problem:
    """A `Problem` whose truth is the mean of ``given(distribution, x)``, the probability given all
    inputs but number ``last``, whose distribution it is.
    """

    def truth(problem):
        others = problem.dimension - 1
        if others == 1:
            z = np.linspace(-REACH, REACH, POINTS)
            weights = stats.norm.pdf(z)
            u = np.zeros((POINTS, 2))
            u[:, 1 - last] = z
        else:
            engine = stats.qmc.Sobol(others, seed=0)
            u = stats.norm.ppf(engine.random_base2(SOBOL))
            u, weights = np.insert(u, last, 0.0, axis=1), np.ones(len(u))
        return np.average(given(problem.known[last], problem.inputs_of(u)), weights=weights)

    return Problem(inputs, g, truth)


TWO = [normal(), normal()]


def _rp14(x, np):
    moment = np.sqrt(x[2] ** 2 * x[3] ** 2 / 16 + x[4] ** 2)
    return x[0] - 32 / (np.pi * x[1] ** 3) * moment


def _rp14_given(d, x):
    room = (np.pi * x[0] * x[1] ** 3 / 32) ** 2 - x[2] ** 2 * x[3] ** 2 / 16
    edge = np.sqrt(np.maximum(room, 0))
    return d.sf(edge) + d.cdf(-edge)


def _rp35(x, np):
    first = 2 - x[1] + np.exp(-0.1 * x[0] ** 2) + (0.2 * x[0]) ** 4
    return np.minimum(first, 4.5 - x[0] * x[1])


def _rp35_given(d, x):
    edge = 2 + np.exp(-0.1 * x[0] ** 2) + (0.2 * x[0]) ** 4
    with np.errstate(divide="ignore"):
        product = 4.5 / x[0]
    above = d.sf(np.where(x[0] > 0, np.minimum(edge, product), edge))
    return np.where(x[0] < 0, above + d.cdf(np.minimum(product, edge)), above)


def _rp38_rest(x):
    x2, x3, x4, x5, x6, x7 = x[1:]
    top = x4**2 - 4 * x5 * x6 * x7**2 + x4 * (x6 + 4 * x5 + 2 * x6 * x7)
    return x2**3 / (2 * x3**3) * top / (x4 * x5 * (x4 + x6 + 2 * x6 * x7))


def _rp55(x, np):
    across = x[0] - x[1]
    near, far = 0.2 + 0.6 * across**4, 5 / 2**0.5 - 2.2
    return np.minimum(near - np.abs(across) / 2**0.5, far - np.abs(across))


def _rp55_truth(problem):
    """The difference of the two has the density 1/2 - abs(x) / 4."""
    across = np.linspace(-2, 2, 4_000_001)
    fails = _rp55((across, 0.0), np) < 0
    return np.average(fails, weights=0.5 - np.abs(across) / 4)


def _rp57(x, np):
    first, second = -(x[0] ** 2) + x[1] ** 3 + 3, 2 - x[0] - 8 * x[1]
    circle = (x[0] + 3) ** 2 + (x[1] + 3) ** 2 - 4
    return np.minimum(np.maximum(first, second), circle)


def _rp57_given(d, x):
    """Two intervals, of which the parts they share count once."""
    low, high = (2 - x[0]) / 8, np.cbrt(x[0] ** 2 - 3)
    half = np.sqrt(np.maximum(4 - (x[0] + 3) ** 2, 0))

    def length(a, b):
        return np.where(b > a, d.cdf(b) - d.cdf(a), 0)

    shared = length(np.maximum(low, -3 - half), np.minimum(high, -3 + half))
    return length(low, high) + length(-3 - half, -3 + half) - shared


def _rp60(x, np):
    x1, x2, x3, x4, x5 = x

    def three(f, a, b, c):
        return f(f(a, b), c)

    half = three(np.minimum, x2 - x5 / 2, x3 - x5 / 2, x4 - x5 / 2)
    whole = np.maximum(x4 - x5, np.minimum(x2 - x5, x3 - x5))
    return np.minimum(x1 - x5, np.maximum(half, whole))


def _rp60_truth(problem):
    """Given the load the others are independent; of x2, x3, x4 it matters which of them are below
    half of it and which below the whole.
    """
    z = np.linspace(-REACH, REACH, POINTS)
    load = problem.inputs_of(np.stack([z] * 5, 1))[4]
    one, *three = problem.known[:4]
    safe = 0.0
    for levels in np.ndindex(3, 3, 3):  # 0: below a half, 1: below the whole, 2: above
        half, whole = 0 in levels, levels[2] < 2 and min(levels[:2]) < 2
        if not (half and whole):
            cuts = [[0 * load, d.cdf(load / 2), d.cdf(load), 1 + 0 * load] for d in three]
            parts = [c[k + 1] - c[k] for c, k in zip(cuts, levels, strict=True)]
            safe = safe + np.prod(parts, axis=0)
    return np.average(1 - one.sf(load) * safe, weights=stats.norm.pdf(z))


def _rp63_truth(problem):
    z = np.linspace(0, 300, POINTS)
    return np.average(stats.norm.sf(0.1 * z - 4.5), weights=stats.chi2(99).pdf(z))


def _rp77_truth(problem):
    """x1 - x2 is normal, and so is x2."""
    x3 = np.linspace(4 - REACH, 4 + REACH, POINTS)
    gap = stats.norm(10, 1.25**0.5).cdf(x3)
    return np.average(np.where(x3 <= 5, gap, stats.norm.sf(x3)), weights=stats.norm.pdf(x3 - 4))


def _rp91(x, np):
    x1, x2, x3, x4, x5 = x
    first = 0.847 + 0.96 * x2 + 0.986 * x3 - 0.216 * x4 + 0.077 * x2**2 + 0.11 * x3**2
    first = first + 7 / 378 * x4**2 - x3 * x2 - 0.106 * x2 * x4 - 0.11 * x3 * x4
    second = 84_000 * x1 / np.sqrt(x3**2 + x4**2 - x3 * x4 + 3 * x5**2) - 1
    return np.minimum(np.minimum(first, second), 84_000 * x1 / np.abs(x4) - 1)


def _rp91_given(d, x):
    """The first part of it is far from 0 everywhere."""
    load = np.sqrt(x[2] ** 2 + x[3] ** 2 - x[2] * x[3] + 3 * x[4] ** 2)
    return d.cdf(np.maximum(load, np.abs(x[3])) / 84_000)


def _rp110(x, np):
    first = np.where(x[0] <= 3.5, 0.85 - 0.1 * x[0], 4 - x[0])
    return np.minimum(first, np.where(x[1] <= 2, 2.3 - x[1], 0.5 - 0.1 * x[1]))


def _product(d, x, limit):
    """P(x0 x1 > limit), of a positive limit."""
    with np.errstate(divide="ignore"):
        edge = limit / np.abs(x[1])
    return np.where(x[1] > 0, d.sf(edge), d.cdf(-edge))


PROBLEMS: dict[str, Problem] = {
    "RP8": averaged(
        [log_normal(120, 12) for _ in range(4)] + [log_normal(50, 10), log_normal(40, 8)],
        lambda x, np: x[0] + 2 * x[1] + 2 * x[2] + x[3] - 5 * x[4] - 5 * x[5],
        lambda d, x: d.sf((x[0] + 2 * x[1] + 2 * x[2] + x[3] - 5 * x[5]) / 5),
        4,
    ),
    "RP14": averaged(
        [uniform(70, 80), normal(39, 0.1), gumbel(1500, 350), normal(400, 0.1)]
        + [normal(250_000, 35_000)],
        _rp14,
        _rp14_given,
        4,
    ),
    "RP22": averaged(
        TWO,  # of the sum and of the difference, over sqrt 2
        lambda x, np: 2.5 - (x[0] + x[1]) / 2**0.5 + 0.1 * (x[0] - x[1]) ** 2,
        lambda d, x: d.sf(2.5 + 0.2 * x[1] ** 2),
    ),
    "RP24": averaged(
        [normal(10, 3), normal(10, 3)],
        lambda x, np: 2.5 - 0.2357 * (x[0] - x[1]) + 0.00463 * (x[0] + x[1] - 20) ** 4,
        lambda d, x: stats.norm.sf(
            (2.5 + 0.00463 * 2**2 * (x[1] - 10) ** 4) / (0.2357 * 3 * 2**0.5)
        ),
    ),
    "RP25": averaged(
        TWO,
        lambda x, np: np.maximum(x[0] ** 2 - 8 * x[1] + 16, -16 * x[0] + x[1] + 32),
        lambda d, x: np.maximum(d.cdf(16 * x[0] - 32) - d.cdf((x[0] ** 2 + 16) / 8), 0),
        1,
    ),
    "RP28": averaged(
        [normal(78_064, 11_710), normal(0.0104, 0.00156)],
        lambda x, np: x[0] * x[1] - 146.14,
        lambda d, x: 1 - _product(d, x, 146.14),
    ),
    "RP31": averaged(
        TWO, lambda x, np: 2 - x[1] + 256 * x[0] ** 4, lambda d, x: d.sf(2 + 256 * x[0] ** 4), 1
    ),
    "RP33": averaged(
        [normal()] * 3,
        lambda x, np: np.minimum(-x[0] - x[1] - x[2] + 3 * 3**0.5, 3 - x[2]),
        lambda d, x: d.sf(np.minimum(3, 3 * 3**0.5 - x[0] - x[1])),
        2,
    ),
    "RP35": averaged(TWO, _rp35, _rp35_given, 1),
    "RP38": averaged(
        [normal(m, m / 10) for m in (350, 50.8, 3.81, 173, 9.38, 33.1, 0.036)],
        lambda x, np: 15.59e4 - x[0] * _rp38_rest(x),
        lambda d, x: d.sf(15.59e4 / _rp38_rest(x)),
    ),
    "RP53": averaged(
        [normal(1.5), normal(2.5)],
        lambda x, np: np.sin(5 * x[0] / 2) + 2 - (x[0] ** 2 + 4) * (x[1] - 1) / 20,
        lambda d, x: d.sf(1 + 20 * (np.sin(5 * x[0] / 2) + 2) / (x[0] ** 2 + 4)),
        1,
    ),
    "RP54": Problem(
        [exponential()] * 20, lambda x, np: sum(x) - 8.951, lambda p: stats.gamma(20).cdf(8.951)
    ),
    "RP55": Problem([uniform(-1, 1)] * 2, _rp55, _rp55_truth),
    "RP57": averaged(TWO, _rp57, _rp57_given, 1),
    "RP60": Problem(
        [log_normal(mean, mean / 10) for mean in (2200, 2100, 2300, 2000)]
        + [log_normal(1200, 480)],
        _rp60,
        _rp60_truth,
    ),
    "RP63": Problem(
        [normal()] * 100, lambda x, np: 0.1 * sum(v**2 for v in x[1:]) - x[0] - 4.5, _rp63_truth
    ),
    "RP75": averaged(TWO, lambda x, np: 3 - x[0] * x[1], partial(_product, limit=3.0)),
    "RP77": Problem(
        [normal(10, 0.5), normal(), normal(4)],
        lambda x, np: np.where(x[2] <= 5, x[0] - x[1] - x[2], x[2] - x[1]),
        _rp77_truth,
    ),
    "RP89": averaged(
        TWO,
        lambda x, np: np.minimum(8 - x[0] ** 2 - x[1], 6 - x[0] / 5 - x[1]),
        lambda d, x: d.sf(np.minimum(8 - x[0] ** 2, 6 - x[0] / 5)),
        1,
    ),
    "RP91": averaged(
        [normal(0.07433, 0.005), normal(0.1, 0.01), normal(13, 60), normal(4751, 48)]
        + [normal(-684, 11)],
        _rp91,
        _rp91_given,
    ),
    "RP107": Problem(
        [normal()] * 10, lambda x, np: 5 * 10**0.5 - sum(x), lambda p: stats.norm.sf(5)
    ),
    "RP110": Problem(TWO, _rp110, lambda p: 1 - stats.norm.cdf(4) * stats.norm.cdf(5)),
    "RP111": averaged(
        TWO, lambda x, np: 12.5 - np.abs(x[0] * x[1]), lambda d, x: 2 * _product(d, x, 12.5)
    ),
    "axial": averaged(
        [log_normal(300, 30), normal(75_000, 5000)],
        lambda x, np: x[0] - x[1] / (np.pi * 100),
        lambda d, x: d.cdf(x[1] / (np.pi * 100)),
    ),
    "R-S": Problem(
        [normal(4), normal(2)], lambda x, np: x[0] - x[1], lambda p: stats.norm.sf(2**0.5)
    ),
}
