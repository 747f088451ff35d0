"""Cross-entropy methods over a simulator's disturbances, and their proposals for rare events:
``python -m benchmarks.bridge [--json] [--quick | --smoke]``.

First, how many runs of 1000 episodes find a collision on the ferry, with quantiles for actions.
Then the failure probability that `failure_proposal` leads to: by importance sampling with 10,000
new episodes, over the truth, where one is known; each of several seeds with a proposal of its own.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jast
from benchmarks.ferry import REWARD
from benchmarks.limit_states import DYNAMIC
from benchmarks.sizes import options, print_report, printer, size
from jast import cross_entropy as ce
from jast.estimate import clopper_pearson, importance

FRESH = 10_000


def found(runs, samples=100, iterations=10, methods=("ce_method", "ce_surrogate", "ce_mixture")):
    """Runs of each method that find a collision, of 1000 episodes each."""
    sizes = dict(samples=samples, elites=3 * samples // 10, iterations=iterations)
    sim, actions = jast.simulators.ferry(), jast.actions.quantiles()
    stress = ce.over(sim, actions=actions)
    common = dict(reward=REWARD, actions=actions)
    random = partial(jast.search.monte_carlo, sim=sim, episodes=samples * iterations, **common)
    plan = dict(samples=samples, elites=samples // 10, iterations=iterations)
    cem = partial(jast.search.cem, sim=sim, **plan, **common)
    searches = {
        "random search": lambda key: random(key).failing_per_tree[0],
        "search.cem": lambda key: cem(key).failing_per_tree[0],
    }
    for name in methods:
        searches[name] = lambda key, name=name: (
            getattr(ce, name)(key, stress.objective, stress.proposal, **sizes).best_value < 0
        )
    out = {}
    for name, search in searches.items():
        n = int(sum(bool(search(key)) for key in jax.random.split(jax.random.key(0), runs)))
        out[name] = {"runs": runs, "failing": n, "share_95": list(clopper_pearson(n, runs))}
    return out


def _hyperplane(beta, x):
    return beta - jnp.sum(x) / jnp.sqrt(jnp.asarray(x.size, x.dtype))


SYSTEMS = {  # name -> simulator, truth
    "hyperplane, beta 4, d = 10": (
        lambda: jast.simulators.limit_state(Partial(_hyperplane, jnp.float32(4)), 10),
        3.167124183311992e-5,
    ),
    "hyperplane, beta 6, d = 20": (
        lambda: jast.simulators.limit_state(Partial(_hyperplane, jnp.float32(6)), 20),
        9.865876450376946e-10,
    ),
    "walk1d, one-sided": DYNAMIC["walk1d one-sided"],
    "walk1d, two-sided": DYNAMIC["walk1d two-sided"],
    "landing (two modes)": DYNAMIC["landing"],
}


def proposals(name, seeds, iterations=20):
    """Estimate over truth, and its relative standard error, of each seed."""
    make, truth = SYSTEMS[name]
    sim, rows = make(), []
    for seed in range(seeds):
        proposal = jast.estimate.failure_proposal(jax.random.key(seed), sim, iterations=iterations)
        r = importance(jax.random.key(1000 + seed), sim, proposal.policy, FRESH)
        rows.append((r.mean / truth, r.relative_error, bool(proposal.reached)))
    ratio, error, reached = map(list, zip(*rows, strict=True))
    return {
        "truth": truth,
        "ratio": ratio,
        "relative_error": error,
        "reached": reached,
        "crude": float(np.sqrt((1 - truth) / truth / (FRESH + 20_000))),
    }


def main(argv=None):
    args = options(__doc__, "under two minutes: fewer runs").parse_args(argv)
    say = printer(args)
    report = {"found": found(*size(args, (20,), (5,), (1, 10, 2, ["ce_method"]))), "proposals": {}}
    say("runs of 1000 episodes that find a collision on the ferry")
    for name, r in report["found"].items():
        say(
            f"  {name:14} {r['failing']:3d} of {r['runs']}   95 % [{100 * r['share_95'][0]:.0f},"
            f" {100 * r['share_95'][1]:.0f}]"
        )
    say(
        "importance sampling under failure_proposal: estimate / truth by seed; relative standard"
        " error, and that of crude Monte Carlo with all 30,000 episodes"
    )
    for name in list(SYSTEMS)[: 1 if args.smoke else None]:
        r = proposals(name, *size(args, (10,), (3,), (1, 1)))
        report["proposals"][name] = r
        ratios = " ".join(f"{v:.3f}" for v in r["ratio"])
        say(
            f"  {name:27} {ratios}   {100 * min(r['relative_error']):.1f} to"
            f" {100 * max(r['relative_error']):.1f} %   (crude {100 * r['crude']:.3g} %)"
        )
    print_report(args, report)


if __name__ == "__main__":
    main()
