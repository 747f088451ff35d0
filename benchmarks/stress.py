"""`jast.stress` against single searches at equal evaluations, on systems with failures to find:
``python -m benchmarks.stress [--json] [--quick | --smoke] [--cases ...] [--seeds N]``.

For each system: seeds that found a failure, and the best log p relative to the mode (median of
those that found one, and the worst), beside the closed form where there is one. Searches are called
as a user types them. `stress` also estimates the probability within the same budget, and counts its
failure modes. ``--leave-out`` compares `stress` with itself without each of its explorers in turn,
whose evaluations the others then have. The cases named "... loop" are those of
`benchmarks.closed_loops`.
"""

import time
import warnings
from dataclasses import replace
from functools import partial
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import jast
from benchmarks import cma_es as driver
from benchmarks.sizes import add_choices, installed, options, print_report, size
from benchmarks.stress_systems import CASES, JUDGED, LOOPS
from jast._src.core.failures import empty
from jast._src.estimate.population import descents
from jast._src.estimate.population.descents import SETTINGS, cool_failures
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.normal_space.mode_coordinates import centred
from jast._src.normal_space.transform import dimension, normal_numbers, policy_of
from jast._src.stress_testing import explorers
from jast._src.stress_testing import stress_test as portfolio
from jast.rewards import likelihood

__all__ = ["METHODS", "run"]


def stress(key, sim, budget):
    """Best log p relative to the mode, evaluations, and the number of modes."""
    report = jast.stress(key, sim, budget)
    return _best(report.failures), report.episodes, len(report.modes)


def monte_carlo(key, sim, budget):
    return _searched(sim, jast.search.monte_carlo(key, sim, episodes=budget))


def cem(key, sim, budget):
    samples = max(10, budget // 30)
    found = jast.search.cem(key, sim, samples=samples, elites=max(2, samples // 10))
    return _searched(sim, found)


def forest(key, sim, budget):
    trees = max(1, budget // 4000)
    each = max(1, budget // (trees * 18))
    return _searched(sim, jast.search.forest(key, sim, trees=trees, simulations=each))


def mcts(key, sim, budget):
    trees = max(1, budget // 9000)
    return _searched(sim, jast.search.mcts(key, sim, trees=trees, simulations=budget // trees))


def gradient(key, sim, budget):
    """Descents from as many starts as it makes by itself; the budget plays no part."""
    return _searched(sim, jast.search.gradient(key, sim))


def go_explore(key, sim, budget):
    return _searched(sim, jast.search.go_explore(key, sim, episodes=budget))


def chain(key, sim, budget):
    return _searched(sim, jast.search.chain(key, sim, episodes=budget))


def cma_es(key, sim, budget):
    """CMA-ES (the package cma) over the normal numbers of an episode, 128 at a time; like `stress`
    it ranks failures first, by log p. Started anew where it has converged, and refined as the
    searches of jast are.
    """
    size, rng = 128, np.random.default_rng(int(jax.random.bits(key, dtype="uint32")))
    centre, zeros = centred(sim), np.zeros(dimension(sim))
    known, spent = None, 0

    def evaluate(points):
        nonlocal known, spent
        if spent + size > budget:
            raise driver.Stop
        each = jax.device_get(_scored(centre, jnp.asarray(points, normal_numbers(sim))))
        parts = [each] if known is None else [known, each]
        known = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
        value = np.where(known.failure, known.reward, -np.inf)
        order = np.argsort(-value, kind="stable")[:64]
        known = jax.tree.map(lambda a: a[order], known)
        spent += size
        worth = np.where(each.failure, -1 / (1 + np.abs(each.reward)), each.distance)
        return np.nan_to_num(worth, nan=1e30, posinf=1e30)

    settings = dict(popsize=size, tolflatfitness=10**9)
    driver.cma_es(rng, evaluate, zeros, np.ones(len(zeros)), lambda: zeros, **settings)
    known = jax.tree.map(lambda a: a[known.failure], known)
    if not len(known.length):
        return None, spent, None
    more = jast.search.refine(key, sim, known, budget=max(100, budget // 10))
    return _best(more.failures), spent + more.episodes, None


def windows(key, sim, budget):
    """`stress` where failures that are cooled together move as those do that go on alone."""
    as_alone = replace(SETTINGS, kinds_cooling_together=(SETTINGS.kinds_by_width,))
    with mock.patch.object(descents, "SETTINGS", as_alone):
        return stress(key, sim, budget)


def slow_cooling(key, sim, budget):
    """The failures of populations cooled ten times as slowly as in `stress`, then refined."""
    for_failures, for_cooling, for_refinement = jax.random.split(key, 3)
    found = jast.estimate.population(for_failures, sim, budget)
    if (sample := found.proposal) is None:
        return None, found.episodes, None
    rows = resample(sample.log_weight, SETTINGS.cooled_failures, 0.5)
    slowly = 10 * min(int(portfolio.COOLING_SHARE * budget), portfolio.MAX_COOLING)
    points, spent = cool_failures(for_cooling, sim, sample.points[rows], slowly, True)
    found_failures = explorers.failures_at(sim, points)
    few = portfolio.REFINE_EVALUATIONS
    more = jast.search.refine(for_refinement, sim, found_failures.episodes, budget=few)
    return _best(more.failures), found.episodes + spent + more.episodes, None


@jax.jit
def _scored(sim, z):
    """The episodes [n] of the normal numbers ``z`` [n, D], by log p relative to the mode."""

    def play(z):
        policy = policy_of(sim, z)
        return jast.rollout(jax.random.key(0), sim, policy, likelihood(sim))._replace(states=None)

    return jax.vmap(play)(z)


USUAL = stress, monte_carlo, cem, forest, mcts, cma_es
SINGLE = gradient, go_explore, chain, windows, slow_cooling
"""Searches for some kinds of system or budget alone: measured where they are asked for."""
METHODS = {f.__name__: f for f in USUAL + SINGLE}


def _without(name, key, sim, budget):
    """`stress` where one of its explorers is not called."""
    none = explorers.ExplorerResult(empty(sim).episodes, 0, 0, 0)
    left_out = explorers.Explorer(lambda *_: none, None)
    if name == SLOW:
        patched = mock.patch.object(portfolio, "slow_cross_entropy", left_out.run)
    else:
        patched = mock.patch.dict(explorers.EXPLORERS, {name: left_out})
    with patched:
        return stress(key, sim, budget)


SLOW = "slow cross-entropy"
LEFT_OUT = {f"- {name}": partial(_without, name) for name in (*explorers.EXPLORERS, SLOW)}


def _best(failures):
    return float(failures.best.reward) if len(failures) else None


def _searched(sim, result):
    """The same of a search, whose failures are scored by log p relative to the mode."""
    scores = [jast.replay(sim, e, reward=likelihood(sim)).reward for e in result.failures]
    return (max(map(float, scores)) if scores else None), result.evaluations, None


def run(cases, methods, budget, seeds):
    """Rows by case and method."""
    report, calls = {}, METHODS | LEFT_OUT
    for name in cases:
        case, rows = (CASES | LOOPS)[name], {}
        sim = case.make()  # once, so that all seeds share its programs
        for method in methods:
            begin, found = time.process_time(), []
            for seed in range(seeds):
                with warnings.catch_warnings(action="ignore"):
                    found.append(calls[method](jax.random.key(seed), sim, budget))
            best = [b for b, _, _ in found if b is not None]
            rows[method] = dict(
                found=len(best),
                seeds=seeds,
                median=float(np.median(best)) if best else None,
                worst=min(best) if best else None,
                evaluations=float(np.mean([n for _, n, _ in found])),
                modes=[m for _, _, m in found if m is not None],
                cpu_seconds=time.process_time() - begin,
            )
        report[name] = dict(optimum=case.optimum, modes=case.modes, rows=rows)
    return report


def table(report):
    """The report as text."""

    def number(v):
        return f"{'-':>9}" if v is None else f"{v:9.3f}"

    lines = [
        f"{'system':<16} {'optimum':>9} {'method':<23} {'found':>7} {'median':>9} {'worst':>9}"
        f" {'evaluations':>12} {'modes':>12} {'CPU s':>7}"
    ]
    for name, case in report.items():
        for method, r in case["rows"].items():
            modes = ""
            if r["modes"]:
                right = sum(m == case["modes"] for m in r["modes"])
                planted = case["modes"] is not None
                modes = f"{right}/{r['seeds']} right" if planted else f"{np.median(r['modes']):g}"
            lines.append(
                f"{name:<16} {number(case['optimum'])} {method:<23}"
                f" {r['found']:3d}/{r['seeds']:<3d} {number(r['median'])} {number(r['worst'])}"
                f" {r['evaluations']:12.0f} {modes:>12} {r['cpu_seconds']:7.1f}"
            )
    return "\n".join(lines)


def main(argv=None):
    parser = options(__doc__, "two systems, few evaluations")
    add_choices(parser, "--cases", CASES | LOOPS, "all but loops")
    usual = [f.__name__ for f in USUAL if f is not cma_es or installed("cma")]
    add_choices(parser, "--methods", METHODS, ", ".join(usual))
    help = "stress with and without each of its explorers, in place of --methods"
    parser.add_argument("--leave-out", action="store_true", help=help)
    parser.add_argument("--budget", type=int, help="evaluations (default: 100,000)")
    parser.add_argument("--seeds", type=int, help="default: 20")
    args = parser.parse_args(argv)
    cases = args.cases or size(args, list(CASES), ["pedestrians", "latch"], ["branches"])
    methods = args.methods or size(args, usual, usual, ["stress", "monte_carlo"])
    methods = ["stress", *LEFT_OUT] if args.leave_out else methods
    budget = args.budget or size(args, 100_000, 10_000, 600)
    seeds = args.seeds or size(args, 20, 1, 1)
    report = run(cases, methods, budget, seeds)
    settings = dict(budget=budget, seeds=seeds, judged=list(JUDGED), jast=jast.__version__)
    print_report(args, dict(settings=settings, systems=report), table(report))


if __name__ == "__main__":
    main()
