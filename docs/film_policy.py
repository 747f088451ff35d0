"""The film of the lesson on a trained policy: ``python docs/film_policy.py [docs/policy.gif]``.

Runs the cells of notebooks/trained_policy.ipynb up to its report, so it needs the extra
``systems``; then draws an ordinary episode above the likeliest failure.
"""

import json
import sys
from pathlib import Path

import jax
import matplotlib
import numpy as np

matplotlib.use("agg")

import matplotlib.pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter

import jast
from jast._src.plot import style

NOTEBOOK = Path(__file__).parents[1] / "notebooks/trained_policy.ipynb"
EVERY = 2  # steps of 20 ms a frame
HOLD = 8  # frames that the end stays
POLE = 1.0  # twice the half length that the environment's formula has


def played():
    """Cart and angle [T + 1, 2] of an episode by chance, and of the likeliest failure."""
    names = {}
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        if cell["cell_type"] == "code" and "report" not in names:
            exec("".join(cell["source"]), names)
    sim, failure = names["sim"], names["report"].failures[0]
    both = jast.rollout(jax.random.key(1), sim), jast.replay(sim, failure)

    def path(s, n):
        return np.stack([s.x, s.theta], -1)[: n + 1]

    return [path(e.states.state, int(e.length)) for e in both]


def film(path):
    """Write the GIF at ``path``."""
    episodes = played()
    words = "by chance", "the likeliest failure"
    colours = style.BLUE, style.VERMILION
    with style.styled():
        figure, axes = plt.subplots(2, 1, figsize=(5.2, 4.4), dpi=72, layout="constrained")
        poles = []
        for ax, word, colour in zip(axes, words, colours, strict=True):
            ax.set(xlim=(-1.3, 1.3), ylim=(-0.2, 1.15), aspect="equal", title=word, yticks=[])
            [cart] = ax.plot([], [], "s", color=style.GREY, markersize=16)
            [pole] = ax.plot([], [], color=colour, linewidth=4)
            poles.append((cart, pole))
        axes[1].set_xlabel("cart [m]")

        def draw(frame):
            for (cart, pole), way in zip(poles, episodes, strict=True):
                x, angle = way[min(frame * EVERY, len(way) - 1)]
                cart.set_data([x], [0.0])
                pole.set_data([x, x + POLE * np.sin(angle)], [0.0, POLE * np.cos(angle)])
            return [part for pair in poles for part in pair]

        frames = max(map(len, episodes)) // EVERY + HOLD
        FuncAnimation(figure, draw, frames, blit=False).save(path, writer=PillowWriter(fps=15))
        plt.close(figure)


if __name__ == "__main__":
    film(sys.argv[1] if len(sys.argv) > 1 else "docs/policy.gif")
