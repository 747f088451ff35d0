"""Many systems in one process: mappings of memory and resident memory after `jast.stress` met each:
``python -m benchmarks.memory [--json] [--quick | --smoke] [--keep]``. ``--keep`` lets no compiled
program go.
"""

import argparse
import json
import os
from pathlib import Path

import jax

import jast
from benchmarks.sizes import options, size
from benchmarks.stress_systems import CASES, TUNED
from jast import memory

__all__ = ["main"]

MAPS, PAGES = Path("/proc/self/maps"), Path("/proc/self/statm")


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


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    options(parser, quick="six systems")
    parser.add_argument("--keep", action="store_true", help="let no compiled program go")
    args = parser.parse_args(argv)
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
