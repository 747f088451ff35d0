"""The numbers of the search for a proposal (`estimate.proposal_search.settings`), each halved and
doubled: ``python -m benchmarks.search_settings [--json] [--quick | --smoke] [--only NUMBER ...]``.

Problems are drawn by seed (`benchmarks.limit_states`). For each number: how many estimates are
flagged, the standard error of the others as a ratio to that by the numbers as they are (geometric
mean over problems that both answer), and how many unflagged ones are off by more than three of
their standard errors.
"""

import math

import jax

import jast
from benchmarks.limit_states import FAMILIES, draw
from benchmarks.sizes import add_choices, options, print_report, printer, size
from jast._src.estimate.proposal_search import by_proposal
from jast._src.estimate.proposal_search.settings import SETTINGS

SHARES = (
    "exploration_end",
    "search_end",
    "singleton_share_most",
    "unexplained_ratio",
    "defensive_scale",
    "refits_end",
)
"""Which are near to 1: halved alone, and doubled as far as 1 allows."""


FIXED = ("components_each",)
"""Which other code is made for."""


def changed(name, by):
    """The settings with one number ``by`` times as great."""
    value = getattr(SETTINGS, name)
    new = type(value)(max(round(value * by), 1)) if isinstance(value, int) else value * by
    return SETTINGS._replace(**{name: min(new, 0.97) if name in SHARES else new})


def answers(settings, problems, budget):
    """[(log of the ratio to the truth in standard errors, standard error, reliable)] of each."""
    out = []
    for seed, (_, sim, truth) in problems:
        request = by_proposal.Request("failure_probability", jax.random.key(seed), sim, budget)
        p = by_proposal.estimate_by_proposal(request._replace(settings=settings))
        off = (p.mean / truth - 1) / p.relative_error if p.failing else math.nan
        out.append((off, p.relative_error, p.reliable and p.relative_error < 0.05))
    return out


def line(of, base):
    """What one change does."""
    both = [math.log(a[1] / b[1]) for a, b in zip(of, base, strict=True) if a[2] and b[2]]
    return {
        "flagged": sum(not a[2] for a in of),
        "error": math.exp(sum(both) / len(both)) if both else math.nan,
        "far": sum(a[2] and abs(a[0]) > 3 for a in of),
    }


def main(argv=None):
    parser = options(__doc__, "two numbers, on two families")
    parser.add_argument("--seeds", type=int, help="problems of each family (3)")
    parser.add_argument("--budget", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=830_000, help="number of the first problem")
    add_choices(parser, "--families", FAMILIES)
    add_choices(parser, "--only", SETTINGS._fields)
    args = parser.parse_args(argv)
    seeds = args.seeds or size(args, 3, 1, 1)
    every = tuple(n for n in SETTINGS._fields if n not in FIXED)
    names = args.only or size(
        args, every, ("coverage_factor", "refit_efficiency"), ("coverage_factor",)
    )
    families = args.families or size(args, list(FAMILIES), ["two_sided", "branches"], ["walks"])
    first = args.first
    problems = [(first + i, draw(f, first + i)) for i in range(seeds) for f in families]
    base = answers(SETTINGS, problems, args.budget)
    out = {"as it is": line(base, base) | {"problems": len(problems)}}
    say = printer(args)

    def text(name):
        return (
            f"{name:32} flagged {out[name]['flagged']:3d}  error {out[name]['error']:5.2f}"
            f"  far {out[name]['far']}"
        )

    say(f"{len(problems)} problems, {args.budget} evaluations, jast {jast.__version__}")
    say(text("as it is"))
    for name in names:
        for by in (0.5, 2.0):
            at = changed(name, by)
            said = f"{name} {getattr(at, name):g}"
            out[said] = line(answers(at, problems, args.budget), base)
            say(text(said))
    print_report(args, out)
    return out


if __name__ == "__main__":
    main()
