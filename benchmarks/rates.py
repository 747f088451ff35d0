"""Episodes that a CPU second buys: ``python -m benchmarks.rates [--json] [--quick | --smoke]
[--systems NAME ...] [--methods NAME ...] [--evaluations N] [--families | --tilts]``.

`jast.estimate.monte_carlo`, `jast.estimate.failure_probability` and `jast.stress`, the last two
with 2,097,152 evaluations (or all with ``--evaluations``), beside a minimal loop in one program:
blocks of vectors of normal numbers by `jax.random.normal`, put through ``step`` and ``evaluate``
and counted. All were compiled before (the second call of each is timed), and all in this process,
one after the other. On an accelerator seconds are those of the clock on the wall.

``--families``: what a random number of each family takes in their place, from a normal number,
where its shape is known before the program is compiled, and where it is not; and to compile.

``--tilts``: how many evaluations of a population take as long as a draw of tilts.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

import jast
import jast.distributions as D
from benchmarks.closed_loops import JUDGED, RARE, TUNED
from benchmarks.sizes import add_choices, options, print_report, printer, size
from jast._src.estimate.population.population import episodes_a_second
from jast._src.estimate.proposal_search.search_state import search_context
from jast._src.estimate.tilts.family import TiltFamily
from jast._src.runtime.device import block_size, read_clock

__all__ = ["SYSTEMS", "rates"]

SYSTEMS = {a.name: a.simulator for a in (*TUNED, *JUDGED, *RARE) if a.name not in ("camera", "arm")}
"""Closed loops all of whose random numbers are standard normal ones"""
WIDEST = 2**17
"""Episodes that the minimal loop runs side by side at most: on a CPU it takes 128."""
EVALUATIONS = 2**21
FAMILIES = (
    D.Normal(0.0, 1.0),
    D.Laplace(0.0, 1.0),
    D.StudentT(5.0, 0.0, 1.0),
    D.Gamma(2.0, 1.0),
    D.Beta(2.0, 3.0),
    D.Poisson(4.0),
    D.Binomial(20, 0.3),
)
COLUMNS = "known_us", "solved_us", "known_compile_s", "solved_compile_s"
METHODS = ("monte_carlo", "failure_probability", "stress")


@partial(jax.jit, static_argnames="blocks")
def minimal_loop(key: jax.Array, sim: jast.Simulator, blocks: int) -> jax.Array:
    """Failures among so many blocks of episodes."""
    block_of = block_size(WIDEST)
    start = sim.init(sim.start().sample(seed=key))
    like = sim.disturbance(start).sample(seed=key)
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (block_of, *jnp.shape(a))), start)

    def block(i, count):
        own = jax.random.fold_in(key, i)
        noise = jax.random.normal(own, (sim.horizon, block_of, *like.shape), like.dtype)

        def step(carry, w):
            state, failed, over = carry
            state = jax.vmap(sim.step)(state, w)
            failed = failed | (~over & jax.vmap(sim.evaluate)(state)[0])
            return (state, failed, over | failed | jax.vmap(sim.is_terminal)(state)), None

        none = jnp.zeros(block_of, bool)
        failed = lax.scan(step, (every, none, none), noise)[0][1]
        return count + jnp.sum(failed, dtype=jnp.int32)

    return lax.fori_loop(0, blocks, block, jnp.zeros((), jnp.int32))


def _rate(work: Callable[[int], float]) -> float:
    """Episodes a CPU second of ``work(seed)``, which says how many it ran, by its second call."""
    work(0)
    begun = read_clock()
    done = work(1)
    return done / (read_clock() - begun)


def rates(
    sim: jast.Simulator, episodes: int, evaluations: int, methods: Sequence[str] = METHODS
) -> dict[str, float]:
    """Episodes a CPU second of the minimal loop, and the share of it that each method reaches."""
    blocks = max(episodes // block_size(WIDEST), 1)

    def loop(seed):
        minimal_loop(jax.random.key(seed), sim, blocks).block_until_ready()
        return blocks * block_size(WIDEST)

    calls = dict(
        monte_carlo=lambda key: jast.estimate.monte_carlo(key, sim, episodes).evaluations,
        failure_probability=lambda key: (
            jast.estimate.failure_probability(key, sim, evaluations).evaluations
        ),
        stress=lambda key: jast.stress(key, sim, evaluations).episodes,
    )
    alone = _rate(loop)
    shares = {m: _rate(lambda seed, m=m: calls[m](jax.random.key(seed))) / alone for m in methods}
    return dict(minimal_loop=alone, **shares)


def evaluations_a_draw(sim: jast.Simulator, budget: int) -> float:
    """Evaluations of a population in the time of a draw of tilts, of three Gaussians a number, in
    batches of a call with this ``budget``.
    """
    key = jax.random.key(0)
    f = TiltFamily(sim, budget, search_context(key), components_each=3)
    by_tilts = _rate(lambda seed: len(f.play(f.untilted()).log_weight))
    return episodes_a_second(key, sim) / by_tilts


def families(numbers: int, kinds: Sequence[D.Distribution]) -> list[dict[str, float]]:
    """Of each family microseconds a number, and seconds to compile, by table and solved for."""
    rows, z = [], jax.random.normal(jax.random.key(0), (numbers // 128, 128))
    for d in kinds:
        row, (leaves, tree) = dict(family=type(d).__name__), jax.tree.flatten(d)

        def known(leaves, z, d=d):
            return D.from_normal(d, z)

        def solved(leaves, z, tree=tree):
            return D.from_normal(tree.unflatten(leaves), z)

        for name, one in (("known", known), ("solved", solved)):
            run = jax.jit(lambda p, z, one=one: lax.map(jax.vmap(lambda v: one(p, v)), z))
            begun = read_clock()
            run = run.lower(leaves, z).compile()
            row[f"{name}_compile_s"] = read_clock() - begun
            jax.block_until_ready(run(leaves, z))
            begun = read_clock()
            jax.block_until_ready(run(leaves, z))
            row[f"{name}_us"] = (read_clock() - begun) / z.size * 1e6
        rows.append(row)
    return rows


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "three systems")
    add_choices(parser, "--systems", SYSTEMS)
    add_choices(parser, "--methods", METHODS)
    parser.add_argument("--evaluations", type=int, help="of each method")
    parser.add_argument("--families", action="store_true", help="random numbers, alone")
    parser.add_argument("--tilts", action="store_true", help="draws of tilts, alone")
    args = parser.parse_args(argv)
    say, by_family, kinds = printer(args), [], size(args, FAMILIES, FAMILIES, FAMILIES[-1:])
    if args.families or args.smoke:
        say(f"{'':10s} us a number: known, solved for; compile s: known, solved for")
        by_family = families(size(args, 2**20, 2**18, 2**10), kinds)
        for row in by_family:
            parts = "  ".join(f"{row[k]:8.3f}" for k in COLUMNS)
            say(f"{row['family']:10s} {parts}")
        if args.families:
            return print_report(args, dict(families=by_family))
    names = args.systems or size(args, list(SYSTEMS), ["drone", "grid", "cart-pole"], ["grid"])
    tilts = []
    for name in names if args.tilts or args.smoke else ():
        row = evaluations_a_draw(SYSTEMS[name], size(args, 500_000, 100_000, 2000))
        tilts.append(dict(system=name, evaluations_a_draw=row))
        say(f"{name:12s} a draw of tilts takes as long as {row:.1f} evaluations")
    if args.tilts:
        return print_report(args, dict(tilts=tilts))
    episodes, evaluations = size(args, (2**20, EVALUATIONS), (2**19, EVALUATIONS), (2**12, 2**12))
    if args.evaluations:
        episodes = evaluations = args.evaluations
    methods = args.methods or METHODS
    rows = []
    for name in names:
        with warnings.catch_warnings(action="ignore"):
            rows.append(dict(system=name, **rates(SYSTEMS[name], episodes, evaluations, methods)))
        shares = "  ".join(f"{m} {rows[-1][m]:.3f}" for m in methods)
        say(f"{name:12s} minimal loop {rows[-1]['minimal_loop']:9.0f} a CPU second; {shares}")
    print_report(
        args,
        dict(
            episodes=episodes,
            evaluations=evaluations,
            rows=rows,
            families=by_family,
            tilts=tilts,
        ),
    )


if __name__ == "__main__":
    main()
