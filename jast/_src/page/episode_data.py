"""An episode as numbers by step, with the names that the user's pytrees have; and its disturbances
to the last bit.
"""

import inspect
import math
from collections.abc import Callable
from json import dumps
from typing import Any

import jax
import numpy as np

from jast._src.core.episode import Episode, replay
from jast._src.core.simulator import Simulator
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.checks import wrong
from jast._src.util.leaf_names import named_fields, path_name
from jast._src.util.pytrees import index_tree

__all__ = ["exact", "far", "groups", "pictures", "short", "states_of", "trace"]

ENTRIES = 24  # numbers of one array that a page shows; the others are counted


def trace(sim: Simulator | None, episode: Episode, quiet: Episode | None, most: int) -> dict:
    """What a page shows of an episode.

    Args:
        sim: which plays it again for its states; None: disturbances alone.
        episode: one.
        quiet: the undisturbed episode, to compare with, or None.
        most: numbers that it may have, nearly. Of a longer episode every second (third ...) step is
            shown, and the last.

    Returns:
        ``steps`` (shown, 0 is the start), ``length``, ``x`` (groups of columns over the steps; that
        of step t led to state t), ``x0`` (the same at the start), and where there is a simulator
        ``states``, ``quiet`` (the same of the undisturbed episode, None behind its end) and
        ``distance``.
    """
    played = None if sim is None else _played(sim, episode)
    whole = jax.tree.map(_numbers, played)
    n = int(episode.length)
    leaves = jax.tree.leaves((whole, episode.disturbances))
    width = sum(min(ENTRIES, math.prod(np.shape(a)[1:])) for a in leaves)
    stride = max(1, -(-(n + 1) * 2 * max(width, 1) // most))
    steps = sorted({*range(0, n + 1, stride), n})
    found = {"steps": steps, "length": n, "x": groups(episode.disturbances, steps, "x", late=1)}
    found["x0"] = groups(jax.tree.map(lambda a: np.asarray(a)[None], episode.x0), [0], "x0")
    if sim is None:
        return found
    found["states"] = groups(whole, steps, "state")
    # of an episodic system it says nothing, and a black box would be called again for it
    told = not (sim.episodic or runs_on_host(sim))
    found["distance"] = short(np.asarray(far(sim, played), float)[steps]) if told else None
    if quiet is not None:
        there = [t for t in steps if t <= int(quiet.length)]
        calm = groups(states_of(sim, quiet), there, "state")
        found["quiet"] = [group["columns"] for group in calm]
    return found


def states_of(sim: Simulator, episode: Episode) -> Any:
    """[horizon + 1, ...] NumPy arrays; of a random key, which is no number, an empty one."""
    return jax.tree.map(_numbers, _played(sim, episode))


def _played(sim: Simulator, episode: Episode) -> Any:
    return (replay(sim, episode) if episode.states is None else episode).states


def _numbers(a: Any) -> np.ndarray:
    key = jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key)
    return np.zeros((len(a), 0)) if key else np.asarray(a)


@jax.jit
def far(sim: Simulator, states: Any) -> jax.Array:
    """Miss distance of each of ``states`` [n, ...]."""
    return jax.vmap(lambda s: sim.evaluate(s)[1])(states)


def groups(
    tree: Any, steps: list[int], name: str, late: int = 0, most: int = ENTRIES
) -> list[dict]:
    """A group of columns for each array of the pytree ``tree`` [T, ...]: ``name``, the ``entries``
    of the array that are shown, at ``most`` so many, ``more``, how many are not, and ``columns``,
    each over ``steps``.

    ``late``: row 0 is of step 1, and step 0 has none.
    """
    found = []
    for called, places, flat in named_fields(tree, name):
        shown = np.pad(flat[:, :most], ((late, 0), (0, 0)), constant_values=np.nan)[steps]
        found.append(
            {
                "name": called,
                "entries": places[:most],
                "more": max(0, len(places) - most),
                "columns": [short(column) for column in shown.T],
            }
        )
    return found


def short(values: Any) -> list[float]:
    """Six digits are enough to be looked at."""
    return [float(f"{v:.6g}") for v in values]


def exact(episode: Episode) -> dict:
    """x0 and the steps taken, to the last bit: of each array its name, dtype and values."""

    def arrays(tree: Any) -> list[dict]:
        return [
            {
                "name": path_name(path),
                "dtype": np.asarray(a).dtype.name,
                "values": np.asarray(a).tolist(),
            }
            for path, a in jax.tree_util.tree_leaves_with_path(tree)
        ]

    n = int(episode.length)
    taken = jax.tree.map(lambda a: np.asarray(a)[:n], episode.disturbances)
    return {
        "length": n,
        "log_prob": float(episode.log_prob),
        "distance": float(episode.distance),
        "x0": arrays(episode.x0),
        "disturbances": arrays(taken),
    }


def pictures(
    caller: str, draw: Callable[..., str], states: Any, steps: list[int], most: int
) -> dict:
    """What ``draw`` makes of the states of an episode.

    Args:
        caller: for messages.
        draw: one state -> an SVG or HTML fragment; where it has an argument ``past``, that is the
            states before, [t, ...].
        states: [T, ...].
        steps: at which there may be a picture.
        most: characters that all of them may take. Where they would take more there are fewer
            pictures, and a step shows the last one before it.

    Returns:
        ``fragments``, and ``at``: of each of ``steps`` the number of its fragment.

    Raises:
        ValueError: where ``draw`` returns no text, or one picture is too long.
    """
    found: dict[int, str] = {}
    trails = _takes_past(draw)

    def drawn(t: int) -> str:
        if t not in found:
            past = {"past": index_tree(states, np.s_[:t])} if trails else {}
            found[t] = draw(index_tree(states, t), **past)
            if not isinstance(found[t], str):
                must = "return a str, an SVG or HTML fragment"
                raise wrong(caller, "draw", must, type(found[t]).__name__)
        return found[t]

    longest = max(1, _length(drawn(steps[0])), _length(drawn(steps[-1])))
    count = min(len(steps), max(1, most // longest))
    while True:
        places = np.unique(np.linspace(len(steps) - 1, 0, count).round().astype(int))
        fragments = [drawn(steps[i]) for i in places]
        if sum(map(_length, fragments)) <= most:
            break
        if count == 1:
            raise ValueError(
                f"{caller}: a picture of draw may have up to {most} characters here, received"
                f" {_length(fragments[0])}"
            )
        count //= 2
    at = np.maximum(np.searchsorted(places, np.arange(len(steps)), side="right") - 1, 0)
    return {"fragments": fragments, "at": at.tolist()}


def _takes_past(draw: Callable[..., str]) -> bool:
    try:
        return "past" in inspect.signature(draw).parameters
    except ValueError:  # a builtin that does not tell
        return False


def _length(fragment: str) -> int:
    """In the file."""
    return len(dumps(fragment, ensure_ascii=False).encode())
