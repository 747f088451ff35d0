"""What a first call costs: ``python -m benchmarks.first_minute [--json] [--quick | --smoke]
[--systems NAME ...] [--ways]``.

Each system has a process of its own, without a cache of compiled programs, that makes one call four
times: the first, the same again, with another key, and with another budget. Of each: CPU seconds,
seconds of the clock, programs that were compiled, seconds that tracing, lowering and compiling
took, and how many of the programs contain the user's ``step``. Then the CPU time of loading jast
over that of importing JAX, and the first and the second ``python -m jast``, from an empty cache.
Systems of other people's libraries are left out where the library is not installed.
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

import jast
from benchmarks.doors import simulator
from benchmarks.sizes import (
    NO_CACHE,
    add_choices,
    in_fresh_process,
    installed,
    options,
    print_report,
    printer,
    size,
)
from jast._src.normal_space.transform import dimension, outcome
from jast._src.runtime import _jax
from jast.distributions import Normal

__all__ = ["SYSTEMS", "calls"]

MARK = "the_users_step"
"""Stands in the text of each program that contains the step."""
TIMES = ("jaxpr_trace_duration", "jaxpr_to_mlir_module_duration", "backend_compile_duration")
LANES = 128  # episodes side by side
TIMES_PLAYED = 10  # after compilation
IMPORTED = {
    "import jast": "import jast",
    "jast.Simulator and distributions": "import jast; jast.Simulator, jast.distributions.Normal",
    "jast.stress": "import jast; jast.stress",
}
"""What is loaded when it is first asked for, beside ``import jax``."""
IMPORTS = 5
"""Fresh processes, of which the quickest counts."""


def lane() -> jast.Simulator:
    """The car of the README."""

    def step(car, gust):
        offset, speed = car
        speed = 0.8 * speed - 0.3 * offset + 0.1 * gust
        return jnp.stack([offset + speed, speed])

    def off(car):
        return jnp.maximum(1.4 - jnp.abs(car[0]), 0.0)

    return jast.Simulator(
        init=lambda x0: jnp.zeros(2),
        step=step,
        disturbance=lambda car: Normal(0.0, 1.0),
        evaluate=lambda car: (jnp.abs(car[0]) >= 1.4, off(car)),
        horizon=30,
    )


def plane() -> jast.Simulator:
    """A plane in twenty numbers: P = Phi(-4.75) = 1.02e-6."""
    return jast.simulators.limit_state(lambda z: 4.75 - jnp.sum(z) / jnp.sqrt(20.0), 20)


STRESS, PROBABILITY = jast.stress, jast.estimate.failure_probability
SYSTEMS: dict[str, tuple[Callable, Callable, tuple, str]] = {
    "lane": (lane, STRESS, (None, 1_000_000), ""),
    "ferry": (jast.simulators.ferry, STRESS, (None, 100_000), ""),
    "plane of 20 numbers": (plane, PROBABILITY, (100_000, 150_000), ""),
    "gymnax CartPole": (partial(simulator, "gymnax"), STRESS, (20_000, 30_000), "gymnax"),
    "MJX cart-pole": (partial(simulator, "MJX"), STRESS, (5_000, 8_000), "mujoco"),
    "brax inverted pendulum": (partial(simulator, "brax"), STRESS, (5_000, 8_000), "brax"),
}
"""Name -> simulator, call, its budget and another one, and the library that it is made of."""


def calls(name: str, least: bool) -> list[dict[str, float]]:
    """What each of the four calls of a system takes, in this process."""
    make, call, budgets, _ = SYSTEMS[name]
    budget, another = (2000, 3000) if least else budgets
    sim = make()
    named = jax.named_scope(MARK)(sim.step)
    sim = dataclasses.replace(sim, step=lambda s, x: named(s, x))
    one, other = jax.random.split(jax.random.key(0))
    rows, events = [], []

    def heard(event, seconds, **_):
        return events.append((event.rsplit("/", 1)[1], seconds))

    jax.monitoring.register_event_duration_secs_listener(heard)
    with tempfile.TemporaryDirectory() as folder:
        for key, evaluations in ((one, budget), (one, budget), (other, budget), (one, another)):
            events.clear()
            texts = Path(tempfile.mkdtemp(dir=folder))
            jax.config.update("jax_dump_ir_to", str(texts))
            cpu, wall = time.process_time(), time.perf_counter()
            call(key, sim, evaluations)
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            rows.append(
                {
                    "cpu_s": cpu,
                    "wall_s": wall,
                    "programs": sum(event == TIMES[-1] for event, _ in events),
                    "compilation_s": sum(s for event, s in events if event in TIMES),
                    "with_step": sum(MARK in text.read_text() for text in texts.iterdir()),
                }
            )
    return rows


def ways(make: Callable) -> list[tuple[float, float]]:
    """(CPU seconds to compile, microseconds an episode) of a program that plays `LANES` episodes
    side by side: as JAX does, as `runtime._jax` does briefly, and quickly.
    """
    sim = make()
    z = jax.random.normal(jax.random.key(0), (LANES, dimension(sim)))
    play = jax.jit(jax.vmap(lambda z: outcome(sim, z).distance)).lower(z)
    rows = []
    for how in ({}, _jax._BRIEFLY, _jax._QUICKLY):
        begin = time.process_time()
        run = play.compile(compiler_options=how)
        compiled = time.process_time() - begin
        jax.block_until_ready(run(z))
        begin = time.process_time()
        for _ in range(TIMES_PLAYED):
            jax.block_until_ready(run(z))
        seconds = (time.process_time() - begin) / (TIMES_PLAYED * LANES)
        rows.append((compiled, seconds * 1e6))
    return rows


def loading(code: str, times: int) -> float:
    """CPU seconds of a fresh process that runs ``code``, the least of so many ``times``."""
    code = f"{code}; import time; print(time.process_time())"
    command = [sys.executable, "-c", code]
    run = partial(subprocess.run, command, check=True, capture_output=True, text=True)
    return min(float(run().stdout) for _ in range(times))


def command_line(arguments: list[str]) -> list[float]:
    """Seconds of the clock of the first and the second ``python -m jast``."""
    with tempfile.TemporaryDirectory() as folder:
        kept = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/programs"}
        command = [sys.executable, "-m", "jast", *arguments, "--output", f"{folder}/out"]
        seconds = []
        for _ in range(2):
            begin = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True, env=os.environ | kept)
            seconds.append(time.perf_counter() - begin)
    return seconds


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "lane and plane, without the command line")
    add_choices(parser, "--systems", SYSTEMS)
    parser.add_argument(
        "--ways", action="store_true", help="what each way of compiling costs and gives, alone"
    )
    args = parser.parse_args(argv)
    say, few = printer(args), ["lane", "plane of 20 numbers"]
    names = args.systems or size(args, list(SYSTEMS), few, few[-1:])
    absent = [name for name in names if not installed(SYSTEMS[name][3] or "jast")]
    if args.ways:
        found = {name: ways(SYSTEMS[name][0]) for name in names if name not in absent}
        say(f"{'':32}{'as JAX does':>20}{'briefly':>20}{'quickly':>20}   compile s, us an episode")
        for name, rows in found.items():
            say(f"{name:32}" + "".join(f"{c:10.2f}{us:10.1f}" for c, us in rows))
        return print_report(args, found)
    results = {}
    say(f"{'call':32}{'CPU s':>8}{'wall s':>8}{'programs':>10}{'compile s':>11}{'step in':>9}")
    for name in names:
        results[name] = None
        if name in absent:
            say(f"{name:32}{SYSTEMS[name][3]} is not installed")
            continue
        results[name] = in_fresh_process(
            "calls", name, args.smoke, module="first_minute", settings=NO_CACHE
        )
        which = ("first", "again", "another key", "another budget")
        for kind, row in zip(which, results[name], strict=True):
            cpu, wall, programs, compilation, steps = row.values()
            label = f"{name}, {kind}"
            say(f"{label:32}{cpu:8.1f}{wall:8.1f}{programs:10}{compilation:11.1f}{steps:9}")
    times = size(args, IMPORTS, IMPORTS, 1)
    jax_alone = loading("import jax", times)
    for what, code in IMPORTED.items():
        ratio = results[f"{what} / import jax"] = loading(code, times) / jax_alone
        say(f"{what} / import jax: {ratio:.2f}")
    if not (args.quick or args.smoke):
        first, second = results["python -m jast"] = command_line([])
        say(f"python -m jast: {first:.1f} s, then {second:.1f} s")
    print_report(args, results)


if __name__ == "__main__":
    main()
