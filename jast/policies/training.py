"""The training of a failure policy as one compiled program: steps of all lanes, and after each,
once enough was seen, an update of the networks.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast.distributions.mixtures import x_of
from jast.heads.heads import Moments
from jast.policies import lanes as L
from jast.policies import start as starts
from jast.policies.learner import Learner, Net, act, draw, learner, see, soft_value, update
from jast.pytrees import select

__all__ = ["stretch"]

VALUE_DRAWS = 16


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


class Phase(NamedTuple):
    """How a stretch goes; traced."""

    updates: Any
    """int32: of the networks, after each step of all lanes."""
    acts: Any
    """int32: from this step on the policy acts and learns. Before, the latents are a drift of each
    episode's own, and noise, and the critics learn alone: else their first guesses would drive all
    components of the policy the same way.
    """
    total: Any
    """Steps of all stretches together, over which the learning rate falls."""


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
    stored: Any
    """int32: transitions stored so far."""
    learner: Learner
    net: Net
    scale: Any
    """float32: lambda."""
    widen: Any
    """float32: deviation of the starts' latents."""
    reach: Any
    """float32: deviation of the drifts."""
    at: Any
    """int32: steps of all lanes so far; the numbers drawn in a step have a key folded from it."""


@functools.partial(jax.jit, static_argnames="shape")
def first(key, sim, shape, alpha):
    """A `Training` before its first step."""
    for_lanes, for_networks = jax.random.split(key)
    z0 = jax.random.normal(for_lanes, (shape.lanes, shape.n0), jnp.float32)
    still = jnp.zeros((shape.lanes, shape.n), jnp.float32)
    lanes = jax.vmap(functools.partial(L.begin, sim, shape.dense))(
        jax.random.split(jax.random.clone(for_lanes), shape.lanes), z0, still
    )
    net = Net(Moments(*(jnp.asarray(a) for a in Moments.empty(shape.m))), jnp.ones((), jnp.float32))
    new = learner(for_networks, shape.m, shape.n, shape.hidden, shape.components, alpha)
    zero, one, at = jnp.zeros((), jnp.float32), jnp.ones((), jnp.float32), jnp.zeros((), jnp.int32)
    return Training(
        lanes,
        L.empty(shape.capacity, shape.m, shape.n),
        at,
        new,
        net,
        scale=one,
        widen=one,
        reach=zero,
        at=at,
    )


@functools.partial(jax.jit, static_argnames=("shape", "applies"))
def stretch(key, sim, shape, applies, rates, training, phase, steps):
    """``steps`` steps of all lanes: ``(Training, Count)``."""
    nothing = Count(
        *(jnp.zeros((), jnp.float32 if name in _SUMS else jnp.int32) for name in Count._fields)
    )

    def body(_, carry):
        training, count = carry
        training, more = _step(key, sim, shape, applies, rates, training, phase)
        return training, jax.tree.map(jnp.add, count, more)

    return lax.fori_loop(0, steps, body, (training, nothing))


_SUMS = {"failing_log_p", "log_p", "gain", "nearest", "squares", "loss"}


def _step(key, sim, shape, applies, rates, training, phase):
    k, lanes, net = shape.lanes, training.lanes, training.net
    for_noise, for_updates, for_starts = jax.random.split(jax.random.fold_in(key, training.at), 3)
    acting = training.at >= phase.acts
    noise, drift, z0 = _cut(for_noise, ((k, shape.n + 1), (k, shape.n), (k, shape.n0)))

    def choose(lane, e):
        mixture = act(
            applies[0],
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
    buffer, stored = L.put(training.buffer, training.stored, new, valid)
    updates = jnp.where(stored > 0, phase.updates, 0)
    left = jnp.clip(1 - training.at.astype(jnp.float32) / phase.total, 0.05, 1)
    slower = rates._replace(learning_rate=rates.learning_rate * left)

    def learn(i, carry):
        for_noise, for_rows = jax.random.split(jax.random.fold_in(for_updates, i))
        # of the stored ones all alike; the remainder favours none by more than 2^-15
        at = jax.random.bits(for_rows, (shape.batch,), jnp.uint32) % jnp.clip(
            stored, 1, shape.capacity
        ).astype(jnp.uint32)
        rows = jax.tree.map(lambda a: a[at.astype(jnp.int32)], buffer)
        noise = jax.random.normal(for_noise, (2, shape.batch, shape.n), jnp.float32)
        new, loss = update(
            noise,
            carry[0],
            applies,
            net,
            slower,
            acting.astype(jnp.float32),
            training.scale,
            rows,
            sim.horizon,
        )
        return new, carry[1] + loss

    new_learner, loss = lax.fori_loop(
        0, updates, learn, (training.learner, jnp.zeros((), jnp.float32))
    )
    whole = moved.over & ~invalid
    number = lambda p: jnp.sum(p, dtype=jnp.int32)
    total = lambda p, a: jnp.sum(jnp.where(p, a, 0))
    count = Count(
        number(moved.over),
        number(~lanes.over),
        number(invalid),
        number(whole),
        number(moved.failed),
        total(moved.failed, moved.log_p),
        total(whole, moved.log_p),
        total(whole, moved.gain),
        total(whole, moved.nearest),
        total(whole, moved.nearest**2),
        loss,
        updates,
    )
    lanes = jax.vmap(select)(moved.over, again, moved)
    return (
        training._replace(
            lanes=lanes, buffer=buffer, stored=stored, learner=new_learner, at=training.at + 1
        ),
        count,
    )


def _cut(key, shapes):
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
def settle(training, horizon):
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


@functools.partial(jax.jit, static_argnames=("shape", "applies"))
def tilt(key, sim, shape, applies, training, bonus):
    """The `Tilt` of the start that the critics ask for: p(x0) exp(V_true(s0)).

    The shaped return of an episode is its true one and lambda (d(s0) - d(s_T)), so V_true(s0), with
    -lambda d(s_T) at the end, is V(s0) - lambda d(s0).
    """
    for_draws, for_fit = jax.random.split(key)
    noise = jax.random.normal(for_draws, (VALUE_DRAWS, shape.n), jnp.float32)

    def log_value(z0):
        lane = L.at(sim, shape.dense, x_of(sim.start(), z0))
        inputs = see(training.net, sim.horizon, lane.seen, lane.t, lane.potential)
        v = soft_value(applies, training.net.unit * training.scale, training.learner, inputs, noise)
        return (
            jnp.where(lane.over, jnp.where(lane.failed, bonus, 0), v)
            - training.scale * lane.potential
        )

    return starts.fit(for_fit, log_value, shape.n0, wide=training.widen)
