"""How probable it is that uniform inputs break a requirement: estimates with their intervals, and
crude Monte Carlo (``python -m benchmarks.arch --probability``).
"""

import time
import warnings

import jax

import jast

__all__ = ["rows", "table"]


def rows(sim, budget, crude, seed=0):
    """By method: the probability, its interval, its relative error, whether it is reliable."""
    key, E = jax.random.key(seed), jast.estimate
    methods = {
        "failure_probability": lambda: E.failure_probability(key, sim, budget),
        "subset_simulation": lambda: E.subset_simulation(key, sim, max(100, budget // 40)),
        "monte_carlo": lambda: E.monte_carlo(key, sim, crude),
    }
    found = {}
    for name, method in methods.items():
        begin = time.process_time()
        with warnings.catch_warnings(action="ignore"):
            r = method()
        found[name] = dict(
            probability=float(r.mean),
            interval=[float(v) for v in r.interval],
            relative_error=float(r.relative_error),
            reliable=bool(r.reliable),
            episodes=int(r.episodes),
            cpu_seconds=time.process_time() - begin,
        )
    return found


def table(found):
    """The rows as text."""
    lines = [
        f"{'method':<20} {'P':>9} {'0.95 interval':>20} {'SE, %':>6} {'episodes':>9} {'CPU s':>7}"
    ]
    for name, r in found.items():
        low, high = r["interval"]
        lines.append(
            f"{name:<20} {r['probability']:9.2e} [{low:8.2e}, {high:8.2e}]"
            f" {100 * r['relative_error']:6.1f} {r['episodes']:9d} {r['cpu_seconds']:7.1f}"
            f"{'' if r['reliable'] else '  unreliable'}"
        )
    return "\n".join(lines)
