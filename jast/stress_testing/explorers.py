"""The explorers of `jast.stress`: ways to find failures, each a function ``(key, sim, budget) ->
Haul``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import limit_state as latent
from jast.actions import wide
from jast.episode import Episode
from jast.estimate.design_points import design_points
from jast.estimate.populations import cool, explore
from jast.failures import empty
from jast.incidents import runs_on_host
from jast.outline import outline
from jast.rewards import likelihood
from jast.search.cem import cem
from jast.search.centred import centred
from jast.search.forest import forest
from jast.search.go_explore import go_explore
from jast.search.monte_carlo import monte_carlo
from jast.simulator import Simulator

__all__ = ["EXPLORERS", "Haul", "explorers_of", "of_points", "onward"]

KEPT = 128
"""Failures that an explorer hands over, the most."""
PRUNES = 18
"""Of a tree: 10 with more simulations each found failures of `jast.simulators.colav` in half as
many trees.
"""
STEPS = 30
"""Iterations of `onward`: half of them with twice the draws ends in worse basins."""
AROUND = 0.5
"""Width of its first draws around a failure."""


class Haul(NamedTuple):
    """What an explorer brought in."""

    episodes: Episode
    """Failing ones [m], on the host."""
    evaluations: int
    failing: int
    """Failing episodes among those simulated, where they were counted; else m"""
    invalid: int


def plain(key: jax.Array, sim: Simulator, budget: int) -> Haul:
    """Draws of the model."""
    return _of_search(monte_carlo(key, sim, episodes=budget, reward=likelihood(sim), top=KEPT))


def cooled(key: jax.Array, sim: Simulator, budget: int) -> Haul:
    """Wider noise, cooled down: chains that start where failures are frequent."""
    return _of_points(sim, cool(key, sim, int(np.clip(budget // 84, 1, KEPT))))


def levels(key: jax.Array, sim: Simulator, budget: int) -> Haul:
    """Subset simulation: down the levels of the miss distance."""
    found = explore(key, sim, int(np.clip(budget // 12, 50, 1000)), most=budget)
    return _of_points(sim, found)


def slopes(key: jax.Array, sim: Simulator, budget: int) -> Haul:
    """Gradients of the miss distance, from draws of the model."""
    found = design_points(key, sim, int(np.clip(budget // 108, 4, 48)))
    return _of_points(sim, found)


def likest(key: jax.Array, sim: Simulator, budget: int) -> Haul:
    """The cross-entropy method."""
    samples = max(10, budget // 15)
    elites = max(2, samples // 10)
    return _of_search(
        cem(key, sim, samples=samples, elites=elites, iterations=15, refine=0, top=KEPT)
    )


def onward(key: jax.Array, sim: Simulator, budget: int, failures: Any = None) -> Haul:
    """The cross-entropy method in many small steps, which cross from one basin to another where
    slopes lead nowhere; around the likeliest of ``failures``, if any are given.
    """
    samples = max(10, budget // STEPS)
    return _of_search(
        cem(
            key,
            centred(sim),
            samples=samples,
            elites=max(2, samples // 10),
            iterations=STEPS,
            failures=failures,
            actions=None if failures is None else wide(AROUND),
            refine=0,
            top=KEPT,
        )
    )


def trees(key: jax.Array, sim: Simulator, budget: int) -> Haul:
    """A forest of search trees."""
    number = int(np.clip(budget // 2500, 1, 64))
    each = max(10, budget // (PRUNES * number))
    return _of_search(
        forest(key, sim, trees=number, prunes=PRUNES, simulations=each, refine=0, top=KEPT)
    )


def kept(key: jax.Array, sim: Simulator, budget: int) -> Haul:
    """Restarts from kept states, for failures that take many things one after another."""
    return _of_search(go_explore(key, sim, episodes=budget, refine=0, top=KEPT))


EXPLORERS: dict[str, Callable[[jax.Array, Simulator, int], Haul]] = {
    "plain draws": plain,
    "widened noise, cooled": cooled,
    "gradients": slopes,
    "levels of distance": levels,
    "cross-entropy": likest,
    "forest": trees,
    "kept states": kept,
}
LATENT = {"widened noise, cooled", "gradients", "levels of distance"}
LEAST = {
    "widened noise, cooled": 84,
    "plain draws": 30,
    "gradients": 432,
    "levels of distance": 600,
    "cross-entropy": 600,
    "forest": 2000,
}
"""Evaluations below which an explorer is not worth a call; those that come first are left last.
"kept states" is called only where nothing else found a failure.
"""


def explorers_of(sim: Simulator, budget: int) -> dict[str, int]:
    """The names of those that work on ``sim``, with what each has of ``budget`` evaluations."""
    about = outline(sim)
    quantiles = about.start.quantile and about.disturbance.quantile
    floats = all(jnp.issubdtype(s.dtype, jnp.floating) for s in jax.tree.leaves(about.x))
    chosen, left = [], budget
    for name, least in LEAST.items():
        fits = (quantiles or name not in LATENT) and least <= left
        if fits and (name != "gradients" or (floats and not runs_on_host(sim))):
            chosen.append(name)
            left -= least
    return {name: LEAST[name] + left // len(chosen) for name in chosen}


def _of_search(result: Any) -> Haul:
    """The `Haul` of a `jast.search.SearchResult`."""
    found = result.failures.episodes
    return Haul(found, result.episodes, int(result.failing), int(result.invalid))


def _of_points(sim: Simulator, found: Any) -> Haul:
    """The `Haul` of an explorer that ends with points."""
    haul = of_points(sim, np.asarray(found.points))
    return haul._replace(evaluations=found.evaluations, invalid=int(getattr(found, "invalid", 0)))


def of_points(sim: Simulator, points: np.ndarray) -> Haul:
    """The `Haul` of points [m, D] of normal numbers: those of the first that fail."""
    points = points[:KEPT]
    if not len(points):
        return Haul(empty(sim).episodes, 0, 0, 0)
    e = latent.played(sim, points)
    e = jax.tree.map(lambda a: a[e.failure], e)
    return Haul(e, len(points), len(e.length), 0)
