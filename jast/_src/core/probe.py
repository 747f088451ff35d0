"""What `jast.check` judges by: a few short episodes side by side, in one program.

Some are as the model has them and one is undisturbed. Of a system in JAX each has company that
shares its random numbers: it tells what the disturbances do to the state, and what rounding does.
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
from jast._src.core.typing import Array, ArrayTree
from jast._src.runtime._jax import quick
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.pytrees import index_tree, select, select_rows

__all__ = ["Probe", "Resolution", "probe"]

STARTS = 16  # of five paths each: enough for a median over them
HOSTED_STARTS = 8  # of one path each, of a system on the host, where each is dear
STEPS = 500  # of a path at most, as `jast.check` is to take seconds
NOTED_STEPS = 8  # whose numbers are judged, of a system that is not episodic
PLAIN, DRAWN_ANEW, UNIT_OFF, OTHER, WIDE, UNDISTURBED = range(6)
"""The paths of a start: as it is, with one disturbance drawn anew, with the state moved by a unit
of the last place at every step, with all disturbances drawn anew, and with these wider than the
model's. Then the undisturbed episode, from a start of its own."""
PATHS = 5  # of a start
NEVER = np.iinfo(np.int32).max  # a step that none is
WIDTH = 3.0  # of the wide path's draws, in those of the model: rare ends are met then, too
JUMP = 3.0  # a change of so many times the greatest before is a jump
NEAR_START = 0.2  # of the farthest that a state has been: where a jump back ends, at most
FAR_AWAY = 0.5  # likewise where it begins, at least
# These three are root mean squares, and most numbers have to jump. Of 81 systems of this repository
# none does so, 64 episodes each, also with a `JUMP` of 2; cart-poles that reset themselves jump 7
# to 13 times as far as before.


class Resolution(NamedTuple):
    """What paths that share their random numbers say of a system."""

    units: list[Array]
    """Of each float of the state: the median, over the starts, of the units in the last place by
    which a disturbance drawn anew moves it, where it does; where it does in no start, as it is
    mostly rounded away, by which all disturbances drawn anew do; else NaN."""
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
    ended: Array
    """bool: ``is_terminal`` holds at every start."""


class Probe(NamedTuple):
    """Of L episodes, the last one undisturbed, at their first T states."""

    has_mode: bool
    """Whether there is an undisturbed episode."""
    density: Array
    """bool [L, T]: the log density of the disturbance that led there is not finite."""
    state: ArrayTree
    """bool [L, T]: a leaf of the state holds NaN."""
    distance: Array
    """bool [L, T]: the miss distance is not finite."""
    x0: ArrayTree
    """Of the first episode."""
    x: ArrayTree
    """Its first disturbance."""
    judged: ArrayTree
    """A state of it that is evaluated."""
    resolution: Resolution | None
    """None for a system on the host."""


class _Company(NamedTuple):
    """What the paths of one start have shown; d numbers of its state."""

    units: list[jax.Array]
    """[2, ...]: the greatest way of the second and the fourth from the first, for each float of the
    state."""
    distance: jax.Array
    """[5]: the least so far."""
    unmoved: list[jax.Array]
    differ: jax.Array
    numbers: jax.Array
    """[d]: of the wide path now."""
    farthest: jax.Array
    """[d]: that each has been from its start."""
    change: jax.Array
    """[d]: the greatest of each in one step."""
    jump: jax.Array


class _Now(NamedTuple):
    """Where the paths [N] are; ``company`` [S]."""

    t: jax.Array
    states: Any
    done: jax.Array
    flags: tuple[jax.Array, Any, jax.Array]
    """[T, N]: ``density``, ``state`` and ``distance`` of `Probe`, of all paths."""
    x: Any
    """The first disturbances."""
    company: _Company | None


def probe(sim: Simulator) -> Probe:
    """A `Probe`, values of NumPy. Plays 81 short episodes; of a system on the host 9."""
    return jax.device_get(_probe(sim))


@quick
def _probe(sim: Simulator) -> Probe:
    signature, hosted = signature_of(sim), runs_on_host(sim)
    widens = signature.disturbance.closed and not hosted  # where that costs no more
    starts, paths = (HOSTED_STARTS, 1) if hosted else (STARTS, PATHS)
    steps = sim.horizon if sim.episodic else min(sim.horizon, STEPS)
    noted = steps if sim.episodic else min(steps, NOTED_STEPS)
    own = np.append(np.repeat(np.arange(starts, dtype=np.int32), paths), np.int32(starts))
    path = np.append(np.tile(np.arange(paths, dtype=np.int32), starts), np.int32(UNDISTURBED))
    # programs with the default generator take longer to compile
    key_of = partial(jax.random.wrap_key_data, impl=COUNTER)
    key = jax.random.key(0, impl=COUNTER)
    shape = starts + 1, steps + 2, *jax.random.key_data(key).shape
    words = jax.random.bits(key, shape, jnp.uint32)
    seed = words[:, 0, 0]
    when = (seed % max(steps // 2, 1)).astype(jnp.int32)  # a disturbance is drawn anew

    def calm(undisturbed, dist, x):
        """``x``, or the mode of an undisturbed episode."""
        if not signature.has_mode:
            return x
        mode = jax.tree.map(lambda mode, x: jnp.asarray(mode, x.dtype), D.mode(dist), x)
        return select(undisturbed, mode, x)

    def begin(words, undisturbed):
        dist = sim.start()
        x0 = calm(undisturbed, dist, D.sample(dist, key_of(words)))
        return first_state(sim, x0), x0, ~jnp.isfinite(dist.log_prob(x0))

    def step(own, path, t, state):
        again = jnp.where((path == DRAWN_ANEW) & (t == when[own]), 1, 2 + t)
        other = jnp.where(path < OTHER, 0, path).astype(words.dtype)
        key, dist = key_of(words[own, again] ^ other), sim.disturbance(state)
        wide = Wide(jnp.where(path == WIDE, WIDTH, 1.0))
        x = wide.draw(key, dist) if widens else D.sample(dist, key)
        x = calm(path == UNDISTURBED, dist, x)
        after = next_state(sim, state, x)
        if not hosted:
            off = jax.tree.map(partial(_a_unit_off, seed[own] + t.astype(seed.dtype)), after)
            after = select(path == UNIT_OFF, off, after)
        return after, x, ~jnp.isfinite(dist.log_prob(x))

    def look(state):
        """Whether an episode ends there, the miss distance, and which leaves are NaN."""
        event, distance = jnp.zeros((), bool), jnp.zeros(())
        if not sim.episodic:  # such a system is judged at its end, below
            event, distance, *_ = sim.evaluate(state)
        ends = jnp.asarray(event) | jnp.asarray(sim.is_terminal(state))
        return ends, jnp.asarray(distance), jax.tree.map(_any_nan, state)

    def of_starts(tree):
        """[S, 5, ...]: the paths of each start, without the undisturbed episode."""
        return jax.tree.map(lambda a: a[:-1].reshape(starts, paths, *a.shape[1:]), tree)

    def over(done):
        return jnp.any(of_starts(done)[:, :OTHER], axis=1)

    def body(now):
        t = now.t + 1
        after, x, improbable = jax.vmap(step, (0, 0, None, 0))(own, path, now.t, now.states)
        states = select_rows(now.done, now.states, after)
        ends, distance, nan = jax.vmap(look, axis_size=len(own))(states)
        flags = jax.tree.map(
            lambda noted, wrong: noted.at[t].set(wrong & ~now.done, mode="drop"),
            now.flags,
            (improbable, nan, ~jnp.isfinite(distance)),
        )
        company = now.company
        if company is not None:
            seen = of_starts((states, x, distance))
            later = jax.vmap(_follow, (0, 0, 0, 0, 0, None))(company, origins, *seen, t)
            company = select_rows(over(now.done), company, later)
        first_x = select(now.t == 0, x, now.x)
        return _Now(t, states, now.done | ends, flags=flags, x=first_x, company=company)

    def goes_on(now):
        more = (now.t < noted) & ~jnp.all(now.done)
        more = more if hosted else more | ~jnp.all(over(now.done))
        return more & (now.t < steps)

    undisturbed = np.arange(starts + 1) == starts
    of_start = jax.vmap(begin)(words[:, 0], undisturbed)
    states, x0, improbable = index_tree(of_start, own)
    ends, distance, nan = jax.vmap(look, axis_size=len(own))(states)
    flags = jax.tree.map(
        lambda wrong: jnp.zeros((noted + 1, len(own)), bool).at[0].set(wrong),
        (improbable, nan, ~jnp.isfinite(distance)),
    )
    company = None if hosted else jax.vmap(_company)(*of_starts((states, distance)))
    origins = None if hosted else company.numbers
    x = jax.tree.map(lambda s: jnp.zeros((len(own), *s.shape), s.dtype), signature.x)
    now = _Now(jnp.int32(0), states, ends, flags=flags, x=x, company=company)
    last = lax.while_loop(goes_on, body, now)
    density, nan, wrong = last.flags
    if sim.episodic:
        distance = jax.vmap(sim.evaluate, axis_size=len(own))(last.states)[1]
        wrong = wrong.at[-1].set(~jnp.isfinite(distance))
    # a black box has kept what it says of the start
    judged = last.states if sim.episodic or hosted else states
    noted = np.flatnonzero(np.isin(path, (PLAIN, OTHER, UNDISTURBED)))
    flags = jax.tree.map(lambda a: a[:, noted].T, (density, nan, wrong))
    found = Probe(signature.has_mode, *flags, *index_tree((x0, last.x, judged), 0), resolution=None)
    if hosted:
        return found
    company = last.company
    if sim.episodic:
        company = company._replace(distance=of_starts(distance))
    starting = index_tree(of_start[0], np.s_[:-1])
    ended = jnp.all(jax.vmap(sim.is_terminal, axis_size=starts)(starting))
    return found._replace(resolution=_resolution(company, starting, ended))


def _company(states: Any, distance: jax.Array) -> _Company:
    """Of the paths [5, ...] of a start, before the first step."""
    numbers = _numbers(states)
    no, nowhere = jnp.zeros((), bool), jnp.zeros_like(numbers)
    return _Company(
        units=[jnp.zeros_like(a[:2]) for a in _floats(states)],
        distance=jnp.full_like(distance, jnp.inf),
        unmoved=[~no for _ in jax.tree.leaves(states)],
        differ=no,
        numbers=numbers,
        farthest=nowhere,
        change=nowhere,
        jump=jnp.int32(0),
    )


def _follow(
    company: _Company, origin: jax.Array, states: Any, x: Any, distance: jax.Array, t: jax.Array
) -> _Company:
    """One step on: ``states`` [5, ...] are those after step ``t``, ``x`` [5, ...] led there from
    the start, whose numbers are ``origin`` [d].
    """
    moves = company.farthest > 0
    count = jnp.sum(moves, dtype=jnp.int32)
    scale = jnp.where(moves, company.farthest, 1)

    def norm(a):
        return jnp.sqrt(jnp.sum(jnp.where(moves, (a - origin) / scale, 0) ** 2))

    numbers, before = _numbers(states), norm(company.numbers)
    change = jnp.abs(numbers - company.numbers)
    jumps = moves & (change > JUMP * company.change)
    most = 2 * jnp.sum(jumps, dtype=jnp.int32) > count
    away = before**2 > FAR_AWAY**2 * count.astype(before.dtype)
    returned = norm(numbers) < NEAR_START * before
    jumped = (t > 5) & (count > 1) & most & away & returned
    pairs = zip(company.units, _floats(states), strict=True)
    leaves = zip(company.unmoved, jax.tree.leaves(states), strict=True)
    differ = [jnp.any(a[OTHER] != a[PLAIN]) for a in jax.tree.leaves(x)]
    return _Company(
        units=[jnp.maximum(u, _units_apart(a)) for u, a in pairs],
        distance=jnp.minimum(company.distance, distance),
        unmoved=[u & jnp.all(a[OTHER] == a[PLAIN]) for u, a in leaves],
        differ=company.differ | jnp.any(jnp.stack(differ or [False])),
        numbers=numbers,
        farthest=jnp.maximum(company.farthest, jnp.abs(numbers - origin)),
        change=jnp.maximum(company.change, change),
        jump=jnp.where(jumped & (company.jump == 0), t, company.jump),
    )


def _resolution(c: _Company, starts: Any, ended: jax.Array) -> Resolution:
    """By the company of all starts, whose states were ``starts``."""
    gap = c.distance[:, UNIT_OFF] - c.distance[:, PLAIN]
    gap = jnp.where(jnp.isfinite(gap), gap, 0)
    first = jnp.where(jnp.isfinite(c.distance[:, PLAIN]), c.distance[:, PLAIN], 0)
    # words of a random key that the start chooses differ
    unmoved = [
        jnp.all(u) & (a.dtype != jnp.uint32 or jnp.all(a == a[:1]))
        for u, a in zip(c.unmoved, jax.tree.leaves(starts), strict=True)
    ]
    first_jump = jnp.min(jnp.where(c.jump > 0, c.jump, NEVER))
    units = (jnp.nanmedian(jnp.where(u > 0, u, jnp.nan), axis=0) for u in c.units)
    return Resolution(
        units=[jnp.where(jnp.isnan(one), all_, one) for one, all_ in units],
        # a whole unit has the deviation of 12 ** 0.5 roundings
        rounding=jnp.sqrt(jnp.mean(gap**2) / 12),
        spread=jnp.std(first),
        unmoved=unmoved,
        differ=jnp.any(c.differ),
        distance_differs=jnp.any(c.distance[:, OTHER] != c.distance[:, PLAIN]),
        jump=jnp.where(first_jump < NEVER, first_jump, 0),
        ended=ended,
    )


def _any_nan(a: jax.Array) -> jax.Array:
    return jnp.any(jnp.isnan(a)) if jnp.issubdtype(a.dtype, jnp.inexact) else jnp.zeros((), bool)


def _numbers(states: Any) -> jax.Array:
    """[d]: the floats and signed integers of the state of the wide path; words of random keys,
    which have no sign, are no measure of a way.
    """
    of, kinds = jnp.zeros(()).dtype, (jnp.floating, jnp.signedinteger)
    leaves = jax.tree.leaves(states)
    leaves = [a[WIDE] for a in leaves if any(jnp.issubdtype(a.dtype, k) for k in kinds)]
    return jnp.concatenate([jnp.zeros(0, of), *(jnp.ravel(a).astype(of) for a in leaves)])


def _floats(tree: Any) -> list[jax.Array]:
    return [a for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]


def _units_apart(a: jax.Array) -> jax.Array:
    """[2, ...]: how far the second and the fourth path are from the first, in units of the last
    place.
    """
    size = jnp.abs(a[PLAIN : PLAIN + 1])
    unit = jnp.nextafter(size, jnp.full_like(size, jnp.inf)) - size
    units = jnp.abs(a[np.array([DRAWN_ANEW, OTHER])] - a[PLAIN : PLAIN + 1]) / unit
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
