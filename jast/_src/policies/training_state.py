"""The state of a training, one step of all its lanes, by the policy or around the model, and what a
learner takes from the exploration before it learns.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.core.simulator import Simulator
from jast._src.distributions.flat_rows import split
from jast._src.distributions.mixtures import x_of
from jast._src.heads.heads import Moments
from jast._src.policies.actor import Normalisation, latent_mixture, network_inputs, sample_latents
from jast._src.policies.lanes import Lane, Transitions, begin_lane, lane_at, step_lane
from jast._src.policies.start_fit import Tilt, fit_tilt
from jast._src.util.pytrees import count_numbers, select_rows

__all__ = [
    "Config",
    "Totals",
    "TrainingState",
    "begin_training",
    "explore",
    "fit_normalisation",
    "fit_start",
    "init_training",
    "learning_rate_left",
    "repeat",
    "step_lanes",
]

LAST_RATE = 0.05  # fraction of the learning rate that is left at the end; a convention


class Config(NamedTuple):
    """The static part of a training."""

    m: int
    """Numbers observed."""
    n: int
    """Latents of x."""
    n0: int
    """Latents of x0; 0: it is drawn from its own distribution."""
    lanes: int
    """Episodes side by side."""
    capacity: int
    """Transitions of the buffer."""
    hidden: tuple[int, ...] = ()
    """Widths of the networks' layers."""
    components: int = 1
    """Of the policy."""
    dense_reward: bool = False
    """The distance shapes every step's reward, not only the last one's."""
    batch: int = 0
    """Transitions of an update."""


class Totals(NamedTuple):
    """Sums over steps of all lanes: int32 counts, and float32 sums over valid episodes that ended.

    The default of each is 0.
    """

    episodes: jax.Array
    """Episodes that ended."""
    steps: jax.Array
    """Of the simulator."""
    invalid: jax.Array
    """Transitions with a number that was not finite."""
    valid: jax.Array
    """Valid episodes that ended."""
    failures: jax.Array
    """Failing episodes."""
    failing_log_p: jax.Array
    """Of log p over the failing episodes."""
    log_p: jax.Array
    gain: jax.Array
    nearest: jax.Array
    """Of miss distances."""
    squares: jax.Array
    """Of their squares."""
    loss: jax.Array
    """Of the critics, over the updates."""
    updates: jax.Array
    """Of the networks."""

    @classmethod
    def zero(cls) -> "Totals":
        """Those of no steps."""
        sums = {"failing_log_p", "log_p", "gain", "nearest", "squares", "loss"}
        return cls(
            *(jnp.zeros((), jnp.float32 if name in sums else jnp.int32) for name in cls._fields)
        )


class TrainingState(NamedTuple):
    """Where a training stands: all that the rest of it depends on."""

    lanes: Lane
    """[lanes] in front."""
    buffer: Transitions | tuple[()]
    """A ring buffer; () after the exploration where a learner keeps none."""
    stored: jax.Array
    """int32: transitions stored so far."""
    learner: Any
    """What is learned: with ``actor`` and ``log_alpha`` among it."""
    normalisation: Normalisation
    scale: jax.Array
    """float32: lambda."""
    widen: jax.Array
    """float32: deviation of the starts' latents."""
    reach: jax.Array
    """float32: deviation of the drifts."""
    step: jax.Array
    """int32: steps of all lanes so far; the random key of a step is folded from it."""


def begin_training(key: jax.Array, sim: Simulator, config: Config, learner: Any) -> TrainingState:
    """The `TrainingState` of ``learner`` before its first step."""
    z0 = jax.random.normal(key, (config.lanes, config.n0), jnp.float32)
    no_drift = jnp.zeros((config.lanes, config.n), jnp.float32)
    lanes = jax.vmap(functools.partial(begin_lane, sim, config.dense_reward))(
        jax.random.split(jax.random.clone(key), config.lanes), z0, no_drift
    )
    one, moments = jnp.ones((), jnp.float32), Moments.empty(config.m)
    return TrainingState(
        lanes=lanes,
        buffer=Transitions.empty(config.capacity, config.m, config.n),
        stored=jnp.zeros((), jnp.int32),
        learner=learner,
        normalisation=Normalisation(Moments(*map(jnp.asarray, moments)), one),
        scale=one,
        widen=one,
        reach=jnp.zeros((), jnp.float32),
        step=jnp.zeros((), jnp.int32),
    )


@functools.partial(jax.jit, static_argnames=("config", "init_learner"))
def init_training(
    key: jax.Array, sim: Simulator, config: Config, init_learner: Callable, alpha: jax.Array
) -> TrainingState:
    """The `TrainingState` before the first step of a learner of networks."""
    for_lanes, for_networks = jax.random.split(key)
    sizes = config.m, config.n, config.hidden, config.components
    return begin_training(for_lanes, sim, config, init_learner(for_networks, *sizes, alpha))


def repeat(
    step: Callable[[TrainingState], tuple[TrainingState, Totals]],
    training: TrainingState,
    times: int | jax.Array,
) -> tuple[TrainingState, Totals]:
    """The state after so many ``times`` of ``step``, and the sums of their `Totals`."""

    def body(_, carry):
        training, totals = carry
        training, more = step(training)
        return training, jax.tree.map(jnp.add, totals, more)

    return lax.fori_loop(0, times, body, (training, Totals.zero()))


def learning_rate_left(training: TrainingState, total: jax.Array) -> jax.Array:
    """The fraction of the learning rate after ``training.step`` of ``total`` steps."""
    return jnp.clip(1 - training.step.astype(jnp.float32) / total, LAST_RATE, 1)


def step_lanes(
    for_noise: jax.Array,
    for_starts: jax.Array,
    sim: Simulator,
    config: Config,
    apply: Callable,
    training: TrainingState,
    acting: bool | jax.Array,
    sample: Callable[..., jax.Array] = sample_latents,
) -> tuple[Lane, Transitions, jax.Array, Totals]:
    """One step of all lanes: ``(Lane, Transitions, valid, Totals)``, each [lanes] but for the last.
    Those that are over begin anew.

    ``acting``: ``sample`` draws the latents from the policy's mixture; else they are a drift of
    each episode's own, and noise.
    """
    k, n, lanes = config.lanes, config.n, training.lanes
    noise, drift, z0 = _normals(for_noise, (k, n + 1), (k, n), (k, config.n0))

    def step(lane, noise):
        mixture = latent_mixture(apply, training.learner.actor, _inputs(training, sim, lane))
        z = jnp.where(acting, sample(mixture, noise), lane.drift + noise[:-1])
        return step_lane(sim, config.dense_reward, lane, z)

    moved, new, valid, invalid = jax.vmap(step)(lanes, noise)
    again = jax.vmap(functools.partial(begin_lane, sim, config.dense_reward))(
        jax.random.split(for_starts, k), training.widen * z0, training.reach * drift
    )
    ended = moved.over & ~invalid

    def count(flags):
        return jnp.sum(flags, dtype=jnp.int32)

    def total(flags, values):
        return jnp.sum(jnp.where(flags, values, 0))

    totals = Totals.zero()._replace(
        episodes=count(moved.over),
        steps=count(~lanes.over),
        invalid=count(invalid),
        valid=count(ended),
        failures=count(moved.failed),
        failing_log_p=total(moved.failed, moved.log_p),
        log_p=total(ended, moved.log_p),
        gain=total(ended, moved.gain),
        nearest=total(ended, moved.nearest),
        squares=total(ended, moved.nearest**2),
    )
    return select_rows(moved.over, again, moved), new, valid, totals


@functools.partial(jax.jit, static_argnames=("config", "apply"))
def explore(
    key: jax.Array,
    sim: Simulator,
    config: Config,
    apply: Callable,
    training: TrainingState,
    steps: int,
) -> tuple[TrainingState, Totals]:
    """``steps`` steps of all lanes around the model, kept in the buffer and not learned from."""

    def step(training):
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, 0), training.step))
        lanes, new, valid, totals = step_lanes(*keys, sim, config, apply, training, False)
        buffer, stored = training.buffer.put(training.stored, new, valid)
        return training._replace(
            lanes=lanes, buffer=buffer, stored=stored, step=training.step + 1
        ), totals

    return repeat(step, training, steps)


def _inputs(training: TrainingState, sim: Simulator, lane: Lane) -> jax.Array:
    """What the networks see of a lane."""
    seen = lane.observation, lane.t, lane.potential
    return network_inputs(training.normalisation, sim.horizon, *seen)


def _normals(key: jax.Array, *shapes: tuple[int, ...]) -> list[jax.Array]:
    """Standard normal arrays of these shapes, by one call of the generator: each takes long to
    compile.
    """
    like = [jax.ShapeDtypeStruct(s, jnp.float32) for s in shapes]
    return split(jax.random.normal(key, (count_numbers(like),), jnp.float32), like)


@jax.jit
def fit_normalisation(training: TrainingState, horizon: int) -> TrainingState:
    """``training`` with the moments of what was observed so far, and the critics' unit."""
    rows = training.buffer
    stored = (jnp.arange(rows.t.shape[0], dtype=jnp.int32) < training.stored).astype(jnp.float32)
    n = jnp.maximum(jnp.sum(stored), 1)

    def average(a: jax.Array) -> jax.Array:
        return jnp.einsum("n,n...->...", stored, a) / n

    mean = average(rows.observation)
    deviation = jnp.sqrt(average((rows.observation - mean[None]) ** 2))
    # a number that is constant up to rounding does not vary
    deviation = jnp.where(deviation > 1e-6 * jnp.abs(mean), deviation, 0)
    unit = jnp.sqrt(average(rows.approach**2) * horizon)
    return training._replace(
        normalisation=Normalisation(Moments(n, mean, deviation), jnp.where(unit > 0, unit, 1))
    )


@functools.partial(jax.jit, static_argnames=("config", "value"))
def fit_start(
    key: jax.Array,
    sim: Simulator,
    config: Config,
    training: TrainingState,
    bonus: float | jax.Array,
    value: Callable[..., jax.Array],
) -> Tilt:
    """The `Tilt` of the start by ``value(key, training, inputs)``, V of the networks' inputs: p(x0)
    exp(V_true(s0)).

    The shaped return of an episode is its true one and lambda (d(s0) - d(s_T)), so V_true(s0), with
    -lambda d(s_T) at the end, is V(s0) - lambda d(s0).
    """
    for_value, for_fit = jax.random.split(key)

    def log_value(z0):
        lane = lane_at(sim, config.dense_reward, x_of(sim.start(), z0))
        v = value(for_value, training, _inputs(training, sim, lane))
        ended = jnp.where(lane.failed, bonus, 0)
        return jnp.where(lane.over, ended, v) - training.scale * lane.potential

    return fit_tilt(for_fit, log_value, config.n0, width=training.widen)
