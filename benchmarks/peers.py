"""Peers of jast's cross-entropy optimisers on the same budgets, in NumPy and float64: ``python -m
benchmarks.peers [--json] [--quick | --smoke] [--cases ...] [--peers ...]``.

A peer is ``peer(seed, objective, mean, sd, budget)`` and gives every true evaluation in order, ``(x
[n, d], value [n])`` with ``n <= budget``. Methods that start from a distribution get N(mean, diag
sd^2), methods on a box mean +- 2 sd. Needs scipy 1.15 and, for their peers, cma and
bayesian-optimization.
"""

import importlib.metadata
import itertools
import warnings
from functools import partial

import numpy as np

from benchmarks import cma_es as driver
from benchmarks.cases import CASES
from benchmarks.sizes import add_choices, installed, options, print_report, printer, size, timed

__all__ = ["PEERS", "run", "summary"]


def _record(objective, budget, dimension, search):
    """What ``search(evaluate)`` evaluates, stopped when it asks for one more than ``budget``."""
    x, value = np.empty((budget, dimension)), np.empty(budget)
    n = 0

    def evaluate(point):
        nonlocal n
        if n == budget:
            raise driver.Stop
        x[n] = point
        value[n] = objective(x[n])
        n += 1
        return float(value[n - 1])

    with warnings.catch_warnings(action="ignore"):
        try:
            search(evaluate)
        except driver.Stop:
            pass
    return x[:n], value[:n]


def random_search(seed, objective, mean, sd, budget):
    """Draws from the start distribution."""
    x = mean + sd * np.random.default_rng(seed).standard_normal((budget, len(mean)))
    return x, objective(x)


def cma_es(seed, objective, mean, sd, budget):
    """CMA-ES (cma), population 4 + 3 ln d. The first run starts at the mean, each restart, after it
    has converged, at a draw from the start distribution.

    ``tolfun`` and ``tolfunhist`` (1e-11, absolute) are off: in sierra's flat far field they end a
    run after one generation, on 1B five times a seed.
    """
    rng = np.random.default_rng(seed)

    def restart():
        return mean + sd * rng.standard_normal(len(mean))

    def search(evaluate):
        driver.cma_es(rng, partial(map, evaluate), mean, sd, restart, tolfun=0, tolfunhist=0)

    return _record(objective, budget, len(mean), search)


def differential_evolution(seed, objective, mean, sd, budget):
    """Differential evolution (scipy, its defaults, no polish) with 5 d individuals in the box;
    started anew should the population become equal.
    """
    from scipy import optimize

    rng = np.random.default_rng(seed)
    bounds = list(zip(mean - 2 * sd, mean + 2 * sd))

    def search(evaluate):
        while True:
            optimize.differential_evolution(
                evaluate, bounds, popsize=5, maxiter=budget, tol=0, polish=False, rng=rng
            )

    return _record(objective, budget, len(mean), search)


def direct(seed, objective, mean, sd, budget):
    """DIRECT (scipy, locally biased). It is deterministic, so the seed shifts the box by a uniform
    draw of up to +- 0.25 sd in each coordinate.
    """
    from scipy import optimize

    centre = mean + 0.25 * sd * np.random.default_rng(seed).uniform(-1, 1, len(mean))
    bounds = list(zip(centre - 2 * sd, centre + 2 * sd))

    def search(evaluate):
        return optimize.direct(
            evaluate, bounds, maxfun=2 * budget, maxiter=budget, vol_tol=0, len_tol=0
        )

    return _record(objective, budget, len(mean), search)


def expected_improvement(seed, objective, mean, sd, budget):
    """Sequential Gaussian process with expected improvement (bayesian-optimization), Matern 5/2 in
    units of sd, y standardised at every step.

    The first ten points are draws from the start distribution, the others maximise the acquisition
    in the box: 10,000 candidates, the best ten of them improved by L-BFGS-B. One
    lengthscale for all coordinates, of the greatest likelihood of six starts. All this is the
    library's default, only xi is 0.
    """
    from bayes_opt.acquisition import ExpectedImprovement
    from bayes_opt.target_space import TargetSpace
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Matern

    rng = np.random.default_rng(seed)
    state = np.random.RandomState(rng.integers(2**32))
    bounds = {f"x{i}": (-2.0, 2.0) for i in range(len(mean))}
    gp = GaussianProcessRegressor(
        Matern(nu=2.5), alpha=1e-6, normalize_y=True, n_restarts_optimizer=5, random_state=state
    )
    acquisition = ExpectedImprovement(xi=0.0)
    candidates = dict(n_random=10_000, n_smart=10, random_state=state)

    def search(evaluate):
        z = rng.standard_normal((10, len(mean)))
        # it asks for a point of the box: in 40 dimensions ten draws may all lie outside of it
        z = list(z if (np.abs(z) <= 2).all(axis=1).any() else np.clip(z, -2, 2))
        value = [evaluate(mean + sd * point) for point in z]
        while True:
            y = np.array(value)
            space = TargetSpace(None, bounds, allow_duplicate_points=True)
            # it maximises; EI in these units, or L-BFGS-B finds it flat
            for point, target in zip(z, (y.mean() - y) / (y.std() or 1.0)):
                space.register(point, target)
            z.append(acquisition.suggest(gp, space, **candidates))
            value.append(evaluate(mean + sd * z[-1]))

    return _record(objective, budget, len(mean), search)


PEERS = {
    f.__name__: f
    for f in (random_search, cma_es, differential_evolution, direct, expected_improvement)
}


def run(peer, case, seeds):
    """One run a seed: best ``values``, ``distances`` of the best point to the minimiser (None where
    there is none) and ``cpu_s``, each [seeds].
    """
    peer, case = PEERS.get(peer, peer), CASES[case] if isinstance(case, str) else case
    budget = case.budgets[0] * case.budgets[1]
    values, points, seconds = [], [], []
    for seed in seeds:
        search = partial(peer, seed, case.objective, case.mean, case.sd, budget)
        (x, value), cpu, _ = timed(search)
        seconds.append(cpu)
        assert 0 < len(value) <= budget, (peer, len(value))
        best = np.argmin(value)
        values.append(value[best])
        points.append(x[best])
    distances = case.distances(points)
    return {"values": np.array(values), "distances": distances, "cpu_s": np.array(seconds)}


def summary(values, distances=None):
    """Means and standard errors of several runs; ``F`` is sqrt(50) times the root of the mean
    square distance, ``rms``.
    """
    values, n = np.asarray(values, float), len(values)

    def se(sample):
        return float(np.std(sample, ddof=1) / n**0.5) if n > 1 else float("nan")

    report = dict(seeds=n, best=float(values.mean()), best_se=se(values))
    report |= dict(median=float(np.median(values)))
    if distances is not None:
        d = np.asarray(distances, float)
        rms = float(np.mean(d**2) ** 0.5)
        report |= dict(distance=float(d.mean()), distance_se=se(d), rms=rms, F=50**0.5 * rms)
    return report


def main(argv=None):
    parser = options(__doc__, "4 runs of each pair")
    parser.add_argument("--seeds", type=int, help="runs of each pair (default 64)")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    add_choices(parser, "--cases", CASES)
    add_choices(parser, "--peers", PEERS, "all but expected_improvement")
    args = parser.parse_args(argv)
    say, seeds = printer(args), args.seeds or size(args, 64, 4, 1)
    cases = args.cases or size(args, list(CASES), list(CASES), ["branin"])
    usual = [p for p in PEERS if p != "expected_improvement"]
    peers = args.peers or size(args, usual, usual, ["random_search", "differential_evolution"])
    packages = {"scikit-learn": "sklearn", "bayesian-optimization": "bayes_opt"}
    packages |= {name: name for name in ("numpy", "scipy", "cma")}
    there = [p for p, module in packages.items() if installed(module)]
    report = {"versions": {p: importlib.metadata.version(p) for p in there}, "results": []}
    say(
        f"{'case':14}{'peer':24}{'mean best':>12}{'se':>10}{'median':>12}{'distance':>10}"
        f"{'se':>8}{'F':>8}{'CPU s':>9}"
    )
    for name, peer in itertools.product(cases, peers):
        result = run(peer, name, range(args.first, args.first + seeds))
        s = summary(result["values"], result["distances"])
        s["cpu_s"] = float(result["cpu_s"].mean())
        where = f"{'-':>10}{'-':>8}{'-':>8}"
        if "F" in s:
            where = f"{s['distance']:10.3f}{s['distance_se']:8.3f}{s['F']:8.1f}"
        say(
            f"{name:14}{peer:24}{s['best']:12.5g}{s['best_se']:10.2g}{s['median']:12.5g}{where}"
            f"{s['cpu_s']:9.4f}"
        )
        raw = {k: None if v is None else v.tolist() for k, v in result.items()}
        report["results"].append({"case": name, "peer": peer, **s, "runs": raw})
    print_report(args, report)


if __name__ == "__main__":
    main()
