"""Are `jast.explain.indices` right? ``python -m benchmarks.indices [--json] [--quick | --smoke]``.

Limit states whose variance-based indices are known (by one quadrature, in float64): how far the
first-order and the total ones are from the truth, and how often their 95 % intervals cover it, over
keys; and the CPU time beyond that of the estimate.
"""

import time
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jast
from benchmarks.sizes import options, print_report, printer, size
from jast.simulators import limit_state

__all__ = ["CASES", "run"]

PHI = np.vectorize(NormalDist().cdf)


def plane(a: Any, beta: float) -> tuple[Any, float, list, list]:
    """(simulator, P, first order, total) of the half-space a x >= beta, abs(a) = 1: P(F | x_i) =
    Phi((a_i x_i - beta) / sqrt(1 - a_i^2)) (Papaioannou and Straub, 2021).
    """
    z = np.linspace(-9, 9, 4001)
    weight = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) * (z[1] - z[0])
    p = float(PHI(-beta))

    def square(r):
        return float(weight @ PHI((r * z - beta) / np.sqrt(1 - r * r)) ** 2)

    first = [(square(r) - p * p) / (p - p * p) for r in a]
    total = [1 - (square(np.sqrt(1 - r * r)) - p * p) / (p - p * p) for r in a]
    given = Partial(_plane, jnp.asarray(a, float), jnp.asarray(beta))
    return limit_state(given, len(a)), p, first, total


def _plane(a: Any, beta: Any, x: Any) -> Any:
    return beta - a @ x


def either(beta: float) -> tuple[Any, float, list, list]:
    """The same where x_1 >= beta or x_2 >= beta; x_3 does nothing."""
    q = float(PHI(-beta))
    p = 1 - (1 - q) ** 2
    first, total = q * (1 - q) ** 3 / (p - p * p), q * (1 - q) ** 2 / (p - p * p)
    sim = limit_state(Partial(_either, jnp.asarray(beta)), 3)
    return sim, p, [first, first, 0.0], [total, total, 0.0]


def _either(beta: Any, x: Any) -> Any:
    return beta - jnp.maximum(x[0], x[1])


CASES = {
    "plane, one strong": lambda: plane((0.9, 0.4, 0.03**0.5), 3.0),
    "plane, 1e-6": lambda: plane((0.8, 0.5, 0.11**0.5), 4.75),
    "plane, ten alike": lambda: plane((0.1**0.5,) * 10, 4.0),
    "either of two": lambda: either(4.0),
}


def run(seeds: int, budget: int, draws: int) -> dict:
    """By case: P, and of first-order and total indices the root mean square error over the largest
    of them and the share of intervals that cover.
    """
    out = {}
    for name, make in CASES.items():
        sim, p, *truth = make()
        errors, covered, cpu = [], [], []
        for seed in range(seeds):
            key = jax.random.key(seed)
            estimate = jast.estimate.failure_probability(key, sim, budget)
            begin = time.process_time()
            found = jast.explain.indices(jax.random.fold_in(key, 1), sim, estimate, draws=draws)
            cpu.append(time.process_time() - begin)
            values = [[r.first for r in found.rows], [r.total for r in found.rows]]
            ends = np.array([[r.first_interval, r.total_interval] for r in found.rows])
            low, high = np.moveaxis(ends, 0, 1)[..., 0], np.moveaxis(ends, 0, 1)[..., 1]
            errors.append(np.square(np.subtract(values, truth)))
            covered.append((low <= truth) & (truth <= high))
        rms = np.sqrt(np.mean(errors, axis=(0, 2))) / np.max(truth, axis=1)
        cover = np.mean(covered, axis=(0, 2))
        out[name] = dict(
            probability=p,
            first=max(truth[0]),
            total=max(truth[1]),
            error_first=float(rms[0]),
            error_total=float(rms[1]),
            cover_first=float(cover[0]),
            cover_total=float(cover[1]),
            intervals=seeds * len(truth[0]),
            cpu_seconds=float(np.median(cpu)),
        )
    return out


def main(argv: list[str] | None = None) -> None:
    args = options(__doc__, "fewer keys").parse_args(argv)
    say = printer(args)
    report = run(*size(args, (40, 20_000, 400), (10, 20_000, 400), (1, 5000, 20)))
    say("case                  P         first     error  cover   total  error  cover  CPU s")
    for name, r in report.items():
        say(
            f"{name:<20} {r['probability']:9.3g} {r['first']:9.3g}  {100 * r['error_first']:5.1f} %"
            f"  {100 * r['cover_first']:3.0f} %  {r['total']:6.3f}  {100 * r['error_total']:4.1f} %"
            f"  {100 * r['cover_total']:3.0f} %  {r['cpu_seconds']:.2f}"
        )
    print_report(args, report)


if __name__ == "__main__":
    main()
