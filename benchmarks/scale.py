"""What the driver of units costs, what a second worker gains, and whether killed calls go on to the
same result: ``python -m benchmarks.scale [--json] [--quick | --smoke] [--costs] [--kills N]
[--calls NAME ...]``.

``overhead``: CPU time of a call to that with a plain loop over the same units in its place, both
in one thread.
``checkpoint``: CPU time with a checkpoint to that without. Runs of the two alternate; medians.
``workers``: wall time with one process to that with two, of an executor of spawned processes, on
the ferry (S0) and on a black box that waits for 5 ms. ``kills``: calls killed at random moments
(SIGKILL) and made again: how many gave the result of the uninterrupted call to the bit, and how
many units that had ended were not on disk.

``--costs``: only the first two. ``--kills N``: only kills, N in all, also of the chains, whose
steps depend on one another: a forest with heads, a training, a validation.
"""

import multiprocessing
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import jax
import numpy as np

import jast
from benchmarks.sizes import options, print_report, size, timed
from jast._src.runtime import backends
from jast._src.runtime import work as units
from jast._src.runtime.checkpoints import PARTS, read_records
from jast.blackbox import from_python
from jast.distributions import Normal
from jast.simulators import ferry, landing
from jast.weakness import default

KEY = jax.random.key(0)
WAIT = 0.005  # s that a black box takes


def waits(disturbances):
    time.sleep(WAIT)
    return False, float(disturbances[0])


def calls(episodes, trees, budget):
    """Calls by name, with keywords as to how they run; at full size 1,000,000, 200 and 100,000."""
    return {
        "nominal": lambda **how: jast.nominal(KEY, ferry(), episodes, **how),
        "monte_carlo": lambda **how: jast.search.monte_carlo(
            KEY, ferry(), episodes=episodes, refine=0, **how
        ),
        "forest": lambda **how: jast.search.forest(
            KEY, ferry(), trees=trees, refine=0, threads=1, lanes=trees // 4, **how
        ),
        "failure_probability": lambda **how: jast.estimate.failure_probability(
            KEY, landing(), budget, **how
        ),
    }


def guessed(inputs):
    """A classifier that answers in 5 ms."""
    time.sleep(WAIT)
    return (inputs.sum(axis=1) > 0).astype(int)


def validated(**how):
    inputs = np.random.default_rng(0).normal(size=(400, 3))
    labels = (inputs[:, 0] > 0).astype(int)
    selector = default(first=40, growth=0.0)
    return jast.weakness.validate(KEY, guessed, inputs, labels, selector=selector, **how)


def chains():
    """Calls by name, of which all or a part is no sum of units."""
    return {
        "sac": lambda **how: jast.policies.sac(
            KEY, landing(), episodes=800, lanes=8, hidden=(32, 32), batch=64, updates=1, **how
        ),
        "validate": validated,
        "forest with heads": lambda **how: jast.search.forest(
            KEY, ferry(), trees=8, prunes=4, simulations=200, lanes=2, heads="rollout", **how
        ),
    }


def plain(task, n, fold, state, watch, ways=units.HERE, **_):
    """`runtime.work.run` as a loop: without threads, checkpoints and interrupts."""
    for number in range(n):
        result = jax.device_get(task.function(task.shared, number, backends.UnitContext()))
        state = fold(state, number, result)
    return units.UnitsRun(state, n)


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
            times.append(timed(run)[1])
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
            each = [timed(lambda: call(executor=executor))[2] for _ in range(repeats)]
            times.append(statistics.median(each))
    return dict(seconds=times[0], speedup=times[0] / times[1])


def black_box(episodes):
    sim = from_python(waits, horizon=10, disturbance=Normal(0.0, 1.0))
    reward = jast.rewards.standard()  # needs no episodes before the search
    return lambda **how: jast.search.monte_carlo(
        KEY, sim, episodes=episodes, reward=reward, refine=0, **how
    )


def same(a, b):
    """Whether two results are the same to the bit; their settings and functions aside."""
    a, b = (jax.tree.leaves(_numbers(r)) for r in (a, b))
    as_bytes = [[np.asarray(x).tobytes() for x in leaves] for leaves in (a, b)]
    return as_bytes[0] == as_bytes[1]


def _numbers(result):
    if isinstance(result, jast.policies.FailurePolicy):
        return result.learned, result.history
    heads = getattr(result, "heads", None)
    if heads is not None:
        result = result._replace(heads=(heads.policy.params, heads.inputs, heads.returns))
    return result._replace(settings=None) if "settings" in result._fields else result


ALL = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
CHILD = """
import sys
from benchmarks import scale
log, name, folder, *sizes = sys.argv[1:]
scale.logged(log)
(scale.calls(*map(int, sizes)) | scale.chains())[name](checkpoint=folder)
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


def killed(name, sizes, moment, folder, programs):
    """Units that had ended, and parts on disk, of a call whose process was killed ``moment``
    seconds after it had begun to keep any; None where it was done before. ``programs``: a folder
    of compiled ones, as all these processes compile the same.
    """
    ended, checkpoint = folder / "ended", folder / "run.jast"
    ended.touch()
    command = [sys.executable, "-W", "ignore", "-c", CHILD, ended, name, checkpoint, *sizes]
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": programs} | ALL
    process = subprocess.Popen([str(word) for word in command], env=env)

    def begun():
        return parts(checkpoint) or (checkpoint / "state.jast").exists()

    while not begun() and process.poll() is None:
        time.sleep(0.002)
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        process.kill()
    if process.wait() == 0:
        return None
    units = [name for name in parts(checkpoint) if not name.startswith("answer")]
    return ended.stat().st_size, len(units)


def parts(checkpoint):
    """Names of the parts in the folder, where it is there yet."""
    path = checkpoint / PARTS
    return [r.header["name"] for r in read_records(path)] if path.exists() else []


def kills(name, sizes, runs):
    """``runs`` calls, each killed once, at a moment of the time that it takes, and made again."""
    call, rng = (calls(*sizes) | chains())[name], random.Random(0)
    whole = call()
    _, _, longest = timed(call)  # compiled by now
    met, lost, equal = 0, 0, 0
    with tempfile.TemporaryDirectory() as all_folders:
        for i in range(runs):
            folder = Path(all_folders, str(i))
            folder.mkdir()
            seen = killed(name, sizes, rng.uniform(0, longest), folder, f"{all_folders}/programs")
            if seen is not None:
                met, lost = met + 1, max(lost, seen[0] - seen[1])
            equal += same(call(checkpoint=folder / "run.jast"), whole)
    return dict(runs=runs, killed=met, equal=equal, most_units_lost=lost)


def many_kills(n, names):
    """`kills` of these calls, ``n`` in all; tells of each as it ends, as this takes long."""
    sizes, found = (300_000, 16, 20_000), {}
    names = names or [*calls(*sizes), *chains()]
    for i, name in enumerate(names):
        if runs := n // len(names) + (i < n % len(names)):
            found[name] = kills(name, sizes, runs)
            print(name, found[name], file=sys.stderr, flush=True)
    return found


def report(args):
    sizes = size(args, (1_000_000, 200, 100_000), (100_000, 16, 20_000), (2000, 8, 5000))
    names = size(args, None, None, ["nominal"])
    found = costs(sizes, names or calls(*sizes), size(args, 9, 3, 1))
    if args.costs:
        return found
    if not args.smoke:
        n, episodes, repeats = size(args, (4_000_000, 1280, 5), (1_000_000, 640, 1), None)
        of_ferry = partial(jast.nominal, KEY, ferry(), n)
        waiting = speedup(black_box(episodes), repeats)
        found["workers"] = {"S0": speedup(of_ferry, repeats), "black box, 5 ms": waiting}
    each = names or size(args, list(calls(*sizes)), ["nominal", "forest"], None)
    found["kills"] = {name: kills(name, sizes, size(args, 25, 2, 1)) for name in each}
    return found


def costs(sizes, names, repeats):
    """What the driver and a checkpoint cost these calls."""
    found = dict(overhead={}, checkpoint={})
    for name in names:
        call = calls(*sizes)[name]
        found["overhead"][name] = ratio(call, looped(call), repeats)
        found["checkpoint"][name] = ratio(kept(call), call, repeats)
    return found


def tables(found):
    """What was found, as text."""
    parts = []
    if "overhead" in found:
        rows = ["| call | CPU s | driver | checkpoint |", "|---|---|---|---|"]
        for name, cost in found["overhead"].items():
            kept = found["checkpoint"][name]["more"]
            rows.append(f"| {name} | {cost['seconds']:.2f} | {cost['more']:+.1%} | {kept:+.1%} |")
        parts.append(rows)
    if "workers" in found:
        rows = ["| system | s, one worker | speedup of two |", "|---|---|---|"]
        for name, gain in found["workers"].items():
            rows.append(f"| {name} | {gain['seconds']:.2f} | {gain['speedup']:.2f} |")
        parts.append(rows)
    if "kills" in found:
        rows = ["| call | killed | equal | most units lost |", "|---|---|---|---|"]
        for name, of in found["kills"].items():
            killed = f"{of['killed']} of {of['runs']}"
            rows.append(f"| {name} | {killed} | {of['equal']} | {of['most_units_lost']} |")
        parts.append(rows)
    return "\n\n".join(map("\n".join, parts))


def main(argv=None):
    parser = options(__doc__, "less of everything: two kills of two calls")
    parser.add_argument("--costs", action="store_true", help="only the driver and a checkpoint")
    parser.add_argument("--kills", type=int, metavar="N", help="only kills, N in all")
    parser.add_argument("--calls", nargs="+", metavar="NAME", help="of these calls; default: all")
    args = parser.parse_args(argv)
    found = report(args) if args.kills is None else dict(kills=many_kills(args.kills, args.calls))
    print_report(args, found, tables(found))


if __name__ == "__main__":
    from benchmarks import scale  # a checkpoint knows functions by the module's own name

    scale.main()
