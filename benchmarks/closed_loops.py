"""Closed loops whose controllers clip, brake, switch and latch, with known probabilities of
failure: ``python -m benchmarks.closed_loops [--json] [--quick | --smoke] [--loops NAME ...]``
computes them.

`TUNED` are loops that settings may be chosen on, `JUDGED` those on which nothing was: 80 to 400
random numbers an episode. `RARE` are three more to judge on, of about one in a million. Truths are
plain draws by jast, with JAX's Threefry, which a minimal loop (`independent_draws`) repeats; those
of `RARE`, of breaker, tank, store and oven are exact (`benchmarks.operators`).

Tank, store and oven were judged on until the move that draws anew all after a level was found on
them; freezer and packets were made after it.
"""

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

import jast
from benchmarks.operators import OPERATORS, SYSTEMS, easier
from benchmarks.sizes import options, print_report, printer, size
from jast._src.normal_space.transform import dimension, outcome
from jast.distributions import Bernoulli, Independent, Joint, Normal

__all__ = ["JUDGED", "RARE", "TUNED", "Loop"]

LANES = 128
"""Episodes that are drawn side by side."""


class Loop(NamedTuple):
    """A closed loop and the probability that its episode fails."""

    name: str
    simulator: jast.Simulator
    numbers: int
    """Random numbers of an episode"""
    truth: float
    error: float
    """Relative standard error of the truth"""
    how: str


def normals(n: int) -> Callable[[Any], Any]:
    """``n`` standard normal numbers a step."""
    one = Normal(jnp.zeros(()), 1.0) if n == 1 else Independent(Normal(jnp.zeros(n), 1.0), 1)
    return lambda state: one


def system(first: Any, step: Any, distance: Any, n: int, horizon: int, **more: Any) -> Any:
    """A simulator that starts at ``first`` and fails where its distance is not above 0."""

    def evaluate(state):
        gap = distance(state)
        return gap <= 0, jnp.maximum(gap, 0.0)

    about = dict(init=lambda x0: jnp.asarray(first, float), disturbance=normals(n), horizon=horizon)
    return jast.Simulator(step=step, evaluate=evaluate, **(about | more))


# to tune on


def crossing_step(s, w):
    """A car (position, speed) meets a pedestrian (position, speed); a noisy detector of the
    pedestrian is smoothed, and above a threshold the car brakes as hard as it can.
    """
    x, v, p, u, seen = s
    near = jnp.abs(p + 0.4 * w[0]) < 2.5
    seen = 0.8 * seen + 0.2 * near
    push = jnp.where((seen > 0.12) & (x < 0), -8.0, jnp.clip(1.5 * (11 - v), -2.0, 2.0))
    v = jnp.maximum(v + 0.05 * (push + 0.5 * w[1]), 0.0)
    u = jnp.clip(u + 0.1 * w[2], -0.5, 2.0)
    return jnp.stack([x + 0.05 * v, v, p + 0.05 * u, u, seen])


def crossing_distance(s):
    """Between the car's outline and the pedestrian, as a share of the outline."""
    return jnp.sqrt((s[0] / 1.5) ** 2 + (s[2] / 0.5) ** 2) - 1


def junction_step(s, w):
    """The ego car (position, speed) and a crossing car (position, speed); the ego decides by a
    noisy gap in time to go or to yield, and keeps to it within hysteresis.
    """
    x, v, y, u, go = s
    mine, other = -x / jnp.maximum(v, 0.5), (-y + w[0]) / jnp.maximum(u, 0.5)
    gap = other - mine
    go = jnp.where(x < -8, jnp.where(gap > 1, 1.0, jnp.where(gap < 0.2, 0.0, go)), go)
    stop = (go < 0.5) & (x < -3) & (y < 4)
    brake = jnp.clip(-(v**2) / (2 * jnp.maximum(-3 - x, 0.5)), -6.0, 0.0)
    v = jnp.maximum(v + 0.1 * jnp.where(stop, brake, jnp.clip(9.5 - v, -1.0, 2.0)), 0.0)
    u = jnp.clip(u + 0.1 * (9 - u + 3.0 * w[1]), 0.0, 15.0)
    return jnp.stack([x + 0.1 * v, v, y + 0.1 * u, u, go])


def junction_distance(s):
    """Between two squares of 6 m."""
    return jnp.maximum(jnp.abs(s[0]) - 3.0, jnp.abs(s[2]) - 3.0)


def pole_step(s, w):
    """A cart-pole under bang-bang control of noisy observations."""
    x, v, a, b = s
    seen = s + jnp.asarray([0.05, 0.15, 0.05, 0.25], s.dtype) * w
    lean = seen[2] + 0.5 * seen[3] + 0.1 * seen[0] + 0.2 * seen[1]
    return pole(s, jnp.where(lean > 0, 10.0, -10.0))


def pole(s, force):
    """One step of 20 ms of the cart-pole of Barto, Sutton and Anderson (1983)."""
    x, v, a, b = s
    sine, cosine = jnp.sin(a), jnp.cos(a)
    inner = (force + 0.05 * b**2 * sine) / 1.1
    turn = (9.8 * sine - cosine * inner) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
    push = inner - 0.05 * turn * cosine / 1.1
    return jnp.stack([x + 0.02 * v, v + 0.02 * push, a + 0.02 * b, b + 0.02 * turn])


def pole_distance(s):
    """To 12 degrees or 2.4 m, as shares of these."""
    return jnp.minimum(1 - jnp.abs(s[2]) / 0.2095, 1 - jnp.abs(s[0]) / 2.4)


# to judge on


def follower_step(s, w):
    """A car (gap, closing speed, own speed) follows one that brakes at random; its emergency brake
    latches.
    """
    gap, closing, v, braking = s
    lead = jnp.clip(-0.15 * (v - closing - 20) + 9.0 * w[0], -9.0, 4.0)
    seen = gap + 1.0 * w[1]
    braking = jnp.maximum(braking, 1.0 * (seen < 0.6 * jnp.maximum(closing, 0.0) * 2 + 4))
    own = jnp.where(braking > 0, -4.0, jnp.clip(0.3 * (seen - 1.2 * v) - 1.2 * closing, -3.0, 2.0))
    v = jnp.maximum(v + 0.1 * own, 0.0)
    closing = closing + 0.1 * (own - lead)
    return jnp.stack([gap - 0.1 * closing, closing, v, braking])


def drone_step(s, w):
    """A drone (height, climb, thrust) in gusts; its thrust saturates and lags."""
    h, c, thrust = s
    wanted = jnp.clip(-1.2 * (h + 0.3 * w[1]) - 1.6 * c, -4.0, 4.0)
    thrust = thrust + 0.2 * (wanted - thrust)
    c = c + 0.05 * (thrust - 0.2 * c * jnp.abs(c)) + 0.32 * w[0]
    return jnp.stack([h + 0.05 * c, c, thrust])


def insulin_step(s, w):
    """Blood sugar, insulin at work, and what a meal still gives; the pump doses by a noisy sensor
    and suspends below 90.
    """
    sugar, insulin, meal = s
    seen = sugar + 20 * w[1]
    dose = jnp.where(seen < 90, 0.0, jnp.clip(0.03 * (seen - 100), 0.0, 2.5))
    insulin = 0.9 * insulin + 0.1 * dose * 1.6
    meal = 0.93 * meal + jnp.maximum(0.6 * w[0] - 0.4, 0.0)
    return jnp.stack([sugar + 2.2 * meal - 6 * insulin - 0.04 * (sugar - 120), insulin, meal])


def ship_step(s, w):
    """A ship (offset, heading, turn, rudder) whose autopilot has a slow rudder with a dead zone."""
    y, heading, turn, rudder = s
    wanted = jnp.clip(-0.06 * y - 1.5 * (heading + 0.05 * w[1]) - 4 * turn, -0.5, 0.5)
    wanted = jnp.where(jnp.abs(wanted) < 0.05, 0.0, wanted)
    rudder = rudder + jnp.clip(wanted - rudder, -0.05, 0.05)
    turn = 0.9 * turn + 0.03 * rudder + 0.008 * w[0]
    return jnp.stack([y + 2 * jnp.sin(heading), heading + turn, turn, rudder])


def camera_step(s, w):
    """A lane keeper (offset, speed) whose camera sees worse the farther it is out, and drops out at
    random: then it steers as before.
    """
    wind, drop = w
    y, v, steer = s
    wanted = jnp.clip(-0.5 * y - 1.2 * v, -0.5, 0.5)
    lost = (drop > 0) | (jnp.abs(y) > 0.6)
    steer = jnp.where(lost, steer, wanted)
    v = 0.95 * v + 0.1 * steer + 0.045 * wind
    return jnp.stack([y + 0.2 * v, v, steer])


def grid_step(s, w):
    """Frequency of a grid, its governor, and load that was shed: at -.5 Hz a tenth is shed, once;
    at -.8 more.
    """
    f, governor, shed, load = s
    load = 0.98 * load + 0.055 * w
    governor = governor + jnp.clip(0.25 * (-f - 0.4 * governor), -0.03, 0.03)
    shed = jnp.where(f < -0.8, 0.25, jnp.where(f < -0.5, jnp.maximum(shed, 0.1), shed))
    f = f + 0.2 * (governor + shed - load - 0.15 * f)
    return jnp.stack([f, governor, shed, load])


def landing_step(s, w):
    """Height, sink rate and elevator of a landing aeroplane: below 15 m it flares, and the elevator
    saturates.
    """
    h, sink, elevator, time = s
    wanted = jnp.where(h < 15, 0.5 + 0.13 * h, 3.0)
    command = jnp.clip(0.8 * (sink + 0.3 * w[1] - wanted), -1.2, 1.2)
    elevator = elevator + 0.3 * (command - elevator)
    sink = sink + 0.1 * (-1.5 * elevator) + 0.1 * w[0] * (1 + 0.02 * h)
    return jnp.stack([h - 0.1 * sink, sink, elevator, time + 1])


def landing_distance(s):
    """To touching down with more than 1.6 m/s."""
    return jnp.where(s[0] > 0, 0.05 * s[0], 0.0) + jnp.maximum(1.6 - s[1], 0.0) + 1e-3 * (s[0] > 0)


def arm_step(s, w):
    """A robot arm (motor, motor speed, arm, arm speed) with backlash: the gear pushes only beyond a
    gap.
    """
    motor, speed, arm, turn = s
    wind = motor - arm
    gear = 30 * (jnp.maximum(wind - 0.1, 0.0) + jnp.minimum(wind + 0.1, 0.0))
    torque = jnp.clip(-8 * (arm + 0.05 * w[1]) - 4 * speed, -3.0, 3.0)
    speed = speed + 0.05 * (torque - gear - speed)
    turn = turn + 0.05 * (gear - 0.5 * turn) + 0.16 * w[0]
    return jnp.stack([motor + 0.05 * speed, speed, arm + 0.05 * turn, turn])


def plain(loop: Loop, draws: int, seed: int = 0) -> tuple[int, int]:
    """Failures among so many plain draws, nearly, and how many they were."""
    blocks = max(draws // LANES, 1)
    part = min(blocks, 4096)
    failing = done = 0
    for i in range(-(-blocks // part)):
        failing += int(_failing(loop.simulator, jax.random.key(seed * 100_000 + i), part))
        done += part * LANES
    return failing, done


@partial(jax.jit, static_argnames="blocks")
def _failing(sim, key, blocks):
    numbers = dimension(sim)

    def block(i, count):
        z = jax.random.normal(jax.random.fold_in(key, i), (LANES, numbers))
        failure = jax.vmap(partial(outcome, sim))(z).failure
        return count + jnp.sum(failure, dtype=jnp.int32)

    return lax.fori_loop(0, blocks, block, jnp.zeros((), jnp.int32))


def independent_draws(loop: Loop, draws: int, seed: int = 0) -> tuple[int, int]:
    """As `plain`, by a loop that uses the simulator's functions only, with other draws."""
    blocks = min(max(draws // LANES, 1), 1024)
    failing = done = 0
    while done < draws:
        key = jax.random.key(seed * 100_000 + done // (blocks * LANES), impl="rbg")
        failing += int(_independent_failures(loop.simulator, key, blocks))
        done += blocks * LANES
    return failing, done


@partial(jax.jit, static_argnames="blocks")
def _independent_failures(sim, key, blocks):
    def fails(key):
        first, rest = jax.random.split(key)
        state = sim.init(sim.start().sample(seed=first))

        def step(carry, key):
            state, failed, over = carry
            new = sim.step(state, sim.disturbance(state).sample(seed=key))
            failed = failed | (~over & sim.evaluate(new)[0])
            return (new, failed, over | failed | sim.is_terminal(new)), None

        failed = sim.evaluate(state)[0]
        begun = (state, failed, failed | sim.is_terminal(state))
        return lax.scan(step, begun, jax.random.split(rest, sim.horizon))[0][1]

    def block(i, count):
        keys = jax.random.split(jax.random.fold_in(key, i), LANES)
        return count + jnp.sum(jax.vmap(fails)(keys), dtype=jnp.int32)

    return lax.fori_loop(0, blocks, block, jnp.zeros((), jnp.int32))


DRAWS = "plain draws"
OPERATOR = "transition operator"
MOST_DRAWS = {"follower": 20.1, "drone": 7.7, "camera": 6.7, "ship": 5.5, "arm": 19.93}
"""How many times as many draws as of the others the truths of these took."""


def _two(state):
    return Joint((Normal(0.0, 1.0), Bernoulli(probs=0.2)))


def _arm(x0):
    return jnp.stack([x0, 0.0 * x0, x0, 0.0 * x0])


def _loop(name, numbers, truth, error, how, *about, **more):
    return Loop(name, system(*about, **more), numbers, truth, error, how)


def _exact(name, truth):
    first, step, distance, steps = SYSTEMS[name]
    return _loop(name, steps, truth, 0, OPERATOR, first, step, distance, 1, steps)


_LANDED = dict(is_terminal=lambda s: s[0] <= 0)
_ARM = dict(start=lambda: Normal(0.0, 0.1), init=_arm)
TUNED = (
    _loop(
        *("crossing", 300, 0.001431, 0.0084, DRAWS),
        *([-35.0, 11, -4, 1, 0], crossing_step, crossing_distance, 3, 100),
    ),
    _loop(
        *("junction", 100, 0.0003582, 0.0167, DRAWS),
        *([-30.0, 9, -32, 9, 0], junction_step, junction_distance, 2, 50),
    ),
    _loop(
        "cart-pole", 400, 0.000116, 0.0294, DRAWS, [0.0, 0, 0, 0], pole_step, pole_distance, 4, 100
    ),
    _exact("breaker", 5.0877e-05),
    _exact("tank", 4.909e-09),
    _exact("store", 2.137e-07),
    _exact("oven", 1.2206e-06),
)
JUDGED = (
    _loop(
        *("follower", 200, 6.806e-05, 0.0086, DRAWS),
        *([5.0, 0, 20, 0], follower_step, lambda s: s[0] / 5, 2, 100),
    ),
    _loop(
        *("drone", 200, 0.0001970, 0.0081, DRAWS),
        *([0.0, 0, 0], drone_step, lambda s: 1 - jnp.abs(s[0]) / 3.7, 2, 100),
    ),
    _loop(
        *("insulin", 200, 0.0001266, 0.0281, DRAWS),
        *([120.0, 0.3, 0], insulin_step, lambda s: (s[0] - 70) / 50, 2, 100),
    ),
    _loop(
        *("ship", 160, 9.642e-05, 0.0137, DRAWS),
        *([0.0, 0, 0, 0], ship_step, lambda s: 1 - jnp.abs(s[0]) / 45, 2, 80),
    ),
    _loop(
        *("camera", 160, 0.0001109, 0.0116, DRAWS),
        *([0.0, 0, 0], camera_step, lambda s: 1 - jnp.abs(s[0]) / 0.7, 1, 80),
        **dict(disturbance=_two),
    ),
    _loop(
        *("grid", 150, 0.0001352, 0.0272, DRAWS),
        *([0.0, 0, 0, 0], grid_step, lambda s: 1 + s[0] / 1.2, 1, 150),
    ),
    _loop(
        *("landing", 400, 0.0001364, 0.0271, DRAWS),
        *([40.0, 3, 0, 0], landing_step, landing_distance, 2, 200),
        **_LANDED,
    ),
    _loop(
        *("arm", 201, 4.076e-05, 0.0111, DRAWS),
        *([0.0, 0, 0, 0], arm_step, lambda s: 1 - jnp.abs(s[2]) / 0.67, 2, 100),
        **_ARM,
    ),
)
RARE = (_exact("rail", 9.1717e-07), _exact("freezer", 3.2289e-06), _exact("packets", 6.9634e-06))


def truth_of(loop: Loop, draws: int, cells: int) -> tuple[float, float]:
    """The probability of failure, recomputed, and its relative standard error."""
    if loop.how == OPERATOR:
        return OPERATORS[loop.name](cells), 0.0
    failing, drawn = plain(loop, draws)
    return failing / drawn, failing**-0.5 if failing else math.inf


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "200,000 draws a loop")
    parser.add_argument("--loops", nargs="+", help="default: all")
    args = parser.parse_args(argv)
    draws, cells = size(args, 10_000_000, 200_000, LANES), size(args, 2400, 600, 100)
    say, rows = printer(args), []
    for loop in TUNED + JUDGED + RARE:
        if args.loops and loop.name not in args.loops:
            continue
        begun = time.process_time()
        more = size(args, MOST_DRAWS.get(loop.name, 1.0), 1.0, 1.0)
        p, error = truth_of(loop, int(more * draws), cells)
        both = math.hypot(error * p, loop.error * loop.truth)
        apart = abs(p - loop.truth) / both if 0 < both < math.inf else 0.0
        row = dict(name=loop.name, numbers=loop.numbers, truth=loop.truth, error=loop.error)
        row |= dict(recomputed=p, apart=apart, cpu_seconds=time.process_time() - begun)
        text = f"recomputed {p:.4g}  {apart:.1f} standard errors apart"
        if loop.how == DRAWS:
            failing, drawn = independent_draws(loop, draws // 10)
            other = failing / drawn
            both = math.hypot(math.sqrt(loop.truth / drawn), loop.error * loop.truth)
            row |= dict(independent=other, independent_apart=abs(other - loop.truth) / both)
            text += f"  minimal loop {other:.3g}, {row['independent_apart']:.1f} apart"
        else:
            row |= dict(relative=p / loop.truth - 1)
            text = f"recomputed {p:.5g}, {row['relative']:+.1e} of it"
        rows.append(row)
        say(
            f"{loop.name:10s} {loop.numbers:4d} numbers  truth {loop.truth:.4g}"
            f" +- {loop.error:.1%}  {text}"
        )
    checked = easier(size(args, 1_000_000, 200_000, 1000), cells)
    for name, row in checked.items():
        say(
            f"{name:10s} made easier: operator {row['operator']:.4g}, drawn {row['drawn']:.4g},"
            f" {row['apart']:.1f} standard errors apart"
        )
    print_report(args, dict(loops=rows, easier=checked))


if __name__ == "__main__":
    main()
