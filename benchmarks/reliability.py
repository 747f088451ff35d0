"""Peers that estimate rare events, from OpenTURNS, on limit states of known probability: ``python
-m benchmarks.reliability [--json] [--quick] [--seeds N]``.

``run(method, g_batch, dimension, budget, seed)`` estimates P(g(x) <= 0), x ~ N(0, I). Evaluations
are counted in ``g_batch``, those of finite-difference gradients too. The table is over seeds: rms
relative error, median of the reported coefficient of variation, evaluations, share of the runs that
are off by more than 20 %, CPU time. What a method is told beyond g stands in its docstring. Needs
openturns.
"""

import itertools

import numpy as np

from benchmarks.limit_states import LIMITS
from benchmarks.sizes import add_choices, options, percent, print_report, printer, size, timed
from benchmarks.structural import PROBLEMS

__all__ = ["METHODS", "Counted", "run"]

# starts of FORM, one a mode, as a user who knows the modes would give them; levels that subset
# simulation and NAIS take
CASES = {
    "landing, static": (
        [s * LIMITS["landing, static"].parameters[0][0] for s in (3, -3)],
        {"subset": 13, "nais": 5},
    ),
    "four-branch": (
        [np.array(s) for s in ((2.0, 2.0), (-2.0, -2.0), (2.0, -2.0), (-2.0, 2.0))],
        {"subset": 3, "nais": 3},
    ),
    "hyperplane 20": ([np.ones(20)], {"subset": 7, "nais": 4}),
    "parallel": ([np.array([2.0, 2.0])], {"subset": 8, "nais": 7}),
}


class Counted:
    """g as an OpenTURNS event, and the number of points it was asked for."""

    def __init__(self, g_batch, dimension):
        import openturns as ot

        self.evaluations = 0

        def batch(x):
            self.evaluations += len(x)
            return np.asarray(g_batch(np.asarray(x)), float)[:, None]

        function = ot.PythonFunction(dimension, 1, func_sample=batch)
        self.event = ot.ThresholdEvent(
            ot.CompositeRandomVector(function, ot.RandomVector(ot.Normal(dimension))),
            ot.LessOrEqual(),
            0.0,
        )


def _sized(algorithm, n):
    """A simulation of n points (a level), evaluated in a hundred blocks."""
    algorithm.setBlockSize(max(n // 100, 1))
    algorithm.setMaximumOuterSampling(100)
    algorithm.run()
    result = algorithm.getResult()
    return result.getProbabilityEstimate(), result.getCoefficientOfVariation()


def subset(ot, event, budget, levels):
    """Subset simulation, its defaults (a tenth survives a level). ``levels``: how many it will
    take, which splits the budget; it is told.
    """
    return _sized(ot.SubsetSampling(event), budget // levels)


def nais(ot, event, budget, levels):
    """Nonparametric adaptive importance sampling, quantile .1; ``levels`` as in `subset`. Its time
    grows with the square of the points a level.
    """
    return _sized(ot.NAIS(event, 0.1), budget // levels)


def _form(ot, counted, budget, search, starts):
    """``search`` (FORM or MultiFORM, its defaults) from each start, then importance sampling from
    an equal mixture of N(design point, I); 0 where none was found.
    """
    parts, event = [], counted.event
    for start in starts:
        solver = ot.AbdoRackwitz()
        solver.setStartingPoint(start)
        algorithm = search(solver, event)
        try:
            algorithm.run()
        except (TypeError, RuntimeError):  # no convergence, or not on the limit state
            continue
        found = algorithm.getResult()
        found = found.getFORMResultCollection() if search is ot.MultiFORM else [found]
        points = (f.getStandardSpaceDesignPoint() for f in found)
        parts += [ot.Normal(point, ot.CovarianceMatrix(len(start))) for point in points]
    if not parts:
        return 0.0, float("nan")
    proposal = parts[0] if len(parts) == 1 else ot.Mixture(parts)
    drawn = ot.ImportanceSamplingExperiment(proposal)
    sampling = ot.ProbabilitySimulationAlgorithm(event, drawn)
    sampling.setMaximumCoefficientOfVariation(0.0)  # to the end of the budget
    return _sized(sampling, budget - counted.evaluations)


LEVELS = {"subset": subset, "nais": nais}
FORM = {  # name -> (search, how many starts of 16 random ones, N(0, I); None: those given by hand)
    "form_one": ("FORM", 1),
    "form_16": ("FORM", 16),  # no routine of OpenTURNS, but what a careful user would do with it
    "form_by_hand": ("FORM", None),
    "multi_form": ("MultiFORM", 1),
}
METHODS = LEVELS | FORM


def run(method, g_batch, dimension, budget, seed, levels=13, starts=()):
    """One estimate: a dict of ``estimate``, ``evaluations`` and ``reported_cov``.

    ``g_batch``: x [n, dimension] -> [n], float64; ``method``: one of ``METHODS``; ``levels`` is
    read by `subset` and `nais`, ``starts`` by `form_by_hand`.
    """
    import openturns as ot

    ot.Log.Show(ot.Log.NONE)
    ot.RandomGenerator.SetSeed(seed + 1)
    counted = Counted(g_batch, dimension)
    if method in LEVELS:
        estimate, cov = LEVELS[method](ot, counted.event, budget, levels)
    else:
        search, some = FORM[method]
        if some is not None:
            starts = np.random.default_rng(seed).standard_normal((16, dimension))[:some]
        estimate, cov = _form(ot, counted, budget, getattr(ot, search), starts)
    spent = counted.evaluations
    return dict(estimate=float(estimate), evaluations=spent, reported_cov=float(cov))


def _levels(truth):
    """What subset simulation and NAIS are told: a tenth survives each level."""
    levels = int(np.ceil(-np.log10(truth))) + 1
    return {"subset": levels, "nais": levels}


def row(method, case, budget, seeds):
    """The report of several seeds."""
    limit = (LIMITS | PROBLEMS)[case]
    starts, levels = CASES[case] if case in CASES else ((), _levels(limit.truth))
    about = method, limit.batch, limit.dimension, budget
    more = levels.get(method), starts
    runs, cpu, _ = timed(lambda: [run(*about, seed, *more) for seed in range(seeds)])
    error = np.array([r["estimate"] for r in runs]) / limit.truth - 1
    # none where nothing was found
    cov = [r["reported_cov"] for r in runs if r["reported_cov"] >= 0]
    return {
        "rms": float(np.mean(error**2) ** 0.5),
        "median_error": float(np.median(np.abs(error))),
        "cov": float(np.median(cov)) if cov else None,
        "beyond_20": float(np.mean(~(np.abs(error) < 0.2))),
        "evaluations": float(np.median([r["evaluations"] for r in runs])),
        "cpu_s": cpu / seeds,
        "seeds": seeds,
    }


def main(argv=None):
    parser = options(__doc__, "4 seeds, and no NAIS in 20 dimensions, which takes minutes")
    parser.add_argument("--seeds", type=int, help="runs of each row; 20, or 4 with --quick")
    parser.add_argument("--budget", type=int, help="evaluations of a run (default 100,000)")
    fixed = f"{', '.join(CASES)}; the others have no starts by hand"
    add_choices(parser, "--cases", CASES | PROBLEMS, fixed)
    add_choices(parser, "--methods", METHODS)
    args = parser.parse_args(argv)
    say, seeds = printer(args), args.seeds or size(args, 20, 4, 1)
    budget = args.budget or size(args, 100_000, 100_000, 2000)
    cases = args.cases or size(args, list(CASES), list(CASES), ["parallel"])
    methods = args.methods or size(args, list(METHODS), list(METHODS), ["subset", "form_16"])
    report = {"budget": budget, "seeds": seeds, "results": {}}
    say(
        f"{'case':17}{'method':14}{'rms':>10}{'median':>10}{'reported':>10}{'> 20 %':>9}"
        f"{'evaluations':>13}{'CPU s':>8}"
    )
    for case, method in itertools.product(cases, methods):
        if args.quick and (case, method) == ("hyperplane 20", "nais"):
            continue
        report["results"][f"{case}, {method}"] = r = row(method, case, budget, seeds)
        errors = "".join(f"{percent(r[k]):>10}" for k in ("rms", "median_error", "cov"))
        say(
            f"{case:17}{method:14}{errors}{100 * r['beyond_20']:7.0f}"
            f" %{r['evaluations']:13.0f}{r['cpu_s']:8.2f}"
        )
    print_report(args, report)


if __name__ == "__main__":
    main()
