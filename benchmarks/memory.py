"""Many systems in one process: mappings of memory and resident memory after `jast.stress` met each:
``python -m benchmarks.memory [--json] [--quick | --smoke] [--keep | --long]``. ``--keep`` lets no
compiled program go. ``--long``: instead, the most memory that long calls on the ferry hold, each in
a process of its own, as they become longer.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import jax

import jast
from benchmarks.sizes import options, size
from benchmarks.stress_systems import CASES, TUNED
from jast import memory
from jast.simulators import ferry

__all__ = ["main"]

KEY = jax.random.key(0)
MAPS, PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")


LONG = {
    "monte_carlo": (
        "episodes",
        lambda n: jast.search.monte_carlo(KEY, ferry(), episodes=n, refine=0),
    ),
    "forest": (
        "simulations of each of 10,000 trees",
        lambda n: jast.search.forest(
            KEY, ferry(), trees=10_000, prunes=18, simulations=n // 18, refine=0
        ),
    ),
}
"""Name -> (what grows, the call)"""


def peak(name, n):
    """Prints the CPU seconds, and the most resident megabytes of this process, after a call of
    `LONG`, and before it.
    """
    before, begin = _most(), time.process_time()
    LONG[name][1](n)
    print(json.dumps(dict(n=n, seconds=time.process_time() - begin, before=before, most=_most())))


def _most():
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return round(int(line.split()[1]) / 1000)


def peaks(sizes):
    """(name, what `peak` says) of each call of each size, each in a process of its own."""
    for name, each in sizes.items():
        for n in each:
            code = f"from benchmarks import memory; memory.peak({name!r}, {n})"
            command = [sys.executable, "-W", "ignore", "-c", code]
            yield name, json.loads(subprocess.run(command, check=True, capture_output=True).stdout)


def held():
    """(mappings of memory, resident megabytes) of this process, on Linux."""
    resident = int(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return MAPS.read_bytes().count(b"\n"), round(resident / 1e6)


def run(names, budget):
    """(name, what `held` says after `jast.stress` of that system), one after the other; first
    "nothing", before all.
    """
    yield "nothing", held()
    for name in names:
        jast.stress(jax.random.key(0), CASES[name].make(), budget)
        yield name, held()


def long(args):
    """`peaks` in print."""
    episodes, simulations = (10**6, 10**7, 10**8), (90, 900, 9000)
    sizes = size(args, (episodes, simulations), (episodes[:2], simulations[:2]), ((10**4,), ()))
    rows = peaks(dict(zip(LONG, sizes)))
    if args.json:
        return print(json.dumps([[name, row] for name, row in rows]))
    print(f"{'call':<48}{'number':>11}{'CPU s':>7}{'MB before':>11}{'MB most':>9}")
    for name, row in rows:
        what = f"{name}, {LONG[name][0]}"
        numbers = f"{row['n']:>11}{row['seconds']:>7.0f}{row['before']:>11}{row['most']:>9}"
        print(f"{what:<48}{numbers}", flush=True)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    options(parser, quick="six systems")
    parser.add_argument("--keep", action="store_true", help="let no compiled program go")
    parser.add_argument("--long", action="store_true", help="long calls, each on its own")
    args = parser.parse_args(argv)
    if args.long:
        return long(args)
    names = size(args, list(CASES), list(TUNED), ["linear-10", "branches"])
    kept, memory.MAPS = memory.MAPS, 10**9 if args.keep else memory.MAPS
    try:
        rows = run(names, size(args, 5000, 1000, 300))
        if args.json:
            print(json.dumps(dict(rows)))
            return
        print(f"{'after':<16}{'mappings':>9}{'megabytes':>11}")
        for name, (mappings, megabytes) in rows:
            print(f"{name:<16}{mappings:>9}{megabytes:>11}", flush=True)
    finally:
        memory.MAPS = kept


if __name__ == "__main__":
    main()
