"""A sweep of `failure_probability` over a gain against as many separate calls:
``python -m benchmarks.sweep [--json] [--quick | --smoke]``.

The calls are on simulators that are built one by one, each of new functions, as a loop would. CPU
seconds hold the compilation. The sweep goes first, so that it pays for what both share. `filter`
has a known probability: its rows say how many intervals hold it, and where it crosses a level.
"""

import argparse
import json
import math
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np

import jast
from benchmarks.ferry import timed
from benchmarks.sizes import options, size
from benchmarks.stress_systems import lane
from jast.distributions import Normal
from jast.estimate import failure_probability

__all__ = ["run"]

STEPS, LIMIT, LEVEL = 10, 7.0, 1e-5


def filtered(decay):
    """A filter of white noise, which must be below a limit at the end."""
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda y, x: decay * y + x,
        disturbance=lambda y: Normal(0.0, 1.0),
        evaluate=lambda y: (y >= LIMIT, jnp.maximum(LIMIT - y, 0.0)),
        horizon=STEPS,
        episodic=True,
    )


def of_filter(decay):
    """The probability that it is not."""
    return NormalDist().cdf(-LIMIT / math.sqrt(sum(decay ** (2 * i) for i in range(STEPS))))


CASES = {
    "lane": (lane, "gain", 0.25, 0.4, None),
    "filter": (filtered, "decay", 0.5, 0.8, of_filter),
}


def run(name, n, budget):
    """Numbers of one case: CPU seconds, and what the rows are worth."""
    make, setting, low, high, truth = CASES[name]
    values, key = np.linspace(low, high, n), jax.random.key(0)
    swept = lambda **how: jast.sweep(key, make, {setting: values}, budget=budget, **how)
    table, seconds, _ = timed(swept)
    calls = lambda: [
        failure_probability(jax.random.fold_in(key, i), make(v), budget)
        for i, v in enumerate(values)
    ]
    apart, of_calls, _ = timed(calls)
    report = dict(
        values=n,
        budget=budget,
        sweep_seconds=seconds,
        calls_seconds=of_calls,
        times=of_calls / seconds,
        **_worth("sweep", table.results, values, truth),
        **_worth("calls", apart, values, truth),
    )
    if truth is not None and truth(low) < LEVEL < truth(high):
        found = table.crossing(LEVEL, unreliable=True)
        exact = _solved(truth, low, high)
        report |= dict(crossing=found.value, crossing_interval=found.interval, exact=exact)
    return report


def _worth(who, results, values, truth):
    """How many rows are reliable, the median of their standard errors, and how many intervals hold
    the truth: of all rows, and of the reliable ones.
    """
    good = [r.reliable for r in results]
    out = {
        f"{who}_reliable": sum(good),
        f"{who}_relative_error": float(np.nanmedian([r.relative_error for r in results])),
    }
    if truth is not None:
        held = [r.interval[0] <= truth(v) <= r.interval[1] for r, v in zip(results, values)]
        out[f"{who}_hold"] = sum(held)
        out[f"{who}_reliable_hold"] = sum(h for h, g in zip(held, good) if g)
    return out


def _solved(rising, low, high):
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < LEVEL else (low, middle)
    return low


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    args = options(parser, quick="12 values").parse_args(argv)
    n, budget = size(args, 50, 12, 2), size(args, 10_000, 10_000, 5000)
    names = size(args, list(CASES), list(CASES), ["filter"])
    report = {name: run(name, n, budget) for name in names}
    if args.json:
        print(json.dumps(report))
        return
    for name, numbers in report.items():
        print(name)
        for what, value in numbers.items():
            print(f"  {what:<24}{value if isinstance(value, tuple) else f'{value:.5g}'}")


if __name__ == "__main__":
    main()
