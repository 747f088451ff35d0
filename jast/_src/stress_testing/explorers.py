"""The explorers of `jast.stress`: ways to find failures, each a function ``(key, sim, budget) ->
ExplorerResult``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.actions import wide
from jast._src.core.counter_prng import counter_key, numpy_generator
from jast._src.core.episode import Episode, replay, rollout
from jast._src.core.failures import empty
from jast._src.core.nominal import Nominal, rate_of
from jast._src.core.policy import undisturbed
from jast._src.core.rewards import likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.estimate.gaussians.design_points import design_points
from jast._src.estimate.host_populations import cool, explore
from jast._src.estimate.population.descents import population_size
from jast._src.estimate.population.particle_moves import (
    Particles,
    allocate_particles,
    draw_particles,
)
from jast._src.normal_space import transform
from jast._src.normal_space.evaluate_points import evaluate_points, lanes_of
from jast._src.normal_space.mode_coordinates import centred
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.cem import cem
from jast._src.search.falsify import falsify
from jast._src.search.forest import forest
from jast._src.search.go_explore.go_explore import go_explore
from jast._src.search.monte_carlo import monte_carlo
from jast._src.util.display import call_settings
from jast._src.util.pytrees import index_tree

__all__ = [
    "EXPLORERS",
    "ExplorerResult",
    "divide_budget",
    "failing_episodes",
    "failures_at",
    "has_quantiles",
    "nominal_points",
    "slow_cross_entropy",
]

MAX_FAILURES = 128  # failures that an explorer hands over, the most
PRUNES = 18
"""Prunes of a tree: 10 with more simulations each found failures of `jast.simulators.colav` in half
as many trees.
"""
TREE_EVALUATIONS = 2500  # evaluations for each tree of a forest, and at most as many trees as below
MAX_TREES = 64  # trees of a forest; one with more would prune too rarely
COOLED_EVALUATIONS = 84  # of each failure that is cooled: its wide draws, and a move at each width
LEVEL_EVALUATIONS = 12  # evaluations for each point that goes down the levels of the distance
LEVEL_POINTS = 50, 1000  # least and greatest number of them
DESCENT_EVALUATIONS = 108  # evaluations for each descent by gradients
DESCENTS = 4, 48  # least and greatest number of them
ITERATIONS = 15  # iterations of the cross-entropy method
SLOW_ITERATIONS = 30  # half as many with twice the draws end in worse basins
SLOW_WIDTH = 0.5  # width of its first draws around a failure
ELITES = 10  # share of the draws that the cross-entropy method fits, its denominator; a convention


class ExplorerResult(NamedTuple):
    """What an explorer found."""

    episodes: Episode
    """Failing ones [m], on the host."""
    evaluations: int
    failing: int
    """Failing episodes among those simulated, where they were counted; else m"""
    invalid: int


def plain_draws(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """Draws of the model; points, for the program that judges these is compiled anyway."""
    if not has_quantiles(sim):
        reward = likelihood(sim)
        return _from_search(monte_carlo(key, sim, episodes=budget, reward=reward, top=MAX_FAILURES))
    return _draw_points(key, sim, budget)[0]


def nominal_points(
    key: jax.Array, sim: Simulator, episodes: int, by_populations: bool = False
) -> tuple[Nominal, Episode]:
    """`jast.nominal` by points, and failing episodes of it [m]; the undisturbed one has the reward
    of `collect` here, too, and is a point where all modes are medians: no program is for it alone.
    Nor is one for the others: the program of ``by_populations``, or of the searches, draws them.
    """
    signature, reward, quiet = signature_of(sim), likelihood(sim), None
    offers = [signature.disturbance, *([signature.start] if signature.random_start else [])]
    if all(o.mode_is_median for o in offers):
        e = transform.played(sim, np.zeros((1, transform.dimension(sim))))
        quiet = replay(sim, index_tree(e, 0), reward=reward)
    elif all(o.mode for o in offers):
        quiet = rollout(key, sim, undisturbed(sim), reward)  # draws nothing
    draw = _draw_particles if by_populations else _draw_points
    found, distance = draw(key, sim, episodes)
    valid = episodes - found.invalid
    rate, interval = rate_of(found.failing, found.invalid, episodes)
    n = Nominal(
        undisturbed=quiet,
        failing=found.failing,
        episodes=episodes,
        rate=rate,
        interval=interval,
        mean_distance=distance / valid if valid else np.nan,
        invalid=found.invalid,
        settings=call_settings("nominal", key, episodes=episodes),
    )
    return n, found.episodes


def _draw_points(key, sim, n):
    """The `ExplorerResult` of ``n`` draws of the model, and the sum of the valid distances."""
    rng, d = numpy_generator(key), transform.dimension(sim)
    failures = np.zeros((0, d), transform.normal_numbers(sim))
    log_p, failing, invalid, distance = np.zeros(0), 0, 0, 0.0
    for begin in range(0, n, size := lanes_of(d)):
        z = rng.standard_normal((min(size, n - begin), d)).astype(failures.dtype)
        o = evaluate_points(sim, z)
        failing, invalid = failing + o.failure.sum(), invalid + o.invalid.sum()
        distance += float(o.distance[~o.invalid].sum(dtype=np.float64))
        failures = np.concatenate([failures, z[o.failure]])
        log_p = np.concatenate([log_p, o.log_p[o.failure]])
        best = np.argsort(-log_p, kind="stable")[:MAX_FAILURES]
        failures, log_p = failures[best], log_p[best]
    episodes = failures_at(sim, failures).episodes
    return ExplorerResult(episodes, n, int(failing), int(invalid)), distance


def _draw_particles(key, sim, n):
    """The same, of the failures one alone."""
    size = population_size(sim)
    particles, failing, invalid, distance = allocate_particles(sim, size), 0, 0, 0.0
    first = np.zeros((0, transform.dimension(sim)), transform.normal_numbers(sim))
    for i, begin in enumerate(range(0, n, size)):
        m = min(size, n - begin)
        particles, wrong = draw_particles(sim, particles, counter_key(key, 1, i), m)
        p = Particles(*(np.asarray(a)[:m] for a in particles))
        fails = p.score == -np.inf
        failing, invalid = failing + int(fails.sum()), invalid + wrong
        distance += float(p.distance[p.score < np.inf].sum(dtype=np.float64))
        first = np.concatenate([first, p.z[fails]])[:1]
    return ExplorerResult(failures_at(sim, first).episodes, n, failing, invalid), distance


def falsified(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """The first failures that signals of few pieces lead to; ends with these."""
    return _from_search(falsify(key, sim, simulations=budget, top=MAX_FAILURES))


def cooled_noise(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """Wider noise, cooled down: chains that start where failures are frequent."""
    return _from_points(sim, cool(key, sim, _number(budget, COOLED_EVALUATIONS, 1, MAX_FAILURES)))


def distance_levels(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """Subset simulation: down the levels of the miss distance."""
    size = _number(budget, LEVEL_EVALUATIONS, *LEVEL_POINTS)
    return _from_points(sim, explore(key, sim, size, max_evaluations=budget))


def gradients(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """Gradients of the miss distance, from draws of the model."""
    found = design_points(key, sim, _number(budget, DESCENT_EVALUATIONS, *DESCENTS))
    return _from_points(sim, found)


def cross_entropy(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """The cross-entropy method."""
    return _from_search(_cem(key, sim, budget, ITERATIONS))


def slow_cross_entropy(
    key: jax.Array, sim: Simulator, budget: int, failures: Any = None
) -> ExplorerResult:
    """The cross-entropy method in many small steps, which cross from one basin to another where
    slopes lead nowhere; around the likeliest of ``failures``, if any are given.
    """
    actions = None if failures is None else wide(SLOW_WIDTH)
    about = dict(failures=failures, actions=actions)
    return _from_search(_cem(key, centred(sim), budget, SLOW_ITERATIONS, **about))


def search_forest(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """A forest of search trees."""
    trees = _number(budget, TREE_EVALUATIONS, 1, MAX_TREES)
    each = max(10, budget // (PRUNES * trees))
    about = dict(trees=trees, prunes=PRUNES, simulations=each)
    return _from_search(forest(key, sim, **about, refine=0, top=MAX_FAILURES))


def kept_states(key: jax.Array, sim: Simulator, budget: int) -> ExplorerResult:
    """Restarts from kept states, for failures that take many things one after another."""
    return _from_search(go_explore(key, sim, episodes=budget, refine=0, top=MAX_FAILURES))


class Explorer(NamedTuple):
    """A way to find failures, and where it serves."""

    run: Callable[[jax.Array, Simulator, int], ExplorerResult]
    min_evaluations: int | None
    """Below which it is not worth a call; None where it is called by itself: first, of a system on
    the host, or only if nothing else found a failure"""
    needs_quantiles: bool = False
    """Whether the disturbances need quantile functions"""
    needs_gradients: bool = False


EXPLORERS = {
    "falsify": Explorer(falsified, None, needs_quantiles=True),
    "widened noise, cooled": Explorer(cooled_noise, COOLED_EVALUATIONS, needs_quantiles=True),
    "plain draws": Explorer(plain_draws, 30),
    "gradients": Explorer(
        gradients, DESCENT_EVALUATIONS * DESCENTS[0], needs_quantiles=True, needs_gradients=True
    ),
    "levels of distance": Explorer(
        distance_levels, LEVEL_EVALUATIONS * LEVEL_POINTS[0], needs_quantiles=True
    ),
    "cross-entropy": Explorer(cross_entropy, 600),
    "forest": Explorer(search_forest, 2000),
    "kept states": Explorer(kept_states, None),
}
"""By name; where the budget is small, those that come first are called."""


def has_quantiles(sim: Simulator) -> bool:
    """Whether an episode of ``sim`` is a point of normal numbers."""
    signature = signature_of(sim)
    return signature.start.quantile and signature.disturbance.quantile


def divide_budget(sim: Simulator, budget: int) -> dict[str, int]:
    """The names of the explorers that work on ``sim``, with what each has of ``budget``
    evaluations.
    """
    floats = all(
        jnp.issubdtype(s.dtype, jnp.floating) for s in jax.tree.leaves(signature_of(sim).x)
    )
    quantiles, differentiable = has_quantiles(sim), floats and not runs_on_host(sim)
    least, left = {}, budget
    for name, explorer in EXPLORERS.items():
        fits = explorer.min_evaluations is not None and explorer.min_evaluations <= left
        fits = fits and (quantiles or not explorer.needs_quantiles)
        if fits and (differentiable or not explorer.needs_gradients):
            least[name] = explorer.min_evaluations
            left -= least[name]
    return {name: n + left // len(least) for name, n in least.items()}


def failures_at(sim: Simulator, points: np.ndarray) -> ExplorerResult:
    """Those of the first points [m, D] of normal numbers that fail."""
    points = points[:MAX_FAILURES]
    if not len(points):
        return ExplorerResult(empty(sim).episodes, 0, 0, 0)
    e = transform.played(sim, points)
    e = index_tree(e, e.failure)
    return ExplorerResult(e, len(points), len(e.length), 0)


def failing_episodes(sim: Simulator, runs: list) -> Episode:
    """The failing ``runs`` of a black box as a batch of episodes, to be replayed; at least one."""
    like, n = signature_of(sim), len(runs)
    zero, number = np.zeros(n, like.dtype), np.array([run.t for run in runs], np.int32)
    x0, x = (
        jax.tree.structure(tree).unflatten([np.stack(a) for a in zip(*leaves, strict=True)])
        for tree, leaves in ((like.x0, [r.x0 for r in runs]), (like.x, [r.xs for r in runs]))
    )
    return Episode(
        x0=x0,
        disturbances=x,
        log_prob=zero,
        distance=zero,
        failure=np.ones(n, bool),
        length=number,
        reward=zero,
    )


def _number(budget, each, least, most):
    """How many the budget affords at so many evaluations ``each``."""
    return int(np.clip(budget // each, least, most))


def _cem(key, sim, budget, iterations, **about):
    """The `jast.search.SearchResult` of the cross-entropy method."""
    samples = max(10, budget // iterations)
    elites = max(2, samples // ELITES)
    numbers = dict(samples=samples, elites=elites, iterations=iterations)
    return cem(key, sim, **numbers, **about, refine=0, top=MAX_FAILURES)


def _from_search(result: Any) -> ExplorerResult:
    """The failures of a `jast.search.SearchResult`."""
    found = result.failures.episodes
    return ExplorerResult(found, result.episodes, int(result.failing), int(result.invalid))


def _from_points(sim: Simulator, found: Any) -> ExplorerResult:
    """The failures of an explorer that ends with points."""
    result = failures_at(sim, np.asarray(found.points))
    invalid = int(getattr(found, "invalid", 0))
    return result._replace(evaluations=found.evaluations, invalid=invalid)
