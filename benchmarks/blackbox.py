"""What a black box costs beside its own time, and what workers gain: ``python -m
benchmarks.blackbox [--json] [--quick | --smoke]``.

``overhead``: milliseconds of wall time an evaluation of a function that does nothing, in a compiled
loop of batches. ``speedup``: wall time with one worker to that with two, for a system that waits
for 5 ms and one that computes for as long, in batches of 64; repetitions of the two alternate.
Medians, with quartiles.
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
    print_report(args, report, "\n".join(f"{k}: {json.dumps(v)}" for k, v in report.items()))


if __name__ == "__main__":
    main()
