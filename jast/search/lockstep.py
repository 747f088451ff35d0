"""What searches over independent episodes share: lanes in lockstep, counting, the best distinct
episodes, the loop on the host and its result.

Episode n of tree k draws the disturbance of level t with the key folded from (tree key k, n, t);
the start, where it is random, is level 0. So an episode is known by its number, whatever the chunks
it was simulated in.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import failures as archive
from jast._threads import run_in_thread
from jast.checkpoints import step_once
from jast.episode import Episode, replay
from jast.outline import outline
from jast.progress import advance, begin, conclude
from jast.search.result import History, SearchResult, Trials
from jast.search.tree.packing import pack
from jast.watch import Watch, in_pieces

__all__ = [
    "Played",
    "Tally",
    "add",
    "blank",
    "distinct",
    "drive",
    "finish",
    "finish_traced",
    "fold",
    "in_words",
    "logged",
    "note",
    "nothing",
    "play",
    "tally",
    "trials",
    "whole",
]


class Played(NamedTuple):
    """Simulated episodes, one a lane."""

    episode: Episode
    """Leading axis [lanes]; ``disturbances`` [lanes, horizon, ...], or None where they were not
    recorded.
    """
    invalid: Any
    """[lanes] bool: the reward is not finite, as the simulator, a density or the reward was not; no
    failure then, reward -inf.
    """
    tag: Any
    """[lanes] uint32: a hash of x0 and the disturbances, to tell repetitions."""


class Tally(NamedTuple):
    """Counts of the episodes of a chunk: int32 scalars, but for ``failing``."""

    episodes: Any
    steps: Any
    failures: Any
    invalid: Any
    first: Any
    """How many episodes of the search were simulated up to and including its first failing one;
    ``NEVER`` where none of these failed.
    """
    failing: Any
    """[trees] bool: whether the tree found a failure."""


NEVER = np.int32(2**31 - 1)
FIRST = np.uint32(0x9E3779B9)
"""The hash of no disturbance."""


def play(sim, reward, keys, draw_start, draw, live, rows=None, record=False, judge=True):
    """Simulate one episode a lane, all lanes a step at a time: `Played`.

    ``keys`` [lanes]: of the episodes. ``draw_start(key, row, dist)`` and ``draw(key, row, dist)``
    make x0 and x with the key of their level; ``rows``: a pair of pytrees, [1, lanes, ...] for x0
    and [horizon, lanes, ...] for x, that the draws depend on. Lanes that are not ``live`` [lanes]
    bool come back as episodes of length 0 and mean nothing. Ended lanes step on, and only what is
    summed up is masked (and the state, where it is yet to be judged). Without ``judge`` an episodic
    system is not evaluated: for the disturbances of episodes whose outcome is known.
    """
    like = outline(sim)
    start = int(like.random_start)
    rows = ((), ()) if rows is None else rows
    at = lambda level, rows, t: (
        jax.vmap(jax.random.fold_in, (0, None))(keys, level),
        jax.tree.map(lambda a: a[t], rows),
    )

    def first(key, row):
        x0 = draw_start(key, row, sim.start()) if start else ()
        progress = begin(sim, reward, x0)
        return x0, progress, fold(FIRST, x0)

    def move(key, row, progress, tag, last):
        x = draw(key, row, sim.disturbance(progress.state))
        return x, advance(sim, reward, progress, x, last), fold(tag, x)

    move = jax.vmap(move, (0, 0, 0, 0, None))
    x0, progress, tag = jax.vmap(first)(*at(0, rows[0], 0))
    xs = None
    if record:
        lanes = live.shape
        xs = jax.tree.map(lambda s: jnp.zeros((sim.horizon, *lanes, *s.shape), s.dtype), like.x)

    def step(carry):
        t, length, tag, xs, before = carry
        on = ~before.done
        x, after, folded = move(*at(t + start, rows[1], t), before, tag, t + 1 >= sim.horizon)
        masked = jax.tree.map(
            lambda a, b: jnp.where(on, a, b), after._replace(state=()), before._replace(state=())
        )
        kept = masked._replace(
            state=(
                jax.tree.map(lambda a, b: jax.vmap(jnp.where)(on, a, b), after.state, before.state)
                if sim.episodic
                else after.state
            )
        )
        if record:
            xs = jax.tree.map(
                lambda a, b: a.at[t].set(jax.vmap(jnp.where)(on, b, jnp.zeros_like(b))), xs, x
            )
        return t + 1, length + on.astype(jnp.int32), jnp.where(on, folded, tag), xs, kept

    carry = (
        jnp.int32(0),
        jnp.zeros(live.shape, jnp.int32),
        tag,
        xs,
        progress._replace(done=progress.done | ~live),
    )
    _, length, tag, xs, end = lax.while_loop(lambda c: jnp.any(~c[4].done), step, carry)
    if judge:
        end = jax.vmap(lambda e, on: conclude(sim, reward, e, on))(end, live)
    finite = jnp.isfinite(end.reward)
    xs = jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), xs)
    value = jnp.where(finite, end.reward, -jnp.inf)
    return Played(
        Episode(x0, xs, end.log_prob, end.distance, end.failure & finite, length, value),
        ~finite,
        tag,
    )


@partial(jax.jit, static_argnums=1)
def blank(sim, n):
    """n episodes that were not played: reward -inf, distance inf, an `Episode` with its
    disturbances.
    """
    like = outline(sim)
    zero = lambda dtype: jnp.zeros((n,), dtype)
    x0 = jax.tree.map(lambda s: jnp.zeros((n, *s.shape), s.dtype), like.x0)
    x = jax.tree.map(lambda s: jnp.zeros((n, sim.horizon, *s.shape), s.dtype), like.x)
    real = zero(like.dtype)
    return Episode(x0, x, real, real + jnp.inf, zero(bool), zero(jnp.int32), real - jnp.inf)


def tally(played, live, order, tree=None, trees=1):
    """The `Tally` of the ``live`` lanes of ``played``; ``order`` [lanes]: each one's place in the
    search, from 0; ``tree`` [lanes] of ``trees``, default 0.
    """
    e = played.episode
    count = lambda p: jnp.sum(p & live, dtype=jnp.int32)
    failing = e.failure & live
    of_tree = (
        jnp.any(failing)[None] if tree is None else jnp.zeros((trees,), bool).at[tree].max(failing)
    )
    steps = jnp.sum(jnp.where(live, e.length, 0), dtype=jnp.int32)
    first = jnp.min(jnp.where(failing, order + 1, NEVER))
    return Tally(count(live), steps, count(e.failure), count(played.invalid), first, of_tree)


def trials(played):
    """The `Trials` of played episodes, all of them live."""
    e = played.episode
    every, none = jnp.ones_like(e.failure), jnp.zeros_like(e.failure)
    return Trials(e.reward, e.distance, e.log_prob, e.failure, every, none)


def add(a, b):
    """Two tallies as one."""
    return Tally(
        *(x + y for x, y in zip(a[:4], b[:4], strict=True)),
        jnp.minimum(a.first, b.first),
        a.failing | b.failing,
    )


def nothing(trees=1):
    """The `Tally` of no episode."""
    zero = jnp.zeros((), jnp.int32)
    return Tally(zero, zero, zero, zero, jnp.asarray(NEVER), jnp.zeros((trees,), bool))


def distinct(failure, reward, tag, number, count, k):
    """The k best distinct of n episodes: (their places [k], n where there are no more; their counts
    [k]).

    Failures before the others, then by falling reward; those of a reward that is not finite never.
    Equal reward and tag is a repetition, of which the least ``number`` stands for all, with their
    ``count`` added.
    """
    (n,) = reward.shape
    group = jnp.where(jnp.isfinite(reward), jnp.where(failure, 0, 1), 2)
    group, value, tag, _, place, count = lax.sort(
        (group, -reward, tag, number, jnp.arange(n, dtype=jnp.int32), count), num_keys=4
    )
    differs = [a[1:] != a[:-1] for a in (group, value, tag)]
    new = jnp.concatenate([jnp.ones((1,), bool), differs[0] | differs[1] | differs[2]])
    to = jnp.where(group < 2, jnp.cumsum(new, dtype=jnp.int32) - 1, k)
    places = jnp.full((k,), n, jnp.int32).at[jnp.where(new, to, k)].set(place, mode="drop")
    return places, jnp.zeros((k,), jnp.int32).at[to].add(count, mode="drop")


def whole(function, **values):
    """The values as Python ints; ValueError naming the setting unless each is a whole number from 1
    to 2^31 - 1.
    """
    for name, value in values.items():
        if (
            isinstance(value, bool)
            or not isinstance(value, int | np.integer)
            or not 1 <= value < 2**31
        ):
            raise ValueError(
                f"{function}: {name} must be a whole number from 1 to 2^31 - 1, received {value!r}"
            )
    return [int(v) for v in values.values()]


class Log(NamedTuple):
    """What the host knows of a search: exact counts, as Python ints."""

    tally: Tally
    history: History
    interrupted: str | None
    trials: Trials | None


def drive(chunk, carry, ends, *, host=False, trees=1, progress=False, callback=None, name="search"):
    """``(carry, Log)`` after ``carry, tally, best, trials = chunk(carry, begin, end)`` for each
    stretch up to the next of ``ends`` (episodes of each tree).

    ``best`` [trees]: the best reward so far; ``trials``: `Trials` [end - begin, trees] or None.
    ``host``: the system runs on the host. ``callback(done, total, None)`` after each chunk: the
    episodes of all trees. A KeyboardInterrupt ends the search after the last whole chunk, and is
    raised again where there is none.
    """

    def work(kept, done, end):
        carry, noted = kept
        make = lambda: chunk(carry, done, end)
        run = lambda: jax.block_until_ready(make())
        step = (lambda: run_in_thread(run)) if host else run
        carry, *news = step_once(step, carry, like=make)
        return carry, note(noted, end, *jax.device_get(news))

    whole = ends[-1] * trees
    watch = Watch(name, whole, "sim", progress, callback)
    words = lambda kept: in_words(kept[1])
    kept, done = in_pieces(work, (carry, NOTHING), ends, watch, lambda end: end * trees, words)
    carry, noted = kept
    interrupted = f"after {done * trees} of {whole} episodes" if done < ends[-1] else None
    return carry, logged(noted, interrupted)


class Noted(NamedTuple):
    """What is known of the first chunks of a search."""

    tally: Tally | None
    moments: tuple
    """Of each chunk: (its end, the best rewards so far, failures so far, trials or None)"""


NOTHING = Noted(None, ())


def note(noted, end, counted, best, record):
    """`Noted` with one chunk more, which ends at ``end``: of its `Tally`, the best rewards so far
    [trees] and its `Trials`, if any.
    """
    # Python's ints do not overflow
    counted, total = Tally(*(int(v) for v in counted[:5]), counted.failing), noted.tally
    if total is not None:
        sums = (a + b for a, b in zip(total[:4], counted[:4], strict=True))
        counted = Tally(*sums, min(total.first, counted.first), total.failing | counted.failing)
    return Noted(counted, (*noted.moments, (end, best, counted.failures, record)))


def in_words(noted):
    """What the bar says of `Noted`."""
    return dict(failures=noted.tally.failures, best=f"{noted.moments[-1][1].max():.4g}")


def logged(noted, interrupted=None):
    """The `Log` of `Noted`."""
    *moments, records = zip(*noted.moments, strict=True)
    record = None if records[0] is None else jax.tree.map(lambda *a: np.concatenate(a), *records)
    return Log(noted.tally, History(*(np.array(v) for v in moments)), interrupted, record)


def finish(sim, reward, log, best, candidates, tree, simulation, counts, settings, top):
    """The `SearchResult` on the host.

    ``best``: the best episode that was simulated; ``candidates``: episodes [m] that failed, with
    the tree and number at which each was first found and how often. All are replayed, and what is
    said of them is what the replay says.
    """
    candidates = jax.device_get(candidates)
    # so that one that no longer fails is counted as dropped
    candidates = candidates._replace(failure=np.ones(len(simulation), bool))
    found = archive.collect(sim, reward, candidates, tree, simulation, log.tally.failures, top)
    # repetitions are no candidates, but were counted
    times = {(int(k), int(i)): int(n) for k, i, n in zip(tree, simulation, counts, strict=True)}
    found = found._replace(
        counts=np.array(
            [times[int(k), int(i)] for k, i in zip(found.tree, found.simulation, strict=True)],
            np.int32,
        )
    )
    best = jax.device_get(replay(sim, found.best if found.size else best, reward=reward))
    n = log.tally
    return SearchResult(
        best=best,
        best_reward_per_tree=log.history.best_reward[-1],
        failures=found,
        episodes=n.episodes,
        steps=n.steps,
        first_failure=None if n.first == NEVER else n.first,
        failing_share=n.failures / n.episodes,
        failing_per_tree=n.failing,
        failing=n.failures,
        history=log.history,
        invalid=n.invalid,
        settings=settings | ({"interrupted": log.interrupted} if log.interrupted else {}),
        trials=log.trials,
    )


def finish_traced(sim, reward, n, best, best_reward):
    """The `SearchResult` inside a transformation: no archive and no history."""
    return SearchResult(
        best=replay(sim, best, reward=reward),
        best_reward_per_tree=best_reward,
        failures=None,
        episodes=n.episodes,
        steps=n.steps,
        first_failure=jnp.where(n.first == NEVER, -1, n.first),
        failing_share=n.failures.astype(best_reward.dtype) / n.episodes.astype(best_reward.dtype),
        failing_per_tree=n.failing,
        failing=n.failures,
        history=None,
        invalid=n.invalid,
        settings=None,
    )


def fold(tag, x):
    """The hash with the bits of one more disturbance: a multiply and a shift a word, as it is paid
    at every step.
    """
    for word in pack(x) if jax.tree.leaves(x) else ():
        tag = (tag ^ word) * jnp.uint32(0x85EBCA6B)
        tag = tag ^ (tag >> 15)
    return tag
