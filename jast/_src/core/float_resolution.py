"""Whether the floats of a state are fine enough for what a disturbance does to it.

A position of 4.6e6 m in float32 moves in steps of half a metre: what pushes it by five is rounded,
at every step, and so is the probability of where it ends. The paths that show it show what
`core.traps` tells, too.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core.actions import Wide
from jast._src.core.counter_prng import COUNTER
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, first_state, next_state
from jast._src.core.typing import Array
from jast._src.runtime._jax import quick
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.pytrees import select, with_rows_of

__all__ = ["Probe", "describe", "probe", "rounding_problem"]

STARTS = 16  # of five paths each: enough for a median over them
STEPS = 500  # of a path at most, as `jast.check` is to take seconds
COARSE_UNITS = 32.0  # of the last place: a disturbance that moves a number by fewer is rounded
COARSE_SHARE = 0.02  # of what the disturbances do to the miss distance: rounding of more matters
# A random walk whose steps have a standard deviation of 10 units is off by 1 % at 4.5 of them.
WIDTH = 3.0  # of the last path's draws, in those of the model: rare ends are met then, too
JUMP = 3.0  # a change of so many times the greatest before is a jump
NEAR_START = 0.2  # of the farthest that a state has been: where a jump back ends, at most
FAR_AWAY = 0.5  # likewise where it begins, at least
# These three are root mean squares, and most numbers have to jump. Of 81 systems of this repository
# none does so, 64 episodes each, also with a `JUMP` of 2; cart-poles that reset themselves jump 7
# to 13 times as far as before.


class Probe(NamedTuple):
    """What paths that share their random numbers say of a system."""

    units: list[Array]
    """Of each float of the state: the median, over the starts, of the units in the last place by
    which a disturbance drawn anew moves it, where it does; else NaN."""
    rounding: Array
    """Standard deviation of the miss distance that rounding makes."""
    spread: Array
    """That of the disturbances."""
    unmoved: list[Array]
    """Of each leaf of the state, bool: all disturbances, drawn anew, change nothing of it."""
    differ: Array
    """bool: whether these disturbances differ."""
    distance_differs: Array
    """bool: whether the miss distance does."""
    jump: Array
    """The first step at which a state jumps back to its start; 0 where none does."""


def rounding_problem(sim: Simulator) -> str | None:
    """A text that says so where the dtype of the state rounds what the disturbances do; None where
    it does not, and for a system on the host. Runs 80 episodes at most.
    """
    if runs_on_host(sim):
        return None
    found = probe(sim)
    # a system whose random start decides everything is as it is meant
    return None if signature_of(sim).random_start and all(found.unmoved) else describe(found)


def describe(found: Probe) -> str | None:
    """`rounding_problem` by what a `probe` found."""
    if found.differ and all(found.unmoved):
        return (
            "no disturbance changes a number of the state: step does not use its second argument,"
            " or the state is too coarse for it; take large offsets out of the state, or use"
            " float64"
        )
    units = [np.nanmin(a, initial=np.inf) for a in found.units]
    least = min(units, default=np.inf)
    if not least < COARSE_UNITS or not found.rounding > COARSE_SHARE * found.spread:
        return None
    return (
        "the state is too coarse: a disturbance changes one of its numbers by only"
        f" {least:.2g} units in the last place, and rounding changes the miss distance by"
        f" {found.rounding / found.spread:.0%} as much as the disturbances do; take large offsets"
        " out of the state, or use float64"
    )


def probe(sim: Simulator) -> Probe:
    """Five paths from each of 16 starts: one as it is, one with a disturbance drawn anew, one whose
    state is moved by a unit of the last place at every step, one with all disturbances drawn anew,
    and one of these that are wider than the model's. Values of NumPy.
    """
    return jax.device_get(_probe(sim))


@quick
def _probe(sim):
    steps = min(sim.horizon, STEPS)
    key = jax.random.key(0, impl=COUNTER)
    shape = STARTS, steps + 2, *jax.random.key_data(key).shape
    keys = jax.random.bits(key, shape, jnp.uint32)
    paths = jax.vmap(partial(_five_paths, sim, steps))(keys)
    units, distance, unmoved, differ, back, starts = paths
    units = [jnp.nanmedian(jnp.where(u > 0, u, jnp.nan), axis=0) for u in units]
    gap = distance[:, 2] - distance[:, 0]
    gap = jnp.where(jnp.isfinite(gap), gap, 0)
    # a whole unit has the deviation of 12 ** 0.5 roundings
    rounding = jnp.sqrt(jnp.mean(gap**2) / 12)
    first = jnp.where(jnp.isfinite(distance[:, 0]), distance[:, 0], 0)
    # words of a random key that the start chooses differ
    unmoved = [
        jnp.all(u) & (a.dtype != jnp.uint32 or jnp.all(a == a[:1]))
        for u, a in zip(unmoved, starts, strict=True)
    ]
    return Probe(
        units=units,
        rounding=rounding,
        spread=jnp.std(first),
        unmoved=unmoved,
        differ=jnp.any(differ),
        distance_differs=jnp.any(distance[:, 3] != distance[:, 0]),
        jump=jnp.min(jnp.where(back > 0, back, steps + 1)) % (steps + 1),
    )


class _Course(NamedTuple):
    """How far the last path has come; d numbers of its state."""

    numbers: jax.Array
    """[d]."""
    farthest: jax.Array
    """[d]: that each has been from its start."""
    change: jax.Array
    """[d]: the greatest of each in one step."""
    ended: jax.Array
    back: jax.Array
    """``jump`` of `Probe`."""


class _Paths(NamedTuple):
    """Where the five paths of a start are."""

    t: jax.Array
    states: Any
    """[5, ...]."""
    units: list[jax.Array]
    """The greatest way between the first two paths, for each float of the state."""
    distance: jax.Array
    """[5]."""
    done: jax.Array
    """[5]."""
    unmoved: list[jax.Array]
    differ: jax.Array
    course: _Course


def _five_paths(sim: Simulator, steps: int, keys: jax.Array) -> tuple[Any, ...]:
    """``units``, ``distance``, ``unmoved``, ``differ`` and ``back`` of the `_Paths` at their end,
    and the leaves of the first state. ``keys``: the data of keys, uint32: of the start, of the
    disturbance drawn anew, of the steps.
    """
    seed = keys[0, 0]
    # programs with the default generator take longer to compile
    key_of = partial(jax.random.wrap_key_data, impl=COUNTER)
    when = (seed % max(steps // 2, 1)).astype(jnp.int32)
    which = jnp.arange(5, dtype=jnp.int32)
    state = first_state(sim, D.sample(sim.start(), key_of(keys[0])))
    states = jax.tree.map(lambda a: jnp.broadcast_to(a, (5, *jnp.shape(a))), state)
    widens = signature_of(sim).disturbance.closed  # where that costs no more

    def step(i, t, state):
        words = keys[jnp.where((i == 1) & (t == when), 1, 2 + t)]
        key = key_of(words ^ jnp.where(i < 3, 0, i).astype(words.dtype))
        dist = sim.disturbance(state)
        wide = Wide(jnp.where(i == 4, WIDTH, 1.0))
        x = wide.draw(key, dist) if widens else D.sample(dist, key)
        after = next_state(sim, state, x)
        off = jax.tree.map(partial(_a_unit_off, seed + t.astype(seed.dtype)), after)
        return select(i == 2, off, after), x

    def evaluate(state):
        event, distance, *_ = sim.evaluate(state)
        return event | sim.is_terminal(state), jnp.asarray(distance)

    def body(paths):
        states, x = jax.vmap(step, (0, None, 0))(which, paths.t, paths.states)
        done, distance = paths.done, paths.distance
        if not sim.episodic:
            done, now = jax.vmap(evaluate)(states)
            distance = jnp.minimum(distance, now.astype(distance.dtype))
        differ = [jnp.any(a[3] != a[0]) for a in jax.tree.leaves(x)]
        return _Paths(
            t=paths.t + 1,
            states=states,
            units=[
                jnp.maximum(u, _units_apart(a))
                for u, a in zip(paths.units, _floats(states), strict=True)
            ],
            distance=distance,
            done=done,
            unmoved=[
                u & jnp.all(a[3] == a[0]) for u, a in zip(paths.unmoved, jax.tree.leaves(states))
            ],
            differ=paths.differ | jnp.any(jnp.stack(differ or [False])),
            course=_follow(paths.course, start, _numbers(states, 4), paths.t + 1, done[4]),
        )

    event, distance = evaluate(state)
    no = jnp.zeros((), bool)
    start = _numbers(states, 4)
    nowhere = jnp.zeros_like(start)
    first = _Paths(
        t=jnp.int32(0),
        states=states,
        units=[jnp.zeros_like(a[0]) for a in _floats(states)],
        distance=jnp.full(5, jnp.inf, distance.dtype),
        done=jnp.broadcast_to(event & (not sim.episodic), (5,)),
        unmoved=[~no for _ in jax.tree.leaves(states)],
        differ=no,
        course=_Course(start, farthest=nowhere, change=nowhere, ended=no, back=jnp.int32(0)),
    )
    first = with_rows_of(keys, first)
    last = lax.while_loop(lambda p: (p.t < steps) & ~jnp.any(p.done[:3]), body, first)
    distance = jax.vmap(evaluate)(last.states)[1] if sim.episodic else last.distance
    return (
        last.units,
        distance,
        last.unmoved,
        last.differ,
        last.course.back,
        jax.tree.leaves(state),
    )


def _follow(
    course: _Course, start: jax.Array, now: jax.Array, t: jax.Array, ends: jax.Array
) -> _Course:
    """One step on: ``now`` is the state after step ``t``, at which the path ``ends`` or not."""
    moves = course.farthest > 0
    count = jnp.sum(moves, dtype=jnp.int32)
    scale = jnp.where(moves, course.farthest, 1)

    def norm(a):
        return jnp.sqrt(jnp.sum(jnp.where(moves, (a - start) / scale, 0) ** 2))

    before = norm(course.numbers)
    change = jnp.abs(now - course.numbers)
    jumps = moves & (change > JUMP * course.change)
    most = 2 * jnp.sum(jumps, dtype=jnp.int32) > count
    away = before**2 > FAR_AWAY**2 * count.astype(before.dtype)
    returned = norm(now) < NEAR_START * before
    jumped = (t > 5) & (count > 1) & most & away & returned & ~course.ended
    return _Course(
        numbers=now,
        farthest=jnp.maximum(course.farthest, jnp.abs(now - start)),
        change=jnp.maximum(course.change, change),
        ended=course.ended | ends,
        back=jnp.where(jumped & (course.back == 0), t, course.back),
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


def _units_apart(a: jax.Array) -> jax.Array:
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
    h = jnp.arange(a.size, dtype=jnp.uint32).reshape(a.shape) * 40503 + seed
    h = h * jnp.uint32(2654435761)
    h = (h ^ (h >> 15)) * jnp.uint32(2246822519)
    up = (h ^ (h >> 13)) * jnp.uint32(3266489917) >> 31 == 1
    return jnp.nextafter(a, jnp.where(up, jnp.inf, -jnp.inf).astype(a.dtype))
