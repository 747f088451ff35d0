"""Environments of other libraries: ``python -m benchmarks.doors [--json] [--quick | --smoke]
[--systems NAME ...] [--seeds N] [--truth] [--lines]``.

The systems are those of docs/guides/environments.md, whose code is run as it is printed there, and
a pendulum of gymnax. Each has a process of its own, without a cache of compiled programs: seconds
from the first import to a failure (`jast.search.falsify`), then
`jast.estimate.failure_probability` at a budget over some keys, beside plain draws for the CPU time
of a warm call. ``--truth`` draws the truths that stand below again; ``--lines`` counts the lines
that a user writes. Systems whose library is not installed are named and left out.
"""

import ast
import math
import re
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax

import jast
from benchmarks import BEGUN
from benchmarks.sizes import (
    NO_CACHE,
    add_choices,
    in_fresh_process,
    installed,
    options,
    percent,
    print_report,
    printer,
    size,
)
from jast.distributions import Normal

__all__ = ["EXAMPLES", "SYSTEMS", "Door"]

GUIDE = Path(__file__).parents[1] / "docs/guides/environments.md"
EXAMPLES = {
    section.partition("\n")[0]: block
    for section in GUIDE.read_text().split("\n## ")
    for block in re.findall(r"```python\n(.*?)```", section, re.S)
}
"""Heading in the guide -> the code under it."""
HEADS = (
    "| system, budget | truth (its standard error) | unflagged | rms error of these (of all)"
    " | intervals that hold | CPU s: first, warm | plain draws in that time"
    " | first failure: s of the clock (CPU) |\n|" + "---|" * 8,
    "| you have | lines | of which the call that makes the simulator |\n|---|---|---|",
)


class Door(NamedTuple):
    """What it needs, the budget, how many keys have it, and the truth: the probability, its
    relative standard error, and the plain draws of each of 16 keys that it is made of.
    """

    library: str
    budget: int
    keys: int
    truth: float
    error: float
    draws: int


SYSTEMS = {
    "gymnax": Door("gymnax", 1_000_000, 20, 1.603e-3, 0.0086, 2**19),
    "pendulum": Door("gymnax", 1_000_000, 20, 1.682e-4, 0.019, 2**20),
    "MJX": Door("mujoco.mjx", 20_000, 2, 9.956e-4, 0.062, 2**14),
    "brax": Door("brax", 20_000, 2, 4.532e-2, 0.025, 2**11),
}
"""Truths as ``python -m benchmarks.doors --truth`` printed them, with gymnax 1.0.1, brax 0.14.2 and
mujoco-mjx 3.17.0.
"""


def simulator(name: str) -> jast.Simulator:
    """That of the guide, without the call that is printed at the end; or the pendulum."""
    if name == "pendulum":
        return pendulum()
    tree, names = ast.parse(EXAMPLES[name]), {}
    tree.body = [part for part in tree.body if not isinstance(part, ast.Expr)]
    exec(compile(tree, f"{GUIDE.name}: {name}", "exec"), names)
    return names["sim"]


def pendulum() -> jast.Simulator:
    """Kept upright with a torque that is limited, while gusts turn it; a failure leans by 60
    degrees. The start is 12 degrees off.
    """
    import gymnax

    env, params = gymnax.make("Pendulum-v1")
    return jast.adapters.gymnax(
        env,
        params,
        policy=lambda seen: -12.0 * seen[1:2] - 4.0 * seen[2:],  # sine of the angle, and its rate
        horizon=50,
        seed=5,
        force=(Normal(0.0, 0.16), lambda s, gust: s.replace(theta_dot=s.theta_dot + gust)),
        failure=lambda now: now.observation[0] < 0.5,  # cosine of the angle
        distance=lambda now: now.observation[0] - 0.5,
    )


def truth(name: str) -> tuple[float, float]:
    """The probability by plain draws, pooled over 16 keys, and its relative standard error."""
    sim, n = simulator(name), SYSTEMS[name].draws
    keys = jax.random.split(jax.random.key(1000), 16)
    p = sum(float(jast.estimate.monte_carlo(key, sim, n).mean) for key in keys) / 16
    return p, math.sqrt((1 - p) / (p * 16 * n))


def figures(name: str, budget: int, keys: int) -> dict[str, Any]:
    """Of a system, in this process, which has done nothing before."""
    sim, about = simulator(name), SYSTEMS[name]
    found = jast.search.falsify(jax.random.key(0), sim)
    wall, cpu = time.perf_counter() - BEGUN, time.process_time()
    from benchmarks import time_to_answer as t  # late: the import makes its own systems

    system = t.System(sim, about.truth, about.error, budget=budget)
    row = t.row_of(name, system, "failure_probability", keys)
    row["plain"] = t.plain_draws(system, row["warm"] or row["first"])
    cold = dict(simulations=found.first_failure, wall_s=wall, cpu_s=cpu)
    return row | dict(budget=budget, to_first_failure=cold)


def lines(block: str) -> dict[str, int]:
    """Lines of code from the first after the imports to the simulator, and those of the one
    statement that makes it; without blank ones.
    """
    text, whole, call = block.splitlines(), 0, 0
    for part in ast.parse(block).body:
        count = sum(bool(line.strip()) for line in text[part.lineno - 1 : part.end_lineno])
        if not isinstance(part, ast.Import | ast.ImportFrom | ast.Expr):
            whole += count
        if isinstance(part, ast.Assign) and ast.unparse(part.targets[0]) == "sim":
            call = count
    return dict(lines=whole, call=call)


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "those of gymnax, two keys")
    add_choices(parser, "--systems", SYSTEMS)
    parser.add_argument("--seeds", type=int, help="keys (default: 20 of gymnax, 2 of the others)")
    parser.add_argument("--truth", action="store_true", help="only draw the truths again")
    parser.add_argument("--lines", action="store_true", help="only count the lines of the guide")
    args = parser.parse_args(argv)
    names = args.systems or size(args, list(SYSTEMS), ["gymnax", "pendulum"], ["gymnax"])
    names = [] if args.lines else names
    say = printer(args)
    absent = [name for name in names if not installed(SYSTEMS[name].library)]
    report: dict[str, Any] = dict.fromkeys(absent)
    for name in report:
        say(f"{name} is left out: {SYSTEMS[name].library} is not installed")
    names = [name for name in names if name not in report]
    if args.truth:
        for name in names:
            report[name] = truth(name)
            say("{}: {:.4g}, relative standard error {:.2g}".format(name, *report[name]))
    elif names:
        say(HEADS[0])
        for name in names:
            door = SYSTEMS[name]
            budget = size(args, door.budget, door.budget, 300_000)
            keys = args.seeds or size(args, door.keys, 2, 1)
            report[name] = in_fresh_process(
                "figures", name, budget, keys, module="doors", settings=NO_CACHE
            )
            say(_row(report[name]))
    if not args.truth:
        report["lines"] = {name: lines(block) for name, block in EXAMPLES.items()}
        say(HEADS[1])
        for name, count in report["lines"].items():
            say(f"| {name} | {count['lines']} | {count['call']} |")
    print_report(args, report)


def _row(r):
    cold, warm = r["to_first_failure"], r["warm"]
    cells = (
        f"{r['system']}, {r['budget']:,}",
        f"{r['truth']:.3g} ({percent(SYSTEMS[r['system']].error)})",
        f"{r['reliable']} of {r['seeds']}",
        f"{percent(r['rms'])} ({percent(r['rms_of_all'])})",
        f"{r['held']} of {r['reliable']}",
        f"{r['first']:.1f}, " + ("-" if warm is None else f"{warm:.1f}"),
        percent(r["plain"]),
        f"{cold['wall_s']:.1f} ({cold['cpu_s']:.1f})",
    )
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
