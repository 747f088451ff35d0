"""Table 1 of the MCFS-AP paper with its networks, and where heads pay: ``python -m benchmarks.ferry
--table1``.

A row pools the trees of some seeds. Its interval takes them as independent; those of one seed share
their heads, so the seeds' own rates stand beside it. Speeds are of whole calls, training and result
included, without compilation: a call before each row (`warm_up`) compiles the same programs.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np

import jast
from benchmarks import engine
from benchmarks.ferry import BOX, REWARD, TABLE, data, golden, outcome
from benchmarks.sizes import print_report, printer, size, timed
from jast._src.core.counter_prng import tree_keys
from jast._src.search.tree.memory import LANES
from jast._src.util.intervals import clopper_pearson

VARIANTS = {"-/-": None, "MCTS-SA": None, "RP/-": "rollout", "-/VN": "value", "RP/VN": "both"}
HEADS = {"none": None, "rollout": "rollout", "value": "value", "both": "both"}
# simulations per CPU second of the published code, on cores like these
SPEED = {"-/-": 14_000, "MCTS-SA": 10_700, "RP/-": 663, "-/VN": 535, "RP/VN": 239}


class Sizes(NamedTuple):
    """How much is measured; as it stands, all."""

    trees: int = 200
    taught_trees: int = 200
    """Of the paper mode's rows that learn, the slow ones."""
    seeds: int = 3
    round: int = 1
    """Trees between two trainings in paper mode; 1 is the published sequence."""
    heads: tuple = tuple(HEADS)
    """Of the rows beside the paper's table."""
    simulations: int = 500
    """A root, on S0b and for the trees that teach the heads of a warm start."""
    budgets: tuple = (20, 50, 100, 200, 500)
    """Simulations a root, where CPU time is compared."""
    budget_trees: int = 400
    starts: tuple = (15.0, 17.0)
    """Of the systems of a warm start."""
    warm_trees: int = 40
    substeps: tuple = (0, 3, 10, 30, 100, 300)
    """Of the slowed simulators."""
    modes: tuple = ("paper", "default")
    """Of the paper's table."""
    variants: tuple = tuple(VARIANTS)
    published: int = 500
    """Simulations a root, of the paper's table."""
    small: int = 50
    """Simulations a root, where that is few."""


QUICK = Sizes(
    trees=100,
    taught_trees=24,
    seeds=1,
    round=8,
    heads=("none", "both"),
    simulations=50,
    budgets=(),
    budget_trees=100,
    starts=(15.0,),
    warm_trees=100,
    substeps=(0, 30, 300),
)
SMOKE = QUICK._replace(
    trees=2,
    taught_trees=2,
    round=1,
    heads=("both",),
    simulations=5,
    budget_trees=2,
    warm_trees=2,
    substeps=(0,),
    modes=("paper",),
    variants=("MCTS-SA",),
    published=5,
    small=5,
)
COLUMNS = {  # name -> width and text of a row; "-" where it has no such number
    "B": (3, lambda r: r["B"] or "-"),
    "trees": (5, lambda r: r["trees"]),
    "rate %": (6, lambda r: f"{100 * r['rate']:.1f}"),
    "95 %": (12, lambda r: "{:.1f} to {:.1f}".format(*(100 * v for v in r["rate_95"]))),
    "of each seed": (15, lambda r: " ".join(f"{100 * v:.1f}" for v in r["rates"])),
    "mean best": (
        14,
        lambda r: (
            f"{r['mean_best']:.2f}"
            + (f" +- {r['mean_best_95']:.2f}" if "mean_best_95" in r else "")
        ),
    ),
    "failing": (7, lambda r: f"{r['mean_best_failing']:.2f}"),
    "best of each": (17, lambda r: " ".join(f"{v:.2f}" for v in r.get("bests", [r["best"]]))),
    "sims/s": (7, lambda r: f"{r['simulations_per_cpu_s']:.0f}"),
    "cost": (5, lambda r: f"{r['cpu_ratio']:.2f}"),
    "factor": (6, lambda r: f"{r['factor']:.0f}"),
    "compile": (7, lambda r: f"{r['warm_up_cpu_s']:.1f}"),
    "failing/s": (
        20,
        lambda r: "{:.3g} ({:.3g} to {:.3g})".format(
            r["failing_trees_per_cpu_s"], *r["failing_trees_per_cpu_s_95"]
        ),
    ),
}
LEGEND = """B: trees between two trainings, - where nothing is learned. failing: mean best of
failing trees. sims/s: simulations per
CPU second, without compilation; cost: CPU time of one, to that of the block's first row; factor:
sims/s over the published code's; compile: CPU s of the call before, which compiles what no row
above it did; failing/s: failing trees per CPU second, with the interval of the rate."""


def forest(sim, heads=None, mode="default", trees=200, simulations=500, **settings):
    """A search by its key. The round of its heads has the default length, but by number, so that
    `warm_up` can have the same with fewer trees.
    """
    settings = dict(round=max(1, min(trees // 5, LANES))) | settings
    more = dict(trees=trees, simulations=simulations, mode=mode, reward=REWARD, actions=BOX)
    if heads is not None:
        more |= dict(heads=heads, head_settings=jast.heads.settings(mode, **settings))
    return functools.partial(jast.search.forest, sim=sim, **more)


def variant(name, mode, sizes):
    """A row of Table 1."""
    s0, heads = jast.simulators.ferry(), VARIANTS[name]
    if name == "MCTS-SA":
        more = dict(mode=mode, reward=REWARD, actions=BOX, simulations=18 * sizes.published)
        return functools.partial(jast.search.mcts, sim=s0, trees=sizes.trees, **more)
    # alone, the paper's value network is not trained
    published = dict(train=False) if heads == "value" else dict(round=sizes.round)
    trees = sizes.taught_trees if mode == "paper" and name.startswith("RP") else sizes.trees
    return forest(s0, heads, mode, trees, sizes.published, **(published if mode == "paper" else {}))


def warm_up(search):
    """CPU seconds of compiling what a search runs: it is ended at its first news or, where heads
    learn, has one round of trees and one step of training.
    """

    def end(*_):
        raise KeyboardInterrupt

    heads, trees = search.keywords.get("head_settings"), search.keywords["trees"]
    more = dict(callback=end)
    if heads is not None and heads.train:
        more = dict(trees=min(heads.round, trees), head_settings=heads._replace(steps=(1, 1)))
    tree_keys(jax.random.key(0), trees)[: more.get("trees")]
    return timed(lambda: search(jax.random.key(0), **more))[1]


def warm_run(search, seed):
    """`timed`; a short call is made twice and the second one counts, as some small programs depend
    on what was found.
    """
    first = timed(lambda: search(jax.random.key(seed)))
    return timed(lambda: search(jax.random.key(seed))) if first[1] < 2 else first


def measure(searches, seeds):
    """The row of a search, given for each seed."""
    warm = warm_up(searches[0])
    runs = [warm_run(search, seed) for search, seed in zip(searches, seeds, strict=True)]
    results, cpu, wall = zip(*runs, strict=True)
    bests = [np.asarray(r.best_reward_per_tree, np.float64) for r in results]
    row = outcome(np.concatenate(bests))
    heads = searches[0].keywords.get("head_settings")
    episodes = sum(r.episodes for r in results)
    a_second = row["trees"] / sum(cpu)
    return row | {
        "B": heads.round if heads is not None and heads.train else None,
        "rates": [float((b > 0).mean()) for b in bests],
        "bests": [b.max() for b in bests],
        "episodes": episodes,
        "steps": sum(r.steps for r in results),
        "cpu_s": list(cpu),
        "wall_s": list(wall),
        "warm_up_cpu_s": warm,
        "simulations_per_cpu_s": episodes / sum(cpu),
        "simulations_per_cpu_s_with_warm_up": episodes / (sum(cpu) + warm),
        "failing_trees_per_cpu_s": row["rate"] * a_second,
        "failing_trees_per_cpu_s_95": [rate * a_second for rate in row["rate_95"]],
    }


def published():
    """Variant -> the paper's row, of its trees' best rewards where the data is there."""
    if (found := data("table1_per_tree.json")) is not None:
        bests = found["best_reward_per_tree"]
        return {name: outcome(np.array(bests[name])) for name in VARIANTS}

    def row(rate, mean, best):
        ends = list(clopper_pearson(round(2 * rate), 200))
        return dict(trees=200, rate=rate / 100, rate_95=ends, mean_best=mean, best=best)

    return {name: row(*TABLE[name]) for name in VARIANTS}


def line(name, row):
    def text(show):
        try:
            return show(row)
        except (KeyError, TypeError):  # a published row
            return "-"

    return f"{name:9}" + "".join(f" {text(show):>{width}}" for width, show in COLUMNS.values())


def block(title, searches, seeds, say, table1=False):
    """Name -> row, measured and said one by one; a search, or a list of one for each seed. The
    first is what the others' cost is compared with; ``table1``: names are the paper's, whose speed
    is compared with, too.
    """
    say(f"\n{title}")
    rows = {}
    for name, search in searches.items():
        row = measure(search if isinstance(search, list) else [search] * len(seeds), seeds)
        plain = next(iter(rows.values()), row)
        row["cpu_ratio"] = plain["simulations_per_cpu_s"] / row["simulations_per_cpu_s"]
        if table1:
            row["factor"] = row["simulations_per_cpu_s"] / SPEED[name]
        rows[name] = row
        say(line(name, row))
    return rows


def kinds(names, sim, **settings):
    """Name -> default search with these heads."""
    return {name: forest(sim, HEADS[name], **settings) for name in names}


def warm_start(sizes, seeds, say):
    """System -> rows of small searches that start with heads learned on S0, or without."""
    s0, n = jast.simulators.ferry(), sizes.simulations
    learn = forest(s0, "both", trees=sizes.trees, simulations=n)
    taught = f"{sizes.trees} trees of 18 x {sizes.simulations} on S0"
    heads = [learn(jax.random.key(seed)).heads for seed in seeds]
    later, out = [seed + 1000 for seed in seeds], {}
    for x in sizes.starts:
        few = dict(trees=sizes.warm_trees, simulations=sizes.small)
        search = functools.partial(forest, jast.simulators.ferry(adversary=(x, 0.0)), **few)
        rows = {
            "none": search(),
            "cold": search("both"),
            "warm": [search(h) for h in heads],
            "frozen": [search(h, train=False) for h in heads],
        }
        title = (
            f"start at ({x:g}, 0), 18 x {sizes.small}: heads that start cold, or warm from"
            f" {taught} (not counted), or stay as those are (frozen)"
        )
        out[f"({x:g}, 0)"] = block(title, rows, later, say)
    return out


def episode_cost(sim, simulations):
    """CPU microseconds of one random episode, of 200 in lockstep."""
    problem, keys = engine.problem(9000, sim=sim), tree_keys(jax.random.key(0), 200)
    play = functools.partial(engine.rollouts, problem, keys, simulations)
    return min(engine.cpu(play)[0] for _ in range(3)) / (simulations * 200) * 1e6


def slowed(sizes, seeds, say):
    """Of each slowed S0: its substeps, the cost of an episode, and its rows."""
    out = []
    for n in sizes.substeps:
        sim = engine.slow_ferry(n)
        cost = episode_cost(sim, max(4, 1000 // (3 + n)))
        few = dict(trees=sizes.trees, simulations=sizes.small)
        title = f"{n} substeps, 18 x {sizes.small}: {cost:.2f} us an episode"
        rows = block(title, kinds(("none", "rollout", "both"), sim, **few), seeds, say)
        out.append({"substeps": n, "episode_cpu_us": cost, "rows": rows})
    return out


def draw(out, path):
    """The paper's Figures 4 and 5, measured."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from jast._src.plot.style import COLOURS, styled

    with styled():
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.9), layout="constrained")
        for colour, marker, name in zip(COLOURS, "os^", ("none", "rollout", "both"), strict=False):
            label = {"none": "no heads", "both": "both heads"}.get(name, "rollout head")
            style = dict(color=colour, marker=marker, markersize=5, capsize=2.5, label=label)
            points = [(p["episode_cpu_us"], p["rows"][name]) for p in out["slow_simulator"]]
            bars(left, points, "failing_trees_per_cpu_s", 1, style)
            points = [
                (18 * n, rows[name]) for n, rows in out["equal_cpu_time"].items() if name in rows
            ]
            bars(right, points, "rate", 100, style)
        left.set(xscale="log", xlabel="CPU time of a simulator's episode, microseconds")
        left.set(yscale="log", ylabel="failing trees per CPU second")
        left.set_title("Trees of 18 x 50 simulations")
        for axis in (left.xaxis, left.yaxis):
            axis.set_major_formatter("{x:g}")
        right.set(xscale="log", xlabel="simulations a tree")
        right.set(ylim=(0, 102), ylabel="failing trees, %")
        ticks = [18 * n for n in out["equal_cpu_time"]]
        right.set_xticks(ticks, map(str, ticks))
        right.minorticks_off()
        right.set_title("Trees of 18 roots on S0")
        left.legend(loc="lower left")
        figure.savefig(path, dpi=100)
        plt.close(figure)


def bars(ax, points, name, scale, style):
    """A line through the number ``name`` of (x, row) with its intervals as bars."""
    if points:
        x, rows = zip(*points, strict=True)
        y = scale * np.array([r[name] for r in rows])
        ends = scale * np.array([r[f"{name}_95"] for r in rows])
        ax.errorbar(x, y, np.abs(ends.T - y), **style)


def report(args):
    """Measure, print and draw what the arguments of `benchmarks.ferry` ask for."""
    sizes = size(args, Sizes(), QUICK, SMOKE)
    if args.trees:
        same = dict.fromkeys(("trees", "taught_trees", "budget_trees"), args.trees)
        sizes = sizes._replace(warm_trees=max(1, args.trees // 5), **same)
    seeds = range(args.seed, args.seed + (args.seeds or sizes.seeds))
    say = printer(args)
    rows = published()
    out = {"golden": golden(), "seeds": list(seeds), "sizes": sizes._asdict(), "published": rows}
    say(f"golden episodes: {out['golden'] or 'data not found'}\n{LEGEND}\n")
    say(f"{'':9}" + "".join(f" {name:>{width}}" for name, (width, _) in COLUMNS.items()))
    say("published")
    for name, row in rows.items():
        say(line(name, row))
    measured = functools.partial(block, seeds=seeds, say=say)
    for mode in sizes.modes:
        searches = {name: variant(name, mode, sizes) for name in sizes.variants}
        out[mode] = measured(f"S0, {mode} mode", searches, table1=True)
    s0, s0b = jast.simulators.ferry(), jast.simulators.ferry(adversary=(17.0, 0.0))
    for label, system, key, n in (
        ("S0b", s0b, "S0b", sizes.simulations),
        ("S0", s0, "small", sizes.small),
    ):
        searches = kinds(sizes.heads, system, trees=sizes.trees, simulations=n)
        out[key] = measured(f"{label}, default mode, 18 x {n}", searches)
    names, trees = [name for name in sizes.heads if name != "value"], sizes.budget_trees
    out["equal_cpu_time"] = {
        n: measured(
            f"S0, default mode, 18 x {n}, {trees} trees",
            kinds(names, s0, trees=trees, simulations=n),
        )
        for n in sizes.budgets
    }
    out["warm_start"] = warm_start(sizes, seeds, say)
    if args.picture:
        out["slow_simulator"] = slowed(sizes, seeds, say)
        draw(out, args.picture)
    print_report(args, out)
