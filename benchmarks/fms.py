"""The flight management system's trajectory predictor: what each search finds in 5000 evaluations
(Table 3.3 of Moss's thesis, on an open stand-in).

``python -m benchmarks.fms [--json] [--quick | --smoke] [--seeds N]``. Every method has the same
number of evaluations and independent seeds (trees). Failures are counted once each: a tree that
comes to the end of an episode again has evaluated nothing. Means are over seeds, +- is one standard
error of that mean. The last column counts repetitions too, as the thesis does, with quantiles over
seeds. The control is the same search on the predictor without its defect. CPU time is that of the
one call for all seeds, compilation included.
"""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jast
from benchmarks.sizes import options, print_report, printer, size, timed
from jast.distributions import Independent, Normal
from jast.simulators.fms import MEANS, SIGMAS, fms

EVALUATIONS = 5000
# Table 3.3, one seed: failures, first failure, mean and standard deviation of d, least d
PUBLISHED = {
    "database": (0, None, 560.21, 75.09, 410.98),
    "monte carlo": (5, 128, 407.44, 64.85, -1127.7),
    "cross-entropy": (24, 249, 625.65, 97.80, -1077.3),
    "mcts, thesis": (4394, 61, -923.49, 497.4, -1147.9),
}

SMOKE = ("monte carlo", "cross-entropy", "mcts", "forest")
"""Searches of ``--smoke``: one of each."""


def searches(evaluations, seeds):
    """Name -> (the search of a simulator, settings of the simulator)."""
    safe = jast.rewards.episodic()
    with warnings.catch_warnings(action="ignore"):
        warnings.simplefilter("ignore", UserWarning)  # as printed, for the comparison
        printed = jast.rewards.episodic(mode="thesis")
    # the thesis's proposal: distances of 1 nmi, give or take 3
    near = Independent(
        Normal(jnp.asarray(MEANS).at[1].set(1.0), jnp.asarray(SIGMAS).at[1].set(3.0)), 1
    )

    def monte_carlo(key, sim):
        return jast.search.monte_carlo(
            key, sim, episodes=evaluations * seeds, reward=safe, record=True
        )

    plain = jast.actions.samples()

    def mcts(key, sim, **of):
        return jast.search.mcts(
            key, sim, trees=seeds, simulations=evaluations, record=True, actions=plain, **of
        )

    cem = dict(
        samples=evaluations // 10,
        elites=evaluations // 100,
        iterations=10,
        trees=seeds,
        reward=safe,
        actions=jast.actions.quantiles(near),
        record=True,
    )
    # a hundredth of what failures earn
    deep = dict(mode="episodic", reward=safe, exploration=1000.0)
    # among failures log p decides
    likely = dict(mode="episodic", reward=jast.rewards.standard(event_bonus=600.0), exploration=3.0)
    roots = dict(trees=seeds, prunes=5, simulations=evaluations // 5, record=True, actions=plain)
    return {
        "database": (monte_carlo, dict(database=True)),
        "monte carlo": (monte_carlo, {}),
        "cross-entropy": (lambda key, sim: jast.search.cem(key, sim, **cem), {}),
        "mcts, thesis": (lambda key, sim: mcts(key, sim, mode="thesis", reward=printed), {}),
        "mcts": (lambda key, sim: mcts(key, sim, **deep), {}),
        "mcts, likeliest": (lambda key, sim: mcts(key, sim, **likely), {}),
        "forest": (lambda key, sim: jast.search.forest(key, sim, **roots, **deep), {}),
    }


def mean(values):
    """The mean over seeds and its standard error; None where there are no values."""
    values = np.asarray([v for v in values if np.isfinite(v)], float)
    if not len(values):
        return None
    return {
        "mean": float(values.mean()),
        "se": float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None,
    }


def quantiles(shares):
    """The mean of the shares of seeds, and what a tenth, a half and nine tenths of them, and all,
    do not exceed.
    """
    at = np.quantile(shares, (0.1, 0.5, 0.9, 1.0)).tolist()
    names = "mean", "10 %", "median", "90 %", "greatest"
    return dict(zip(names, (float(shares.mean()), *at), strict=True))


def by_seed(trials, seeds):
    """`Trials` [evaluations, seeds]; Monte Carlo's one tree is cut into seeds."""
    if trials.reward.shape[1] == seeds:
        return trials
    return jax.tree.map(lambda a: a.reshape(seeds, -1).T, trials)


def summary(result, seeds, baseline=None):
    """The table's row of one search; ``baseline``: mean log p of Monte Carlo's failures."""
    t, lanes = by_seed(result.trials, seeds), range(seeds)
    failures = t.failure.sum(0)
    first = [int(f.argmax()) + 1 if f.any() else np.inf for f in t.failure.T]
    valid = t.ran & np.isfinite(t.distance)
    distances = [t.distance[valid[:, k], k] for k in lanes]
    log_p = [t.log_prob[t.failure[:, k], k] for k in lanes]
    every, likely = np.concatenate(log_p), [p.mean() if len(p) else np.nan for p in log_p]
    return {
        "failures": mean(failures),
        "failures_median": float(np.median(failures)),
        "failures_least": int(failures.min()),
        "share_of_simulations": float(failures.mean() / len(t.reward)),
        "with_repetitions": quantiles((t.failure | t.repeated).mean(0)),
        "seeds_without_failure": int((failures == 0).sum()),
        "first_failure_median": float(np.median(first)),
        "distance_mean": mean([d.mean() for d in distances]),
        "distance_sd": mean([d.std() for d in distances]),
        "distance_least": mean([d.min() for d in distances]),
        "log_p_of_failures": mean(likely),
        "log_p_greatest": float(every.max()) if len(every) else None,
        "log_p_less_monte_carlo": None if baseline is None else mean(np.array(likely) - baseline),
        "invalid": int(result.invalid),
    }


def run(evaluations, seeds, control_seeds, say, key=0, names=None):
    """The table; ``names``: of these searches alone."""
    keys, out, baseline = jax.random.split(jax.random.key(key), 7), {}, None
    table = searches(evaluations, seeds).items()
    for k, (name, (search, settings)) in zip(keys, table, strict=True):
        if names and name not in names:
            continue
        result, seconds, _ = timed(partial(search, k, fms(**settings)))
        out[name] = summary(result, seeds, baseline) | {"cpu_s": seconds}
        if name == "monte carlo":
            t = result.trials
            baseline = float(t.log_prob[t.failure].mean())
            out[name] |= {"log_p_less_monte_carlo": mean([0.0])}
        say(line(name, out[name]))
    table = searches(evaluations, control_seeds).items()
    for k, (name, (search, settings)) in zip(keys, table, strict=True):
        if name in out:
            control = search(k, fms(fixed=True, **settings))
            out[name]["control_failures"] = int(control.failures.seen)
    return out


HEADER = (
    f"{'method':15} {'failures':>16} {'median':>7} {'share':>7} {'first':>7} {'mean d':>16}"
    f" {'sd d':>6} {'least d':>15} {'log p to MC':>13} {'CPU s':>7}   with repetitions: mean;"
    " 10, 50, 90 % of seeds, the greatest"
)


def told(v, digits=3):
    """A `mean`, or a number, in words."""
    if not isinstance(v, dict):
        return "-" if v is None else f"{v:.{digits}f}"
    error = "" if v["se"] is None else f" +- {v['se']:.{digits}f}"
    return f"{v['mean']:.{digits}f}{error}"


def spread(shares):
    """`quantiles` in words."""
    mean, *rest = (f"{100 * v:.1f}" for v in shares.values())
    return f"{mean} %; {', '.join(rest)} %"


def line(name, row):
    """A row of the table in words."""
    of = partial(told, digits=1)
    return (
        f"{name:15} {of(row['failures']):>16} {row['failures_median']:7.0f}"
        f" {100 * row['share_of_simulations']:6.2f}% {row['first_failure_median']:7.0f}"
        f" {of(row['distance_mean']):>16} {row['distance_sd']['mean']:6.1f}"
        f" {of(row['distance_least']):>15} {of(row['log_p_less_monte_carlo']):>13}"
        f" {row['cpu_s']:7.1f}   {spread(row['with_repetitions'])}"
    )


def main(argv=None):
    parser = options(__doc__, "10 seeds, in under two minutes")
    help = "independent searches of each method (default 100, with --quick 10)"
    parser.add_argument("--seeds", type=int, help=help)
    args = parser.parse_args(argv)
    say, seeds = printer(args), args.seeds or size(args, 100, 10, 2)
    evaluations = 100 if args.smoke else EVALUATIONS
    say(f"{evaluations} evaluations, {seeds} seeds\n{HEADER}")
    names = SMOKE if args.smoke else None
    with jax.enable_x64(True):
        table = run(evaluations, seeds, min(seeds, 10), say, names=names)
    controls = ", ".join(f"{name} {row['control_failures']}" for name, row in table.items())
    say(f"on the predictor without its defect: {controls} failures")
    sizes = dict(evaluations=evaluations, seeds=seeds)
    print_report(args, sizes | dict(published=PUBLISHED, methods=table))


if __name__ == "__main__":
    main()
