"""Failure probabilities from few calls of the system: ``python -m benchmarks.few_calls [--json]
[--quick | --smoke] [--budget N] [--seeds N] [--systems NAME ...]``.

`failure_probability` with 200 calls (999 for Booth) on limit states of known probability, and with
1200 to 5000 on systems of 30 to 1000 numbers, over seeds: rms of estimate over truth less 1, how
many are within 10 %, how many intervals cover, how many estimates are flagged, the rms of the
others, and the silent misses: unflagged, and off by more than 4 standard errors. The error of so
many plain draws follows from the truth. CPU seconds are of the method, the first of a system
compiles. Of a system in Python the runs are counted outside of jast, as its starts.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from benchmarks.closed_loops import JUDGED, system
from benchmarks.first_minute import lane
from benchmarks.limit_states import DYNAMIC, four_branch, four_branch_probability
from benchmarks.probability import summary
from benchmarks.ridges import RIDGES, ridge
from benchmarks.sizes import add_choices, options, print_report, printer, size, timed
from benchmarks.time_to_answer import gayton
from jast._src.core.simulator import Simulator
from jast.blackbox import from_python
from jast.distributions import Joint, MultivariateNormalDiag, Normal, TruncatedNormal
from jast.estimate import failure_probability
from jast.simulators import limit_state

__all__ = ["SYSTEMS", "SlowLane", "System", "metaballs", "plane", "slow_lane"]


class System(NamedTuple):
    """How to make a simulator, the probability that it fails, and the calls that it is given."""

    make: Callable[[], Simulator]
    truth: float
    budget: int = 200


def hyperplane(beta: float, x: Any) -> Any:
    """beta less the mean direction."""
    return beta - jnp.sum(x) / x.shape[0] ** 0.5


def curved(x: Any) -> Any:
    """A paraboloid that narrows the region of failure."""
    return 4.5 - x[0] + 0.016 * jnp.sum(x[1:] ** 2)


def _log_normal(z, mean, sd):
    variance = np.log(1 + (sd / mean) ** 2)
    return jnp.exp(np.log(mean) - variance / 2 + np.sqrt(variance) * z)


def rp8(z: Any) -> Any:
    """RP8 of the reliability benchmark: a plastic mechanism, six log-normal variables."""
    moments = [(120, 12)] * 4 + [(50, 10), (40, 8)]
    x = [_log_normal(z[i], mean, sd) for i, (mean, sd) in enumerate(moments)]
    return x[0] + 2 * x[1] + 2 * x[2] + x[3] - 5 * x[4] - 5 * x[5]


def oscillator(mean: float, deviation: float, z: Any) -> Any:
    """The nonlinear oscillator of the literature by its force's mean and standard deviation."""
    force = mean, deviation
    moments = ((1, 0.05), (1, 0.1), (0.1, 0.01), (0.5, 0.05), force, (1, 0.2))
    m, c1, c2, r, force, t = (mean + sd * z[i] for i, (mean, sd) in enumerate(moments))
    w = jnp.sqrt((c1 + c2) / m)
    return 3 * r - jnp.abs(2 * force / (m * w**2) * jnp.sin(w * t / 2))


def damped_oscillator(z: Any) -> Any:
    """The damped oscillator of Der Kiureghian and de Stefano (1991), whose secondary spring is of
    mean strength 21.5.
    """
    means = np.array([1.5, 0.01, 1.0, 0.01, 0.05, 0.02, 21.5, 100.0])
    spread = np.array([0.1, 0.1, 0.2, 0.2, 0.4, 0.5, 0.1, 0.1])
    mp, ms, kp, ks, zp, zs, strength, s0 = _log_normal(z, means, spread * means)
    wp, ws = jnp.sqrt(kp / mp), jnp.sqrt(ks / ms)
    wa, za, gamma = (wp + ws) / 2, (zp + zs) / 2, ms / mp
    theta = (wp - ws) / wa
    damping = za * zs / (zp * zs * (4 * za**2 + theta**2) + gamma * za**2)
    tuned = (zp * wp**3 + zs * ws**3) * wp / (4 * za * wa**4)
    peak = 3 * ks * jnp.sqrt(jnp.pi * s0 / (4 * zs * ws**3) * damping * tuned)
    return strength - peak


def metaballs(x: Any) -> Any:
    """Fails away from two balls; the nearest failures lie in a gap between them."""
    first = (4 * (x[0] + 2) ** 2 / 9 + x[1] ** 2 / 25) ** 2
    second = ((x[0] - 2.5) ** 2 / 4 + (x[1] - 0.5) ** 2 / 25) ** 2
    return 30 / (first + 1) + 20 / (second + 1) - 5


def _booth(s):
    value = (s[0] + 2 * s[1] - 7) ** 2 + (2 * s[0] + s[1] - 5) ** 2 - 200
    return value <= 0, jnp.maximum(value, 0)


def booth() -> Simulator:
    """Booth's function <= 200 under a truncated normal x1 and a normal x2."""
    noise = Joint((TruncatedNormal(-10.0, 1.5, -10.0, 5.0), Normal(-2.5, 1.0)))
    return Simulator(
        init=lambda x0: jnp.zeros(2),
        step=lambda s, x: jnp.stack(x),
        disturbance=lambda s: noise,
        evaluate=_booth,
        horizon=1,
        episodic=True,
    )


def branches(p: float, k: float) -> Simulator:
    """The four-branch series system."""
    return limit_state(Partial(four_branch, jnp.asarray(p), jnp.asarray(k)), 2)


def slow(disturbances: np.ndarray) -> tuple[bool, float]:
    """The four branches in plain Python, 0.2 seconds a run."""
    time.sleep(0.2)
    value = float(four_branch(7.0, 3.0, disturbances[0], np=np))
    return value <= 0, max(value, 0.0)


def black_box() -> Simulator:
    """`slow` with two workers."""
    noise = MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2))
    return from_python(slow, horizon=1, disturbance=noise, workers=2)


class SlowLane:
    """The lane in plain Python, whose starts are counted."""

    runs = 0

    def initialize(self) -> None:
        SlowLane.runs += 1
        self.offset = self.speed = 0.0

    def transition(self, gust: Any) -> None:
        self.speed = 0.8 * self.speed - 0.3 * self.offset + 0.1 * float(gust)
        self.offset += self.speed

    def miss_distance(self) -> float:
        return max(1.4 - abs(self.offset), 0.0)

    def is_event(self) -> bool:
        return abs(self.offset) >= 1.4


def slow_lane() -> Simulator:
    """`SlowLane` as a black box."""
    return from_python(SlowLane, horizon=30, disturbance=Normal(0.0, 1.0))


def plane(numbers: int, beta: float = 3.5) -> Simulator:
    """The hyperplane so many standard deviations out."""
    return limit_state(Partial(hyperplane, jnp.asarray(beta)), numbers)


def first_of(depths: Any, ways: Any, x: Any) -> Any:
    """How far the nearest of some planes is."""
    return jnp.min(depths - ways @ x)


def planes(*depths: float) -> Simulator:
    """Fails beyond any of some planes of 60 numbers that stand square on one another: no slope near
    the middle shows more than one.
    """
    ways = np.linalg.qr(np.random.default_rng(0).standard_normal((60, len(depths)))).Q.T.copy()
    return limit_state(Partial(first_of, jnp.asarray(depths), jnp.asarray(ways)), 60)


def force(mean: float, deviation: float) -> Partial:
    """The nonlinear `oscillator` under a force of this mean and standard deviation."""
    return Partial(oscillator, jnp.asarray(mean), jnp.asarray(deviation))


def signed(g: Callable, dimension: int) -> Simulator:
    """The limit state ``g``, whose failures say how deep they are."""
    sim = limit_state(g, dimension)
    return dataclasses.replace(sim, evaluate=lambda x: (g(x) <= 0, g(x)))


def diffusion(z: float, steps: int) -> Simulator:
    """The diffusion in the plane of Schorlepp and Grafke (2025): X + 2 Y >= z at the end."""
    dt, spread = 1 / steps, (0.5 / steps) ** 0.5

    def step(s, w):
        x, y = s
        moved = -x - x * y, -4 * y + x**2
        return jnp.stack([x + dt * moved[0] + spread * w[0], y + dt * moved[1] + spread / 2 * w[1]])

    return system([0.0, 0.0], step, lambda s: z - s[0] - 2 * s[1], 2, steps, episodic=True)


def energy(z: Any, bound: float = 88.0) -> Any:
    """The bound less the sum of squares: no direction fails before another."""
    return bound - jnp.sum(z**2)


def any_far(z: Any, bound: float = 5.0) -> Any:
    """Failure beyond +-bound in any number: two modes for each."""
    return bound - jnp.max(jnp.abs(z))


def of_40(g: Callable[..., Any], bound: float) -> Simulator:
    """The system of 40 numbers that fails beyond the bound."""
    return limit_state(partial(g, bound=bound), 40)


def asian_option(z: Any) -> Any:
    """An option on the mean of 89 daily prices: 14 less its discounted payoff."""
    dt = 1 / 3 / 88
    prices = 40 * jnp.exp(jnp.cumsum((0.07 - 0.02) * dt + 0.2 * dt**0.5 * z))
    return 14 - jnp.exp(-0.07 / 3) * ((40 + jnp.sum(prices)) / 89 - 35)


# hyperplane and branches: closed form and quadrature; curved: quadrature over the chi density of
# the nine others; Booth and metaballs: a grid of 4001 x 4001 points; RP8 and the oscillator: 4e6
# points of an importance density at the design point, standard errors .16 and .14 %
SYSTEMS = {
    "four-branch": System(lambda: branches(7.0, 3.0), 2.2227950662e-3),
    "RP8": System(lambda: limit_state(rp8, 6), 7.8995e-4),
    "hyperplane 10": System(partial(plane, 10, 4.5), 3.3976731e-6),
    "curved 10": System(lambda: limit_state(curved, 10), 1.7912043e-6),
    "oscillator": System(lambda: limit_state(force(0.6, 0.1), 6), 9.133286e-6),
    "Booth": System(booth, 4.2964e-8, 999),
    "metaballs": System(lambda: limit_state(metaballs, 2), 1.12795e-5),
    "black box": System(black_box, 2.2227950662e-3),
    "landing": System(*DYNAMIC["landing"]),
    "four-branch, far": System(lambda: branches(10.0, 5.0), four_branch_probability(10.0, 5.0)),
}
# lane: `probability_of_lane` of tests/test_moments.py with 1.5 million draws, standard error .02 %;
# diffusion and option: transition operators and quadrature; energy: chi-square; any of
# 40: closed form; closed loops: `benchmarks.closed_loops`
MANY = {
    "lane, 600": System(lane, 5.0355e-5, 600),
    "lane, 2000": System(lane, 5.0355e-5, 2000),
    "lane, 5000": System(lane, 5.0355e-5, 5000),
    "lane in Python": System(slow_lane, 5.0355e-5, 2000),
    "plane 100": System(partial(plane, 100), 2.3262908e-4, 1200),
    "plane 1000": System(partial(plane, 1000), 2.3262908e-4, 1200),
    "three planes, 600": System(partial(planes, 3.5, 3.6, 3.7), 4.9945816e-4, 600),
    "diffusion 3, 50": System(partial(diffusion, 3.0, 50), 1.0877e-5, 1200),
    "diffusion 3, 200": System(partial(diffusion, 3.0, 200), 9.1231e-6, 1200),
    "diffusion 4, 50": System(partial(diffusion, 4.0, 50), 2.346e-8, 1200),
    "Asian option": System(lambda: limit_state(asian_option, 88), 1.577745e-3, 1200),
    "energy": System(partial(of_40, energy, 88.0), 1.8429071e-5, 5000),
    "any of 40": System(partial(of_40, any_far, 5.0), 2.2931869e-5, 3000),
    "energy, common": System(partial(of_40, energy, 52.0), 9.6820850e-2, 600),
    "energy, 2 %": System(partial(of_40, energy, 60.0), 2.1873468e-2, 2000),
    "any, common": System(partial(of_40, any_far, 3.0), 1.0249616e-1, 600),
    "any, 2 %": System(partial(of_40, any_far, 3.5), 1.8442474e-2, 2000),
} | {f"{loop.name} loop": System(lambda x=loop: x.simulator, loop.truth, 5000) for loop in JUDGED}
# as few calls as methods of active learning print: 67 and 26 to 40 of the AK family, 680 to 4011
# for the damped oscillator; truths by quadrature
LITERATURE = {
    "oscillator, 67": (force(0.6, 0.1), 6, 9.133286e-6, 67),
    "oscillator .45, 67": (force(0.45, 0.075), 6, 1.51875e-8, 67),
    "Gayton, 40": (gayton, 2, 2.8745376e-5, 40),
    "Gayton of 8, 100": (gayton, 8, 2.8745376e-5, 100),
    "damped, 300": (damped_oscillator, 8, 4.414265e-5, 300),
}
FEWEST = {"plane 100, 300": System(partial(plane, 100), 2.3262908e-4, 300)}
for name, (g, dimension, truth, budget) in LITERATURE.items():
    FEWEST[name] = System(partial(limit_state, g, dimension), truth, budget)
    FEWEST[f"{name}, signed"] = System(partial(signed, g, dimension), truth, budget)
for number in RIDGES:
    g, dimension, truth = ridge(number)
    FEWEST[f"ridge {number}"] = System(partial(limit_state, g, dimension), truth, 250)
QUICK = ["four-branch", "hyperplane 10", "lane, 2000", "plane 100", "diffusion 3, 50"]
SYSTEMS |= FEWEST | MANY


def report_of(system: System, seeds: int, budget: int | None) -> dict:
    """The report of some seeds."""
    sim, calls = system.make(), budget or system.budget
    SlowLane.runs = 0
    keys = (jax.random.key(seed) for seed in range(seeds))
    each = [timed(partial(failure_probability, key, sim, calls)) for key in keys]
    runs, seconds, walls = zip(*each, strict=True)
    report = summary([(r, system.truth) for r in runs])
    near = [abs(r.mean / system.truth - 1) < 0.1 for r in runs]
    good = [r.mean / system.truth - 1 for r in runs if r.reliable]
    return report | {
        "rms_unflagged": float(np.sqrt(np.mean(np.square(good)))) if good else None,
        "plain": math.sqrt((1 - system.truth) / system.truth / calls),
        "runs_counted": SlowLane.runs / seeds,
        "budget": calls,
        "within_10": sum(near),
        "cpu_s": float(np.median(seconds)),
        "cpu_s_first": seconds[0],
        "wall_s": float(np.median(walls)),
    }


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "3 seeds of five systems")
    parser.add_argument("--seeds", type=int, help="20")
    parser.add_argument("--budget", type=int, help="of each system; default 200, of Booth 999")
    add_choices(parser, "--systems", SYSTEMS)
    args = parser.parse_args(argv)
    say, report, seeds = printer(args), {}, args.seeds or size(args, 20, 3, 1)
    budget = args.budget or size(args, None, None, 50)
    say(
        "system            calls      rms   reliable  within 10 %  covers  flagged  silent"
        "  plain draws  CPU s (first)  wall s  runs counted"
    )
    for name in args.systems or size(args, list(SYSTEMS), QUICK, ["hyperplane 10"]):
        report[name] = r = report_of(SYSTEMS[name], seeds, budget)
        reliable = f"{100 * r['rms_unflagged']:8.1f} %" if r["rms_unflagged"] else f"{'-':>10}"
        counted = f"{r['runs_counted']:12.0f}" if r["runs_counted"] else ""
        say(
            f"{name:18}{r['budget']:5d}{100 * r['rms']:8.1f} %{reliable}"
            f"{r['within_10']:8d} of {seeds:<2d}{r['covers']:7d}{r['flagged']:9d}"
            f"{r['far_unflagged']:8d}{100 * r['plain']:11.0f} %{r['cpu_s']:8.1f}"
            f" ({r['cpu_s_first']:.1f}){r['wall_s']:10.1f}{counted}"
        )
    print_report(args, report)


if __name__ == "__main__":
    main()
