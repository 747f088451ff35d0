"""Episodes that go on from a kept state: a state is a pytree, so that the way there need not be
simulated again.

Runs go on in lanes in lockstep. What a lane draws is either new, also of wider noise and of noise
that persists, or follows a known failing episode and changes it here and there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core import actions
from jast._src.core.episode import Episode
from jast._src.core.signature import ask, signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.transition import Progress, advance, begin, conclude
from jast._src.distributions.flat_rows import unflat
from jast._src.search.lanes import EMPTY_HASH, Played, fold_hash
from jast._src.util.pytrees import count_numbers, select

__all__ = [
    "CHANGES",
    "Follow",
    "Noise",
    "Point",
    "continue_runs",
    "exploring_draws",
    "following_draws",
    "played_runs",
    "start_point",
]

PERSISTING = np.uint32(1 << 31)  # address of what persists in the noise of a run


class Point(NamedTuple):
    """An episode on its way."""

    progress: Progress
    t: jax.Array
    """int32: steps so far."""
    tag: jax.Array
    """uint32: a hash of the disturbances so far."""


class Noise(NamedTuple):
    """How a run draws anew, one a lane."""

    width: jax.Array
    """Of the normal numbers; 1 is the model's."""
    persisting: jax.Array
    """From 0 to below 1: the share of the normal numbers that is the same at every step."""


class Follow(NamedTuple):
    """How a run follows a known episode, one a lane."""

    noise: Noise
    rows: Any
    """[horizon, ...]: the disturbances of that episode, and"""
    x0: Any
    length: jax.Array
    """int32: how many they are; beyond them it draws anew."""
    rate: jax.Array
    """Share of the steps that it changes, by"""
    change: jax.Array
    """int32, one of `CHANGES`."""
    size: jax.Array
    """Of the changes, from 0 to 1."""


CHANGES = "anew", "to the mode", "towards the mode", "a step aside"


def continue_runs(
    sim: Simulator,
    reward: Any,
    keys: jax.Array,
    points: Point,
    until: jax.Array,
    draw: Callable,
    own: Any,
    most: int,
    keep: bool = False,
) -> tuple[Point, jax.Array, Any, Any]:
    """Let every lane go on from its point.

    Args:
        sim: the simulator.
        reward: of whole episodes.
        keys: [N], of the runs.
        points: [N], where each goes on.
        until: [N] int32: the step at which it stops, if not before.
        draw: ``(key, t, own, distribution) -> disturbance``, t an int32 from 0 on.
        own: [N, ...]: what ``draw`` knows of the lane.
        most: of the new steps of any lane; static.
        keep: also return the points on the way; static.

    Returns:
        The `Point` [N] of each end, how many steps are new [N], the new disturbances [most, N, ...]
        and the points after each of them [most, N], or ``()``.
    """
    (n,) = until.shape
    xs = jax.tree.map(lambda s: jnp.zeros((most, n, *s.shape), s.dtype), signature_of(sim).x)
    way = jax.tree.map(lambda a: jnp.zeros((most, *a.shape), a.dtype), points) if keep else ()
    until = jnp.minimum(until, sim.horizon)

    def on(p):
        return ~p.progress.done & (p.t < until)

    def move(key, p, own, on):
        x = draw(key, p.t, own, sim.disturbance(p.progress.state))
        progress = advance(sim, reward, p.progress, x, p.t + 1 >= sim.horizon)
        return x, select(on, Point(progress, p.t + 1, fold_hash(p.tag, x)), p)

    def step(carry):
        i, p, new, xs, way = carry
        live = on(p)
        x, p = jax.vmap(move)(keys, p, own, live)
        xs, way = jax.tree.map(lambda s, v: s.at[i].set(v), (xs, way), (x, p if keep else ()))
        return i + 1, p, new + live.astype(jnp.int32), xs, way

    first = jnp.zeros((), jnp.int32), points, jnp.zeros(n, jnp.int32), xs, way
    _, end, new, xs, way = lax.while_loop(lambda c: jnp.any(on(c[1])) & (c[0] < most), step, first)
    return end, new, xs, way


def start_point(sim: Simulator, reward: Any, x0: Any) -> Point:
    """The `Point` that x0 leads to, before any step."""
    tag = fold_hash(jnp.uint32(EMPTY_HASH), x0)
    return Point(begin(sim, reward, x0), jnp.zeros((), jnp.int32), tag)


def played_runs(
    sim: Simulator, reward: Any, x0: Any, rows: Any, points: Point, end: Point, new: Any, xs: Any
) -> Played:
    """What runs [N] came to: whole episodes, of x0 and the disturbances ``rows`` [N, horizon, ...]
    up to ``points`` and the new ones after them.
    """
    ended = jax.vmap(lambda p: conclude(sim, reward, p, p.done))(end.progress)
    most = jax.tree.leaves(xs)[0].shape[0]
    i = jnp.arange(most, dtype=jnp.int32)[:, None]
    at = jnp.where(i < new[None], points.t[None] + i, sim.horizon)
    lane = jnp.broadcast_to(jnp.arange(new.shape[0], dtype=jnp.int32)[None], at.shape)
    rows = jax.tree.map(lambda a, b: a.at[lane, at].set(b, mode="drop"), rows, xs)
    # the distance of an episodic system is known at its end alone
    known = ended.done | ~jnp.asarray(sim.episodic)
    finite = jnp.isfinite(ended.reward) & ~ended.invalid
    value = jnp.where(finite, ended.reward, -jnp.inf)
    distance = jnp.where(known, ended.distance, jnp.inf)
    episode = Episode(x0, rows, ended.log_prob, distance, ended.failure & finite, end.t, value)
    return Played(episode, ~finite, end.tag)


def exploring_draws(sim: Simulator) -> tuple[Callable, Callable]:
    """``draw`` of `continue_runs` with a `Noise`, and likewise ``draw_start(key, noise, p(x0))``:
    draws of the model, of wider noise where it has quantile functions.
    """
    signature = signature_of(sim)
    step = _fresh if signature.disturbance.quantile else _sampled
    return step, _fresh_start if signature.start.quantile else _sampled_start


def _sampled(key, t, own, dist):
    return D.sample(dist, jax.random.fold_in(key, t + 1))


def _sampled_start(key, own, dist):
    return D.sample(dist, jax.random.fold_in(key, 0))


def _fresh_start(key, own, dist):
    z = own.width * _normal(jax.random.fold_in(key, 0), dist, own.width.dtype)
    return D.from_normal(dist, unflat(z, D.event_like(dist)))


def _fresh(key, t, own, dist):
    dtype = own.width.dtype
    same = _normal(jax.random.fold_in(key, PERSISTING), dist, dtype)
    new = _normal(jax.random.fold_in(key, t + 1), dist, dtype)
    z = own.width * (own.persisting * same + jnp.sqrt(1 - own.persisting**2) * new)
    return D.from_normal(dist, unflat(z, D.event_like(dist)))


def _normal(key, dist, dtype):
    return jax.random.normal(key, (count_numbers(D.event_like(dist)),), dtype)


def following_draws(sim: Simulator) -> tuple[Callable, Callable]:
    """The same two with a `Follow`."""
    signature = signature_of(sim)
    fresh, fresh_start = exploring_draws(sim)
    of_step, of_start = ask(sim, lambda start, state, dist: (_aside(dist), _aside(start)))
    step = _changer(signature.disturbance.mode, of_step)
    start = _changer(signature.start.mode, of_start)

    def draw(key, t, own, dist):
        x = jax.tree.map(lambda a: a[jnp.minimum(t, a.shape[0] - 1)], own.rows)
        anew = fresh(key, t, own.noise, dist)
        changed = step(jax.random.fold_in(key, t + 1), own, x, anew, dist)
        return select(t < own.length, changed, anew)

    def draw_start(key, own, dist):
        anew = fresh_start(key, own.noise, dist)
        return start(jax.random.fold_in(key, 0), own, own.x0, anew, dist)

    return draw, draw_start


def _aside(dist):
    return D.has_quantile(dist) and D.has_cdf(dist)


def _changer(has_mode: bool, aside: bool) -> Callable:
    """``(key, own, x, anew, distribution) -> disturbance``: ``x``, or changed."""

    def change(key, own, x, anew, dist):
        coin, noise = jax.random.split(key)
        dtype = own.size.dtype
        ways = [anew] * len(CHANGES)
        if has_mode:
            ways[1] = D.mode(dist)
            ways[2] = actions.samples().near(x, dist, 1 - own.size)
        if aside:
            z = D.to_normal(dist, x)
            e = unflat(_normal(noise, dist, dtype), D.event_like(dist))
            keep = jnp.sqrt(1 - own.size**2)

            def mixed(z, e):
                return keep.astype(z.dtype) * z + own.size.astype(z.dtype) * e

            ways[3] = D.from_normal(dist, jax.tree.map(mixed, z, e))
        changed = jax.tree.map(
            lambda *each: jnp.stack([a.astype(each[0].dtype) for a in each])[own.change], *ways
        )
        hit = jax.random.uniform(coin, (), dtype) < own.rate
        return select(hit, changed, x)

    return change
