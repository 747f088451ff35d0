"""Episodes: one run of a simulated system, from its start to a failure, an end or the horizon.

`begin`, `advance` and `conclude` are the meaning of an episode, once, for every rollout, replay and
search of the package.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast import distributions as D
from jast import results, rewards
from jast._jax import is_traced
from jast.policy import nominal_policy

__all__ = [
    "Episode",
    "Progress",
    "accumulator",
    "advance",
    "begin",
    "blank",
    "conclude",
    "play_back",
    "random_start",
    "replay",
    "rollout",
]


@results.shown()
class Episode(NamedTuple):
    """One episode, or many along leading axes. Rows from ``length`` on are zero and mean
    nothing.
    """

    x0: Any
    """Initial disturbance, ``()`` for a system with one start."""
    disturbances: Any
    """[horizon, ...]: x_1 .. x_length in the first rows."""
    log_prob: jax.Array
    """True log density of x0 and the ``length`` steps: never normalised."""
    distance: jax.Array
    """Miss distance: the least, or the last one of an episodic system; inf where the simulator
    returned a number that is not finite.
    """
    failure: jax.Array
    """bool: ended in a failure event."""
    length: jax.Array
    """int32: steps taken, 0 .. horizon."""
    reward: jax.Array
    """Sum of the reward over the episode; -inf where the simulator returned a number that is not
    finite.
    """
    states: Any = None
    """[horizon + 1, ...]: s_0 .. s_length in the first rows, or None where they were not kept."""


class Progress(NamedTuple):
    """An episode so far, at a state."""

    state: Any
    log_prob: jax.Array
    reward: jax.Array
    distance: jax.Array
    failure: jax.Array
    done: jax.Array
    invalid: jax.Array
    """The simulator, the density or the reward returned NaN, or an infinity that has no meaning:
    the episode ended there.
    """
    owed: Any = ()
    """Of an episodic system: the log p of the arrival at its end, which the reward has not seen
    before `conclude`; 0 before the end. Else ``()``.
    """


def accumulator(sim):
    """The float dtype in which an episode's numbers are summed: the widest of its log densities and
    its distance.
    """

    def numbers():
        x0 = D.sample(sim.start(), jax.random.key(0))
        state = sim.init(x0)
        dist = sim.disturbance(state)
        return (
            sim.start().log_prob(x0),
            dist.log_prob(D.sample(dist, jax.random.key(0))),
            sim.evaluate(state)[1],
        )

    return jnp.result_type(*(jnp.zeros((), a.dtype) for a in jax.eval_shape(numbers)[1:]))


def random_start(sim):
    """Whether x0 is a choice: ``start`` is not `fixed`."""
    return bool(jax.tree.leaves(jax.eval_shape(lambda: D.sample(sim.start(), jax.random.key(0)))))


def blank(sim, state):
    """The `Progress` at ``state``, with nothing behind it."""
    zero, no = jnp.zeros((), accumulator(sim)), jnp.zeros((), bool)
    return Progress(state, zero, zero, zero + jnp.inf, no, no, no, zero if sim.episodic else ())


def begin(sim, reward, x0, last=False):
    """The `Progress` at s0, which x0 leads to; a failure there is an episode of length 0. ``last``:
    the episode is to end here.
    """
    start = sim.start()
    state = _strong(sim.init(x0))
    log_p = (D.log_density(start, x0, density) for density in ("raw", rewards.density_of(reward)))
    return _arrive(
        sim, reward, blank(sim, state), state, log_p, jnp.asarray(last), lambda d: jnp.zeros_like(d)
    )


def advance(sim, reward, progress, x, last):
    """The `Progress` one step on, by disturbance ``x``; ``last``: the horizon is reached by it.
    Meaningless once ``progress.done``.
    """
    dist = sim.disturbance(progress.state)
    log_p = (D.log_density(dist, x, density) for density in ("raw", rewards.density_of(reward)))
    state = _strong(sim.step(progress.state, x))
    return _arrive(
        sim, reward, progress, state, log_p, last, lambda d: sim.evaluate(progress.state)[1] - d
    )


def conclude(sim, reward, progress, live=True):
    """The `Progress` with the outcome of an episodic system, whose episode is ``done``; that of any
    other system stays as it is.

    Here such a system is evaluated. Where not ``live`` it is shown a state of zeros, and the
    `Progress` stays as it is.
    """
    if not sim.episodic:
        return progress
    live = jnp.asarray(live) & progress.done & ~progress.invalid
    event, own = sim.evaluate(
        jax.tree.map(lambda a: jnp.where(live, a, jnp.zeros((), a.dtype)), progress.state)
    )
    event, own = jnp.asarray(event), jnp.asarray(own).astype(progress.reward.dtype)
    total = _paid(reward, progress.reward, progress.owed, event, own, jnp.ones((), bool), -own)
    invalid = ~jnp.isfinite(own) | jnp.isnan(total) | (total == jnp.inf)
    new = dict(owed=jnp.zeros_like(progress.owed)) | _outcome(
        total, own, event, jnp.ones((), bool), invalid
    )
    return progress._replace(
        **{name: jnp.where(live, value, getattr(progress, name)) for name, value in new.items()}
    )


def _arrive(sim, reward, before, state, log_p, last, approach):
    dtype = before.reward.dtype
    log_prob, counted = (jnp.asarray(p).astype(dtype) for p in log_p)
    ends = jnp.asarray(sim.is_terminal(state)) | last
    invalid = jnp.isnan(log_prob) | (log_prob == jnp.inf)
    if sim.episodic:  # evaluated at its end, by `conclude`
        none = jnp.zeros((), dtype)
        total, owed = (
            jnp.where(
                ends, before.reward, _paid(reward, before.reward, counted, False, none, False, none)
            ),
            jnp.where(ends, counted, 0),
        )
        event, distance, done = jnp.zeros((), bool), before.distance, ends
    else:
        event, own = sim.evaluate(state)
        event, own = jnp.asarray(event), jnp.asarray(own).astype(dtype)
        # the order at a state: failure, then is_terminal, then the horizon
        done, distance, owed = event | ends, jnp.minimum(before.distance, own), ()
        total = _paid(
            reward, before.reward, counted, event, distance, done, approach(own).astype(dtype)
        )
        invalid |= ~jnp.isfinite(own)
    invalid |= jnp.isnan(total) | (total == jnp.inf)
    return Progress(
        state,
        before.log_prob + log_prob,
        owed=owed,
        **_outcome(total, distance, event, done, invalid),
    )


def _paid(reward, total, log_p, event, distance, terminal, approach):
    """The episode's reward, ``total`` before, after one more arrival."""
    event, terminal = jnp.asarray(event), jnp.asarray(terminal)
    if rewards.once(reward):  # it is paid for the whole episode, at its end
        total = total + log_p
        return jnp.where(
            terminal,
            jnp.asarray(reward(total, event, distance, terminal, approach)).astype(total.dtype),
            total,
        )
    return total + jnp.asarray(reward(log_p, event, distance, terminal, approach)).astype(
        total.dtype
    )


def _outcome(reward, distance, failure, done, invalid):
    reward, distance = jnp.where(invalid, -jnp.inf, reward), jnp.where(invalid, jnp.inf, distance)
    return dict(
        reward=reward,
        distance=distance,
        failure=failure & ~invalid,
        done=done | invalid,
        invalid=invalid,
    )


def rollout(key, sim, policy=None, reward=rewards.STANDARD):
    """Simulate one episode: `Episode`. ``jax.vmap`` over keys, simulators or policies gives many;
    differentiable in the simulator's and policy's parameters.

    ``policy`` chooses the disturbances (default: the simulator's own model, the nominal system),
    ``reward`` scores them. The key is consumed. An episode in which the simulator returns NaN has
    no failure, distance inf and reward -inf. Its `replay` is the same to the bit; inside a
    transformation, where drawing and stepping are one program, up to rounding.
    """
    reward = rewards.as_pytree(reward)
    episode = _rollout(key, sim, policy, reward)
    if is_traced(episode):
        return episode
    # a draw that is fused into the step is not rounded to what is recorded (a multiply-add), so the
    # recording is played
    return play_back(sim, reward, episode.x0, episode.disturbances, episode.length)


@jax.jit
def _rollout(key, sim, policy, reward):
    policy = nominal_policy(sim) if policy is None else policy
    keys = jax.random.split(key, sim.horizon + 1)
    x0 = D.sample(policy.start(), keys[0])

    return _play(
        sim,
        reward,
        x0,
        lambda state, t, key: D.sample(policy.disturbance(state, t), key),
        keys[1:],
        sim.horizon,
    )


def replay(sim, episode, x0=None, reward=rewards.STANDARD):
    """Run recorded disturbances again: `Episode` with its states. Exact: the same input gives the
    same bits.

    ``episode`` is an `Episode`, or its disturbances [T, ...] with T <= horizon (a pytree where x is
    one) and, for a system with a random start, ``x0``. An episode that neither failed nor ended by
    then ends there. Raises ValueError where the disturbances do not fit the simulator.
    """
    length = None
    if isinstance(episode, Episode):
        disturbances, x0, length = episode.disturbances, episode.x0, episode.length
    else:
        disturbances = episode
    like_x0, like = jax.eval_shape(_shapes, sim)
    x0 = like_x0 if x0 is None and not jax.tree.leaves(like_x0) else x0
    x0 = _fitted("x0", x0, like_x0)
    rows = {jnp.shape(leaf)[0] if jnp.ndim(leaf) else -1 for leaf in jax.tree.leaves(disturbances)}
    if len(rows) != 1 or not 0 <= (steps := rows.pop()) <= sim.horizon:
        raise ValueError(
            f"replay: disturbances must have between 0 and {sim.horizon} rows (the horizon),"
            f" received {jax.tree.map(jnp.shape, disturbances)}"
        )
    disturbances = _fitted(
        "disturbances",
        disturbances,
        jax.tree.map(lambda s: jax.ShapeDtypeStruct((steps, *s.shape), s.dtype), like),
    )
    steps = jnp.asarray(steps if length is None else length, jnp.int32)
    return play_back(sim, rewards.as_pytree(reward), x0, _pad(disturbances, sim.horizon), steps)


@jax.jit
def play_back(sim, reward, x0, disturbances, steps):
    """`replay` without its checks: ``disturbances`` [horizon, ...], of which at most ``steps`` rows
    are played; may be vmapped.
    """
    return _play(sim, reward, x0, lambda state, t, x: x, disturbances, steps)


def _play(sim, reward, x0, choose, rows, steps):
    """The episode of at most ``steps`` steps in which ``choose(state, t, rows[t])`` gives the
    disturbances.
    """
    first = begin(sim, reward, x0, last=steps <= 0)

    def body(before, at):
        t, row = at
        # an ended lane goes on from the start state, so that no NaN reaches a gradient
        safe = before._replace(state=_select(before.done, first.state, before.state))
        x = choose(safe.state, t, row)
        after = advance(sim, reward, safe, x, t + 1 >= steps)
        kept = _select(before.done, before, after)
        return kept, (_clear(before.done, x), _clear(before.done, after.state), ~before.done)

    last, (disturbances, states, live) = lax.scan(
        body, first, (jnp.arange(sim.horizon, dtype=jnp.int32), rows)
    )
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first.state, states)
    length, last = jnp.sum(live, dtype=jnp.int32), conclude(sim, reward, last)
    return Episode(
        x0, disturbances, last.log_prob, last.distance, last.failure, length, last.reward, states
    )


def _shapes(sim):
    """A value of x0 and of x, for their shapes and dtypes."""
    key = jax.random.key(0)
    x0 = D.sample(sim.start(), key)
    return x0, D.sample(sim.disturbance(_strong(sim.init(x0))), key)


def _fitted(name, value, like):
    """``value`` as arrays of the shapes and dtypes of ``like``, or a ValueError."""
    if jax.tree.structure(value) != jax.tree.structure(like):
        raise ValueError(f"replay: {name} must be {_text(like)}, received {_text(value)}")

    def fit(v, s):
        v = jnp.asarray(v)
        kinds = [jnp.issubdtype(d, jnp.floating) for d in (v.dtype, s.dtype)]
        if v.shape != s.shape or (kinds[0] and not kinds[1]):
            raise ValueError(f"replay: {name} must be {_text(like)}, received {_text(value)}")
        return v.astype(s.dtype)

    return jax.tree.map(fit, value, like)


def _pad(rows, horizon):
    return jax.tree.map(
        lambda a: jnp.zeros((horizon, *a.shape[1:]), a.dtype).at[: a.shape[0]].set(a), rows
    )


def _text(tree):
    return str(jax.tree.map(lambda a: f"{jnp.result_type(a)}{list(jnp.shape(a))}", tree))


def _strong(tree):
    """Arrays of explicit dtype: a weak type would change on its way through a step."""
    return jax.tree.map(lambda a: lax.convert_element_type(a, jnp.result_type(a)), tree)


def _select(pred, a, b):
    return jax.tree.map(lambda x, y: jnp.where(pred, x, y), a, b)


def _clear(pred, tree):
    return jax.tree.map(lambda a: jnp.where(pred, jnp.zeros((), a.dtype), a), tree)
