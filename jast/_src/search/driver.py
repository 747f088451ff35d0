"""The driver of a search on the host, once for all searches: progress, callback, interruption,
checkpoint, counts, history, archive of failures, refinement.

A search is an object with three methods (`Search`): ``init``, ``step`` and ``result``. `run` does
the rest. Searches whose work is made of independent units (`jast.search.monte_carlo`, trees) run
those by `runtime.work` and end by `complete` too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core import failures as archive
from jast._src.core.episode import Episode, replay
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, PathLike, Reward
from jast._src.runtime._jax import is_traced, is_tracing
from jast._src.runtime.checkpoints import keep_answers, open_checkpoint, step_once
from jast._src.runtime.host_errors import (
    Incident,
    incidents,
    merge_incidents,
    new_incidents,
    runs_on_host,
)
from jast._src.runtime.jax_settings import run_in_thread
from jast._src.runtime.progress_bar import Watch, in_pieces
from jast._src.search.calibration import Calibration, with_calibration
from jast._src.search.lanes import NEVER, Tally
from jast._src.search.refine.final import refine_failures
from jast._src.search.result import History, SearchResult, Trials
from jast._src.util import checks
from jast._src.util.pytrees import join_rows

__all__ = [
    "Log",
    "Noted",
    "complete",
    "finish",
    "finish_traced",
    "require_counts",
    "require_host",
    "run",
]

State = TypeVar("State")


class Search(Protocol[State]):
    """A search as the driver takes it: what does not change while it runs, and three methods."""

    sim: Simulator
    reward: Reward
    top: int
    """Distinct failures that the result keeps."""

    def init(self) -> State:
        """The first state: a pytree whose structure stays."""
        ...

    def step(self, state: State, begin: int, end: int) -> tuple[State, Tally, Any, Trials | None]:
        """Simulate the episodes ``begin`` .. ``end - 1`` of each tree: the next state, their
        counts, the best rewards so far [trees], and their numbers where these are recorded.
        """
        ...

    def result(self, state: State, log: Log, settings: dict[str, Any]) -> SearchResult:
        """The `SearchResult` of a state (by `finish`)."""
        ...


class Log(NamedTuple):
    """What the host knows of a search: exact counts, as Python ints."""

    tally: Tally
    history: History
    interrupted: str | None
    trials: Trials | None


class Noted(NamedTuple):
    """What is known of the first steps of a search."""

    tally: Tally | None = None
    moments: tuple[tuple, ...] = ()
    """Of each step: (its end, the best rewards so far, failures so far, trials or None)."""

    def step(self, end: int, tally: Tally, best: np.ndarray, trials: Trials | None) -> Noted:
        """These and one step more, which ends at ``end``."""
        tally = Tally(*(int(v) for v in tally[:5]), tally.failing)  # which do not overflow
        if self.tally is not None:
            tally = self.tally.add(tally)
        return Noted(tally, (*self.moments, (end, best, tally.failures, trials)))

    def words(self) -> dict[str, Any]:
        """What the bar says of them."""
        return dict(failures=self.tally.failures, best=f"{self.moments[-1][1].max():.4g}")

    def log(self, interrupted: str | None = None) -> Log:
        """The `Log` of them."""
        *moments, trials = zip(*self.moments, strict=True)
        trials = None if trials[0] is None else join_rows(*trials)
        return Log(self.tally, History(*(np.array(v) for v in moments)), interrupted, trials)


def run(
    key: jax.Array,
    search: Search,
    ends: Sequence[int],
    settings: dict[str, Any],
    *,
    trees: int = 1,
    record: bool = False,
    stop_at_failure: bool = False,
    calibration: Calibration | None = None,
    before: Any = None,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    **about: Any,
) -> SearchResult:
    """Run a search from its first step to its refined result.

    Args:
        key: the user's.
        search: what is run.
        ends: rising numbers of episodes of each tree; a step leads to each.
        settings: of the result; ``method`` is the search's name.
        trees: independent searches, side by side.
        record: whether steps return `Trials`.
        stop_at_failure: end with the step that has the first failure.
        calibration: the episodes that gave the scales.
        before: `jast.incidents.incidents` before those; None: as they are now.
        progress: whether there is a bar.
        callback: called as ``callback(done, total, None)`` after each step, in episodes of all
            trees.
        checkpoint: a folder that keeps what each step returned, or None.
        **about: what the result depends on beside ``settings``, for the checkpoint.

    Returns:
        `SearchResult`. A KeyboardInterrupt ends the search after the last whole step, and is raised
        again where there is none.
    """
    name, sim = settings["method"], search.sim
    before = incidents(sim) if before is None else before
    host, total, failures = runs_on_host(sim), ends[-1] * trees, 0

    def piece(carry, begin, end):
        nonlocal failures
        state, noted = carry

        def step():
            return jax.block_until_ready(search.step(state, begin, end))

        def structure():
            trials = Trials(*range(len(Trials._fields))) if record else None
            return state, Tally(*range(len(Tally._fields))), 0, trials

        made = (lambda: run_in_thread(step)) if host else step
        state, *news = step_once(made, state, like=structure)
        noted = noted.step(end, *jax.device_get(news))
        failures = noted.tally.failures
        return state, noted

    def ends_left():
        for end in ends:
            if not (stop_at_failure and failures):
                yield end

    watch = Watch(name, total, "sim", progress, callback)
    about |= dict(sim=sim, top=search.top, settings=settings, record=record)
    with open_checkpoint(name, checkpoint, key, **about) as store, keep_answers(store):
        (state, noted), done = in_pieces(
            piece,
            (search.init(), Noted()),
            ends_left(),
            watch,
            lambda end: end * trees,
            lambda carry: carry[1].words(),
        )
        short = done < ends[-1] and not (stop_at_failure and failures)
        interrupted = f"after {done * trees} of {total} episodes" if short else None
        found = search.result(state, noted.log(interrupted), settings)
        return complete(key, search, found, before, calibration)


def complete(
    key: jax.Array,
    search: Any,
    found: SearchResult,
    before: Any,
    calibration: Calibration | None = None,
    elsewhere: tuple[Incident, ...] = (),
) -> SearchResult:
    """``found`` by ``search`` (its ``sim``, ``reward``, ``top``) with the episodes of the
    calibration, its failures refined, and the incidents since ``before`` here and ``elsewhere``.
    """
    sim, reward, top = search.sim, search.reward, search.top
    found = with_calibration(sim, reward, calibration, found, top)
    found = refine_failures(key, sim, reward, found, top)
    here = new_incidents(before, incidents(sim))
    return found._replace(incidents=merge_incidents(here, elsewhere))


def require_counts(function: str, **counts: Any) -> list[int]:
    """The counts as Python ints; ValueError naming the setting unless each is a whole number from 1
    to 2^31 - 1.
    """
    return [checks.whole_number(function, *c, bits=31) for c in counts.items()]


def require_host(function: str, key: jax.Array, sim: Simulator) -> None:
    """ValueError inside of a transformation of JAX, and for what is no key."""
    checks.check_random_key(function, key)
    if is_traced(key, sim) or is_tracing():
        raise ValueError(f"{function}: cannot be traced; call it outside of jax.jit and jax.vmap")


def finish(
    search: Any,
    log: Log,
    best: Episode,
    candidates: Episode,
    numbers: np.ndarray,
    *,
    counts: np.ndarray | None = None,
    settings: dict[str, Any],
    trees: np.ndarray | None = None,
) -> SearchResult:
    """The `SearchResult` on the host. All episodes are replayed, and what is said of them is what
    the replay says.

    Args:
        search: has ``sim``, ``reward`` and ``top``.
        log: what was noted.
        best: the best episode that was simulated.
        candidates: distinct episodes [m] that failed.
        numbers: [m] the simulation at which each was first found.
        counts: [m] how often it was, repetitions too; None: as the candidates say.
        settings: what was asked for.
        trees: [m] the tree that found it; None: there is one tree.
    """
    sim, reward = search.sim, search.reward
    trees = np.zeros(len(numbers), int) if trees is None else trees
    # so that one that no longer fails is counted as dropped
    best, candidates = jax.device_get((best, candidates))
    candidates = candidates._replace(failure=np.ones(len(numbers), bool))
    tally = log.tally
    found = archive.collect(sim, reward, candidates, trees, numbers, tally.failures, search.top)
    if counts is not None:
        times = dict(zip(zip(trees.tolist(), numbers.tolist()), counts, strict=True))
        where = zip(found.tree.tolist(), found.simulation.tolist())
        found = found._replace(counts=np.array([times[each] for each in where], np.int32))
    # of equal ones the first that was simulated, as inside of a transformation
    if found.size and not (best.failure and best.reward >= found.best.reward):
        best = found.best
    best = jax.device_get(replay(sim, best, reward=reward))
    return SearchResult(
        best=best,
        best_reward_per_tree=log.history.best_reward[-1],
        failures=found,
        episodes=tally.episodes,
        steps=tally.steps,
        first_failure=None if tally.first == NEVER else tally.first,
        failing_share=tally.failures / tally.episodes,
        failing_per_tree=tally.failing,
        failing=tally.failures,
        history=log.history,
        invalid=tally.invalid,
        settings=settings | ({"interrupted": log.interrupted} if log.interrupted else {}),
        trials=log.trials,
    )


def finish_traced(
    sim: Simulator, reward: Any, tally: Tally, best: Episode, best_reward: jax.Array
) -> SearchResult:
    """The `SearchResult` inside a transformation: no archive and no history."""
    real = best_reward.dtype
    return SearchResult(
        best=replay(sim, best, reward=reward),
        best_reward_per_tree=best_reward,
        failures=None,
        episodes=tally.episodes,
        steps=tally.steps,
        first_failure=jnp.where(tally.first == NEVER, -1, tally.first),
        failing_share=tally.failures.astype(real) / tally.episodes.astype(real),
        failing_per_tree=tally.failing,
        failing=tally.failures,
        history=None,
        invalid=tally.invalid,
        settings=None,
    )
