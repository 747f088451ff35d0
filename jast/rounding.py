"""Whether the floats of a state are fine enough for what a disturbance does to it.

A position of 4.6e6 m in float32 moves in steps of half a metre: what pushes it by five is rounded,
at every step, and so is the probability of where it ends. The paths that show it show what
`jast.traps` tells, too.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._jax import quick
from jast.actions import Wide
from jast.counter import COUNTER
from jast.incidents import hosted
from jast.outline import outline
from jast.pytrees import strong
from jast.simulator import Simulator

__all__ = ["Looked", "looked", "rounded"]

PAIRS, STEPS = 16, 500
UNITS, SHARE = 32.0, 0.02
"""A disturbance that moves a number by fewer units of its last place is rounded; it matters where
rounding moves the miss distance by more than this share of what the disturbances do. A random walk
whose steps have a standard deviation of 10 units is off by 1 % at 4.5 standard deviations.
"""
WIDTH = 3.0
"""How much wider than the model the last path draws, where that costs no more: a cart-pole whose
policy nearly never fails meets its end then."""
JUMP, BACK, AWAY = 3.0, 0.2, 0.5
"""The state jumps back where most of the numbers that have moved change by more than 3 times their
greatest change before, and end at a fifth of their way from the start or nearer, having been at
more than half of the farthest (root mean squares). Of 81 systems of this repository none does, 64
episodes each, also with 2 in place of 3; cart-poles that reset themselves jump 7 to 13 times as
far as before.
"""


class Looked(NamedTuple):
    """What paths that share their random numbers say of a system."""

    units: list[Any]
    """Of each float of the state: the median, over the pairs, of the units in the last place by
    which a disturbance drawn anew moves it, where it does; else NaN"""
    moved: Any
    """Standard deviation of the miss distance that rounding makes"""
    spread: Any
    """And that of the disturbances"""
    still: Any
    """A list of bools: whether all disturbances, drawn anew, change nothing of a leaf of the
    state"""
    drawn: Any
    """bool: whether these disturbances differ"""
    felt: Any
    """bool: whether the miss distance does"""
    back: Any
    """The first step at which a state jumps back to its start; 0 where none does"""


def rounded(sim: Simulator) -> str | None:
    """A text that says so where the dtype of the state rounds what the disturbances do; None where
    it does not, and for a system on the host. Runs 80 episodes at most.
    """
    if hosted(sim):
        return None
    seen = looked(sim)
    # a system whose random start decides everything is as it is meant
    return None if outline(sim).random_start and all(seen.still) else words(seen)


def words(seen: Looked) -> str | None:
    """`rounded` of what was `looked` at."""
    if seen.drawn and all(seen.still):
        return (
            "no disturbance changes a number of the state: step does not use its second argument,"
            " or the state is too coarse for it; take large offsets out of the state, or use"
            " float64"
        )
    least = [u for u in (np.nanmin(a, initial=np.inf) for a in seen.units) if u < UNITS]
    if not least or not seen.moved > SHARE * seen.spread:
        return None
    return (
        "the state is too coarse: a disturbance changes one of its numbers by only"
        f" {min(least):.2g} units in the last place, and rounding changes the miss distance by"
        f" {seen.moved / seen.spread:.0%} as much as the disturbances do; take large offsets out of"
        " the state, or use float64"
    )


def looked(sim: Simulator) -> Looked:
    """Five paths from each of 16 starts: one as it is, one with a disturbance drawn anew, one whose
    state is moved by a unit of the last place at every step, one with all disturbances drawn anew,
    and one of these that are wider than the model's. Values of NumPy.
    """
    return jax.device_get(_looked(sim))


@quick
def _looked(sim):
    steps = min(sim.horizon, STEPS)
    key = jax.random.key(0, impl=COUNTER)
    shape = PAIRS, steps + 2, *jax.random.key_data(key).shape
    keys = jax.random.bits(key, shape, jnp.uint32)
    units, distance, still, drawn, back, starts = jax.vmap(partial(_five, sim, steps))(keys)
    units = [jnp.nanmedian(jnp.where(u > 0, u, jnp.nan), axis=0) for u in units]
    gap = distance[:, 2] - distance[:, 0]
    gap = jnp.where(jnp.isfinite(gap), gap, 0)
    # a whole unit has the deviation of 12 ** 0.5 roundings
    moved = jnp.sqrt(jnp.mean(gap**2) / 12)
    first = jnp.where(jnp.isfinite(distance[:, 0]), distance[:, 0], 0)
    felt = jnp.any(distance[:, 3] != distance[:, 0])
    # words of a random key that the start chooses differ
    fixed = lambda a: a.dtype != jnp.uint32 or jnp.all(a == a[:1])
    still = [jnp.all(s) & fixed(a) for s, a in zip(still, starts, strict=True)]
    back = jnp.min(jnp.where(back > 0, back, steps + 1)) % (steps + 1)
    return Looked(units, moved, jnp.std(first), still, jnp.any(drawn), felt, back)


class _Way(NamedTuple):
    """How far the last path has come; d numbers of its state."""

    numbers: Any
    """[d]"""
    far: Any
    """[d]: the farthest that each has been from its start"""
    change: Any
    """[d]: the greatest change of each in one step"""
    ended: Any
    back: Any
    """See `Looked`"""


def _five(sim: Simulator, steps: int, keys: jax.Array) -> tuple[Any, ...]:
    """The greatest way between the first two paths, in units, for each float of the state; the miss
    distances [5]; ``still``, ``drawn`` and ``back`` of `Looked`; the leaves of the first state.
    ``keys``: the data of keys, uint32: of the start, of the disturbance drawn anew, of the steps.
    """
    # programs with the default generator take longer to compile
    seed, made = keys[0, 0], partial(jax.random.wrap_key_data, impl=COUNTER)
    when = (seed % max(steps // 2, 1)).astype(jnp.int32)
    which = jnp.arange(5, dtype=jnp.int32)
    state = sim.init(D.sample(sim.start(), made(keys[0])))
    repeated = lambda a: jnp.broadcast_to(jnp.asarray(a)[None], (5, *jnp.shape(a)))
    states = jax.tree.map(repeated, state)
    widens = outline(sim).disturbance.closed

    def step(i, t, state):
        words = keys[jnp.where((i == 1) & (t == when), 1, 2 + t)]
        key = made(words ^ jnp.where(i < 3, 0, i).astype(words.dtype))
        dist = sim.disturbance(state)
        wide = Wide(jnp.where(i == 4, WIDTH, 1.0))
        x = wide.draw(key, dist) if widens else D.sample(dist, key)
        off = lambda a: jnp.where(i == 2, _a_unit_off(seed + t.astype(seed.dtype), a), a)
        return jax.tree.map(off, sim.step(state, x)), x

    def judged(state):
        event, distance, *_ = sim.evaluate(state)
        return event | sim.is_terminal(state), distance

    def body(carry):
        t, states, units, distance, done, still, drawn, way = carry
        states, x = jax.vmap(step, (0, None, 0))(which, t, states)
        if not sim.episodic:
            done, now = jax.vmap(judged)(states)
            distance = jnp.minimum(distance, now.astype(distance.dtype))
        units = [jnp.maximum(u, _apart(a)) for u, a in zip(units, _floats(states), strict=True)]
        still = [s & jnp.all(a[3] == a[0]) for s, a in zip(still, jax.tree.leaves(states))]
        drawn |= jnp.any(jnp.stack([jnp.any(a[3] != a[0]) for a in jax.tree.leaves(x)] or [False]))
        way = _went(way, start, _numbers(states, 4), t + 1, done[4])
        return t + 1, states, units, distance, done, still, drawn, way

    dtype, no = jax.eval_shape(judged, state)[1].dtype, jnp.zeros((), bool)
    start = _numbers(states, 4)
    first = (
        jnp.int32(0),
        states,
        [jnp.zeros_like(a[0]) for a in _floats(states)],
        jnp.full(5, jnp.inf, dtype),
        jnp.broadcast_to(judged(state)[0] & (not sim.episodic), (5,)),
        [~no for _ in jax.tree.leaves(states)],
        no,
        _Way(start, jnp.zeros_like(start), jnp.zeros_like(start), no, jnp.int32(0)),
    )
    goes_on = lambda c: (c[0] < steps) & ~jnp.any(c[4][:3])
    _, states, units, distance, _, still, drawn, way = lax.while_loop(goes_on, body, first)
    if sim.episodic:
        distance = jax.vmap(judged)(states)[1]
    return units, distance, still, drawn, way.back, jax.tree.leaves(strong(state))


def _went(way: _Way, start: jax.Array, now: jax.Array, t: jax.Array, ends: jax.Array) -> _Way:
    """One step on: ``now`` is the state after step ``t``, at which the path ``ends`` or not."""
    moves = way.far > 0
    count = jnp.sum(moves, dtype=jnp.int32)
    of = jnp.where(moves, way.far, 1)
    size = lambda a: jnp.sqrt(jnp.sum(jnp.where(moves, (a - start) / of, 0) ** 2))
    before = size(way.numbers)
    jumps = moves & (jnp.abs(now - way.numbers) > JUMP * way.change)
    most = 2 * jnp.sum(jumps, dtype=jnp.int32) > count
    away = before**2 > AWAY**2 * count.astype(before.dtype)
    jumped = (t > 5) & (count > 1) & most & away & (size(now) < BACK * before) & ~way.ended
    return _Way(
        now,
        jnp.maximum(way.far, jnp.abs(now - start)),
        jnp.maximum(way.change, jnp.abs(now - way.numbers)),
        way.ended | ends,
        jnp.where(jumped & (way.back == 0), t, way.back),
    )


def _numbers(states: Any, path: int) -> jax.Array:
    """[d]: the floats and signed integers of the state of one path; words of random keys, which
    have no sign, are no measure of a way.
    """
    of, kinds = jnp.zeros(()).dtype, (jnp.floating, jnp.signedinteger)
    leaves = jax.tree.leaves(states)
    leaves = [a[path] for a in leaves if any(jnp.issubdtype(a.dtype, k) for k in kinds)]
    return jnp.concatenate([jnp.zeros(0, of), *(jnp.ravel(a).astype(of) for a in leaves)])


def _floats(tree: Any) -> list[jax.Array]:
    return [a for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]


def _apart(a: jax.Array) -> jax.Array:
    """How far the second path is from the first, in units of the last place."""
    size = jnp.abs(a[0])
    units = jnp.abs(a[1] - a[0]) / (jnp.nextafter(size, jnp.full_like(size, jnp.inf)) - size)
    return jnp.where(jnp.isfinite(units), units, 0)


def _a_unit_off(seed: jax.Array, a: jax.Array) -> jax.Array:
    """``a`` with each float a unit of the last place higher or lower, by a hash of ``seed``
    (uint32) and its place.
    """
    a = jnp.asarray(a)
    if not jnp.issubdtype(a.dtype, jnp.floating):
        return a
    h = (jnp.arange(a.size, dtype=jnp.uint32).reshape(a.shape) * 40503 + seed) * jnp.uint32(
        2654435761
    )
    h = (h ^ (h >> 15)) * jnp.uint32(2246822519)
    up = (h ^ (h >> 13)) * jnp.uint32(3266489917) >> 31 == 1
    return jnp.nextafter(a, jnp.where(up, jnp.inf, -jnp.inf).astype(a.dtype))
