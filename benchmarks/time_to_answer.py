"""What a CPU second buys: ``python -m benchmarks.time_to_answer [--json] [--quick | --smoke]
[--systems NAME ...] [--methods NAME ...] [--seeds N]``.

`jast.estimate.failure_probability` and `jast.stress`, both as they come, on systems of known
probability: the closed loops of `benchmarks.closed_loops` and rows of static problems and
diffusions. Beside them stand plain draws for the CPU time of the first (what they would come to, by
the measured rate of `jast.estimate.monte_carlo`) and OpenTURNS's subset simulation where it is
installed. ``first`` is the first call in this process, with compilation. On an accelerator seconds
are those of the clock on the wall. A silent miss is an unflagged answer more than 4 standard errors
off, of itself and the truth. An interval holds the truth where they are no further apart than it
and the truth's own interval reach together.
"""

import math
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jast
from benchmarks.closed_loops import JUDGED, RARE, TUNED, system
from benchmarks.reliability import Counted
from benchmarks.sizes import add_choices, options, percent, print_report, printer, size
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.transform import dimension
from jast._src.runtime.device import on_cpu, read_clock
from jast.simulators import limit_state

__all__ = ["SYSTEMS", "System", "gayton", "plain_draws", "row_of", "toy", "well"]


class System(NamedTuple):
    """A simulator, the probability that it fails, and that one's relative standard error.
    ``budget``: of each method, where it is not the one that follows from the measured rate.
    """

    simulator: jast.Simulator
    truth: float
    error: float = 0.0
    group: str = "static"
    budget: int | None = None


def leaf(u):
    """Two circles, each as far from the origin."""
    return jnp.minimum(jnp.sum((u + 3.8) ** 2, -1), jnp.sum((u - 3.8) ** 2, -1)) - 1


def ring(u):
    """Between two circles about the origin."""
    r = jnp.sum(u**2, -1)
    return jnp.maximum(16 - r, r - 20.25)


def gayton(u):
    """Gayton's hat."""
    return 0.5 * (u[..., 0] - 2) ** 2 - 1.5 * (u[..., 1] - 5) ** 3 - 3


def piecewise(u):
    """Breitung's piecewise branches, of which the farther one looks nearer."""
    a, b = u[..., 0], u[..., 1]
    first = jnp.where(a > 3.5, 4 - a, 0.85 - 0.1 * a)
    return jnp.minimum(first, jnp.where(b > 2, 0.5 - 0.1 * b, 2.3 - b))


def cube(u):
    """All of six numbers are great."""
    return jnp.max(1.8 - u, -1)


def plane(beta, u):
    """A half-space."""
    return beta - jnp.sum(u, -1) / u.shape[-1] ** 0.5


def slab(u):
    """Between two parallel paraboloids."""
    value = u[..., 0] - jnp.sum(u[..., 1:] ** 2, -1)
    return jnp.maximum(3.5 - value, value - 3.52)


def toy_step(steps, s, w):
    """The diffusion of Schorlepp and Grafke (2023), by Euler's method."""
    x, y = s
    dt, deep = 1 / steps, 0.5**0.5
    x_next = x + dt * (-x - x * y) + deep * dt**0.5 * w[0]
    return jnp.stack([x_next, y + dt * (-4 * y + x**2) + 0.5 * deep * dt**0.5 * w[1]])


def toy(z, steps):
    """The same; it fails where x + 2 y >= z at the end."""

    def gap(s):
        return z - s[0] - 2 * s[1]

    return system([0.0, 0.0], Partial(toy_step, steps), gap, 2, steps, episodic=True)


def well_step(s, w):
    """A double well."""
    x, y = s
    drift = jnp.stack([x - x**3, -2 * y])
    return s + 0.01 * drift + (0.01 * 0.1) ** 0.5 * w


def well():
    """The same; it fails where the progress from one well to the other is .95."""
    return system([-1.0, 0.0], well_step, well_distance, 2, 500)


def well_distance(s):
    """Of that progress, to .95."""

    def bump(x):
        return 0.5 * jnp.exp(-8 * ((s[0] - x) ** 2 + s[1] ** 2))

    return 0.95 - (0.5 - bump(-1.0) + bump(1.0))


def _static(g, d, truth):
    return System(limit_state(g, d), truth)


SYSTEMS = {
    **{a.name: System(a.simulator, a.truth, a.error, "tuned loops") for a in TUNED},
    **{a.name: System(a.simulator, a.truth, a.error, "judged loops") for a in JUDGED + RARE},
    "leaf": _static(leaf, 2, 4.7934155e-6),
    "ring": _static(ring, 2, 2.9539733e-4),
    "Gayton": _static(gayton, 2, 2.8745376e-5),
    "Gayton of 8": _static(gayton, 8, 2.8745376e-5),
    "piecewise": _static(piecewise, 2, 3.1957884e-5),
    "cube": _static(cube, 6, 2.1516243e-9),
    "plane of 100": _static(Partial(plane, 3.5), 100, 2.3262908e-4),
    "plane of 300": _static(Partial(plane, 3.5), 300, 2.3262908e-4),
    "slab": _static(slab, 5, 2.2402549e-7),
    "toy, z 3, 100": System(toy(3.0, 100), 9.6715e-6, 0.0, "diffusions"),
    "toy, z 4, 50": System(toy(4.0, 50), 2.346e-8, 0.0, "diffusions"),
    "double well": System(well(), 1.342e-3, 0.0, "diffusions"),
}
METHODS = ("failure_probability", "stress", "subset")


def answers(method: str, about: System, seed: int) -> tuple[Any, float]:
    """The `Estimate` of a method (of OpenTURNS (log mean, relative error)), and CPU seconds."""
    begun, key = read_clock(), jax.random.key(seed)
    with warnings.catch_warnings(action="ignore"):
        if method == "stress":
            found = jast.stress(key, about.simulator, about.budget).probability
        elif method == "failure_probability":
            found = jast.estimate.failure_probability(key, about.simulator, about.budget)
        else:
            found = _subset(about, seed)
    return found, read_clock() - begun


def _subset(about, seed):
    """OpenTURNS's subset simulation with 10,000 points a level, as it comes; the system runs in the
    program of `normal_space.evaluate_points`.
    """
    import openturns as ot

    ot.RandomGenerator.SetSeed(seed)

    def distance(x):
        o = evaluate_points(about.simulator, np.asarray(x, np.float32))
        return np.where(o.failure, -1.0, np.maximum(o.distance, 1e-30))

    method = ot.SubsetSampling(Counted(distance, dimension(about.simulator)).event)
    method.setBlockSize(10_000)
    method.setMaximumOuterSampling(1)
    method.run()
    result = method.getResult()
    p, error = result.getProbabilityEstimate(), result.getCoefficientOfVariation()
    return (math.log(p) if p > 0 else math.nan), error


def row_of(name: str, about: System, method: str, seeds: int) -> dict[str, Any]:
    """Figures of a method on a system over ``seeds`` keys."""
    found, seconds = zip(*(answers(method, about, seed) for seed in range(seeds)), strict=True)
    if method == "subset":
        logs, errors = np.array(found).T
        reliable, evaluations = np.isfinite(logs), 0
        ends = np.full((seeds, 2), np.nan)
    else:
        logs = np.array([p.log_mean for p in found])
        errors = np.array([p.relative_error for p in found])
        reliable = np.array([p.reliable for p in found])
        ends = np.log(np.maximum([p.interval for p in found], 1e-300)) - math.log(about.truth)
        evaluations = int(np.mean([p.evaluations for p in found]))
    off = logs - math.log(about.truth)
    z = np.abs(off) / np.hypot(errors, about.error)
    known = reliable & np.isfinite(off)
    # to either side, as far as the interval and that of the truth itself, of 95 % both
    reach = np.hypot(ends - off[:, None], 1.96 * about.error)
    holds = (off <= reach[:, 0]) & (-off <= reach[:, 1])

    def rms(a):
        return float(np.sqrt(np.mean(a**2))) if a.size else None

    warm = float(np.mean(seconds[1:])) if seeds > 1 else None
    return dict(
        system=name,
        group=about.group,
        method=method,
        truth=about.truth,
        seeds=seeds,
        reliable=int(reliable.sum()),
        rms=rms(np.expm1(off[known])),
        rms_of_all=rms(np.expm1(off[np.isfinite(off)])),
        held=int(holds[known].sum()),
        silent_misses=int((known & (z > 4)).sum()),
        evaluations=evaluations,
        first=seconds[0],
        warm=warm,
    )


def plain_draws(about: System, seconds: float) -> float | None:
    """The relative standard error of plain draws in so many CPU seconds."""
    n = 2**15 if on_cpu() else 2**22

    def count(seed):
        return jast.estimate.monte_carlo(jax.random.key(seed), about.simulator, n)

    count(0)
    begun = read_clock()
    count(1)
    rate = n / (read_clock() - begun)
    return math.sqrt((1 - about.truth) / about.truth / (rate * seconds)) if about.truth else None


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "two systems, one key")
    add_choices(parser, "--systems", SYSTEMS)
    add_choices(parser, "--methods", METHODS)
    parser.add_argument("--seeds", type=int, help="keys (default: 20)")
    args = parser.parse_args(argv)
    names = args.systems or size(args, list(SYSTEMS), ["drone", "piecewise"], ["piecewise"])
    methods = args.methods or size(args, METHODS, METHODS[:2], METHODS[:1])
    say, seeds, rows = printer(args), args.seeds or size(args, 20, 2, 1), []
    for name in names:
        for method in methods:
            row = row_of(name, SYSTEMS[name], method, seeds)
            if method == "failure_probability":
                row["plain"] = plain_draws(SYSTEMS[name], row["warm"] or row["first"])
            rows.append(row)
            say(_line(row))
    print_report(args, dict(seeds=seeds, rows=rows))


def _line(r):
    warm = "-" if r["warm"] is None else f"{r['warm']:.1f}"
    plain = f"  plain draws {percent(r['plain'])}" if "plain" in r else ""
    return (
        f"{r['system']:14s} {r['method']:20s} truth {r['truth']:.3g}  reliable"
        f" {r['reliable']}/{r['seeds']}  rms {percent(r['rms'])} (all {percent(r['rms_of_all'])})"
        f"  held {r['held']}/{r['reliable']}  silent misses {r['silent_misses']}"
        f"  {r['evaluations']} evaluations  CPU s first {r['first']:.1f} warm {warm}{plain}"
    )


if __name__ == "__main__":
    main()
