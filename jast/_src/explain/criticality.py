"""criticality: how probable a failure was at each moment of the episode that ended in it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.core.episode import Episode, play_chosen, replay
from jast._src.core.rewards import log_likelihood
from jast._src.core.simulator import Simulator, require_simulator
from jast._src.core.typing import PRNGKey
from jast._src.runtime.host_errors import runs_on_host, showing_runs
from jast._src.runtime.progress_bar import Watch
from jast._src.util import checks, display
from jast._src.util.intervals import checked_level, clopper_pearson
from jast._src.util.pytrees import map_in_lanes, select

__all__ = ["Criticality", "criticality"]

LANES = 512  # episodes that are played at a time
DRAWS = 1000  # continuations of each state by default
HOSTED_BUDGET = 1000  # episodes of a black box by default
MOST_LANES = 4096  # the same where no episode may be played in vain
CERTAIN = 0.95  # a probability from which on a failure counts as certain


@display.result_class("evaluations")
class Criticality(NamedTuple):
    """The probability of failing from each state of an episode, [length + 1] rows.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> failure = jast.replay(sim, jnp.full(6, 2.0))
        >>> found = jast.explain.criticality(jax.random.key(0), sim, failure, draws=100)
        >>> 0 < found.last_below_half < found.point_of_no_return <= 5
        True
    """

    probability: np.ndarray
    """Of failing later on, disturbed as the model says; row t is of the state after t steps."""
    interval: np.ndarray
    """[length + 1, 2]: exact (Clopper and Pearson 1934), at ``level``."""
    level: float
    last_below_half: int | None
    """The last step after which the probability is below one half; None where it never is."""
    point_of_no_return: int
    """The first step from which on it stays at .95 or more."""
    steepest: int
    """The step that raised it most, from 1 on; 0 where no step was taken."""
    draws: int
    """Continuations of each state."""
    invalid: int
    evaluations: int
    """Episodes simulated."""

    def __str__(self) -> str:
        p, n = self.probability, len(self.probability) - 1
        lines = []
        if self.steepest:
            a, b = p[self.steepest - 1], p[self.steepest]
            lines.append(f"step {self.steepest} raised it most: from {a:.3g} to {b:.3g}")
        half = self.last_below_half
        lines.append(
            "failure was the likelier outcome from the start"
            if half is None
            else f"after step {half} a failure was still the less likely outcome"
        )
        lines.append(f"it stays at {CERTAIN} or more from step {self.point_of_no_return} on")
        shown = np.unique(np.linspace(0, n, min(n, 9) + 1).round().astype(int))
        lines.append(f"{'after step':>10} {'P(failure)':>11}   {self.level:.0%} interval")
        for t in shown:
            low, high = self.interval[t]
            lines.append(f"{t:10d} {p[t]:11.4g}   [{low:.4g}, {high:.4g}]")
        return "\n".join(lines)


def criticality(
    key: PRNGKey,
    sim: Simulator,
    episode: Episode,
    *,
    draws: int | None = None,
    level: float = 0.95,
    budget: int | None = None,
    progress: bool = False,
) -> Criticality:
    """When was the failure still avoidable?

    From every state of the episode ``draws`` continuations are simulated, with disturbances of the
    model. How many of them fail is the probability of failing from there.

    Args:
        key: consumed.
        sim: the simulator, of any kind.
        episode: a failure, or any other episode.
        draws: continuations of each state, at least 1: the standard error is at most
            0.5 / sqrt(draws). In all ``(length + 1) * draws`` episodes, nearly. Default: 1000, or
            as many as the ``budget`` affords.
        level: of the intervals, each for itself.
        budget: evaluations at most, all of them counted. Default: none; 1000 of a black box where
            ``draws`` is left out.
        progress: whether there is a bar.

    Returns:
        `Criticality`.

    Raises:
        ValueError: for bad arguments, where ``episode`` does not fit the simulator, and for a
            budget that does not do for the ``draws``, or for one of each state.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> failure = jast.replay(sim, jnp.full(6, 2.0))
        >>> found = jast.explain.criticality(jax.random.key(0), sim, failure, draws=100)
        >>> bool(found.probability[-1] == 1.0)
        True
    """
    name = "criticality"
    checks.check_random_key(name, key)
    level = checked_level(name, level)
    require_simulator(name, sim)
    hosted = runs_on_host(sim)
    if draws is not None:
        draws = checks.whole_number(name, "draws", draws, 1)
    if budget is not None:
        budget = checks.whole_number(name, "budget", budget, 1)
    elif hosted and draws is None:
        budget = HOSTED_BUDGET
    try:
        episode = replay(sim, episode)
    except ValueError as error:
        raise ValueError(f"{name}: episode cannot be played again: {error}") from error
    steps = int(episode.length)
    draws = _affordable_draws(budget, draws, steps)
    rows = np.repeat(np.arange(steps + 1, dtype=np.int32), draws)
    given = jax.tree.map(jnp.asarray, (episode.x0, episode.disturbances))

    size = LANES
    if hosted or budget is not None:  # hardly an episode more than was asked for
        size = -(-len(rows) // -(-len(rows) // MOST_LANES))

    def lanes(at, kept):
        keys = jax.random.split(jax.random.fold_in(key, at[0]), size)
        found = jax.block_until_ready(_continued(keys, sim, *given, kept))
        watch.reach(min(int(at[0]) + size, len(rows)))
        return found

    at = np.arange(len(rows), dtype=np.int32)
    with Watch(name, len(rows), "sim", progress, None) as watch, showing_runs(sim, watch):
        ended, wrong = map_in_lanes(size, lanes, at, rows)
    failing, invalid = np.bincount(rows[ended], minlength=steps + 1), int(wrong.sum())
    p = failing / draws
    interval = np.stack([clopper_pearson(int(k), draws, level) for k in failing])
    below, sure = np.flatnonzero(p < 0.5), np.flatnonzero(p < CERTAIN)
    return Criticality(
        probability=p,
        interval=interval,
        level=level,
        last_below_half=int(below[-1]) if len(below) else None,
        point_of_no_return=int(sure[-1]) + 1 if len(sure) else 0,
        steepest=int(np.argmax(np.diff(p))) + 1 if steps else 0,
        draws=draws,
        invalid=invalid,
        evaluations=-(-len(rows) // size) * size,
    )


def _affordable_draws(budget: int | None, draws: int | None, steps: int) -> int:
    """Continuations of each of ``steps + 1`` states. ValueError where the budget is too small."""
    if budget is None:
        return DRAWS if draws is None else draws
    states, least = steps + 1, 1 if draws is None else draws
    # the last program may play some more, the episode is replayed, and one run is made twice
    last = -(-budget // MOST_LANES) + 2
    affordable = min((budget - last) // states, DRAWS)
    if affordable < least:
        must = f"be at least {states * least + last}, {least} continuations of {states} states"
        raise checks.wrong("criticality", "budget", must, budget)
    return affordable if draws is None else draws


@jax.jit
def _continued(keys: Any, sim: Simulator, x0: Any, disturbances: Any, kept: Any) -> Any:
    """Whether episodes [n] fail, or are invalid, of which the first ``kept`` [n] disturbances are
    given.
    """

    def one(key, kept):
        def choose(state, t, x):
            own = D.sample(sim.disturbance(state), jax.random.fold_in(key, t))
            return select(t < kept, x, own)

        e = play_chosen(sim, log_likelihood, x0, choose, disturbances, sim.horizon)
        return e.failure, ~jnp.isfinite(e.reward)

    return jax.vmap(one)(keys, kept)
