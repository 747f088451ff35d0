"""Are `jast.estimate.failure_samples` like failures as they happen? ``python -m
benchmarks.failure_samples [--json] [--quick | --smoke] [--cases ...] [--seeds N]``.

Density and coverage (Naeem et al. 2020): of as many true failures, independent ones, drawn exactly
or by rejection. ``coverage`` is the share of these that have a sample within the distance of their
fifth neighbour among each other, ``density`` the mean number of such balls that a sample lies in,
over five. Equal distributions have a density of 1 and a coverage of .97 (1 - 2^-5, Naeem et al.,
equation 9); a lost mode lacks in coverage, samples where no failures are in density. Distances are
between the latent normal numbers of episodes.

``chain`` is what one would do without a proposal: moves of the same kind, with as many evaluations,
all from the likeliest failure that `jast.search.cem` found.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from scipy import stats
from scipy.spatial.distance import cdist

import jast
from benchmarks.limit_states import DYNAMIC, LIMITS, Limit
from benchmarks.literature import CASES as LITERATURE
from benchmarks.sizes import add_choices, options, print_report, printer, size, timed
from jast._src.estimate.host_populations import equilibrate
from jast._src.normal_space import transform
from jast._src.normal_space.evaluate_points import evaluate_points
from jast.estimate import failure_probability, failure_samples

__all__ = ["density_and_coverage", "run"]

NEIGHBOURS = 5  # whose distance is the radius of a ball: Naeem et al.
LANES = 50_000  # points that are judged side by side


def density_and_coverage(true: np.ndarray, found: np.ndarray) -> tuple[float, float]:
    """Of samples ``found`` [m, D], beside ``true`` ones [n, D]."""
    radius = np.sort(cdist(true, true), axis=1)[:, NEIGHBOURS]
    within = cdist(true, found) <= radius[:, None]
    return float(within.sum() / (NEIGHBOURS * len(found))), float(within.any(axis=1).mean())


def beyond_half_spaces(limit: Limit) -> Callable:
    """Draws failures of half-spaces that do not overlap, exactly."""
    directions, beta, _ = limit.parameters

    def draw(rng, n):
        p = stats.norm.sf(beta)
        which = rng.choice(len(beta), n, p=p / p.sum())
        z = rng.standard_normal((n, limit.dimension))
        a = directions[which]
        along = stats.norm.isf(rng.random(n) * p[which])
        return z + (along - np.sum(a * z, axis=1))[:, None] * a

    return draw


def both_planes(rng, n):
    """Of the half-planes, exactly."""

    def tail():
        return stats.norm.isf(rng.random(n) * stats.norm.sf(3))

    return np.stack([rng.choice((-1, 1), n) * tail(), tail()], axis=1)


def by_rejection(sim: jast.Simulator) -> Callable:
    """Draws failures by drawing until there are enough."""

    def draw(rng, n):
        kept = np.zeros((0, transform.dimension(sim)))
        while len(kept) < n:
            z = rng.standard_normal(
                (LANES, transform.dimension(sim)), transform.normal_numbers(sim)
            )
            kept = np.concatenate([kept, z[evaluate_points(sim, z).failure]])
        return kept[:n]

    return draw


def _static(name):
    return LIMITS[name].simulator(), beyond_half_spaces(LIMITS[name])


def _rejected(make):
    sim = make()
    return sim, by_rejection(sim)


CASES: dict[str, Callable[[], tuple[jast.Simulator, Callable]]] = {
    "half-planes": lambda: (LITERATURE["half-planes"][0](), both_planes),
    "four-branch": lambda: _rejected(LIMITS["four-branch"].simulator),
    "landing, static": lambda: _static("landing, static"),
    "hyperplane 20": lambda: _static("hyperplane 20"),
    "pendulum": lambda: _rejected(DYNAMIC["pendulum"][0]),
    "walk1d one-sided": lambda: _rejected(DYNAMIC["walk1d one-sided"][0]),
    "collision avoidance": lambda: _rejected(LITERATURE["collision avoidance"][0]),
}


def _numbers(sim: jast.Simulator, z: Any) -> np.ndarray:
    """[n, D]: 0 where a number decided nothing."""
    return transform.normal_of(sim, jax.device_get(transform.episodes(sim, z)))


def ours(key, sim, n, budget):
    """Points, and evaluations."""
    first, second = jax.random.split(key)
    p = failure_probability(first, sim, budget)
    found = failure_samples(second, sim, p, n)
    return transform.normal_of(sim, found.failures), p.evaluations + found.evaluations


def chain(key, sim, n, budget):
    """From the likeliest failure, with as many evaluations."""
    first, second = jax.random.split(key)
    best = jast.search.cem(first, sim, samples=max(budget // 100, 100))
    start = transform.normal_of(sim, best.failures.episodes)[:1]
    if not len(start):
        return np.full((1, transform.dimension(sim)), np.inf), best.episodes
    moved, sampler = equilibrate(second, sim, np.repeat(start, n, axis=0), budget // n)
    return _numbers(sim, moved.z), best.episodes + sampler.evaluations


METHODS = {"failure_samples": ours, "chain": chain}


def run(name: str, seeds: int, n: int, budget: int, methods: list[str] | None = None) -> dict:
    """The numbers of one case, a list of one a seed each."""
    sim, draw = CASES[name]()
    report = {}
    for method in methods or METHODS:
        function, rows = METHODS[method], []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            true = _numbers(sim, draw(rng, n).astype(transform.normal_numbers(sim)))
            key = jax.random.key(seed)
            (found, evaluations), cpu, _ = timed(partial(function, key, sim, n, budget))
            rows.append((*density_and_coverage(true, found), evaluations, cpu))
        names = "density", "coverage", "evaluations", "cpu_s"
        report[method] = dict(zip(names, np.array(rows).T.tolist(), strict=True))
    return report


def main(argv=None):
    parser = options(__doc__, "3 seeds of four systems")
    add_choices(parser, "--cases", CASES)
    parser.add_argument("--seeds", type=int, help="default 10")
    args = parser.parse_args(argv)
    say, report, seeds = printer(args), {}, args.seeds or size(args, 10, 3, 2)
    n, budget = size(args, 1000, 1000, 50), size(args, 100_000, 50_000, 5000)

    def spread(v):
        return f"{np.mean(v):.3f} +- {np.std(v, ddof=1) if len(v) > 1 else 0:.3f}"

    for name in args.cases or list(CASES)[: size(args, None, 4, 1)]:
        report[name] = run(name, seeds, n, budget, size(args, None, None, ["failure_samples"]))
        for method, r in report[name].items():
            say(
                f"{name:20} {method:16} density {spread(r['density'])}  coverage"
                f" {spread(r['coverage'])}  evaluations {np.median(r['evaluations']):.0f}"
                f"  CPU {np.median(r['cpu_s']):.1f} s"
            )
    print_report(args, report)


if __name__ == "__main__":
    main()
