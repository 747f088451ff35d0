"""The moving picture of the front page: ``python docs/film.py [docs/failure.gif]``.

Ordinary episodes of the ferry pass, then the likeliest collision that a search found.
"""

import sys

import jax
import matplotlib
import numpy as np

matplotlib.use("agg")

import matplotlib.pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter

import jast
from jast._src.plot import style
from jast._src.simulators.ferry import COLLISION

ORDINARY = 40  # episodes by chance
HOLD = 14  # frames that the end stays


def played():
    """Paths [n, T + 1, 2] of the vessel by chance and how many of these collide; its path in the
    failure, and the ferry's.
    """
    sim = jast.simulators.ferry()
    keys = jax.random.split(jax.random.key(1), ORDINARY)
    chance = jax.vmap(lambda key: jast.rollout(key, sim))(keys)
    found = jast.search.cem(jax.random.key(0), sim)
    failure = jast.replay(sim, found.failures.best)
    steps = int(failure.length) + 1

    def path(x, y):
        return np.stack([x, y], -1)[..., :steps, :]

    c, s = chance.states, failure.states
    hits = int(chance.failure.sum())
    return path(c.x, c.y), hits, path(s.x, s.y), path(s.ferry_x, s.ferry_y)


def film(path):
    """Write the GIF at ``path``."""
    chance, hits, failure, ferry = played()
    last = len(failure) - 1
    with style.styled():
        figure, ax = plt.subplots(figsize=(6.4, 5.0), dpi=80, layout="constrained")
        ax.set(xlim=(-5, 112), ylim=(-14, 74), aspect="equal", xlabel="x", ylabel="y")
        ax.plot(*ferry[0], "s", color=style.BLUE, markersize=8)
        ax.plot(*failure[0], "s", color=style.VERMILION, markersize=8)
        ax.text(*(ferry[0] + [0, 5]), "ferry", color=style.BLUE, weight="bold", fontsize=13)
        ax.text(21, -5, "steers at random", color=style.VERMILION, weight="bold", fontsize=13)
        title = ax.set_title(" ", fontsize=14)
        lines = [ax.plot([], [], color=style.GREY, alpha=0.35, linewidth=1)[0] for _ in chance]
        [vessel] = ax.plot([], [], color=style.VERMILION, linewidth=3)
        [other] = ax.plot([], [], color=style.BLUE, linewidth=3)
        ring = plt.Circle(ferry[0], COLLISION, color=style.BLUE, alpha=0.25)
        ax.add_patch(ring)

        def draw(frame):
            first, t = frame <= last + HOLD // 2, frame
            if not first:
                t = frame - last - HOLD // 2 - 1
            t = min(t, last)
            if first:
                for line, way in zip(lines, chance, strict=True):
                    line.set_data(*way[: t + 1].T)
            vessel.set_data(*([[], []] if first else failure[: t + 1].T))
            other.set_data(*ferry[: t + 1].T)
            ring.center = ferry[t]
            words = f"{ORDINARY} episodes by chance: {hits or 'none'} of them ends in a collision"
            title.set_text(words if first else "the likeliest collision that was found")
            return [*lines, vessel, other, ring, title]

        frames = 2 * (last + 1) + HOLD // 2 + HOLD
        animation = FuncAnimation(figure, draw, frames, blit=False)
        animation.save(path, writer=PillowWriter(fps=6))
        plt.close(figure)


if __name__ == "__main__":
    film(sys.argv[1] if len(sys.argv) > 1 else "docs/failure.gif")
