"""Closed loops that nobody chose: ``python -m benchmarks.random_loops [--json] [--quick | --smoke]
[--loops FROM TO] [--keys N] [--draws N] [--budget N] [--stress]``.

Each is drawn by its number: a linear plant of 2 to 4 states under linear feedback of 50 to 150
steps, whose actuator clips, is limited in rate, has a dead zone or is a relay, whose controller may
latch, whose sensor may be noisy or drop out; disturbed by normal, Laplace or uniform numbers or by
jumps. It fails by leaving, by leaving to one side, by staying outside, by leaving after a latch, or
by its energy. Its miss distance is the true one, a coarse one, a constant, or that of another
quantity. The threshold is the quantile of plain draws at 3e-5 to 1e-3.

The truth is that of further plain draws. `jast.estimate.failure_probability` is called as it comes,
or `jast.stress`, whose likeliest failure is told beside its probability. Where both have an error,
``z`` is how many standard errors they are apart.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax import lax

import jast
from benchmarks.closed_loops import LANES
from benchmarks.sizes import options, percent, print_report, printer, size, timed
from benchmarks.time_to_answer import System, plain_draws
from jast._src.normal_space.transform import dimension, simulate
from jast.distributions import Bernoulli, Joint, Laplace, Normal, Uniform

THRESHOLD_DRAWS = 200_000
LEAST_TARGET = 3e-5
"""Probability at which so many draws still tell a quantile."""
NOISE = {
    "normal": Normal(0.0, 1.0),
    "laplace": Laplace(0.0, 0.7),
    "uniform": Uniform(-1.7, 1.7),
    "jumps": Normal(0.0, 0.3),
}
FAR = 1e4
"""Where an unstable plant is held, so that its numbers stay finite."""


class State(NamedTuple):
    """Of a loop."""

    x: jax.Array
    """[n] of the plant"""
    reading: jax.Array
    """The sensor's last one"""
    command: jax.Array
    latch: jax.Array
    """0, 1, or the steps that a timer still runs"""
    recent: jax.Array
    """[hold] what fails, at the last steps"""
    energy: jax.Array


class RandomLoop(NamedTuple):
    """What is drawn for a loop."""

    plant: tuple[jax.Array, jax.Array, jax.Array]
    """x' = A x + b u + g w"""
    feedback: jax.Array
    horizon: int
    noise: str
    dropout: bool
    noisy: bool
    """Whether the sensor is"""
    actuator: str
    latch: str
    failure: str
    distance: str
    limit: float
    """Of the actuator"""
    sigma: float
    """Of the sensor's noise"""
    trip: float
    """Reading that latches"""
    hold: int
    """Steps that it stays outside, to fail so"""
    target: float

    def __str__(self) -> str:
        sensor = " dropouts" * self.dropout + " noisy sensor" * self.noisy
        return (
            f"{len(self.feedback)} states, {self.horizon} steps, {self.noise}{sensor},"
            f" {self.actuator}, latch {self.latch}, fails {self.failure}, distance {self.distance}"
        )


def draw_loop(number: int) -> RandomLoop:
    """The loop of this number."""
    rng = np.random.default_rng(number)
    n, horizon = int(rng.integers(2, 5)), int(rng.choice([50, 80, 120, 150]))
    a = rng.standard_normal((n, n))
    a *= rng.uniform(0.9, 1.02) / np.abs(np.linalg.eigvals(a)).max()
    b, g = rng.standard_normal((n, 1)), rng.standard_normal(n)
    g /= np.linalg.norm(g)
    cost = scipy.linalg.solve_discrete_are(a, b, np.eye(n), np.eye(1) * rng.uniform(0.1, 3))
    feedback = np.linalg.solve(np.eye(1) + b.T @ cost @ b, b.T @ cost @ a)[0]
    drawn = dict(
        noise=str(rng.choice(list(NOISE), p=[0.45, 0.2, 0.15, 0.2])),
        dropout=bool(rng.random() < 0.35),
        noisy=bool(rng.random() < 0.5),
        actuator=str(rng.choice(["clip", "rate", "dead zone", "relay", "linear"])),
        latch=str(rng.choice(["none", "off", "gain", "timer"], p=[0.4, 0.2, 0.2, 0.2])),
        failure=str(
            rng.choice(
                ["outside", "one side", "staying", "latched", "energy"],
                p=[0.3, 0.2, 0.2, 0.15, 0.15],
            )
        ),
        distance=str(
            rng.choice(["true", "coarse", "constant", "another"], p=[0.55, 0.2, 0.1, 0.15])
        ),
        limit=float(rng.uniform(0.5, 2)),
        sigma=float(rng.uniform(0.1, 0.6)),
        trip=float(rng.uniform(1, 2.5)),
        hold=int(rng.integers(2, 6)),
        target=float(10 ** rng.uniform(-5, -3)),
    )
    if drawn["failure"] == "latched" and drawn["latch"] == "none":
        drawn["latch"] = "gain"
    single = partial(jnp.asarray, dtype=jnp.float32)
    plant = single(a), single(b[:, 0]), single(g)
    return RandomLoop(plant=plant, feedback=single(feedback), horizon=horizon, **drawn)


def disturbance(loop: RandomLoop, state: State) -> Any:
    """The noise, whether it jumps, the sensor's noise, and whether its reading is lost."""
    parts = [NOISE[loop.noise]]
    parts += [Bernoulli(probs=0.03)] * (loop.noise == "jumps")
    parts += [Normal(0.0, 1.0)] * loop.noisy + [Bernoulli(probs=0.2)] * loop.dropout
    return parts[0] if len(parts) == 1 else Joint(tuple(parts))


def step(loop: RandomLoop, s: State, w: Any) -> State:
    """One step of plant, sensor and controller."""
    w = list(w) if isinstance(w, tuple) else [w]
    push = w.pop(0)
    if loop.noise == "jumps":
        push = push + 3.0 * w.pop(0)
    reading = s.x[0] + loop.sigma * w.pop(0) if loop.noisy else s.x[0]
    if loop.dropout:
        reading = jnp.where(w.pop(0) > 0, s.reading, reading)
    wanted, latch = _latched(loop, s, reading, -loop.feedback @ s.x.at[0].set(reading))
    command = _actuate(loop, s, wanted)
    a, b, g = loop.plant
    x = jnp.clip(a @ s.x + b * command + g * push, -FAR, FAR)
    value = jnp.abs(x[0]) if loop.failure in ("outside", "energy") else x[0]
    if loop.failure == "latched":
        value = jnp.where(latch > 0, x[0], x[0] - 100.0)
    recent = jnp.concatenate([s.recent[1:], value[None]])
    return State(x, reading, command, latch, recent, 0.9 * s.energy + x[0] ** 2)


def _latched(loop, s, reading, wanted):
    """What the controller wants, and its latch, by the reading."""
    trip, latch = loop.trip, s.latch
    if loop.latch == "off":
        latch = jnp.maximum(latch, 1.0 * (jnp.abs(reading) > 2 * trip))
        wanted = jnp.where(latch > 0, 0.3 * wanted, wanted)
    if loop.latch == "gain":
        latch = jnp.maximum(latch, 1.0 * (jnp.abs(reading) > trip))
        wanted = jnp.where(latch > 0, 0.5 * wanted, wanted)
    if loop.latch == "timer":
        latch = jnp.where(jnp.abs(reading) > trip, 5.0, jnp.maximum(latch - 1, 0.0))
        wanted = jnp.where(latch > 0, s.command, wanted)
    return wanted, latch


def _actuate(loop, s, wanted):
    """What the actuator makes of it."""
    c = loop.limit
    if loop.actuator == "clip":
        return jnp.clip(wanted, -c, c)
    if loop.actuator == "rate":
        return s.command + jnp.clip(wanted - s.command, -0.3 * c, 0.3 * c)
    if loop.actuator == "dead zone":
        return jnp.where(jnp.abs(wanted) < 0.3 * c, 0.0, jnp.clip(wanted, -2 * c, 2 * c))
    if loop.actuator == "relay":
        return jnp.where(jnp.abs(wanted) < 0.2 * c, 0.0, c * jnp.sign(wanted))
    return wanted


def severity(loop: RandomLoop, s: State) -> jax.Array:
    """What fails above the threshold."""
    if loop.failure == "staying":
        return jnp.min(s.recent)
    return jnp.sqrt(s.energy) if loop.failure == "energy" else s.recent[-1]


def evaluate(loop: RandomLoop, threshold: jax.Array, s: State) -> tuple[jax.Array, jax.Array]:
    """(failure, miss distance)."""
    gap = threshold - severity(loop, s)
    failing, far = gap <= 0, gap
    if loop.distance == "coarse":
        far = jnp.ceil(gap / (threshold / 6))
    elif loop.distance == "constant":
        far = jnp.ones_like(gap)
    elif loop.distance == "another":
        far = jnp.maximum(2 * threshold - jnp.abs(s.x[-1]) - 0.5 * jnp.abs(s.x[0]), 0.01)
    elif loop.failure == "latched":
        far = jnp.maximum(threshold - s.x[0], 0.02)
    return failing, jnp.where(failing, 0.0, jnp.maximum(far, 0.0))


def simulator_of(loop: RandomLoop, threshold: Any) -> jast.Simulator:
    """The loop with this threshold."""
    zero = jnp.zeros(())
    first = State(jnp.zeros(len(loop.feedback)), zero, zero, zero, jnp.zeros(loop.hold), zero)
    return jast.Simulator(
        init=lambda x0: first,
        step=partial(step, loop),
        disturbance=partial(disturbance, loop),
        evaluate=partial(evaluate, loop, threshold),
        horizon=loop.horizon,
    )


def threshold_of(loop: RandomLoop, draws: int) -> float:
    """Above which severity the target's part of so many plain episodes comes; of rare targets that
    part which they still tell.
    """
    sim = simulator_of(loop, jnp.float32(1e8))

    def greatest(z):
        def fold(progress, t, most):
            return jnp.maximum(most, severity(loop, progress.state))

        return simulate(sim, z, jnp.float32(-1e9), fold)[-1]

    def block(i, _):
        z = jax.random.normal(jax.random.fold_in(jax.random.key(99), i), (LANES, dimension(sim)))
        return i + 1, jax.vmap(greatest)(z)

    most = jax.jit(lambda: lax.scan(block, 0, None, length=max(draws // LANES, 1))[1])()
    return float(np.quantile(np.ravel(most), 1 - max(loop.target, LEAST_TARGET)))


def ask(
    key: jax.Array, sim: jast.Simulator, budget: int | None, stress: bool
) -> tuple[jast.estimate.Estimate, float]:
    """The probability, and log p of the likeliest failure relative to the mode, NaN where none was
    asked for.
    """
    if not stress:
        return jast.estimate.failure_probability(key, sim, budget), math.nan
    report = jast.stress(key, sim, budget)
    likeliest = float(report.failures.best.reward) if len(report.failures) else math.nan
    return report.probability, likeliest


def rows_of(
    number: int,
    keys: int,
    threshold_draws: int,
    draws: int,
    budget: int | None = None,
    stress: bool = False,
) -> list[dict[str, Any]]:
    """The answers of ``keys`` calls, and what plain draws of as many CPU seconds would tell."""
    loop = draw_loop(number)
    threshold = threshold_of(loop, threshold_draws)
    if not 0 < threshold < FAR / 2:  # nothing disturbs it, or nothing holds it
        return []
    sim = simulator_of(loop, jnp.float32(threshold))
    truth = jast.estimate.monte_carlo(jax.random.key(1000), sim, draws)
    in_a_second, rows = plain_draws(System(sim, truth.mean), 1.0), []
    for seed in range(keys):
        asked = partial(ask, jax.random.key(seed), sim, budget, stress)
        (found, best), seconds, _ = timed(asked)
        z = (found.log_mean - truth.log_mean) / math.hypot(
            found.relative_error, truth.relative_error
        )
        about = dict(loop=number, about=str(loop), truth=truth.mean, error=truth.relative_error)
        about |= dict(key=seed, ratio=found.mean / truth.mean, relative=found.relative_error, z=z)
        about |= dict(reliable=found.reliable, evaluations=int(found.evaluations), seconds=seconds)
        about |= dict(method=found.method, why="" if found.reliable else found.warnings[0])
        about |= dict(plain=in_a_second / math.sqrt(seconds) if in_a_second else None, best=best)
        rows.append({k: None if v != v else v for k, v in about.items()})
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all calls."""
    good = [r for r in rows if r["reliable"]]
    apart = [abs(r["z"]) for r in good if r["z"] is not None]
    return dict(
        calls=len(rows),
        loops=len({r["loop"] for r in rows}),
        reliable=len(good),
        beyond_two=len([z for z in apart if z > 2]),
        farthest=max(apart, default=None),
        median_seconds=float(np.median([r["seconds"] for r in rows])) if rows else None,
        most_seconds=max((r["seconds"] for r in rows), default=None),
        median_error=float(np.median([r["relative"] for r in good])) if good else None,
        median_plain=float(np.median([r["plain"] for r in good if r["plain"]])) if good else None,
    )


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "two loops, one key, fewer plain draws")
    parser.add_argument("--loops", nargs=2, type=int, metavar=("FROM", "TO"), help="default: 0 20")
    parser.add_argument("--keys", type=int, help="calls of a loop (default: 2)")
    parser.add_argument("--draws", type=int, help="plain draws of a truth (default: 3,000,000)")
    parser.add_argument("--budget", type=int, help="evaluations of a call (default: jast's)")
    parser.add_argument("--stress", action="store_true", help="call jast.stress")
    args = parser.parse_args(argv)
    first, end = args.loops or size(args, (0, 20), (14, 16), (0, 1))
    keys = args.keys or size(args, 2, 1, 1)
    draws = args.draws or size(args, 3_000_000, 300_000, 2**15)
    say, rows = printer(args), []
    for number in range(first, end):
        for_threshold = size(args, THRESHOLD_DRAWS, THRESHOLD_DRAWS, 2**14)
        found = rows_of(number, keys, for_threshold, draws, args.budget, args.stress)
        for r in found:
            say(_line(r))
        rows += found
    total = summary(rows)
    say("  ".join(f"{k} {v:.3g}" for k, v in total.items() if v is not None))
    print_report(args, dict(rows=rows, summary=total))


def _line(r):
    ratio, z = ("-" if r[k] is None else f"{r[k]:.3f}" for k in ("ratio", "z"))
    best = "" if r["best"] is None else f" log p {r['best']:.3f} at most;"
    head = f"#{r['loop']} {r['about']}: {r['truth']:.3g} +- {percent(r['error'])}\n"
    return (
        f"{head if not r['key'] else ''}   {'ok  ' if r['reliable'] else 'FLAG'} {ratio} of it,"
        f" SE {percent(r['relative'])}, z {z}, {r['evaluations']} evaluations,"
        f" {r['seconds']:.1f} CPU s (plain draws {percent(r['plain'])});{best} {r['method']} "
        f" {r['why']}"
    )


if __name__ == "__main__":
    main()
