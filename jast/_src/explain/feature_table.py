"""Numbers that say in a few words what an episode was like, with the names of the user's fields."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.normal_space.episode_point import names_of_leaves
from jast._src.util.leaf_names import named_numbers

__all__ = ["Describer", "Feature", "feature_table", "make_describer"]

RUNS = 2, 3, 4, 8, 16  # steps in a row that are looked at together, wherever they are
VALUES = 8  # different whole numbers that are told apart as kinds, at most
FEATURES = 4000  # of a table, nearly, at most
COMPONENTS = 6  # of which it is said what each was while another was greatest, at most


class Feature(NamedTuple):
    """A column of the table."""

    name: str
    kind: str
    """ "number", "count" or "truth"."""


class Describer(NamedTuple):
    """What is fixed once, so that every later episode gets the same table."""

    kinds: dict[str, Any]
    """Component -> the values that it takes, of those that have few."""
    finest: int
    """Steps of the shortest window at a place of its own."""
    of: str
    lead: int


def make_describer(sim: Simulator, episodes: Episode, of: str, lead: int) -> Describer:
    """The `Describer` for episodes like these."""
    kinds = {}
    components = _components(sim, episodes)
    for name, v in components:
        if v.dtype.kind in "iub" and len(values := np.unique(v)) <= VALUES:
            kinds[name] = tuple(values.tolist())
    width = sum(max(len(kinds.get(name, ())), 1) for name, _ in components)
    finest = 1
    while 3 * width * sim.horizon // finest > FEATURES:
        finest *= 2
    return Describer(kinds, finest, of, lead)


def feature_table(
    sim: Simulator, d: Describer, episodes: Episode, end: np.ndarray
) -> tuple[list[Feature], np.ndarray]:
    """The features [F] of ``episodes`` [n], and their values [n, F].

    ``end`` [n]: the step at which each is over, from which what is said of states counts back.
    """
    found: list[tuple[Feature, np.ndarray]] = []
    if d.of != "states":
        for name, v in named_numbers(episodes.x0, "x0"):
            found.append((Feature(f"{name} at the start", "number"), v))
        parts = _components(sim, episodes)
        for name, v in parts:
            if name in d.kinds:
                truth = v.dtype.kind == "b"
                for value in d.kinds[name][-1:] if truth else d.kinds[name]:
                    found += _of_kind(name if truth else f"{name} = {value}", v == value, d)
            else:
                found += _of_numbers(name, v.astype(float), d)
        numbers = [(name, v.astype(float)) for name, v in parts if name not in d.kinds]
        found += _together(numbers, parts)
    if d.of != "disturbances":
        found += _of_states(sim, episodes.states, np.maximum(end - d.lead, 0), d.lead)
    return [f for f, _ in found], np.stack([np.asarray(v, np.float32) for _, v in found], axis=1)


def _components(sim: Simulator, episodes: Episode) -> list[tuple[str, np.ndarray]]:
    """(name, values [n, horizon]) of each number of a disturbance."""
    named = iter(names_of_leaves(signature_of(sim).x, "x"))
    leaves = map(np.asarray, jax.tree.leaves(episodes.disturbances))
    rows = [a.reshape(*a.shape[:2], -1) for a in leaves]
    return [(next(named), a[..., i]) for a in rows for i in range(a.shape[-1])]


def _windows(v: np.ndarray, finest: int) -> Iterator[tuple[str, int, np.ndarray]]:
    """("at step 3", 1, values) and ("of steps 5 to 8", 4, means) of ``v`` [n, T]."""
    horizon = v.shape[1]
    if finest == 1:
        for t in range(horizon):
            yield f"at step {t + 1}", 1, v[:, t]
    size = max(finest, 2)
    while size < horizon:
        for t in range(0, horizon - size + 1, size // 2):
            yield f"of steps {t + 1} to {t + size}", size, v[:, t : t + size].mean(axis=1)
        size *= 2
    for t in range(3, horizon) if finest == 1 else ():
        if t & (t - 1):  # those of 2, 4, 8 ... steps were there
            yield f"of steps 1 to {t}", t, v[:, :t].mean(axis=1)


def _of_numbers(name: str, v: np.ndarray, d: Describer) -> Iterator[tuple[Feature, np.ndarray]]:
    horizon = v.shape[1]
    if horizon == 1:
        yield Feature(name, "number"), v[:, 0]
        return
    yield Feature(f"mean {name}", "number"), v.mean(axis=1)
    for word, best, where in (("greatest", np.max, np.argmax), ("least", np.min, np.argmin)):
        yield Feature(f"{word} {name}", "number"), best(v, axis=1)
        yield Feature(f"step of the {word} {name}", "count"), where(v, axis=1) + 1
    for size in [k for k in RUNS if k < horizon]:
        sums = np.cumsum(np.pad(v, ((0, 0), (1, 0))), axis=1)
        means = (sums[:, size:] - sums[:, :-size]) / size
        for word, best in (("greatest", np.max), ("least", np.min)):
            text = f"{word} mean {name} of {size} steps in a row"
            yield Feature(text, "number"), best(means, axis=1)
        each = np.lib.stride_tricks.sliding_window_view(v, size, axis=1)
        kept = each.min(axis=2).max(axis=1), each.max(axis=2).min(axis=1)
        yield Feature(f"greatest {name} kept up for {size} steps", "number"), kept[0]
        yield Feature(f"least {name} kept up for {size} steps", "number"), kept[1]
    for place, size, values in _windows(v, d.finest):
        yield Feature(f"{'mean ' * (size > 1)}{name} {place}", "number"), values


def _of_kind(name: str, v: np.ndarray, d: Describer) -> Iterator[tuple[Feature, np.ndarray]]:
    """Of a thing that holds at some steps ``v`` [n, T] bool."""
    horizon = v.shape[1]
    if horizon == 1:
        yield Feature(name, "truth"), v[:, 0]
        return
    yield Feature(f"number of steps with {name}", "count"), v.sum(axis=1)
    yield Feature(f"longest run of {name}", "count"), _longest(v)
    for place, size, values in _windows(v.astype(float), d.finest):
        if size == 1:
            yield Feature(f"{name} {place}", "truth"), values
        else:
            yield Feature(f"number {place} with {name}", "count"), values * size


def _longest(v: np.ndarray) -> np.ndarray:
    """[n] the longest run of True in rows of ``v``."""
    run, best = np.zeros(len(v), int), np.zeros(len(v), int)
    for column in v.T:
        run = np.where(column, run + 1, 0)
        best = np.maximum(best, run)
    return best


def _together(
    numbers: list[tuple[str, np.ndarray]], parts: list[tuple[str, np.ndarray]]
) -> Iterator[tuple[Feature, np.ndarray]]:
    """What each component was while another was greatest or least."""
    if not 2 <= len(parts) <= COMPONENTS or parts[0][1].shape[1] == 1:
        return
    rows = np.arange(len(parts[0][1]))
    for name, v in numbers:
        for word, where in (("greatest", np.argmax), ("least", np.argmin)):
            at = where(v, axis=1)
            for other, w in parts:
                if other != name:
                    kind = "truth" if w.dtype.kind == "b" else "number"
                    yield Feature(f"{other} while {name} is {word}", kind), w[rows, at]


def _of_states(
    sim: Simulator, states: Any, at: np.ndarray, lead: int
) -> Iterator[tuple[Feature, np.ndarray]]:
    """Of the states that are seen until step ``at`` [n]."""
    rows, when = np.arange(len(at)), f"{lead} step{'s' * (lead != 1)} before the end"
    seen = np.arange(sim.horizon + 1) <= at[:, None]
    for name, v in named_numbers(states, "state", lead=2):
        now, before = v[rows, at], v[rows, np.maximum(at - 4, 0)]
        for words, values in (
            (f"{name} {when}", now),
            (f"greatest {name} until {when}", np.where(seen, v, -np.inf).max(axis=1)),
            (f"least {name} until {when}", np.where(seen, v, np.inf).min(axis=1)),
            (f"mean {name} until {when}", np.where(seen, v, 0.0).sum(axis=1) / (at + 1)),
            (f"rise of {name} in the 4 steps until {when}", now - before),
        ):
            yield Feature(words, "number"), values
