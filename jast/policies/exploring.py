"""Who explores: all lanes one step further, by the policy or around the model, what is counted on
the way, and what a learner takes from the look before it learns.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.distributions.mixtures import x_of
from jast.heads.heads import Moments
from jast.policies import lanes as L
from jast.policies import start as starts
from jast.policies.actor import Net, act, draw, see
from jast.pytrees import select
from jast.simulator import Simulator

__all__ = ["Count", "Shape", "Training", "first", "look", "move", "nothing", "settle", "tilt"]


class Shape(NamedTuple):
    """Static parts of a training."""

    m: int
    """Numbers seen."""
    n: int
    """Latents of x."""
    n0: int
    """Latents of x0; 0: it is drawn as it is."""
    hidden: tuple
    components: int
    """Of the policy."""
    dense: bool
    """The distance shapes every step's reward, not only the last one's."""
    lanes: int
    batch: int
    capacity: int


class Count(NamedTuple):
    """Of a stretch: int32 counts, and float32 sums over whole, valid episodes."""

    episodes: Any
    steps: Any
    invalid: Any
    whole: Any
    failures: Any
    failing_log_p: Any
    log_p: Any
    gain: Any
    nearest: Any
    """Miss distances, and squares of them."""
    squares: Any
    loss: Any
    updates: Any


class Training(NamedTuple):
    """Where a training stands: all that the rest of it depends on."""

    lanes: L.Lane
    """[lanes] in front."""
    buffer: L.Rows
    """Transitions; () once a learner that keeps none has looked around."""
    stored: Any
    """int32: transitions stored so far."""
    learner: Any
    """What is learned: with ``actor`` and ``log_alpha`` among it."""
    net: Net
    scale: Any
    """float32: lambda."""
    widen: Any
    """float32: deviation of the starts' latents."""
    reach: Any
    """float32: deviation of the drifts."""
    at: Any
    """int32: steps of all lanes so far; the numbers drawn in a step have a key folded from it."""


_SUMS = {"failing_log_p", "log_p", "gain", "nearest", "squares", "loss"}


def nothing() -> Count:
    """A `Count` of no steps."""
    return Count(
        *(jnp.zeros((), jnp.float32 if name in _SUMS else jnp.int32) for name in Count._fields)
    )


def first(key: jax.Array, sim: Simulator, shape: Shape, learner: Any) -> Training:
    """A `Training` of ``learner`` before its first step."""
    z0 = jax.random.normal(key, (shape.lanes, shape.n0), jnp.float32)
    still = jnp.zeros((shape.lanes, shape.n), jnp.float32)
    lanes = jax.vmap(functools.partial(L.begin, sim, shape.dense))(
        jax.random.split(jax.random.clone(key), shape.lanes), z0, still
    )
    net = Net(Moments(*(jnp.asarray(a) for a in Moments.empty(shape.m))), jnp.ones((), jnp.float32))
    zero, one, at = jnp.zeros((), jnp.float32), jnp.ones((), jnp.float32), jnp.zeros((), jnp.int32)
    return Training(
        lanes,
        L.empty(shape.capacity, shape.m, shape.n),
        at,
        learner,
        net,
        scale=one,
        widen=one,
        reach=zero,
        at=at,
    )


def move(
    for_noise: jax.Array,
    for_starts: jax.Array,
    sim: Simulator,
    shape: Shape,
    apply: Callable,
    training: Training,
    acting: jax.Array,
    draw: Callable = draw,
) -> tuple[L.Lane, L.Rows, jax.Array, Count]:
    """One step of all lanes: ``(Lane, Rows, valid, Count)``, each [lanes] but for the last. Those
    that are over begin anew.

    ``acting``: ``draw`` takes the latents from the policy's mixture; else they are a drift of each
    episode's own, and noise.
    """
    k, lanes, net = shape.lanes, training.lanes, training.net
    noise, drift, z0 = _cut(for_noise, ((k, shape.n + 1), (k, shape.n), (k, shape.n0)))

    def choose(lane, e):
        mixture = act(
            apply,
            training.learner.actor,
            see(net, sim.horizon, lane.seen, lane.t, lane.potential),
        )
        return jnp.where(acting, draw(mixture, e), lane.drift + e[:-1])

    moved, new, valid, invalid = jax.vmap(
        lambda lane, e: L.step(sim, shape.dense, lane, choose(lane, e))
    )(lanes, noise)
    again = jax.vmap(functools.partial(L.begin, sim, shape.dense))(
        jax.random.split(for_starts, k), training.widen * z0, training.reach * drift
    )
    whole = moved.over & ~invalid
    number = lambda p: jnp.sum(p, dtype=jnp.int32)
    total = lambda p, a: jnp.sum(jnp.where(p, a, 0))
    count = nothing()._replace(
        episodes=number(moved.over),
        steps=number(~lanes.over),
        invalid=number(invalid),
        whole=number(whole),
        failures=number(moved.failed),
        failing_log_p=total(moved.failed, moved.log_p),
        log_p=total(whole, moved.log_p),
        gain=total(whole, moved.gain),
        nearest=total(whole, moved.nearest),
        squares=total(whole, moved.nearest**2),
    )
    return jax.vmap(select)(moved.over, again, moved), new, valid, count


@functools.partial(jax.jit, static_argnames=("shape", "apply"))
def look(
    key: jax.Array,
    sim: Simulator,
    shape: Shape,
    apply: Callable,
    training: Training,
    steps: int,
) -> tuple[Training, Count]:
    """``steps`` steps of all lanes around the model, kept in the buffer and not learned from."""

    def body(_, carry):
        training, count = carry
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 0), training.at))
        lanes, new, valid, more = move(*keys, sim, shape, apply, training, jnp.asarray(False))
        buffer, stored = L.put(training.buffer, training.stored, new, valid)
        training = training._replace(lanes=lanes, buffer=buffer, stored=stored, at=training.at + 1)
        return training, jax.tree.map(jnp.add, count, more)

    return lax.fori_loop(0, steps, body, (training, nothing()))


def _cut(key: jax.Array, shapes: tuple) -> list[jax.Array]:
    """Standard normal arrays of these shapes, in one draw: each call of a generator is much to
    compile.
    """
    ends, total = [], 0
    for shape in shapes:
        size = functools.reduce(lambda a, b: a * b, shape, 1)
        ends.append((total, total + size, shape))
        total += size
    flat = jax.random.normal(key, (total,), jnp.float32)
    return [flat[a:b].reshape(shape) for a, b, shape in ends]


@jax.jit
def settle(training: Training, horizon: int) -> Training:
    """``training`` with the moments of what was seen so far, and the critics' unit."""
    rows = training.buffer
    stored = (jnp.arange(rows.t.shape[0], dtype=jnp.int32) < training.stored).astype(jnp.float32)
    n = jnp.maximum(jnp.sum(stored), 1)
    average = lambda a: jnp.einsum("n,n...->...", stored, a) / n
    mean = average(rows.seen)
    deviation = jnp.sqrt(average((rows.seen - mean[None]) ** 2))
    # a constant, up to rounding
    deviation = jnp.where(deviation > 1e-6 * jnp.abs(mean), deviation, 0)
    unit = jnp.sqrt(average(rows.approach**2) * horizon)
    return training._replace(net=Net(Moments(n, mean, deviation), jnp.where(unit > 0, unit, 1)))


def tilt(
    key: jax.Array,
    sim: Simulator,
    shape: Shape,
    training: Training,
    bonus: jax.Array,
    value: Callable[[jax.Array], jax.Array],
) -> starts.Tilt:
    """The `Tilt` of the start that is asked for by ``value``, V of what the networks see: p(x0)
    exp(V_true(s0)).

    The shaped return of an episode is its true one and lambda (d(s0) - d(s_T)), so V_true(s0), with
    -lambda d(s_T) at the end, is V(s0) - lambda d(s0).
    """

    def log_value(z0):
        lane = L.at(sim, shape.dense, x_of(sim.start(), z0))
        v = value(see(training.net, sim.horizon, lane.seen, lane.t, lane.potential))
        return (
            jnp.where(lane.over, jnp.where(lane.failed, bonus, 0), v)
            - training.scale * lane.potential
        )

    return starts.fit(key, log_value, shape.n0, wide=training.widen)
