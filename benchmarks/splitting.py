"""Rare events of long diffusions by adaptive multilevel splitting, beside other estimators at equal
steps: ``python -m benchmarks.splitting [--json] [--quick | --smoke] [--systems NAME ...] [--keys N]
[--methods NAME ...]``.

``two channels``: a metastable particle leaves its well by one of two ways within 2000 steps;
``channels by x``: the same, with its x in place of the distance for a score; ``double well``:
another crosses a barrier within 500; ``toy``: a two-scale diffusion is high at its last step, the
50th (Schorlepp and Grafke). Truths are recomputed by transition operators on grids.

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
from benchmarks.closed_loops import system
from benchmarks.sizes import add_choices, installed, options, print_report, printer, size
from benchmarks.time_to_answer import toy, well

__all__ = ["SYSTEMS", "Diffusion"]

METHODS = ("splitting", "failure_probability", "plain", "pytams")
RUNS = 4
"""Of a call of splitting: few, and larger ones."""


class Diffusion(NamedTuple):
    """A system and the probability that its episode fails."""

    simulator: jast.Simulator
    truth: float
    particles: int
    """Of a run of splitting: four of them take about 1e4 episodes"""
    score: Callable[[Any], Any] | None = None


def channels_step(s: Any, w: Any) -> Any:
    """A particle at temperature 1 / 5.67 in a potential of two wells, with two ways between."""
    x, y = s
    hill, dip = jnp.exp(-(x**2) - (y - 1 / 3) ** 2), jnp.exp(-(x**2) - (y - 5 / 3) ** 2)
    right, left = jnp.exp(-((x - 1) ** 2) - y**2), jnp.exp(-((x + 1) ** 2) - y**2)
    along = 0.8 * x**3 - 6 * x * (hill - dip) + 10 * ((x - 1) * right + (x + 1) * left)
    across = 0.8 * (y - 1 / 3) ** 3 - 6 * (y - 1 / 3) * hill + 6 * (y - 5 / 3) * dip
    slope = jnp.stack([along, across + 10 * y * (right + left)])
    return s - 0.01 * slope + math.sqrt(2 * 0.01 / 5.67) * w


def channels_distance(s: Any) -> Any:
    """To 2.1 from the bottom of the first well."""
    return 2.1 - jnp.hypot(s[0] + 1, s[1])


CHANNELS = system([-0.9, 0.1], channels_step, channels_distance, 2, 2000), 6.011e-5, 500
SYSTEMS = {
    "two channels": Diffusion(*CHANNELS),
    "channels by x": Diffusion(*CHANNELS, score=lambda s: s[0]),
    "double well": Diffusion(well(), 1.342e-3, 750),
    "toy": Diffusion(toy(3.0, 50), 1.0877e-5, 500, score=lambda s: s[0] - 3.0 + 2 * s[1]),
}


def estimates(name: str, method: str, keys: int, particles: int) -> list[dict[str, Any]]:
    """An estimate for each key: its ratio to the truth, and what it took."""
    diffusion, found = SYSTEMS[name], []
    sim = diffusion.simulator
    for number in range(keys):
        key, begun = jax.random.key(number), time.process_time()
        if method == "pytams":
            from benchmarks import pytams_peer  # where it is installed

            mean, steps = pytams_peer.run(RUNS * particles)
            row = dict(relative_error=None, covered=None, flagged=False)
            row |= dict(ratio=mean / diffusion.truth, episodes=steps / sim.horizon)
        else:
            p = _estimate(key, diffusion, method, particles)
            low, high = p.interval
            row = dict(
                ratio=0.0 if math.isnan(p.mean) else p.mean / diffusion.truth,
                relative_error=p.relative_error,
                covered=bool(low <= diffusion.truth <= high),
                flagged=not p.reliable,
                episodes=p.episodes,
            )
        found.append(row | dict(cpu_s=time.process_time() - begun))
    return found


def _estimate(key, diffusion, method, particles):
    if method == "splitting":
        score = diffusion.score
        return jast.estimate.splitting(key, diffusion.simulator, particles, runs=RUNS, score=score)
    episodes = 20 * particles  # what splitting takes of these systems, about
    if method == "plain":
        return jast.estimate.monte_carlo(key, diffusion.simulator, episodes)
    return jast.estimate.failure_probability(key, diffusion.simulator, episodes)


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
        covered=None if rows[0]["covered"] is None else sum(row["covered"] for row in rows),
        flagged=sum(row["flagged"] for row in rows),
        silent=sum(wrong),
        keys=len(rows),
        episodes=float(np.mean([row["episodes"] for row in rows])),
        cpu_s=float(np.median([row["cpu_s"] for row in rows])),
    )


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "4 keys, without plain draws")
    parser.add_argument("--keys", type=int, help="default: 16; 4 with --quick, 1 with --smoke")
    parser.add_argument("--particles", type=int, help="of a run; default: by the system")
    add_choices(parser, "--systems", SYSTEMS)
    add_choices(parser, "--methods", METHODS, "all but failure_probability and pytams")
    args = parser.parse_args(argv)
    say, report = printer(args), {}
    keys = args.keys or size(args, 16, 4, 1)
    for name in args.systems or size(args, list(SYSTEMS), list(SYSTEMS), ["toy"]):
        particles = args.particles or size(args, *[SYSTEMS[name].particles] * 2, 20)
        for method in args.methods or size(args, ["splitting", "plain"], *[["splitting"]] * 2):
            if method == "pytams" and not (installed("pytams") and name == "two channels"):
                continue
            r = summary(estimates(name, method, keys, particles))
            report[f"{name}, {method}"] = r
            say(
                f"{name:13} {method:20} rms {r['rms']:.3f} mean {r['mean']:.3f}, covered"
                f" {r['covered']} flagged {r['flagged']} silent {r['silent']} of {r['keys']},"
                f" {r['episodes']:.0f} episodes, {r['cpu_s']:.1f} CPU s"
            )
    print_report(args, report)


if __name__ == "__main__":
    main()
