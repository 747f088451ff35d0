"""How low F-16s come from uniform starts, by altitude (``python -m benchmarks.arch --flights``)."""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.simulators.arch import gcas
from jast._src.simulators.arch.flights import BOX

__all__ = ["rows", "table"]

ALTITUDES = 4040.0, 2338.0, 2330.0, 2270.0, 2262.0


@partial(jax.jit, static_argnames="steps")
def _least(starts, altitude, steps=1):
    """ft: the least altitude of each flight [n] from ``starts`` [n, 3]."""
    samples = round(gcas.DURATION / gcas.DT)

    def least(attitude):
        _, flight = gcas.drive(gcas.start(attitude, altitude), samples, steps)
        return flight.altitude.min()

    return jax.vmap(least)(starts)


def rows(flights, seed=0):
    """By altitude at the start: the least over random starts and the box's corners, where that was,
    and the share that hit the ground; and what half the integrator's step changes in the corners.
    """
    low, high = np.array(BOX)
    u = np.random.default_rng(seed).uniform(size=(flights, 3))
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

    def to(u):
        return jnp.asarray(low + u * (high - low), jnp.zeros(()).dtype)

    found = {}
    for altitude in ALTITUDES:
        begin = time.process_time()
        inside, ends = (np.asarray(_least(to(v), altitude)) for v in (u, corners))
        halved = np.asarray(_least(to(corners), altitude, steps=2))
        worst = corners[ends.argmin()]
        found[f"{altitude:g}"] = dict(
            least=float(min(inside.min(), ends.min())),
            corner=dict(zip(("roll", "pitch", "yaw"), worst.tolist(), strict=True)),
            yaw=float(np.abs(np.diff(ends.reshape(4, 2))).max()),
            halved=float(np.abs(halved - ends).max()),
            share=float((inside < 0).mean()),
            flights=flights,
            cpu_seconds=time.process_time() - begin,
        )
    return found


def table(found):
    """The rows as text."""
    lines = [
        f"{'altitude':>8} {'least, ft':>10} {'hit the ground':>14} {'by yaw, ft':>10}"
        f" {'half the step, ft':>17} {'CPU s':>6}"
    ]
    for altitude, r in found.items():
        lines.append(
            f"{altitude:>8} {r['least']:10.1f} {r['share']:14.2%} {r['yaw']:10.4f}"
            f" {r['halved']:17.3f} {r['cpu_seconds']:6.1f}"
        )
    return "\n".join(lines)
