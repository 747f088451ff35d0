"""Speed of the tree search, in CPU time of this process and as ratios within one run: ``python -m
benchmarks.engine [--json] [--quick | --smoke]``.

Rates are simulations (episodes) per CPU second, compilation excluded; each figure is the best of
several alternated repetitions, which on a shared machine is the least disturbed one. The rates are
those of one core: they are measured in a process whose XLA has one thread (``PJRT_NPROC=1``); with
more it cuts kernels over threads, which wait for each other at the cost of CPU time. The search's
own threads, which use all cores, are measured in ``cores``.
"""

import dataclasses
import functools
import json
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial

import jast
from benchmarks import reference
from benchmarks.sizes import (
    NO_CACHE,
    in_fresh_process,
    in_this_process,
    options,
    print_report,
    processors,
    size,
    timed,
)
from jast._src.core.counter_prng import tree_keys
from jast._src.core.transition import Progress, begin
from jast._src.search.forest import MODES
from jast._src.search.tree import run
from jast._src.search.tree.layout import choose_rollout, take
from jast._src.search.tree.settings import mode_settings, problem_of
from jast.rewards import as_pytree

REWARD = jast.rewards.standard(event_bonus=30.0, density="mode")
BOX = jast.actions.uniform(0.0, 1.0)


def problem(total, mode="paper", sim=None, reward=REWARD, actions=BOX):
    """What `jast.search.forest` grows in this mode."""
    sim = jast.simulators.ferry() if sim is None else sim
    chosen = mode_settings("forest", MODES, mode, actions)
    return problem_of(sim, as_pytree(reward), actions, chosen, 10.0, total)


def cpu(function):
    """CPU and wall seconds of one call."""
    return timed(function)[1:]


@functools.partial(jax.jit, static_argnames="simulations")
def rollouts(problem, keys, simulations):
    """Plain random rollouts of the same simulator, reward and random numbers: the best reward of
    each lane.
    """

    def one(i, best):
        key = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, i)
        first = jax.vmap(lambda _: begin(problem.sim, problem.reward, ()))(keys)

        def roll(carry):
            level, at = carry

            def draw(k, tree_key, t, p):
                return take(problem, t, p, choose_rollout(problem, k, tree_key, t, p.state))

            after = jax.vmap(draw)(key, keys, level, at)
            kept = jax.tree.map(lambda a, b: jnp.where(at.done, a, b), at[1:], after[1:])
            return level + 1, Progress(after.state, *kept)._replace(log_prob=at.log_prob)

        _, end = lax.while_loop(
            lambda c: jnp.any(~c[1].done), roll, (jnp.zeros(keys.shape, jnp.int32), first)
        )
        return jnp.maximum(best, end.reward)

    return lax.fori_loop(0, simulations, one, jnp.full(keys.shape, -jnp.inf))


def whole(problem, keys, prunes, simulations, children, memoize="node"):
    """The trees of a forest in one thread, without its result."""
    tree = run._make(problem, keys, prunes * simulations, memoize)
    for turn in range(prunes):
        tree = run._grow(problem, tree, turn * simulations, (turn + 1) * simulations, memoize)
        tree, _ = run._prune(problem, tree, children, memoize)
    return tree


def first_turn(problem, keys, capacity, simulations):
    """The first simulations of trees with this much room; making the trees is not counted."""
    tree = jax.block_until_ready(run._make(problem, keys, capacity, "node"))
    return cpu(lambda: run._grow(problem, tree, 0, simulations, "node").log)


def rates(repeats, lanes=200, prunes=18, simulations=500, plain_trees=3):
    keys, total = tree_keys(jax.random.key(0), lanes), prunes * simulations
    problems = {mode: problem(total, mode) for mode in MODES}
    children = {mode: int(p.settings.widths.max()) for mode, p in problems.items()}
    runs = {"rollouts": lambda: rollouts(problems["paper"], keys, 2 * simulations)}
    for mode in ("paper", "default"):
        of_mode = problems[mode], keys, prunes, simulations, children[mode]
        runs[f"forest, {mode}"] = functools.partial(whole, *of_mode)
    episodes = {name: total * lanes for name in runs} | {"rollouts": 2 * simulations * lanes}
    best = {name: float("inf") for name in runs}
    ratio = {name: 0.0 for name in runs}
    plain = 0.0
    for function in runs.values():
        cpu(function)
    for seed in range(repeats):
        now = {name: episodes[name] / cpu(function)[0] for name, function in runs.items()}
        start = time.process_time()
        done = sum(reference.forest(10 * seed + k)[1] for k in range(plain_trees))
        plain = max(plain, done / (time.process_time() - start))
        for name, rate in now.items():
            best[name] = min(best[name], 1 / rate)
            ratio[name] = max(ratio[name], rate / now["rollouts"])
    rate = {name: 1 / seconds for name, seconds in best.items()}
    return {
        "simulations_per_cpu_s": rate | {"plain Python reference": plain},
        "to_rollouts": {name: ratio[name] for name in runs if name != "rollouts"},
        "to_reference": {name: rate[name] / plain for name in runs if name != "rollouts"},
    }


def capacity(repeats, lanes=200, few=500, many=10_000):
    """Cost of the first 500 simulations in trees with room for 10,000, to that in trees with room
    for 500: 1 where nothing copies the tree.
    """
    keys = tree_keys(jax.random.key(0), lanes)
    small, large = problem(few), problem(many)
    pairs = [
        (first_turn(large, keys, many, few)[0], first_turn(small, keys, few, few)[0])
        for _ in range(repeats + 1)
    ][1:]
    return {
        f"ratio_{many}_to_{few}": min(a for a, _ in pairs) / min(b for _, b in pairs),
        f"us_per_lockstep_{few}": min(b for _, b in pairs) / few * 1e6,
    }


def cores(repeats, trees=200, prunes=6, simulations=500):
    """How many times faster two threads, of half of the trees each, are than one, in wall time."""
    sizes = dict(trees=trees, prunes=prunes, simulations=simulations, lanes=trees // 2)
    how = dict(reward=REWARD, actions=BOX, mode="paper")
    key, sim = jax.random.key(0), jast.simulators.ferry()

    def search(threads):
        found = jast.search.forest(key, sim, threads=threads, **sizes, **how)
        return found.best_reward_per_tree

    pairs = [
        [cpu(functools.partial(search, threads))[1] for threads in (1, 2)]
        for _ in range(repeats + 1)
    ][1:]
    return {"two_to_one": max(one / two for one, two in pairs), "pairs_wall_s": pairs}


def compile_time(total=9000, lanes=100):
    """Seconds to trace and compile what a forest on S0 runs."""
    p, keys, out = problem(total, "default"), tree_keys(jax.random.key(0), lanes), {}
    children = int(p.settings.widths.max())
    start = time.perf_counter()

    def lap(name):
        nonlocal start
        out[name], start = time.perf_counter() - start, time.perf_counter()

    tree = jax.eval_shape(lambda: run.make(p, keys, total, "node"))
    lap("trace of the arrays")
    run._grow.lower(p, tree, 0, 500, "node").compile()
    lap("grow")
    run._make.lower(p, keys, total, "node").compile()
    lap("make")
    run._prune.lower(p, tree, children, "node").compile()
    lap("prune")
    return out


def slow_ferry(substeps):
    """S0 with a step that takes ``substeps`` times the arithmetic and ends in the same place. One
    program serves every number of substeps.
    """
    sim = jast.simulators.ferry()
    return dataclasses.replace(sim, step=Partial(_slow_step, sim.step, jnp.int32(substeps)))


def _slow_step(step, substeps, state, a):
    def burn(_, heading):
        return jnp.arctan2(jnp.sin(heading), jnp.cos(heading))

    after = step(state, a)
    return after._replace(heading=lax.fori_loop(0, substeps, burn, after.heading))


SLOWED = ((None, "S0"), (200, "200 substeps"))


def memoization(lanes, prunes, simulations, systems=SLOWED, memoize=("node", "root", "none")):
    """CPU time of the memoization modes, to that with states at every node, on the cheap S0 and one
    of 200 substeps.
    """
    keys, out = tree_keys(jax.random.key(0), lanes), {}
    for substeps, name in systems:
        sim = None if substeps is None else slow_ferry(substeps)
        p = problem(prunes * simulations, sim=sim)
        children = int(p.settings.widths.max())
        runs = {
            mode: functools.partial(whole, p, keys, prunes, simulations, children, mode)
            for mode in memoize
        }
        for function in runs.values():
            cpu(function)
        seconds = {mode: min(cpu(function)[0] for _ in range(2)) for mode, function in runs.items()}
        out[name] = {mode: s / seconds["node"] for mode, s in seconds.items()}
    return out


class At(NamedTuple):
    """Where mctx's search stands."""

    level: jax.Array
    progress: Progress


def peer(repeats, lanes=200, simulations=500):
    """Simulations per CPU second of mctx's MuZero policy on S0 with 10 actions and no rollouts,
    beside the forest's first root with its rollouts.
    """
    try:
        import mctx
    except ImportError:
        return "mctx is not installed: pip install jast[benchmark]"
    p = problem(simulations)
    sim = p.sim

    def recurrent(params, key, action, embedding):
        def one(a, at):
            after = take(p, at.level, at.progress, ((), (a.astype(jnp.float32) + 0.5) / 10))
            gone = at.progress.done
            after = jax.tree.map(lambda x, y: jnp.where(gone, x, y), at.progress, after)
            gain = after.reward - jnp.where(gone, after.reward, at.progress.reward)
            return gain, gone, At(at.level + 1, after)

        reward, gone, after = jax.vmap(one)(action, embedding)
        shape = action.shape
        found = dict(prior_logits=jnp.zeros((*shape, 10)), value=jnp.zeros(shape))
        discount = jnp.where(gone, 0.0, 1.0)
        return mctx.RecurrentFnOutput(reward=reward, discount=discount, **found), after

    @jax.jit
    def policy(key):
        start = At(jnp.int32(0), begin(sim, REWARD, ()))
        start = jax.tree.map(lambda a: jnp.broadcast_to(a, (lanes, *jnp.shape(a))), start)
        root = mctx.RootFnOutput(
            prior_logits=jnp.zeros((lanes, 10)), value=jnp.zeros(lanes), embedding=start
        )
        settings = dict(dirichlet_fraction=0.0)
        return mctx.muzero_policy((), key, root, recurrent, simulations, **settings).action

    keys = tree_keys(jax.random.key(0), lanes)
    theirs = functools.partial(policy, jax.random.key(1))
    ours = functools.partial(first_turn, p, keys, simulations, simulations)
    cpu(theirs), ours()
    pairs = [(cpu(theirs)[0], ours()[0]) for _ in range(repeats)]
    n = lanes * simulations
    return {
        "mctx": n / min(a for a, _ in pairs),
        "jast": n / min(b for _, b in pairs),
        "ratio": min(a for a, _ in pairs) / min(b for _, b in pairs),
    }


def main(argv=None):
    args = options(__doc__, "fewer repetitions, smaller memoization runs").parse_args(argv)
    repeats = size(args, 5, 2, 1)
    measure = functools.partial(
        in_this_process if args.smoke else in_fresh_process, module="engine"
    )

    def least(*arguments):
        return arguments if args.smoke else ()

    one = run.bytes_per_tree(problem(9000), run.Plan(18, 500, 1, "node"))
    smallest = (2, 2, 45, [(1, "1 substep")], ["node", "none"])
    systems = size(args, (100, 18, 100), (32, 4, 100), smallest)
    report = {
        "processors": processors(),
        "bytes_per_tree_of_9000": one,
        "bytes_per_node": one / 9000,
        **measure("rates", repeats, *least(2, 2, 45, 1)),
        "capacity": measure("capacity", repeats, *least(2, 90, 180)),
        "cores": cores(repeats, *least(2, 2, 45)),
        "peer_at_200_x_500": measure("peer", repeats, *least(2, 20)),
        "compile_s": measure("compile_time", *least(90, 2), settings=NO_CACHE),
        "memoization": measure("memoization", *systems),
    }
    print_report(args, report, "\n".join(f"{k}: {json.dumps(v)}" for k, v in report.items()))


if __name__ == "__main__":
    main()
