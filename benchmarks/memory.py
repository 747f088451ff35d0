"""Many systems in one process: mappings of memory and resident memory after `jast.stress` met each:
``python -m benchmarks.memory [--json] [--quick | --smoke] [--keep | --long]``. ``--keep`` lets no
compiled program go. ``--long``: instead, the most memory that long calls on the ferry hold, each in
a process of its own, as they become longer.
"""

import os
from pathlib import Path

import jax

import jast
from benchmarks.sizes import in_fresh_process, options, print_report, printer, size, timed
from benchmarks.stress_systems import CASES, TUNED
from jast._src.runtime import memory
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
    """CPU seconds, and the most resident megabytes of this process, after a call of `LONG`, and
    before it.
    """
    before = _most()
    _, seconds, _ = timed(lambda: LONG[name][1](n))
    return dict(n=n, seconds=seconds, before=before, most=_most())


def _most():
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return round(int(line.split()[1]) / 1000)


def peaks(sizes):
    """(name, what `peak` says) of each call of each size, each in a process of its own."""
    for name, each in sizes.items():
        for n in each:
            yield name, in_fresh_process("peak", name, n, module="memory", settings={})


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
    say, rows = printer(args), []
    say(f"{'call':<48}{'number':>11}{'CPU s':>7}{'MB before':>11}{'MB most':>9}")
    for name, row in peaks(dict(zip(LONG, sizes))):
        rows.append([name, row])
        what = f"{name}, {LONG[name][0]}"
        numbers = f"{row['n']:>11}{row['seconds']:>7.0f}{row['before']:>11}{row['most']:>9}"
        say(f"{what:<48}{numbers}")
    print_report(args, rows)


def main(argv=None):
    parser = options(__doc__, "six systems")
    parser.add_argument("--keep", action="store_true", help="let no compiled program go")
    parser.add_argument("--long", action="store_true", help="long calls, each on its own")
    args = parser.parse_args(argv)
    if args.long:
        return long(args)
    names = size(args, list(CASES), list(TUNED), ["linear-10", "branches"])
    kept, memory.MAPS = memory.MAPS, 10**9 if args.keep else memory.MAPS
    say, rows = printer(args), {}
    say(f"{'after':<16}{'mappings':>9}{'megabytes':>11}")
    try:
        for name, numbers in run(names, size(args, 5000, 1000, 300)):
            rows[name] = numbers
            say("{:<16}{:>9}{:>11}".format(name, *numbers))
    finally:
        memory.MAPS = kept
    print_report(args, rows)


if __name__ == "__main__":
    main()
