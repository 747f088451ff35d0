"""The states of a black box, records of its disturbances, and the functions of a simulator on them:
only an outcome asks the host.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.contract import OBSERVED
from jast._src.core.typing import Array, ArrayTree
from jast._src.runtime._jax import host_call
from jast._src.util.pytrees import select

__all__ = [
    "Record",
    "Standing",
    "blank",
    "extend",
    "judge",
    "judge_with_log_p",
    "observe",
    "outcome",
    "outcome_and_log_p",
    "transition",
    "with_outcome",
]


class Record(NamedTuple):
    """State of an episodic black box.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> run = lambda x: (bool(x.sum() > 5.0), float(max(5.0 - x.sum(), 0.0)))
        >>> sim = jast.blackbox.from_python(run, horizon=10, disturbance=D.Normal(0.0, 1.0))
        >>> state = sim.step(sim.init(()), jnp.array(2.0))
        >>> int(state.t), state.disturbances[:2].tolist()
        (1, [2.0, 0.0])
    """

    begun: Array
    """bool: True in every state of an episode; the system is not run on a state of zeros."""
    t: Array
    """int32: disturbances so far."""
    x0: ArrayTree
    disturbances: ArrayTree
    """[horizon, ...]: the first t rows; zeros after them."""


class Standing(NamedTuple):
    """State of a black box that is looked at after every disturbance.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> class Tank:
        ...     def initialize(self):
        ...         self.level = 5.0
        ...
        ...     def transition(self, x):
        ...         self.level += float(x)
        ...
        ...     def miss_distance(self):
        ...         return max(self.level, 0.0)
        ...
        ...     def is_event(self):
        ...         return self.level <= 0.0
        >>> sim = jast.blackbox.from_python(Tank, horizon=10, disturbance=D.Normal(0.0, 1.0))
        >>> float(jast.replay(sim, jnp.array([-2.0, 1.0])).states.distance[1])  # after one step
        3.0
    """

    begun: Array
    t: Array
    x0: ArrayTree
    disturbances: ArrayTree
    event: Array
    """bool."""
    distance: Array
    """float: miss distance; NaN where something went wrong."""
    terminal: Array
    """bool: ended without a failure, or by an incident."""
    log_p: Array
    """float: log p of the last disturbance as the object says it; 0 where it says nothing."""
    seen: Array
    """[k] float: what the object's ``observe`` returned; empty where it has none."""


def blank(episodic, horizon, like0, size, like):
    """A state of zeros; ``like0``, ``like``: shapes and dtypes of x0 and x."""
    no, zero = jnp.zeros((), bool), jnp.zeros(())
    record = Record(
        begun=no,
        t=jnp.zeros((), jnp.int32),
        x0=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), like0),
        disturbances=jax.tree.map(lambda s: jnp.zeros((horizon, *s.shape), s.dtype), like),
    )
    if episodic:
        return record
    seen = jnp.zeros((size,))
    return Standing(*record, event=no, distance=zero, terminal=no, log_p=zero, seen=seen)


def judge(host, state):
    """Event and distance of an episode; NaN before its end. A state of zeros is not asked for."""
    return judge_with_log_p(host, state)[:2]


def judge_with_log_p(host, state):
    """`judge`, and log p as the system says it."""
    live = state.begun & (state.t == host.spec.horizon)
    event, distance, _, log_p, _ = _ask(host, 0, live, state.t, state.x0, state.disturbances)
    return event, jnp.where(live | ~state.begun, distance, jnp.nan), log_p


def extend(state, x):
    rows = jax.tree.map(
        lambda a, v: a.at[state.t].set(jnp.asarray(v, a.dtype)), state.disturbances, x
    )
    return state._replace(t=state.t + 1, disturbances=rows)


def transition(host, state, x):
    """An ended state, and one of zeros, stays as it is and is not asked for."""
    over = ~state.begun | state.event | state.terminal | (state.t >= host.spec.horizon)
    after = with_outcome(host, extend(state, x), ~over)
    return select(over, state, after)


def with_outcome(host, state, live=True):
    """``state`` with its outcome."""
    size, live = state.seen.shape[0], state.begun & live
    found = _ask(host, size, live, state.t, state.x0, state.disturbances)
    return Standing(*state[: -len(found)], *found)


def outcome(state):
    return state.event, state.distance


def outcome_and_log_p(state):
    return state.event, state.distance, state.log_p


def observe(state):
    if isinstance(state, Standing) and state.seen.shape[0]:
        return state.seen
    rows = jax.tree.leaves(state.disturbances)
    dtype = jnp.zeros(()).dtype

    def numbers(a):
        a = jnp.ravel(a[jnp.maximum(state.t - 1, 0)])
        # a seed is an unsigned number of any size
        seed = jnp.issubdtype(a.dtype, jnp.unsignedinteger)
        return a.astype(dtype) / (float(jnp.iinfo(a.dtype).max) if seed else 1.0)

    last = map(numbers, rows)
    return jnp.concatenate([(state.t / rows[0].shape[0]).astype(dtype)[None], *last])[:OBSERVED]


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _ask(host, size, live, t, x0, disturbances):
    """Event, distance, terminal, log p and [size] observed numbers from the host, where ``live``;
    one call for a batch, under any number of `jax.vmap`.
    """
    flag, number = (jax.ShapeDtypeStruct((), d) for d in (bool, jnp.zeros(()).dtype))
    shapes = flag, number, flag, number, jax.ShapeDtypeStruct((size,), number.dtype)
    return host_call(
        host.callback(number.dtype, size), shapes, live, t, *jax.tree.leaves((x0, disturbances))
    )


@_ask.defjvp
def _(host, size, primals, tangents):
    """No gradient: NaN, whatever the direction."""
    event, distance, terminal, log_p, seen = _ask(host, size, *primals)
    floats = [a for a in jax.tree.leaves(tangents) if a.dtype != jax.dtypes.float0]
    moved = [jnp.sum(a).astype(distance.dtype) for a in floats]
    unknown = sum(moved, jnp.zeros_like(distance)) * jnp.nan
    none = np.zeros((), jax.dtypes.float0)
    slopes = none, unknown, none, unknown, jnp.broadcast_to(unknown, seen.shape)
    return (event, distance, terminal, log_p, seen), slopes
