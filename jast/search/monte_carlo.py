"""Random search: independent episodes and nothing learned from any. The baseline of every other
search.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import actions as choices
from jast import units
from jast._jax import jit, quick
from jast.checkpoints import open_checkpoint
from jast.counter import tree_keys
from jast.incidents import incidents, merge_incidents, new_incidents, runs_on_host
from jast.memory import require
from jast.outline import outline
from jast.places import Task
from jast.search import lockstep as E
from jast.search.ending import ended, planned, usual
from jast.search.prepare import prepare
from jast.watch import Watch

if TYPE_CHECKING:
    import chex

    from jast.search.result import SearchResult
    from jast.simulator import Simulator
    from jast.typing import Actions, Callback, Executor, PathLike, Reward

__all__ = ["monte_carlo"]

LANES, HOSTED = 4096, 64
"""Episodes in lockstep; of a system on the host, where a chunk takes long, and only between chunks
can a search be watched and interrupted.
"""
MOMENTS = 200
"""Of the history, about: a moment is at least a block of ``LANES`` episodes."""


class Found(NamedTuple):
    """The best so far: one episode of all, and the top distinct failures, by their numbers."""

    failure: Any
    reward: Any
    number: Any
    top_reward: Any
    """[top], falling; -inf where there are fewer."""
    top_number: Any
    top_tag: Any
    top_count: Any


SAMPLES = choices.samples()


def monte_carlo(
    key: chex.PRNGKey,
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
    episodes, top = E.whole("monte_carlo", episodes=episodes, top=top)
    asked = dict(sim=sim, reward=reward, actions=actions, episodes=episodes, record=bool(record))
    before = incidents(sim)
    # the episodes that scale the reward are the same for every key: no part of a random sample
    reward, actions, settings, _ = prepare(
        "monte_carlo", key, sim, reward, actions, episodes=episodes
    )
    settings = planned("monte_carlo", refine, sim, settings, usual(sim, reward))
    lanes = HOSTED if runs_on_host(sim) else min(LANES, max(128, 1 << (episodes - 1).bit_length()))
    own, key = key, tree_keys(key, 1)[0]
    if settings is None:
        units.require_untraced(
            "monte_carlo", checkpoint=checkpoint, executor=executor, devices=devices
        )
        if episodes * sim.horizon >= 2**31:
            raise ValueError(
                "monte_carlo: episodes times the horizon must be below 2^31 inside a"
                f" transformation, received {episodes} x {sim.horizon}"
            )
        found, counted = _chunk(key, sim, reward, actions, _nothing(sim, 1), 0, episodes, lanes)
        best = jax.tree.map(lambda a: a[0], _rebuild(key, sim, reward, actions, found.number[None]))
        return E.finish_traced(sim, reward, counted, best, found.reward[None])

    if record:
        row = 3 * outline(sim).dtype.itemsize + 2  # three numbers and two bools
        records = f"the records of {episodes} episodes"
        require("monte_carlo", 2 * episodes * row, records, "use fewer, or record=False")

    most = (2**31 - 1) // (lanes * sim.horizon)  # the steps of a chunk are counted in int32
    blocks = (
        1 if record or runs_on_host(sim) else max(1, min(-(-episodes // (lanes * MOMENTS)), most))
    )
    stride = blocks * lanes
    job = Job(key, sim, reward, actions, _nothing(sim, top), episodes, stride, lanes, bool(record))
    with (
        open_checkpoint("monte_carlo", checkpoint, own, top=top, **asked) as store,
        Watch("monte_carlo", episodes, "sim", progress, callback) as watch,
    ):
        ran = units.run(
            Task(_unit, job, lambda: _like(job)),
            -(-episodes // stride),
            partial(_with, job),
            (jax.device_get(job.nothing), E.NOTHING),
            watch,
            units.placement("monte_carlo", executor, devices, store),
            size=lambda done: min(done * stride, episodes),
            words=lambda kept: E.in_words(kept[1]),
        )
    found, noted = ran.state
    log = E.logged(noted, units.describe_missing("episodes", ran, noted.tally.episodes, episodes))
    found = jax.device_get(found)
    numbers = np.concatenate([found.number[None], found.top_number])
    rebuilt = jax.device_get(_rebuild(key, sim, reward, actions, numbers))
    n = int((found.top_reward > -jnp.inf).sum())
    best, candidates = (
        jax.tree.map(lambda a: a[0], rebuilt),
        jax.tree.map(lambda a: a[1 : n + 1], rebuilt),
    )
    found = E.finish(
        sim,
        reward,
        log,
        best,
        candidates,
        [0] * n,
        found.top_number[:n],
        found.top_count[:n],
        settings,
        top,
    )
    found = ended(own, sim, reward, found, top)
    here = new_incidents(before, incidents(sim))
    return found._replace(incidents=merge_incidents(here, ran.incidents))


class Job(NamedTuple):
    """What all chunks of a search have in common."""

    key: Any
    sim: Any
    reward: Any
    actions: Any
    nothing: Found
    """What each begins with."""
    episodes: int
    stride: int
    """Episodes of a chunk; the last one has what is left."""
    lanes: int
    record: bool


def _unit(job, number, post):
    """Chunk ``number``: (`Found`, `Tally`, `Trials` or None)."""
    begin = number * job.stride
    end = min(begin + job.stride, job.episodes)
    about = job.key, job.sim, job.reward, job.actions, job.nothing, begin, end
    if not job.record:
        return *_chunk(*about, job.lanes), None
    found, counted, played = _block(*about, job.lanes)
    rows = jax.tree.map(lambda a: a[: end - begin, None], E.trials(played))
    return found, counted, rows


def _like(job):
    return job.nothing, E.nothing(), E.Trials(*E.Trials._fields) if job.record else None


def _with(job, kept, number, news):
    """(`Found`, `Noted`) with chunk ``number`` as well."""
    found, noted = kept
    new, counted, rows = news
    if (new.top_reward > -np.inf).any():
        found = jax.device_get(_joined(found, new))
    elif new.reward > found.reward and not found.failure:
        found = Found(*new[:3], *found[3:])
    end = min((number + 1) * job.stride, job.episodes)
    return found, E.note(noted, end, counted, found.reward[None], rows)


@jax.jit
def _joined(found, new):
    """The `Found` of two, of which ``new`` is of later episodes."""
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), found[3:], new[3:])
    top_reward, top_number, top_tag, top_count = both
    (k,) = found.top_reward.shape
    everywhere = jnp.ones(top_reward.shape, bool)
    places, counts = E.distinct(everywhere, top_reward, top_tag, top_number, top_count, k)
    better = (new.failure & ~found.failure) | (
        (new.failure == found.failure) & (new.reward > found.reward)
    )
    best = jax.tree.map(lambda a, b: jnp.where(better, b, a), found[:3], new[:3])
    return Found(*best, *_picked(places, top_reward, top_number, top_tag), counts)


def _picked(places, reward, number, tag):
    """These at ``places``; where there are no more, a reward of -inf."""
    pairs = ((reward, -jnp.inf), (number, 0), (tag, 0))
    return [a.at[places].get(mode="fill", fill_value=fill) for a, fill in pairs]


def _nothing(sim, top):
    zero, lowest = np.zeros((), np.int32), np.asarray(-np.inf, outline(sim).dtype)
    none = np.zeros(top, np.int32)
    lows = np.full(top, lowest)
    return Found(np.zeros((), bool), lowest, zero, lows, none, none.astype(np.uint32), none)


@partial(jit, static_argnames="lanes")
def _chunk(key, sim, reward, actions, found, begin, end, lanes):
    """Episodes ``begin`` .. ``end - 1``, a block of lanes at a time: (`Found`, `Tally`)."""

    def block(carry):
        at, found, counted = carry
        found, more, _ = _block(key, sim, reward, actions, found, at, end, lanes)
        return at + lanes, found, E.add(counted, more)

    begin, end = jnp.asarray(begin, jnp.int32), jnp.asarray(end, jnp.int32)
    # compared by what is left, as the end may be the last int32
    _, found, counted = lax.while_loop(
        lambda c: (c[0] < end) & (c[0] >= begin), block, (begin, found, E.nothing())
    )
    return found, counted


@partial(jit, static_argnames="lanes")
def _block(key, sim, reward, actions, found, begin, end, lanes):
    """Those of episodes ``begin`` .. ``end - 1`` that fit in the lanes: (`Found`, `Tally`,
    `Played`).
    """
    number = begin + jnp.arange(lanes, dtype=jnp.int32)
    live = (number < end) & (number >= begin)
    played = _play(key, sim, reward, actions, number, live)
    return _keep(found, played, number, live), E.tally(played, live, number), played


def _play(key, sim, reward, actions, number, live, **how):
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, number)
    draw_start, draw = (
        lambda key, row, dist, f=f: f(key, dist) for f in (actions.draw_start, actions.draw)
    )
    return E.play(sim, reward, keys, draw_start, draw, live, **how)


@quick
def _rebuild(key, sim, reward, actions, number):
    """The episodes of these numbers [m], with their disturbances."""
    return _play(
        key, sim, reward, actions, number, jnp.ones(number.shape, bool), record=True, judge=False
    ).episode


def _keep(found, played, number, live):
    e = played.episode
    value = jnp.where(live, e.reward, -jnp.inf)
    failing = live & e.failure
    any_failure = jnp.any(failing)
    i = jnp.argmax(jnp.where(failing | ~any_failure, value, -jnp.inf))
    better = (any_failure & ~found.failure) | (
        (any_failure == found.failure) & (value[i] > found.reward)
    )
    pick = lambda a, b: jnp.where(better, a, b)
    found = found._replace(
        failure=found.failure | any_failure,
        reward=pick(value[i], found.reward),
        number=pick(number[i], found.number),
    )

    def merge(found):
        values = jnp.concatenate([found.top_reward, jnp.where(failing, value, -jnp.inf)])
        numbers, tags = (
            jnp.concatenate([found.top_number, number]),
            jnp.concatenate([found.top_tag, played.tag]),
        )
        counts = jnp.concatenate([found.top_count, jnp.ones_like(number)])
        (k,) = found.top_reward.shape
        places, counts = E.distinct(jnp.ones(values.shape, bool), values, tags, numbers, counts, k)
        return Found(*found[:3], *_picked(places, values, numbers, tags), counts)

    # rarely anything enters, and sorting is dear; a repetition of the least kept one is to be
    # counted, too
    return lax.cond(
        jnp.any(failing & (value >= found.top_reward[-1])), merge, lambda found: found, found
    )
