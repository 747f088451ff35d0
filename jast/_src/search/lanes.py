"""Episodes in lanes that step together, how they are counted, and the best distinct ones of them.

Episode n of tree k draws the disturbance of level t with the key folded from (tree key k, n, t);
the start, where it is random, is level 0. So an episode is known by its number, whatever the chunks
it was simulated in.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.episode import Episode
from jast._src.core.signature import signature_of
from jast._src.core.transition import advance, begin, conclude
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.result import Trials
from jast._src.search.tree.packing import pack
from jast._src.util.pytrees import index_tree, select_rows, zero_where

__all__ = [
    "EMPTY_HASH",
    "NEVER",
    "Played",
    "Tally",
    "blank_episodes",
    "distinct_episodes",
    "fold_hash",
    "in_blocks",
    "play_drawn",
    "play_lanes",
    "take_rows",
]


NEVER = np.int32(2**31 - 1)  # the greatest int32: no simulation has this number
EMPTY_HASH = np.uint32(0x9E3779B9)  # the hash of no disturbance


class Played(NamedTuple):
    """Simulated episodes, one a lane."""

    episode: Episode
    """Leading axis [lanes]; ``disturbances`` [lanes, horizon, ...], or None where they were not
    recorded.
    """
    invalid: jax.Array
    """[lanes] bool: the reward is not finite, as the simulator, a density or the reward was not; no
    failure then, reward -inf.
    """
    tag: jax.Array
    """[lanes] uint32: a hash of x0 and the disturbances, to tell repetitions."""

    def trials(self) -> Trials:
        """Their numbers; all of them are live."""
        e = self.episode
        every = jnp.ones_like(e.failure)
        return Trials(e.reward, e.distance, e.log_prob, e.failure, every, ~every)


class Tally(NamedTuple):
    """Counts of some episodes: int32 scalars, or Python ints on the host."""

    episodes: jax.Array | int
    steps: jax.Array | int
    failures: jax.Array | int
    invalid: jax.Array | int
    first: jax.Array | int
    """How many episodes of the search were simulated up to and including its first failing one;
    ``NEVER`` where none of these failed.
    """
    failing: jax.Array
    """[trees] bool: whether the tree found a failure."""

    @classmethod
    def none(cls, trees: int = 1) -> "Tally":
        """Of no episode."""
        zero = jnp.zeros((), jnp.int32)
        return cls(zero, zero, zero, zero, jnp.asarray(NEVER), jnp.zeros((trees,), bool))

    @classmethod
    def of(
        cls,
        played: Played,
        live: jax.Array,
        order: jax.Array,
        tree: jax.Array | None = None,
        trees: int = 1,
    ) -> "Tally":
        """Of the ``live`` lanes of ``played``; ``order`` [lanes]: each one's place in the search,
        from 0; ``tree`` [lanes] of ``trees``, default 0.
        """
        failing = played.episode.failure & live
        tree = jnp.zeros(live.shape, jnp.int32) if tree is None else tree
        return cls(
            episodes=jnp.sum(live, dtype=jnp.int32),
            steps=jnp.sum(jnp.where(live, played.episode.length, 0), dtype=jnp.int32),
            failures=jnp.sum(failing, dtype=jnp.int32),
            invalid=jnp.sum(played.invalid & live, dtype=jnp.int32),
            first=jnp.min(jnp.where(failing, order + 1, NEVER)),
            failing=jnp.zeros((trees,), bool).at[tree].max(failing),
        )

    def add(self, more: "Tally") -> "Tally":
        """Both as one."""
        sums = (a + b for a, b in zip(self[:4], more[:4], strict=True))
        least = min if isinstance(self.first, int) else jnp.minimum
        return Tally(*sums, least(self.first, more.first), self.failing | more.failing)


def play_lanes(sim, reward, keys, draw_start, draw, live, rows=((), ()), record=False, judge=True):
    """Simulate one episode a lane, all lanes a step at a time: `Played`.

    ``keys`` [lanes]: of the episodes. ``draw_start(key, row, dist)`` and ``draw(key, row, dist)``
    make x0 and x with the key of their level; ``rows``: a pair of pytrees, [1, lanes, ...] for x0
    and [horizon, lanes, ...] for x, that the draws depend on. Lanes that are not ``live`` [lanes]
    bool come back as episodes of length 0 and mean nothing. Ended lanes step on, and only what is
    summed up is masked (and the state, where it is yet to be judged). Without ``judge`` an episodic
    system is not evaluated: for the disturbances of episodes whose outcome is known.
    """
    like = signature_of(sim)
    start = int(like.random_start)
    if runs_on_host(sim):  # which runs nothing twice: what is not live does what another lane does
        like_lane = jnp.where(live, jnp.arange(len(live)), jnp.argmax(live))
        keys, rows = keys[like_lane], index_tree(rows, np.s_[:, like_lane])

    def at(level, rows, t):
        own = jax.vmap(jax.random.fold_in, (0, None))(keys, level)
        return own, index_tree(rows, t)

    def first(key, row):
        x0 = draw_start(key, row, sim.start()) if start else ()
        progress = begin(sim, reward, x0)
        return x0, progress, fold_hash(EMPTY_HASH, x0)

    def move(key, row, progress, tag, last):
        x = draw(key, row, sim.disturbance(progress.state))
        return x, advance(sim, reward, progress, x, last), fold_hash(tag, x)

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
        state = select_rows(on, after.state, before.state) if sim.episodic else after.state
        after = select_rows(on, after._replace(state=()), before._replace(state=()))
        if record:
            x = jax.vmap(zero_where)(~on, x)
            xs = jax.tree.map(lambda a, b: a.at[t].set(b), xs, x)
        length, tag = length + on.astype(jnp.int32), jnp.where(on, folded, tag)
        return t + 1, length, tag, xs, after._replace(state=state)

    zero, begun = jnp.zeros(live.shape, jnp.int32), progress._replace(done=progress.done | ~live)
    carry = jnp.int32(0), zero, tag, xs, begun
    _, length, tag, xs, end = lax.while_loop(lambda c: jnp.any(~c[4].done), step, carry)
    if judge:
        end = jax.vmap(lambda e, on: conclude(sim, reward, e, on))(end, live)
    finite = jnp.isfinite(end.reward)
    xs = jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), xs)
    value = jnp.where(finite, end.reward, -jnp.inf)
    failure = end.failure & finite
    e = Episode(x0, xs, end.log_prob, end.distance, failure, length, value)
    return Played(e, ~finite, tag)


def play_drawn(key, sim, reward, actions, number, live, **how):
    """`play_lanes` of the episodes of these numbers [lanes] of the tree's ``key``, as ``actions``
    draw them.
    """

    def draw_start(key, row, dist):
        return actions.draw_start(key, dist)

    def draw(key, row, dist):
        return actions.draw(key, dist)

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, number)
    return play_lanes(sim, reward, keys, draw_start, draw, live, **how)


def in_blocks(block, lanes, begin, end, carry):
    """``(carry, Tally)`` after ``block(number, live, carry)``, which returns such a pair, of each
    block of lanes of the episodes ``begin`` .. ``end - 1``: their numbers [lanes], and which of
    them are live.
    """
    begin, end = jnp.asarray(begin, jnp.int32), jnp.asarray(end, jnp.int32)

    # compared by what is left, as the end may be the last int32
    def left(number):
        return (number < end) & (number >= begin)

    def body(carried):
        at, carry, tally = carried
        number = at + jnp.arange(lanes, dtype=jnp.int32)
        carry, more = block(number, left(number), carry)
        return at + lanes, carry, tally.add(more)

    _, carry, tally = lax.while_loop(lambda c: left(c[0]), body, (begin, carry, Tally.none()))
    return carry, tally


@partial(jax.jit, static_argnums=1)
def blank_episodes(sim, n):
    """n episodes that were not played: reward -inf, distance inf, an `Episode` with its
    disturbances.
    """
    like = signature_of(sim)
    x0 = jax.tree.map(lambda s: jnp.zeros((n, *s.shape), s.dtype), like.x0)
    x = jax.tree.map(lambda s: jnp.zeros((n, sim.horizon, *s.shape), s.dtype), like.x)
    zero, length = jnp.zeros((n,), like.dtype), jnp.zeros((n,), jnp.int32)
    return Episode(x0, x, zero, zero + jnp.inf, length > 0, length, zero - jnp.inf)


def distinct_episodes(failure, reward, tag, number, count, k):
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


def take_rows(tree, places):
    """The rows ``places`` [k] of the leaves [n, ...]; zeros where a place is n or more."""
    return jax.tree.map(lambda a: a.at[places].get(mode="fill", fill_value=0), tree)


def fold_hash(tag, x):
    """The hash with the bits of one more disturbance: a multiply and a shift a word, as it is paid
    at every step.
    """
    for word in pack(x) if jax.tree.leaves(x) else ():
        tag = (tag ^ word) * jnp.uint32(0x85EBCA6B)
        tag = tag ^ (tag >> 15)
    return tag
