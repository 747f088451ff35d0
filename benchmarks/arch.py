"""Falsification of the ARCH-COMP benchmarks with few simulations: ``python -m benchmarks.arch
[--json] [--quick | --smoke] [--cases ...] [--methods ...] [--seeds N] [--budget N]
[--probability [CASE]] [--flights]``.

For each requirement and method: seeds that falsified it within the budget (300; CC4 and AT 1500),
and the mean and median number of simulations of these. A method is ``method(key, sim, budget)`` and
gives how many simulations it took, or None. Searches of jast are called as users type them, with a
batch that suits so few simulations. CMA-ES (cma) and Bayesian optimisation with expected
improvement (bayesian-optimization: a minute and more a run, so only where it is asked for) are
those of `benchmarks.peers`, over the levels of the inputs.
"""

import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import jast
from benchmarks import arch_flights, arch_probability, peers
from benchmarks.cma_es import Stop
from benchmarks.sizes import add_choices, installed, options, print_report, size
from jast._src.normal_space import transform
from jast.simulators.arch import automatic_transmission, chasing_cars, ground_collision_avoidance

__all__ = ["METHODS", "run"]

S = jast.search
CASES = {"CC1": 300, "CC2": 300, "CC3": 300, "CC4": 1500, "CC5": 300, "CCx": 300} | {
    name: 1500
    for name in ("AT1", "AT2", "AT51", "AT52", "AT53", "AT54", "AT6a", "AT6b", "AT6c", "AT6abc")
}
CASES |= {"F16": 300}
SYSTEMS = {"CC": chasing_cars, "AT": automatic_transmission, "F1": ground_collision_avoidance}
PUBLISHED = {
    "CC1": "FalCAuN 229 (10/10)",
    "CC2": "FalCAuN 76 (10/10)",
    "CC3": "FalCAuN 122 (10/10)",
    "CC4": "FalCAuN 1257 (4/10, in another file 7/10)",
    "CCx": "FalCAuN 0/10",
    "AT1": "FalCAuN 896 (10/10)",
    "AT2": "FalCAuN 256 (10/10)",
    "AT6a": "FalCAuN 458 (10/10)",
    "AT6b": "FalCAuN 600 (10/10; the year after 0/10)",
    "AT6c": "FalCAuN 898 (10/10)",
    "AT6abc": "FalCAuN 1232 (10/10)",
    "F16": "MoonLight with TuRBO 21 (10/10), from 2338 ft and with other gains",
}


def system(name):
    """The simulator of a requirement."""
    return SYSTEMS[name[:2]](name)


def falsify(key, sim, budget):
    return S.falsify(key, sim, simulations=budget, batch=1).first_failure


def random(key, sim, budget):
    return S.monte_carlo(key, sim, episodes=budget, refine=0).first_failure


def _guided(search, settings):
    """A search of jast for failures over the levels of the inputs, with settings for a budget."""

    def method(key, sim, budget):
        told = jast.rewards.lexicographic(near=1.0, rare=1.0)
        actions = jast.actions.quantiles()
        found = search(key, sim, reward=told, actions=actions, refine=0, **settings(budget))
        first = found.first_failure
        return first if first is not None and first <= budget else None

    return method


def _generations(budget):
    samples = min(25, budget)
    return dict(samples=samples, elites=max(1, samples // 5), iterations=budget // samples)


def _peer(name):
    """A peer of `benchmarks.peers`, over the levels of the inputs from the middle of their ranges,
    one simulation at a time; what is outside of [0, 1] is clipped.
    """

    def method(key, sim, budget):
        failed = False

        def objective(u):
            nonlocal failed
            if failed:
                raise Stop
            z = jax.scipy.special.ndtri(jnp.clip(jnp.asarray(u), 1e-6, 1 - 1e-6))
            o = jax.device_get(transform.outcomes(sim, z[None]))
            failed = bool(o.failure[0])
            return -1.0 if failed else float(o.distance[0])

        seed, d = int(jax.random.key_data(key)[-1]), transform.dimension(sim)
        middle, sd = np.full(d, 0.5), np.full(d, 0.25)
        _, value = peers.PEERS[name](seed, objective, middle, sd, budget)
        return len(value) if failed else None

    return method


METHODS = {
    "falsify": falsify,
    "random": random,
    "cem": _guided(S.cem, _generations),
    "mcts": _guided(S.mcts, lambda n: dict(simulations=n)),
    "forest": _guided(
        S.forest, lambda n: dict(trees=1, prunes=min(18, n), simulations=-(-n // 18))
    ),
    "cma_es": _peer("cma_es"),
    "bayesian": _peer("expected_improvement"),
}
NEEDED = {"cma_es": "cma", "bayesian": "bayes_opt"}


def run(cases, methods, seeds, budget=None):
    """Rows by requirement and method."""
    report = {}
    for name in cases:
        limit, sim, rows = budget or CASES[name], system(name), {}
        for method in methods:
            begin, took = time.process_time(), []
            for seed in range(seeds):
                with warnings.catch_warnings(action="ignore"):
                    took.append(METHODS[method](jax.random.key(seed), sim, limit))
            found = [int(n) for n in took if n is not None]
            rows[method] = dict(
                falsified=len(found),
                seeds=seeds,
                mean=float(np.mean(found)) if found else None,
                median=float(np.median(found)) if found else None,
                simulations=took,
                cpu_seconds=time.process_time() - begin,
            )
        report[name] = dict(budget=limit, published=PUBLISHED.get(name), rows=rows)
        jax.clear_caches()
    return report


def table(report):
    """The report as text."""

    def number(v):
        return f"{'-':>8}" if v is None else f"{v:8.1f}"

    lines = [
        f"{'':<5} {'budget':>6} {'method':<9} {'falsified':>9} {'mean':>8} {'median':>8}"
        f" {'CPU s':>7}"
    ]
    for name, case in report.items():
        for method, r in case["rows"].items():
            lines.append(
                f"{name:<5} {case['budget']:6d} {method:<9} {r['falsified']:4d}/{r['seeds']:<4d}"
                f" {number(r['mean'])} {number(r['median'])} {r['cpu_seconds']:7.1f}"
            )
        if case["published"]:
            lines.append(f"{name:<5} {'':>6} published: {case['published']}")
    return "\n".join(lines)


def main(argv=None):
    parser = options(__doc__, "one requirement, three seeds")
    add_choices(parser, "--cases", CASES)
    add_choices(parser, "--methods", METHODS, "all but bayesian")
    parser.add_argument("--seeds", type=int, help="default: 50")
    parser.add_argument("--budget", type=int, help="simulations (default: 300; CC4 and AT 1500)")
    parser.add_argument(
        "--probability",
        nargs="?",
        const="CCx",
        choices=CASES,
        help="instead: how probable it is that uniform inputs break one (default: CCx), by"
        " estimates of 20,000 episodes (or --budget) and crude Monte Carlo of 1,000,000",
    )
    parser.add_argument(
        "--flights", action="store_true", help="instead: how low F-16s come, by altitude"
    )
    args = parser.parse_args(argv)
    settings = dict(jast=jast.__version__)
    if args.flights:
        found = arch_flights.rows(size(args, 20_000, 2_000, 20))
        return print_report(args, dict(settings=settings, rows=found), arch_flights.table(found))
    if args.probability:
        budget = args.budget or size(args, 20_000, 5_000, 500)
        crude = size(args, 1_000_000, 20_000, 500)
        found = arch_probability.rows(system(args.probability), budget, crude)
        settings |= dict(case=args.probability)
        return print_report(
            args, dict(settings=settings, rows=found), arch_probability.table(found)
        )
    usual = [m for m in METHODS if m != "bayesian" and installed(NEEDED.get(m, "jast"))]
    cases = args.cases or size(args, list(CASES), ["CC2"], ["CC1"])
    methods = args.methods or size(args, usual, ["falsify", "cem"], ["falsify"])
    seeds = args.seeds or size(args, 50, 3, 2)
    report = run(cases, methods, seeds, args.budget or size(args, None, None, 20))
    print_report(args, dict(settings=settings | dict(seeds=seeds), systems=report), table(report))


if __name__ == "__main__":
    main()
