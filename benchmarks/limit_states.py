"""Rare events of known probability, fixed and drawn by seed, for studies of error and coverage:
``python -m benchmarks.limit_states [--json] [--quick | --smoke]`` checks the truths.

``cases()`` lists the fixed ones, ``draw(family, seed)`` gives one of a family of ``FAMILIES``:
`Case`, (name, simulator, truth). Truths are closed forms or quadratures in float64 (SciPy), with P
log-uniform from 1e-12 to 1e-2, so that nothing can be tuned to one number. Parameters are bound by
a ``Partial`` and dimensions come from small sets: seeds of one family and dimension share a
compiled program. A limit state ``g(*parameters, x [..., d], np)`` fails where it is <= 0, x ~ N(0,
I_d); it is written once for two array libraries.
"""

import functools
import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from scipy import integrate, optimize, stats

import jast
from benchmarks.sizes import options, print_report, printer, size
from jast.simulators import autoregression, landing, limit_state, pendulum, ruin, walk1d

__all__ = ["DYNAMIC", "FAMILIES", "LIMITS", "Case", "Limit", "cases", "draw", "limit"]


class Case(NamedTuple):
    """A simulator and the probability that its episode fails."""

    name: str
    simulator: Any
    truth: float


class Limit(NamedTuple):
    """A limit state, its parameters (float64) and P(g <= 0)."""

    g: Callable
    parameters: tuple
    dimension: int
    truth: float

    def simulator(self):
        """As `jast.simulators.limit_state`, in JAX's default precision."""
        return limit_state(
            Partial(self.g, *(jnp.asarray(np.asarray(p, float)) for p in self.parameters)),
            self.dimension,
        )

    def batch(self, x):
        """g of x [n, d] in NumPy: [n]."""
        return self.g(*self.parameters, x, np=np)


# limit states


def half_spaces(directions, beta, slope, x, np=jnp):
    """Fails beyond any of m half-spaces, directions [m, d]; ``slope`` [m] scales the miss distance
    of each.
    """
    return np.min(slope * (beta - x @ directions.T), axis=-1)


def corner(directions, beta, x, np=jnp):
    """Fails beyond all of m half-spaces."""
    return np.max(beta - x @ directions.T, axis=-1)


def parabola(directions, beta, k, x, np=jnp):
    """Fails at y0 >= beta + k sum of the squares of the others, y = directions @ x; k > 0: a narrow
    region, k < 0: a wide one.
    """
    y = x @ directions.T
    return beta - y[..., 0] + k * np.sum(y[..., 1:] ** 2, axis=-1)


def sphere(centre, radius, side, x, np=jnp):
    """Fails outside (side 1) or inside (side -1) of a sphere; about abs(x - centre) - radius near
    to it, and smooth.
    """
    return side * (radius**2 - np.sum((x - centre) ** 2, axis=-1)) / (2 * radius)


def plane_and_ball(direction, beta, centre, radius, x, np=jnp):
    """Fails beyond a plane, and inside of a sphere."""
    beyond = beta - np.sum(direction * x, axis=-1)
    return np.minimum(beyond, sphere(centre, radius, -1.0, x, np))


def four_branch(p, k, x, np=jnp):
    """The four-branch series system: p = 7, k = 3 in the literature."""
    across, along = (x[..., 0] - x[..., 1]), (x[..., 0] + x[..., 1]) / 2**0.5
    return np.minimum(k + 0.1 * across**2 - np.abs(along), p / 2**0.5 - np.abs(across))


# truths


def _simpson(function, low, high, n=4001):
    x = np.linspace(low, high, n)
    return float(integrate.simpson(function(x), x=x))


def any_of(p):
    """P of a union of independent events."""
    return float(-np.expm1(np.sum(np.log1p(-np.asarray(p)))))


def parabola_probability(beta, k, m):
    """By the chi density of the m others."""
    return _simpson(
        lambda r: stats.chi.pdf(r, m) * stats.norm.sf(beta + k * r**2), 0.0, m**0.5 + 14
    )


def sphere_probability(offset, radius, side, d):
    """By the coordinate y along the centre, y = offset + radius sin t, and the chi-square of the d
    - 1 others.
    """
    rest = stats.chi2.cdf if side < 0 else stats.chi2.sf

    def within(t):
        y, slope = offset + radius * np.sin(t), radius * np.cos(t)
        return stats.norm.pdf(y) * rest(slope**2, d - 1) * slope

    beyond = stats.norm.sf(offset + radius) + stats.norm.cdf(offset - radius) if side > 0 else 0.0
    return _simpson(within, -np.pi / 2, np.pi / 2) + beyond


def four_branch_probability(p, k):
    """By the coordinate t = (x1 - x2) / sqrt 2: fails beyond p / 2, else where (x1 + x2) / sqrt 2
    is beyond k + .2 t^2.
    """
    return 2 * stats.norm.sf(p / 2) + _simpson(
        lambda t: 2 * stats.norm.pdf(t) * stats.norm.sf(k + 0.2 * t**2), -p / 2, p / 2
    )


def first_passage(decay, spread, threshold, steps, two_sided=False, nodes=300):
    """P(s or abs(s) >= threshold within ``steps``), s' = decay s + spread N(0, 1) from 0, by
    Nystrom: the mass that passes is summed step by step.
    """
    deviation = np.sqrt(spread**2 * np.sum(decay ** (2 * np.arange(steps))))
    low = -threshold if two_sided else -9.0 * deviation
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = low + (x + 1) * (threshold - low) / 2, w * (threshold - low) / 2

    def passes(s):
        return stats.norm.sf((threshold - decay * s) / spread) + (
            stats.norm.cdf((-threshold - decay * s) / spread) if two_sided else 0.0
        )

    kernel, out = stats.norm.pdf((x[:, None] - decay * x) / spread) / spread * w, w * passes(x)
    density, total = stats.norm.pdf(x / spread) / spread, passes(0.0)
    for _ in range(steps - 1):
        total += out @ density
        density = kernel @ density
    return float(total)


def walk_probability(threshold, steps, two_sided, nodes=300):
    return first_passage(1.0, 1.0, threshold, steps, two_sided, nodes)


def autoregression_probability(rate, threshold, steps, nodes=300):
    spread = np.sqrt(-np.expm1(-2 * rate))
    return first_passage(np.exp(-rate), spread, threshold, steps, nodes=nodes)


def ruin_probability(up, start, goal, steps):
    mass = np.zeros(goal + 1)
    mass[start] = 1
    for _ in range(steps):
        inner = mass[1:-1]
        mass[0], mass[-1] = mass[0] + (1 - up) * inner[0], mass[-1] + up * inner[-1]
        mass[1:-1] = np.append(0, up * inner[:-1]) + np.append((1 - up) * inner[1:], 0)
    return float(mass[-1])


def _solve(probability, target, low, high):
    """The parameter with this probability, which falls with it; where its range does not contain
    it, the nearer end.
    """

    def gap(v):
        return np.log(max(probability(v), 1e-300)) - np.log(target)

    if gap(low) <= 0:
        return low
    return high if gap(high) >= 0 else float(optimize.brentq(gap, low, high, rtol=1e-4))


# fixed


def _plane(d, beta=5.0):
    parameters = np.full((1, d), d**-0.5), np.array([beta]), np.ones(1)
    return Limit(half_spaces, parameters, d, float(stats.norm.sf(beta)))


def _landing_static():
    a = np.append(0.1, np.full(10, 0.03))
    size = np.sqrt(a @ a)
    parameters = np.stack([a, -a]) / size, np.full(2, 1 / size), np.full(2, size)
    return Limit(half_spaces, parameters, 11, 4.0236721906842e-13)


LIMITS = {
    "four-branch": Limit(four_branch, (7.0, 3.0), 2, 2.2227950662e-3),
    **{f"hyperplane {d}": _plane(d) for d in (2, 20, 100)},
    "parallel": Limit(corner, (np.eye(2), np.full(2, 3.5)), 2, 5.4116288413e-8),
    "landing, static": _landing_static(),
}
# the truths of the simulators' docstrings; the pendulum's has a standard error of .11 %
DYNAMIC = {
    "landing": (landing, 4.0236721906842e-13),
    "walk1d one-sided": (functools.partial(walk1d, "one-sided"), 9.578759495e-4),
    "walk1d two-sided": (walk1d, 0.1087363323),
    "autoregression": (autoregression, 1.7438880336e-5),
    "ruin": (ruin, 2.6049921451e-6),
    "pendulum": (pendulum, 8.169e-3),
}


def cases(names=None):
    """The fixed cases, all or those named: a list of `Case`."""
    make = {name: (l.simulator, l.truth) for name, l in LIMITS.items()} | DYNAMIC
    chosen = make if names is None else names
    return [Case(name, make[name][0](), make[name][1]) for name in chosen]


# families: (rng, P) -> Limit, or (simulator, truth)


def _directions(rng, m, d):
    return np.linalg.qr(rng.standard_normal((d, m)))[0].T


def two_sided(rng, P, dimensions=(2, 5, 20), spread=0.0):
    """Two half-spaces, opposite or at a right angle, the second with 2 to 50 % of the mass."""
    d = int(rng.choice(dimensions))
    opposite = rng.random() < 0.5
    share = 10 ** rng.uniform(np.log10(0.02), np.log10(0.5))
    a, p = _directions(rng, 2, d), P * np.array([1 - share, share])
    if opposite:
        a[1] = -a[0]
    parameters = a, stats.norm.isf(p), 10 ** rng.uniform(-spread, spread, 2)
    return Limit(half_spaces, parameters, d, float(p.sum()) if opposite else any_of(p))


def scaled(rng, P):
    """Two half-spaces with slopes from .03 to 30: the smaller miss distance is not the nearer
    failure.
    """
    return two_sided(rng, P, spread=1.5)


def high_dimensional(rng, P):
    """A hyperplane (its second side is out of reach) or two opposite ones in 50 to 200
    dimensions.
    """
    l = two_sided(rng, P, (50, 100, 200))
    a, beta, slope = l.parameters
    truth = float(stats.norm.sf(beta).sum())
    if rng.random() < 0.5:
        beta, truth = np.array([stats.norm.isf(P), 40.0]), P
    return Limit(half_spaces, (np.stack([a[0], -a[0]]), beta, slope), l.dimension, truth)


def union(rng, P):
    """2, 4 or 8 orthogonal half-spaces of unequal mass in 10 dimensions."""
    m = int(rng.choice((2, 4, 8)))
    p = P * rng.dirichlet(np.full(m, 2.0))
    parameters = _directions(rng, m, 10), stats.norm.isf(p), np.ones(m)
    return Limit(half_spaces, parameters, 10, any_of(p))


def intersection(rng, P):
    """2 or 4 orthogonal half-spaces at once, in 5 or 20 dimensions."""
    m, d = int(rng.choice((2, 4))), int(rng.choice((5, 20)))
    p = P ** rng.dirichlet(np.full(m, 8.0))
    return Limit(corner, (_directions(rng, m, d), stats.norm.isf(p)), d, float(p.prod()))


def curved(rng, P):
    """A parabola in 1 or 4 of the other coordinates, with k beta from -.35 (a wide region) to 1.5
    (a narrow one).
    """
    m, d = int(rng.choice((1, 4))), int(rng.choice((5, 20)))
    c = rng.uniform(*((-0.35, -0.05) if rng.random() < 0.5 else (0.05, 1.5)))
    beta = _solve(lambda b: parabola_probability(b, c / b, m), P, 0.5, 9.0)
    parameters = _directions(rng, 1 + m, d), beta, c / beta
    return Limit(parabola, parameters, d, parabola_probability(beta, c / beta, m))


def _sphere(rng, offset, radius, side, d):
    parameters = offset * _directions(rng, 1, d)[0], radius, float(side)
    return Limit(sphere, parameters, d, sphere_probability(offset, radius, side, d))


def outside(rng, P):
    """Outside of a sphere around the origin (no design point: all directions are alike) or around a
    centre up to 2 away.
    """
    d, offset = int(rng.choice((2, 5, 10))), rng.uniform(0.2, 2) * (rng.random() < 0.5)
    radius = _solve(lambda r: sphere_probability(offset, r, 1, d), P, 0.5, 14.0)
    return _sphere(rng, offset, radius, 1, d)


def inside(rng, P):
    """Inside of a sphere of radius 1 to 4."""
    d, radius = int(rng.choice((2, 5))), rng.uniform(1, 4)
    offset = _solve(lambda c: sphere_probability(c, radius, -1, d), P, 0.0, 14.0)
    return _sphere(rng, offset, radius, -1, d)


def islands(rng, P):
    """A plane, and on its other side a ball with 3 to 30 % of the mass, aslant of the mirror image
    of what is nearest of the plane. They are apart.
    """
    d = int(rng.choice((2, 3, 5)))
    share, radius = rng.uniform(0.03, 0.3), d**0.5 * rng.uniform(0.6, 1.0)
    ball = share * P
    offset = _solve(lambda c: sphere_probability(c, radius, -1, d), ball, 0.0, 14.0)
    u, v = np.linalg.qr(rng.normal(size=(d, 2)))[0].T
    beta = stats.norm.isf(P - ball)
    parameters = u, beta, -offset * (u + v) / 2**0.5, radius
    truth = P - ball + sphere_probability(offset, radius, -1, d)
    return Limit(plane_and_ball, parameters, d, truth)


def branches(rng, P):
    """Four branches: two curved ones, and two planes with 10 to 90 % of the mass."""
    p = 2 * stats.norm.isf(P * rng.uniform(0.1, 0.9) / 2)
    k = _solve(lambda k: four_branch_probability(p, k), P, 0.2, 9.0)
    return Limit(four_branch, (p, k), 2, four_branch_probability(p, k))


def landings(rng, P):
    """Landing with drawn noises and the runway of this probability."""
    sigma_i, sigma_t = rng.uniform(0.02, 0.3), rng.uniform(0.02, 0.1)
    b = stats.norm.isf(P / 2) * np.sqrt(sigma_i**2 + 10 * sigma_t**2)
    return landing(b, sigma_i, sigma_t), P


def walks(rng, P):
    """walk1d, either form, to a threshold of this probability."""
    form = str(rng.choice(("one-sided", "two-sided")))
    steps = walk1d(form).horizon
    both = form == "two-sided"
    threshold = _solve(lambda c: walk_probability(c, steps, both, 150), P, 0.5, 60.0)
    return walk1d(form, threshold=threshold), walk_probability(threshold, steps, both)


def autoregressions(rng, P):
    """Autoregression over 100 steps with a drawn rate and the threshold of this probability."""
    rate = rng.uniform(0.05, 0.5)
    threshold = _solve(lambda c: autoregression_probability(rate, c, 100, 150), P, 0.5, 9.0)
    return autoregression(rate, threshold), autoregression_probability(rate, threshold, 100)


def ruins(rng, P):
    """Ruin from 1 to 5, with drawn odds, in 200 steps; the goal is the one of nearest
    probability.
    """
    up, start = rng.uniform(0.3, 0.48), int(rng.integers(1, 6))
    p = {goal: ruin_probability(up, start, goal, 200) for goal in range(start + 2, 60, 2)}
    goal = min(p, key=lambda goal: abs(np.log(p[goal]) - np.log(P)))
    return ruin(up, start, goal, horizon=200), p[goal]


OF_LIMITS = (two_sided, scaled, high_dimensional, union, intersection, curved, outside, inside)
OF_SYSTEMS = (landings, walks, autoregressions, ruins)
FAMILIES = {f.__name__: f for f in (*OF_LIMITS, islands, branches, *OF_SYSTEMS)}


def limit(family, seed, log10=(-12.0, -2.0)):
    """What the family draws: a `Limit`, or (simulator, truth) of one of several steps. ``log10``:
    range of log10 P.
    """
    rng = np.random.default_rng([zlib.crc32(family.encode()), seed])
    return FAMILIES[family](rng, 10 ** rng.uniform(*log10))


def draw(family, seed, log10=(-12.0, -2.0)):
    """The `Case` of one of ``FAMILIES`` and a seed; ``log10``: range of log10 P."""
    drawn = limit(family, seed, log10)
    simulator, truth = (drawn.simulator(), drawn.truth) if isinstance(drawn, Limit) else drawn
    return Case(f"{family} {seed}", simulator, truth)


def check(family, seed, n=400_000):
    """Standard errors between truth and sampling: one number at P of 3 to 30 % (plain Monte Carlo),
    where a simple sampler can, a second at its own P.

    Limit states are sampled in NumPy, the second time with weights from N(0, 2.5^2 I), d <= 5, or
    at the corner; systems of several steps are simulated.
    """
    easy, rng = limit(family, seed, (-1.5, -0.5)), np.random.default_rng(seed)
    if not isinstance(easy, Limit):
        rate, truth = jast.nominal(jax.random.key(seed), easy[0], n).rate, easy[1]
        return [(rate - truth) / np.sqrt(truth * (1 - truth) / n)]
    shape = 10_000, easy.dimension
    rate = np.mean([easy.batch(rng.standard_normal(shape)) <= 0 for _ in range(n // 10_000)])
    scores = [(rate - easy.truth) / np.sqrt(easy.truth * (1 - easy.truth) / n)]
    rare = limit(family, seed)
    at_corner = rare.g is corner
    if rare.dimension <= 5 or at_corner:
        centre, spread = (rare.parameters[1] @ rare.parameters[0], 1.0) if at_corner else (0.0, 2.5)
        z = rng.standard_normal((n, rare.dimension))
        x = centre + spread * z
        log_weights = rare.dimension * np.log(spread) + 0.5 * np.sum(z**2 - x**2, -1)
        weights = (rare.batch(x) <= 0) * np.exp(log_weights)
        scores.append((weights.mean() - rare.truth) / (weights.std() / n**0.5))
    return scores


def main(argv=None):
    """Check the truths of the families by sampling."""
    parser = options(main.__doc__, "2 problems of a family")
    parser.add_argument("--seeds", type=int, help="problems of a family (default 8)")
    args = parser.parse_args(argv)
    seeds, n = args.seeds or size(args, 8, 2, 1), size(args, 400_000, 400_000, 10_000)
    say, report = printer(args), {}

    def off(z):
        return f"rms {np.sqrt(np.mean(z**2)):.2f}, greatest {np.abs(z).max():.2f}"

    for family in FAMILIES:
        scores = [check(family, seed, n) for seed in range(seeds)]
        easy = np.array([s[0] for s in scores])
        rare = np.array([s[1] for s in scores if len(s) > 1])
        report[family] = {"easy": easy.tolist(), "rare": rare.tolist()}
        note = f", rare: {off(rare)} ({len(rare)} seeds)" if len(rare) else ""
        say(f"{family:18} standard errors: {off(easy)}{note}")
    print_report(args, report)


if __name__ == "__main__":
    main()
