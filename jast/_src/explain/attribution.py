"""attribution: the share of each disturbance in how near the system came to failing."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.normal_space import episode_point
from jast._src.normal_space.episode_point import EpisodePoint
from jast._src.normal_space.gradients import gradients
from jast._src.runtime.host_errors import runs_on_host
from jast._src.runtime.progress_bar import Watch
from jast._src.util import checks, display

__all__ = ["Attribution", "attribution"]

POINTS = 128  # on the way from the mode to the episode
HOSTED_BUDGET = 1000  # evaluations of a black box by default
PRINTED = 10  # disturbances
METHODS = "shapley", "integrated", "gradient"


@display.printable()
class Attribution(NamedTuple):
    """By how much each disturbance has lowered the miss distance.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> failure = jast.replay(sim, jnp.full(30, 0.5).at[3].set(5.0))
        >>> found = jast.explain.attribution(sim, failure, permutations=10)
        >>> found.parts[0][0]  # the greatest is that of step 4
        4
    """

    values: Any
    """Like the disturbances [horizon, ...]: above 0 what led towards the failure. In units of the
    distance; of the gradient, of the distance for each unit that the normal number goes on."""
    start: Any
    """The same of x0."""
    error: Any
    """Standard errors of ``values``; 0 where nothing is drawn at random."""
    total: float
    """Miss distance of the undisturbed system less that of the episode."""
    method: str
    parts: tuple[Any, ...]
    """(step, name, value, error), the greatest first; step 0 is x0."""
    residual: float
    """``total`` less the sum of all values: what a sum of differences has left out. NaN of the
    gradient, which need not sum to anything."""
    evaluations: int
    """Episodes simulated; one with its gradient counts as 4."""

    def __str__(self) -> str:
        lines = [f"{self.method}: the disturbances lowered the miss distance by {self.total:.4g}"]
        for step, name, value, error in self.parts[:PRINTED]:
            line = f"  step {step:4d}  {name:<12} {value:+10.4g}"
            line += f" +- {error:.2g}" if error > 0 else ""
            sums = self.total and not np.isnan(self.residual)
            lines.append(line + (f"  {value / self.total:6.1%}" if sums else ""))
        if len(self.parts) > PRINTED:
            rest = sum(value for _, _, value, _ in self.parts[PRINTED:])
            lines.append(f"  the other {len(self.parts) - PRINTED:3d} {'':<12} {rest:+10.4g}")
        return "\n".join(lines)


def attribution(
    sim: Simulator,
    episode: Episode,
    method: Literal["shapley", "integrated", "gradient"] = "shapley",
    *,
    key: PRNGKey | None = None,
    permutations: int = 200,
    budget: int | None = None,
    progress: bool = False,
) -> Attribution:
    """Which disturbances brought the failure about, and by how much?

    The miss distance of the episode is compared with that of the undisturbed system, in which every
    disturbance is at its mode. ``"shapley"`` (Shapley 1953): the mean of what each number changes
    when the disturbances are put in, one after the other, in random orders; by simulation alone, so
    for black boxes, too; the values sum to the whole. ``"integrated"`` (integrated gradients,
    Sundararajan, Taly and Yan 2017): the gradient along the way from the mode to the episode; they
    sum to the whole up to ``residual``. ``"gradient"``: the slope at the episode, just outside of
    the failures, on the way from the mode.

    Args:
        sim: the simulator; its disturbances have quantile functions.
        episode: one failure.
        method: "shapley", "integrated" or "gradient".
        key: of the orders; `jax.random.key(0)` by default.
        permutations: orders, at least 2; each costs as many episodes as there are numbers. Every
            other order is the one before it reversed (antithetic).
        budget: of "shapley": evaluations at most; there are fewer orders where it affords no more.
            Default: none; 1000 of a black box.
        progress: whether there is a bar, of "shapley".

    Returns:
        `Attribution`.

    Raises:
        ValueError: for another method, a budget that does not do for two orders, where the distance
            has no finite gradient, and where ``episode`` is not one failure of this simulator.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> failure = jast.replay(sim, jnp.full(30, 0.5).at[3].set(5.0))
        >>> found = jast.explain.attribution(sim, failure, permutations=10)
        >>> int(jnp.argmax(jnp.abs(found.values)))
        3
    """
    name = "attribution"
    checks.one_of(name, "method", method, sorted(METHODS))
    permutations = checks.whole_number(name, "permutations", permutations, 2)
    key = jax.random.key(0) if key is None else key
    checks.check_random_key(name, key)
    g = episode_point.failing_point(name, sim, episode)
    quiet = g.evaluate(np.zeros((1, len(g.v)))).distance[0]
    if not np.isfinite(quiet):
        raise checks.wrong(name, "sim", "have a finite miss distance when it is undisturbed", quiet)
    total = float(quiet - g.outcome.distance[0])
    error, cost = np.zeros(len(g.v)), 0
    if method == "shapley":
        permutations = _affordable(g, permutations, budget)
        total_runs = g.evaluate.spent + 2 * -(-permutations // 2) * np.count_nonzero(g.v)
        with Watch(name, total_runs, "sim", progress, None) as g.evaluate.watch:
            values, error = _shapley(g, float(quiet), key, permutations)
    elif method == "integrated":
        values, cost = _integrated(g), 4 * POINTS
    else:
        values, cost = _gradient(g), 4
    x0, shaped = episode_point.like_disturbances(g.sim, values)
    steps, called = episode_point.number_steps(g.sim), episode_point.number_names(g.sim)
    live = np.flatnonzero(g.v)
    parts = [(int(steps[i]), called[i], float(values[i]), float(error[i])) for i in live]
    parts.sort(key=lambda part: -abs(part[2]))
    residual = np.nan if method == "gradient" else total - float(values.sum())
    return Attribution(
        values=shaped,
        start=x0,
        error=episode_point.like_disturbances(g.sim, error)[1],
        total=total,
        method=method,
        parts=tuple(parts),
        residual=residual,
        evaluations=g.evaluate.spent + cost,
    )


def _affordable(g: EpisodePoint, permutations: int, budget: int | None) -> int:
    """So many orders, at most as the ``budget`` affords. ValueError where that is not two."""
    if budget is None and runs_on_host(g.sim):
        budget = HOSTED_BUDGET
    if budget is None:
        return permutations
    budget = checks.whole_number("attribution", "budget", budget, 1)
    each, spent = max(np.count_nonzero(g.v), 1), g.evaluate.spent + 1  # one run is made twice
    affordable = (budget - spent) // each // 2 * 2
    if affordable < 2:
        must = f"be at least {2 * each + spent}, two orders of {each} numbers"
        raise checks.wrong("attribution", "budget", must, budget)
    return min(permutations, affordable)


def _shapley(g: EpisodePoint, quiet: float, key: jax.Array, permutations: int):
    """Means and standard errors [D], by pairs of orders."""
    live, rng = np.flatnonzero(g.v), numpy_generator(key)
    d, pairs = len(live), -(-permutations // 2)
    seen = np.zeros((pairs, len(g.v)))
    if not d:
        return seen[0], seen[0]
    for i in range(pairs):
        order = rng.permutation(live)
        for one in (order, order[::-1]):
            # row k has the first k + 1 disturbances of the order
            points = np.zeros((d, len(g.v)))
            points[:, one] = np.tril(np.ones((d, d))) * g.v[one]
            along = np.concatenate([[quiet], _checked_finite(g.evaluate(points).distance)])
            seen[i, one] -= np.diff(along) / 2
    error = seen.std(axis=0, ddof=1) / np.sqrt(pairs) if pairs > 1 else np.full(len(g.v), np.nan)
    return seen.mean(axis=0), error


def _integrated(g: EpisodePoint) -> np.ndarray:
    """By the midpoint rule on the way from 0 to the episode."""
    shares = (np.arange(POINTS) + 0.5) / POINTS
    slopes = _gradients(g, shares[:, None] * g.v)
    return -slopes.mean(axis=0) * g.v


def _gradient(g: EpisodePoint) -> np.ndarray:
    """Just outside of the failures, where the distance is not yet flat."""
    shares = 1 - np.geomspace(1e-5, 1, 2 * POINTS)
    outside = shares[~g.evaluate(shares[:, None] * g.v).failure]
    if not len(outside):
        raise ValueError(
            'attribution: method="gradient" needs a point outside of the failures on the line'
            ' from the mode to the episode, and there is none; expected method="shapley" here'
        )
    slopes = _gradients(g, outside.max() * g.v[None])[0]
    return -slopes * np.sign(g.v)


def _gradients(g: EpisodePoint, points: np.ndarray) -> np.ndarray:
    slopes = gradients(g.sim, points).slope.astype(np.float64)
    if not np.isfinite(slopes).all() or not slopes.any():
        raise ValueError(
            "attribution: the miss distance has no finite gradient, or one of 0; expected"
            ' method="shapley", which needs none'
        )
    return slopes


def _checked_finite(distance: np.ndarray) -> np.ndarray:
    if not np.isfinite(distance).all():
        raise ValueError(
            "attribution: the miss distance is not finite where only some of the disturbances"
            " act; expected a finite one"
        )
    return distance.astype(np.float64)
