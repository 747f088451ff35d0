"""What the driver of units costs, what a second worker gains, and whether killed calls go on to the
same result: ``python -m benchmarks.scale [--json] [--quick | --smoke]``.

``overhead``: CPU time of a call to that with a plain loop over the same units in its place.
``checkpoint``: CPU time with a checkpoint to that without. Runs of the two alternate; medians.
``workers``: wall time with one process to that with two, of an executor of spawned processes, on
the ferry (S0) and on a black box that waits for 5 ms. ``kills``: calls killed at random moments
(SIGKILL) and made again: how many gave the result of the uninterrupted call to the bit, and how
many units that had ended were not on disk.
"""

import argparse
import json
import multiprocessing
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import numpy as np  # noqa: E402

import jast  # noqa: E402
from benchmarks.sizes import options, size  # noqa: E402
from jast import places, units  # noqa: E402
from jast.blackbox import from_python  # noqa: E402
from jast.checkpoints import PARTS  # noqa: E402
from jast.distributions import Normal  # noqa: E402
from jast.ledger import records  # noqa: E402
from jast.simulators import ferry, landing  # noqa: E402

KEY, WAIT = jax.random.key(0), 0.005


def waits(disturbances):
    time.sleep(WAIT)
    return False, float(disturbances[0])


def calls(episodes, trees, budget):
    """Calls by name, with keywords as to how they run; by default 100,000, 200 and 100,000."""
    return {
        "nominal": lambda **how: jast.nominal(KEY, ferry(), episodes, **how),
        "monte_carlo": lambda **how: jast.search.monte_carlo(
            KEY, ferry(), episodes=episodes, refine=0, **how
        ),
        "forest": lambda **how: jast.search.forest(KEY, ferry(), trees=trees, refine=0, **how),
        "failure_probability": lambda **how: jast.estimate.failure_probability(
            KEY, landing(), budget, **how
        ),
    }


def plain(task, n, fold, state, watch, ways=units.HERE, **_):
    """`jast.units.run` as a loop: without threads, checkpoints and interrupts."""
    for number in range(n):
        result = jax.device_get(task.function(task.shared, number, places.Post()))
        state = fold(state, number, result)
    return units.Ran(state, n)


def looped(call):
    """``call`` with `plain` in the driver's place."""

    def run():
        kept, units.run = units.run, plain
        try:
            return call()
        finally:
            units.run = kept

    return run


def kept(call):
    """``call`` with a checkpoint of its own."""

    def run():
        with tempfile.TemporaryDirectory() as folder:
            return call(checkpoint=folder)

    return run


def ratio(one, other, repeats):
    """CPU seconds of ``other``, and by how much more or less ``one`` takes: medians of runs by
    turns.
    """
    one(), other()  # compile
    ratios, seconds = [], []
    for _ in range(repeats):
        times = []
        for run in (one, other):
            begin = time.process_time()
            run()
            times.append(time.process_time() - begin)
        ratios.append(times[0] / times[1] - 1)
        seconds.append(times[1])
    return dict(seconds=statistics.median(seconds), more=statistics.median(ratios))


def speedup(call, repeats):
    """Wall seconds with one worker, and that over the time with two."""
    spawn, times = multiprocessing.get_context("spawn"), []
    for workers in (1, 2):
        with ProcessPoolExecutor(workers, mp_context=spawn) as executor:
            call(executor=executor)  # compile
            call(executor=executor)
            each = []
            for _ in range(repeats):
                begin = time.perf_counter()
                call(executor=executor)
                each.append(time.perf_counter() - begin)
            times.append(statistics.median(each))
    return dict(seconds=times[0], speedup=times[0] / times[1])


def black_box(episodes):
    sim = from_python(waits, horizon=10, disturbance=Normal(0.0, 1.0))
    reward = jast.rewards.standard()  # needs no episodes before the search
    return lambda **how: jast.search.monte_carlo(
        KEY, sim, episodes=episodes, reward=reward, refine=0, **how
    )


def same(a, b):
    """Whether two results are the same to the bit."""
    a, b = (jax.tree.leaves(r._replace(settings=None)) for r in (a, b))
    equal = lambda x, y: np.asarray(x).tobytes() == np.asarray(y).tobytes()
    return len(a) == len(b) and all(map(equal, a, b))


CHILD = """
import sys
from benchmarks import scale
log, name, folder, *sizes = sys.argv[1:]
scale.logged(log)
scale.calls(*map(int, sizes))[name](checkpoint=folder)
"""


def logged(path):
    """From now on each unit that ends adds a byte to the file ``path``."""
    real, log = units.Task, open(path, "ab", buffering=0)

    def task(function, shared, like):
        def noted(*args):
            result = jax.device_get(function(*args))
            log.write(b".")
            return result

        return real(noted, shared, like)

    for module in list(sys.modules.values()):
        if getattr(module, "Task", None) is real and module.__name__.startswith("jast."):
            module.Task = task


def killed(name, sizes, moment, folder):
    """Units that had ended, and parts on disk, of a call whose process was killed ``moment``
    seconds after its first part; None where it was done before.
    """
    ended, checkpoint = Path(folder, "ended"), Path(folder, "run.jast")
    ended.touch()
    command = [sys.executable, "-W", "ignore", "-c", CHILD, ended, name, checkpoint, *sizes]
    process = subprocess.Popen([str(word) for word in command])
    while not parts(checkpoint) and process.poll() is None:
        time.sleep(0.002)
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        process.kill()
    if process.wait() == 0:
        return None
    found = parts(checkpoint)
    return ended.stat().st_size, sum(not name.startswith("answer") for name in found)


def parts(checkpoint):
    """Names of the parts in the folder, where it is there yet."""
    path = checkpoint / PARTS
    return [r.header["name"] for r in records(path)] if path.exists() else []


def kills(name, sizes, runs, longest):
    """``runs`` calls, each killed once and made again."""
    call, rng = calls(*sizes)[name], random.Random(0)
    whole, met, lost, equal = call(), 0, 0, 0
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            seen = killed(name, sizes, rng.uniform(0, longest), folder)
            if seen is not None:
                met, lost = met + 1, max(lost, seen[0] - seen[1])
            equal += same(call(checkpoint=Path(folder, "run.jast")), whole)
    return dict(runs=runs, killed=met, equal=equal, most_units_lost=lost)


def report(args):
    sizes = size(args, (100_000, 200, 100_000), (100_000, 16, 20_000), (2000, 8, 5000))
    repeats, names = size(args, 15, 3, 1), size(args, None, None, ["nominal"])
    found = dict(overhead={}, checkpoint={}, workers={}, kills={})
    for name in names or calls(*sizes):
        call = calls(*sizes)[name]
        found["overhead"][name] = ratio(call, looped(call), repeats)
        found["checkpoint"][name] = ratio(kept(call), call, repeats)
    if not args.smoke:
        n, episodes, repeats = size(args, (4_000_000, 1280, 5), (1_000_000, 640, 1), None)
        of_ferry = lambda **how: jast.nominal(KEY, ferry(), n, **how)
        found["workers"]["S0"] = speedup(of_ferry, repeats)
        found["workers"]["black box, 5 ms"] = speedup(black_box(episodes), repeats)
    runs, longest = size(args, (25, 1.5), (2, 0.5), (1, 0.1))
    for name in names or size(args, list(calls(*sizes)), ["nominal", "forest"], None):
        found["kills"][name] = kills(name, sizes, runs, longest)
    return found


def table(found):
    lines = ["| call | CPU s | driver | checkpoint |", "|---|---|---|---|"]
    for name, cost in found["overhead"].items():
        kept = found["checkpoint"][name]["more"]
        lines.append(f"| {name} | {cost['seconds']:.2f} | {cost['more']:+.1%} | {kept:+.1%} |")
    lines += ["", "| system | s, one worker | speedup of two |", "|---|---|---|"]
    for name, gain in found["workers"].items():
        lines.append(f"| {name} | {gain['seconds']:.2f} | {gain['speedup']:.2f} |")
    lines += ["", "| call | killed | equal | most units lost |", "|---|---|---|---|"]
    for name, of in found["kills"].items():
        killed = f"{of['killed']} of {of['runs']}"
        lines.append(f"| {name} | {killed} | {of['equal']} | {of['most_units_lost']} |")
    return "\n".join(lines)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args = options(parser, "less of everything: two kills of two calls").parse_args(argv)
    found = report(args)
    print(json.dumps(found, indent=1) if args.json else table(found))


if __name__ == "__main__":
    main()
