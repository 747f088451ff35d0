"""Speed of the tree search, in CPU time of this process and as ratios within one run: ``python -m
benchmarks.engine [--json] [--quick]``.

Rates are simulations (episodes) per CPU second, compilation excluded; each figure is the best of
several alternated repetitions, which on a shared machine is the least disturbed one. The rates are
those of one core: they are measured in a process whose XLA has one thread (``PJRT_NPROC=1``); with
more it cuts kernels over threads, which wait for each other at the cost of CPU time. The search's
own threads, which use all cores, are measured in ``cores``.
"""

import argparse
import functools
import json
import os
import subprocess
import sys
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial

import jast
from benchmarks import reference
from jast.counter import tree_keys
from jast.progress import Progress, begin
from jast.rewards import as_pytree
from jast.search.forest import MODES
from jast.search.tree import run
from jast.search.tree.layout import choose_rollout, take
from jast.search.tree.settings import problem_of, settled
from jast.simulator import Simulator

REWARD = jast.rewards.standard(event_bonus=30.0, density="mode")
BOX = jast.actions.uniform(0.0, 1.0)


def problem(total, mode="paper", sim=None, reward=REWARD, actions=BOX):
    """What `jast.search.forest` grows in this mode."""
    sim = jast.simulators.ferry() if sim is None else sim
    chosen = settled("forest", MODES, mode, actions)
    return problem_of(sim, as_pytree(reward), actions, chosen, 10.0, total)


def cpu(function):
    """CPU and wall seconds of one call."""
    start = time.process_time(), time.perf_counter()
    jax.block_until_ready(function())
    return time.process_time() - start[0], time.perf_counter() - start[1]


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
            draw = lambda k, tree_key, t, p: take(
                problem, t, p, choose_rollout(problem, k, tree_key, t, p.state)
            )
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


def first_turn(problem, keys, capacity, simulations=500):
    """The first simulations of trees with this much room; making the trees is not counted."""
    tree = jax.block_until_ready(run._make(problem, keys, capacity, "node"))
    return cpu(lambda: run._grow(problem, tree, 0, simulations, "node").log)


def rates(repeats, lanes=200, prunes=18, simulations=500):
    keys, total = tree_keys(jax.random.key(0), lanes), prunes * simulations
    problems = {mode: problem(total, mode) for mode in MODES}
    children = {mode: int(p.settings.widths.max()) for mode, p in problems.items()}
    runs = {
        "rollouts": lambda: rollouts(problems["paper"], keys, 1000),
        "forest, paper": lambda: whole(
            problems["paper"], keys, prunes, simulations, children["paper"]
        ),
        "forest, default": lambda: whole(
            problems["default"], keys, prunes, simulations, children["default"]
        ),
    }
    episodes = {
        "rollouts": 1000 * lanes,
        "forest, paper": total * lanes,
        "forest, default": total * lanes,
    }
    best = {name: float("inf") for name in runs}
    ratio = {name: 0.0 for name in runs}
    plain = 0.0
    for function in runs.values():
        cpu(function)
    for seed in range(repeats):
        now = {name: episodes[name] / cpu(function)[0] for name, function in runs.items()}
        start = time.process_time()
        done = sum(reference.forest(10 * seed + k)[1] for k in range(3))
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


def capacity(repeats, lanes=200):
    """Cost of the first 500 simulations in trees with room for 10,000, to that in trees with room
    for 500: 1 where nothing copies the tree.
    """
    keys = tree_keys(jax.random.key(0), lanes)
    small, large = problem(500), problem(10_000)
    pairs = [
        (first_turn(large, keys, 10_000)[0], first_turn(small, keys, 500)[0])
        for _ in range(repeats + 1)
    ][1:]
    return {
        "ratio_10000_to_500": min(a for a, _ in pairs) / min(b for _, b in pairs),
        "us_per_lockstep_500": min(b for _, b in pairs) / 500 * 1e6,
    }


def cores(repeats, trees=200):
    """How many times faster two threads, of half of the trees each, are than one, in wall time."""
    search = lambda threads: jast.search.forest(
        jax.random.key(0),
        jast.simulators.ferry(),
        trees=trees,
        prunes=6,
        reward=REWARD,
        actions=BOX,
        mode="paper",
        threads=threads,
        lanes=trees // 2,
    )
    pairs = [
        (
            cpu(lambda: search(1).best_reward_per_tree)[1],
            cpu(lambda: search(2).best_reward_per_tree)[1],
        )
        for _ in range(repeats + 1)
    ][1:]
    return {"two_to_one": max(one / two for one, two in pairs), "pairs_wall_s": pairs}


ONE_THREAD = {"PJRT_NPROC": "1"}
NO_CACHE = {"JAX_ENABLE_COMPILATION_CACHE": "false"}


def alone(name, *arguments, module="engine", settings=ONE_THREAD):
    """A measurement of this module, or of another benchmark, in a process of its own with these
    environment variables: an XLA of one thread, say.
    """
    code = (
        f"import json; from benchmarks import {module};"
        f" print(json.dumps({module}.{name}(*{arguments!r})))"
    )
    env = os.environ | settings | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return json.loads(
        subprocess.run(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True, env=env
        ).stdout.splitlines()[-1]
    )


def compile_time(total=9000, lanes=100):
    """Seconds to trace and compile what a forest on S0 runs."""
    p, keys, out = problem(total, "default"), tree_keys(jax.random.key(0), lanes), {}
    jax.block_until_ready(p.settings.widths)
    start = time.perf_counter()

    def lap(name):
        nonlocal start
        out[name], start = time.perf_counter() - start, time.perf_counter()

    tree = jax.eval_shape(lambda: run.make(p, run._shared(p), keys, total, "node"))
    lap("trace of the arrays")
    run._grow.lower(p, tree, 0, 500, "node").compile()
    lap("grow")
    run._make.lower(p, keys, total, "node").compile()
    lap("make")
    run._prune.lower(p, tree, 191, "node").compile()
    lap("prune")
    return out


def slow_ferry(substeps):
    """S0 with a step that takes ``substeps`` times the arithmetic and ends in the same place. One
    program serves every number of substeps.
    """
    sim = jast.simulators.ferry()
    step = Partial(_slow_step, sim.step, jnp.int32(substeps))
    return Simulator(
        sim.init,
        step,
        sim.disturbance,
        sim.evaluate,
        sim.horizon,
        is_terminal=sim.is_terminal,
        observe=sim.observe,
    )


def _slow_step(step, substeps, state, a):
    def burn(_, heading):
        return jnp.arctan2(jnp.sin(heading), jnp.cos(heading))

    after = step(state, a)
    return after._replace(heading=lax.fori_loop(0, substeps, burn, after.heading))


def memoization(lanes, prunes, simulations):
    """CPU time of the memoization modes, to that with states at every node, on the cheap S0 and one
    of 200 substeps.
    """
    keys, out = tree_keys(jax.random.key(0), lanes), {}
    for name, sim in (("S0", None), ("200 substeps", slow_ferry(200))):
        p = problem(prunes * simulations, sim=sim)
        children = int(p.settings.widths.max())
        runs = {
            mode: functools.partial(whole, p, keys, prunes, simulations, children, mode)
            for mode in ("node", "root", "none")
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
            return (
                after.reward - jnp.where(gone, after.reward, at.progress.reward),
                gone,
                At(at.level + 1, after),
            )

        reward, gone, after = jax.vmap(one)(action, embedding)
        shape = (*action.shape, 10)
        return (
            mctx.RecurrentFnOutput(
                reward=reward,
                discount=jnp.where(gone, 0.0, 1.0),
                prior_logits=jnp.zeros(shape),
                value=jnp.zeros(action.shape),
            ),
            after,
        )

    @jax.jit
    def policy(key):
        start = At(jnp.int32(0), begin(sim, REWARD, ()))
        start = jax.tree.map(lambda a: jnp.broadcast_to(a, (lanes, *jnp.shape(a))), start)
        root = mctx.RootFnOutput(
            prior_logits=jnp.zeros((lanes, 10)), value=jnp.zeros(lanes), embedding=start
        )
        return mctx.muzero_policy(
            (), key, root, recurrent, simulations, dirichlet_fraction=0.0
        ).action

    keys = tree_keys(jax.random.key(0), lanes)
    theirs, ours = (
        lambda: policy(jax.random.key(1)),
        lambda: first_turn(p, keys, simulations, simulations),
    )
    cpu(theirs), ours()
    pairs = [(cpu(theirs)[0], ours()[0]) for _ in range(repeats)]
    n = lanes * simulations
    return {
        "mctx": n / min(a for a, _ in pairs),
        "jast": n / min(b for _, b in pairs),
        "ratio": min(a for a, _ in pairs) / min(b for _, b in pairs),
    }


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.engine", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--quick", action="store_true", help="fewer repetitions, smaller memoization runs"
    )
    args = parser.parse_args(argv)
    repeats = 2 if args.quick else 5
    p = problem(9000)
    one = run.bytes_per_tree(p, run.Plan(18, 500, 1, "node"))
    report = {
        "processors": (
            len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        ),
        "bytes_per_tree_of_9000": one,
        "bytes_per_node": one / 9000,
        **alone("rates", repeats),
        "capacity": alone("capacity", repeats),
        "cores": cores(repeats),
        "peer_at_200_x_500": alone("peer", repeats),
        "compile_s": alone("compile_time", settings=NO_CACHE),
        "memoization": alone("memoization", *((32, 4, 100) if args.quick else (100, 18, 100))),
    }
    if args.json:
        print(json.dumps(report, indent=1))
        return
    for name, value in report.items():
        print(f"{name}: {json.dumps(value, default=str)}")


if __name__ == "__main__":
    main()
