"""The experiment of Lipkis and Agogino (NASA) as printed: a failure policy of the landing by soft
actor-critic, and Algorithm 2 with it.

``python -m benchmarks.nasa [--json] [--quick | --smoke] [--seed N] [--cells N ...]``. 25,000
episodes of training with a learning rate of 1e-4 and two hidden layers of 100, then 10^7 episodes
with epsilon .05 from the model's own start; the truth is 4.0237e-13, the printed outcome 3.253e-13
with a standard deviation of 1.378e-13. Beside it: the same policy with its start moved, and the
double loop of section 5, with as many traces; and a policy by Q-learning on a discretised state
(footnote 3), with its start moved: 100 cells of the offset at each step and 13 values of the drift,
as many episodes. ``--cells``: instead, Q-learning alone with these numbers of cells, 4 seeds each
and 10^5 traces.
"""

import math

import jax

import jast
from benchmarks.sizes import options, print_report, printer, size, timed
from jast.estimate import double_loop, importance, normal, policy_proposal

PUBLISHED = dict(mean=3.253e-13, standard_deviation=1.378e-13)


def row(found, truth):
    """An estimate in numbers."""
    seen = found.failing > 0
    return {
        "over_truth": found.mean / truth if seen else None,
        "relative_error": found.relative_error if seen else None,
        "interval_over_truth": [v / truth for v in found.interval] if seen else None,
        "normal_over_truth": (
            [v / truth for v in normal(found.mean, found.standard_error)] if seen else None
        ),
        "ess": found.ess,
        "failing": found.failing,
        "reliable": found.reliable,
    }


def by_cells(sim, truth, cells, episodes, samples, seed, say):
    """Rows of Q-learning, by the cells of the offset and the seed."""
    rows = {}
    for n in cells:
        for s in range(seed, seed + 4):
            for_policy, for_traces = jax.random.split(jax.random.key(s))
            policy = jast.policies.q_learning(for_policy, sim, episodes=episodes, cells=(1, n))
            found = importance(for_traces, sim, policy_proposal(sim, policy, 0.05), samples)
            r = row(found, truth)
            rows.setdefault(n, []).append(r)
        said = ", ".join(
            "no failure"
            if r["over_truth"] is None
            else f"{r['over_truth']:.3f} (SE {100 * r['relative_error']:.1f} %)"
            for r in rows[n]
        )
        say(f"  {n} cells: {said}")
    return rows


def main(argv=None):
    parser = options(__doc__, "2500 episodes of training and 10^5 of each estimate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cells", type=int, nargs="+")
    args = parser.parse_args(argv)
    say, (episodes, samples) = printer(args), size(args, (25_000, 10**7), (2500, 10**5), (80, 1000))
    sim, truth = jast.simulators.landing(), math.erfc(1 / math.sqrt(2 * 0.019))
    if args.cells:
        samples = min(samples, 10**5)
        return print_report(
            args, by_cells(sim, truth, args.cells, episodes, samples, args.seed, say)
        )
    keys = jax.random.split(jax.random.key(args.seed), 4)
    as_printed = dict(hidden=(100, 100), learning_rate=1e-4)
    if args.smoke:
        as_printed |= dict(batch=16, updates=1, hidden=(8,))
    policy, cpu, _ = timed(lambda: jast.policies.sac(keys[0], sim, episodes=episodes, **as_printed))
    say(f"{episodes} episodes of training, {cpu:.0f} CPU s; {samples} traces an estimate")
    learn = jast.policies.q_learning
    cells = (1, 100)
    table, table_cpu, _ = timed(
        lambda: learn(jax.random.fold_in(keys[0], 1), sim, episodes=episodes, cells=cells)
    )
    say(f"Q-learning: as many episodes of training, {table_cpu:.0f} CPU s")
    in_table = policy_proposal(sim, table, 0.05)
    untilted = policy_proposal(sim, policy, 0.05, tilt_start=False)
    tilted = policy_proposal(sim, policy, 0.05)
    key = jax.random.fold_in(keys[3], 1)
    calls = {
        "Algorithm 2, as printed": lambda: importance(keys[1], sim, untilted, samples),
        "double loop": lambda: double_loop(keys[2], sim, untilted, samples // 100, 100),
        "start moved": lambda: importance(keys[3], sim, tilted, samples),
        "Q-learning, start moved": lambda: importance(key, sim, in_table, samples),
    }
    out = {"published": PUBLISHED, "truth": truth, "training_cpu_s": cpu, "table_cpu_s": table_cpu}
    for name, call in calls.items():
        found, cpu, _ = timed(call)
        r = out[name] = row(found, truth) | {"cpu_s": cpu}
        text = "no failure"
        if r["over_truth"] is not None:
            low, high = r["interval_over_truth"]
            normal_low, normal_high = r["normal_over_truth"]
            text = (
                f"{r['over_truth']:.3f} of the truth, SE {100 * r['relative_error']:.1f} %,"
                f" [{low:.3f}, {high:.3f}], normal [{normal_low:.3f}, {normal_high:.3f}]"
            )
        word = "" if r["reliable"] else ", UNRELIABLE"
        say(f"  {name:24} {text}, ESS {r['ess']:.0f}{word}, {cpu:.0f} CPU s")
    print_report(args, out)


if __name__ == "__main__":
    main()
