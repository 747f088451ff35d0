"""Random search: independent episodes and nothing learned from any. The baseline of every other
search.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core import actions as choices
from jast._src.core.counter_prng import tree_keys
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Actions, Callback, Executor, PathLike, PRNGKey, Reward
from jast._src.runtime import work
from jast._src.runtime._jax import jit, quick
from jast._src.runtime.backends import Task
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.host_errors import incidents, runs_on_host
from jast._src.runtime.memory import require
from jast._src.runtime.progress_bar import Watch
from jast._src.search.driver import Noted, complete, finish, finish_traced, require_counts
from jast._src.search.lanes import Tally, distinct_episodes, in_blocks, play_drawn, take_rows
from jast._src.search.refine.final import default_share, with_refine_share
from jast._src.search.result import SearchResult, Trials
from jast._src.search.setup import prepare
from jast._src.util.checks import wrong
from jast._src.util.pytrees import index_tree, map_in_lanes, select

__all__ = ["monte_carlo"]

LANES = 4096  # episodes that step together
HOSTED_LANES = 64  # those of a system on the host, watched and interrupted between two chunks
MOMENTS = 200  # of the history, about: a moment is at least a block of ``LANES`` episodes


class Top(NamedTuple):
    """The best distinct failures [k], by their numbers."""

    reward: jax.Array
    """Falling; -inf where there are fewer."""
    tag: jax.Array
    number: jax.Array
    count: jax.Array


class Found(NamedTuple):
    """The best so far: one episode of all, and the top failures."""

    failure: jax.Array
    reward: jax.Array
    number: jax.Array
    top: Top


SAMPLES = choices.samples()


def monte_carlo(
    key: PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 100_000,
    reward: Reward | None = None,
    actions: Actions = SAMPLES,
    refine: float | None = None,
    top: int = 64,
    record: bool = False,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> SearchResult:
    """What are the likeliest failures that chance alone finds? Simulate independent episodes and
    keep the best. With ``refine=0`` this is the baseline of searches; `jast.nominal` only counts,
    and `jast.estimate.monte_carlo` is the baseline of estimators.

    With ``actions.samples()`` or ``quantiles()`` the failing share is the failure probability, up
    to chance. A random start is drawn likewise (from its own distribution where actions are a box).
    Episode i depends on the key and on i alone, not on ``episodes``.

    KeyboardInterrupt ends the search with the result of the whole chunks, and
    ``settings["interrupted"]`` says so. Works under `jax.jit` and `jax.vmap`, without archive,
    history and callbacks.

    Args:
        key: consumed.
        sim: the simulator.
        episodes: how many; static, like ``top``.
        reward: what is maximised. Default: `jast.rewards.lexicographic`. Its scales come from 128
            plain episodes (10 of a black box), the same for every key, which are not among those of
            the result.
        actions: of `jast.actions`, which draw the disturbances.
        refine: as for `forest`, the share that pulls the failures to where they are likeliest.
        top: distinct failures kept.
        record: keep the numbers of every episode (``result.trials``); without it memory does not
            grow with ``episodes``.
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after every chunk. There are about 200
            of them; a black box has one every 64 episodes.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `SearchResult` of one tree.

    Raises:
        ValueError: for a count below 1, a ``refine`` that is not possible, and where the
            simulator's functions or the actions do not fit together.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.monte_carlo(jax.random.key(0), sim, episodes=1000, refine=0)
        >>> len(result.failures) > 0, bool(result.best.failure)
        (True, True)
    """
    name = "monte_carlo"
    episodes, top = require_counts(name, episodes=episodes, top=top)
    about = dict(sim=sim, reward=reward, actions=actions, episodes=episodes, record=bool(record))
    before = incidents(sim)
    # the episodes that scale the reward are the same for every key: no part of a random sample
    reward, actions, settings, _ = prepare(name, key, sim, reward, actions, episodes=episodes)
    settings = with_refine_share(name, refine, sim, settings, default_share(sim, reward))
    few = min(LANES, max(128, 1 << (episodes - 1).bit_length()))
    lanes = HOSTED_LANES if runs_on_host(sim) else few
    parts = tree_keys(key, 1)[0], sim, reward, actions
    if settings is None:
        work.require_untraced(name, checkpoint=checkpoint, executor=executor, devices=devices)
        if episodes * sim.horizon >= 2**31:
            must = "be below 2^31 inside a transformation"
            raise wrong(name, "episodes times the horizon", must, f"{episodes} x {sim.horizon}")
        found, tally = _chunk(*parts, _nothing(sim, 1), 0, episodes, lanes)
        best = index_tree(_rebuild(*parts, found.number[None]), 0)
        return finish_traced(sim, reward, tally, best, found.reward[None])

    if record:
        row = 3 * signature_of(sim).dtype.itemsize + 2  # three numbers and two bools
        records = f"the records of {episodes} episodes"
        require(name, 2 * episodes * row, records, "use fewer, or record=False")

    blocks = 1
    if not record and not runs_on_host(sim):
        most = (2**31 - 1) // (lanes * sim.horizon)  # the steps of a chunk are counted in int32
        blocks = max(1, min(-(-episodes // (lanes * MOMENTS)), most))
    job = Job(
        *parts,
        top=top,
        nothing=_nothing(sim, top),
        episodes=episodes,
        stride=blocks * lanes,
        lanes=lanes,
        record=bool(record),
    )
    with (
        open_checkpoint(name, checkpoint, key, top=top, **about) as store,
        Watch(name, episodes, "sim", progress, callback) as watch,
    ):
        ran = work.run(
            Task(_unit, job, lambda: _like(job)),
            -(-episodes // job.stride),
            partial(_with, job),
            (job.nothing, Noted()),
            watch,
            work.placement(name, executor, devices, store),
            size=lambda done: min(done * job.stride, episodes),
            words=lambda carry: carry[1].words(),
        )
    found, noted = ran.state
    log = noted.log(work.describe_missing("episodes", ran, noted.tally.episodes, episodes))
    numbers = np.concatenate([found.number[None], found.top.number])
    rebuilt = jax.device_get(_rebuilt(parts, numbers))
    n = int((found.top.reward > -np.inf).sum())
    best, failing = (index_tree(rebuilt, i) for i in (0, slice(1, n + 1)))
    numbers, counts = found.top.number[:n], found.top.count[:n]
    found = finish(job, log, best, failing, numbers, counts=counts, settings=settings)
    return complete(key, job, found, before, elsewhere=ran.incidents)


class Job(NamedTuple):
    """What all chunks of a search have in common."""

    key: jax.Array
    sim: Simulator
    reward: Reward
    actions: Actions
    top: int
    nothing: Found
    """What each begins with."""
    episodes: int
    stride: int
    """Episodes of a chunk; the last one has what is left."""
    lanes: int
    record: bool


def _unit(job, number, context):
    """Chunk ``number``: (`Found`, `Tally`, `Trials` or None)."""
    begin = number * job.stride
    end = min(begin + job.stride, job.episodes)
    about = job.key, job.sim, job.reward, job.actions
    if runs_on_host(job.sim):
        at = begin + np.arange(job.lanes, dtype=np.int32)
        live = at < end
        played = _recorded(*about, at, live)
        found, tally = _summed(job.nothing, at, live, played)
    elif job.record:
        found, tally, played = _block(*about, job.nothing, begin, end, job.lanes)
    else:
        return *_chunk(*about, job.nothing, begin, end, job.lanes), None
    trials = index_tree(played.trials(), np.s_[: end - begin, None]) if job.record else None
    return found, tally, trials


def _like(job):
    return job.nothing, Tally.none(), Trials(*Trials._fields) if job.record else None


def _with(job, carry, number, news):
    """(`Found`, `Noted`) with chunk ``number`` as well."""
    found, noted = carry
    new, tally, trials = news
    found = jax.device_get(_merged(found, new))
    end = min((number + 1) * job.stride, job.episodes)
    return found, noted.step(end, tally, found.reward[None], trials)


@jax.jit
def _merged(found, new):
    """The `Found` of two, of which ``new`` is of later episodes."""
    better = (new.failure & ~found.failure) | (
        (new.failure == found.failure) & (new.reward > found.reward)
    )
    best = select(better, new[:3], found[:3])

    def merge(top):
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), top, new.top)
        everywhere = jnp.ones(both.reward.shape, bool)
        places, counts = distinct_episodes(everywhere, *both, len(top.reward))
        reward = both.reward.at[places].get(mode="fill", fill_value=-jnp.inf)
        return take_rows(both, places)._replace(reward=reward, count=counts)

    # rarely anything enters, and sorting is dear; a repetition of the least one is to be counted,
    # too
    enters = (new.top.reward > -jnp.inf) & (new.top.reward >= found.top.reward[-1])
    return Found(*best, lax.cond(jnp.any(enters), merge, lambda top: top, found.top))


def _nothing(sim, top):
    zero, lowest = np.zeros((), np.int32), np.asarray(-np.inf, signature_of(sim).dtype)
    none = np.zeros(top, np.int32)
    nothing = Top(np.full(top, lowest), none.astype(np.uint32), none, none)
    return Found(zero > 0, lowest, zero, nothing)


@partial(jit, static_argnames="lanes")
def _chunk(key, sim, reward, actions, found, begin, end, lanes):
    """Episodes ``begin`` .. ``end - 1``, a block of lanes at a time: (`Found`, `Tally`)."""

    def block(number, live, found):
        return _summed(found, number, live, play_drawn(key, sim, reward, actions, number, live))

    return in_blocks(block, lanes, begin, end, found)


@partial(jit, static_argnames="lanes")
def _block(key, sim, reward, actions, found, begin, end, lanes):
    """Those of episodes ``begin`` .. ``end - 1`` that fit in the lanes: (`Found`, `Tally`,
    `Played`).
    """
    number = begin + jnp.arange(lanes, dtype=jnp.int32)
    live = (number < end) & (number >= begin)
    played = play_drawn(key, sim, reward, actions, number, live)
    return *_summed(found, number, live, played), played


@jax.jit
def _summed(found, number, live, played):
    """``found`` with the ``live`` ones of episodes of these numbers, and their `Tally`."""
    e = played.episode
    failing, value = live & e.failure, jnp.where(live, e.reward, -jnp.inf)
    any_failure = jnp.any(failing)
    i = jnp.argmax(jnp.where(failing | ~any_failure, value, -jnp.inf))
    rewards = jnp.where(failing, value, -jnp.inf)
    top = Top(rewards, played.tag, number, jnp.ones_like(number))
    found = _merged(found, Found(any_failure, value[i], number[i], top))
    return found, Tally.of(played, live, number)


@jit
def _recorded(key, sim, reward, actions, number, live):
    """`Played` with their disturbances."""
    return play_drawn(key, sim, reward, actions, number, live, record=True)


def _rebuilt(parts, numbers):
    """The episodes of these ``numbers`` [m], with their disturbances. Those of a black box are
    drawn by the program that drew them first: what another one draws may differ in the last digit,
    and would have to run.
    """
    if not runs_on_host(parts[1]):
        return _rebuild(*parts, numbers)
    every = np.ones(HOSTED_LANES, bool)
    return map_in_lanes(HOSTED_LANES, lambda n: _recorded(*parts, n, every).episode, numbers)


@quick
def _rebuild(key, sim, reward, actions, number):
    """The episodes of these numbers [m], with their disturbances."""
    live = jnp.ones(number.shape, bool)
    parts = key, sim, reward, actions, number, live
    return play_drawn(*parts, record=True, judge=False).episode
