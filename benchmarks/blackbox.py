"""What a black box costs beside its own time, and what workers gain: ``python -m
benchmarks.blackbox [--json] [--quick | --smoke]``.

``overhead``: milliseconds of wall time an evaluation of a function that does nothing, in a compiled
loop of batches. ``speedup``: wall time with one worker to that with two, for a system that waits
for 5 ms and one that computes for as long, in batches of 64; repetitions of the two alternate.
Medians, with quartiles.

``runs``: of an object of 15 steps, how many runs each call was asked for and how many it made,
counted inside of the object, with the seconds that the call took in all.
"""

import json
import subprocess
import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jast
from benchmarks.sizes import options, print_report, processors, size, timed
from jast import blackbox
from jast.distributions import Normal

HORIZON = 10
SECONDS = 0.005


def trivial(disturbances):
    return False, float(disturbances[0])


def waits(disturbances):
    time.sleep(SECONDS)
    return trivial(disturbances)


def computes(disturbances):
    end = time.perf_counter() + SECONDS
    while time.perf_counter() < end:
        pass
    return trivial(disturbances)


class Counted:
    """A walk that fails 6 away from its start; counts its starts."""

    runs = 0

    def initialize(self):
        Counted.runs += 1
        self.at = 0.0

    def transition(self, x):
        self.at += float(x)

    def is_event(self):
        return abs(self.at) >= 6.0

    def miss_distance(self):
        return max(6.0 - abs(self.at), 0.0)


KEY = jax.random.key(0)
FAILING = jnp.full(15, 0.5)
CALLS = {  # name -> (runs asked for, the call, whether it is in the quick size)
    "nominal": (30, lambda sim: jast.nominal(KEY, sim, 30), True),
    "search.falsify": (
        300,
        lambda sim: jast.search.falsify(KEY, sim, simulations=300, stop=False),
        True,
    ),
    "estimate.monte_carlo": (300, lambda sim: jast.estimate.monte_carlo(KEY, sim, 300), True),
    "estimate.failure_probability": (
        300,
        lambda sim: jast.estimate.failure_probability(KEY, sim, 300),
        False,
    ),
    "stress": (300, lambda sim: jast.stress(KEY, sim, 300), True),
    "search.monte_carlo": (
        300,
        lambda sim: jast.search.monte_carlo(KEY, sim, episodes=300),
        False,
    ),
    "search.chain": (300, lambda sim: jast.search.chain(KEY, sim, episodes=300), False),
    "search.cem": (
        300,
        lambda sim: jast.search.cem(KEY, sim, samples=100, elites=10, iterations=3),
        False,
    ),
    "search.go_explore": (300, lambda sim: jast.search.go_explore(KEY, sim, episodes=300), False),
    "search.forest": (
        300,
        lambda sim: jast.search.forest(KEY, sim, trees=2, prunes=3, simulations=50),
        False,
    ),
    "search.refine": (
        1000,
        lambda sim: jast.search.refine(KEY, sim, jast.replay(sim, FAILING), budget=1000),
        False,
    ),
    "explain.minimal": (
        500,
        lambda sim: jast.explain.minimal(sim, jast.replay(sim, FAILING), budget=500),
        True,
    ),
    "explain.criticality": (
        1000,
        lambda sim: jast.explain.criticality(KEY, sim, jast.replay(sim, FAILING), budget=1000),
        True,
    ),
    "explain.attribution": (
        1000,
        lambda sim: jast.explain.attribution(sim, jast.replay(sim, FAILING), budget=1000),
        False,
    ),
}


def runs(every):
    """By the name of a call: runs asked for and made, and seconds; ``every`` call or a few."""
    out = {}
    for name, (asked, call, quick) in CALLS.items():
        if every or quick:
            sim = blackbox.from_python(Counted, horizon=15, disturbance=Normal(0.0, 1.0))
            Counted.runs = 0
            seconds = wall(call, sim)
            out[name] = {"asked": asked, "made": Counted.runs, "seconds": round(seconds, 1)}
    return out


def box(system, workers):
    return blackbox.from_python(
        system, horizon=HORIZON, disturbance=Normal(0.0, 1.0), workers=workers
    )


def loop(sim, lanes):
    """(first row, calls) -> the sum of the distances of so many batches, no two alike."""

    def one(x):
        return sim.evaluate(blackbox.Record(jnp.ones((), bool), jnp.int32(HORIZON), (), x))[1]

    @jax.jit
    def run(rows, calls):
        return lax.fori_loop(
            0,
            calls,
            lambda i, total: total + jax.vmap(one)(rows + total[None, None] + 1).sum() / lanes,
            jnp.zeros(()),
        )

    return lambda seed, calls: float(
        run(jax.random.normal(jax.random.key(seed), (lanes, HORIZON)), calls)
    )


def wall(function, *args):
    return timed(partial(function, *args))[2]


def middle(values):
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    return {"median": median, "quartiles": [low, high]}


def overhead(repeats, batches=((1, 200), (64, 50), (1024, 5))):
    """``batches``: (lanes, calls a repetition)."""
    out = {}
    for workers in (0, 1):
        sim = box(trivial, workers)
        for lanes, calls in batches:
            run = loop(sim, lanes)
            run(0, 1)
            out[f"{workers} workers, batch {lanes}"] = middle(
                [wall(run, i + 1, calls) / (calls * lanes) * 1e3 for i in range(repeats)]
            )
    return out


def speedup(repeats, lanes=64):
    out = {}
    for system in (waits, computes):
        runs = [loop(box(system, workers), lanes) for workers in (1, 2)]
        for run in runs:
            run(0, 2)  # the workers start, and the pool learns how long a run takes
        one, two = zip(
            *([wall(run, i + 1, 4) / (4 * lanes) * 1e3 for run in runs] for i in range(repeats))
        )
        out[system.__name__] = {
            "ms_one_worker": middle(one),
            "ms_two_workers": middle(two),
            "ratio": middle([a / b for a, b in zip(one, two)]),
        }
    return out


def two_processes(repeats, pieces=100):
    """Of 2 n pieces of computing in one process, to n in each of two."""
    code = (
        f"import time\nfor _ in range({pieces}):\n end = time.perf_counter() + {SECONDS}\n while"
        " time.perf_counter() < end: pass"
    )

    def together(count):
        processes = [
            subprocess.Popen([sys.executable, "-S", "-E", "-c", code]) for _ in range(count)
        ]
        for process in processes:
            process.wait()

    return middle([2 * wall(together, 1) / wall(together, 2) for _ in range(repeats)])


def main(argv=None):
    args = options(__doc__, "fewer repetitions").parse_args(argv)
    repeats = size(args, 15, 3, 1)
    report = {
        "processors": processors(),
        "overhead_ms": overhead(repeats, **({"batches": [(2, 2)]} if args.smoke else {})),
        "speedup": speedup(repeats, 4 if args.smoke else 64)
        | {"two_processes": two_processes(repeats, 2 if args.smoke else 100)},
    }
    if not args.smoke:
        report["runs"] = runs(not args.quick)
    print_report(args, report, "\n".join(f"{k}: {json.dumps(v)}" for k, v in report.items()))


if __name__ == "__main__":
    main()
