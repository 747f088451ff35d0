"""Multistart descent by gradients through the simulator to the boundary of failure, and along it to
the likeliest failures (`normal_space.design_point_descent`, `jast.search.refine`).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.episode import Episode, play_back
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, PathLike, PRNGKey
from jast._src.normal_space.design_point_descent import EPISODES, STEPS, descents
from jast._src.normal_space.transform import check, dimension, normal_numbers, played, side_by_side
from jast._src.runtime._jax import jit
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.best_episodes import standard_reward
from jast._src.search.driver import Log, finish, require_counts, require_host, run
from jast._src.search.lanes import NEVER, Tally, blank_episodes
from jast._src.search.refine.final import with_refine_share
from jast._src.search.refine.refine import GRADIENT, first_failing_lift, lift
from jast._src.search.result import SearchResult
from jast._src.util.display import call_settings
from jast._src.util.pytrees import index_tree

__all__ = ["gradient"]

SHARE = 2.0  # of the evaluations, for the refinement: descents end anywhere on the boundary
EVALUATIONS = STEPS * GRADIENT + EPISODES  # of one descent


def gradient(
    key: PRNGKey,
    sim: Simulator,
    *,
    starts: int = 48,
    refine: float | None = None,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> SearchResult:
    """Follow the gradient of the miss distance to failures, and make them as likely as they get.

    From each of ``starts`` draws of the model, twelve steps to the nearest point of the linearised
    boundary of failure, in the normal numbers of the disturbances; then `jast.search.refine`. It
    needs few evaluations where the distance is smooth, and finds nothing where it is flat.

    Args:
        key: consumed.
        sim: the simulator, written in JAX; its disturbances have quantile functions.
        starts: draws of the model to go from.
        refine: evaluations of the refinement, as a share of those of the descents; 0 for none.
            Default: 2.
        top: distinct failures kept.
        progress: show a bar.
        callback: called as ``callback(done, total, None)``, in evaluations, after the descents.
        checkpoint: a folder that keeps what the descents and the refinement came to. The same call
            then goes on where it was stopped, to the same result.

    Returns:
        `SearchResult`: the ends of the descents, and what came of them (``refined``). Its reward is
        that of `jast.rewards.standard` with the density relative to the mode (raw, where there is
        none). ``episodes`` and ``steps`` are evaluations of the descents, one with its gradient
        counted as 4. ``settings["useful_gradients"]`` is the share of the gradients that were
        finite and not 0: where that is 0 the distance has none, and no failure is found but by the
        draws themselves.

    Raises:
        ValueError: for a count below 1, a negative ``refine``, a system that runs on the host,
            disturbances without a quantile function, a simulator whose functions do not fit
            together, and inside of a transformation of JAX.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.gradient(jax.random.key(0), sim, starts=4, refine=0)
        >>> bool(result.best.failure)
        True
    """
    name = "gradient"
    starts, top = require_counts(name, starts=starts, top=top)
    require_host(name, key, sim)
    if runs_on_host(sim):
        raise ValueError(
            f"{name}: sim runs on the host and has no gradients; jast.search.go_explore and"
            " jast.search.chain need none"
        )
    check(name, sim)
    settings = with_refine_share(name, refine, sim, call_settings(name, key, starts=starts), SHARE)
    search = _Search(key, sim, starts, top)
    watched = dict(progress=progress, callback=callback, checkpoint=checkpoint)
    return run(key, search, [starts * EVALUATIONS], settings, **watched)


class State(NamedTuple):
    """What the descents came to."""

    failing: Episode
    """[m] the failing episodes at their ends."""
    nearest: Episode
    """[1] that of the least distance."""
    useful: float
    """Share of the gradients that were finite and not 0."""


class _Search:
    """A `search.driver.Search` of one step."""

    def __init__(self, key: jax.Array, sim: Simulator, starts: int, top: int):
        self.sim, self.reward, self.top = sim, standard_reward(sim), top
        self.draw, _ = jax.random.split(key)
        self.starts = starts

    def init(self) -> State:
        return State(blank_episodes(self.sim, 0), blank_episodes(self.sim, 1), 0.0)

    def step(self, state: State, begin: int, end: int) -> tuple[State, Tally, np.ndarray, None]:
        """The descents."""
        sim, n = self.sim, self.starts
        z = jax.random.normal(self.draw, (n, dimension(sim)), normal_numbers(sim))
        d = descents(sim, np.asarray(z))
        failing = self._failing(d.point[np.isfinite(d.point).all(axis=1) & d.found])
        nearest = self._scored(played(sim, d.nearest[[np.argmin(d.distance)]]))
        first = int(d.first.min())
        # side by side, the gradients of a step before its other episodes
        order = first * (GRADIENT * n + n * (EPISODES // STEPS)) + GRADIENT * n
        failures = int(d.failing.sum())
        tally = Tally(
            episodes=end,
            steps=GRADIENT * int(d.slopes.sum()) + int(d.steps.sum()),
            failures=failures,
            invalid=int(d.invalid.sum()),
            first=order + int(np.argmin(d.first)) + 1 if first < STEPS else NEVER,
            failing=np.array([failures > 0]),
        )
        best = failing.reward.max() if len(failing.length) else nearest.reward[0]
        useful = float(d.useful.sum()) / (n * STEPS)
        return State(failing, nearest, useful), tally, np.array([best]), None

    def _failing(self, z: np.ndarray) -> Episode:
        """The failing episodes of the points ``z`` [n, D], lifted as little as makes them fail."""
        sim = self.sim
        if len(z):
            e = played(sim, lift(z).reshape(-1, dimension(sim)))
            _, rows = first_failing_lift(e.failure, len(z))
            if len(rows):
                return self._scored(index_tree(e, rows))
        return jax.device_get(blank_episodes(sim, 0))

    def _scored(self, e: Episode) -> Episode:
        """The episodes with the reward of the search."""
        return side_by_side(self.sim, partial(_scored, self.sim, self.reward), e)

    def result(self, state: State, log: Log, settings: dict[str, Any]) -> SearchResult:
        failing, n = state.failing, len(state.failing.length)
        nearest = index_tree(state.nearest, 0)
        settings = settings | dict(useful_gradients=round(float(state.useful), 4))
        return finish(self, log, nearest, failing, np.arange(n), settings=settings)


@jit
def _scored(sim: Simulator, reward: Any, e: Episode) -> Episode:
    def score(x0, x, length):
        return play_back(sim, reward, x0, x, length)._replace(states=None)

    return jax.vmap(score)(e.x0, e.disturbances, e.length)
