"""Episodes in whatever form a user has them, as one batch; what their ends left undrawn, what is
observed at each of their steps; and ordinary ones.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core import rewards
from jast._src.core.episode import Episode, play_back, rollout, stacked
from jast._src.core.failures import Failures, identity
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.normal_space.transform import side_by_side
from jast._src.runtime._jax import jit
from jast._src.search.refine.modes import Mode
from jast._src.util.checks import wrong
from jast._src.util.pytrees import as_partial, index_tree, select_rows

__all__ = [
    "distinct_rows",
    "draw_ordinary",
    "gather_episodes",
    "named_kinds",
    "observations",
    "play_to_horizon",
]

LANES = 256  # episodes that are played at a time


def gather_episodes(function: str, argument: str, sim: Simulator, given: Any) -> Episode:
    """One batch [n], on the host and without states, of a `jast.Episode` (one or a batch), a
    `jast.failures.Failures`, anything that has these as ``failures``, or a sequence of episodes or
    of modes.

    Raises:
        ValueError: which names the ``argument``, for anything else and for episodes that are not of
            ``sim``.
    """
    refusal = ValueError(
        f"{function}: {argument} must be episodes (a jast.Episode with a leading axis, a list of"
        f" them, result.failures, a report), received {type(given).__name__}"
    )
    held = getattr(given, "failures", None)
    e = held if isinstance(held, Failures | Episode) else given
    if isinstance(e, Failures):
        e = e.episodes
    elif isinstance(e, list | tuple) and not isinstance(e, Episode):
        each = [part.failure if isinstance(part, Mode) else part for part in e]
        if not all(isinstance(part, Episode) and np.ndim(part.length) == 0 for part in each):
            raise refusal
        if not each:
            raise ValueError(f"{function}: {argument} must hold episodes, received none")
        e = stacked(each)
    if not isinstance(e, Episode):
        raise refusal
    e = jax.tree.map(np.asarray, jax.device_get(e._replace(states=None)))
    if e.length.ndim == 0:
        e = index_tree(e, None)
    if e.length.ndim != 1:
        raise wrong(function, argument, "have one leading axis", f"the shape {e.length.shape}")
    signature, n = signature_of(sim), len(e.length)
    for part, like, rows in (
        (e.x0, signature.x0, ()),
        (e.disturbances, signature.x, (sim.horizon,)),
    ):
        wanted = jax.tree.map(lambda s, rows=rows: (n, *rows, *s.shape), like)
        if jax.tree.map(np.shape, part) != wanted:
            must = f"be episodes of sim, with disturbances of the shapes {wanted}"
            raise wrong(function, argument, must, jax.tree.map(np.shape, part))
    return e


def distinct_rows(e: Episode) -> np.ndarray:
    """Rows of the first of each of the equal episodes [n]."""
    seen: dict[bytes, int] = {}
    for i in range(len(e.length)):
        seen.setdefault(identity(index_tree(e, i)), i)
    return np.fromiter(seen.values(), int, len(seen))


def named_kinds(function: str, labels: Any, n: int) -> tuple[tuple[str, ...], np.ndarray]:
    """The different names in ``labels``, and the number of that of each of ``n`` failures."""
    names, at = np.unique(np.asarray(labels).astype(str), return_inverse=True)
    if at.shape != (n,):
        must = f"be one for each of the {n} failures"
        raise wrong(function, "labels", must, f"the shape {np.shape(labels)}")
    return tuple(names.tolist()), at


def play_to_horizon(
    sim: Simulator, e: Episode, key: jax.Array, states: bool
) -> tuple[Episode, int]:
    """The episodes [n] of `gather_episodes`, whose disturbances go on to the horizon, with their
    states but for random keys; and how many were played for it. On the host.

    A failing episode is over sooner than others; what would have come is drawn from the model at
    its last state. So no number tells that an episode was over.

    Args:
        states: whether states are asked for. Without them episodes that all last to the horizon are
            not played again.
    """
    n = len(e.length)
    if not states and (e.length == sim.horizon).all():
        return e, 0
    rows = np.arange(n, dtype=np.int32), e.x0, e.disturbances, e.length
    x, s = side_by_side(sim, partial(_played_on, sim, key), *rows, lanes=LANES)
    return e._replace(disturbances=x, states=s), n


@jit
def _played_on(sim: Simulator, key: Any, at: Any, x0: Any, x: Any, length: Any) -> Any:
    def one(at, x0, x, length):
        e = play_back(sim, rewards.STANDARD, x0, x, length)
        last = sim.disturbance(index_tree(e.states, length))
        keys = jax.random.split(jax.random.fold_in(key, at), sim.horizon)
        more = jax.vmap(lambda k: D.sample(last, k))(keys)
        live = jnp.arange(sim.horizon, dtype=jnp.int32) < length
        return select_rows(live, x, more), jax.tree.map(_plain, e.states)

    return jax.vmap(one)(at, x0, x, length)


def _plain(a: jax.Array) -> jax.Array:
    key = jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key)
    return jnp.zeros((len(a), 0)) if key else a


def draw_ordinary(key: jax.Array, sim: Simulator, n: int) -> Episode:
    """At most ``n`` episodes of the model that do not fail."""
    at = np.arange(n, dtype=np.int32)
    e = side_by_side(sim, partial(_drawn, key, sim), at, lanes=LANES)
    return index_tree(e, ~e.failure)


@jit
def _drawn(key: jax.Array, sim: Simulator, at: jax.Array) -> Episode:
    return jax.vmap(lambda k: rollout(jax.random.fold_in(key, k), sim)._replace(states=None))(at)


def observations(name: str, sim: Simulator, observe: Callable, e: Episode) -> np.ndarray:
    """[n, horizon + 1, d] of the states."""
    watched, about = partial(_watched, sim, as_partial(observe)), (e.x0, e.disturbances, e.length)
    seen = side_by_side(sim, watched, *about, lanes=LANES)
    if not isinstance(seen, np.ndarray) or seen.ndim != 3:
        shapes = jax.tree.map(lambda a: np.shape(a)[2:], seen)
        raise wrong(name, "observe", "return a vector [d]", f"arrays of the shapes {shapes}")
    return seen.astype(float)


@jit
def _watched(sim: Simulator, observe: Partial, x0: Any, x: Any, length: Any) -> Any:
    def one(x0, x, length):
        states = play_back(sim, rewards.STANDARD, x0, x, length).states
        return jax.tree.map(jnp.asarray, jax.vmap(observe)(states))

    return jax.vmap(one)(x0, x, length)
