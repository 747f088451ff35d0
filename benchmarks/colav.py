"""The ferry with collision avoidance: how often it fails by itself, what the searches find, and
what keeping its states is worth.

``python -m benchmarks.colav [--json] [--quick | --smoke]``. The searches have 22 roots of 50
simulations, as published for S1. Rates have 95 % Clopper-Pearson intervals. The CPU time of a
search is that of its one call, compilation included. Those of memoization are of one core,
compilation excluded, the best of alternated runs (of one with ``--quick``), in a process whose XLA
has one thread.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

import jast
from benchmarks.engine import cpu, problem, whole
from benchmarks.sizes import (
    in_fresh_process,
    in_this_process,
    options,
    print_report,
    printer,
    size,
    timed,
)
from jast._src.core.counter_prng import tree_keys
from jast._src.util.intervals import clopper_pearson
from jast.simulators.colav import SCENARIOS, colav

REWARD = jast.rewards.standard(event_bonus=200.0, density="mode")
PRUNES = 22  # published
SIMULATIONS = 50  # of a root: published
ALL = ("delay", "steering", "noise")
SUBSTEPS = (1, 3, 10, 30, 100, 300)


def published(log_p, event, distance, terminal, approach):
    """The reward of S1: ten times the log densities, and 200 for a collision or less 50 times the
    miss distance.
    """
    return 10 * log_p + jnp.where(terminal, jnp.where(event, 200.0, -50 * distance), 0)


published.density = "mode"


def nominal(scenario, kind, episodes, substeps):
    """How often the system fails when disturbances are drawn from their densities."""
    sim = colav(scenario, kind, substeps=substeps)
    found = jast.nominal(jax.random.key(0), sim, episodes=episodes)
    quiet = found.undisturbed
    return {
        "undisturbed_distance_m": float(quiet.distance),
        "undisturbed_fails": bool(quiet.failure),
        "episodes": found.episodes,
        "failures": found.failing,
        "rate": found.rate,
        "rate_95": list(found.interval),
        "mean_distance_m": found.mean_distance,
    }


def share(failing):
    """How many of several runs found a collision."""
    found, n = int(np.sum(failing)), len(failing)
    ends = list(clopper_pearson(found, n))
    return {"runs": n, "failing": found, "share": found / n, "share_95": ends}


def search(scenario, kind, trees, substeps, heads=None, prunes=PRUNES):
    """Trees of the default search that find a collision."""
    sim = colav(scenario, kind, substeps=substeps)
    sizes = dict(trees=trees, prunes=prunes, simulations=SIMULATIONS)
    how = dict(reward=REWARD, actions=jast.actions.samples(), heads=heads)
    result, seconds, _ = timed(lambda: jast.search.forest(jax.random.key(0), sim, **sizes, **how))
    best = {"best": float(result.best.reward), "best_distance_m": float(result.best.distance)}
    cost = {"episodes": result.episodes, "steps": result.steps, "cpu_s": seconds}
    return share(result.failing_per_tree) | best | cost


def random_search(scenario, kind, runs, substeps, episodes=PRUNES * SIMULATIONS):
    """Random searches of as many episodes as a tree has simulations that find a collision."""
    sim = colav(scenario, kind, substeps=substeps)

    def one(key):
        found = jast.search.monte_carlo(key, sim, episodes=episodes, reward=REWARD)
        return found.failing_per_tree[0]

    keys = jax.random.split(jax.random.key(1), runs)
    return share(jax.jit(lambda keys: jax.lax.map(one, keys))(keys))


def memoization(
    substeps, mode, simulations, trees, repeats, prunes=PRUNES, memoize=("node", "root", "none")
):
    """CPU microseconds and simulator steps of a simulation, by where states are kept; and of
    MCTS-SA, one root, whose simulations all begin at the start.
    """
    total = prunes * simulations
    sim, reward = colav("sharp turn", substeps=substeps), published if mode == "paper" else REWARD
    p = problem(total, mode, sim, reward, jast.actions.samples())
    keys = tree_keys(jax.random.key(0), trees)
    children = int(p.settings.widths.max())
    runs = {
        name: functools.partial(whole, p, keys, prunes, simulations, children, name)
        for name in memoize
    }
    runs["MCTS-SA"] = functools.partial(whole, p, keys, 1, total, children, "none")
    steps = {name: float(np.mean(play().steps)) / total for name, play in runs.items()}
    seconds = {name: float("inf") for name in runs}
    for _ in range(repeats):
        for name, function in runs.items():
            seconds[name] = min(seconds[name], cpu(function)[0])
    us = {name: s / total / trees * 1e6 for name, s in seconds.items()}
    ratios = {
        f"{a}/{b}": us[a] / us[b] for a, b in itertools.product(memoize[:-1], ("none", "MCTS-SA"))
    }
    about = dict(mode=mode, simulations=simulations, trees=trees, substeps=substeps)
    return about | dict(us=us, steps=steps, ratios=ratios)


def picture(rows, path):
    """Figure 5 of the paper, measured: the CPU time of a simulation by the substeps of a step."""
    from jast._src.plot import style

    labels = {
        "MCTS-SA": "MCTS-SA, full simulations",
        "none": "forest, no states",
        "root": "states at roots",
        "node": "states at every node",
    }
    with style.axes(None, (6.8, 4.2)) as ax:
        substeps = [r["substeps"] for r in rows]
        looks = zip(labels.items(), style.COLOURS, "osD^", strict=False)
        for (name, label), colour, marker in looks:
            us = [r["us"][name] for r in rows]
            ax.loglog(substeps, us, color=colour, marker=marker, label=label)
        ax.set(xlabel="substeps of a search step", ylabel="CPU time of a simulation (µs)")
        ax.legend(loc="upper left")
        ax.figure.savefig(path, dpi=120)


def main(argv=None):
    parser = options(__doc__, "fewer episodes, trees and rows: under two minutes")
    parser.add_argument(
        "--memoization", action="store_true", help="only what keeping states is worth"
    )
    parser.add_argument(
        "--substeps",
        type=int,
        default=30,
        help="of a search step, but for memoization: 30 by the published code, 20 by its text",
    )
    parser.add_argument("--picture", help="draw the CPU time by substeps to this file")
    args = parser.parse_args(argv)
    say = printer(args)

    def percent(r, name):
        low, high = (100 * v for v in r[f"{name}_95"])
        return f"{100 * r[name]:6.1f} % [{low:.1f}, {high:.1f}]"

    report = {"nominal": {}, "searches": {}, "memoization": []}
    measure = in_this_process if args.smoke else in_fresh_process
    say("nominal: least distance undisturbed, and failures among episodes as the model draws them")
    few = [*SCENARIOS][:1] if args.smoke else SCENARIOS
    for scenario in () if args.memoization else few:
        for kind in size(args, (*ALL, ALL), ("delay", "steering"), ("delay",)):
            name = f"{scenario}, {kind if isinstance(kind, str) else 'all three'}"
            episodes = size(args, 300_000, 20_000, 100)
            r = report["nominal"][name] = nominal(scenario, kind, episodes, args.substeps)
            low, high = r["rate_95"]
            say(
                f"  {name:26} {r['undisturbed_distance_m']:6.2f} m   {r['failures']:6d} of"
                f" {r['episodes']}, {r['rate']:.2e} [{low:.1e}, {high:.1e}]"
            )

    say(
        f"\ntrees of {PRUNES} x {SIMULATIONS} that find a collision, and random searches of as many"
        " episodes"
    )
    rows = [(s, k) for k in ("delay", "steering") for s in SCENARIOS]
    two = [("sharp turn", "delay"), ("head-on", "steering")]
    for scenario, kind in () if args.memoization else size(args, rows, two, two[:1]):
        trees, prunes = size(args, 200, 64, 4), 2 if args.smoke else PRUNES
        r = {
            "random": random_search(scenario, kind, trees, args.substeps, prunes * SIMULATIONS),
            "forest": search(scenario, kind, trees, args.substeps, prunes=prunes),
        }
        if not (args.quick or args.smoke):
            r["forest, heads"] = search(scenario, kind, trees, args.substeps, heads="both")
        report["searches"][f"{scenario}, {kind}"] = r
        for name, row in r.items():
            more = ""
            if "best" in row:
                near, cpu_s = row["best_distance_m"], row["cpu_s"]
                more = f"best {row['best']:8.2f}, {near:.2f} m, {cpu_s:.0f} CPU s"
            say(f"  {scenario + ', ' + kind:26} {name:14} {percent(row, 'share'):24} {more}")

    say("\nCPU time of a simulation (us) and its steps, by where states are kept")
    if args.smoke:
        # the program of the search
        calls = [(1, "default", SIMULATIONS, 4, 1, 2, ["node", "none"])]
    elif args.quick:
        calls = [(30, "paper", 20, 64, 1)]
    else:
        calls = [(30, mode, n, 128, 2) for mode in ("default", "paper") for n in (20, 50)]
        calls += [(n, "paper", 20, 64, 2) for n in SUBSTEPS]
    for call in calls:
        report["memoization"].append(r := measure("memoization", *call, module="colav"))
        us, steps = r["us"], r["steps"]
        cells = ", ".join(f"{name} {us[name]:.1f} ({steps[name]:.1f})" for name in us)
        ratios = ", ".join(f"{name} {value:.2f}" for name, value in r["ratios"].items())
        say(
            f"  {r['substeps']:3d} substeps, {r['mode']}, {PRUNES} x {r['simulations']},"
            f" {r['trees']} trees: {cells}; {ratios}"
        )
    if args.picture:
        picture(report["memoization"][-len(SUBSTEPS) :], args.picture)
    print_report(args, report)


if __name__ == "__main__":
    main()
