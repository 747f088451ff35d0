"""The ferry S0: golden episodes, the paper's Table 1 without networks, and what the default search
makes of it.

``python -m benchmarks.ferry [--json] [--quick | --smoke] [--trees N]``. Every tree has 9000
simulations. Rates have 95 % Clopper-Pearson intervals, means 1.96 standard errors. Published rows:
Lytskjold and Mengshoel, Table 1, 200 trees each. ``--table1 [--seeds N] [--picture PATH]``: all of
that table, networks included, and where they pay (`benchmarks.table1`).
"""

import json
import pathlib
from functools import partial

import jax
import numpy as np

import jast
from benchmarks.sizes import options, print_report, printer, size, timed
from jast._src.util.intervals import clopper_pearson

DATA = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data" / "ferry"
REWARD = jast.rewards.standard(event_bonus=30.0, density="mode")
BOX = jast.actions.uniform(0.0, 1.0)
TABLE = {  # as printed in the paper: share of failing trees in %, mean best reward, best
    "-/-": (29.5, 1.927, 28.061),
    "MCTS-SA": (35.5, 2.304, 28.245),
    "RP/-": (37.0, 4.776, 28.650),
    "-/VN": (20.5, -1.426, 28.784),
    "RP/VN": (39.0, 5.818, 29.092),
}
PUBLISHED = {"forest, paper": TABLE["-/-"], "mcts, paper": TABLE["MCTS-SA"]}


def data(name):
    """What a file of published results holds, or None where it is absent."""
    path = DATA / name
    return json.loads(path.read_text()) if path.exists() else None


def golden():
    """Greatest error of the rewards of the published episodes, in float32 and float64; None where
    the data is absent.
    """
    if (found := data("golden_episodes.json")) is None:
        return None
    episodes, errors = found["episodes"], {}
    for bits in (32, 64):
        with jax.enable_x64(bits == 64):
            sim = jast.simulators.ferry()
            replayed = [jast.replay(sim, np.array(e["seeds"]), reward=REWARD) for e in episodes]
        off = [float(r.reward) - e["reward"] for r, e in zip(replayed, episodes, strict=True)]
        errors[f"float{bits}"] = float(np.abs(off).max())
    return {"episodes": len(episodes), "greatest_error": errors}


def outcome(best):
    """What trees found, by the reward of each one's best episode."""
    n, failing = best.size, int(np.sum(best > 0))
    return {
        "trees": n,
        "rate": failing / n,
        "rate_95": list(clopper_pearson(failing, n)),
        "mean_best": best.mean(),
        "mean_best_95": 1.96 * best.std() / np.sqrt(n),
        "mean_best_failing": best[best > 0].mean() if failing else None,
        "best": best.max(),
    }


def row(search, seed):
    """One row: what a search of many trees found."""
    result, cpu, wall = timed(lambda: search(jax.random.key(seed)))
    best = np.asarray(result.best_reward_per_tree, np.float64)
    runs = [best[i : i + 200].max() for i in range(0, best.size - 199, 200)]
    return outcome(best) | {
        "best_of_200": [min(runs), float(np.median(runs)), max(runs)] if runs else None,
        "failing_episodes": result.failing_share,
        "episodes": result.episodes,
        "steps": result.steps,
        "cpu_s": cpu,
        "wall_s": wall,
        "failing_trees_per_cpu_s": int(np.sum(best > 0)) / cpu,
    }


def rows(trees, prunes=18, simulations=500):
    """Name -> search of S0 (and S0b)."""
    s0, s0b = jast.simulators.ferry(), jast.simulators.ferry(adversary=(17.0, 0.0))

    common = dict(trees=trees, reward=REWARD, actions=BOX)

    def forest(sim=s0, **settings):
        sizes = dict(prunes=prunes, simulations=simulations)
        return partial(jast.search.forest, sim=sim, **(common | sizes | settings))

    def mcts(**settings):
        total = prunes * simulations
        return partial(jast.search.mcts, sim=s0, simulations=total, **common, **settings)

    return {
        "forest, paper": forest(mode="paper"),
        "mcts, paper": mcts(mode="paper"),
        "forest, default": forest(),
        "forest, draws of the model": forest(actions=jast.actions.samples()),
        "mcts, default": mcts(),
        "forest, S0b, paper": forest(s0b, mode="paper"),
        "forest, S0b, default": forest(s0b),
        "monte carlo": lambda key: jast.search.monte_carlo(
            key, s0, episodes=prunes * simulations * trees, reward=REWARD, actions=BOX
        ),
        "forest, widening (2, 0.5) alone": forest(spread=False, focus=1.0),
        "forest, and spread": forest(focus=1.0),
        "cem": lambda key: jast.search.cem(key, s0, trees=trees, reward=REWARD, actions=BOX),
    }


QUICK = ("forest, widening (2, 0.5) alone", "forest, and spread", "cem")
"""Rows that ``--quick`` leaves out."""
SMOKE = ("forest, paper", "mcts, paper", "monte carlo", "cem")
"""Rows of ``--smoke``, one of each search."""


def main(argv=None):
    parser = options(__doc__, "100 trees a row; of --table1 also fewer rows")
    parser.add_argument("--trees", type=int, help="trees a row (default 1000; of --table1 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--table1",
        action="store_true",
        help="the paper's Table 1 with networks, and where they pay",
    )
    parser.add_argument(
        "--seeds", type=int, help="of --table1: seeds a row, from --seed on (default 3)"
    )
    parser.add_argument(
        "--picture", help="of --table1: also measure slower simulators, and draw to this file"
    )
    args = parser.parse_args(argv)
    if args.table1:
        from benchmarks import table1

        return table1.report(args)
    say, trees = printer(args), args.trees or size(args, 1000, 100, 2)
    report = {"golden": golden(), "seed": args.seed, "rows": {}}
    say("golden episodes:", report["golden"] or "data not found")
    say(
        f"{'search':32} {'trees':>5} {'rate %':>7} {'95 %':>13} {'mean best':>15} {'best':>7}"
        f" {'of 200: least, median':>21} {'CPU s':>7}"
    )
    table = rows(trees, *((2, 45) if args.smoke else ()))
    for name in size(args, [*table], [name for name in table if name not in QUICK], SMOKE):
        report["rows"][name] = r = row(table[name], args.seed)
        low, high = (100 * v for v in r["rate_95"])
        of_200 = "{:.3f}, {:.3f}".format(*r["best_of_200"][:2]) if r["best_of_200"] else "-"
        mean = f"{r['mean_best']:.2f} +- {r['mean_best_95']:.2f}"
        say(
            f"{name:32} {r['trees']:5d} {100 * r['rate']:7.1f} {low:5.1f} to {high:5.1f}"
            f" {mean:>15} {r['best']:7.3f} {of_200:>21} {r['cpu_s']:7.1f}"
        )
        if name in PUBLISHED:
            rate, mean, best = PUBLISHED[name]
            say(f"{'  published':32} {200:5d} {rate:7.1f} {'':14} {mean:14.2f} {best:7.3f}")
    print_report(args, report)


if __name__ == "__main__":
    main()
