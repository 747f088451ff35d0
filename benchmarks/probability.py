"""Failure probabilities: error, coverage and cost of jast's estimators, ``python -m
benchmarks.probability [--json] [--quick | --smoke] [--only PART ...]``.

``landing``: importance resampling of traces and policies on the landing (truth 4.0237e-13), the
published Algorithm 2, traces a second; ``range``: log P to 1e-100 in float32; ``policy``: failure
policies by both learners at equal steps of the simulator; ``default``: `failure_probability` over
seeds, with and without gradients, beside OpenTURNS on the same limit states and evaluations;
``cases``: the fixed cases, of benchmarks.limit_states, markov_systems, literature and structural;
``coverage``: problems drawn by seed (benchmarks.limit_states), how often the 95 % interval covers,
how often an estimate is flagged, and how often an interval misses without a flag. Float32
throughout.
"""

import itertools
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from scipy import stats

import jast
from benchmarks import reliability
from benchmarks.limit_states import DYNAMIC, FAMILIES, Case, cases, draw
from benchmarks.literature import CASES as LITERATURE
from benchmarks.markov_systems import CASES as MARKOV
from benchmarks.sizes import add_choices, options, print_report, printer, size, timed
from benchmarks.structural import PROBLEMS
from jast._src.core.policy import Policy
from jast._src.distributions.mixtures import blend
from jast.distributions import Normal
from jast.estimate import (
    clopper_pearson,
    failure_probability,
    importance,
    policy_proposal,
    trace_proposal,
)

LANDING = DYNAMIC["landing"][1]
TRUTHS = {"landing": LANDING, "pendulum": 8.169e-3}
PARTS = ("landing", "range", "policy", "default", "cases", "coverage")


def both_traces(b=1.0):
    """The landing and its two design points as a proposal."""
    sim = jast.simulators.landing(b=b)
    ends = [side * b * 1.001 for side in (1, -1)]
    points = [(jnp.full(10, v * 0.0009 / 0.019), jnp.float32(v * 0.01 / 0.019)) for v in ends]
    return sim, trace_proposal(sim, [jast.replay(sim, *point) for point in points])


def _to_the_edge(s, t):
    """The best deterministic policy: the rest of the way in equal steps."""
    rest = jnp.where(s.x2 >= 0, 1.0, -1.0) - s.x2
    return Normal(rest / (10 - t).astype(s.x2.dtype), jnp.ones_like(s.x2) * 0.03)


def _two_starts(s0):
    return blend(jnp.array([0.5, 0.5]), Normal(s0, 0.1), Normal(-s0, 0.1))


def landing(seeds, samples=100_000, many=2_000_000):
    sim, traces = both_traces()
    policy = Policy(Partial(_two_starts, jnp.float32(0.526)), _to_the_edge)
    proposals = {
        "two traces": traces,
        "policy, tilted start": policy_proposal(sim, policy),
        "policy, start of the model (Algorithm 2)": policy_proposal(sim, policy, tilt_start=False),
    }
    out = {}
    for name, proposal in proposals.items():
        runs = [importance(jax.random.key(seed), sim, proposal, samples) for seed in range(seeds)]
        key = jax.random.key(seeds)
        _, cpu, wall = timed(partial(importance, key, sim, proposal, many))
        speed = dict(traces_per_cpu_s=many / cpu, traces_per_s=many / wall)
        out[name] = summary([(r, LANDING) for r in runs]) | speed
    return out


def to_small(samples=262_144):
    """log10 P, the error of the estimate and its relative standard error, by the width of the
    runway.
    """
    rows = []
    for b in (1.0, 1.5, 2.0, 2.5, 2.92):
        sim, proposal = both_traces(b)
        r = importance(jax.random.key(1), sim, proposal, samples)
        log_p = float(np.log(2) + stats.norm.logsf(b / np.sqrt(0.019)))
        error = float(np.expm1(r.log_mean - log_p))
        row = dict(b=b, log10_P=log_p / np.log(10), error=error, relative_error=r.relative_error)
        rows.append(row)
    return rows


def policies(seeds, episodes, systems, samples=100_000, methods=("sac", "ppo")):
    """Learned policies by both learners at equal steps of the simulator: training and estimation
    from nothing. Yields each row's name and numbers; the first seed compiles, so of the CPU seconds
    the median is reported.
    """
    for system, n, method in itertools.product(systems, episodes, methods):
        sim, truth = getattr(jast.simulators, system)(), TRUTHS[system]
        runs, seen, clocks = [], [], []
        for seed in range(seeds):
            wall, cpu = time.perf_counter(), time.process_time()
            teach = getattr(jast.policies, method)
            policy = teach(jax.random.key(seed), sim, episodes=n)
            proposal = policy_proposal(sim, policy)
            r = importance(jax.random.key(100 + seed), sim, proposal, samples)
            clocks.append((time.perf_counter() - wall, time.process_time() - cpu))
            runs.append((r, truth))
            upper = np.nan
            if system == "landing" and r.failures_seen:
                draw = partial(jast.estimate.failure_samples, jax.random.key(200 + seed), sim)
                found = draw(proposal, 500, moves=0).failures
                upper = float(np.mean(found.x0 + found.disturbances.sum(axis=1) > 0))
            seen.append((policy.steps, policy.history.failing_share[-1], upper))
        steps, failing, upper = np.array(seen, np.float64).T
        errors = [float(r.relative_error) for r, _ in runs]
        more = {
            "relative_errors": errors,
            "relative_error_mean": float(np.mean(errors)),
            "relative_error_spread": float(np.std(errors, ddof=1)) if seeds > 1 else None,
            "failing_share": failing.tolist(),
            "upper_mode": None if np.isnan(upper).all() else upper.tolist(),
            "steps": float(np.mean(steps)),
            "wall_s": [w for w, _ in clocks],
            "cpu_s": float(np.median([c for _, c in clocks])),
            "cpu_s_each": [c for _, c in clocks],
        }
        yield f"{system}, {n} episodes, {method}", summary(runs) | more


def default(seeds, peers, budget=100_000):
    """`failure_probability` on landing and the limit states that OpenTURNS is run on."""
    out = {}
    names = {"landing": "landing, static"}
    known = {c.name: c for c in cases()}
    for case in ["landing", *(["four-branch", "hyperplane 20", "parallel"] if peers else [])]:
        sim, truth = (jast.simulators.landing(), LANDING) if case == "landing" else known[case][1:]
        for name, gradients in (("jast", True), ("jast, no gradients", False)):
            out[f"{case}, {name}"] = ours([(sim, truth)] * seeds, budget, gradients=gradients)
        for method in peers:
            if (case, method) != ("hyperplane 20", "nais"):  # minutes a run
                out[f"{case}, {method}"] = reliability.row(
                    method, names.get(case, case), budget, min(seeds, 20)
                )
    return out


def ours(problems, budget, **settings):
    """The summary of `failure_probability` on (simulator, truth), a seed each."""
    cpu, runs = time.process_time(), []
    for seed, (sim, truth) in enumerate(problems):
        key = jax.random.key(10_000 + seed)
        runs.append((failure_probability(key, sim, budget, **settings), truth))
    return summary(runs) | {"cpu_s": (time.process_time() - cpu) / len(runs)}


def summary(runs):
    """Of [(estimate, truth), ...]: errors, coverage and flags; far: by more than 4 of the reported
    standard errors.
    """
    error = np.array([r.mean / truth - 1 if r.failures_seen else -1 for r, truth in runs])
    covers = np.array([r.interval[0] <= truth <= r.interval[1] for r, truth in runs])
    reliable = np.array([r.reliable for r, _ in runs])
    reported = np.array([r.relative_error for r, _ in runs])
    far = ~(np.abs(error) <= 4 * reported)
    return {
        "seeds": len(runs),
        "rms": float(np.mean(error**2) ** 0.5),
        "greatest": float(np.abs(error).max()),
        "beyond_20": float(np.mean(np.abs(error) > 0.2)),
        "relative_error": float(np.nanmedian(reported)),
        "covers": int(covers.sum()),
        "flagged": int((~reliable).sum()),
        "covers_of_reliable": int((covers & reliable).sum()),
        "misses_unflagged": int((~covers & reliable).sum()),
        "far_unflagged": int((far & reliable).sum()),
        "beyond_10_unflagged": int(((np.abs(error) > 0.1) & reliable).sum()),
        "evaluations": float(np.median([r.evaluations for r, _ in runs])),
        "estimates": [r.mean / truth for r, truth in runs],
        "standard_errors_off": [
            (r.mean / truth - 1) / r.relative_error if r.failures_seen else None
            for r, truth in runs
        ],
        "relative_errors": reported.tolist(),
        "reliable": reliable.tolist(),
    }


def line(name, r):
    text = (
        f"  {name:42} rms {100 * r['rms']:7.2f} %  greatest {100 * r['greatest']:6.1f} %  SE"
        f" {100 * r['relative_error']:6.2f} %"
    )
    text += (
        f"  covers {r['covers']:3d}, flagged {r['flagged']:3d}, misses unflagged"
        f" {r['misses_unflagged']:2d} of {r['seeds']} (far {r['far_unflagged']}, 10 %"
        f" {r['beyond_10_unflagged']})"
    )
    return text + (f"  CPU {r['cpu_s']:.1f} s" if isinstance(r.get("cpu_s"), float) else "")


def _chosen(args):
    """The fixed cases that are asked for."""
    if args.smoke:
        return cases(["four-branch"])
    every = dict(fixed=cases())
    for group, rows in dict(markov=MARKOV, literature=LITERATURE).items():
        every[group] = [Case(name, make(), truth) for name, (make, truth) in rows.items()]
    every["structural"] = [Case(name, p.simulator(), p.truth) for name, p in PROBLEMS.items()]
    wanted = args.cases or list(every)
    return [c for g, some in every.items() for c in some if g in wanted or c.name in wanted]


def main(argv=None):
    parser = options(__doc__, "under two minutes: few seeds, no learned policies, two families")
    add_choices(parser, "--only", PARTS)
    parser.add_argument(
        "--seeds", type=int, help="seeds of each family in coverage (20), and of default (50)"
    )
    add_choices(parser, "--families", FAMILIES)
    parser.add_argument(
        "--first", type=int, default=50_000, help="number of the first problem of a family"
    )
    parser.add_argument("--budget", type=int, help="default 100,000")
    parser.add_argument(
        "--cases",
        nargs="+",
        metavar="CASE",
        help="names of fixed cases, or fixed, markov, literature, structural; default: all",
    )
    args = parser.parse_args(argv)
    # learned policies need minutes, and so do all cases
    slow = size(args, (), ("policy", "cases"), ("policy",))
    parts = args.only or [part for part in PARTS if part not in slow]
    say, budget = printer(args), args.budget or size(args, 100_000, 100_000, 5000)
    report, quick = {"budget": budget}, args.quick

    def seeds(*n):
        return args.seeds or size(args, *n)

    if "landing" in parts:
        report["landing"] = landing(*size(args, (200,), (5,), (1, 1000, 1000)))
        say("importance resampling on the landing, 1e5 traces")
        for name, r in report["landing"].items():
            say(
                line(name, r) + f"  {r['traces_per_cpu_s'] / 1e6:.2f} M traces a CPU s,"
                f" {r['traces_per_s'] / 1e6:.2f} M a s"
            )
    if "range" in parts:
        report["range"] = to_small(1000 if args.smoke else 262_144)
        for r in report["range"]:
            say(
                f"  log10 P {r['log10_P']:8.2f}  error {100 * r['error']:6.2f} %  SE"
                f" {100 * r['relative_error']:.2f} %"
            )
    if "policy" in parts:
        report["policy"] = {}
        plan = size(
            args,
            ((2000, 12_000), ("landing", "pendulum"), 100_000),
            ((2000,), ("landing",), 100_000),
            ((300,), ("landing",), 1000),
        )
        say("learned policies at equal steps of the simulator")
        for name, r in policies(seeds(10, 2, 1), *plan):
            report["policy"][name] = r
            spread = r["relative_error_spread"] or np.nan
            say(
                line(name, r) + f"  SE {100 * r['relative_error_mean']:.2f}"
                f" +- {100 * spread:.2f} %, {r['steps']:.0f} steps"
            )
    if "default" in parts:
        say(f"failure_probability, budget {budget}")
        peers = [] if quick or args.smoke else ["subset", "nais", "form_16", "form_by_hand"]
        report["default"] = default(seeds(50, 3, 1), peers, budget)
        for name, r in report["default"].items():
            if "covers" in r:
                say(line(name, r))
            else:
                say(
                    f"  {name:42} rms {100 * r['rms']:7.2f} %  beyond 20 %:"
                    f" {100 * r['beyond_20']:.0f} %  reported {100 * (r['cov'] or np.nan):.2f} %"
                )
    if "cases" in parts:
        report["cases"] = {}
        for c in _chosen(args):
            report["cases"][c.name] = r = ours([c[1:]] * seeds(10, 10, 1), budget)
            say(line(c.name, r))
    if "coverage" in parts:
        report["coverage"], total = {}, []
        families = args.families or list(FAMILIES)
        families = size(args, families, ("two_sided", "branches"), ("branches",))
        for family in families:
            problems = [draw(family, args.first + seed)[1:] for seed in range(seeds(20, 3, 1))]
            report["coverage"][family] = r = ours(problems, budget)
            total.append(r)
            say(line(family, r))
        names = "flagged", "misses_unflagged", "far_unflagged", "beyond_10_unflagged"
        sums = {name: sum(r[name] for r in total) for name in names}
        n, covers = (sum(r[name] for r in total) for name in ("seeds", "covers_of_reliable"))
        flagged, _, far, off = sums.values()
        interval = clopper_pearson(covers, n - flagged) if n > flagged else (0.0, 1.0)
        counts = dict(problems=n, covers=covers, coverage_95=list(interval))
        report["coverage_total"] = counts | sums
        say(
            f"  all: {covers} of {n - flagged} unflagged intervals cover [{interval[0]:.3f},"
            f" {interval[1]:.3f}]; {flagged} of {n} flagged; of the others {far} are far,"
            f" {off} off by more than 10 %"
        )
    print_report(args, report)


if __name__ == "__main__":
    main()
