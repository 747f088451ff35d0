"""Go-Explore: keep states, return to them, explore from there; then make the failures likelier from
their ends backwards.

First return, then explore (Ecoffet et al. 2021); for adaptive stress testing, with the backward
algorithm as its second phase, Koren and Kochenderfer 2020. In place of a learned policy the second
phase has a search: from each state of the known failing episode, the later ones first, likelier
ways to a failure.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jast import _checks, memory
from jast._jax import is_traced, is_tracing
from jast.contract import contract
from jast.counter import numpy_generator, tree_keys
from jast.incidents import incidents, new_incidents, runs_on_host
from jast.outline import outline
from jast.results import call_settings
from jast.rewards import as_pytree
from jast.search import cells as C
from jast.search import kept as K
from jast.search import lockstep as E
from jast.search import phases as P
from jast.search.ending import SHARE, ended, planned
from jast.search.result import SearchResult
from jast.simulator import Simulator, require_simulator

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback

__all__ = ["go_explore"]

LANES, HOSTED, SLOTS, TRACES = 256, 64, 4096, 4
"""Runs side by side; of a system on the host; states kept; failures that are made likelier side by
side.
"""
BACK = 0.6
"""Share of that work before it is at the start."""
MOMENTS = 100


def go_explore(
    key: chex.PRNGKey,
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
    episodes, top = E.whole(name, episodes=episodes, top=top)
    length = (
        max(1, -(-sim.horizon // 8))
        if length is None
        else _checks.whole_number(name, "length", length)
    )
    expected = "from 0 to below 1"
    backward = _checks.number(name, "backward", backward, lambda v: 0 <= v < 1, expected)
    if cell is not None and not callable(cell):
        raise ValueError(f"{name}: cell must be a function of a state, received {cell!r}"[:200])
    _checks.check_random_key(name, key)
    if is_traced(key, sim) or is_tracing():
        raise ValueError(f"{name}: cannot be traced; call it outside of jax.jit and jax.vmap")
    contract(name, sim)
    cell = None if cell is None else _cell(name, sim, cell)
    numbers = dict(episodes=episodes, length=min(length, sim.horizon), backward=backward)
    settings = planned(name, refine, sim, call_settings(name, key, **numbers), SHARE)
    size = HOSTED if runs_on_host(sim) else LANES
    lanes = max(8, min(size, 1 << max(0, (episodes // 16).bit_length())))
    plan = P.Plan(lanes, min(length, sim.horizon), min(TRACES, lanes // 8))
    search = _Search(key, sim, cell, plan, episodes, int(episodes * (1 - backward)))
    before = incidents(sim)
    mark = jax.eval_shape(partial(C.features, sim), outline(sim).state)
    slots = min(SLOTS, max(64, 4 * episodes))
    needed = 2 * memory.size(jax.eval_shape(partial(C.empty, sim, slots)))  # and those that enter
    memory.require(name, needed, f"{slots} states and the ways there", "use a smaller state")
    carry = C.empty(sim, slots), K.none(sim, max(top, 64), mark), None, 0
    stretch = lanes if runs_on_host(sim) else lanes * max(1, episodes // (lanes * MOMENTS))
    ends = [*range(stretch, episodes, stretch), episodes]
    (_, kept, *_), log = E.drive(
        search.chunk,
        carry,
        ends,
        host=runs_on_host(sim),
        progress=progress,
        callback=callback,
        name=name,
    )
    found = K.result(sim, search.reward, log, kept, settings, top)
    found = ended(key, sim, search.reward, found, top)
    return found._replace(incidents=new_incidents(before, incidents(sim)))


def _cell(name, sim, cell):
    """``cell`` as what `jax.jit` takes; ValueError where it does not work."""
    try:
        told = jax.eval_shape(cell, outline(sim).state)
    except Exception as error:
        said = f"{name}: cell raised {type(error).__name__} on a state: {error}"
        raise ValueError(said) from error
    if not jax.tree.leaves(told):
        raise ValueError(f"{name}: cell must return numbers, received {told!r}")
    return as_pytree(cell)


class _Search:
    """What does not change while a search runs."""

    def __init__(self, key, sim, cell, plan, episodes, until):
        self.key, self.rng = tree_keys(key, 1)[0], numpy_generator(jax.random.fold_in(key, 1))
        self.sim, self.cell, self.plan, self.reward = sim, cell, plan, K.likelihood(sim)
        self.episodes, self.until = episodes, until

    def chunk(self, carry, begin, end):
        """Runs ``begin`` .. ``end - 1``: explore, or, where a failure is known and it is time for
        that, make failures likelier.
        """
        cells, kept, traces, since = carry
        ends = np.int32(begin), np.int32(end)
        if traces is None and begin >= self.until and np.asarray(kept.episode.failure)[0]:
            traces, since = self._traces(kept), begin
        if traces is None:
            (cells, kept), counted = P.explore(
                self.key, self.sim, self.reward, self.cell, self.plan, cells, kept, *ends
            )
        else:
            whole = max(1.0, BACK * (self.episodes - since))
            schedule = np.array([since, whole], kept.value.dtype)
            (kept, traces), counted = P.backward(
                self.key, self.sim, self.reward, self.plan, kept, traces, *ends, *schedule
            )
        return (cells, kept, traces, since), counted, K.best_of(kept), None

    def _traces(self, kept):
        """The likeliest failure, then by turns the one that ends least like those and the next
        likeliest.
        """
        e, value, mark = jax.device_get((kept.episode, kept.value, kept.mark))
        n = int((e.failure & (value > -np.inf)).sum())
        mark = (mark[:n] - mark[:n].mean(axis=0)) / np.maximum(mark[:n].std(axis=0), 1e-6)
        rows, left = [0], list(range(1, n))
        while left and len(rows) < self.plan.traces:
            far = np.abs(mark[left][:, None] - mark[rows][None]).sum(axis=2).min(axis=1)
            rows.append(left.pop(int(np.argmax(far)) if len(rows) % 2 else 0))
        rows = np.resize(rows, self.plan.traces)
        e = jax.tree.map(lambda a: a[rows], e)
        return P.Traces(e.x0, e.disturbances, e.length, e.reward)
