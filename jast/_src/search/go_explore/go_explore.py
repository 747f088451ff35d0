"""Go-Explore: keep states, return to them, explore from there; then make the failures likelier from
their ends backwards.

First return, then explore (Ecoffet et al. 2021); for adaptive stress testing, with the backward
algorithm as its second phase, Koren and Kochenderfer 2020. In place of a learned policy the second
phase has a search: from each state of the known failing episode, the later ones first, likelier
ways to a failure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.contract import contract
from jast._src.core.counter_prng import tree_keys
from jast._src.core.episode import Episode
from jast._src.core.rewards import as_pytree
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, require_simulator
from jast._src.core.typing import Callback, PathLike, PRNGKey, Reward
from jast._src.runtime import memory
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.best_episodes import BestEpisodes, standard_reward
from jast._src.search.driver import Log, require_counts, require_host, run
from jast._src.search.go_explore.archive import Cells, empty_cells, features
from jast._src.search.go_explore.phases import Plan, explore, improve_backward
from jast._src.search.lanes import Tally, blank_episodes
from jast._src.search.refine.final import SHARE, with_refine_share
from jast._src.search.result import SearchResult
from jast._src.util import checks
from jast._src.util.display import call_settings
from jast._src.util.pytrees import index_tree

__all__ = ["go_explore"]

LANES = 256  # runs side by side
HOSTED_LANES = 64  # those of a system on the host, watched and interrupted between two rounds
SLOTS = 4096  # states that are kept at most
TRACES = 4  # failures that are made likelier side by side
BACK = 0.6  # share of that work before it is at the start
MOMENTS = 100  # of the history, about


class State(NamedTuple):
    """A search so far."""

    cells: Cells
    best: BestEpisodes
    traces: Episode
    """The failures that are made likelier, [P] in front."""
    since: int
    """The run from which on they are; -1 before it, when ``traces`` mean nothing."""


def go_explore(
    key: PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 100_000,
    length: int | None = None,
    cell: Callable[..., Any] | None = None,
    backward: float = 0.5,
    refine: float | None = None,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> SearchResult:
    """Find failures that need many things to go wrong one after another: for long horizons, and for
    systems that do not say how near a failure is.

    States are kept, with the disturbances that led there, the likeliest way to each cell. Runs go
    on from them: half of the runs from the states that are nearest to failure, the others from
    those least gone on from, a few from the start. They draw from the model and, where it has
    quantile functions, from wider and persisting noise. The best failures are then made likelier:
    runs go on from states of the failing episode, first the last ones, later from its start, and
    change some of its disturbances; whatever still fails and is likelier takes its place.

    Args:
        key: consumed.
        sim: the simulator. Its state has to be all that decides what happens next, as always.
        episodes: runs; one from a kept state costs only its new steps (``result.steps`` counts
            those), so compare with other searches at equal steps.
        length: the most steps of a run that explores; default: an eighth of the horizon.
        cell: ``state -> array or pytree of arrays``, preferably whole numbers: states of equal
            value are of one cell. Default: by the step, the rank of the miss distance and two
            random projections of ``observe``.
        backward: share of the runs, from 0 to below 1, that make known failures likelier.
        refine: evaluations of `jast.search.refine` at the end, on top of the episodes, as a share
            of these; 0 for none. Default: 0.1.
        top: distinct failures kept.
        progress: show a bar.
        callback: called as ``callback(done, total, None)``, in runs.
        checkpoint: a folder that keeps what the search came to now and then. The same call then
            goes on where it was stopped, to the same result.

    Returns:
        `SearchResult`. ``best`` is the likeliest failure, or the episode that came nearest; its
        reward is that of `jast.rewards.standard` with the density relative to the mode (raw, where
        there is none). ``simulation`` of a failure is the number of the run that ended in it.
        KeyboardInterrupt ends the search with what it has.

    Raises:
        ValueError: for a count below 1, ``backward`` or ``refine`` outside its range, a ``refine``
            above 0 without quantile functions, a ``cell`` that is no function, a simulator whose
            functions do not fit together, and inside of a transformation of JAX.

    A system whose miss distance means something only at its end (``episodic``) has no nearest
    states; there cells are told by the step and what is observed.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.go_explore(jax.random.key(0), sim, episodes=2000, refine=0)
        >>> bool(result.best.failure)
        True
    """
    name = "go_explore"
    require_simulator(name, sim)
    episodes, top = require_counts(name, episodes=episodes, top=top)
    if length is None:
        length = max(1, -(-sim.horizon // 8))
    length = min(checks.whole_number(name, "length", length), sim.horizon)
    expected = "from 0 to below 1"
    backward = checks.number(name, "backward", backward, lambda v: 0 <= v < 1, expected)
    if cell is not None and not callable(cell):
        raise ValueError(f"{name}: cell must be a function of a state, received {cell!r}"[:200])
    require_host(name, key, sim)
    contract(name, sim)
    given = dict(episodes=episodes, length=length, backward=backward)
    settings = with_refine_share(name, refine, sim, call_settings(name, key, **given), SHARE)
    most = HOSTED_LANES if runs_on_host(sim) else LANES
    lanes = max(8, min(most, 1 << (episodes // 16).bit_length()))
    slots = min(SLOTS, max(64, 4 * episodes))
    # twice: with those that enter
    needed = 2 * memory.size(jax.eval_shape(partial(empty_cells, sim, slots)))
    memory.require(name, needed, f"{slots} states and the ways there", "use a smaller state")
    stretch = lanes if runs_on_host(sim) else lanes * max(1, episodes // (lanes * MOMENTS))
    search = _Search(
        sim=sim,
        reward=standard_reward(sim),
        top=top,
        key=tree_keys(key, 1)[0],
        cell=None if cell is None else _cell(name, sim, cell),
        plan=Plan(lanes, length, min(TRACES, lanes // 8)),
        slots=slots,
        episodes=episodes,
        until=int(episodes * (1 - backward)),
    )
    ends = [*range(stretch, episodes, stretch), episodes]
    watched = dict(progress=progress, callback=callback, checkpoint=checkpoint)
    return run(key, search, ends, settings, **watched, cell=cell)


def _cell(name, sim, cell):
    """``cell`` as what `jax.jit` takes; ValueError where it does not work."""
    try:
        told = jax.eval_shape(cell, signature_of(sim).state)
    except Exception as error:
        said = f"{name}: cell raised {type(error).__name__} on a state: {error}"
        raise ValueError(said) from error
    if not jax.tree.leaves(told):
        raise ValueError(f"{name}: cell must return numbers, received {told!r}")
    return as_pytree(cell)


@dataclass(frozen=True)
class _Search:
    """A `search.driver.Search`."""

    sim: Simulator
    reward: Reward
    top: int
    key: jax.Array
    cell: Callable | None
    plan: Plan
    slots: int
    episodes: int
    until: int
    """Runs that explore, at least."""

    def init(self) -> State:
        sim, n = self.sim, self.plan.traces
        mark = jax.eval_shape(partial(features, sim), signature_of(sim).state)
        best = BestEpisodes.none(sim, max(self.top, 64), mark)
        return State(empty_cells(sim, self.slots), best, blank_episodes(sim, n), -1)

    def step(self, state: State, begin: int, end: int) -> tuple[State, Tally, jax.Array, None]:
        """Explore, or, where a failure is known and it is time for that, make failures likelier."""
        cells, best, traces, since = state
        common, ends = (self.key, self.sim, self.reward), (np.int32(begin), np.int32(end))
        if since < 0 and begin >= self.until and np.asarray(best.episode.failure)[0]:
            traces, since = self.first_traces(best), begin
        if since < 0:
            (cells, best), tally = explore(*common, self.cell, self.plan, cells, best, *ends)
        else:
            whole = max(1.0, BACK * (self.episodes - since))
            schedule = np.array([since, whole], best.value.dtype)
            (best, traces), tally = improve_backward(
                *common, self.plan, best, traces, *ends, *schedule
            )
        return State(cells, best, traces, since), tally, best.reward(), None

    def first_traces(self, best: BestEpisodes) -> Episode:
        """The likeliest failure, then by turns the one that ends least like those and the next
        likeliest.
        """
        e, value, mark = jax.device_get((best.episode, best.value, best.mark))
        n = int((e.failure & (value > -np.inf)).sum())
        mark = (mark[:n] - mark[:n].mean(axis=0)) / np.maximum(mark[:n].std(axis=0), 1e-6)
        rows, left = [0], list(range(1, n))
        while left and len(rows) < self.plan.traces:
            far = np.abs(mark[left][:, None] - mark[rows][None]).sum(axis=2).min(axis=1)
            rows.append(left.pop(int(np.argmax(far)) if len(rows) % 2 else 0))
        return index_tree(e, np.resize(rows, self.plan.traces))

    def result(self, state: State, log: Log, settings: dict[str, Any]) -> SearchResult:
        return state.best.result(self, log, settings)
