"""Rare events of long diffusions by adaptive multilevel splitting, beside other estimators at equal
steps: ``python -m benchmarks.splitting [--json] [--quick | --smoke] [--systems NAME ...] [--keys N]
[--methods NAME ...]``.

``two channels``: a metastable particle leaves its well by one of two ways within 2000 steps;
``double well``: another crosses a barrier within 500; ``toy``: a two-scale diffusion is high at its
last step, the 50th (Schorlepp and Grafke). Truths are recomputed by transition operators on grids.

``splitting``: `jast.estimate.splitting` by the distance; ``failure_probability`` and ``plain``
draws (`monte_carlo`) with the episodes that it took; ``pytams`` (pip install pytams; not part of
any extra) with about as many steps, in Python. Their ``episodes`` are steps / horizon.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jast
from benchmarks import pytams_peer
from benchmarks.sizes import add_choices, installed, options, print_report, printer, size
from jast import distributions as D

__all__ = ["SYSTEMS", "Diffusion"]

METHODS = ("splitting", "failure_probability", "plain", "pytams")
RUNS = 4
"""Of a call of splitting: few, and larger ones."""


class Diffusion(NamedTuple):
    """A system and the probability that its episode fails."""

    make: Callable[[], jast.Simulator]
    truth: float
    particles: int
    """Of a run of splitting: four of them take about 1e4 episodes"""


def _pair(state: Any) -> Any:
    return D.Independent(D.Normal(jnp.zeros(2), 1.0), 1)


def _slope(s: Any) -> Any:
    """Of the potential with two channels."""
    x, y = s
    hill, dip = jnp.exp(-(x**2) - (y - 1 / 3) ** 2), jnp.exp(-(x**2) - (y - 5 / 3) ** 2)
    right, left = jnp.exp(-((x - 1) ** 2) - y**2), jnp.exp(-((x + 1) ** 2) - y**2)
    return jnp.stack(
        [
            0.8 * x**3 - 6 * x * hill + 6 * x * dip + 10 * (x - 1) * right + 10 * (x + 1) * left,
            0.8 * (y - 1 / 3) ** 3
            - 6 * (y - 1 / 3) * hill
            + 6 * (y - 5 / 3) * dip
            + 10 * y * (right + left),
        ]
    )


def two_channels(beta: float = 5.67, dt: float = 0.01, steps: int = 2000) -> jast.Simulator:
    """From one well: failure where it is 2.1 away from the bottom of that."""

    def evaluate(s):
        gap = 2.1 - jnp.hypot(s[0] + 1, s[1])
        return gap <= 0, jnp.maximum(gap, 0.0)

    return jast.Simulator(
        init=lambda x0: jnp.array([-0.9, 0.1]),
        step=lambda s, w: s - dt * _slope(s) + math.sqrt(2 * dt / beta) * w,
        disturbance=_pair,
        evaluate=evaluate,
        horizon=steps,
    )


def double_well(eps: float = 0.1, dt: float = 0.01, steps: int = 500) -> jast.Simulator:
    """From one well: failure at the bottom of the other."""

    def step(s, w):
        drift = jnp.stack([s[0] - s[0] ** 3, -2 * s[1]])
        return s + dt * drift + math.sqrt(dt * eps) * w

    def evaluate(s):
        left, right = (jnp.exp(-8 * ((s[0] - m) ** 2 + s[1] ** 2)) for m in (-1, 1))
        gap = 0.95 - (0.5 - 0.5 * left + 0.5 * right)
        return gap <= 0, jnp.maximum(gap, 0.0)

    return jast.Simulator(
        init=lambda x0: jnp.array([-1.0, 0.0]),
        step=step,
        disturbance=_pair,
        evaluate=evaluate,
        horizon=steps,
    )


class At(NamedTuple):
    """A place, and how many steps led there."""

    at: Any
    steps: Any


def toy(level: float = 3.0, eps: float = 0.5, steps: int = 50) -> jast.Simulator:
    """Failure where X + 2 Y is at least ``level`` at time 1."""
    dt = 1 / steps

    def step(s, w):
        x, y = s.at
        drift = jnp.stack([-x - x * y, -4 * y + x**2])
        noise = math.sqrt(eps * dt) * jnp.array([1.0, 0.5]) * w
        return At(s.at + dt * drift + noise, s.steps + 1)

    def evaluate(s):
        gap = level - s.at[0] - 2 * s.at[1]
        return (gap <= 0) & (s.steps == steps), jnp.maximum(gap, 0.0)

    return jast.Simulator(
        init=lambda x0: At(jnp.zeros(2), jnp.zeros((), jnp.int32)),
        step=step,
        disturbance=_pair,
        evaluate=evaluate,
        horizon=steps,
    )


SYSTEMS = {
    "two channels": Diffusion(two_channels, 6.011e-5, 500),
    "double well": Diffusion(double_well, 1.342e-3, 800),
    "toy": Diffusion(toy, 1.0877e-5, 600),
}


def estimates(system: str, method: str, keys: int, particles: int) -> list[dict[str, Any]]:
    """An estimate for each key: its ratio to the truth, and what it took."""
    diffusion, found = SYSTEMS[system], []
    sim = diffusion.make()
    for number in range(keys):
        key, begun = jax.random.key(number), time.process_time()
        if method == "pytams":
            mean, steps = pytams_peer.run(RUNS * particles, number)
            row = dict(relative_error=None, covered=None, flagged=False)
            row |= dict(ratio=mean / diffusion.truth, episodes=steps / sim.horizon)
        else:
            p = _estimate(key, sim, method, particles)
            low, high = p.interval
            row = dict(
                ratio=0.0 if math.isnan(p.mean) else p.mean / diffusion.truth,
                relative_error=p.relative_error,
                covered=low <= diffusion.truth <= high,
                flagged=not p.reliable,
                episodes=p.episodes,
            )
        found.append(row | dict(cpu_s=time.process_time() - begun))
    return found


def _estimate(key, sim, method, particles):
    if method == "splitting":
        return jast.estimate.splitting(key, sim, particles, runs=RUNS)
    episodes = 20 * particles  # what splitting takes of these systems, about
    if method == "plain":
        return jast.estimate.monte_carlo(key, sim, episodes)
    return jast.estimate.failure_probability(key, sim, episodes)


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the estimates of some keys."""
    ratios = np.array([row["ratio"] for row in rows])
    wrong = [
        not row["flagged"] and abs(row["ratio"] - 1) > max(0.5, 4 * row["relative_error"])
        for row in rows
        if row["relative_error"] is not None
    ]
    return dict(
        rms=float(np.sqrt(np.mean((ratios - 1) ** 2))),
        mean=float(ratios.mean()),
        covered=sum(bool(row["covered"]) for row in rows),
        flagged=sum(row["flagged"] for row in rows),
        silent=sum(wrong),
        keys=len(rows),
        episodes=float(np.mean([row["episodes"] for row in rows])),
        cpu_s=float(np.median([row["cpu_s"] for row in rows])),
    )


def main() -> None:
    parser = options(__doc__, "4 keys, and no plain draws")
    parser.add_argument("--keys", type=int, help="default: 16; 4 with --quick, 1 with --smoke")
    parser.add_argument("--particles", type=int, help="of a run; default: by the system")
    add_choices(parser, "--systems", SYSTEMS)
    add_choices(parser, "--methods", METHODS, "all but failure_probability and pytams")
    args = parser.parse_args()
    say, report = printer(args), {}
    keys = args.keys or size(args, 16, 4, 1)
    for system in args.systems or size(args, list(SYSTEMS), list(SYSTEMS), ["toy"]):
        particles = args.particles or size(args, *[SYSTEMS[system].particles] * 2, 20)
        for method in args.methods or size(args, ["splitting", "plain"], *[["splitting"]] * 2):
            if method == "pytams" and not (installed("pytams") and system == "two channels"):
                continue
            r = summary(estimates(system, method, keys, particles))
            report[f"{system}, {method}"] = r
            say(
                f"{system:13} {method:20} rms {r['rms']:.3f} mean {r['mean']:.3f}, covered"
                f" {r['covered']} flagged {r['flagged']} silent {r['silent']} of {r['keys']},"
                f" {r['episodes']:.0f} episodes, {r['cpu_s']:.1f} CPU s"
            )
    print_report(args, report)


if __name__ == "__main__":
    main()
