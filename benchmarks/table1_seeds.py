"""Table 1 of the MCFS-AP paper over seeds: the share of failing trees of each seed, its mean and
standard deviation, by the published code and by the published text.

``python -m benchmarks.table1_seeds [--json] [--quick | --smoke] [--seeds N] [--trees N] [--rows
NAME ...]``. A row is a variant and a mode of its heads (`jast.heads.settings`); "tree" behind it:
statistics of roots are counted at the end of the tree; "mcts" is MCTS-SA, a tree without prunes.
The trees of a seed with heads are one sequence, taught after each tree (but for -/VN by the code,
whose head stays as it was made), so they are not independent: a run is one figure. Every tree has
18 x 500 simulations.
"""

import sys

import jax
import numpy as np

import jast
from benchmarks.ferry import BOX, REWARD, TABLE
from benchmarks.sizes import add_choices, options, print_report, printer, size, timed

VARIANTS = {"mcts": "MCTS-SA", "none": "-/-", "rollout": "RP/-", "value": "-/VN", "both": "RP/VN"}
"""The search or its heads: the paper's name of the row."""
ROWS = {
    "mcts": (None, "code", "turn"),
    "none": (None, "code", "turn"),
    **{
        f"{heads}, {mode}": (heads, mode, "turn")
        for mode in ("code", "text")
        for heads in [*VARIANTS][2:]
    },
    "rollout, code, tree": ("rollout", "code", "tree"),
}


def search(row, trees, simulations):
    """The search of a row, by its key."""
    heads, mode, counted = ROWS[row]
    more = {}
    if heads is not None:
        settings = jast.heads.settings(mode, counted=counted)
        # that row's head is never trained: its trees are the same to the bit, all at once
        idle = settings.untrained_alone and heads == "value"
        more = dict(heads=heads, head_settings=settings._replace(train=not idle))
    common = dict(trees=trees, mode=mode, reward=REWARD, actions=BOX)
    if row == "mcts":
        sim = jast.simulators.ferry()
        return lambda key: jast.search.mcts(key, sim, simulations=18 * simulations, **common)
    sim = jast.simulators.ferry(observation=mode)
    return lambda key: jast.search.forest(
        key, sim, prunes=18, simulations=simulations, **common, **more
    )


def summary(bests, cpu):
    """The row of several seeds, by the best rewards [seeds, trees]."""
    rates = np.mean(bests > 0, axis=1)

    def over(values):
        return {
            "mean": float(values.mean()),
            "sd": float(values.std(ddof=1)) if len(values) > 1 else None,
        }

    return {
        "rates": rates.tolist(),
        "rate": over(rates),
        "mean_best": over(bests.mean(axis=1)),
        "best": float(bests.max()),
        "cpu_s_a_seed": cpu / len(bests),
    }


def main(argv=None):
    parser = options(__doc__, "2 seeds of 8 trees: under two minutes")
    parser.add_argument("--seeds", type=int, help="default 10")
    parser.add_argument("--trees", type=int, help="of a seed; default 200, as published")
    add_choices(parser, "--rows", ROWS)
    args = parser.parse_args(argv)
    seeds, trees = args.seeds or size(args, 10, 2, 2), args.trees or size(args, 200, 8, 2)
    rows = args.rows or size(args, [*ROWS], [*ROWS], ["rollout, code, tree"])
    simulations = 10 if args.smoke else 500
    say = printer(args)
    say(f"{seeds} seeds of {trees} trees, 18 x {simulations} simulations; % of failing trees")
    out = {}
    for row in rows:
        find, bests, cpu = search(row, trees, simulations), [], 0.0
        for seed in range(seeds):
            result, seconds, _ = timed(lambda seed=seed, find=find: find(jax.random.key(seed)))
            bests.append(np.asarray(result.best_reward_per_tree, np.float64))
            cpu += seconds
            share = 100 * np.mean(bests[-1] > 0)
            print(  # a row takes many minutes
                f"    {row}, seed {seed}: {share:.1f} %, {seconds:.0f} CPU s",
                file=sys.stderr,
                flush=True,
            )
        r = out[row] = summary(np.stack(bests), cpu)
        spread = "" if r["rate"]["sd"] is None else f" +- {100 * r['rate']['sd']:.1f} (SD)"
        printed = TABLE[VARIANTS[row.split(",")[0]]]
        say(
            f"  {row:20} {100 * r['rate']['mean']:5.1f}{spread},"
            f" {100 * min(r['rates']):.1f} to {100 * max(r['rates']):.1f};"
            f" mean best {r['mean_best']['mean']:.2f}, best {r['best']:.2f};"
            f" printed {printed[0]}, {printed[1]:.2f}, {printed[2]:.2f};"
            f" {r['cpu_s_a_seed']:.0f} CPU s a seed"
        )
    print_report(args, out)


if __name__ == "__main__":
    main()
