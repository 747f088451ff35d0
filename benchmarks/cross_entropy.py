"""The cross-entropy methods on sierra and on other objectives, beside their peers: ``python -m
benchmarks.cross_entropy [--json] [--quick | --smoke] [--seeds N]``.

All in float64, but for the rows that say so. b_v: mean best value of the runs +- its standard
error; d: mean distance to the optimum; F: sqrt(50) times the root of its mean square, which the
thesis's b_d most likely is; hit: share of the runs that end in the global basin (below -0.0165, as
no other minimum is). The table of the thesis is R. J. Moss's Table 2.1. Peers (`benchmarks.peers`)
have the same budgets. ``--picture PATH`` draws the runs on 1A, 1B and 1C, ``--sierra PATH`` sierra
itself in the six settings of figure 2.1.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.cases import CASES
from benchmarks.engine import cpu
from benchmarks.sierra_figure import sierra
from benchmarks.sizes import options, print_report, printer, size, timed
from jast import cross_entropy as ce
from jast._src.cross_entropy.surrogates import RADIAL

SIERRA = ("sierra 1A", "sierra 1B", "sierra 1C")
METHODS = ("ce_method", "ce_surrogate", "ce_mixture")
ELITES = {5: 3, 10: 5, 20: 10, 40: 20}
TABLE = {  # b_v and b_d of the thesis, Table 2.1
    "ce_method": ((-0.0134, 23.48), (-0.0032, 138.87), (-0.0065, 43.14)),
    "ce_surrogate": ((-0.0179, 12.23), (-0.0156, 18.24), (-0.0156, 17.23)),
    "ce_mixture": ((-0.0169, 16.87), (-0.0146, 33.30), (-0.0146, 22.17)),
}
SCHEDULES = {
    "uniform": (-0.0193, 8.53),
    "Geo(0.1)": (-0.0115, 25.35),
    "Geo(0.2)": (-0.0099, 27.59),
    "Geo(0.3)": (-0.0089, 30.88),
}
BASIN = -0.0165


@functools.cache
def program(method, objective, samples, iterations, settings):
    """Runs of one method on one objective by keys, mean and covariance: a compiled program for all
    of them.
    """
    sizes = dict(samples=samples, elites=ELITES[samples], iterations=iterations)

    def search(key, mean, covariance):
        return getattr(ce, method)(key, objective, (mean, covariance), **sizes, **dict(settings))

    return jax.jit(jax.vmap(search, (0, None, None)))


@functools.cache
def objective(function):
    return ce.sierra() if function.__name__ == "sierra" else functools.partial(function, np=jnp)


def runs(method, case, seeds, dtype=np.float64, goal=None, **settings):
    """A batch of runs of a case, `CEResult`; ``goal``: in place of its objective."""
    c = CASES[case]
    goal = objective(c.objective) if goal is None else goal
    run = program(method, goal, *c.budgets, tuple(sorted(settings.items())))
    keys = jax.random.split(jax.random.key(0), seeds)
    return run(keys, c.mean.astype(dtype), np.diag(c.sd.astype(dtype) ** 2))


def row(values, distances=None, sierra=True):
    """The report of several runs."""
    out = peers.summary(values, distances)
    return out | {"hit": float(np.mean(np.asarray(values, float) < BASIN))} if sierra else out


def run_jast(method, case, seeds, **settings):
    result = runs(method, case, seeds, **settings)
    far = CASES[case].distances(result.best_x)
    return row(result.best_value, far, case in SIERRA) | {"invalid": int(np.sum(result.invalid))}


def run_peer(peer, case, seeds):
    found = peers.run(peer, case, range(seeds))
    cpu = {"cpu_s": float(found["cpu_s"].mean())}
    return row(found["values"], found["distances"], case in SIERRA) | cpu


def speed(seeds, methods=METHODS):
    """CPU time to compile each method on sierra, and of a seed of 1A; 1B has the same program."""
    out = {}
    for method in methods:
        run = program(method, ce.sierra(), 10, 10, ())
        c = {case: (CASES[case].mean, np.diag(CASES[case].sd ** 2)) for case in SIERRA[:2]}
        keys = jax.random.split(jax.random.key(1), seeds)
        trace = functools.partial(run.lower, keys, *c["sierra 1A"])
        compiled, compile_cpu, compile_wall = timed(lambda trace=trace: trace().compile())
        each = {
            case: min(cpu(functools.partial(compiled, keys, *start))[0] for _ in range(3)) / seeds
            for case, start in c.items()
        }
        out[method] = {
            "compile_cpu_s": compile_cpu,
            "compile_wall_s": compile_wall,
            "cpu_ms_a_seed": {k: 1e3 * v for k, v in each.items()},
            "seeds": seeds,
        }
    return out


def schedules(seeds, rates=(0.1, 0.2, 0.3), forms=("before", "after"), modes=("thesis", "default")):
    """Experiment 2: 1B with uneven schedules, in both forms of the normaliser, with and without the
    ratchet of the elites.
    """
    out = {}
    run = functools.partial(run_jast, "ce_surrogate", "sierra 1B", seeds)
    uneven = [
        (f"Geo({p}), {form}", ce.schedules.geometric(p, form)(100, 10))
        for form in forms
        for p in rates
    ]
    for mode in modes:
        out[f"uniform, {mode}"] = run(mode=mode)
        for name, counts in uneven:
            out[f"{name}, {mode}"] = run(mode=mode, schedule=counts)
    for name, counts in uneven[: len(rates)]:
        out[f"{name}, thesis with ratchet"] = run(mode="thesis", schedule=counts, ratchet=True)
    return out


def surrogates(seeds, cases=("sierra 1A", "paraboloid 2")):
    """CE-surrogate in mode "thesis" with each model of the objective, the published code's default
    first.
    """
    models = {"gaussian process": {}}
    models |= {f"basis={name}": dict(basis=name) for name in RADIAL}
    models |= {
        f"polynomial, degree {k}": dict(surrogate="polynomial", degree=k) for k in (1, 2, 3, 4)
    }
    return {
        f"{case}, {name}": run_jast("ce_surrogate", case, seeds, mode="thesis", **how)
        for case in cases
        for name, how in models.items()
    }


def row_text(name, r, published=None):
    far = f"   d {r['distance']:6.2f}   F {r['F']:6.1f}" if "F" in r else ""
    note = f"   thesis {published[0]:.4f} / {published[1]:.2f}" if published else ""
    return (
        f"  {name:34} {r['best']:.4f} +- {r['best_se']:.4f}{far}   hit {r['hit']:.2f}  "
        f" ({r['seeds']} seeds){note}"
    )


def main(argv=None):
    parser = options(__doc__, "under two minutes: 64 seeds, fewer cases and peers")
    parser.add_argument("--seeds", type=int, help="runs of each row; 256, or 64 with --quick")
    parser.add_argument(
        "--slow-seeds",
        type=int,
        default=24,
        help="runs of the expected-improvement optimiser, 2 to 5 CPU seconds each",
    )
    parser.add_argument("--surrogates", action="store_true", help="only the kinds of surrogate")
    parser.add_argument("--picture", metavar="PATH", help="draw the mean best value by evaluations")
    parser.add_argument("--sierra", metavar="PATH", help="only draw figure 2.1 of the thesis")
    args = parser.parse_args(argv)
    if args.sierra:
        return sierra()[0].figure.savefig(args.sierra)
    jax.config.update("jax_enable_x64", True)
    seeds = args.seeds or size(args, 256, 64, 2)
    methods, modes = METHODS, ("thesis", "default")
    if args.smoke:  # the others differ in their names alone
        methods, modes = ("ce_surrogate",), ("default",)
    say = printer(args)
    if args.surrogates:
        report = surrogates(seeds, *(((SIERRA[0],),) if args.smoke else ()))
        for name, r in report.items():
            other = f"  {name:34} median {r['median']:.3g}, mean {r['best']:.3g}"
            say(row_text(name, r) if name.startswith("sierra") else other)
        return print_report(args, report)
    report = {"seeds": seeds, "speed": speed(seeds, methods)}
    report |= {"sierra": {}, "peers": {}, "others": {}}
    say("speed: CPU seconds to compile, CPU ms of a run")
    for method, s in report["speed"].items():
        each = s["cpu_ms_a_seed"]
        say(
            f"  {method:14} compile {s['compile_cpu_s']:.1f} s, 1A {each['sierra 1A']:.2f} ms, 1B"
            f" by the same program {each['sierra 1B']:.2f} ms"
        )

    cheap = ("random_search", "cma_es", "differential_evolution", "direct")
    cheap = size(args, cheap, cheap, cheap[2:])  # of SciPy
    for i, case in enumerate(SIERRA[: 1 if args.smoke else None]):
        say(f"\n{case}")
        for mode in modes:
            for method in methods:
                if args.quick and (method, mode) == ("ce_mixture", "thesis"):
                    continue
                r = run_jast(method, case, seeds, mode=mode)
                report["sierra"][f"{case}, {method}, {mode}"] = r
                published = TABLE[method][i] if mode == "thesis" else None
                say(row_text(f"{method}, {mode}", r, published))
        for peer in (*cheap, *size(args, ("expected_improvement",), (), ())):
            n = args.slow_seeds if peer == "expected_improvement" else seeds
            report["peers"][f"{case}, {peer}"] = r = run_peer(peer, case, n)
            say(row_text(peer, r))

    if not args.quick:
        say(
            "\nsierra in float32, default CE-surrogate: the objective itself, and its log (value"
            " -exp(-log))"
        )
        jax.config.update("jax_enable_x64", False)
        for case in SIERRA[: 1 if args.smoke else 2]:
            name = f"{case}, ce_surrogate, float32"
            r = report["sierra"][name] = run_jast("ce_surrogate", case, seeds, dtype=np.float32)
            say(row_text(f"{case}, float32", r))
            found = runs("ce_surrogate", case, seeds, np.float32, ce.sierra(log=True))
            x = np.asarray(found.best_x, float)
            r = row(CASES[case].objective(x), CASES[case].distances(x))
            report["sierra"][f"{name}, log"] = r
            say(row_text(f"{case}, float32, log=True", r))
        jax.config.update("jax_enable_x64", True)
        say("\nexperiment 2: schedules, CE-surrogate from 1B")
        few = ((0.1,), ("before",), ("default",)) if args.smoke else ()
        report["schedules"] = schedules(seeds, *few)
        for name, r in report["schedules"].items():
            published = SCHEDULES[name.split(",")[0]] if name.endswith("thesis") else None
            say(row_text(name, r, published))

    say("\nother objectives: median best value (mean)")
    others = [case for case in CASES if case not in SIERRA]
    for case in size(args, others, ("branin", "ackley 5", "levy 5"), ("paraboloid 2",)):
        some = size(args, METHODS, METHODS[:2], METHODS[:1])
        rows = {method: run_jast(method, case, seeds) for method in some}
        if not args.quick:
            rows["ce_surrogate, thesis"] = run_jast("ce_surrogate", case, seeds, mode="thesis")
        rows |= {peer: run_peer(peer, case, seeds) for peer in cheap}
        report["others"][case] = rows
        texts = (f"{name} {r['median']:.4g} ({r['best']:.4g})" for name, r in rows.items())
        say(f"  {case:13} {', '.join(texts)}")
    if args.picture:
        picture(args.picture, report)
    print_report(args, report)


def picture(path, report):
    """Mean best value by evaluations with its 95 % band; where two peers of the same budget end, by
    a line.
    """
    import matplotlib

    matplotlib.use("Agg")
    from jast import plot
    from jast._src.plot import style

    shown = {
        "CE-method": ("ce_method", "thesis"),
        "CE-surrogate, thesis": ("ce_surrogate", "thesis"),
        "CE-surrogate, default": ("ce_surrogate", "default"),
    }
    with style.axes(None, (10.0, 3.7), columns=3, sharey=True) as axes:
        for ax, case in zip(axes, SIERRA, strict=True):
            drawn = {
                name: runs(method, case, report["seeds"], mode=mode)
                for name, (method, mode) in shown.items()
            }
            plot.convergence(drawn, axes=ax)
            for peer, name, line in (("cma_es", "CMA-ES", "--"), ("direct", "DIRECT", ":")):
                best = report["peers"][f"{case}, {peer}"]["best"]
                ax.axhline(best, color=style.INK, linestyle=line, linewidth=1.2, label=name)
            ax.set_title(case)
            ax.get_legend().remove()
        axes[0].set_ylabel("mean best value")
        axes[2].legend(loc="upper right", bbox_to_anchor=(1.05, 1.05))
        axes[0].figure.savefig(path)


if __name__ == "__main__":
    main()
